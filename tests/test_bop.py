"""BOP data sets.

Accepted: pictures in rgb or gray with any suffix, folders and pictures with zeros or not, PLY, OBJ, GLB
and STL meshes in mm, JSON with a byte order mark or in UTF-16, pictures with nothing in them, no scene_gt_info, no
targets or BOP'24's, a sensor's files (scene_camera_SENSOR.json, rgb_SENSOR; chosen as test:SENSOR where there are
several). Warned about: meshes in another unit (by the stated diameter, or where mm make no object), a stated diameter
in metres or far from the mesh's, a mesh so small that it may be in metres. Refused: missing or damaged files, poses in
metres, entries of another kind than BOP's, lens distortion in scene_camera.json, scene_gt_info that does not fit
scene_gt.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from posekit.datasets.bop import BopDataset
from posekit.errors import CameraError, ImageError, InputError, MeshError, PromptError
from posekit.geometry import random_rotation
from posekit.mesh.model import ObjectModel

R = random_rotation(np.random.default_rng(1))


def put(path: Path, data: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(data))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two scenes; image 3 of the first has two instances of object 5 and one of object 9."""
    models = tmp_path / "models"
    models.mkdir()
    for k in (5, 9):
        trimesh.creation.box((100 + k, 60, 40)).export(models / f"obj_{k:06d}.ply")
    put(models / "models_info.json", {"9": {"symmetries_discrete": [np.diag([-1.0, -1, 1, 1]).ravel().tolist()]}})
    for scene, images in ((2, (3, 11)), (40, (0,))):
        folder = tmp_path / "test" / f"{scene:06d}"
        (folder / "rgb").mkdir(parents=True)
        (folder / "mask_visib").mkdir()
        truth = [
            {"obj_id": k, "cam_R_m2c": R.ravel().tolist(), "cam_t_m2c": [10.0 * i, -20.0, 800.0]}
            for i, k in enumerate((5, 9, 5))
        ]
        info = [
            {
                "bbox_obj": [10 * i, 20, 30, 40],
                "bbox_visib": [10 * i, 20, 15, 40] if i else [-1] * 4,
                "visib_fract": 0.4 * i,
            }
            for i in range(3)
        ]
        put(folder / "scene_gt.json", {str(i): truth for i in images})
        put(folder / "scene_gt_info.json", {str(i): info for i in images})
        cameras = {str(i): {"cam_K": [500 + i, 0, 31.5, 0, 501, 23.5, 0, 0, 1], "depth_scale": 1.0} for i in images}
        put(folder / "scene_camera.json", cameras)
        for i in images:
            Image.new("RGB", (64, 48), (i, 0, 0)).save(folder / "rgb" / f"{i:06d}.png")
        mask = np.zeros((48, 64), np.uint8)
        Image.fromarray(mask).save(folder / "mask_visib" / "000003_000000.png")
        mask[5:9, 6:8] = 255
        Image.fromarray(mask).save(folder / "mask_visib" / "000003_000001.png")
    return tmp_path


def test_what_there_is(root: Path) -> None:
    data = BopDataset(root)
    assert data.model_ids() == [5, 9]
    assert data.scenes() == [2, 40]
    assert data.images() == [(2, 3), (2, 11), (40, 0)]
    assert data.images(2) == [(2, 3), (2, 11)]
    assert data.targets is None


def test_models_are_in_metres_and_loaded_once(root: Path) -> None:
    data = BopDataset(root)
    np.testing.assert_allclose(data.model(9).extents, [0.109, 0.06, 0.04], atol=1e-6)
    assert len(data.model(9).symmetries.discrete) == 1
    assert data.model(9) is data.model(9)


def test_views_have_their_own_camera(root: Path) -> None:
    data = BopDataset(root)
    view = data.view(2, 11)
    assert (view.camera.fx, view.camera.fy, view.camera.size) == (511, 501, (64, 48))
    assert view.image[0, 0].tolist() == [11, 0, 0]
    assert data.view(2, 3).camera.fx == 503


def test_instances(root: Path) -> None:
    first, second, _ = BopDataset(root).instances(2, 3)
    assert (second.scene, second.image, second.index, second.obj_id) == (2, 3, 1, 9)
    np.testing.assert_allclose(second.T_cam_obj.t, [0.01, -0.02, 0.8])
    np.testing.assert_allclose(second.T_cam_obj.R, R, atol=1e-9)
    assert second.box_obj == (10, 20, 41, 61)
    assert second.box_visib == (10, 20, 26, 61)
    assert second.visib_fract == pytest.approx(0.4)
    assert second.mask().sum() == 8
    assert first.box_visib is None
    assert not first.mask().any()  # hidden altogether


def test_a_truth_that_is_scaled_a_little_is_a_rotation_again(root: Path) -> None:
    path = root / "test" / "000002" / "scene_gt.json"
    truth = json.loads(path.read_text())
    truth["3"][0]["cam_R_m2c"] = (R * 1.0023).ravel().tolist()
    put(path, truth)
    np.testing.assert_allclose(BopDataset(root).instances(2, 3)[0].T_cam_obj.R, R, atol=1e-9)


def test_targets_choose_images_and_instances(root: Path) -> None:
    put(root / "test_targets_bop24.json", [{"scene_id": 40, "im_id": 0, "obj_id": 5, "inst_count": 1}])
    put(root / "test_targets_bop19.json", [{"scene_id": 2, "im_id": 3, "obj_id": 5, "inst_count": 1}])
    data = BopDataset(root)
    assert data.images() == [(2, 3)]
    assert [i.index for i in data.instances(2, 3)] == [2]  # the more visible one of the two
    assert len(data.instances(2, 3, every=True)) == 3
    assert data.images(40) == []
    assert BopDataset(root, targets="test_targets_bop24.json").images() == [(40, 0)]
    assert len(BopDataset(root, targets=None).images()) == 3
    with pytest.raises(InputError, match=r"there is no targets file .*x.json: check its name, or pass targets=None"):
        BopDataset(root, targets="x.json")
    put(root / "test_targets_bop19.json", [{"scene": 2}])
    with pytest.raises(InputError, match="is no list of targets with scene_id"):
        BopDataset(root).images()


def test_without_scene_gt_info_boxes_are_unknown(root: Path) -> None:
    (root / "test" / "000002" / "scene_gt_info.json").unlink()
    [first, *_] = BopDataset(root).instances(2, 3)
    assert first.box_obj is None
    assert np.isnan(first.visib_fract)


def test_what_is_missing_is_named(root: Path) -> None:
    with pytest.raises(InputError, match=r"has no folder 'val': a data set in BOP layout has models/"):
        BopDataset(root, split="val")
    with pytest.raises(InputError, match=r"there is no scene .*000003; there are \[2, 40\]"):
        BopDataset(root).images(3)
    with pytest.raises(MeshError, match=r"there is no mesh .*obj_000007.ply for object 7; there are \[5, 9\]"):
        BopDataset(root).model(7)
    with pytest.raises(MeshError, match="there are no meshes"):
        BopDataset(root, models="models_eval").model_ids()
    data = BopDataset(root)
    with pytest.raises(InputError, match="has no annotations for image 12"):
        data.instances(2, 12)
    with pytest.raises(InputError, match=r"there is no photograph .*000012.png"):
        data.view(2, 12)
    with pytest.raises(CameraError, match="has no camera for image 12"):
        data.camera(2, 12, (64, 48))
    with pytest.raises(PromptError, match="is not there"):
        data.instances(2, 3)[2].mask()


@pytest.mark.parametrize("name", ["scene_gt.json", "scene_camera.json"])
def test_missing_and_damaged_scene_files(root: Path, name: str) -> None:
    path = root / "test" / "000002" / name

    def use() -> None:
        data = BopDataset(root)
        data.view(2, 3)
        data.instances(2, 3)

    path.write_text("{")
    with pytest.raises(InputError, match=f"{name} cannot be read"):
        use()
    path.write_text("[]")
    with pytest.raises(InputError, match="does not map image numbers to entries"):
        use()
    path.unlink()
    with pytest.raises(InputError, match=f"there is no file .*{name}: this copy of the data set is not complete"):
        use()


def test_annotations_that_do_not_fit(root: Path) -> None:
    folder = root / "test" / "000002"
    put(folder / "scene_gt_info.json", {"3": []})
    with pytest.raises(InputError, match=r"has 0 entries for image 3, scene_gt.json 3: they belong together"):
        BopDataset(root).instances(2, 3)
    put(folder / "scene_gt.json", {"3": []})
    put(folder / "scene_gt_info.json", {"3": [{}]})
    assert BopDataset(root).instances(2, 3) == []  # nothing in the picture, whatever is said about it
    put(folder / "scene_gt.json", {"3": [{"obj_id": 5, "cam_R_m2c": [0] * 9, "cam_t_m2c": [0, 0, 900]}]})
    put(folder / "scene_gt_info.json", {"3": [{"bbox_obj": [0] * 4, "bbox_visib": [0] * 4, "visib_fract": 1}]})
    with pytest.raises(InputError, match=r"annotation 0 of image 3 .* is not BOP's"):
        BopDataset(root).instances(2, 3)


def test_files_in_utf16_are_read(root: Path) -> None:
    for path in (root / "test" / "000002").glob("*.json"):
        path.write_bytes(path.read_text().encode("utf-16"))
    data = BopDataset(root)
    assert data.instances(2, 3) and data.view(2, 3)


def test_a_damaged_photograph(root: Path) -> None:
    (root / "test" / "000002" / "rgb" / "000003.png").write_bytes(b"\x89PNG")
    with pytest.raises(ImageError):
        BopDataset(root).view(2, 3)


# --- sets as people make them ---


@pytest.mark.parametrize("kind", ["rgb", "gray"])
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"])
def test_pictures_of_every_suffix(kind: str, suffix: str, root: Path) -> None:
    folder = root / "test" / "000002"
    (folder / "rgb" / "000003.png").unlink()
    (folder / kind).mkdir(exist_ok=True)
    Image.new("L", (64, 48), 90).save(folder / kind / f"000003{suffix}")
    assert BopDataset(root).view(2, 3).image[0, 0].tolist() == pytest.approx([90] * 3, abs=2)


def test_folders_pictures_and_meshes_without_zeros(root: Path) -> None:
    (root / "test" / "000002").rename(root / "test" / "2")
    (root / "test" / "2" / "rgb" / "000003.png").rename(root / "test" / "2" / "rgb" / "3.png")
    trimesh.load(root / "models" / "obj_000009.ply").export(root / "models" / "obj_9.obj")
    (root / "models" / "obj_000009.ply").unlink()
    data = BopDataset(root)
    assert data.scenes() == [2, 40] and data.view(2, 3).camera.fx == 503
    np.testing.assert_allclose(data.model(9).extents, [0.109, 0.06, 0.04], atol=1e-6)


def test_a_byte_order_mark(root: Path) -> None:
    for path in root.rglob("*.json"):
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    data = BopDataset(root)
    assert len(data.instances(2, 3)) == 3 and len(data.model(9).symmetries.discrete) == 1


def test_models_in_metres_are_told(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    trimesh.creation.box((0.1, 0.06, 0.04)).export(root / "models" / "obj_000005.ply")
    np.testing.assert_allclose(BopDataset(root).model(5).extents, [0.1, 0.06, 0.04], atol=1e-6)
    assert "obj_000005.ply: BOP's meshes are in mm" in caplog.text and "taken for metres" in caplog.text


def test_targets_of_pictures_alone_ask_for_all_that_is_in_them(root: Path) -> None:
    """As BOP'24 has them."""
    put(root / "test_targets_bop24.json", [{"scene_id": 2, "im_id": 3}])
    data = BopDataset(root)
    assert data.images() == [(2, 3)]
    assert [(t.obj_id, t.count) for t in data.targets or ()] == [(5, 2), (9, 1)]
    assert len(data.instances(2, 3)) == 3


@pytest.mark.parametrize("stated", [None, 155.0])
def test_a_mesh_in_metres_is_told_by_the_stated_diameter(
    stated: float | None, root: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Two metres long, so "2 mm" would be an object too."""
    mesh = trimesh.creation.box((2.0, 0.5, 0.4))
    mesh.export(root / "models" / "obj_000005.ply")
    long = float(np.linalg.norm((2.0, 0.5, 0.4)))
    put(root / "models" / "models_info.json", {} if stated is None else {"5": {"diameter": 1000 * long}})
    model = BopDataset(root).model(5)
    assert model.diameter == pytest.approx(long if stated else long / 1000, rel=1e-5)
    assert ("taken for metres, 2100 mm long" if stated else "where it is in another unit") in caplog.text


def test_a_diameter_stated_in_metres_is_measured(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    size = BopDataset(root).model(5).diameter
    put(root / "models" / "models_info.json", {"5": {"diameter": size}})
    assert BopDataset(root).measured_model(5).diameter == pytest.approx(size)
    assert "is in metres, not in BOP's mm" in caplog.text


def test_a_stated_diameter_of_something_else_is_told(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    put(root / "models" / "models_info.json", {"5": {"diameter": 4000.0}})
    assert BopDataset(root).measured_model(5).diameter == pytest.approx(4.0)
    assert "models_info.json says 4000" in caplog.text


@pytest.mark.parametrize(("units", "scale"), [("mm", 1.0), ("m", 1000.0), ("cm", 10.0)])
def test_units_that_are_given_are_taken(units: str, scale: float, root: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Also where models_info.json tells another story."""
    stated = BopDataset(root).model(5).diameter
    for path in (root / "models").glob("obj_*.ply"):
        mesh = trimesh.load(path, process=False)
        mesh.apply_scale(1 / scale)
        mesh.export(path)
    caplog.clear()
    assert BopDataset(root, units=units).model(5).diameter == pytest.approx(stated, rel=1e-5)
    assert not caplog.records


def test_poses_in_metres_are_refused(root: Path) -> None:
    path = root / "test" / "000002" / "scene_gt.json"
    data = json.loads(path.read_text())
    for entry in (e for entries in data.values() for e in entries):
        entry["cam_t_m2c"] = [v / 1000 for v in entry["cam_t_m2c"]]
    put(path, data)
    with pytest.raises(InputError, match="seems to be in metres; multiply it by 1000"):
        BopDataset(root).instances(2, 3)


def as_sensor(folder: Path, name: str) -> None:
    for kind in ("scene_camera", "scene_gt", "scene_gt_info"):
        (folder / f"{kind}_{name}.json").write_bytes((folder / f"{kind}.json").read_bytes())
    for kind in ("rgb", "mask_visib"):
        (folder / f"{kind}_{name}").mkdir()
        for path in (folder / kind).iterdir():
            (folder / f"{kind}_{name}" / path.name).write_bytes(path.read_bytes())


def test_the_pictures_of_a_sensor(root: Path) -> None:
    folder = root / "test" / "000002"
    as_sensor(folder, "photoneo")
    for path in [folder / f"{kind}.json" for kind in ("scene_camera", "scene_gt", "scene_gt_info")]:
        path.unlink()
    data = BopDataset(root)
    assert data.image_path(2, 3) == folder / "rgb_photoneo" / "000003.png"
    assert data.view(2, 3).camera.fx == 503
    assert data.instances(2, 3)[1].mask().sum() == 8
    as_camera = json.loads((folder / "scene_camera_photoneo.json").read_text())
    put(folder / "scene_camera_cam1.json", as_camera)
    with pytest.raises(InputError, match="sensors cam1, photoneo: choose one, as --split test:cam1"):
        BopDataset(root).images(2)
    assert BopDataset(root, "test:photoneo").images(2) == [(2, 3), (2, 11)]
    with pytest.raises(InputError, match="no sensor 'left'; there are cam1, photoneo"):
        BopDataset(root, "test:left").images(2)


@pytest.mark.parametrize(
    ("name", "entry"), [("scene_camera.json", [1]), ("scene_camera.json", "x"), ("scene_gt.json", {"obj_id": 1})]
)
def test_entries_of_another_kind(name: str, entry: object, root: Path) -> None:
    put(root / "test" / "000002" / name, {"3": entry})
    with pytest.raises(InputError, match=f"{name}, image 3: its entry is no (map|list)"):
        BopDataset(root).instances(2, 3), BopDataset(root).camera(2, 3, (64, 48))


@pytest.mark.parametrize("entry", [{}, {"cam_K": None}, {"cam_K": [10**400] * 9}, {"cam_K": [1, 2]}])
def test_a_camera_that_is_none(entry: object, root: Path) -> None:
    put(root / "test" / "000002" / "scene_camera.json", {"3": entry})
    with pytest.raises(CameraError, match=r"scene_camera\.json, image 3"):
        BopDataset(root).camera(2, 3, (64, 48))


def test_distortion_in_scene_camera_is_refused(root: Path) -> None:
    path = root / "test" / "000002" / "scene_camera.json"
    data = json.loads(path.read_text())
    data["3"]["dist_coeffs"] = [-0.1, 0.02, 0, 0, 0]
    put(path, data)
    with pytest.raises(CameraError, match="image 3: its picture has lens distortion"):
        BopDataset(root).view(2, 3)
    assert BopDataset(root).view(2, 11).camera.fx == 511


@pytest.mark.parametrize(("scale", "suffix"), [(1.0, ".png"), (0.1, ".png"), (0.1, ".tif"), (None, ".png")])
def test_depth_is_in_metres_by_the_pictures_own_scale(scale: float | None, suffix: str, root: Path) -> None:
    """A grey value times depth_scale is millimetres; without one a grey value is a millimetre."""
    folder = root / "test" / "000002"
    assert BopDataset(root).depth(2, 3) is None
    raw = np.zeros((48, 64), np.uint16)
    raw[10, 20], raw[30, 40] = 8000, 1
    (folder / "depth").mkdir()
    Image.fromarray(raw).save(folder / "depth" / f"000003{suffix}")
    cameras = json.loads((folder / "scene_camera.json").read_text())
    cameras["3"].pop("depth_scale")
    if scale is not None:
        cameras["3"]["depth_scale"] = scale
    put(folder / "scene_camera.json", cameras)
    depth = BopDataset(root).depth(2, 3)
    assert depth is not None and depth.dtype == np.float32 and depth.shape == (48, 64)
    assert depth[10, 20] == pytest.approx(8.0 * (scale or 1.0)) and depth[30, 40] == pytest.approx(
        1e-3 * (scale or 1.0)
    )
    assert np.count_nonzero(depth) == 2


def test_damaged_depth_is_told(root: Path) -> None:
    folder = root / "test" / "000002"
    (folder / "depth").mkdir()
    Image.new("RGB", (64, 48)).save(folder / "depth" / "000003.png")
    with pytest.raises(ImageError, match="damaged or has several channels"):
        BopDataset(root).depth(2, 3)
    (folder / "depth" / "000003.png").write_bytes(b"x")
    with pytest.raises(ImageError, match="damaged or has several channels"):
        BopDataset(root).depth(2, 3)
    Image.new("I;16", (64, 48)).save(folder / "depth" / "000003.png")
    cameras = json.loads((folder / "scene_camera.json").read_text())
    cameras["3"]["depth_scale"] = "x"
    put(folder / "scene_camera.json", cameras)
    with pytest.raises(InputError, match="image 3: its depth_scale is no number"):
        BopDataset(root).depth(2, 3)


def test_a_pictures_size_is_read_from_its_header(root: Path) -> None:
    assert BopDataset(root).picture_size(2, 3) == (64, 48)
    (root / "test" / "000002" / "rgb" / "000003.png").write_bytes(b"x")
    with pytest.raises(ImageError, match="is damaged"):
        BopDataset(root).picture_size(2, 3)


def test_a_stated_diameter_is_in_millimetres(root: Path) -> None:
    """Taken where it is that of the mesh, to a twentieth, in mm."""
    measured = BopDataset(root).model(5).diameter
    for stated in (1000 * measured * 1.04, 1000 * measured * 0.96, 1000 * measured * 1.2):
        put(root / "models" / "models_info.json", {"5": {"diameter": stated}})
        assert BopDataset(root).measured_model(5).diameter == pytest.approx(stated / 1000)
    for bad in (0, -3, "x", float("inf"), None):
        put(root / "models" / "models_info.json", {"5": {"diameter": bad}})
        with pytest.raises(InputError, match="it is a number of mm"):
            BopDataset(root).measured_model(5)
    put(root / "models" / "models_info.json", {"9": {"diameter": 5}})
    assert BopDataset(root).measured_model(5).diameter == pytest.approx(measured)


def test_the_fine_models_measure_where_there_are_some(root: Path) -> None:
    (root / "models_eval").mkdir()
    trimesh.creation.box((50, 60, 40)).export(root / "models_eval" / "obj_000005.ply")
    put(root / "models_eval" / "models_info.json", {"5": {"diameter": 90.0}})
    data = BopDataset(root)
    assert data.measured_model(5).diameter == pytest.approx(0.09)
    np.testing.assert_allclose(data.measured_model(5).model.extents, [0.05, 0.06, 0.04], atol=1e-6)
    assert data.measured_model(5) is data.measured_model(5) and data.measured_model(9).model is data.model(9)


def test_boxes_are_none_by_their_size_alone(root: Path) -> None:
    path = root / "test" / "000002" / "scene_gt_info.json"
    info = json.loads(path.read_text())
    for k, box in enumerate(([-5, -7, 0, 0], [3, 4, -1, 5], [3, 4, 5, -1])):
        info["3"][k]["bbox_obj"] = box
    put(path, info)
    assert [i.box_obj for i in BopDataset(root).instances(2, 3)] == [(-5, -7, -4, -6), None, None]


@pytest.mark.parametrize(("far", "known"), [(9.9, False), (10.1, True)])
def test_poses_nearer_than_a_centimetre_are_taken_for_metres(far: float, known: bool, root: Path) -> None:
    path = root / "test" / "000002" / "scene_gt.json"
    truth = json.loads(path.read_text())
    for entries in truth.values():
        for k, entry in enumerate(entries):
            entry["cam_t_m2c"] = [0.6 * far, 0.0, 0.8 * far] if k else [0, 0, 1]
    put(path, truth)
    if known:
        assert len(BopDataset(root).instances(2, 3)) == 3
    else:
        with pytest.raises(InputError, match="seems to be in metres"):
            BopDataset(root).instances(2, 3)


def test_only_numbered_folders_are_scenes(root: Path) -> None:
    (root / "test" / "notes").mkdir()
    (root / "test" / "77").write_text("")
    assert BopDataset(root).scenes() == [2, 40]


def test_one_target_without_an_object_is_refused(root: Path) -> None:
    put(
        root / "test_targets_bop19.json",
        [{"scene_id": 2, "im_id": 3, "obj_id": 5, "inst_count": 1}, {"scene_id": 2, "im_id": 11}],
    )
    with pytest.raises(InputError, match="is no list of targets with scene_id"):
        BopDataset(root).images()


def test_one_entry_without_a_number_is_refused(root: Path) -> None:
    path = root / "test" / "000002" / "scene_camera.json"
    put(path, json.loads(path.read_text()) | {"first": {}})
    with pytest.raises(InputError, match="does not map image numbers to entries"):
        BopDataset(root).camera(2, 3, (64, 48))


@pytest.mark.parametrize(("share", "told"), [(0.8, True), (0.96, False), (1.04, False), (1.2, True)])
def test_a_stated_diameter_is_told_from_a_twentieth_on(
    share: float, told: bool, root: Path, caplog: pytest.LogCaptureFixture
) -> None:
    put(root / "models" / "models_info.json", {"5": {"diameter": share * float(np.linalg.norm((105, 60, 40)))}})
    BopDataset(root).model(5)
    assert ("models_info.json says" in caplog.text) == told and len(caplog.records) == told


def test_a_mesh_in_millimetres_is_read_once_and_nothing_is_told(
    root: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, load = [], ObjectModel.load

    def counted(path: Path, units: str) -> ObjectModel:
        asked.append(units)
        return load(path, units=units)

    monkeypatch.setattr(ObjectModel, "load", counted)
    for stated in ({}, {"5": {"diameter": float(np.linalg.norm((105, 60, 40)))}}):
        put(root / "models" / "models_info.json", stated)
        BopDataset(root).model(5)
    assert asked == ["mm", "mm"] and not caplog.records
    trimesh.creation.box((1.0, 2.0, 2.0)).export(root / "models" / "obj_000005.ply")
    put(root / "models" / "models_info.json", {"5": {"diameter": 3.0}})
    BopDataset(root).model(5)
    assert not caplog.records, "as small as it is said to be"


def test_a_mesh_in_centimetres_is_told_with_its_sizes(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    trimesh.creation.box((10.0, 20.0, 20.0)).export(root / "models" / "obj_000005.ply")
    put(root / "models" / "models_info.json", {"5": {"diameter": 300.0}})
    assert BopDataset(root).model(5).diameter == pytest.approx(0.3)
    assert "would make it 30 mm long; it is taken for centimetres, 300 mm long" in caplog.text


def test_a_mesh_of_no_size_that_fits_is_refused_with_its_size(root: Path) -> None:
    trimesh.creation.box((1e6, 2e6, 2e6)).export(root / "models" / "obj_000005.ply")
    with pytest.raises(MeshError, match=r"obj_000005\.ply.*The meshes of a data set in BOP layout are in mm"):
        BopDataset(root).model(5)

"""What is written in BOP layout is what posekit, COCO's rules and BOP's toolkit read."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from objects import bracket
from posekit.camera import Camera
from posekit.datasets.bop import BopDataset
from posekit.datasets.bop_writer import Annotation, BopWriter, Picture, mask_to_rle, model_info, write_models
from posekit.errors import InputError
from posekit.geometry import Pose, random_rotation
from posekit.mesh.model import ObjectModel
from posekit.mesh.symmetries import Symmetries

CAMERA = Camera(100.0, 101.0, 31.5, 23.5, 64, 48)
RNG = np.random.default_rng(0)


def a_mask(x0: int, y0: int, x1: int, y1: int) -> np.ndarray:
    mask = np.zeros((48, 64), bool)
    mask[y0:y1, x0:x1] = True
    return mask


def a_picture(obj_ids: tuple[int, ...] = (3, 7)) -> Picture:
    poses = [Pose(random_rotation(RNG), np.array([0.01 * k, -0.02, 0.8])) for k in range(len(obj_ids))]
    whole, seen = a_mask(10, 5, 30, 25), a_mask(10, 5, 20, 25)
    annotations = [Annotation(o, pose, whole, seen) for o, pose in zip(obj_ids, poses, strict=True)]
    depth = np.where(whole, 0.8123, 1.5).astype(np.float32)
    image = RNG.integers(0, 256, (48, 64, 3)).astype(np.uint8)
    return Picture(image, CAMERA, annotations, depth)


def finished(root: Path, pictures: dict[tuple[int, int], Picture], quality: int | None = None) -> BopDataset:
    writer = BopWriter(root, "train", quality)
    for (scene, image), picture in pictures.items():
        writer.write(scene, image, picture)
    writer.finish({3: "three", 7: "seven"})
    return BopDataset(root, "train", targets=None)


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    pictures = {(1, 0): a_picture(), (1, 5): a_picture((7,)), (4, 2): a_picture((3, 3))}
    data = finished(tmp_path, pictures)
    assert data.images() == sorted(pictures)
    for (scene, image), picture in pictures.items():
        view = data.view(scene, image)
        np.testing.assert_array_equal(view.image, picture.image)
        assert view.camera == CAMERA
        for instance, annotation in zip(data.instances(scene, image), picture.annotations, strict=True):
            assert instance.obj_id == annotation.obj_id
            np.testing.assert_allclose(instance.T_cam_obj.matrix, annotation.T_cam_obj.matrix, atol=1e-12)
            np.testing.assert_array_equal(instance.mask(), annotation.mask_visib)
            assert instance.box_obj == (10, 5, 30, 25) and instance.box_visib == (10, 5, 20, 25)
            assert instance.visib_fract == pytest.approx(0.5)


def test_depth_is_in_units_of_its_scale(tmp_path: Path) -> None:
    finished(tmp_path, {(1, 0): a_picture()})
    units = cv2.imread(str(tmp_path / "train/000001/depth/000000.png"), cv2.IMREAD_UNCHANGED)
    camera = json.loads((tmp_path / "train/000001/scene_camera.json").read_text())["0"]
    assert units.dtype == np.uint16
    assert units[10, 12] * camera["depth_scale"] == pytest.approx(812.3, abs=0.06)


def test_what_lies_outside_the_picture_counts(tmp_path: Path) -> None:
    mask = a_mask(0, 5, 10, 25)
    annotation = Annotation(3, Pose.translation([0, 0, 1]), mask, mask, pixels=400, box=(-10, 5, 10, 25))
    data = finished(tmp_path, {(1, 0): Picture(np.zeros((48, 64, 3), np.uint8), CAMERA, [annotation])})
    [instance] = data.instances(1, 0)
    assert instance.box_obj == (-10, 5, 10, 25) and instance.box_visib == (0, 5, 10, 25)
    assert instance.visib_fract == pytest.approx(0.5)


def test_coco_annotations_are_coco(tmp_path: Path) -> None:
    finished(tmp_path, {(1, 0): a_picture()})
    coco = json.loads((tmp_path / "train/000001/scene_gt_coco.json").read_text())
    assert [c["name"] for c in coco["categories"]] == ["three", "seven"]
    assert coco["images"][0]["file_name"] == "rgb/000000.png"
    first, second = coco["annotations"]
    assert (first["id"], second["id"], second["category_id"], first["image_id"]) == (1, 2, 7, 0)
    assert first["bbox"] == [10, 5, 10, 20] and first["area"] == 200
    np.testing.assert_array_equal(decoded(first["segmentation"]), a_mask(10, 5, 20, 25))


def decoded(rle: dict) -> np.ndarray:
    values = np.repeat(np.arange(len(rle["counts"])) % 2, rle["counts"]).astype(bool)
    return values.reshape(rle["size"], order="F")


@pytest.mark.parametrize("kind", ["empty", "full", "corner", "end", "random"])
def test_run_lengths(kind: str) -> None:
    mask = {"empty": a_mask(0, 0, 0, 0), "full": a_mask(0, 0, 64, 48), "corner": a_mask(0, 0, 1, 1),
            "end": a_mask(63, 47, 64, 48), "random": RNG.random((48, 64)) < 0.5}[kind]  # fmt: skip
    np.testing.assert_array_equal(decoded(mask_to_rle(mask)), mask)


def test_targets_are_what_is_visible_enough(tmp_path: Path) -> None:
    hidden = Annotation(3, Pose.translation([0, 0, 1]), a_mask(0, 0, 20, 20), a_mask(0, 0, 2, 2))
    shown = a_picture((7, 7))
    picture = Picture(shown.image, CAMERA, [hidden, *shown.annotations])
    finished(tmp_path, {(1, 0): picture})
    targets = json.loads((tmp_path / "train_targets_bop19.json").read_text())
    assert targets == [{"im_id": 0, "inst_count": 2, "obj_id": 7, "scene_id": 1}]
    assert [i.obj_id for i in BopDataset(tmp_path, "train").instances(1, 0)] == [7, 7]


def test_a_killed_writing_goes_on(tmp_path: Path) -> None:
    first = BopWriter(tmp_path)
    first.write(1, 0, a_picture())
    assert BopWriter(tmp_path).written() == {(1, 0)}
    with pytest.raises(InputError, match="has no images"):
        BopWriter(tmp_path, "val").finish({})
    second = BopWriter(tmp_path)
    second.write(1, 1, a_picture())
    second.finish({3: "three", 7: "seven"})
    second.discard_records()
    assert BopDataset(tmp_path, "train", targets=None).images() == [(1, 0), (1, 1)]
    assert not (tmp_path / ".records").exists()


def test_arrays_that_do_not_fit(tmp_path: Path) -> None:
    picture = a_picture()
    with pytest.raises(InputError, match="arrays have shapes"):
        BopWriter(tmp_path).write(1, 0, Picture(picture.image[:40], CAMERA, picture.annotations))
    with pytest.raises(InputError, match="one for every annotation"):
        BopWriter(tmp_path).write(1, 0, Picture(picture.image, CAMERA, [], masks={"x": [a_mask(0, 0, 1, 1)]}))


def test_models_come_back(tmp_path: Path) -> None:
    plain = bracket((0.03, 0.0, -0.01))
    turned = ObjectModel.from_arrays(
        plain.vertices, plain.faces, colors=plain.colors, symmetries=Symmetries.parse("z:2,x:inf", plain.center)
    )
    uvs = RNG.random((len(plain.vertices), 2)).astype(np.float32)
    texture = RNG.integers(0, 256, (32, 16, 3)).astype(np.uint8)
    textured = ObjectModel.from_arrays(plain.vertices, plain.faces, uvs=uvs, texture=texture, normals=plain.normals)
    write_models(tmp_path, {1: turned, 12: textured})
    for folder in ("models", "models_eval"):
        (tmp_path / "train").mkdir(exist_ok=True)
        data = BopDataset(tmp_path, "train", models=folder)
        assert data.model_ids() == [1, 12]
        one, twelve = data.model(1), data.model(12)
        np.testing.assert_allclose(one.bounds, turned.bounds, atol=1e-7)
        np.testing.assert_allclose(twelve.normals, textured.normals, atol=1e-6)
        assert len(one.symmetries.discrete) == 1 and len(one.symmetries.continuous) == 1
        np.testing.assert_allclose(one.symmetries.discrete[0].matrix, turned.symmetries.discrete[0].matrix, atol=1e-9)
        np.testing.assert_allclose(one.symmetries.continuous[0].offset, turned.center, atol=1e-9)
    data = BopDataset(tmp_path, "train")
    np.testing.assert_array_equal(data.model(12).texture, texture)
    np.testing.assert_allclose(data.model(12).uvs, uvs, atol=1e-6)
    assert sorted(map(tuple, data.model(1).colors)) == sorted(map(tuple, turned.colors))


def test_model_info() -> None:
    model = bracket((0.03, 0.0, -0.01))
    info = model_info(model)
    assert info["diameter"] == pytest.approx(1000 * model.diameter)
    assert [info[f"min_{a}"] for a in "xyz"] == pytest.approx((1000 * model.bounds[0]).tolist())
    assert [info[f"size_{a}"] for a in "xyz"] == pytest.approx((1000 * model.extents).tolist())
    assert not any(key.startswith("symmetries") for key in info)

"""Synthetic data sets: true to their own annotations, the same whoever makes them, and whole after a kill."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import os
import signal
import subprocess
import sys
import tarfile
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from objects import bracket, cuboid
from posekit.cli.app import app
from posekit.datasets.bop import BopDataset
from posekit.datasets.bop_writer import write_models
from posekit.datasets.results_csv import ResultRow, results_csv
from posekit.datasets.symmetry import detect_symmetries
from posekit.errors import ConfigError, InputError, OutputError
from posekit.machines import Machines
from posekit.mesh.model import ObjectModel
from posekit.metrics import pose_error
from posekit.render import Renderer
from posekit.synth.backdrops import Backdrops
from posekit.synth.plan import SynthConfig
from posekit.synth.run import begin, run

SIZE = (160, 120)
QUIET = lambda done, total: None  # noqa: E731


def objects() -> dict[int, ObjectModel]:
    """A bracket, and a textured box."""
    vertices, faces = cuboid((-0.05, -0.02, -0.03), (0.05, 0.02, 0.03), cells=4)
    rng = np.random.default_rng(0)
    uvs = rng.random((len(vertices), 2))
    texture = rng.integers(0, 256, (16, 16, 3)).astype(np.uint8)
    return {2: bracket((0.02, 0, 0)), 5: ObjectModel.from_arrays(vertices, faces, name="box", uvs=uvs, texture=texture)}


def config(kind: str, images: int, **changes: object) -> SynthConfig:
    return dataclasses.replace(SynthConfig(kind, images, seed=3, size=SIZE, frames=3), **changes)


def make(root: Path, what: SynthConfig, machines: Machines = Machines(), shard: int = 0) -> BopDataset:
    begin(what, root, objects())
    run(root, machines, QUIET, shard)
    return BopDataset(root, what.split, targets=None)


def digest(root: Path) -> dict[str, str]:
    """Every file and what is in it."""
    files = sorted(p for p in root.rglob("*") if p.is_file())
    return {str(p.relative_to(root)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.mark.parametrize("kind", ["randomised", "scenes", "sequence"])
def test_its_own_truth_is_right(kind: str, tmp_path: Path, renderer: Renderer) -> None:
    """Read back, each pose has no error, and the mesh drawn there covers the mask; depth is the mesh's."""
    data = make(tmp_path / "set", config(kind, 6))
    assert len(data.images()) == 6
    checked = 0
    for scene, image in data.images():
        view = data.view(scene, image)
        units = cv2.imread(str(data.image_path(scene, image).parent.parent / f"depth/{image:06d}.png"), -1)
        for instance in data.instances(scene, image, every=True):
            model = data.model(instance.obj_id)
            turn, shift = pose_error(instance.T_cam_obj, instance.T_cam_obj, model.symmetries.transforms())
            assert turn < 1e-6 and shift < 1e-9
            [drawn] = renderer.render(model, [instance.T_cam_obj], view.camera)
            visible = instance.mask()
            assert drawn.mask is not None and drawn.depth is not None
            assert not (visible & ~drawn.mask).sum() > 0.01 * visible.sum() + 2
            if instance.visib_fract == 1.0 and visible.sum() > 300:
                assert (drawn.mask & visible).sum() / (drawn.mask | visible).sum() > 0.99
                checked += 1
            inside = visible & drawn.mask
            np.testing.assert_allclose(units[inside] * 1e-4, drawn.depth[inside], atol=2e-4)
    assert checked > 0


@pytest.mark.parametrize("kind", ["randomised", "scenes", "sequence", "photoreal"])
def test_its_own_truth_scores_exactly_100(kind: str, tmp_path: Path) -> None:
    what = config(kind, 2, size=(96, 72), samples=1, views=2, variant="scalar_rgb", split="test")
    data = make(tmp_path / "set", what)
    found = [i for scene, image in data.images() for i in data.instances(scene, image, every=True)]
    rows = [ResultRow(i.scene, i.image, i.obj_id, i.visib_fract, i.T_cam_obj.R, i.T_cam_obj.t, 0.5) for i in found]
    csv = tmp_path / "truth.csv"
    csv.write_text(results_csv(rows))
    arguments = ["eval", "--stage", "score", "--root", data.root, "--csv", csv, "--out", tmp_path / "out"]
    result = CliRunner().invoke(app, [*map(str, arguments)])
    assert result.exit_code == 0, result.output
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert results["counts"]["instances"] > 0 and results["counts"]["missing"] == 0
    for key in ("2deg_2cm", "add_01d", "vsd_ar", "mssd_ar", "mspd_ar", "ar"):
        assert results["pooled"][key] == 100.0


def test_several_workers_make_the_same_images(tmp_path: Path) -> None:
    what = config("randomised", 20)
    make(tmp_path / "one", what)
    make(tmp_path / "two", what, Machines(workers=2))
    assert digest(tmp_path / "one") == digest(tmp_path / "two")
    make(tmp_path / "other", dataclasses.replace(what, seed=4))
    assert digest(tmp_path / "other") != digest(tmp_path / "one")


def test_a_ray_cluster_makes_the_same_images(tmp_path: Path) -> None:
    what = config("sequence", 6)
    make(tmp_path / "one", what)
    make(tmp_path / "ray", what, Machines(workers=2, ray="local"))
    assert digest(tmp_path / "one") == digest(tmp_path / "ray")


def test_killed_and_resumed_is_never_killed(tmp_path: Path) -> None:
    what = config("randomised", 40)
    make(tmp_path / "whole", what)
    root = tmp_path / "killed"
    begin(what, root, objects())
    code = "import sys; from pathlib import Path; from posekit.machines import Machines\n" \
           "from posekit.synth.run import run; run(Path(sys.argv[1]), Machines(), lambda *_: None)"  # fmt: skip
    for wanted in (3, 17):
        process = subprocess.Popen([sys.executable, "-c", code, str(root)], start_new_session=True)
        records = root / ".records" / "train"
        while process.poll() is None and (not records.is_dir() or len(list(records.iterdir())) < wanted):
            time.sleep(0.005)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    done = len(list((root / ".records" / "train").glob("*.json")))
    assert 0 < done < 40
    assert run(root, Machines(), QUIET) == 40 - done
    assert digest(root) == digest(tmp_path / "whole")
    assert run(root, Machines(), QUIET) == 0
    assert digest(root) == digest(tmp_path / "whole")


def test_shards_hold_every_image_once(tmp_path: Path) -> None:
    data = make(tmp_path / "set", config("randomised", 5), shard=2)
    names = []
    for path in sorted((tmp_path / "set" / "shards").glob("*.tar")):
        with tarfile.open(path) as tar:
            names += tar.getnames()
    kinds = {"rgb.jpg", "depth.png", "camera.json", "gt.json", "gt_info.json", "mask_visib.json"}
    assert sorted(names) == sorted(f"{s:06d}_{i:06d}.{kind}" for s, i in data.images() for kind in kinds)
    assert len(list((tmp_path / "set" / "shards").glob("*.tar"))) == 3


def test_report(tmp_path: Path) -> None:
    make(tmp_path / "set", config("randomised", 6))
    numbers = json.loads((tmp_path / "set" / "statistics.json").read_text())
    assert numbers["images"] == 6 and numbers["instances_by_object"] == {"2": 3, "5": 3}
    assert cv2.imread(str(tmp_path / "set" / "contact_sheet.jpg")).shape[1] > 600


def test_masks_are_dilated_beside(tmp_path: Path) -> None:
    make(tmp_path / "set", config("randomised", 4))
    for path in (tmp_path / "set").rglob("mask_dilated/*.png"):
        grown, mask = cv2.imread(str(path), 0), cv2.imread(str(path).replace("mask_dilated", "mask_visib"), 0)
        assert (grown >= mask).all()


def steps(data: BopDataset) -> list[tuple[float, float]]:
    """Turns (radians) and shifts (metres) of the first object from frame to frame."""
    poses = [data.instances(scene, image, every=True)[0].T_cam_obj for scene, image in data.images()]
    return [pose_error(a, b) for a, b in itertools.pairwise(poses)]


def test_sequences_move_as_they_say(tmp_path: Path) -> None:
    """Still ones not at all, fast ones more than slow ones, jerky ones in bursts; all in scenes of their own."""

    def of(motion: str) -> list[tuple[float, float]]:
        return steps(make(tmp_path / motion, config("sequence", 16, frames=16, size=(64, 48), motion=motion)))

    assert all(turn < 1e-6 and shift < 1e-9 for turn, shift in of("still"))
    slow, smooth, fast, jerky = (np.array(of(m))[:, 0] for m in ("slow", "smooth", "fast", "jerky"))
    assert 0 < slow.max() < smooth.max() < fast.max() < 0.6
    assert 4 * np.abs(np.diff(smooth)).max() < np.abs(np.diff(jerky)).max()
    mixed = make(tmp_path / "mixed", config("sequence", 8, frames=1))
    assert mixed.scenes() == list(range(1, 9))
    told = json.loads((tmp_path / "mixed" / "sequences.json").read_text())
    assert [told[str(n)]["motion"] for n in (1, 2, 7, 8)] == ["still", "slow", "leaving", "still"]


def test_what_leaves_a_sequence_has_no_truth_until_it_is_back(tmp_path: Path) -> None:
    data = make(tmp_path / "set", config("sequence", 20, frames=20, motion="leaving"))
    counts = [len(data.instances(scene, image, every=True)) for scene, image in data.images()]
    assert len(counts) == 20
    assert counts[0] == counts[-1] > 0 and counts[8:13] == [0] * 5
    truths = json.loads((tmp_path / "set" / "train" / "000001" / "scene_gt.json").read_text())
    assert truths["10"] == [] and truths["0"] and not list((tmp_path / "set").rglob("mask/000010_*"))


def test_what_passes_in_a_sequence_hides(tmp_path: Path) -> None:
    data = make(tmp_path / "set", config("sequence", 15, frames=15, motion="hidden"))
    first = min(i.obj_id for i in data.instances(1, 0, every=True))
    seen = [i.visib_fract for n in range(15) for i in data.instances(1, n, every=True) if i.obj_id == first]
    assert min(seen) < 0.6 * max(seen)


def test_fast_sequences_are_blurred(tmp_path: Path) -> None:
    """The same scene at the same moment: what moves has softer edges than what stands still."""
    sharpness = {}
    for motion in ("still", "fast"):
        data = make(tmp_path / motion, config("sequence", 1, frames=1, motion=motion, size=(320, 240)))
        mask = np.any([i.mask() for i in data.instances(1, 0, every=True)], axis=0)
        edges = cv2.Laplacian(cv2.cvtColor(data.view(1, 0).image, cv2.COLOR_RGB2GRAY), cv2.CV_32F, ksize=3)
        sharpness[motion] = float(np.abs(edges[mask]).mean())
    assert sharpness["fast"] < 0.9 * sharpness["still"]


def test_backgrounds(tmp_path: Path) -> None:
    voc = tmp_path / "VOC2012" / "JPEGImages"
    voc.mkdir(parents=True)
    cv2.imwrite(str(voc / "a.png"), np.full((60, 80, 3), (255, 0, 0), np.uint8))
    cv2.imwrite(str(tmp_path / "VOC2012" / "labels.png"), np.zeros((60, 80, 3), np.uint8))
    picture = Backdrops(str(tmp_path / "VOC2012"), 0).draw(np.random.default_rng(0), (32, 24))
    assert picture.shape == (24, 32, 3) and tuple(picture[0, 0]) == (0, 0, 255)
    with pytest.raises(InputError, match="there is no folder of backgrounds"):
        Backdrops(str(tmp_path / "none"), 0)
    with pytest.raises(InputError, match="holds no JPEG"):
        Backdrops(str(tmp_path), 0)


def test_symmetries_are_found(renderer: Renderer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import trimesh

    def plain(mesh: trimesh.Trimesh) -> ObjectModel:
        return ObjectModel.from_arrays(mesh.vertices + [0.1, 0, 0], mesh.faces)

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    cylinder = detect_symmetries(renderer, plain(trimesh.creation.cylinder(0.03, 0.1, sections=256)))
    assert len(cylinder.continuous) == 1 and abs(cylinder.continuous[0].axis[2]) == 1 and cylinder.discrete
    box = detect_symmetries(renderer, plain(trimesh.creation.box((0.1, 0.06, 0.04))))
    assert len(box.discrete) == 3 and not box.continuous
    for _ in range(2):  # found, and read from the cache
        square = detect_symmetries(renderer, plain(trimesh.creation.box((0.06, 0.06, 0.1))))
        assert len(square.discrete) == 7
    for kept in (tmp_path / "posekit" / "symmetries").iterdir():
        kept.write_text("damaged")
    assert len(detect_symmetries(renderer, plain(trimesh.creation.box((0.06, 0.06, 0.1)))).discrete) == 7
    found = detect_symmetries(renderer, bracket())
    assert not found.discrete and not found.continuous
    vertices, faces = cuboid((-0.03, -0.02, -0.05), (0.03, 0.02, 0.05), cells=8)
    colours = np.where(vertices[:, :1] > 0, [[220, 30, 30]], [[30, 30, 220]])
    painted = detect_symmetries(renderer, ObjectModel.from_arrays(vertices, faces, colors=colours))
    assert len(painted.discrete) == 1, "paint takes the turns away that shape alone would have"


# --- command line -----------------------------------------------------------------------------------------------


def synth(*args: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["synth", *map(str, args)])
    return result.exit_code, result.output


@pytest.fixture
def meshes(tmp_path: Path) -> Path:
    write_models(tmp_path, objects())
    return tmp_path / "models"


def test_command_and_resume(tmp_path: Path, meshes: Path) -> None:
    out = tmp_path / "set"
    code, text = synth("--models", meshes, "--out", out, "--images", 4, "--size", "160x120", "--quality", 0)
    assert code == 0, text
    assert "4 images made" in text
    data = BopDataset(out, "train")
    assert data.model_ids() == [2, 5] and data.image_path(2, 0).suffix == ".png"
    code, text = synth("--models", meshes, "--out", out, "--images", 4)
    assert code == 1 and "pass --resume to go on with its data set" in text
    code, text = synth("--out", out, "--resume", "--shards", 3)
    assert code == 0 and "0 images made" in text and len(list((out / "shards").iterdir())) == 2


def test_command_errors(tmp_path: Path, meshes: Path) -> None:
    for args, words in (
        (("--out", tmp_path / "a"), "a data set needs meshes"),
        (("--out", tmp_path / "a", "--resume"), "no data set was begun there"),
        (("--out", tmp_path / "a", "--resume", "--models", meshes), "leave --models out"),
        (("--out", tmp_path / "a", "--models", tmp_path / "x.ply"), "there is no mesh"),
        (("--out", tmp_path / "a", "--models", meshes, "--size", "9"), "give WIDTHxHEIGHT"),
        (("--out", tmp_path / "a", "--models", meshes, "--workers", 0), "at least 1 is needed"),
        (("--out", tmp_path / "a", "--models", meshes, "--quality", 101), "JPEG quality"),
    ):
        code, text = synth(*args)
        assert code == 1 and words in " ".join(text.split()), text
        assert not (tmp_path / "a" / "synth.json").exists()


def test_settings_that_make_no_sense(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="the kind is one of"):
        SynthConfig("other", 1)
    with pytest.raises(ConfigError, match="the motion is mixed or one of still"):
        SynthConfig("sequence", 1, motion="wild")
    with pytest.raises(ConfigError, match="needs objects"):
        begin(config("randomised", 1), tmp_path / "set", {})
    (tmp_path / "synth.json").write_text("{}")
    with pytest.raises(InputError, match="is no configuration of a synthetic data set"):
        SynthConfig.read(tmp_path)
    with pytest.raises(OutputError, match="holds files"):
        begin(config("randomised", 1), tmp_path, objects())


# --- photoreal --------------------------------------------------------------------------------------------------


def test_rooms_are_traced_where_masks_are(tmp_path: Path, renderer: Renderer) -> None:
    """Mitsuba and posekit's renderer see the same surfaces at the same depth; the same seed gives the same pixels."""
    from posekit.synth.photoreal import Photoreal

    what = config("photoreal", 2, size=(64, 48), samples=2, views=2, variant="scalar_rgb")
    data = make(tmp_path / "set", what)
    maker = Photoreal(what, {k: data.model(k) for k in data.model_ids()}, renderer)
    room = maker._room(np.random.default_rng([what.seed, 0, 0]))
    scene = maker.mi.load_dict(room.scene)
    seen = 0
    for image in range(2):
        camera = data.view(1, image).camera
        instances = data.instances(1, image, every=True)
        T_world_obj = {obj_id: pose for obj_id, _, pose in room.objects}
        T_cam_world = instances[0].T_cam_obj @ T_world_obj[instances[0].obj_id].inverse()
        traced = maker._depth(scene, camera, T_cam_world)
        for instance in instances:
            model = data.model(instance.obj_id)
            [drawn] = renderer.render(model, [instance.T_cam_obj], camera)
            inner = cv2.erode(instance.mask().astype(np.uint8), np.ones((3, 3))) > 0
            assert drawn.depth is not None
            np.testing.assert_allclose(traced[inner], drawn.depth[inner], atol=2e-4)
            seen += int(inner.sum())
            assert (
                model.bounds[0] is not None
                and T_world_obj[instance.obj_id].apply(model.hull_vertices)[:, 2].min() > -1e-6
            )
    assert seen > 100
    again = make(tmp_path / "again", what)
    assert digest(again.root) == digest(data.root)
    assert np.ptp(data.view(1, 0).image) > 60


def test_environments_from_files_light_the_rooms(tmp_path: Path) -> None:
    """Under a red sky a picture is redder than under a blue one."""
    redness = []
    for colour in ((0.0, 0.0, 9.0), (9.0, 0.0, 0.0)):
        folder = tmp_path / f"sky{len(redness)}"
        folder.mkdir()
        cv2.imwrite(str(folder / "sky.hdr"), np.full((8, 16, 3), colour, np.float32))  # BGR
        what = config("photoreal", 1, size=(32, 32), samples=4, views=1, variant="scalar_rgb", hdri=str(folder))
        data = make(tmp_path / f"set{len(redness)}", what)
        red, _, blue = data.view(1, 0).image.reshape(-1, 3).mean(axis=0)
        redness.append(red - blue)
    assert redness[0] > redness[1] + 5
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"holds no .exr or .hdr"):
        make(tmp_path / "no", config("photoreal", 1, variant="scalar_rgb", hdri=str(tmp_path / "empty")))


def test_what_photoreal_needs_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    from posekit.synth import photoreal

    with pytest.raises(ConfigError, match=r"--variant nothing: this Mitsuba has .*scalar_rgb"):
        photoreal.load_mitsuba("nothing")
    monkeypatch.setattr(photoreal, "find_llvm", lambda: None)
    with pytest.raises(ConfigError, match="apt-get install libllvm19"):
        photoreal.load_mitsuba("llvm_ad_rgb")
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(ConfigError, match=r"pip install 'posekit\[photoreal\]'"):
        photoreal.load_mitsuba("auto")
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(ConfigError, match=r"pip install 'posekit\[photoreal\]'"):
        photoreal.drop([], np.random.default_rng(0), 0.1)


def test_things_dropped_come_to_rest() -> None:
    from posekit.synth.photoreal import drop

    models = [bracket(), *objects().values()]
    poses = drop(models, np.random.default_rng(1), 0.1)
    lowest = [pose.apply(model.hull_vertices)[:, 2].min() for pose, model in zip(poses, models, strict=True)]
    assert min(lowest) > -1e-6 and min(lowest) < 0.005
    again = drop(models, np.random.default_rng(1), 0.1)
    assert all(np.array_equal(a.matrix, b.matrix) for a, b in zip(poses, again, strict=True))

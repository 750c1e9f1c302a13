"""RBOT's and BCOT's layouts, on samples made here; RBOT's protocol; and sequences made in RBOT's manner."""

from __future__ import annotations

import inspect
import itertools
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from bop_scene import brick
from objects import bracket
from posekit.camera import Camera
from posekit.cli.app import app
from posekit.datasets.bop import BopDataset
from posekit.datasets.registry import open_dataset
from posekit.datasets.sequences import BcotDataset, RbotDataset, followed
from posekit.errors import CameraError, ConfigError, InputError
from posekit.evaluate import rbot
from posekit.evaluate.options import EvalOptions
from posekit.evaluate.stages import ImageStage
from posekit.evaluate.truths import TruthReader
from posekit.geometry import Pose, rotation_angle, so3_exp
from posekit.machines import Machines
from posekit.mesh.model import ObjectModel
from posekit.render import Light, Renderer
from posekit.results import Estimate
from posekit.synth.draw_objects import Placed, draw_objects
from posekit.synth.plan import SynthConfig
from posekit.synth.rbot import SHIFT_STEP, TURN_STEP, quick_path
from posekit.synth.run import begin, run
from posekit.tracking.tracker import LOST, TRACKED, Tracked, Tracker

CAMERA = Camera(200.0, 201.0, 79.0, 61.0, 160, 120)
FRAMES = 4


def poses(z: float = 0.45) -> list[Pose]:
    return [Pose(so3_exp([0.3, 0.04 * k, 0.2]), [0.01 + 0.002 * k, -0.01, z]) for k in range(FRAMES)]


def line(pose: Pose) -> str:
    return "\t".join(f"{v:.6g}" for v in [*pose.R.ravel(), *(1000 * pose.t)])


def write_obj(path: Path, model: ObjectModel) -> None:
    """A mesh in mm."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in 1000 * model.vertices]
    path.write_text("\n".join(rows + [f"f {a} {b} {c}" for a, b, c in model.faces + 1]) + "\n")


def photograph(objects: list[Placed]) -> Image.Image:
    backdrop = np.random.default_rng(1).integers(60, 90, (120, 160, 3)).astype(np.uint8)
    return Image.fromarray(draw_objects(Renderer(), objects, CAMERA, Light(), backdrop).image)


def rbot_sample(root: Path) -> Path:
    """Two objects; the first has a regular and an occluded sequence, the second a regular one."""
    meshes = {"ape": bracket(), "cube": brick()}
    first, second = poses(), [Pose(np.eye(3), [0.01 * k, 0.0, 0.3]) for k in range(FRAMES)]
    for name, model in meshes.items():
        write_obj(root / name / f"{name}.obj", model)
        (root / name / "frames").mkdir()
        for k, pose in enumerate(first):
            photograph([Placed(1, model, pose)]).save(root / name / "frames" / f"a_regular{k:04d}.png")
    write_obj(root / "squirrel_small.obj", brick())
    for k, (pose, other) in enumerate(zip(first, second, strict=True)):
        objects = [Placed(1, meshes["ape"], pose), Placed(2, brick(), other)]
        photograph(objects).save(root / "ape" / "frames" / f"d_occlusion{k:04d}.png")
    header = "r00\tr01\tr02\tr10\tr11\tr12\tr20\tr21\tr22\ttx\tty\ttz\n"
    (root / "poses_first.txt").write_text(header + "".join(line(p) + "\n" for p in first))
    (root / "poses_second.txt").write_text(header + "".join(line(p) + "\n" for p in second))
    (root / "camera_calibration.txt").write_text("# fx\tfy\tcx\tcy\n200.0\t201.0\t79.0\t61.0\n")
    return root


def bcot_sample(root: Path) -> Path:
    write_obj(root / "models" / "Lamp Clamp.obj", bracket())
    write_obj(root / "models" / "Cat.obj", brick())
    for place, name in (("easy_static_trans", "Lamp Clamp"), ("outdoor", "Cat"), ("outdoor", "Lamp Clamp")):
        folder = root / place / name
        folder.mkdir(parents=True)
        (root / place / "K.txt").write_text("200.0 0.0 79.0 0.0 201.0 61.0 0 0 1\n")
        (folder / "pose.txt").write_text("".join(line(p) + "\t\n" for p in poses()))
        (folder / "box.txt").write_text("not read\n")
        for k in range(FRAMES):
            Image.new("RGB", CAMERA.size).save(folder / f"{k:04d}.png")
    return root


# --- the readers ---


def test_rbot_is_known_by_its_files(tmp_path: Path) -> None:
    data, info = open_dataset(None, rbot_sample(tmp_path))
    assert isinstance(data, RbotDataset) and info.name == "rbot"
    assert info.names == {1: "ape", 2: "cube", 3: "squirrel_small"}
    assert data.scenes() == [101, 102, 401]
    assert data.images(401) == [(401, k) for k in range(FRAMES)]
    view = data.view(101, 2)
    assert view.camera.size == (160, 120) and np.allclose(view.camera.K, CAMERA.K)
    [ape] = data.instances(101, 2, every=True)
    assert ape.obj_id == 1 and np.allclose(ape.T_cam_obj.matrix, poses()[2].matrix, atol=1e-5)
    assert data.model(1).diameter == pytest.approx(bracket().diameter, rel=1e-4)
    assert followed(data, 401).variant == "occlusion" and followed(data, 401).obj_id == 1


def test_rbots_second_object_hides_the_first(tmp_path: Path) -> None:
    data = RbotDataset(rbot_sample(tmp_path), "occlusion")
    assert data.scenes() == [401] and data.split == "occlusion"
    assert [i.obj_id for i in data.instances(401, 0)] == [1]
    assert [i.obj_id for i in data.instances(401, 0, every=True)] == [1, 3]
    first, second = TruthReader(data).read(401, 0)
    assert first.visible < 0.9 and second.visible == 1.0


def test_rbots_drawn_frames_lie_where_the_poses_say(tmp_path: Path) -> None:
    """Poses, camera and units are right together: the mesh covers what differs from the background."""
    data = RbotDataset(rbot_sample(tmp_path))
    [truth] = TruthReader(data).read(101, 1)
    image = data.view(101, 1).image.astype(int)
    drawn = (image.max(axis=2) > 95) | (image.min(axis=2) < 55)
    assert (drawn & truth.read_mask()).sum() > 0.8 * truth.read_mask().sum()
    assert (drawn & ~truth.read_mask()).sum() < 0.1 * truth.read_mask().sum()


@pytest.mark.parametrize(
    ("file", "text", "error", "message"),
    [
        ("poses_first.txt", "header\n" + "1 " * 12 + "\n", InputError, "pose 0.*no rotation"),
        ("poses_first.txt", "header\n" + line(Pose.identity()) + "\n", InputError, "1 poses.*frame 3"),
        ("poses_first.txt", "header\n1 2 3\n", InputError, "line 2: '1 2 3' is not 12 numbers"),
        ("poses_first.txt", "header\n", InputError, "no line of 12 numbers"),
        ("camera_calibration.txt", "fx\n0 1 2 3\n", CameraError, "positive"),
    ],
)
def test_damaged_rbot_files_say_what_is_wrong(
    tmp_path: Path, file: str, text: str, error: type[Exception], message: str
) -> None:
    root = rbot_sample(tmp_path)
    (root / file).write_text(text)
    with pytest.raises(error, match=message):
        RbotDataset(root).scenes()


def test_unknown_variants_and_frames_are_refused(tmp_path: Path) -> None:
    root = rbot_sample(tmp_path)
    with pytest.raises(ConfigError, match="no variant 'test'"):
        RbotDataset(root, "test")
    with pytest.raises(InputError, match="no frame 9"):
        RbotDataset(root).view(101, 9)
    with pytest.raises(InputError, match="no sequence 7"):
        RbotDataset(root).images(7)


def test_bcot_is_known_by_its_files(tmp_path: Path) -> None:
    data, info = open_dataset(None, bcot_sample(tmp_path))
    assert isinstance(data, BcotDataset) and info.names == {1: "Cat", 2: "Lamp Clamp"}
    assert data.scenes() == [102, 201, 202]
    assert np.allclose(data.camera(102, 0, (160, 120)).K, CAMERA.K)
    [found] = data.instances(202, 3, every=True)
    assert found.obj_id == 2 and np.allclose(found.T_cam_obj.matrix, poses()[3].matrix, atol=1e-5)
    assert followed(data, 201).variant == "outdoor"
    assert BcotDataset(tmp_path, "outdoor").scenes() == [201, 202]
    with pytest.raises(ConfigError, match="easy_static_trans, outdoor"):
        BcotDataset(tmp_path, "indoor")


def test_bcots_first_line_is_a_pose(tmp_path: Path) -> None:
    """A damaged one is no header: all further poses would be a frame late."""
    root = bcot_sample(tmp_path)
    file = root / "outdoor" / "Cat" / "pose.txt"
    file.write_text("0.1 0.2\n" + file.read_text())
    with pytest.raises(InputError, match="line 1"):
        BcotDataset(root).scenes()
    (root / "outdoor" / "K.txt").write_text("1 2 3\n")
    with pytest.raises(InputError, match="3 numbers"):
        BcotDataset(root).scenes()


# --- the protocol ---


class Scripted:
    """In place of a tracker: the true pose, turned by what ``turns`` (degrees, None for lost) says of a frame after the
    one that it is made in; the turn stays until another tracker is made. frame: is set by the test."""

    turns: ClassVar[dict[int, float | None]] = {}
    frame = 0
    made: ClassVar[list[int]] = []

    def __init__(self, model: ObjectModel, *, pose: Pose, **_: Any) -> None:
        self.off: float | None = 0.0
        self.since = Scripted.frame
        Scripted.made.append(self.since)

    def step(self, image: Any, camera: Camera, valid: Any) -> Tracked:
        if Scripted.frame > self.since:
            self.off = Scripted.turns.get(Scripted.frame, self.off)
        if self.off is None:
            return Tracked(LOST)
        truth = poses()[Scripted.frame]
        pose = Pose(truth.R @ so3_exp([0, 0, np.deg2rad(self.off)]), truth.t)
        return Tracked(TRACKED, Estimate(pose, 0.1, 1, True, 1.0, (0, 0, 1, 1), "ape", timings={"total": 0.1}))


@pytest.fixture
def scripted(monkeypatch: pytest.MonkeyPatch) -> type[Scripted]:
    monkeypatch.setattr(rbot, "Tracker", Scripted)
    Scripted.frame, Scripted.made, Scripted.turns = 0, [], {}
    return Scripted


@pytest.mark.parametrize(
    ("turns", "resets", "right", "made"),
    [
        ({}, True, [True, True, True], [0]),
        ({1: 4.9}, True, [True, True, True], [0]),
        ({1: 5.1}, True, [False, True, True], [0, 1]),  # the reset sets it right in the next frame
        ({1: 5.1}, False, [False, False, False], [0]),
        ({2: None}, True, [True, False, True], [0, 2]),
        ({2: None}, False, [True, False, False], [0]),
    ],
)
def test_a_wrong_frame_counts_once_with_resets(
    tmp_path: Path,
    scripted: type[Scripted],
    turns: dict[int, float | None],
    resets: bool,
    right: list[bool],
    made: list[int],
) -> None:
    scripted.turns = turns

    class Estimator:
        model = bracket()

    data = RbotDataset(rbot_sample(tmp_path), "regular")
    protocol = rbot.RbotProtocol(data, lambda _: Estimator(), "torch", resets)  # type: ignore[arg-type, return-value]
    truths = TruthReader(data)
    judged = []
    for k in range(FRAMES):
        scripted.frame = k
        judged += protocol.step(101, data.view(101, k), truths.read(101, k))
    assert judged[0].given and [j.right for j in judged[1:]] == right
    assert [j.reset for j in judged[1:]] == [resets and not r for r in right]
    assert scripted.made == made


def test_the_summary_is_a_mean_over_sequences(tmp_path: Path) -> None:
    data, info = open_dataset(None, rbot_sample(tmp_path))

    def record(scene: int, image: int, obj_id: int, right: bool) -> dict[str, Any]:
        first = image == 0
        entry = {"obj_id": obj_id, "counted": not first}
        return {
            "scene": scene,
            "image": image,
            "truths": [entry if first else entry | {"right": right, "reset": not right}],
        }

    shares = {101: (1, [True] * 4), 102: (2, [True, False, True, True]), 401: (1, [False] * 2 + [True] * 2)}
    records = [record(s, k, o, r) for s, (o, every) in shares.items() for k, r in enumerate([True, *every])]
    options = EvalOptions("track", protocol="rbot")
    found = rbot.summary(options, data, info, records)
    assert {v: e["right"] for v, e in found["by_variant"].items()} == {"regular": 87.5, "occlusion": 50.0}
    assert found["right"] == 75.0 and found["frames"] == 12 and found["resets"] == 3
    assert [s["first_wrong"] for s in found["by_sequence"]] == [None, 2, 1]
    variants, lines = rbot.rows(found)
    assert variants == ["regular", "occlusion"]
    assert lines == [("1 ape", [100.0, 50.0]), ("2 cube", [75.0, None]), ("mean over sequences", [87.5, 50.0])]


def timed(run_stage: Any) -> Any:
    """`ImageStage.run` that tells the scripted tracker which frame it is."""

    def run(stage: ImageStage, scene: int, image: int) -> Any:
        Scripted.frame = image
        return run_stage(stage, scene, image)

    return run


def test_the_scripted_tracker_is_called_as_the_real_one() -> None:
    names = inspect.signature(Tracker).parameters
    assert {"model", "pose", "estimator", "config", "detector"} <= set(names) and names["detector"].default is None


def test_eval_detects_rbot_and_writes_the_protocol(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scripted: type[Scripted]
) -> None:
    """One frame of each sequence is 20 degrees off; networks are not loaded."""
    monkeypatch.setattr(ImageStage, "_estimator", lambda stage, obj_id: SimpleNamespace(model=stage.data.model(obj_id)))
    monkeypatch.setattr(ImageStage, "run", timed(ImageStage.run))
    scripted.turns = {2: 20.0}
    root = rbot_sample(tmp_path / "RBOT_dataset")
    command = ["eval", "--stage", "track", "--protocol", "rbot", "--root", str(root), "--objects", "ape"]
    done = CliRunner().invoke(app, [*command, "--out", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert results["title"] == "RBOT: track, RBOT's protocol"
    assert results["counts"]["instances"] == 2 * (FRAMES - 1)
    assert list(results["protocol"]["by_variant"]) == ["regular", "occlusion"]
    assert [s["right"] for s in results["protocol"]["by_sequence"]] == [pytest.approx(200 / 3)] * 2
    assert results["protocol"]["resets"] == 2 and results["protocol"]["with_resets"]
    assert results["pooled"]["5deg_5cm"] == pytest.approx(200 / 3)
    assert "RBOT's protocol" in done.output and "within 5 degrees and 5 cm" in done.output
    assert "resets to the true pose" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["--stage", "refine", "--protocol", "rbot"], "--stage track"),
        (["--stage", "track", "--no-resets"], "--protocol rbot"),
    ],
)
def test_the_protocol_belongs_to_tracking(tmp_path: Path, extra: list[str], message: str) -> None:
    done = CliRunner().invoke(app, ["eval", "--root", str(tmp_path), *extra])
    assert done.exit_code == 1 and message in " ".join(done.stderr.split())


# --- made sequences ---


def made(root: Path, variant: str, frames: int = 3, images: int = 0, size: tuple[int, int] = (160, 120)) -> BopDataset:
    count = images or frames
    what = SynthConfig("sequence", count, seed=3, size=size, quality=0, frames=frames, rbot=variant)
    begin(what, root, {2: bracket(), 5: brick()})
    run(root, Machines(), lambda *_: None)
    return BopDataset(root, "train", targets=None)


def test_the_variants_show_the_same_motion(tmp_path: Path) -> None:
    data = made(tmp_path, "all", frames=2, images=16)
    told = json.loads((tmp_path / "sequences.json").read_text())
    assert [told[str(n)]["variant"] for n in (1, 2, 3, 4)] == ["regular", "light", "noise", "occlusion"]
    assert [told[str(n)]["object"] for n in range(1, 9)] == [2] * 4 + [5] * 4

    def main(scene: int, image: int) -> Any:
        return next(i for i in data.instances(scene, image, every=True) if i.obj_id == told[str(scene)]["object"])

    for scene in (2, 3, 4):
        for image in range(2):
            assert np.allclose(main(scene, image).T_cam_obj.matrix, main(1, image).T_cam_obj.matrix)
    assert not np.allclose(main(1, 0).T_cam_obj.matrix, main(5, 0).T_cam_obj.matrix)
    assert sorted(i.obj_id for i in data.instances(4, 0, every=True)) == [2, 5]
    assert followed(data, 4).obj_id == 2 and followed(data, 4).variant == "occlusion"


def test_light_shades_and_noise_covers(tmp_path: Path) -> None:
    data = made(tmp_path, "all", frames=12, images=36)
    frames = {n: data.view(n, 11).image.astype(float) for n in (1, 2, 3)}
    mask = data.instances(1, 11, every=True)[0].mask()
    far = ~cv2.dilate(mask.astype(np.uint8), np.ones((5, 5))).astype(bool)
    assert np.abs(frames[2] - frames[1])[mask].mean() > 3 and (frames[2] == frames[1])[far].all()
    assert 9 < (frames[3] - frames[2])[far].std() < 13  # a little less than 12, where grey levels end


def test_the_second_object_hides_and_passes(tmp_path: Path) -> None:
    data = made(tmp_path, "occlusion", frames=60, size=(96, 72))
    seen = [i.visib_fract for k in range(60) for i in data.instances(1, k, every=True) if i.obj_id == 2]
    assert min(seen) < 0.8 and max(seen) > 0.95 and len(seen) == 60


@pytest.mark.parametrize("seed", [0, 1])
def test_a_path_is_as_quick_as_it_says_and_stays_in_the_picture(seed: int) -> None:
    model, camera = bracket((0.02, 0, 0)), Camera(600, 600, 319.5, 239.5, 640, 480)
    path = quick_path(model, camera, np.random.default_rng(seed))
    found = [path(k / 30) for k in range(1001)]
    turns = [float(rotation_angle(a.R.T @ b.R)) for a, b in itertools.pairwise(found)]
    centres = np.array([p.apply(model.center) for p in found])
    shifts = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    assert np.mean(turns) == pytest.approx(TURN_STEP, rel=0.35)
    assert shifts.mean() == pytest.approx(SHIFT_STEP * model.diameter, rel=0.35)
    pixels = camera.project(centres)
    assert (pixels > 100).all() and (pixels < [540, 380]).all()


def test_rbots_manner_refuses_what_does_not_fit(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="second mesh"):
        begin(SynthConfig("sequence", 3, rbot="all"), tmp_path / "one", {1: brick()})
    assert not (tmp_path / "one").exists()
    with pytest.raises(ConfigError, match="--kind sequence"):
        SynthConfig("scenes", 3, rbot="all")
    with pytest.raises(ConfigError, match="regular, light"):
        SynthConfig("sequence", 3, rbot="wild")

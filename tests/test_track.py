"""Tracking: with an oracle instead of a network what the loop does, with the shipped network the command."""

from __future__ import annotations

import gc
import json
import sys
import tracemalloc
from collections.abc import Sequence
from concurrent.futures import wait
from dataclasses import replace
from pathlib import Path
from threading import Event
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from bop_scene import write_scene
from objects import CAMERA, bracket, cuboid
from posekit.align.colour_edge import Tint, learn, off_colour, outline_lines
from posekit.align.gauss_newton import GaussianPose, Points, fuse
from posekit.camera import Camera
from posekit.cli.app import app
from posekit.errors import CameraError, ConfigError, OutputError
from posekit.estimate.refine import crops
from posekit.geometry import Pose, rotation_angle, so3_exp, view_rotation
from posekit.io.video import VideoFrames, VideoWriter
from posekit.mesh.model import ObjectModel
from posekit.metrics import pose_error
from posekit.render import Renderer
from posekit.results import Detection, Estimate
from posekit.synth.example import Example, ply
from posekit.tracking.appearance import SETTLED
from posekit.tracking.memory import MOST, Memory
from posekit.tracking.points import Keyframe, follow_points, match_texture
from posekit.tracking.tracker import LOST, TRACKED, UNCERTAIN, TrackConfig, Tracker
from posekit.view import View
from posekit.visualise.recording import Recorder
from test_refine import Oracle

STEADY = TrackConfig()


@pytest.fixture(scope="module")
def model() -> ObjectModel:
    return bracket()


def path(model: ObjectModel, k: float) -> Pose:
    """Two degrees and 3 mm a frame about the centre."""
    R = so3_exp([0.0, 0.035 * k, 0.01 * k]) @ view_rotation([0.5, -1.0, 0.6])
    return Pose(R, [0.003 * k - 0.05, 0.0, 0.6]) @ model.T_ctr_obj


def backdrop() -> np.ndarray:
    return np.random.default_rng(1).integers(90, 160, (480, 640, 3)).astype(np.uint8)


def photograph(renderer: Renderer, model: ObjectModel, pose: Pose | None) -> View:
    image, mask = backdrop(), np.zeros((480, 640), bool)
    if pose is not None:
        [drawn] = renderer.render(model, [pose], CAMERA)
        assert drawn.mask is not None
        mask, image = drawn.mask, np.where(drawn.mask[..., None], drawn.image, image)
    return View(image, CAMERA, mask)


class Estimator:
    """Stands for a PoseEstimator: its first pose is ``found``."""

    def __init__(self, model: ObjectModel, renderer: Renderer, found: Pose | None = None, score: float = 0.9) -> None:
        self.model, self.renderer, self.found, self.score = model, renderer, found, score

    def estimate(self, view: View, detections: Sequence[Detection], min_score: float = 0.0) -> list[Estimate]:
        if self.found is None:
            return []
        return [Estimate(self.found, 0.1, 3, True, self.score, d.box, self.model.name, d) for d in detections]


class Finder:
    def __init__(self) -> None:
        self.calls = 0

    def detect(self, view: View, models: Sequence[ObjectModel]) -> list[Detection]:
        self.calls += 1
        return [Detection((10.0, 10.0, 50.0, 50.0))]


def tracker(model: ObjectModel, renderer: Renderer, truth: Pose, config: TrackConfig = STEADY, **more) -> Tracker:  # type: ignore[no-untyped-def]
    more.setdefault("estimator", Estimator(model, renderer))
    return Tracker(model, CAMERA, predictor=Oracle(model, truth), config=config, **more)


@pytest.mark.parametrize("motion", ["points", "velocity", "none"])
def test_an_oracle_is_followed(model: ObjectModel, renderer: Renderer, motion: str) -> None:
    following = tracker(model, renderer, path(model, 0), replace(STEADY, motion=motion), pose=path(model, 0))
    for k in range(6):
        following.predictor.truth = path(model, k)  # type: ignore[attr-defined]
        found = following.step(photograph(renderer, model, path(model, k)).image)
        assert found.state == TRACKED and found.T_cam_obj is not None and found.estimate is not None
        turn, shift = pose_error(found.T_cam_obj, path(model, k))
        assert np.rad2deg(turn) < 0.4 and shift < 2.5e-3, "two degrees and 3 mm a frame"
        assert found.estimate.score > 0.8 and set(found.estimate.timings) == {"network", "total"}


def looked(view: View, model: ObjectModel, renderer: Renderer, pose: Pose) -> Keyframe:
    [seen], [drawn] = crops(view, model, model.hull_ctr, [pose], (160, 120), renderer)
    T_view_ctr = Pose.rotation(seen.R_view_cam) @ pose @ model.T_obj_ctr
    return Keyframe(seen, drawn, T_view_ctr, np.ones((120, 160), bool))


def test_followed_points_alone_carry_a_pose(model: ObjectModel, renderer: Renderer) -> None:
    before, after = (photograph(renderer, model, path(model, k)) for k in (0, 1))
    at = looked(before, model, renderer, path(model, 0))
    # what was drawn lies beside the pose that is believed: the points are the believed pose's
    for drawn in (at, looked(before, model, renderer, path(model, 0.3))):
        start = Pose.rotation(drawn.seen.R_view_cam) @ path(model, 0) @ model.T_obj_ctr
        points = follow_points(drawn, start, drawn.again(after), model)
        assert points is not None and len(points.points) > 20
        found = fuse(start, [GaussianPose.about(start, drawn.drawn.camera, 1.0, 50.0, 0.5), points], drawn.drawn.camera)
        assert found is not None
        pose = Pose.rotation(drawn.seen.R_view_cam.T) @ found.pose @ model.T_ctr_obj
        still, moved = pose_error(path(model, 0), path(model, 1)), pose_error(pose, path(model, 1))
        assert moved[0] < 0.35 * still[0] and moved[1] < 0.35 * still[1]
    flat = View(np.full_like(after.image, 128), CAMERA)
    empty = looked(flat, model, renderer, path(model, 0))
    assert follow_points(empty, empty.T_view_ctr, empty.again(flat), model) is None


def parcel() -> ObjectModel:
    """A box of many colours."""
    vertices, faces = cuboid((-0.06, -0.04, -0.03), (0.06, 0.04, 0.03), 9)
    colours = np.random.default_rng(5).integers(20, 235, (len(vertices), 3)).astype(np.uint8)
    return ObjectModel.from_arrays(vertices, faces, name="parcel", colors=colours)


def test_texture_leads_from_the_drawn_mesh_to_the_frame(renderer: Renderer) -> None:
    model = parcel()
    view = photograph(renderer, model, path(model, 0))
    darker = View((0.5 * view.image.astype(np.float32) + 20).astype(np.uint8), CAMERA)
    for shown in (view, darker):
        at = looked(shown, model, renderer, path(model, 0.6))
        points = match_texture(at, model)
        assert points is not None
        prior = GaussianPose.about(at.T_view_ctr, at.drawn.camera, 0.2, 10.0, 0.1)
        found = fuse(at.T_view_ctr, [prior, points], at.drawn.camera)
        assert found is not None
        pose = Pose.rotation(at.seen.R_view_cam.T) @ found.pose @ model.T_ctr_obj
        before, after = (pose_error(p, path(model, 0)) for p in (path(model, 0.6), pose))
        assert after[0] < 0.2 * before[0] and after[1] < 0.7 * before[1]
    noise = np.random.default_rng(2).integers(0, 255, (480, 640, 3)).astype(np.uint8)
    assert match_texture(looked(View(noise, CAMERA), model, renderer, path(model, 0)), model) is None


def test_hidden_points_are_not_followed(model: ObjectModel, renderer: Renderer) -> None:
    view = photograph(renderer, model, path(model, 0))
    at = looked(view, model, renderer, path(model, 0))
    left = np.arange(160) < 80
    half = replace(at, visible=np.broadcast_to(left, (120, 160)))
    points = follow_points(half, at.T_view_ctr, at.seen, model)
    assert points is not None and (points.pixels[:, 0] < 81).all()


@pytest.mark.parametrize("off", [0.0, 0.6])
def test_an_outline_is_found_by_its_colours(model: ObjectModel, renderer: Renderer, off: float) -> None:
    """Colours are learned at the true pose; the outline, drawn beside it, is then pulled back."""
    view = photograph(renderer, model, path(model, 0))
    at = looked(view, model, renderer, path(model, 0))
    assert at.drawn.mask is not None
    colours = learn(at.seen, at.drawn.mask, at.visible)
    assert (colours.seen(at.seen) == at.drawn.mask).mean() > 0.9
    beside = looked(view, model, renderer, path(model, off))
    lines = outline_lines(beside.seen, beside.drawn, colours, colours.seen(beside.seen), model.center)
    assert lines is not None and len(lines.points) > 60
    np.testing.assert_allclose(np.linalg.norm(lines.normals, axis=1), 1, atol=1e-5)
    prior = GaussianPose.about(beside.T_view_ctr, beside.drawn.camera, 0.2, 10.0, 0.1)
    found = fuse(beside.T_view_ctr, [prior, lines], beside.drawn.camera)
    assert found is not None
    pose = Pose.rotation(beside.seen.R_view_cam.T) @ found.pose @ model.T_ctr_obj
    turn, shift = pose_error(pose, path(model, 0))
    assert np.rad2deg(turn) < 0.7 and shift < 0.002


def test_blurred_edges_do_not_move_the_outline(model: ObjectModel, renderer: Renderer) -> None:
    """Pixels that mix two colours are like neither, and more like one of them by chance: here the object's, whose rim
    teaches them, while its surroundings have many colours."""
    view = photograph(renderer, model, path(model, 0))
    blocks = np.random.default_rng(3).integers(0, 255, (60, 80, 3)).astype(np.uint8)
    many = cv2.resize(blocks, (640, 480), interpolation=cv2.INTER_NEAREST)
    image = np.where(view.mask[..., None], np.uint8([230, 60, 50]), many)
    blurred = View(cv2.GaussianBlur(image, (0, 0), 2.0), CAMERA)
    at = looked(blurred, model, renderer, path(model, 0))
    assert at.drawn.mask is not None
    colours = learn(at.seen, at.drawn.mask, at.visible)
    lines = outline_lines(at.seen, at.drawn, colours, colours.seen(at.seen), model.center)
    assert lines is not None
    there = at.drawn.camera.project(at.T_view_ctr.apply(lines.points))
    off = np.einsum("ni,ni->n", lines.places - there, lines.normals)
    assert abs(np.median(off)) < 0.35, "pixels of the crop"


def test_an_outline_is_not_sought_where_the_object_is_hidden(model: ObjectModel, renderer: Renderer) -> None:
    view = photograph(renderer, model, path(model, 0))
    at = looked(view, model, renderer, path(model, 0))
    assert at.drawn.mask is not None
    colours = learn(at.seen, at.drawn.mask, at.visible)
    seen = colours.seen(at.seen) & (np.arange(160) < 80)
    lines = outline_lines(at.seen, at.drawn, colours, seen, model.center)
    assert lines is not None and (lines.places[:, 0] < 83).all()
    assert outline_lines(at.seen, at.drawn, colours, np.zeros_like(seen), model.center) is None


def test_what_is_suddenly_of_another_colour_hides_the_object(model: ObjectModel, renderer: Renderer) -> None:
    view = photograph(renderer, model, path(model, 0))
    warmer = View((view.image * np.array([1.0, 0.9, 0.75])).astype(np.uint8), CAMERA)
    at = looked(warmer, model, renderer, path(model, 0))
    assert at.drawn.mask is not None
    tint = Tint.of(off_colour(at.seen, at.drawn), at.drawn.mask)
    assert not tint.hides(off_colour(at.seen, at.drawn), at.drawn.mask).any(), (
        "another light than the mesh's, as it was"
    )
    image = at.seen.image.copy()
    image[40:80, 70:100] = (200, 30, 220)
    patch = np.zeros_like(at.visible)
    patch[40:80, 70:100] = True
    hidden = tint.hides(off_colour(replace(at.seen, image=image), at.drawn), at.drawn.mask)
    covered = patch & at.drawn.mask
    assert covered.sum() > 300 and (hidden & covered).sum() > 0.85 * covered.sum()
    assert (hidden & ~patch).sum() < 0.25 * covered.sum(), "the edge is blurred"
    lines = outline_lines(at.seen, at.drawn, learn(at.seen, at.drawn.mask, at.visible), ~hidden, model.center)
    assert lines is not None and not patch[tuple(np.rint(lines.places[:, ::-1]).astype(int).T)].any()


def test_beliefs_are_weighed_by_their_information() -> None:
    camera = Camera(200.0, 200.0, 79.5, 59.5, 160, 120)
    a, b = Pose(np.eye(3), [0.0, 0.0, 1.0]), Pose(so3_exp([0.0, 0.02, 0.0]), [0.03, 0.0, 1.0])
    firm, loose = (GaussianPose.about(pose, camera, turn, 2.0, 0.05) for pose, turn in ((a, 0.01), (b, 0.02)))
    found = fuse(a, [firm, loose], camera)
    assert found is not None
    assert rotation_angle(found.pose.R) == pytest.approx(0.02 / 5, rel=1e-3)  # information 4 to 1
    assert found.pose.t[0] == pytest.approx(0.015)
    assert found.turn_std == pytest.approx(np.sqrt(3 / (1 / 0.01**2 + 1 / 0.02**2)))
    wider = firm.spread(firm.covariance)
    np.testing.assert_allclose(wider.covariance, 2 * firm.covariance)
    R = so3_exp([0.3, -0.2, 0.5])
    turned = firm.turned(R)
    assert turned.turn_std == pytest.approx(firm.turn_std)
    np.testing.assert_allclose(turned.turned(R.T).information, firm.information, atol=1e-6)


def test_outliers_lose_their_weight() -> None:
    camera = Camera(200.0, 200.0, 79.5, 59.5, 160, 120)
    rng = np.random.default_rng(0)
    points, truth = rng.uniform(-0.1, 0.1, (60, 3)), Pose(so3_exp([0.1, -0.05, 0.2]), [0.02, -0.01, 0.6])
    pixels = camera.project(truth.apply(points))
    pixels[:15] += rng.uniform(10, 30, (15, 2))
    start = Pose(np.eye(3), [0.0, 0.0, 0.62])
    terms = [GaussianPose.about(start, camera, 1.0, 50.0, 1.0), Points(points, pixels, np.ones(60), np.full(60, 0.3))]
    found = fuse(start, terms, camera, steps=20)
    assert found is not None
    turn, shift = pose_error(found.pose, truth)
    assert np.rad2deg(turn) < 0.3 and shift < 0.002


def test_a_small_predicted_angle_leaves_the_pose_where_asked(model: ObjectModel, renderer: Renderer) -> None:
    """With the picture still, only the network could move it."""
    turns = []
    for still in (0.0, 5.0):
        config = TrackConfig(still_deg=still, outline=False, texture=False)
        following = tracker(model, renderer, path(model, 1), config, pose=path(model, 0))
        for _ in range(4):
            found = following.step(photograph(renderer, model, path(model, 0)).image)
        assert found.T_cam_obj is not None
        turns.append(np.rad2deg(pose_error(found.T_cam_obj, path(model, 0))[0]))
    assert turns[0] > 0.3 and turns[1] < 0.1


def test_a_large_turn_is_compared_again(model: ObjectModel, renderer: Renderer) -> None:
    for iterations, calls in ((1, 1), (3, 2)):
        config = TrackConfig(motion="none", outline=False, texture=False, iterations=iterations, again_deg=0.5)
        following = tracker(model, renderer, path(model, 6), config, pose=path(model, 0))
        following.step(photograph(renderer, model, path(model, 0)).image)
        before = following.predictor.calls  # type: ignore[attr-defined]
        following.step(photograph(renderer, model, path(model, 6)).image)
        assert following.predictor.calls - before == calls  # type: ignore[attr-defined]


@pytest.mark.parametrize("clear", [True, False])
def test_a_large_predicted_angle_restarts_where_the_outline_is_no_evidence(
    clear: bool, model: ObjectModel, renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not clear:
        monkeypatch.setattr("posekit.tracking.tracker.contrast", lambda *_: 0.1)
    truth, finder = path(model, 0), Finder()
    following = tracker(
        model, renderer, truth, pose=truth, estimator=Estimator(model, renderer, truth), detector=finder
    )
    image = photograph(renderer, model, truth).image
    following.predictor.angles = [0.6]  # type: ignore[attr-defined]  # above 25 degrees
    states = [following.step(image).state for _ in range(3)]
    doubtful = TRACKED if clear else UNCERTAIN
    assert states == [TRACKED, doubtful, doubtful], "the first pose is given; one frame in doubt is no loss"
    found = following.step(image)
    if clear:
        assert found.state == TRACKED and finder.calls == 0
        return
    assert found.state == TRACKED and found.restarted and finder.calls == 1
    following.predictor.angles = [0.01]  # type: ignore[attr-defined]
    assert following.step(photograph(renderer, model, truth).image).state == TRACKED


def test_quick_motion_is_followed_by_the_outline_alone(model: ObjectModel, renderer: Renderer) -> None:
    """A mesh without colours, a network that says nothing, 19 pixels and 4 degrees a frame."""
    plain = replace(model, colors=None, uvs=None, texture=None)
    start = path(model, 0)

    def place(k: int) -> Pose:
        return Pose(so3_exp([0.0, 0.07 * k, 0.0]) @ start.R, start.t + [0.02 * k, 0.0, 0.0])

    ends = {}
    for scales in ((4, 2, 1), ()):
        config = TrackConfig(scales=scales, motion="none", still_deg=24.9)
        following = tracker(plain, renderer, start, config, pose=start)
        for k in range(5):
            found = following.step(photograph(renderer, model, place(k)).image)
        ends[scales] = pose_error([found.T_cam_obj], [place(4)])[1][0] if found.T_cam_obj is not None else np.inf
    assert ends[4, 2, 1] < 0.01 < ends[()]


def test_what_disappears_is_lost_soon_and_found_again(model: ObjectModel, renderer: Renderer) -> None:
    truth, finder = path(model, 0), Finder()
    estimator = Estimator(model, renderer)
    following = tracker(model, renderer, truth, pose=truth, estimator=estimator, detector=finder)
    there, gone = (photograph(renderer, model, pose).image for pose in (truth, None))
    assert following.step(there).state == TRACKED
    results = [following.step(gone) for _ in range(12)]
    assert [r.state for r in results] == [UNCERTAIN] * 2 + [LOST] * 10
    assert not any(r.reliable for r in results) and all((r.T_cam_obj is None) == (r.state == LOST) for r in results)
    assert finder.calls == 2, "not every frame is searched"
    estimator.found, estimator.score = truth, 0.1
    assert {following.step(there).state for _ in range(6)} == {LOST}, "a bad first pose is not taken"
    estimator.score = 0.9
    results = [following.step(there) for _ in range(6)]
    assert sum(r.restarted for r in results) == 1 and results[-1].state == TRACKED and not results[-1].restarted


def test_what_leaves_the_picture_is_lost(model: ObjectModel, renderer: Renderer) -> None:
    leaving = [Pose(path(model, 0).R, [0.2 + 0.02 * k, 0.0, 0.6]) for k in range(25)]
    following = tracker(model, renderer, leaving[0], pose=leaving[0])
    states = []
    for pose in leaving:
        following.predictor.truth = pose  # type: ignore[attr-defined]
        states.append(following.step(photograph(renderer, model, pose).image).state)
    assert states[:5] == [TRACKED] * 5 and states[-5:] == [LOST] * 5, "nobody searches"
    assert [s for s in states if s != LOST] + [LOST] * states.count(LOST) == states, "it does not come back"
    outside = tracker(model, renderer, leaving[-1], pose=leaving[-1])
    assert outside.step(backdrop()).state == LOST, "the first pose shows nothing of it"


def test_the_mask_is_the_coloured_part_the_poses_or_none(model: ObjectModel, renderer: Renderer) -> None:
    seen = []
    for mask in ("pose", "none", "colours"):
        following = tracker(model, renderer, path(model, 0), replace(STEADY, mask=mask), pose=path(model, 0))
        following.step(photograph(renderer, model, path(model, 0)).image)
        answer = following.predictor.predict
        following.predictor.predict = lambda o, r, answer=answer: seen.append((o[0].mask, r[0].mask)) or answer(o, r)  # type: ignore
        covered = photograph(renderer, model, path(model, 0)).image.copy()
        covered[:240] = backdrop()[:240]
        following.step(covered)
    np.testing.assert_array_equal(*seen[0])
    assert seen[1][0] is None
    part, whole = seen[2]
    assert 0.2 < part.sum() / whole.sum() < 0.8 and not (part & ~whole).any()


def test_memory_does_not_grow(model: ObjectModel, renderer: Renderer) -> None:
    """After 20 frames less than 1 kB a frame, or 10 MB in 10,000 frames."""
    frames = [photograph(renderer, model, path(model, k)).image for k in (0, 1)]
    following = tracker(model, renderer, path(model, 0), pose=path(model, 0))
    sizes = []
    tracemalloc.start()
    try:
        for k in range(80):
            following.predictor.truth = path(model, k % 2)  # type: ignore[attr-defined]
            assert following.step(frames[k % 2]).state == TRACKED
            if k in (19, 79):
                gc.collect()
                sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert (sizes[1] - sizes[0]) / 60 < 1000


def test_what_cannot_be_tracked_is_said(model: ObjectModel, renderer: Renderer) -> None:
    with pytest.raises(ConfigError, match="first pose, or a detector"):
        Tracker(model, CAMERA, estimator=SimpleNamespace())  # type: ignore[arg-type]
    following = Tracker(
        model,
        pose=path(model, 0),
        estimator=Estimator(model, renderer),
        predictor=Oracle(model, path(model, 0)),  # type: ignore[arg-type]
    )
    with pytest.raises(CameraError, match="without a camera"):
        following.step(backdrop())
    for wrong in (
        {"still_deg": 30},
        {"iterations": 0},
        {"min_colour_share": 2},
        {"keep": 0},
        {"mask": "true"},
        {"motion": "x"},
        {"runtime": "x"},
    ):
        with pytest.raises(ConfigError):
            TrackConfig(**wrong)


# --- the command ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(example: Example, renderer: Renderer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A video in which the example's camera turns a little, its mesh and its first pose."""
    folder = tmp_path_factory.mktemp("track")
    (folder / "toy.ply").write_text(ply(example.model))
    (folder / "pose.json").write_text(json.dumps({"T_cam_obj": example.T_cam_obj.matrix.tolist()}))
    with VideoWriter(folder / "toy.mp4", 30.0) as writer:
        for k in range(5):
            writer.write(np.roll(example.view.image, 2 * k, axis=1))
    return folder


def run(folder: Path, *flags: object, source: str = "toy.mp4", cache: Path | None = None):  # type: ignore[no-untyped-def]
    camera = make_camera_flag(folder)
    arguments = ["track", str(folder / source), "-m", str(folder / "toy.ply"), *camera, *map(str, flags)]
    return CliRunner().invoke(app, arguments)


def make_camera_flag(folder: Path) -> list[str]:
    return ["--camera", (folder / "camera.txt").read_text()] if (folder / "camera.txt").exists() else []


def test_a_video_becomes_poses_and_an_overlay(
    example: Example, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    c = example.view.camera
    (folder / "camera.txt").write_text(f"{c.fx},{c.fy},{c.cx},{c.cy}")
    done = run(folder, "--pose", folder / "pose.json", "--out", tmp_path / "out", "--still-angle", 0, "--rerun")
    assert done.exit_code == 0, done.output
    assert "5 tracked" in done.stdout
    lines = [json.loads(line) for line in (tmp_path / "out" / "poses.jsonl").read_text().splitlines()]
    assert [line["frame"] for line in lines] == list(range(5))
    assert all(line["state"] == "tracked" and 0 <= line["angle_deg"] < 25 for line in lines)
    first = Pose.from_matrix(lines[0]["T_cam_obj"])
    turn, shift = pose_error(first, example.T_cam_obj)
    assert np.rad2deg(turn) < 10 and shift < 0.05
    moved = c.project(Pose.from_matrix(lines[4]["T_cam_obj"]).t) - c.project(first.t)
    assert abs(moved[0] - 8) < 3 and abs(moved[1]) < 3, "8 pixels to the right"
    rows = (tmp_path / "out" / "poses.csv").read_text().splitlines()
    assert rows[0] == "scene_id,im_id,obj_id,score,R,t,time" and len(rows) == 6
    assert float(rows[1].split(",")[5].split()[2]) == pytest.approx(1000 * first.t[2])
    assert len(list(VideoFrames(tmp_path / "out" / "overlay.mp4", None))) == 5
    recorded = (tmp_path / "out" / "track.rrd").read_bytes()
    assert recorded[:3] == b"RRF" and b"objects/0-toy" in recorded and b"camera/image" in recorded
    assert not list((tmp_path / "out").glob(".*"))
    again = run(folder, "--pose", folder / "pose.json", "--out", tmp_path / "out")
    assert again.exit_code == 1 and "--force" in again.stderr


def test_a_recording_without_rerun_says_what_to_install(model: ObjectModel, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(OutputError, match="posekit\\[rerun\\]"):
        Recorder(Path("a.rrd"), [model])


def test_a_box_gives_the_first_frame(folder: Path, tmp_path: Path, example: Example) -> None:
    box = ",".join(f"{v:.0f}" for v in example.box)
    result = run(
        folder, *make_camera_flag(folder), "--box", box, "--frames", 1, "--no-overlay", "--out", tmp_path / "a"
    )
    [line] = (tmp_path / "a" / "poses.jsonl").read_text().splitlines()
    entry = json.loads(line)
    assert (entry["state"], entry["restarted"]) == (TRACKED, True), result.output
    both = run(folder, "--box", box, "--pose", folder / "pose.json", "--out", tmp_path / "b")
    assert both.exit_code == 1 and "pass --pose for several" in both.stderr


def test_nothing_to_track_is_an_error(folder: Path, tmp_path: Path) -> None:
    (folder / "damaged").mkdir(exist_ok=True)
    (folder / "damaged" / "0.png").write_bytes(b"no picture")
    flags = ("--pose", folder / "pose.json", "--runtime", "torch")
    result = run(folder, *flags, "--out", tmp_path / "a", source="damaged")
    assert result.exit_code == 1 and "not one frame" in result.stderr
    [line] = (tmp_path / "a" / "poses.jsonl").read_text().splitlines()
    assert json.loads(line)["state"] == "lost" and "problem" in json.loads(line)
    result = run(folder, *flags, "--pose", folder / "pose.json", "--out", tmp_path / "b")
    assert result.exit_code == 1 and "2 --pose for 1 --model" in result.stderr
    result = run(folder, *flags, "--out", tmp_path / "c", source="none.mp4")
    assert result.exit_code == 1 and "there is no" in result.stderr


# --- eval --stage track ---------------------------------------------------------------------------------------------


def still_scene(root: Path) -> Path:
    """The first picture of a small scene five times over."""
    write_scene(root, images=1)
    folder = root / "test" / "000002"
    for name in ("scene_gt", "scene_gt_info", "scene_camera"):
        entries = json.loads((folder / f"{name}.json").read_text())
        (folder / f"{name}.json").write_text(json.dumps({str(k): entries["0"] for k in range(5)}))
    for file in [*folder.glob("*/000000.png"), *folder.glob("*/000000_*.png")]:
        for k in range(1, 5):
            (file.parent / file.name.replace("000000", f"{k:06d}", 1)).write_bytes(file.read_bytes())
    return root


def test_eval_follows_a_sequence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    root = still_scene(tmp_path / "still")
    command = ["eval", "--stage", "track", "--root", str(root), "--min-visible", "0.5", "--out", str(tmp_path / "out")]
    assert CliRunner().invoke(app, command).exit_code == 0
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert results["stage"] == "track" and results["counts"]["instances"] == 10
    states = [i["state"] for i in results["instances"] if i["found"]]
    assert len(states) >= 5 and set(states) <= {"tracked", "uncertain"}
    done = CliRunner().invoke(app, [*command[:-1], str(tmp_path / "b"), "--images", "3"])
    assert done.exit_code == 1 and "whole sequences" in done.stderr


# --- finding it again -----------------------------------------------------------------------------------------------


def test_what_was_seen_finds_it_again_without_a_detector(renderer: Renderer) -> None:
    """It comes back elsewhere; nobody has a detector, and the network says nothing there."""
    model = parcel()
    start = path(model, 0)
    following = tracker(model, renderer, start, pose=start)
    for k in range(4):
        following.predictor.truth = path(model, k)  # type: ignore[attr-defined]
        assert following.step(photograph(renderer, model, path(model, k)).image).state == TRACKED
    gone = photograph(renderer, model, None).image
    states = [following.step(gone).state for _ in range(9)]
    assert states[-1] == LOST
    back = Pose(path(model, 3).R, path(model, 3).t + [0.09, -0.03, 0.0])
    following.predictor.truth = back  # type: ignore[attr-defined]
    image = photograph(renderer, model, back).image
    results = [following.step(image) for _ in range(6)]
    assert sum(r.restarted for r in results) == 1 and results[-1].state == TRACKED
    assert results[-1].T_cam_obj is not None
    turn, shift = pose_error(results[-1].T_cam_obj, back)
    assert np.rad2deg(turn) < 5 and shift < 0.02


def test_memory_is_bounded_and_spread(renderer: Renderer) -> None:
    model = parcel()
    memory = Memory(model, renderer)
    for k in range(60):
        turn = so3_exp([0.0, 0.3 * k, 0.0]) @ so3_exp([0.3 * (k % 5), 0.0, 0.0])
        pose = Pose(turn, [0.0, 0.0, 0.6]) @ model.T_ctr_obj
        view = photograph(renderer, model, pose)
        at = looked(view, model, renderer, pose)
        if memory.wants(at.T_view_ctr):
            memory.keep(view, at, at.T_view_ctr)
            assert not memory.wants(at.T_view_ctr)
    assert 10 < len(memory.views) <= MOST
    hidden = replace(at, visible=np.zeros((120, 160), bool))
    before = len(memory.views)
    memory.keep(view, hidden, at.T_view_ctr)
    assert len(memory.views) == before, "nothing is seen of it"


def test_kept_views_lead_to_the_pose(renderer: Renderer) -> None:
    model = parcel()
    memory, first, there = Memory(model, renderer), path(model, 0), path(model, 5)
    view = photograph(renderer, model, first)
    at = looked(view, model, renderer, first)
    assert at.drawn.mask is not None
    colours = learn(at.seen, at.drawn.mask, at.visible)
    assert memory.by_features(view) == [] and memory.by_colours(view, colours, first @ model.T_obj_ctr, 3) == []
    memory.keep(view, at, at.T_view_ctr)
    moved = photograph(renderer, model, there)
    [found, *_] = memory.by_features(moved)
    turn, shift = pose_error(found, there)
    assert np.rad2deg(turn) < 3 and shift < 0.01
    best, *_ = memory.by_colours(moved, colours, first @ model.T_obj_ctr, 3)
    offset = CAMERA.project(best.apply(model.center)) - CAMERA.project(there.apply(model.center))
    assert np.linalg.norm(offset) < 12, "pixels"


class SlowEstimator(Estimator):
    """Waits until it is told to go on."""

    def __init__(self, *arguments) -> None:  # type: ignore[no-untyped-def]
        super().__init__(*arguments)
        self.may_go = Event()

    def estimate(self, view: View, detections: Sequence[Detection], min_score: float = 0.0) -> list[Estimate]:
        assert self.may_go.wait(20)
        return super().estimate(view, detections, min_score)


def test_a_search_beside_the_loop_holds_no_frame_up(model: ObjectModel, renderer: Renderer) -> None:
    """The pose that it finds is of an old frame, and is brought to the newest."""
    old, new = path(model, 0), path(model, 3)
    estimator = SlowEstimator(model, renderer, old)
    config = replace(STEADY, search_beside=True, search_share=1.0)
    following = tracker(model, renderer, new, config, detector=Finder(), estimator=estimator)
    assert following.step(photograph(renderer, model, old).image).state == LOST
    image = photograph(renderer, model, new).image
    assert {following.step(image).state for _ in range(5)} == {LOST}, "the search waits, the loop does not"
    estimator.may_go.set()
    wait([following._searching])  # type: ignore[list-item]
    found = following.step(image)
    assert found.state == TRACKED and found.restarted and found.T_cam_obj is not None
    turn, shift = pose_error(found.T_cam_obj, new)
    assert np.rad2deg(turn) < 3 and shift < 0.01
    assert following.step(image).state == TRACKED


def test_what_was_found_too_long_ago_is_dropped(model: ObjectModel, renderer: Renderer) -> None:
    config = replace(STEADY, search_beside=True, search_age=1e-6)
    following = tracker(
        model, renderer, path(model, 0), config, detector=Finder(), estimator=Estimator(model, renderer, path(model, 0))
    )
    image = photograph(renderer, model, path(model, 0)).image
    following.step(image)
    wait([following._searching])  # type: ignore[list-item]
    assert following.step(image).state == LOST
    for wrong in ({"search_share": 0}, {"search_age": 0}):
        with pytest.raises(ConfigError):
            TrackConfig(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("colours", ["own", "none", "grey"])
def test_what_is_in_front_is_told_by_the_colours_that_the_video_shows(renderer: Renderer, colours: str) -> None:
    coloured = parcel()
    assert coloured.colors is not None
    given = {"own": coloured.colors, "none": None, "grey": np.full_like(coloured.colors, 200)}[colours]
    model, still = replace(coloured, colors=given), path(coloured, 0)
    following = tracker(model, renderer, still, STEADY, pose=still)
    photo = photograph(renderer, coloured, still)
    for _ in range(SETTLED + 2):
        assert following.step(photo.image).state == TRACKED
    assert (following._appearance is None) == (colours == "own")
    columns = np.nonzero(renderer.render(coloured, [still], photo.camera, coords=False)[0].mask)[1]
    image = photo.image.copy()
    image[:, int(np.quantile(columns, 0.7)) : columns.max() + 1] = (30, 200, 60)
    following.step(image)
    before = following._before
    assert before is not None and before.drawn.mask is not None
    green = (before.seen.image.astype(int) - (30, 200, 60) == 0).all(2) & before.drawn.mask
    assert green.mean() > 0.01 and before.visible[green].mean() < 0.3
    assert before.visible[before.drawn.mask & ~green].mean() > 0.7

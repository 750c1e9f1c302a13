"""The page to look with: cameras, files, what its controls do, and the page itself in a browser where there is one."""

from __future__ import annotations

import asyncio
import json
import math
import shutil
import socket
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from objects import bracket
from posekit.camera import Camera
from posekit.cli.app import app
from posekit.errors import ConfigError, ImageError, OutputError, PosekitError, PromptError
from posekit.geometry import Pose, quat_to_rotation, random_rotation, rotation_angle, so3_exp
from posekit.io.calibration import calibration_of_entry
from posekit.io.load import load_pose
from posekit.io.video import Frame
from posekit.mesh.export import to_glb
from posekit.mesh.model import ObjectModel
from posekit.render import Renderer
from posekit.results import Estimate, Step, estimates_to_json
from posekit.view import View
from posekit.viewer import (
    HAND,
    KEPT,
    REFINED,
    Photograph,
    PoseViewer,
    TrackedFrame,
    TrackedVideo,
    ViewerOptions,
    candidates_of,
    describe_shown,
    first_shown,
    gizmo_of_pose,
    page_camera,
    photograph_plane,
    pose_of_gizmo,
    read_result,
    read_track,
    saved_pose,
    start_pose,
    view_of,
)
from posekit.visualise import draw

CAMERA = Camera(500.0, 480.0, 300.0, 250.0, 640, 480)  # its principal point is not in the middle
POSE = Pose(so3_exp([0.4, -0.3, 0.2]), [0.03, -0.02, 0.5])
GREY = 190


@pytest.fixture(scope="module")
def model() -> ObjectModel:
    return bracket(offset=(0.05, 0.02, -0.03))


def photograph(camera: Camera = CAMERA) -> View:
    return View(np.full((camera.height, camera.width, 3), GREY, np.uint8), camera)


def estimate(pose: Pose = POSE, score: float = 0.9, **changes: Any) -> Estimate:
    steps = tuple(Step(Pose(so3_exp([0, 0, 0.1 * k]) @ pose.R, pose.t), 0.1 * k) for k in (3, 2, 1))
    known = Estimate(
        pose, math.radians(3), 3, True, score, (0, 0, 9, 9), "bracket", trace=steps, timings={"total": 1.0}
    )
    return replace(known, **changes)


# --- cameras and poses --------------------------------------------------------------------------------------------


def seen_at(camera: Camera, aspect: float, points: Any, zoom: float = 1.0, target: Any = (0, 0, 1.0)) -> Any:
    """Where a page of this shape draws points (N, 3): -1 to 1 from left to right and from top to bottom."""
    page = page_camera(camera, aspect, zoom, target)
    z = (page.look_at - page.position) / np.linalg.norm(page.look_at - page.position)
    x = np.cross(z, page.up)
    x /= np.linalg.norm(x)
    p = (np.asarray(points) - page.position) @ np.stack([x, np.cross(z, x), z]).T
    tan = math.tan(page.fov / 2)
    return p[:, :2] / p[:, 2:] / (tan * aspect, tan)


@pytest.mark.parametrize("aspect", [0.5, 1.0, 4 / 3, 2.5])
def test_the_page_sees_the_whole_picture_edge_on_edge(aspect: float) -> None:
    plane = photograph_plane(CAMERA, 3.0)
    half = np.array([plane.width / 2, plane.height / 2, 0])
    corners = plane.position + half * [[-1, -1, 0], [1, 1, 0]]
    assert np.allclose(CAMERA.project(corners), [[-0.5, -0.5], [639.5, 479.5]])
    places = seen_at(CAMERA, aspect, corners)
    assert np.abs(places).max() == pytest.approx(1.0), "one edge lies on the window's"
    assert (places[0] < 0).all() and (places[1] > 0).all(), "right is right and down is down"


def test_zooming_looks_at_the_object_from_the_same_place() -> None:
    target = POSE.t
    page = page_camera(CAMERA, 1.5, 4.0, target)
    assert np.allclose(page.position, 0) and np.allclose(page.look_at, target)
    assert np.allclose(seen_at(CAMERA, 1.5, [target], 4.0, target), 0)
    assert math.tan(page.fov / 2) == pytest.approx(math.tan(page_camera(CAMERA, 1.5).fov / 2) / 4)


def test_gizmos_and_poses_are_each_others_inverse(model: ObjectModel) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        pose = Pose(random_rotation(rng), rng.normal(size=3))
        wxyz, position = gizmo_of_pose(pose, model.center)
        assert np.allclose(pose_of_gizmo(wxyz, position, model.center).matrix, pose.matrix)
        assert np.allclose(quat_to_rotation(wxyz) @ (model.center - model.center) + position, pose.apply(model.center))


def test_an_object_without_a_pose_starts_in_the_middle_of_the_picture(model: ObjectModel) -> None:
    shown = first_shown(Photograph(photograph(), "a.png"), 0, model)
    x0, y0, x1, y1 = CAMERA.points_box(shown.T_cam_obj.apply(model.hull_vertices))
    assert 0 < x0 < 320 < x1 < 640 and 0 < y0 < 240 < y1 < 480
    assert 0.15 * 480 < max(x1 - x0, y1 - y0) < 0.7 * 480
    assert "no pose is known" in shown.note
    assert np.allclose(shown.T_cam_obj.matrix, start_pose(CAMERA, model).matrix)


# --- meshes -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("opacity", [1.0, 0.4])
def test_a_mesh_as_glb_is_the_same_mesh(model: ObjectModel, tmp_path: Path, opacity: float) -> None:
    (tmp_path / "bracket.glb").write_bytes(to_glb(model, opacity))
    found = ObjectModel.load(tmp_path / "bracket.glb", units="m")
    assert np.allclose(found.bounds, model.bounds, atol=1e-6) and len(found.faces) == len(model.faces)
    data = (tmp_path / "bracket.glb").read_bytes()
    tree = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    [material] = tree["materials"]
    assert material["pbrMetallicRoughness"]["baseColorFactor"][3] == pytest.approx(opacity)
    assert material["alphaMode"] == ("OPAQUE" if opacity == 1 else "BLEND")
    assert "COLOR_0" in tree["meshes"][0]["primitives"][0]["attributes"], "linear colours of the vertices"


def test_a_large_texture_is_made_smaller_on_the_page(model: ObjectModel, tmp_path: Path) -> None:
    texture = np.random.default_rng(0).integers(0, 255, (64, 32, 3), np.uint8)
    textured = replace(model, colors=None, texture=texture, uvs=np.zeros((len(model.vertices), 2), np.float32))
    (tmp_path / "a.glb").write_bytes(to_glb(textured, texture_side=16))
    found = ObjectModel.load(tmp_path / "a.glb", units="m")
    assert found.texture is not None and found.texture.shape == (16, 8, 3)


# --- what is shown ------------------------------------------------------------------------------------------------


def test_candidates_are_estimates_and_their_alternatives() -> None:
    other = estimate(Pose(so3_exp([0, 0, 2.0]) @ POSE.R, POSE.t), 0.3)
    [first, second] = candidates_of([estimate(alternatives=(other,))])
    assert (first.label, second.label) == ("result", "result, alternative 2")
    assert first.note.startswith("reliable") and "NOT RELIABLE" in second.note
    labels = [each.label for each in candidates_of([estimate(), estimate()])]
    assert labels == ["instance 1", "instance 2"]


def test_what_is_shown_goes_from_step_to_step(model: ObjectModel) -> None:
    shown = first_shown(Photograph(photograph(), "a.png", candidates_of([estimate()])), 0, model)
    assert shown.step == 3 and shown.origin == "result"
    first = shown.stepping(0)
    assert first.origin == "iteration" and first.estimate is None and "before iteration 1 of 3" in first.note
    assert rotation_angle(first.T_cam_obj.R.T @ POSE.R) == pytest.approx(0.3)
    assert shown.stepping(3).T_cam_obj is shown.T_cam_obj
    by_hand = first.moved(Pose.translation([0, 0, 1]))
    assert by_hand.origin == HAND and by_hand.choice == 0
    refined = by_hand.refined(estimate()).moved(POSE).refined(estimate())
    assert [each.label for each in refined.candidates] == ["result", "refined 1", "refined 2"]
    assert refined.chosen.origin == REFINED and refined.choice == 2


def test_text_is_told_without_markup(model: ObjectModel) -> None:
    shown = first_shown(Photograph(photograph(), "a"), 0, model)
    assert "\\<b\\>\\_x" in describe_shown(shown, "<b>_x")


# --- files --------------------------------------------------------------------------------------------------------


def test_a_saved_pose_is_one_that_refine_and_track_take(model: ObjectModel, tmp_path: Path) -> None:
    shown = first_shown(Photograph(photograph(), "a.png"), 0, model).moved(POSE)
    document = saved_pose(shown, model, {"image": Path("a.png"), "mesh": Path("b.ply")}, 12)
    (tmp_path / "pose.json").write_text(json.dumps(document, allow_nan=False))
    assert np.allclose(load_pose(tmp_path / "pose.json").matrix, POSE.matrix)
    again = read_result(tmp_path / "pose.json")
    assert again.image == Path("a.png") and again.meshes == (Path("b.ply"),)
    assert np.allclose(again.candidates[0].T_cam_obj.matrix, POSE.matrix) and again.candidates[0].origin == HAND
    assert document["frame"] == 12 and document["score"] is None
    nan = shown.refined(estimate(angle=math.nan))
    assert saved_pose(nan, model, {})["angle_deg"] is None


def test_a_result_is_read_with_its_photograph_and_camera(model: ObjectModel, tmp_path: Path) -> None:
    about = {"image": "photo.png", "mesh": "b.ply", "camera": {"K": CAMERA.K, "width": 640, "height": 480}}
    other = replace(estimate(), model="other")
    (tmp_path / "result.json").write_text(estimates_to_json([estimate(), estimate(), other], about=about))
    (tmp_path / "photo.png").write_bytes(draw.png(photograph().image))
    result = read_result(tmp_path / "result.json")
    assert result.image == Path("photo.png") and len(result.candidates) == 3
    assert [each.label for each in result.of("bracket")] == ["instance 1", "instance 2"]
    assert [each.label for each in result.of("other")] == ["result"]
    with pytest.raises(PromptError, match="bracket, other, none of cup"):
        result.of("cup")
    assert result.camera is not None
    assert view_of(tmp_path / "photo.png", result.camera).camera == CAMERA


def test_a_photograph_with_distortion_is_seen_as_it_was_estimated(model: ObjectModel, tmp_path: Path) -> None:
    entry = {"K": CAMERA.K.tolist(), "width": 640, "height": 480, "distortion_coefficients": [-0.2, 0.05, 0, 0]}
    lens = calibration_of_entry(entry, (640, 480), "test").lens
    assert lens is not None
    image = np.random.default_rng(0).integers(0, 255, (480, 640, 3), np.uint8)
    (tmp_path / "a.png").write_bytes(draw.png(image))
    view = View(lens.undistorted(image), lens.ideal, lens=lens)
    document = saved_pose(first_shown(Photograph(view, "a"), 0, model), model, {})
    again = view_of(tmp_path / "a.png", document["camera"])
    assert again.camera == view.camera and np.array_equal(again.image, view.image)


@pytest.mark.parametrize("text", ["[]", "{", '{"a": 1}', '{"estimates": 3}', '{"T_cam_obj": [[1]]}'])
def test_other_files_are_no_results(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(PromptError, match=r"give a result.json|is no posekit result"):
        read_result(tmp_path / "a.json")


def line(frame: int, model: str = "cup", pose: Pose | None = POSE) -> str:
    matrix = None if pose is None else pose.matrix.tolist()
    state = "lost" if pose is None else "tracked"
    entry = {"frame": frame, "model": model, "state": state, "T_cam_obj": matrix, "angle_deg": 2.0, "score": 0.8}
    return json.dumps(entry) + "\n"


def test_a_track_is_read_mesh_by_mesh(tmp_path: Path) -> None:
    file = tmp_path / "poses.jsonl"
    file.write_text(line(0) + line(0, "box") + line(1, pose=None) + line(1, "box") + '{"frame": 2, "mo')
    cup = read_track(file, "cup")
    assert [each.number for each in cup] == [0, 1] and cup[1].T_cam_obj is None
    assert cup[0].T_cam_obj is not None and np.allclose(cup[0].T_cam_obj.matrix, POSE.matrix)
    with pytest.raises(PromptError, match="cup, box"):
        read_track(file, "hat")
    file.write_text("x\n" + line(0))
    with pytest.raises(PromptError, match="line 1"):
        read_track(file)
    file.write_text("")
    with pytest.raises(PromptError, match="no frames"):
        read_track(file)
    with pytest.raises(PromptError, match="cannot be read"):
        read_track(tmp_path / "none.jsonl")


class Clip:
    """Frames whose grey says their number; reading is counted."""

    def __init__(self, count: int) -> None:
        self.count, self.rate, self.read = count, 30.0, 0

    def __iter__(self) -> Iterator[Frame]:
        for number in range(self.count):
            self.read += 1
            grey = np.full((480, 640, 3), number, np.uint8)
            yield Frame(number, None if number == 3 else grey, CAMERA, problem="damaged" if number == 3 else "")


def test_a_videos_frames_are_read_forwards_and_backwards() -> None:
    clip = Clip(60)
    video = TrackedVideo(clip, [TrackedFrame(k, "tracked", POSE, 0.02, 0.8) for k in range(70)])
    assert video.view(0).image[0, 0, 0] == 0 and clip.read == 1
    assert video.view(50).image[0, 0, 0] == 50 and clip.read == 51
    assert video.view(51 - KEPT).image[0, 0, 0] == 51 - KEPT and clip.read == 51, "the last ones are kept"
    assert video.view(1).image[0, 0, 0] == 1 and clip.read == 53, "from the beginning"
    assert video.view(52).image[0, 0, 0] == 52
    with pytest.raises(ImageError, match="damaged"):
        video.view(3)
    with pytest.raises(ImageError, match="no frame 65"):
        video.view(65)
    assert video.view(2).image[0, 0, 0] == 2
    assert "about 1 degree; score 0.80" in video.candidates(0)[0].note


@pytest.mark.parametrize("options", [{"port": 70000}, {"opacity": 1.5}])
def test_options_out_of_range(options: Any) -> None:
    with pytest.raises(ConfigError, match="between 0 and 1"):
        ViewerOptions(**options)


# --- the page without a browser -----------------------------------------------------------------------------------


class Desk:
    """A page, what was saved, and a refiner that knows the truth."""

    def __init__(self, model: ObjectModel, pictures: Any, folder: Path) -> None:
        self.folder = folder
        self.error: PosekitError | None = None
        about, options = {"image": "a.png"}, ViewerOptions(port=0, opacity=1.0)
        self.page = PoseViewer(model, pictures, save=self.write, refiner=self.refine, about=about, options=options)
        self.page.server.gui._resolve_client = lambda _: object()  # somebody who has the page open

    def write(self, name: str, text: str) -> Path:
        (self.folder / name).write_text(text)
        return self.folder / name

    def refine(self, view: View, T_cam_obj: Pose) -> Estimate:
        if self.error is not None:
            raise self.error
        return estimate()

    def change(self, control: Any, value: Any) -> None:
        """What the page sends when a person changes a control or clicks a button."""
        from viser import _messages

        server = self.page.server
        message = _messages.GuiUpdateMessage(control._impl.uuid, {"value": value})
        done = asyncio.run_coroutine_threadsafe(server.gui._handle_gui_updates(0, message), server.get_event_loop())
        done.result(5)
        self.settle()

    def drag(self, pose: Pose) -> None:
        """What the page sends when a person drags the gizmo to a pose."""
        scene, page = self.page.server.scene, self.page
        wxyz, position = gizmo_of_pose(pose, page.model.center)

        async def run() -> None:
            handle = page.gizmo
            await scene._fire_transform_controls_callbacks(0, handle, "start")
            handle._impl.wxyz, handle._impl.position = np.asarray(wxyz), np.asarray(position)
            await scene._fire_transform_controls_callbacks(0, handle, "update")
            await scene._fire_transform_controls_callbacks(0, handle, "end")

        asyncio.run_coroutine_threadsafe(run(), page.server.get_event_loop()).result(5)
        self.settle()

    def settle(self) -> None:
        """Until all is done that follows: callbacks run in threads of their own, and hand work to the page's."""
        time.sleep(0.05)
        self.page.wait()


@pytest.fixture
def desk(model: ObjectModel, tmp_path: Path) -> Iterator[Desk]:
    pytest.importorskip("viser", reason='the page needs viser: pip install "posekit[view]"')
    other = estimate(Pose(so3_exp([0, 0, 2.0]) @ POSE.R, POSE.t), 0.3)
    pictures = Photograph(photograph(), "a.png", candidates_of([estimate(alternatives=(other,))]))
    made = Desk(model, pictures, tmp_path)
    with made.page:
        yield made


def test_the_page_is_for_this_machine_alone(desk: Desk) -> None:
    port = desk.page.server.get_port()
    assert desk.page.url == f"http://127.0.0.1:{port}"
    with urllib.request.urlopen(desk.page.url, timeout=10) as answer:
        assert answer.status == 200 and b"<html" in answer.read().lower()
    with pytest.raises(ConnectionRefusedError), socket.create_connection(("127.0.0.2", port), timeout=2):
        pass  # where it listened on every address, this one would answer
    assert desk.page.server.request_share_url() is None, "no relay"


@pytest.mark.parametrize(("origin", "welcome"), [("http://127.0.0.1:{}", True), ("http://localhost:9000", True),
                                                 (None, True), ("http://example.org", False),
                                                 ("http://127.0.0.1.example.org", False)])  # fmt: skip
def test_pages_of_other_sites_are_refused(desk: Desk, origin: str | None, welcome: bool) -> None:
    import viser
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    port = desk.page.server.get_port()
    protocol, sender = f"viser-v{viser.__version__}", origin and origin.format(port)

    def try_it() -> None:
        with connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], origin=sender, max_size=None) as there:
            assert there.recv(timeout=10)

    if welcome:
        try_it()
    else:
        with pytest.raises(InvalidStatus, match="403"):
            try_it()


def test_dragging_refining_and_saving(desk: Desk) -> None:
    page = desk.page
    moved = Pose(so3_exp([0, 0, 0.5]) @ POSE.R, [0.1, 0.0, 0.6])
    desk.drag(moved)
    assert page.shown.origin == HAND and np.allclose(page.shown.T_cam_obj.matrix, moved.matrix)
    assert np.allclose(page.frame.position, moved.apply(page.model.center), atol=1e-6), "the mesh follows"
    desk.change(page.controls.save, True)
    assert np.allclose(load_pose(desk.folder / "pose.json").matrix, moved.matrix)
    assert "saved" in page.controls.message.content
    desk.change(page.controls.refine, True)
    assert page.shown.chosen.label == page.controls.candidate.value == "refined 1"
    assert np.allclose(page.gizmo.position, POSE.apply(page.model.center))
    desk.change(page.controls.undo, True)
    assert np.allclose(page.shown.T_cam_obj.matrix, moved.matrix)
    desk.change(page.controls.undo, True)
    assert page.shown.origin == "result" and page.controls.undo.disabled


def test_hypotheses_and_iterations_are_stepped_through(desk: Desk) -> None:
    page, c = desk.page, desk.page.controls
    assert c.candidate.options == ("result", "result, alternative 2") and c.step.max == 3
    desk.change(c.candidate, "result, alternative 2")
    assert page.shown.choice == 1 and "NOT RELIABLE" in c.text.content
    desk.change(c.step, 1)
    assert page.shown.step == 1 and page.shown.origin == "iteration"


def test_opacity_gizmo_and_zoom(desk: Desk) -> None:
    page, c = desk.page, desk.page.controls
    assert [level for level, mesh in page._meshes.items() if mesh.visible] == [1.0]
    desk.change(c.opacity, 0.4)
    assert [level for level, mesh in page._meshes.items() if mesh.visible] == [0.4]
    desk.change(c.opacity, 0.0)
    assert not any(mesh.visible for mesh in page._meshes.values())
    desk.change(c.gizmo, False)
    assert not page.gizmo.visible
    desk.change(c.zoom, 3.0)
    desk.change(c.reset, True)


def test_what_goes_wrong_is_said_on_the_page(desk: Desk) -> None:
    desk.error = PromptError("the object is behind the camera.")
    desk.change(desk.page.controls.refine, True)
    assert "behind the camera" in desk.page.controls.message.content
    assert not desk.page.controls.refine.disabled and desk.page.shown.origin == "result"


def test_a_pose_far_away_stays_before_the_photograph(desk: Desk) -> None:
    page = desk.page
    page.move(Pose(POSE.R, [0, 0, 30.0]))
    assert page._photograph.position[2] > 31
    plane = photograph_plane(CAMERA, float(page._photograph.position[2]))
    assert page._photograph.render_width == pytest.approx(plane.width)


def test_a_videos_frames_have_their_poses(model: ObjectModel, tmp_path: Path) -> None:
    pytest.importorskip("viser", reason='the page needs viser: pip install "posekit[view]"')
    poses = [POSE, Pose(POSE.R, [0, 0, 0.7]), None, POSE]
    video = TrackedVideo(Clip(4), [TrackedFrame(k, "tracked", pose) for k, pose in enumerate(poses)])
    desk = Desk(model, video, tmp_path)
    with desk.page as page:
        desk.change(page.controls.picture, 1)
        assert page.shown.index == 1 and page.shown.T_cam_obj.t[2] == pytest.approx(0.7)
        desk.change(page.controls.picture, 2)
        assert page.shown.T_cam_obj.t[2] == pytest.approx(0.7), "kept where it is lost"
        desk.change(page.controls.save, True)
        assert json.loads((tmp_path / "pose-000002.json").read_text())["frame"] == 2
        desk.change(page.controls.picture, 3)
        assert "damaged" in page.controls.message.content and page.shown.index == 2


def test_without_viser_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    done = CliRunner().invoke(app, ["view", "a.png", "--model", "a.ply"])
    assert done.exit_code == 1 and 'pip install "posekit[view]"' in done.stderr
    with pytest.raises(OutputError, match="posekit\\[view\\]"):
        PoseViewer(bracket(), Photograph(photograph(), "a"), save=lambda name, text: tmp_path)


# --- the command --------------------------------------------------------------------------------------------------


@pytest.fixture
def run(model: ObjectModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """The command in a folder with a photograph, a mesh and a result, which ends as soon as its page is there."""
    pytest.importorskip("viser", reason='the page needs viser: pip install "posekit[view]"')
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("posekit.cli.view._wait", lambda: None)
    Path("photo.png").write_bytes(draw.png(photograph().image))
    Path("bracket.glb").write_bytes(to_glb(model))
    about = {"image": "photo.png", "mesh": "bracket.glb", "camera": {"K": CAMERA.K, "width": 640, "height": 480}}
    Path("result.json").write_text(estimates_to_json([estimate()], about=about))
    Path("poses.jsonl").write_text(line(0, "bracket"))

    def invoke(*arguments: str) -> Any:
        return CliRunner().invoke(app, ["view", *arguments, "--port", "0", "--units", "m"])

    return invoke


@pytest.mark.parametrize(
    "arguments",
    [
        ["result.json"],
        ["result.json", "--model", "bracket.glb", "--camera", "500,480,300,250"],
        ["photo.png", "--model", "bracket.glb", "--camera", "500,480,300,250", "--pose", "result.json"],
        ["poses.jsonl", "--model", "bracket.glb", "--picture", "photo.png", "--camera", "500,480,300,250"],
    ],
    ids=["result", "result with files", "photograph", "track"],
)
def test_the_command_serves_a_page(run: Callable[..., Any], arguments: list[str]) -> None:
    done = run(*arguments)
    assert done.exit_code == 0, done.output
    assert "page: http://127.0.0.1:" in done.stdout and "viser" not in done.stdout


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["photo.png"], "--model MESH"),
        (["photo.png", "--model", "bracket.glb", "--picture", "photo.png"], "is a photograph itself"),
        (["poses.jsonl", "--model", "bracket.glb"], "--picture VIDEO"),
        (["result.json", "--pose", "result.json"], "has its own poses"),
        (["nowhere.json"], "cannot be read"),
        (["bare.json"], "which mesh"),
        (["gone.json"], "--picture FILE"),
    ],
)
def test_what_the_command_cannot_use(run: Callable[..., Any], arguments: list[str], text: str) -> None:
    Path("bare.json").write_text(json.dumps({"T_cam_obj": POSE.matrix.tolist()}))
    gone = {"T_cam_obj": POSE.matrix.tolist(), "image": "gone.png", "mesh": "bracket.glb"}
    Path("gone.json").write_text(json.dumps(gone))
    done = run(*arguments)
    assert done.exit_code == 1 and text in done.stderr, done.output


# --- in a browser -------------------------------------------------------------------------------------------------


@pytest.fixture
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="a browser is driven by playwright: pip install it")
    with playwright.sync_playwright() as driver:
        names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
        found = next(filter(None, map(shutil.which, names)), None)
        if found is None and not Path(driver.chromium.executable_path).exists():
            pytest.skip("there is no Chromium: apt-get install chromium, or playwright install chromium")
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
        made = driver.chromium.launch(executable_path=found, args=flags)
        yield made
        made.close()


def screenshot(page: Any, path: Path) -> Any:
    """The page (H, W, 3) when it has come to rest with the photograph on it: it fades in, slowly on a busy machine."""
    last = None
    for _ in range(60):
        page.wait_for_timeout(500)
        page.screenshot(path=path)
        picture = cv2.imread(str(path))[..., ::-1].astype(int)
        there = (np.abs(picture - GREY).max(axis=2) < 6).mean() > 0.2
        if there and last is not None and np.array_equal(picture, last):
            return picture
        last = picture
    pytest.fail(f"the page does not show the photograph: {path}")


def canvas_camera(desk: Desk) -> Camera:
    """The page's camera, as pixels of its screenshot."""
    [client] = desk.page.server.get_clients().values()
    width, height = client.camera.image_width, client.camera.image_height
    focal = 0.5 * height / math.tan(0.5 * client.camera.fov)
    return Camera(focal, focal, 0.5 * width - 0.5, 0.5 * height - 0.5, width, height)


def test_a_real_click_and_drag(desk: Desk, browser: Any) -> None:
    """Some 10 s, for a browser that draws without a GPU is slow."""
    shown, asked = desk.page, []
    page = browser.new_page(viewport={"width": 1100, "height": 700})
    page.on("request", lambda request: asked.append(request.url))
    page.goto(shown.url)
    page.get_by_role("button", name="Refine from here").wait_for(timeout=60_000)
    page.get_by_role("checkbox").click()  # without the gizmo

    # Mesh and photograph coincide: the mesh covers what a camera of the photograph's kind sees of it.
    camera, path = canvas_camera(desk), desk.folder / "page.png"
    picture = screenshot(page, path)[: camera.height, : camera.width]
    rendered = Renderer().render(shown.model, [POSE], [camera])[0]
    assert rendered.mask is not None
    colourful = np.ptp(picture, axis=2) > 40
    x0, y0, x1, y1 = (round(v) for v in camera.points_box(POSE.apply(shown.model.hull_vertices)))
    inside = np.zeros_like(colourful)
    inside[y0 - 20 : y1 + 20, x0 - 20 : x1 + 20] = True
    covered, expected = colourful & inside, rendered.mask
    overlap = (covered & expected).sum() / (covered | expected).sum()
    assert overlap > 0.97, f"overlap {overlap:.3f}"
    low, high = camera.project(CAMERA.backproject([[-0.5, -0.5], [639.5, 479.5]]))
    grey = np.abs(picture - GREY).max(axis=2) < 6  # the window's right edge lies in the controls' shadow
    across, down = np.flatnonzero(grey[camera.height // 2 - 100]), np.flatnonzero(grey[:, camera.width - 60])
    edges = across[0] - 0.5, down[0] - 0.5, down[-1] + 0.5
    assert np.abs(np.array(edges) - (low[0], low[1], high[1])).max() < 1.5, "the photograph's edges"

    # A drag along the gizmo's first axis moves the object along its own x axis.
    page.get_by_role("checkbox").click()
    screenshot(page, path)
    middle = POSE.apply(shown.model.center)
    start, end = camera.project(
        [middle + 0.5 * 0.75 * shown.model.diameter * POSE.R[:, 0], middle + 0.09 * POSE.R[:, 0]]
    )
    page.mouse.move(*start)
    page.mouse.down()
    for share in np.linspace(0, 1, 6):
        page.mouse.move(*(start + share * 1.5 * (end - start)))
        page.wait_for_timeout(60)
    page.mouse.up()
    page.get_by_text("moved by hand").wait_for(timeout=20_000)
    screenshot(page, desk.folder / "dragged.png")
    step = POSE.R.T @ (shown.shown.T_cam_obj.t - POSE.t)
    assert shown.shown.origin == HAND, "the mouse found the arrow"
    assert abs(step[0]) > 0.01 and np.abs(step[1:]).max() < 0.002

    page.get_by_role("button", name="Save pose").click()
    page.get_by_text("saved:").wait_for(timeout=20_000)
    assert np.allclose(load_pose(desk.folder / "pose.json").matrix, shown.shown.T_cam_obj.matrix)
    page.get_by_role("button", name="Refine from here").click()
    page.get_by_text("reliable: expected").wait_for(timeout=20_000)
    assert shown.shown.chosen.label == "refined 1"
    page.get_by_role("button", name="Undo").click()
    page.get_by_text("moved by hand").wait_for(timeout=20_000)
    hosts = {url.split("/")[2] for url in asked if url.startswith("http")}
    assert hosts == {f"127.0.0.1:{shown.server.get_port()}"}, "nothing is fetched from elsewhere"

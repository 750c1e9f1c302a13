"""A page to look at poses and to correct them by hand. Layer 4, and the only door to viser, which comes as an extra.

The page's world is the camera's own frame (x right, y down, z forward, metres). The photograph is a rectangle that the
camera sees exactly as its picture, behind the mesh: so both coincide whatever the window's shape is, for cameras whose
principal point is not in the middle, too, as long as the page's eye is in the camera's place.
"""

from __future__ import annotations

import io
import json
import logging
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from posekit.camera import Camera
from posekit.errors import ConfigError, ImageError, OutputError, PosekitError, PromptError
from posekit.geometry import Pose, quat_to_rotation, view_rotation
from posekit.io.calibration import calibration_of_entry
from posekit.io.load import load_image
from posekit.io.video import Frame, Frames
from posekit.mesh.export import to_glb
from posekit.mesh.model import ObjectModel
from posekit.results import Estimate, Step, angle_in_words, estimates_from_json
from posekit.view import View

log = logging.getLogger("posekit")

HOST = "127.0.0.1"
OWN_ORIGIN = re.compile(r"http://(127\.0\.0\.1|localhost)(:[0-9]+)?")  # of pages, forwarded ports too
LEVELS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)  # opacities that can be chosen; each but the first is a mesh of its own
MOST_FACES = 20_000  # of the mesh on the page
MOST_PIXELS = 2048  # longer side of the photograph on the page
QUALITY = 90  # of its JPEG
BEHIND = 4.0  # how much farther away than the object the photograph stands
MOST_ZOOM = 10.0
KEPT = 32  # frames of a video that stay decoded
FILLED = 0.4  # of the picture's shorter side, by an object that nobody has placed yet

HAND, REFINED, STEP, START = "moved by hand", "refined", "iteration", "start"

Array = NDArray[np.float64]
Refiner = Callable[[View, Pose], Estimate]


# --- cameras and poses as the page has them -----------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class PageCamera:
    """What the page's camera is set to. position, look_at, up: (3,) in the camera's frame, metres. fov: vertical field
    of view, radians."""

    position: Array
    look_at: Array
    up: Array
    fov: float


def page_camera(camera: Camera, aspect: float, zoom: float = 1.0, target: ArrayLike = (0.0, 0.0, 1.0)) -> PageCamera:
    """The page's camera in the photograph's place, such that the whole picture is seen.

    aspect: the window's width by its height. zoom: by how much the picture is enlarged about ``target`` (3,), the
    object's centre in the camera's frame; without enlargement the axis is the camera's own.
    """
    across = max(camera.cx + 0.5, camera.width - 0.5 - camera.cx) / camera.fx
    down = max(camera.cy + 0.5, camera.height - 0.5 - camera.cy) / camera.fy
    half = max(down, across / max(aspect, 1e-3))
    at = np.asarray(target, dtype=np.float64)
    if zoom <= 1:
        at = np.array([0.0, 0.0, np.linalg.norm(at)])
    return PageCamera(np.zeros(3), at, np.array([0.0, -1.0, 0.0]), float(2 * np.arctan(half / max(zoom, 1.0))))


@dataclass(frozen=True, eq=False)
class Plane:
    """A rectangle across the camera's axis. width, height: metres; position: (3,), its middle in the camera's frame."""

    width: float
    height: float
    position: Array


def photograph_plane(camera: Camera, depth: float) -> Plane:
    """The rectangle at ``depth`` (metres along z) that the camera sees as its picture, edge on edge."""
    edges = np.array([[-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5]])
    low, high = camera.backproject(edges, depth)
    return Plane(float(high[0] - low[0]), float(high[1] - low[1]), np.asarray(0.5 * (low + high)))


def gizmo_of_pose(T_cam_obj: Pose, center: ArrayLike) -> tuple[Array, Array]:
    """Rotation (4,) wxyz and place (3,) of the gizmo, which sits in the mesh's centre (3,), with the mesh's axes."""
    return T_cam_obj.quat_wxyz, T_cam_obj.apply(center)


def pose_of_gizmo(wxyz: ArrayLike, position: ArrayLike, center: ArrayLike) -> Pose:
    """``T_cam_obj`` of a gizmo in the mesh's centre (3,); the inverse of `gizmo_of_pose`."""
    R = quat_to_rotation(wxyz)
    return Pose(R, np.asarray(position, dtype=np.float64) - R @ np.asarray(center, dtype=np.float64))


def start_pose(camera: Camera, model: ObjectModel) -> Pose:
    """A ``T_cam_obj`` to begin with where none is known: in the picture's middle, upright, seen from before and a
    little from above."""
    R = view_rotation([0.4, -1.0, 0.5])
    focal = min(camera.fx, camera.fy)
    distance = focal * model.diameter / (FILLED * min(camera.width, camera.height))
    middle = camera.backproject([0.5 * camera.width - 0.5, 0.5 * camera.height - 0.5], distance)
    return Pose(R, middle - R @ model.center)


# --- what there is to look at -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pose that can be chosen on the page. label: what the page calls it. note: what is known of it, a line.
    steps: the poses on the way to it, first to last. origin: where it comes from. estimate: its numbers, where there
    are any."""

    label: str
    T_cam_obj: Pose
    note: str = ""
    steps: tuple[Step, ...] = ()
    origin: str = "result"
    estimate: Estimate | None = None


def candidates_of(estimates: Sequence[Estimate]) -> list[Candidate]:
    """Every estimate, each followed by its alternatives."""
    found = []
    for number, estimate in enumerate(estimates, 1):
        name = f"instance {number}" if len(estimates) > 1 else "result"
        found.append(_candidate(name, estimate))
        found += [_candidate(f"{name}, alternative {k}", each) for k, each in enumerate(estimate.alternatives, 2)]
    return found


def _candidate(label: str, estimate: Estimate, origin: str = "result") -> Candidate:
    note = f"{estimate.verdict}; score {estimate.score:.2f}"
    return Candidate(label, estimate.T_cam_obj, note, estimate.trace, origin, estimate)


class Pictures(Protocol):
    """Photographs with poses, by their place from 0."""

    @property
    def count(self) -> int:
        """How many there are."""

    def label(self, index: int) -> str:
        """What the page calls it."""

    def number(self, index: int) -> int | None:
        """A frame's number in its video, None for a photograph."""

    def view(self, index: int) -> View:
        """Raises ImageError where it cannot be read."""

    def candidates(self, index: int) -> Sequence[Candidate]:
        """The poses that are known, best first; none where the object is lost."""


@dataclass(frozen=True, eq=False)
class Photograph:
    """One picture and the poses in it."""

    picture: View
    name: str
    poses: Sequence[Candidate] = ()
    count: int = 1

    def label(self, index: int) -> str:  # noqa: ARG002 - there is one
        """Its name."""
        return self.name

    def number(self, index: int) -> int | None:  # noqa: ARG002
        """None: it is not of a video."""
        return None

    def view(self, index: int) -> View:  # noqa: ARG002
        """The picture itself."""
        return self.picture

    def candidates(self, index: int) -> Sequence[Candidate]:  # noqa: ARG002
        """The poses that were given."""
        return self.poses


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """A line of poses.jsonl. T_cam_obj: None where the object was lost. angle: predicted rotation error, radians."""

    number: int
    state: str
    T_cam_obj: Pose | None = None
    angle: float | None = None
    score: float | None = None
    reliable: bool | None = None


class TrackedVideo:
    """The frames of a video that was tracked. Frames are decoded in order; the last few stay decoded, and a step far
    back starts again from the beginning."""

    def __init__(self, frames: Frames, tracked: Sequence[TrackedFrame]) -> None:
        self.frames, self.tracked, self.count = frames, tracked, len(tracked)
        self._running: Iterator[Frame] | None = None
        self._place = -1
        self._kept: dict[int, Frame] = {}

    def label(self, index: int) -> str:
        """ "frame N"."""
        return f"frame {self.tracked[index].number}"

    def number(self, index: int) -> int | None:
        """The frame's number in its video."""
        return self.tracked[index].number

    def view(self, index: int) -> View:
        """The decoded frame. Raises ImageError where it cannot be decoded or has no camera."""
        frame = self._frame(self.tracked[index].number)
        if frame.image is None or frame.camera is None:
            raise ImageError(frame.problem or f"frame {frame.number} cannot be read.")
        return View(frame.image, frame.camera, valid=frame.valid)

    def candidates(self, index: int) -> Sequence[Candidate]:
        """The tracked pose, none where the object was lost."""
        found = self.tracked[index]
        if found.T_cam_obj is None:
            return []
        angle = "unknown" if found.angle is None else angle_in_words(math.degrees(found.angle))
        doubt = ", NOT RELIABLE" if found.reliable is False else ""
        note = f"{found.state}{doubt}: expected rotation error {angle}"
        return [
            Candidate("track", found.T_cam_obj, note + ("" if found.score is None else f"; score {found.score:.2f}"))
        ]

    def _frame(self, number: int) -> Frame:
        if number in self._kept:
            return self._kept[number]
        if self._running is None or number <= self._place:
            self._running = iter(self.frames)
        for frame in self._running:
            self._place = frame.number
            self._kept[frame.number] = frame
            if len(self._kept) > KEPT:
                del self._kept[next(iter(self._kept))]
            if frame.number == number:
                return frame
        self._running = None
        raise ImageError(f"the video has no frame {number}: give the one that was tracked.")


def read_track(path: Path, model: str | None = None) -> list[TrackedFrame]:
    """The lines of a poses.jsonl that are of one mesh, in their order.

    model: the mesh's name; it may be left out where the file has one mesh alone. A last line that is cut off, as a
    killed run leaves it, is left out. Raises PromptError where the file cannot be used.
    """
    needed = "give the poses.jsonl of posekit track."
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise PromptError(f"{path} cannot be read ({error}): {needed}") from error
    found: dict[str, list[TrackedFrame]] = {}
    for number, line in enumerate(lines, 1):
        try:
            entry = json.loads(line)
            name, frame = _tracked(entry)
        except (ValueError, KeyError, TypeError) as error:
            if number == len(lines):
                break
            raise PromptError(f"line {number} of {path} is none of a track ({error}): {needed}") from error
        found.setdefault(name, []).append(frame)
    if not found:
        raise PromptError(f"{path} has no frames: {needed}")
    if model in found:
        return found[model]
    if len(found) > 1:
        raise PromptError(f"{path} has the meshes {', '.join(found)}: give one of them (--model), not {model}.")
    return next(iter(found.values()))


def _tracked(entry: Mapping[str, Any]) -> tuple[str, TrackedFrame]:
    matrix, angle, score = entry["T_cam_obj"], entry["angle_deg"], entry.get("score")
    return str(entry["model"]), TrackedFrame(
        int(entry["frame"]),
        str(entry["state"]),
        None if matrix is None else Pose.from_matrix(matrix),
        None if angle is None else math.radians(angle),
        None if score is None else float(score),
        entry.get("reliable"),
    )


@dataclass(frozen=True, eq=False)
class SavedResult:
    """What a result.json, or a pose that the page saved, says. candidates: the poses; models: the name of each one's
    mesh. image, meshes: files as they were named, none where it does not say. camera: its entry, for `view_of`."""

    candidates: tuple[Candidate, ...]
    models: tuple[str, ...]
    image: Path | None
    meshes: tuple[Path, ...]
    camera: Mapping[str, Any] | None

    def of(self, model: str) -> list[Candidate]:
        """The candidates of one mesh, by its name; all of them where the result has one mesh alone. Raises PromptError
        where none is of this mesh."""
        if len(set(self.models)) <= 1:
            return list(self.candidates)
        found = [each for each, name in zip(self.candidates, self.models, strict=True) if name == model]
        if not found:
            raise PromptError(
                f"the result has poses of {', '.join(dict.fromkeys(self.models))}, none of {model}: give one of these "
                "meshes (--model)."
            )
        return found


def read_result(path: Path) -> SavedResult:
    """A result.json of `estimate` or `refine`, or a pose that the page saved. Raises PromptError for something else."""
    try:
        text = path.read_text(encoding="utf-8-sig")
        document = json.loads(text)
        if not isinstance(document, dict):
            raise ValueError("its outermost part is not {...}")
        if "estimates" in document:
            estimates = estimates_from_json(text)
            # candidates of one mesh are numbered by themselves
            by_model = {
                name: [e for e in estimates if e.model == name] for name in dict.fromkeys(e.model for e in estimates)
            }
            named = [(c, name) for name, group in by_model.items() for c in candidates_of(group)]
        else:
            pose = Pose.from_matrix(document["T_cam_obj"])
            origin = str(document.get("origin", "saved"))
            named = [(Candidate("saved pose", pose, origin, origin=origin), str(document.get("model", "")))]
        mesh = document.get("mesh")
        meshes = mesh if isinstance(mesh, list) else [] if mesh is None else [mesh]
        image, camera = document.get("image"), document.get("camera")
        return SavedResult(
            tuple(candidate for candidate, _ in named),
            tuple(name for _, name in named),
            None if image is None else Path(image),
            tuple(map(Path, meshes)),
            camera if isinstance(camera, dict) else None,
        )
    except OSError as error:
        raise PromptError(f"the result {path} cannot be read ({error.strerror}): check the path.") from error
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        reason = f"it has no {error.args[0]}" if isinstance(error, KeyError) else str(error)
        raise PromptError(
            f"{path} is no result ({reason}): give a result.json of posekit estimate or refine, or a pose that the "
            "page saved."
        ) from error


def view_of(image: Path, camera: Mapping[str, Any]) -> View:
    """A photograph through the camera that a result has; where that says what it was undistorted from, undistorted.
    Raises ImageError, CameraError."""
    pixels = load_image(image)
    entry = camera.get("undistorted_from", camera)
    found = calibration_of_entry(entry, (pixels.shape[1], pixels.shape[0]), "the result's camera")
    valid = None if found.lens is None else found.lens.valid
    return View(found.undistorted(pixels), found.ideal, lens=found.lens, valid=valid)


# --- what is shown ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Shown:
    """What the page shows. index: of the picture. choice: of the candidates. step: on the way to the chosen one, its
    number of steps for itself. origin, note, estimate: of the pose, as a Candidate has them."""

    index: int
    view: View
    candidates: tuple[Candidate, ...]
    choice: int
    step: int
    T_cam_obj: Pose
    origin: str
    note: str
    estimate: Estimate | None = None

    @property
    def chosen(self) -> Candidate:
        """The candidate that is shown."""
        return self.candidates[self.choice]

    def choosing(self, choice: int) -> Shown:
        """With another candidate."""
        c = self.candidates[choice]
        return replace(self, choice=choice, step=len(c.steps), T_cam_obj=c.T_cam_obj, origin=c.origin, note=c.note,
                       estimate=c.estimate)  # fmt: skip

    def stepping(self, step: int) -> Shown:
        """At another pose on the way to the candidate."""
        steps = self.chosen.steps
        if step >= len(steps):
            return self.choosing(self.choice)
        angle = angle_in_words(steps[step].angle_deg)
        note = f"before iteration {step + 1} of {len(steps)}: expected rotation error {angle}"
        return replace(self, step=step, T_cam_obj=steps[step].T_cam_obj, origin=STEP, note=note, estimate=None)

    def moved(self, T_cam_obj: Pose) -> Shown:
        """With a pose that a person gave."""
        return replace(self, T_cam_obj=T_cam_obj, origin=HAND, note=f"{HAND}, not refined yet", estimate=None)

    def refined(self, estimate: Estimate) -> Shown:
        """With what refinement made of it as a further candidate, which is chosen."""
        count = sum(each.origin == REFINED for each in self.candidates) + 1
        added = (*self.candidates, _candidate(f"refined {count}", estimate, REFINED))
        return replace(self, candidates=added).choosing(len(added) - 1)


def first_shown(pictures: Pictures, index: int, model: ObjectModel, last: Pose | None = None) -> Shown:
    """A picture with its best candidate. last: the pose that is kept where the picture has none; without it the object
    is put into the picture's middle."""
    view, found = pictures.view(index), tuple(pictures.candidates(index))
    if not found and last is not None:
        found = (Candidate("kept pose", last, "no pose is known here: this one was shown before", origin=HAND),)
    elif not found:
        note = "no pose is known: move the mesh over the object, then refine"
        found = (Candidate("start", start_pose(view.camera, model), note, origin=START),)
    blank = Shown(index, view, found, 0, 0, found[0].T_cam_obj, "", "")
    return blank.choosing(0)


def saved_pose(shown: Shown, model: ObjectModel, about: Mapping[str, Any], number: int | None = None) -> dict[str, Any]:
    """What is saved: a pose as ``refine --pose`` and ``track --pose`` take it, with where it comes from.

    about: further entries, such as the files' names. number: of the video's frame.
    """
    camera, pose, estimate = shown.view.camera, shown.T_cam_obj, shown.estimate
    seen_by: dict[str, Any] = {"K": camera.K.tolist(), "width": camera.width, "height": camera.height}
    if shown.view.lens is not None:
        lens = shown.view.lens
        taken = {"K": lens.camera.K.tolist(), "width": lens.camera.width, "height": lens.camera.height}
        seen_by["undistorted_from"] = {
            **taken, "model": lens.model, "distortion_coefficients": [float(v) for v in lens.coefficients]
        }  # fmt: skip
    known = estimate is not None and math.isfinite(estimate.angle)
    return {
        **{key: value if isinstance(value, (int, float)) else str(value) for key, value in about.items()},
        **({} if number is None else {"frame": number}),
        "camera": seen_by,
        "model": model.name,
        "origin": shown.origin,
        "T_cam_obj": pose.matrix.tolist(),
        "quat_wxyz": pose.quat_wxyz.tolist(),
        "t_m": pose.t.tolist(),
        "angle_deg": estimate.angle_deg if estimate is not None and known else None,
        "score": None if estimate is None else estimate.score,
    }


def describe_shown(shown: Shown, name: str) -> str:
    """A few lines of Markdown about what is shown. name: the picture's."""
    x, y, z = 1000 * shown.T_cam_obj.t
    return (
        f"**{_plain(name)}**\n\n{_plain(shown.note)}\n\n"
        f"position {x:.1f}, {y:.1f}, {z:.1f} mm (right, down, forward)"
    )  # fmt: skip


def _plain(text: str) -> str:
    """A text in which Markdown has nothing to find."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]<>()#+!|$" else c for c in text)


# --- the page -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ViewerOptions:
    """port: the first that is tried; where another program has it, the next free one is taken; 0 leaves the choice to
    the system. opacity: of the mesh at first, 0 to 1."""

    port: int = 8080
    opacity: float = 0.6

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535 or not 0 <= self.opacity <= 1:
            raise ConfigError(
                f"port {self.port}, opacity {self.opacity:g}: a port lies between 0 and 65535, an opacity between 0 "
                "and 1."
            )


def require_viser() -> Any:
    """The library viser. Raises OutputError where it is not installed."""
    try:
        import viser
    except ImportError as error:
        raise OutputError('the page needs viser: pip install "posekit[view]".') from error
    return viser


def _loopback_server(port: int) -> Any:
    """A server that this machine alone reaches, and there only programs and pages that it served itself; and that no
    page can ask to be shared by viser's relay."""
    viser = require_viser()

    class LoopbackServer(viser.ViserServer):  # type: ignore[misc, name-defined]
        def request_share_url(self, verbose: bool = True) -> str | None:  # noqa: ARG002 - viser's signature
            return None

    with (
        _own_origin(),
        redirect_stdout(io.StringIO()),
    ):  # viser prints where it listens; the command says it in its words
        return LoopbackServer(HOST, port, label="posekit", verbose=False)


@contextmanager
def _own_origin() -> Iterator[None]:
    """Servers that are started meanwhile refuse connections from pages of other sites. viser asks nobody where he comes
    from, so any page in the browser could look at the photograph and move the mesh."""
    import websockets.asyncio.server

    server: Any = websockets.asyncio.server
    started = server.serve
    server.serve = partial(started, origins=[OWN_ORIGIN, None])
    try:
        yield
    finally:
        server.serve = started


@dataclass
class _Controls:
    """The page's controls, by what they do."""

    text: Any = None
    candidate: Any = None
    step: Any = None
    picture: Any = None
    opacity: Any = None
    zoom: Any = None
    gizmo: Any = None
    reset: Any = None
    refine: Any = None
    undo: Any = None
    save: Any = None
    message: Any = None


class PoseViewer:
    """The page: the photograph, the mesh over it with a gizmo, and what can be done with its pose.

    model: the mesh. pictures: what to look at. refiner: makes a pose better; None where nothing can. save: is given a
    file's name and its text, writes it, and gives back the path. about: entries of what is saved.
    It is served from when it is made until `close`, at `url`, to this machine alone. All that a person does there runs
    in one thread, one after the other, the refiner too.
    Raises OutputError where viser is not installed, ImageError where the first picture cannot be read.
    """

    def __init__(
        self,
        model: ObjectModel,
        pictures: Pictures,
        *,
        save: Callable[[str, str], Path],
        refiner: Refiner | None = None,
        about: Mapping[str, Any] = {},
        options: ViewerOptions = ViewerOptions(),
    ) -> None:
        self.model, self.pictures, self.options = model, pictures, options
        self._save, self._refiner, self._about = save, refiner, dict(about)
        require_viser()
        self.shown = first_shown(pictures, 0, model)
        self.history: list[Shown] = []
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="posekit-view")
        self._wanted = 0  # the picture that is asked for last
        self._aspects: dict[int, float] = {}
        self.controls = _Controls()
        self.server = _loopback_server(options.port)
        self._far = 0.0
        self._build_scene()
        self._build_controls()
        self.server.on_client_connect(self._connected)
        self._show()

    @property
    def url(self) -> str:
        """Where a browser finds the page."""
        return f"http://{HOST}:{self.server.get_port()}"

    def __enter__(self) -> PoseViewer:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """End the page; work that waits is dropped."""
        self._worker.shutdown(wait=True, cancel_futures=True)
        with redirect_stdout(io.StringIO()):
            self.server.stop()

    # What the controls do; each may also be called from Python, where nobody uses the page at that moment.

    def choose(self, choice: int) -> None:
        """Show a candidate, by its place in ``shown.candidates``."""
        self._become(self.shown.choosing(choice))

    def step_to(self, step: int) -> None:
        """Show a pose on the way to the candidate, from 0; its number of steps is the candidate itself."""
        self._become(self.shown.stepping(step))

    def move(self, T_cam_obj: Pose, *, remember: bool = True) -> None:
        """Take a pose that a person gave. remember: whether `undo` comes back to what was before."""
        self._become(self.shown.moved(T_cam_obj), remember=remember)

    def undo(self) -> None:
        """Back to what was shown before; nothing where there is nothing."""
        if self.history:
            self.shown = self.history.pop()
            self._show()

    def show_picture(self, index: int) -> None:
        """Show another picture with its best candidate; the pose stays where it has none. Raises ImageError."""
        self._wanted = index
        self._load_picture(index)

    def refine(self) -> None:
        """Refine the pose that is shown. Raises what the refiner raises."""
        if self._refiner is None:
            return
        self._busy(True)
        self._say("refining ...")
        try:
            found = self._refiner(self.shown.view, self.shown.T_cam_obj)
        finally:
            self._busy(False)
        self._become(self.shown.refined(found))

    def save(self) -> Path:
        """Write the pose that is shown and say where. Raises OutputError."""
        number = self.pictures.number(self.shown.index)
        name = "pose.json" if number is None else f"pose-{number:06d}.json"
        document = saved_pose(self.shown, self.model, self._about, number)
        path = self._save(name, json.dumps(document, indent=1, allow_nan=False) + "\n")
        self._say(f"saved: {path}")
        return path

    def look_through(self) -> None:
        """Put every page's eye into the camera's place."""
        for client in self.server.get_clients().values():
            self._place_camera(client)

    # How it is shown.

    def _build_scene(self) -> None:
        scene = self.server.scene
        scene.set_up_direction("-y")
        scene.configure_default_lights(cast_shadow=False)
        scene.add_light_ambient("/light", intensity=1.2)
        wxyz, position = gizmo_of_pose(self.shown.T_cam_obj, self.model.center)
        self.gizmo = scene.add_transform_controls(
            "/object", scale=0.75 * self.model.diameter, depth_test=False, wxyz=wxyz, position=position, line_width=3.0
        )
        self.frame = scene.add_frame("/body", show_axes=False, wxyz=wxyz, position=position)
        drawn = self.model.simplified(MOST_FACES)
        self._meshes = {
            level: scene.add_glb(
                f"/body/mesh-{round(100 * level)}", to_glb(drawn, level), position=-self.model.center,
                visible=False, cast_shadow=False, receive_shadow=False,
            )
            for level in LEVELS if level > 0
        }  # fmt: skip
        self._set_opacity(self.options.opacity)
        self._photograph: Any = None
        self._show_photograph()
        target = self.shown.T_cam_obj.apply(self.model.center)
        seen, first = page_camera(self.shown.view.camera, 4 / 3, target=target), self.server.initial_camera
        first.position, first.look_at, first.up, first.fov = seen.position, seen.look_at, seen.up, seen.fov

        @self.gizmo.on_update  # type: ignore[untyped-decorator]
        async def _(event: Any) -> None:  # in the order in which they come
            handle = event.target
            self.frame.wxyz, self.frame.position = handle.wxyz, handle.position
            pose = pose_of_gizmo(handle.wxyz, handle.position, self.model.center)
            if event.phase == "start":
                self._later(self._remember)
            elif event.phase == "end":
                self._later(self.move, pose, remember=False)

    def _build_controls(self) -> None:
        gui, c = self.server.gui, self.controls
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        c.text = gui.add_markdown("")
        if self.pictures.count > 1:
            c.picture = gui.add_slider("Frame", min=0, max=self.pictures.count - 1, step=1, initial_value=0)
            self._on(c.picture, self._ask_for_picture)
        c.candidate = gui.add_dropdown("Pose", [each.label for each in self.shown.candidates])
        self._on(c.candidate, lambda value: self._later(self._choose_label, value))
        c.step = gui.add_slider("Iteration", min=0, max=1, step=1, initial_value=1)
        self._on(c.step, lambda value: self._later(self.step_to, int(value)))
        c.refine = gui.add_button("Refine from here", disabled=self._refiner is None)
        c.undo = gui.add_button("Undo", disabled=True)
        c.save = gui.add_button("Save pose")
        c.message = gui.add_markdown("")
        with gui.add_folder("Display"):
            c.opacity = gui.add_slider(
                "Opacity", min=0.0, max=1.0, step=0.2, initial_value=_level(self.options.opacity)
            )
            c.gizmo = gui.add_checkbox("Handles", True)
            c.zoom = gui.add_slider("Zoom", min=1.0, max=MOST_ZOOM, step=0.1, initial_value=1.0)
            c.reset = gui.add_button("Reset view")
        self._on(c.opacity, self._set_opacity)
        self._on(c.gizmo, lambda value: setattr(self.gizmo, "visible", bool(value)))
        self._on(c.zoom, lambda _: self.look_through())
        for button, work in ((c.refine, self.refine), (c.undo, self.undo), (c.save, self.save)):
            button.on_click(lambda _, work=work: self._later(work))
        c.reset.on_click(lambda _: self.look_through())

    def _on(self, control: Any, work: Callable[[Any], Any]) -> None:
        """Do something with a control's value when a person changes it, not when the program does."""

        @control.on_update  # type: ignore[untyped-decorator]
        def _(event: Any) -> None:
            if event.client_id is not None:
                work(control.value)

    def _later(self, work: Callable[..., Any], *arguments: Any, **named: Any) -> Future[None]:
        """Do something in the one thread; what goes wrong is said on the page."""

        def run() -> None:
            try:
                work(*arguments, **named)
            except PosekitError as error:
                self._say(str(error))
            except Exception as error:
                log.exception("the page could not do what was asked")
                self._say(f"{type(error).__name__}: {error}")

        with suppress(RuntimeError):  # closed meanwhile
            return self._worker.submit(run)
        return Future()

    def wait(self) -> None:
        """Until all that was asked for so far is done."""
        self._worker.submit(lambda: None).result()

    def _remember(self) -> None:
        self.history.append(self.shown)

    def _become(self, shown: Shown, *, remember: bool = True) -> None:
        if remember:
            self._remember()
        self.shown = shown
        self._show()

    def _choose_label(self, label: str) -> None:
        labels = [each.label for each in self.shown.candidates]
        if label in labels:
            self.choose(labels.index(label))

    def _ask_for_picture(self, index: float) -> None:
        self._wanted = int(index)

        def load() -> None:  # only the last one that was asked for, while a person pulls the slider
            if self.shown.index != self._wanted:
                self._load_picture(self._wanted)

        self._later(load)

    def _load_picture(self, index: int) -> None:
        self.shown = first_shown(self.pictures, index, self.model, self.shown.T_cam_obj)
        self.history.clear()
        self._show_photograph()
        self._show()

    def _show(self) -> None:
        """Bring the page to what is shown."""
        c, shown = self.controls, self.shown
        wxyz, position = gizmo_of_pose(shown.T_cam_obj, self.model.center)
        if position[2] + self.model.diameter > 0.9 * self._far:
            self._show_photograph()
        with self.server.atomic():
            for handle in (self.gizmo, self.frame):
                handle.wxyz, handle.position = wxyz, position
            c.text.content = describe_shown(shown, self.pictures.label(shown.index))
            c.candidate.options = tuple(each.label for each in shown.candidates)
            c.candidate.value = shown.chosen.label
            steps = len(shown.chosen.steps)
            c.step.max = max(steps, 1)
            c.step.value = shown.step if steps else 1
            c.step.disabled = steps == 0
            c.undo.disabled = not self.history
            if c.picture is not None:
                c.picture.value = self._wanted
        self._say("")

    def _show_photograph(self) -> None:
        """The photograph of the picture that is shown, behind the object."""
        view = self.shown.view
        center = self.shown.T_cam_obj.apply(self.model.center)
        self._far = BEHIND * (float(np.linalg.norm(center)) + self.model.diameter)
        plane, image = photograph_plane(view.camera, self._far), _drawn_image(view.image)
        old = self._photograph
        if old is not None and (old.render_width, old.render_height) == (plane.width, plane.height):
            old.image = image
            return
        self._photograph = self.server.scene.add_image(
            "/photograph", image, plane.width, plane.height, position=plane.position,
            format="jpeg", jpeg_quality=QUALITY, cast_shadow=False, receive_shadow=False,
        )  # fmt: skip

    def _set_opacity(self, value: float) -> None:
        chosen = _level(value)
        for level, mesh in self._meshes.items():
            mesh.visible = level == chosen

    def _busy(self, busy: bool) -> None:
        c = self.controls
        c.refine.disabled = busy or self._refiner is None
        c.undo.disabled = busy or not self.history
        c.save.disabled = busy
        self.gizmo.visible = not busy and bool(c.gizmo.value)

    def _say(self, text: str) -> None:
        self.controls.message.content = _plain(text)

    def _connected(self, client: Any) -> None:
        self._place_camera(client)
        self._aspects[client.client_id] = client.camera.aspect

        @client.camera.on_update  # type: ignore[untyped-decorator]
        def _(camera: Any) -> None:
            if abs(self._aspects.get(client.client_id, 0.0) - camera.aspect) > 1e-3:  # the window was resized
                self._aspects[client.client_id] = camera.aspect
                self._place_camera(client)

    def _place_camera(self, client: Any) -> None:
        zoom = float(self.controls.zoom.value)
        target = self.shown.T_cam_obj.apply(self.model.center)
        seen, camera = page_camera(self.shown.view.camera, client.camera.aspect, zoom, target), client.camera
        with client.atomic():
            camera.up_direction = seen.up
            camera.position = seen.position
            camera.look_at = seen.look_at
            camera.fov = seen.fov


def _level(opacity: float) -> float:
    """The nearest of LEVELS."""
    return min(LEVELS, key=lambda level: abs(level - opacity))


def _drawn_image(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A photograph as the page draws it: not larger than is useful there."""
    height, width = image.shape[:2]
    scale = MOST_PIXELS / max(height, width)
    if scale >= 1:
        return image
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)

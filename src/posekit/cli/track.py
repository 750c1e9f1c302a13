"""``posekit track``: objects followed through a video."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any, Literal

import typer

from posekit.cli.options import (
    INPUT,
    LOOP,
    NOT_RELIABLE,
    OUTPUT,
    CameraOption,
    DetectorOption,
    DeviceOption,
    ForceOption,
    FormatOption,
    JsonOption,
    ModelsOption,
    OutOption,
    PresetOption,
    RequireReliableOption,
    RerunOption,
    SymmetryOption,
    ThreadsOption,
    UnitsOption,
    WeightsOption,
    use_threads,
)
from posekit.cli.progress import progress_bar

if TYPE_CHECKING:
    from posekit.cli.output import Destination
    from posekit.io.pose_formats import NamedPose
    from posekit.io.video import Frame, Frames, VideoWriter
    from posekit.tracking.group import TrackerGroup
    from posekit.tracking.tracker import Tracked, Tracker

RECORDING = "track.rrd"
COLUMNS = "scene_id,im_id,obj_id,score,R,t,time"


def track(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help="A video file, a folder or glob of pictures, a BOP scene, or the number of a camera (0).",
        ),
    ],
    model: ModelsOption,
    camera: CameraOption = None,
    pose: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="Pose in the first frame, in a file as refine --pose takes it; one for each --model, in the same "
            "order. Default: the object is detected.",
            rich_help_panel=INPUT,
        ),
    ] = None,
    box: Annotated[
        str | None,
        typer.Option(
            metavar="X0,Y0,X1,Y1", help="Box around the object in the first frame, pixels.", rich_help_panel=INPUT
        ),
    ] = None,
    mask: Annotated[
        Path | None,
        typer.Option(metavar="PNG", help="Mask of the object in the first frame.", rich_help_panel=INPUT),
    ] = None,
    detector: DetectorOption = None,
    units: UnitsOption = "auto",
    symmetry: SymmetryOption = None,
    preset: PresetOption = "lite",
    weights: WeightsOption = None,
    iterations: Annotated[
        int, typer.Option(help="Largest number of network passes for each frame.", rich_help_panel=LOOP)
    ] = 1,
    restart_angle: Annotated[
        float,
        typer.Option(
            metavar="DEGREES",
            help="Predicted rotation error above which the object is detected anew.",
            rich_help_panel=LOOP,
        ),
    ] = 25.0,
    still_angle: Annotated[
        float,
        typer.Option(
            metavar="DEGREES",
            help="Predicted rotation error below which the network does not move the pose (the paper: 2).",
            rich_help_panel=LOOP,
        ),
    ] = 0.0,
    runtime: Annotated[
        Literal["openvino", "torch"], typer.Option(help="Library that runs the network.", rich_help_panel=LOOP)
    ] = "openvino",
    threads: ThreadsOption = None,
    device: DeviceOption = "auto",
    overlay: Annotated[
        bool, typer.Option(help="Write a video with the poses drawn in, overlay.mp4.", rich_help_panel=OUTPUT)
    ] = True,
    rerun: RerunOption = False,
    live: Annotated[
        bool,
        typer.Option(
            "--live",
            help="For cameras: skip frames that come while one is worked on, and search a lost object beside the loop.",
            rich_help_panel=OUTPUT,
        ),
    ] = False,
    frames: Annotated[
        int | None, typer.Option(min=1, help="Stop after so many frames.", rich_help_panel=OUTPUT)
    ] = None,
    out: OutOption = None,
    force: ForceOption = False,
    json: JsonOption = None,
    format_: FormatOption = None,
    require_reliable: RequireReliableOption = False,
) -> None:
    """Follow objects through a video: poses as they come, and an overlay to look at."""
    from posekit.batch.meshes import load_meshes
    from posekit.batch.prompts import prompt_for
    from posekit.cli.output import Destination
    from posekit.detect.prompts import Detector, Successive
    from posekit.errors import ImageError, PromptError
    from posekit.io.pose_formats import pose_files

    default = Path("posekit-out") / f"{Path(source).stem or 'camera'}-track"
    destination = Destination.chosen(out, default, force, json, format_ or (), RECORDING if rerun else None)

    from posekit.estimate.estimator import Estimators
    from posekit.io.load import load_pose
    from posekit.io.video import ReadAhead, open_frames
    from posekit.tracking.tracker import TRACKED, UNCERTAIN, TrackConfig, Tracker

    if pose and len(pose) != len(model):
        raise PromptError(f"{len(pose)} --pose for {len(model)} --model: give one for each, in their order, or none.")
    use_threads(threads)
    config = TrackConfig(
        restart_angle, still_angle, iterations=iterations, runtime=runtime, search_beside=live
    )  # without --live a search is waited for: the results do not depend on the machine's speed
    starts = [load_pose(path) for path in pose] if pose else [None] * len(model)
    meshes = load_meshes(model, units, symmetry)
    sequence = ReadAhead(open_frames(source, camera), latest=live)
    prompt = prompt_for(box, mask, "none")
    if prompt is not None and (pose or len(model) > 1):
        raise PromptError("--box and --mask say where one --model is in the first frame: pass --pose for several.")

    def make_finder() -> Detector:
        from posekit.detect.novel import make_detector

        return make_detector(detector, meshes, doubtful=True)[0]

    finder = Successive(prompt, make_finder)
    estimators = Estimators(preset=preset, weights=weights, device=device)
    trackers = [
        Tracker(mesh, pose=start, detector=finder, config=config, estimator=estimators(mesh))
        for mesh, start in zip(meshes, starts, strict=True)
    ]
    counts = _run(trackers, sequence, destination, overlay, frames, keep=bool(format_))
    if destination.folder is not None:
        for kind in dict.fromkeys(format_ or ()):
            for name, text in pose_files(kind, counts.poses).items():
                counts.files.append(destination.folder.write(name, text))
    destination.say(f"reliable: {counts.reliable} of {counts.used * len(trackers)} poses")
    told = [f"{count} {state}" for state, count in counts.states.items()]
    destination.say(", ".join([*told, f"{counts.restarts} found by a search"] if counts.restarts else told))
    if counts.problems:
        typer.echo(f"{len(counts.problems)} frames could not be used; the first: {counts.problems[0]}", err=True)
    for path in counts.files:
        destination.say(f"wrote: {path}")
    if not counts.used:
        raise ImageError(
            f"not one frame of {source} could be used: {counts.problems[0] if counts.problems else 'it is empty'}."
        )
    if not counts.states.get(TRACKED, 0) + counts.states.get(UNCERTAIN, 0):
        names = ", ".join(m.name for m in meshes)
        raise PromptError(
            f"{names} was found in none of {counts.used} frames: pass --box, --mask or --pose for the first one."
        )
    if require_reliable and counts.reliable < counts.used * len(trackers):
        raise typer.Exit(NOT_RELIABLE)


class _Counts:
    """Counts of frames and of poses."""

    def __init__(self) -> None:
        self.used = 0
        self.reliable = 0
        self.states: dict[str, int] = {}
        self.restarts = 0
        self.problems: list[str] = []
        self.poses: list[NamedPose] = []
        self.files: list[Path] = []


def _run(
    trackers: Sequence[Tracker],
    sequence: Frames,
    destination: Destination,
    overlay: bool,
    most: int | None,
    *,
    keep: bool,
) -> _Counts:
    """Track every frame, and write each as soon as it is done: a killed run keeps its frames. keep: all poses, for
    formats that are written at the end."""
    from posekit.cli.output import named_pose
    from posekit.tracking.group import TrackerGroup

    group = TrackerGroup(trackers)
    counts, folder = _Counts(), None if destination.folder is None else destination.folder.path
    with ExitStack() as stack:
        lines = _Lines(destination, stack, counts)
        writer = record = None
        if folder is not None and overlay:
            from posekit.io.video import VideoWriter

            writer = stack.enter_context(VideoWriter(folder / "overlay.mp4", sequence.rate))
        if folder is not None and destination.recording is not None:
            record = stack.enter_context(_recorder(folder / destination.recording, trackers))
        show = stack.enter_context(_bar(sequence))
        for done, frame in enumerate(sequence):
            if most is not None and done >= most:
                break
            started = time.perf_counter()
            results = _step(group, frame, counts)
            seconds = time.perf_counter() - started
            for k, (tracker, result) in enumerate(zip(trackers, results, strict=True)):
                lines.write(frame, tracker.model.name, k, result, seconds)
                if keep and result.estimate is not None:
                    counts.poses.append(named_pose(result.estimate, frame.number, frame.seconds))
            if record is not None:
                record(frame, results)
            if writer is not None and frame.image is not None:
                _draw(writer, frame, trackers, results)
            show(seconds, results)
    if folder is not None:
        counts.files += [folder / "overlay.mp4"] if overlay and counts.used else []
        counts.files += [] if destination.recording is None else [folder / destination.recording]
    return counts


class _Lines:
    """Where each frame's poses go as soon as they are known: poses.jsonl and poses.csv in the folder, and what
    ``--json`` names. Raises OutputError where they cannot be written."""

    def __init__(self, destination: Destination, stack: ExitStack, counts: _Counts) -> None:
        from posekit.errors import OutputError

        self.table: IO[str] | None = None
        self.files: list[IO[str]] = []
        paths = [] if destination.json in (None, "-") else [Path(str(destination.json))]
        self.aloud = destination.json == "-"
        try:
            if destination.folder is not None:
                folder = destination.folder.path
                folder.mkdir(parents=True, exist_ok=True)
                paths.append(folder / "poses.jsonl")
                counts.files.append(folder / "poses.csv")
                self.table = stack.enter_context(counts.files[-1].open("w", encoding="utf-8", buffering=1))
                self.table.write(COLUMNS + "\n")
            self.files = [stack.enter_context(path.open("w", encoding="utf-8", buffering=1)) for path in paths]
        except OSError as error:
            raise OutputError(f"{error.filename} cannot be written: {error.strerror}.") from error
        counts.files = [*reversed(paths), *counts.files]

    def write(self, frame: Frame, name: str, k: int, result: Tracked, seconds: float) -> None:
        """The k-th mesh in a frame."""
        line = _line(frame, name, result)
        for file in self.files:
            file.write(line)
        if self.aloud:
            typer.echo(line, nl=False)
        if self.table is not None and result.estimate is not None:
            self.table.write(_row(frame, _number(name, k), result, seconds) + "\n")


def _step(group: TrackerGroup, frame: Frame, counts: _Counts) -> list[Tracked]:
    from posekit.tracking.tracker import LOST, Tracked

    if frame.image is None or frame.camera is None:
        counts.problems.append(frame.problem)
        results = [Tracked(LOST) for _ in group.trackers]
    else:
        counts.used += 1
        results = group.step(frame.image, frame.camera, frame.valid)
    for result in results:
        counts.states[result.state] = counts.states.get(result.state, 0) + 1
        counts.restarts += result.restarted
        counts.reliable += result.reliable
    return results


def _state(result: Tracked) -> str:
    """In words, for people: a restart is said, too."""
    return f"{result.state} (restarted)" if result.restarted else result.state


def _doubt(result: Tracked) -> str:
    """What is added where a pose is tracked and still not reliable; the other states say it themselves."""
    from posekit.tracking.tracker import TRACKED

    return " NOT RELIABLE" if result.state == TRACKED and not result.reliable else ""


def _line(frame: Frame, name: str, result: Tracked) -> str:
    from posekit.results import FRAME_SCHEMA, document_to_json

    pose, angle = result.T_cam_obj, result.angle
    entry: dict[str, Any] = {
        "frame": frame.number,
        **({"file": frame.file} if frame.file else {}),
        "model": name,
        "state": result.state,
        "restarted": result.restarted,
        "reliable": result.reliable,
        "T_cam_obj": None if pose is None else pose.matrix.tolist(),
        "angle_deg": None if angle is None else math.degrees(angle),
        "score": None if result.estimate is None else result.estimate.score,
    }
    if frame.seconds is not None:
        entry["seconds"] = frame.seconds
    if frame.problem:
        entry["problem"] = frame.problem
    return document_to_json(FRAME_SCHEMA, entry, indent=None)


def _row(frame: Frame, obj_id: int, result: Tracked, seconds: float) -> str:
    """BOP's columns, millimetres."""
    assert result.estimate is not None
    pose = result.estimate.T_cam_obj
    R = " ".join(repr(float(v)) for v in pose.R.ravel())
    t = " ".join(repr(float(v) * 1000.0) for v in pose.t)
    return f"{frame.scene},{frame.number},{obj_id},{result.estimate.score!r},{R},{t},{seconds!r}"


def _number(name: str, k: int) -> int:
    """The object's number as BOP has it in the mesh's name, else its place among the meshes."""
    from posekit.detect.external import model_number

    found = model_number(name)
    return k + 1 if found is None else found


def _draw(writer: VideoWriter, frame: Frame, trackers: Sequence[Tracker], results: Sequence[Tracked]) -> None:
    from posekit.tracking.tracker import UNCERTAIN
    from posekit.visualise import draw
    from posekit.visualise.figures import outlined

    assert frame.image is not None and frame.camera is not None
    picture, told = frame.image, []
    for tracker, result in zip(trackers, results, strict=True):
        angle = "" if result.angle is None else f" {math.degrees(result.angle):.1f} degrees"
        told.append(f"{tracker.model.name}: {_state(result)}{angle}{_doubt(result)}")
        if result.T_cam_obj is None:
            continue
        colour = draw.YELLOW if result.state == UNCERTAIN else draw.GREEN if result.reliable else draw.RED
        picture = outlined(tracker.renderer, picture, frame.camera, tracker.model, result.T_cam_obj, colour)
        length = 0.6 * float(tracker.model.extents.max())
        picture = draw.axes(picture, frame.camera, result.T_cam_obj, length, tracker.model.center)
    writer.write(draw.caption(picture, f"{frame.number}  " + "  ".join(told)))


@contextmanager
def _recorder(path: Path, trackers: Sequence[Tracker]) -> Iterator[Any]:
    """What is called with each frame and its results."""
    from posekit.visualise.recording import Recorder

    with Recorder(path, [tracker.model for tracker in trackers]) as recorder:

        def record(frame: Frame, results: Sequence[Tracked]) -> None:
            found = [(_state(result), result.T_cam_obj, result.angle) for result in results]
            recorder.frame(frame.number, frame.image, frame.camera, found)

        yield record


@contextmanager
def _bar(sequence: Frames) -> Iterator[Any]:
    """Frames a second, angle and state, live on a terminal."""
    with progress_bar("count", "text", total=sequence.count, stage="tracking") as update:
        mean = 0.0

        def show(seconds: float, results: Sequence[Tracked]) -> None:
            nonlocal mean
            mean = seconds if not mean else 0.9 * mean + 0.1 * seconds
            states = " ".join(
                r.state if r.angle is None else f"{_state(r)} {math.degrees(r.angle):.1f} deg" for r in results
            )
            update(advance=1, description=f"{1 / max(mean, 1e-6):.1f} frames/s  {states}")

        yield show

"""``posekit track``: objects followed through a video."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

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
    ModelsOption,
    OutOption,
    PresetOption,
    RequireReliableOption,
    SymmetryOption,
    ThreadsOption,
    UnitsOption,
    WeightsOption,
    use_threads,
)
from posekit.cli.progress import progress_bar

if TYPE_CHECKING:
    from posekit.io.pose_formats import NamedPose
    from posekit.io.video import Frame, Frames, VideoWriter
    from posekit.tracking.tracker import Tracked, Tracker

COLUMNS = "scene_id,im_id,obj_id,score,R,t,time"


def track(
    source: Annotated[
        str, typer.Argument(help="A video, a folder or glob of pictures, a BOP scene, or a camera's number.")
    ],
    model: ModelsOption,
    camera: CameraOption = None,
    pose: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE", help="First pose, as refine takes it; once for each mesh.", rich_help_panel=INPUT),
    ] = None,
    detector: DetectorOption = None,
    units: UnitsOption = "auto",
    symmetry: SymmetryOption = None,
    preset: PresetOption = "lite",
    weights: WeightsOption = None,
    iterations: Annotated[int, typer.Option(help="Comparisons of a frame at most.", rich_help_panel=LOOP)] = 1,
    restart_angle: Annotated[
        float, typer.Option(metavar="DEGREES", help="Predicted angle that restarts.", rich_help_panel=LOOP)
    ] = 25.0,
    still_angle: Annotated[
        float,
        typer.Option(
            metavar="DEGREES",
            help="Predicted angle below which the network leaves the pose as it is; the paper has 2.",
            rich_help_panel=LOOP,
        ),
    ] = 0.0,
    runtime: Annotated[
        Literal["openvino", "torch"], typer.Option(help="Of the network.", rich_help_panel=LOOP)
    ] = "openvino",
    threads: ThreadsOption = None,
    device: DeviceOption = "auto",
    overlay: Annotated[bool, typer.Option(help="Write overlay.mp4.", rich_help_panel=OUTPUT)] = True,
    rerun: Annotated[
        bool, typer.Option("--rerun", help="Write track.rrd for the Rerun viewer.", rich_help_panel=OUTPUT)
    ] = False,
    live: Annotated[
        bool, typer.Option("--live", help="Drop frames to keep up with a camera.", rich_help_panel=OUTPUT)
    ] = False,
    frames: Annotated[int | None, typer.Option(min=1, help="Frames at most.", rich_help_panel=OUTPUT)] = None,
    out: OutOption = None,
    force: ForceOption = False,
    format_: FormatOption = None,
    require_reliable: RequireReliableOption = False,
) -> None:
    """Follow objects through a video: poses as they come, and an overlay to look at."""
    from posekit.cli.output import OutputFolder
    from posekit.io.pose_formats import check_formats, pose_files

    check_formats(format_ or ())

    folder = OutputFolder.chosen(out, Path("posekit-out") / f"{Path(source).stem or 'camera'}-track", force)

    from posekit.errors import ImageError, PromptError
    from posekit.estimate.estimator import Estimators
    from posekit.io.load import load_pose
    from posekit.io.video import ReadAhead, open_frames
    from posekit.mesh.model import ObjectModel
    from posekit.tracking.tracker import TrackConfig, Tracker

    if pose and len(pose) != len(model):
        raise PromptError(f"{len(pose)} --pose for {len(model)} --model: give one for each, in their order, or none.")
    use_threads(threads)
    config = TrackConfig(restart_angle, still_angle, iterations=iterations, runtime=runtime)
    starts = [load_pose(path) for path in pose] if pose else [None] * len(model)
    meshes = [ObjectModel.load(path, units=units, symmetry=symmetry) for path in model]
    sequence = ReadAhead(open_frames(source, camera), latest=live)
    finder = None
    if not pose or detector is not None:
        from posekit.detect.novel import make_detector

        finder, _ = make_detector(detector, meshes, doubtful=True)
    estimators = Estimators(preset=preset, weights=weights, device=device)
    trackers = [
        Tracker(mesh, pose=start, detector=finder, config=config, estimator=estimators(mesh))
        for mesh, start in zip(meshes, starts, strict=True)
    ]
    counts = _run(trackers, sequence, folder, overlay, rerun, frames, keep=bool(format_))
    for kind in dict.fromkeys(format_ or ()):
        for name, text in pose_files(kind, counts.poses).items():
            counts.files.append(folder.write(name, text).name)
    typer.echo(f"reliable: {counts.reliable} of {counts.used * len(trackers)} poses")
    typer.echo(", ".join(f"{count} {state}" for state, count in counts.states.items()))
    if counts.problems:
        typer.echo(f"{len(counts.problems)} frames could not be used; the first: {counts.problems[0]}", err=True)
    for name in counts.files:
        typer.echo(f"wrote: {folder.path / name}")
    if not counts.used:
        raise ImageError(
            f"not one frame of {source} could be used: {counts.problems[0] if counts.problems else 'it is empty'}."
        )
    if not counts.states.get("tracked", 0) + counts.states.get("restarted", 0):
        names = ", ".join(m.name for m in meshes)
        raise PromptError(f"{names} was found in none of {counts.used} frames: pass --pose FILE for the first one.")
    if require_reliable and counts.reliable < counts.used * len(trackers):
        raise typer.Exit(NOT_RELIABLE)


class _Counts:
    """Counts of frames and of poses."""

    def __init__(self) -> None:
        self.used = 0
        self.reliable = 0
        self.states: dict[str, int] = {}
        self.problems: list[str] = []
        self.poses: list[NamedPose] = []
        self.files: list[str] = ["poses.jsonl", "poses.csv"]


def _run(
    trackers: Sequence[Tracker],
    sequence: Frames,
    folder: Any,
    overlay: bool,
    rerun: bool,
    most: int | None,
    *,
    keep: bool,
) -> _Counts:
    """Track every frame, and write each as soon as it is done: a killed run keeps its frames. keep: all poses, for
    formats that are written at the end."""
    from posekit.cli.output import named_pose
    from posekit.errors import OutputError
    from posekit.io.video import VideoWriter

    counts = _Counts()
    try:
        folder.path.mkdir(parents=True, exist_ok=True)
        lines, table = ((folder.path / name).open("w", encoding="utf-8", buffering=1) for name in counts.files)
    except OSError as error:
        raise OutputError(f"the folder {folder.path} cannot be written: {error.strerror}.") from error
    with (
        lines,
        table,
        VideoWriter(folder.path / "overlay.mp4", sequence.rate) as writer,
        _recorder(folder.path / "track.rrd", trackers, rerun) as record,
        _bar(sequence) as show,
    ):
        table.write(COLUMNS + "\n")
        for done, frame in enumerate(sequence):
            if most is not None and done >= most:
                break
            started = time.perf_counter()
            results = _step(trackers, frame, counts)
            seconds = time.perf_counter() - started
            for k, (tracker, result) in enumerate(zip(trackers, results, strict=True)):
                lines.write(_line(frame, tracker.model.name, result) + "\n")
                if result.estimate is not None:
                    if keep:
                        counts.poses.append(named_pose(result.estimate, frame.number, frame.seconds))
                    table.write(_row(frame, _number(tracker.model.name, k), result, seconds) + "\n")
            record(frame, results)
            if overlay and frame.image is not None:
                _draw(writer, frame, trackers, results)
            show(seconds, results)
    if overlay and counts.used:
        counts.files.append("overlay.mp4")
    if rerun:
        counts.files.append("track.rrd")
    return counts


def _step(trackers: Sequence[Tracker], frame: Frame, counts: _Counts) -> list[Tracked]:
    from posekit.tracking.tracker import LOST, Tracked

    if frame.image is None or frame.camera is None:
        counts.problems.append(frame.problem)
        results = [Tracked(LOST) for _ in trackers]
    else:
        counts.used += 1
        results = [tracker.step(frame.image, frame.camera, frame.valid) for tracker in trackers]
    for result in results:
        counts.states[result.state] = counts.states.get(result.state, 0) + 1
        counts.reliable += result.reliable
    return results


def _line(frame: Frame, name: str, result: Tracked) -> str:
    pose, angle = result.T_cam_obj, result.angle
    entry: dict[str, Any] = {
        "frame": frame.number,
        **({"file": frame.file} if frame.file else {}),
        "model": name,
        "state": result.state,
        "reliable": result.reliable,
        "T_cam_obj": None if pose is None else pose.matrix.tolist(),
        "angle_deg": None if angle is None else math.degrees(angle),
        "score": None if result.estimate is None else result.estimate.score,
    }
    if frame.seconds is not None:
        entry["seconds"] = frame.seconds
    if frame.problem:
        entry["problem"] = frame.problem
    return json.dumps(entry, allow_nan=False)


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
    from posekit.visualise import draw
    from posekit.visualise.figures import outlined

    assert frame.image is not None and frame.camera is not None
    picture, told = frame.image, []
    for tracker, result in zip(trackers, results, strict=True):
        angle = "" if result.angle is None else f" {math.degrees(result.angle):.1f} degrees"
        told.append(f"{tracker.model.name}: {result.state}{angle}{'' if result.reliable else ' NOT RELIABLE'}")
        if result.T_cam_obj is None:
            continue
        colour = draw.GREEN if result.reliable else draw.RED
        picture = outlined(tracker.renderer, picture, frame.camera, tracker.model, result.T_cam_obj, colour)
        length = 0.6 * float(tracker.model.extents.max())
        picture = draw.axes(picture, frame.camera, result.T_cam_obj, length, tracker.model.center)
    writer.write(draw.caption(picture, f"{frame.number}  " + "  ".join(told)))


@contextmanager
def _recorder(path: Path, trackers: Sequence[Tracker], wanted: bool) -> Iterator[Any]:
    """What is called with each frame and its results."""
    if not wanted:
        yield lambda *_: None
        return
    from posekit.visualise.recording import Recorder

    with Recorder(path, [tracker.model for tracker in trackers]) as recorder:

        def record(frame: Frame, results: Sequence[Tracked]) -> None:
            found = [(result.state, result.T_cam_obj, result.angle) for result in results]
            recorder.frame(frame.number, frame.image, frame.camera, found)

        yield record


@contextmanager
def _bar(sequence: Frames) -> Iterator[Any]:
    """Frames a second, angle and state, live on a terminal."""
    with progress_bar("count", "text", total=sequence.count) as update:
        mean = 0.0

        def show(seconds: float, results: Sequence[Tracked]) -> None:
            nonlocal mean
            mean = seconds if not mean else 0.9 * mean + 0.1 * seconds
            states = " ".join(
                r.state if r.angle is None else f"{r.state} {math.degrees(r.angle):.1f} deg" for r in results
            )
            update(advance=1, description=f"{1 / max(mean, 1e-6):.1f} frames/s  {states}")

        yield show

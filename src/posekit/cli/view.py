"""``posekit view``: a page to look at poses and to correct them by hand."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from posekit.cli.options import (
    INPUT,
    CameraOption,
    DeviceOption,
    ForceOption,
    OutOption,
    PresetOption,
    SymmetryOption,
    ThreadsOption,
    UnitsOption,
    WeightsOption,
    use_threads,
)

if TYPE_CHECKING:
    from posekit.geometry import Pose
    from posekit.mesh.model import ObjectModel
    from posekit.results import Estimate
    from posekit.view import View
    from posekit.viewer import Pictures, Refiner

PAGE = "Page"
RESULT, TRACK = ".json", ".jsonl"


def view(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="RESULT|IMAGE",
            help="A result.json or a saved pose, a track's poses.jsonl, or a photograph.",
            show_default=False,
        ),
    ],
    model: Annotated[
        Path | None,
        typer.Option(
            "--model",
            "-m",
            metavar="MESH",
            help="PLY, OBJ, GLB or STL; by default the result's.",
            rich_help_panel=INPUT,
        ),
    ] = None,
    picture: Annotated[
        str | None,
        typer.Option(
            metavar="FILE",
            help="Of a result, its photograph where it is not where the result says; of a track, what was tracked.",
            rich_help_panel=INPUT,
        ),
    ] = None,
    pose: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A photograph's first pose, as refine takes it.", rich_help_panel=INPUT),
    ] = None,
    camera: CameraOption = None,
    units: UnitsOption = "auto",
    symmetry: SymmetryOption = None,
    preset: PresetOption = "lite",
    weights: WeightsOption = None,
    threads: ThreadsOption = None,
    device: DeviceOption = "auto",
    port: Annotated[
        int,
        typer.Option(min=0, max=65535, help="Of the page; where it is taken, the next free one.", rich_help_panel=PAGE),
    ] = 8080,
    opacity: Annotated[float, typer.Option(min=0, max=1, help="Of the mesh at first.", rich_help_panel=PAGE)] = 0.6,
    browser: Annotated[
        bool, typer.Option("--browser", help="Open the page in the browser.", rich_help_panel=PAGE)
    ] = False,
    out: OutOption = None,
    force: ForceOption = False,
) -> None:
    """Look at a pose over its photograph in the browser, correct it by hand, refine it from there, and save it."""
    from posekit.cli.output import OutputFolder
    from posekit.viewer import PoseViewer, ViewerOptions, require_viser

    require_viser()
    folder = OutputFolder.chosen(out, Path("posekit-out") / f"{source.stem}-view", force)
    use_threads(threads)
    mesh, pictures, about = _looked_at(source, model, picture, pose, camera, units, symmetry)

    with PoseViewer(
        mesh,
        pictures,
        save=folder.write,
        refiner=_refiner(mesh, preset, weights, device),
        about=about,
        options=ViewerOptions(port, opacity),
    ) as page:
        typer.echo(f"page: {page.url} (for this machine alone; Ctrl-C ends it)")
        typer.echo(f"Save pose writes into: {folder.path}")
        if browser:
            typer.launch(page.url)
        _wait()


def _wait() -> None:
    """Until Ctrl-C, which is how a page ends."""
    with suppress(KeyboardInterrupt):
        threading.Event().wait()


def _refiner(mesh: ObjectModel, preset: str, weights: Path | None, device: str) -> Refiner:
    """Refinement as `posekit refine` does it; the networks are loaded when it is first asked for, in its thread."""
    made: list[Callable[[View, Pose], Estimate]] = []

    def refine(view: View, T_cam_obj: Pose) -> Estimate:
        if not made:
            from posekit.estimate import PoseEstimator

            made.append(PoseEstimator(mesh, preset=preset, weights=weights, device=device).refine)
        return made[0](view, T_cam_obj)

    return refine


def _looked_at(
    source: Path,
    model: Path | None,
    picture: str | None,
    pose: Path | None,
    camera: str | None,
    units: str,
    symmetry: str | None,
) -> tuple[ObjectModel, Pictures, dict[str, object]]:
    """The mesh, the pictures with their poses, and what a saved pose says of them."""
    from posekit.errors import ConfigError, PromptError
    from posekit.io.load import load_pose, load_view
    from posekit.io.video import open_frames
    from posekit.mesh.model import ObjectModel
    from posekit.viewer import START, Candidate, Photograph, TrackedVideo, read_result, read_track, view_of

    kind = source.suffix.lower()
    if pose is not None and kind in (RESULT, TRACK):
        raise ConfigError(f"--pose is for a photograph; {source.name} has its own poses.")
    if kind == TRACK:
        if picture is None or model is None:
            raise ConfigError(
                f"{source.name} names neither its video nor its mesh: give --picture VIDEO, as track took it, and "
                "--model MESH."
            )
        mesh = ObjectModel.load(model, units=units, symmetry=symmetry)
        tracked = read_track(source, mesh.name)
        return mesh, TrackedVideo(open_frames(picture, camera), tracked), {"image": picture, "mesh": model}
    if kind == RESULT:
        result = read_result(source)
        file = model or (result.meshes[0] if result.meshes else None)
        photo = None if picture is None and result.image is None else Path(picture or str(result.image))
        if file is None or photo is None:
            raise PromptError(
                f"{source.name} does not say which {'mesh' if file is None else 'photograph'} it is of: give "
                f"{'--model MESH' if file is None else '--picture FILE'}."
            )
        if not photo.is_file() and picture is None:
            raise PromptError(
                f"{source.name} is of the photograph {photo}, which is not there: give --picture FILE, or run this in "
                "the folder in which it was made."
            )
        mesh = ObjectModel.load(file, units=units, symmetry=symmetry)
        seen = view_of(photo, result.camera) if camera is None and result.camera else load_view(photo, camera)
        return mesh, Photograph(seen, photo.name, result.of(mesh.name)), {"image": photo, "mesh": file}
    if model is None:
        raise ConfigError(f"what is to be seen in {source.name}? Give --model MESH.")
    if picture is not None:
        raise ConfigError(f"--picture is for results; {source.name} is a photograph itself.")
    seen = load_view(source, camera)
    mesh = ObjectModel.load(model, units=units, symmetry=symmetry)
    known = [] if pose is None else [Candidate("given pose", load_pose(pose), pose.name, origin=START)]
    return mesh, Photograph(seen, source.name, known), {"image": source, "mesh": model}

"""``posekit detect``: where the objects are in a photograph."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from posekit.cli.options import (
    INPUT,
    OUTPUT,
    CameraOption,
    DetectorOption,
    ForceOption,
    ImageArgument,
    JsonOption,
    OutOption,
    ThreadsOption,
    UnitsOption,
    use_threads,
)

if TYPE_CHECKING:
    from posekit.mesh.model import ObjectModel
    from posekit.results import Detection
    from posekit.view import View

SCORES = "Detections"


def detect(
    image: ImageArgument,
    model: Annotated[
        list[Path] | None,
        typer.Option(
            "--model",
            "-m",
            metavar="MESH",
            help="Mesh to look for; repeat the option for several. Without it, objects of any kind are reported.",
            rich_help_panel=INPUT,
        ),
    ] = None,
    units: UnitsOption = "auto",
    camera: CameraOption = None,
    detector: DetectorOption = None,
    min_score: Annotated[
        float | None,
        typer.Option(
            min=0,
            max=1,
            help="Drop detections with a lower score (0 to 1). Default: 0.5 with --verify, else the detector's own.",
            rich_help_panel=SCORES,
        ),
    ] = None,
    max_detections: Annotated[
        int,
        typer.Option(
            min=1, help="Largest number of detections of each mesh (--detector novel only).", rich_help_panel=SCORES
        ),
    ] = 3,
    verify: Annotated[
        bool | None,
        typer.Option(
            help="Estimate a pose for each detection (about a second each) and score it by that. Default: on with "
            "--model and --detector novel.",
            rich_help_panel=SCORES,
        ),
    ] = None,
    threads: ThreadsOption = None,
    scene: Annotated[
        int | None,
        typer.Option(
            help="scene_id in bop.json. Default: the number of the scene's folder, else 0.", rich_help_panel=OUTPUT
        ),
    ] = None,
    out: OutOption = None,
    force: ForceOption = False,
    json: JsonOption = None,
) -> None:
    """Find objects in a photograph: boxes, masks and scores, as COCO, BOP or posekit JSON."""
    from posekit.cli.output import Destination
    from posekit.detect.external import to_bop, to_coco, to_document
    from posekit.detect.novel import NovelDetector, NovelOptions, make_detector
    from posekit.errors import ConfigError
    from posekit.estimate.instances import SearchOptions
    from posekit.io.load import load_view
    from posekit.mesh.model import ObjectModel
    from posekit.visualise.draw import png
    from posekit.visualise.figures import detections_overlay

    if verify and not model:
        raise ConfigError("--verify looks for poses of meshes: pass --model MESH, or leave it out.")
    destination = Destination.chosen(out, Path("posekit-out") / f"{image.stem}-detections", force, json)
    use_threads(threads)
    view = load_view(image, camera)
    meshes = [ObjectModel.load(path, units=units) for path in model or ()]
    finder, classes = make_detector(
        detector,
        meshes,
        min_score=None if verify else min_score,
        max_detections=max_detections,
        doubtful=bool(verify),
    )
    verify = isinstance(finder, NovelDetector) and bool(meshes) if verify is None else verify
    if verify and isinstance(finder, NovelDetector):  # the poses are held to the minimum score, not the detections
        finder = NovelDetector(finder.detector, finder.renderer, NovelOptions(max_detections=max_detections))
    started = time.perf_counter()
    with destination.working("detecting"):
        found = sorted(finder.detect(view, meshes), key=lambda d: -d.score)
    if verify:
        found = _verified(view, found, meshes, SearchOptions().min_score if min_score is None else min_score)
    seconds = time.perf_counter() - started
    for detection in found:
        destination.say(
            f"{detection.label or 'object'}: score {detection.score:.2f}, box "
            + ",".join(f"{v:.0f}" for v in detection.box)
        )
    if not found:
        names = ", ".join(m.name for m in meshes) or "an object"
        destination.say(f"{names} not found.")
    destination.say(f"{len(found)} detections in {seconds:.2f} s")
    folder = destination.folder
    if folder is not None:
        destination.say(f"overlay: {folder.write('overlay.png', png(detections_overlay(view, found)))}")
        destination.say(f"COCO: {folder.write('coco.json', to_coco(found, classes, image, view.camera.size))}")
        destination.say(f"BOP: {folder.write('bop.json', to_bop(found, classes, image, seconds, scene))}")
    destination.write_json(to_document(found, view, image, seconds))


def _verified(
    view: View, found: Sequence[Detection], meshes: Sequence[ObjectModel], min_score: float
) -> list[Detection]:
    """The detections that a pose confirms, best first, with the scores of the poses."""
    from posekit.estimate.estimator import Estimators
    from posekit.estimate.instances import SearchOptions, find_instances, scored_by_poses

    results = find_instances(Estimators(), view, meshes, found, SearchOptions(min_score=min_score))
    kept = [d for each in results for d in scored_by_poses(each) if d.score >= min_score]
    return sorted(kept, key=lambda d: -d.score)

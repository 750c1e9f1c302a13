"""``posekit detect``: where the objects are in a photograph."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from posekit.cli.options import (
    INPUT,
    OUTPUT,
    CameraOption,
    DetectorOption,
    ForceOption,
    ImagesArgument,
    JsonOption,
    OutOption,
    OverlayOption,
    RayOption,
    ThreadsOption,
    UnitsOption,
    WorkersOption,
    use_threads,
)

SCORES = "Detections"


def detect(
    images: ImagesArgument,
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
    overlay: OverlayOption = True,
    workers: WorkersOption = 1,
    ray: RayOption = None,
) -> None:
    """Find objects in photographs: boxes, masks and scores, as COCO, BOP or posekit JSON."""
    from posekit.batch.pictures import several
    from posekit.errors import ConfigError

    if verify and not model:
        raise ConfigError("--verify looks for poses of meshes: pass --model MESH, or leave it out.")

    from posekit.batch.jobs import Detecting, DetectJob, Meshes, PictureFiles

    job = DetectJob(Meshes(tuple(model or ()), units), camera, detector, min_score, max_detections, verify,
                    PictureFiles(overlay=overlay))  # fmt: skip
    if several(images):
        from posekit.cli.many import Wanted, work_through
        from posekit.machines import Machines

        work_through(job, images, Wanted(out, force, json, Machines(workers, ray), threads))
        return

    from posekit.cli.output import Destination
    from posekit.detect.external import to_bop, to_coco, to_document
    from posekit.io.load import load_view
    from posekit.visualise.draw import png
    from posekit.visualise.figures import detections_overlay

    [image] = images
    destination = Destination.chosen(out, Path("posekit-out") / f"{image.stem}-detections", force, json)
    use_threads(threads)
    view = load_view(image, camera)
    with destination.working("loading the detector"):
        detecting = Detecting(job)
    started = time.perf_counter()
    with destination.working("detecting") as tell:
        found = detecting.found(view, tell)
    seconds = time.perf_counter() - started
    for detection in found:
        destination.say(
            f"{detection.label or 'object'}: score {detection.score:.2f}, box "
            + ",".join(f"{v:.0f}" for v in detection.box)
        )
    if not found:
        names = ", ".join(m.name for m in detecting.meshes) or "an object"
        destination.say(f"{names} not found.")
    destination.say(f"{len(found)} detections in {seconds:.2f} s")
    folder, classes = destination.folder, detecting.classes
    if folder is not None:
        if overlay:
            destination.say(f"overlay: {folder.write('overlay.png', png(detections_overlay(view, found)))}")
        destination.say(f"COCO: {folder.write('coco.json', to_coco(found, classes, image, view.camera.size))}")
        destination.say(f"BOP: {folder.write('bop.json', to_bop(found, classes, image, seconds, scene))}")
    destination.write_json(to_document(found, view, image, seconds))

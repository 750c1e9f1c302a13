"""``posekit estimate``: photographs and meshes in, poses out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from posekit.cli.options import (
    LOOP,
    BlendOption,
    BoxOption,
    CameraOption,
    ColourEdgeOption,
    DetectionsOption,
    DetectorOption,
    DeviceOption,
    ForceOption,
    FormatOption,
    HypothesesOption,
    ImagesArgument,
    InitOption,
    IterationsOption,
    JsonOption,
    MaskEdgeOption,
    MaskFromOption,
    MaskOption,
    ModelsOption,
    OutOption,
    OverlayOption,
    PresetOption,
    RayOption,
    RequireReliableOption,
    RerunOption,
    StopAngleOption,
    StopOption,
    SymmetryOption,
    ThreadsOption,
    UnitsOption,
    UpdateOption,
    WeightsOption,
    WorkersOption,
    use_threads,
)

TopOption = Annotated[
    int,
    typer.Option(
        min=1, metavar="N",
        help="Keep the N best distinct poses of each object; the others are the result's alternatives.",
        rich_help_panel=LOOP,
    ),
]  # fmt: skip
InstancesOption = Annotated[
    int,
    typer.Option(
        min=1,
        metavar="N",
        help="Largest number of instances of each mesh to find; used where no box, mask or detections are given.",
        rich_help_panel=LOOP,
    ),
]
MinScoreOption = Annotated[
    float | None,
    typer.Option(
        min=0,
        max=1,
        help="Drop estimates with a lower score (0 to 1). Default: 0 with --box, --mask or --detections, else 0.5.",
        rich_help_panel=LOOP,
    ),
]


def estimate(
    images: ImagesArgument,
    model: ModelsOption,
    camera: CameraOption = None,
    box: BoxOption = None,
    mask: MaskOption = None,
    mask_from: MaskFromOption = "none",
    detections: DetectionsOption = None,
    detector: DetectorOption = None,
    instances: InstancesOption = 1,
    min_score: MinScoreOption = None,
    units: UnitsOption = "auto",
    symmetry: SymmetryOption = None,
    preset: PresetOption = "lite",
    weights: WeightsOption = None,
    init: InitOption = "templates",
    hypotheses: HypothesesOption = 5,
    top: TopOption = 1,
    update: UpdateOption = "auto",
    stop: StopOption = "angle",
    iterations: IterationsOption = 50,
    stop_angle: StopAngleOption = 2.0,
    mask_edge: MaskEdgeOption = True,
    colour_edge: ColourEdgeOption = True,
    threads: ThreadsOption = None,
    device: DeviceOption = "auto",
    out: OutOption = None,
    force: ForceOption = False,
    json: JsonOption = None,
    blend: BlendOption = 0.0,
    format_: FormatOption = None,
    overlay: OverlayOption = True,
    rerun: RerunOption = False,
    require_reliable: RequireReliableOption = False,
    workers: WorkersOption = 1,
    ray: RayOption = None,
) -> None:
    """Estimate objects' poses in photographs, from their meshes. A box, a mask or detections help, but need not be."""
    from posekit.batch.pictures import several

    recording = "estimate.rrd" if rerun else None
    chosen: dict[str, Any] = {"init": init, "hypotheses": hypotheses, "update": update, "stop": stop,
                              "iterations": iterations, "stop_angle_deg": stop_angle, "mask_edge": mask_edge,
                              "colour_edge": colour_edge, "top": top}  # fmt: skip
    if several(images):
        from posekit.batch.jobs import EstimateJob, Meshes, NetworkChoice, PictureFiles
        from posekit.cli.many import Wanted, work_through
        from posekit.estimate.estimator import EstimateOptions
        from posekit.machines import Machines

        job = EstimateJob(
            Meshes(tuple(model), units, symmetry), camera, box, mask, mask_from, detections, detector, instances,
            min_score, NetworkChoice(preset, weights, device), EstimateOptions(**chosen),
            PictureFiles(None, overlay, blend, tuple(format_ or ()), recording),
        )  # fmt: skip
        work_through(job, images, Wanted(out, force, json, Machines(workers, ray), threads, require_reliable))
        return

    from posekit.cli.output import Destination, end_unless_reliable

    [image] = images
    destination = Destination.chosen(out, Path("posekit-out") / image.stem, force, json, format_ or (), recording)

    from posekit.batch.jobs import CANDIDATES, search_for
    from posekit.batch.meshes import load_meshes
    from posekit.batch.prompts import prompt_for
    from posekit.estimate.estimator import EstimateOptions, Estimators
    from posekit.estimate.instances import find_instances
    from posekit.io.load import load_view

    use_threads(threads)
    options = EstimateOptions(**chosen)
    view = load_view(image, camera)
    meshes = load_meshes(model, units, symmetry)
    finder = prompt_for(box, mask, mask_from, detections, image, view.lens)
    prompted = finder is not None
    if finder is None:
        from posekit.detect.novel import make_detector

        with destination.working("loading the detector"):
            candidates = max(CANDIDATES, instances + 1)
            finder, _ = make_detector(detector, meshes, max_detections=candidates, doubtful=True)
    with destination.working("detecting"):
        found = finder.detect(view, meshes)
    with destination.working("loading the networks"):
        estimators = Estimators(preset=preset, weights=weights, options=options, device=device)
    with destination.working("estimating") as estimators.tell:
        results = find_instances(estimators, view, meshes, found, search_for(found, prompted, instances, min_score))
    paths = [{"image": image, "mesh": path} for path in model]
    destination.deliver_all(
        view, [(estimators(each.model), each.instances) for each in results], paths, blend, symmetry, overlay
    )
    if require_reliable:
        end_unless_reliable([each for found_of in results for each in found_of.instances])

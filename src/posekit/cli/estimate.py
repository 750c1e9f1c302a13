"""``posekit estimate``: a photograph and a mesh in, a pose out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

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
    ImageArgument,
    InitOption,
    IterationsOption,
    JsonOption,
    MaskEdgeOption,
    MaskFromOption,
    MaskOption,
    ModelsOption,
    OutOption,
    PresetOption,
    RequireReliableOption,
    RerunOption,
    StopAngleOption,
    StopOption,
    SymmetryOption,
    ThreadsOption,
    UnitsOption,
    UpdateOption,
    WeightsOption,
    use_threads,
)

CANDIDATES = 3  # detections of a mesh that are estimated at least, of which the best estimate is kept

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
    image: ImageArgument,
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
    rerun: RerunOption = False,
    require_reliable: RequireReliableOption = False,
) -> None:
    """Estimate objects' poses in a photograph, from their meshes. A box, a mask or detections help, but need not be."""
    from posekit.cli.output import Destination, end_unless_reliable

    recording = "estimate.rrd" if rerun else None
    destination = Destination.chosen(out, Path("posekit-out") / image.stem, force, json, format_ or (), recording)

    from posekit.cli.meshes import load_meshes
    from posekit.cli.prompts import prompt_for
    from posekit.estimate.estimator import EstimateOptions, Estimators
    from posekit.estimate.instances import SearchOptions, find_instances
    from posekit.io.load import load_view

    use_threads(threads)
    options = EstimateOptions(
        init, hypotheses, update, stop, iterations, stop_angle, mask_edge=mask_edge, colour_edge=colour_edge, top=top
    )
    view = load_view(image, camera)
    meshes = load_meshes(model, units, symmetry)
    finder = prompt_for(box, mask, mask_from, detections, image, view.lens)
    asked = finder is not None
    if finder is None:
        from posekit.detect.novel import make_detector

        with destination.working("loading the detector"):
            candidates = max(CANDIDATES, instances + 1)
            finder, _ = make_detector(detector, meshes, max_detections=candidates, doubtful=True)
    with destination.working("detecting"):
        found = finder.detect(view, meshes)
    with destination.working("loading the networks"):
        estimators = Estimators(preset=preset, weights=weights, options=options, device=device)
    search = SearchOptions.usual(found)
    search = replace(search, candidates=max(search.candidates, instances + 1),
                     instances=search.instances if asked else instances,
                     min_score=search.min_score if min_score is None else min_score)  # fmt: skip
    with destination.working("estimating"):
        results = find_instances(estimators, view, meshes, found, search)
    paths = [{"image": image, "mesh": path} for path in model]
    destination.deliver_all(
        view, [(estimators(each.model), each.instances) for each in results], paths, blend, symmetry
    )
    if require_reliable:
        end_unless_reliable([each for found_of in results for each in found_of.instances])

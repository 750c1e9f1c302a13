"""``posekit estimate``: a photograph and a mesh in, a pose out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from posekit.cli.options import (
    LOOP,
    BoxOption,
    CameraOption,
    ForceOption,
    ImageArgument,
    IterationsOption,
    JsonOption,
    MaskFromOption,
    MaskOption,
    ModelOption,
    OutOption,
    PresetOption,
    SeedOption,
    StopAngleOption,
    StopOption,
    SymmetryOption,
    ThreadsOption,
    UnitsOption,
    UpdateOption,
    WeightsOption,
)

InitOption = Annotated[
    Literal["templates", "mvnet"], typer.Option(help="Where first poses come from.", rich_help_panel=LOOP)
]
HypothesesOption = Annotated[int, typer.Option(metavar="K", help="First poses to refine.", rich_help_panel=LOOP)]


def estimate(
    image: ImageArgument,
    model: ModelOption,
    camera: CameraOption = None,
    box: BoxOption = None,
    mask: MaskOption = None,
    mask_from: MaskFromOption = "grabcut",
    units: UnitsOption = "auto",
    symmetry: SymmetryOption = None,
    preset: PresetOption = "lite",
    weights: WeightsOption = None,
    init: InitOption = "templates",
    hypotheses: HypothesesOption = 5,
    update: UpdateOption = "correspondence",
    stop: StopOption = "angle",
    iterations: IterationsOption = 50,
    stop_angle: StopAngleOption = 2.0,
    seed: SeedOption = 0,
    threads: ThreadsOption = None,
    out: OutOption = None,
    force: ForceOption = False,
    json: JsonOption = None,
) -> None:
    """Estimate an object's pose in a photograph, from its mesh and a box or a mask."""
    from posekit.cli.output import Destination

    destination = Destination.chosen(out, Path("posekit-out") / image.stem, force, json)

    from posekit.cli.prompts import detector_for
    from posekit.estimate import EstimateOptions, PoseEstimator
    from posekit.load import load_view
    from posekit.object_model import ObjectModel

    options = EstimateOptions(init, hypotheses, update, stop, iterations, stop_angle, seed)
    view = load_view(image, camera)
    mesh = ObjectModel.load(model, units=units, symmetry=symmetry)
    detections = detector_for(box, mask, mask_from).detect(view, [mesh])
    with destination.working("loading the networks"):
        estimator = PoseEstimator(mesh, preset=preset, weights=weights, options=options, threads=threads)
    with destination.working("estimating"):
        estimates = estimator.estimate(view, detections)
    destination.deliver(estimator, view, estimates, {"image": image, "mesh": model})

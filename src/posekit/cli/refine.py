"""``posekit refine``: a known pose made better."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from posekit.cli.options import (
    INPUT,
    BlendOption,
    BoxOption,
    CameraOption,
    ColourEdgeOption,
    DeviceOption,
    ForceOption,
    FormatOption,
    ImageArgument,
    IterationsOption,
    JsonOption,
    MaskEdgeOption,
    MaskFromOption,
    MaskOption,
    ModelOption,
    OutOption,
    PerturbOption,
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

PoseOption = Annotated[
    Path,
    typer.Option(
        metavar="FILE",
        help="A result of estimate, JSON with T_cam_obj (4x4, metres), or text: a 4x4 matrix, or x y z qx qy qz qw.",
        rich_help_panel=INPUT,
    ),
]


def refine(
    image: ImageArgument,
    model: ModelOption,
    pose: PoseOption,
    camera: CameraOption = None,
    box: BoxOption = None,
    mask: MaskOption = None,
    mask_from: MaskFromOption = "grabcut",
    units: UnitsOption = "auto",
    symmetry: SymmetryOption = None,
    preset: PresetOption = "lite",
    weights: WeightsOption = None,
    update: UpdateOption = "auto",
    stop: StopOption = "angle",
    iterations: IterationsOption = 50,
    stop_angle: StopAngleOption = 2.0,
    perturb: PerturbOption = True,
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
    """Refine a pose that is roughly known; a mask or a box helps, but neither is needed."""
    from posekit.cli.output import Destination, end_unless_reliable

    default, recording = Path("posekit-out") / f"{image.stem}-refined", "refine.rrd" if rerun else None
    destination = Destination.chosen(out, default, force, json, format_ or (), recording)

    from posekit.cli.meshes import load_meshes
    from posekit.cli.prompts import detector_for
    from posekit.estimate.estimator import EstimateOptions, PoseEstimator
    from posekit.io.load import load_pose, load_view

    use_threads(threads)
    options = EstimateOptions(
        update=update,
        stop=stop,
        iterations=iterations,
        stop_angle_deg=stop_angle,
        perturb=perturb,
        mask_edge=mask_edge,
        colour_edge=colour_edge,
    )
    start = load_pose(pose)
    view = load_view(image, camera)
    [mesh] = load_meshes([model], units, symmetry)
    if box is not None or mask is not None:
        [detection] = detector_for(box, mask, mask_from, view.lens).detect(view, [mesh])
        view = view.with_mask(detection.mask)
    with destination.working("loading the networks"):
        estimator = PoseEstimator(mesh, preset=preset, weights=weights, options=options, device=device)
    with destination.working("refining"):
        refined = estimator.refine(view, start)
    destination.deliver(estimator, view, [refined], {"image": image, "mesh": model}, blend, symmetry)
    if require_reliable:
        end_unless_reliable([refined])

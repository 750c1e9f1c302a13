"""``posekit refine``: known poses made better."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

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
    ImagesArgument,
    IterationsOption,
    JsonOption,
    MaskEdgeOption,
    MaskFromOption,
    MaskOption,
    ModelOption,
    OutOption,
    OverlayOption,
    PerturbOption,
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

PoseOption = Annotated[
    Path,
    typer.Option(
        metavar="FILE|FOLDER",
        help="A result of estimate, JSON with T_cam_obj (4x4, metres), or text: a 4x4 matrix, or x y z qx qy qz qw. Of "
        "several pictures: results.jsonl of estimate, or a folder with NAME/result.json, NAME.json or NAME.txt.",
        rich_help_panel=INPUT,
    ),
]


def refine(
    images: ImagesArgument,
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
    overlay: OverlayOption = True,
    rerun: RerunOption = False,
    require_reliable: RequireReliableOption = False,
    workers: WorkersOption = 1,
    ray: RayOption = None,
) -> None:
    """Refine poses that are roughly known; a mask or a box helps, but neither is needed."""
    from posekit.batch.pictures import several

    recording = "refine.rrd" if rerun else None
    chosen: dict[str, Any] = {"update": update, "stop": stop, "iterations": iterations, "stop_angle_deg": stop_angle,
                              "perturb": perturb, "mask_edge": mask_edge, "colour_edge": colour_edge}  # fmt: skip
    if several(images):
        from posekit.batch.jobs import Meshes, NetworkChoice, PictureFiles, RefineJob
        from posekit.cli.many import Wanted, work_through
        from posekit.estimate.estimator import EstimateOptions
        from posekit.machines import Machines

        job = RefineJob(
            Meshes((model,), units, symmetry), pose, camera, box, mask, mask_from,
            NetworkChoice(preset, weights, device), EstimateOptions(**chosen),
            PictureFiles(None, overlay, blend, tuple(format_ or ()), recording),
        )  # fmt: skip
        work_through(job, images, Wanted(out, force, json, Machines(workers, ray), threads, require_reliable))
        return

    from posekit.cli.output import Destination, end_unless_reliable

    [image] = images
    default = Path("posekit-out") / f"{image.stem}-refined"
    destination = Destination.chosen(out, default, force, json, format_ or (), recording)

    from posekit.batch.meshes import load_meshes
    from posekit.batch.prompts import detector_for
    from posekit.batch.start_poses import StartPoses
    from posekit.estimate.estimator import EstimateOptions, PoseEstimator
    from posekit.io.load import load_view

    use_threads(threads)
    options = EstimateOptions(**chosen)
    start = StartPoses(pose).first(image, model.stem)
    view = load_view(image, camera)
    [mesh] = load_meshes([model], units, symmetry)
    if box is not None or mask is not None:
        [detection] = detector_for(box, mask, mask_from, view.lens).detect(view, [mesh])
        view = view.with_mask(detection.mask)
    with destination.working("loading the networks"):
        estimator = PoseEstimator(mesh, preset=preset, weights=weights, options=options, device=device)
    with destination.working("refining") as estimator.tell:
        refined = estimator.refine(view, start)
    destination.deliver(estimator, view, [refined], {"image": image, "mesh": model}, blend, symmetry, overlay)
    if require_reliable:
        end_unless_reliable([refined])

"""``posekit demo``: a first pose without a photograph, a mesh or a network at hand."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from posekit.cli.options import ForceOption, SeedOption


def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the results; it must be new or empty.")] = Path(
        "posekit-out/demo"
    ),
    seed: SeedOption = 0,
    force: ForceOption = False,
) -> None:
    """Estimate a pose in an example that is made on the spot, and compare it with the truth."""
    from posekit.cli.output import Destination

    destination = Destination.chosen(out, out, force, None)
    assert destination.folder is not None

    from posekit import draw
    from posekit.data.example import make_example, ply
    from posekit.detect import BoxPrompt
    from posekit.estimate import EstimateOptions, PoseEstimator
    from posekit.metrics import rotation_error, translation_error
    from posekit.render import Renderer

    with destination.working("making the example"):
        example = make_example(Renderer(), seed)
    with destination.working("loading the networks"):
        estimator = PoseEstimator(example.model, options=EstimateOptions(seed=seed))
    with destination.working("estimating"):
        detections = BoxPrompt(example.box).detect(example.view, [example.model])
        estimates = estimator.estimate(example.view, detections)
    photo = destination.folder.write("photo.png", draw.png(example.view.image))
    mesh = destination.folder.write("locomotive.ply", ply(example.model))
    destination.deliver(estimator, example.view, estimates)
    for estimate in estimates:
        turn = rotation_error(estimate.T_cam_obj, example.T_cam_obj)
        shift = translation_error(estimate.T_cam_obj, example.T_cam_obj)
        typer.echo(f"true error: {turn:.2f} degrees, {1000 * shift:.1f} mm")
    camera = example.view.camera
    typer.echo(
        f"the same by hand: posekit estimate {photo} --model {mesh} --units m "
        f"--camera {camera.fx:g},{camera.fy:g},{camera.cx:g},{camera.cy:g} "
        f"--box {','.join(f'{v:g}' for v in example.box)}"
    )

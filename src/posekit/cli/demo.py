"""``posekit demo``: a first pose without a photograph, a mesh or a network at hand."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from posekit.cli.options import ForceOption, OutOption, WeightsOption


def demo(
    out: OutOption = None,
    weights: WeightsOption = None,
    seed: Annotated[int, typer.Option(help="Random seed of the example picture.")] = 0,
    force: ForceOption = False,
) -> None:
    """Estimate a pose in an example that is made on the spot, and compare it with the truth."""
    from posekit.cli.output import Destination

    destination = Destination.chosen(out, Path("posekit-out") / "demo", force, None)
    assert destination.folder is not None

    import numpy as np

    from posekit.detect import BoxPrompt
    from posekit.estimate.estimator import PoseEstimator
    from posekit.metrics import pose_error
    from posekit.render import Renderer
    from posekit.synth.example import make_example, ply
    from posekit.visualise import draw

    with destination.working("making the example"):
        example = make_example(Renderer(), seed)
    with destination.working("loading the networks"):
        estimator = PoseEstimator(example.model, weights=weights)
    with destination.working("estimating"):
        detections = BoxPrompt(example.box).detect(example.view, [example.model])
        estimates = estimator.estimate(example.view, detections)
    photo = destination.folder.write("photo.png", draw.png(example.view.image))
    mesh = destination.folder.write("locomotive.ply", ply(example.model))
    destination.deliver(estimator, example.view, estimates, {"image": photo, "mesh": mesh})
    camera = example.view.camera
    for estimate in estimates:
        turn, shift = pose_error(estimate.T_cam_obj, example.T_cam_obj)
        typer.echo(f"    true error {np.rad2deg(turn):.1f} degrees, {1000 * shift:.0f} mm")
    command = ["posekit", "estimate", str(photo), "--model", str(mesh), "--units", "m"]
    command += ["--camera", _numbers(camera.fx, camera.fy, camera.cx, camera.cy), "--box", _numbers(*example.box)]
    command += ["--weights", str(weights)] if weights else []
    typer.echo(f"the same by hand: {shlex.join(command)}")
    typer.echo(
        f"Look at {photo.with_name('overlay.png')}; then try a photograph of your own object: posekit estimate PHOTO "
        "--model MESH --box X0,Y0,X1,Y1"
    )


def _numbers(*values: float) -> str:
    return ",".join(f"{value:g}" for value in values)

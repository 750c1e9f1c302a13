"""``posekit estimate``: a photograph and a mesh in, a pose out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from posekit.cli.options import (
    LOOP,
    BoxOption,
    CameraOption,
    ForceOption,
    ImageArgument,
    IterationsOption,
    JsonOption,
    MaskFrom,
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
from posekit.errors import PromptError

if TYPE_CHECKING:
    from posekit.detect import Detector

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
    from posekit.object_model import ObjectModel
    from posekit.view import load_view

    destination = Destination.chosen(out, Path("posekit-out") / image.stem, force, json)
    detector = prompt(box, mask, mask_from)
    view = load_view(image, camera)
    detections = detector.detect(view, [])
    mesh = ObjectModel.load(model, units=units, symmetry=symmetry)


def prompt(box: str | None, mask: Path | None, mask_from: MaskFrom) -> Detector:
    """The detector that ``--box`` or ``--mask`` stand for. Raises PromptError unless exactly one is given."""
    from posekit.detect import BoxPrompt, MaskPrompt
    from posekit.results import load_mask, parse_box

    if box is not None and mask is not None:
        raise PromptError("--box and --mask were both given: a mask needs no box; pass one of them.")
    if mask is not None:
        return MaskPrompt(load_mask(mask))
    if box is None:
        raise PromptError("where is the object? Pass --box x0,y0,x1,y1 (pixels) or --mask PNG.")
    return BoxPrompt(parse_box(box), mask_from)

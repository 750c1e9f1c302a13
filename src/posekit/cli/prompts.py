"""From ``--box`` and ``--mask`` to a Detector."""

from __future__ import annotations

from pathlib import Path

from posekit.cli.options import MaskFrom
from posekit.detect import BoxPrompt, Detector, MaskPrompt
from posekit.errors import PromptError
from posekit.load import load_mask, parse_box


def detector_for(box: str | None, mask: Path | None, mask_from: MaskFrom) -> Detector:
    """Raises PromptError where neither is given, or both are."""
    if box is not None and mask is not None:
        raise PromptError("--box and --mask were both given; a mask needs no box: pass one of them.")
    if mask is not None:
        return MaskPrompt(load_mask(mask))
    if box is not None:
        return BoxPrompt(parse_box(box), mask_from)
    raise PromptError("where is the object? Pass --box x0,y0,x1,y1 (pixels) or --mask PNG.")

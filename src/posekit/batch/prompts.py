"""From ``--box``, ``--mask`` and ``--detections`` to a Detector."""

from __future__ import annotations

from pathlib import Path

from posekit.detect import BoxPrompt, Detector, MaskPrompt
from posekit.errors import PromptError
from posekit.io.load import load_mask, parse_box
from posekit.lens import Lens


def detector_for(box: str | None, mask: Path | None, mask_from: str, lens: Lens | None = None) -> Detector:
    """As `prompt_for`. Raises PromptError where neither is given, or both are."""
    found = prompt_for(box, mask, mask_from, lens=lens)
    if found is None:
        raise PromptError("where is the object? Pass --box x0,y0,x1,y1 (pixels) or --mask PNG.")
    return found


def prompt_for(
    box: str | None,
    mask: Path | None,
    mask_from: str,
    detections: Path | None = None,
    image: Path | None = None,
    lens: Lens | None = None,
) -> Detector | None:
    """What a person or a file says; None where nothing does. Raises PromptError where several do.

    lens: of the photograph that they speak of, where it was undistorted: what they say is moved with it.
    """
    check_one(box, mask, detections)
    if mask is not None:
        if lens is not None:
            return MaskPrompt(lens.undistorted_mask(load_mask(mask, lens.camera.size)))
        return MaskPrompt(load_mask(mask))
    if box is not None:
        if lens is not None:
            return BoxPrompt(lens.undistorted_box(parse_box(box, lens.camera.size)), mask_from)
        return BoxPrompt(parse_box(box), mask_from)
    if detections is not None and image is not None:
        from posekit.detect.external import DetectionsFile

        return DetectionsFile.read(detections, image)
    return None


def check_one(box: str | None, mask: Path | None, detections: Path | None = None) -> None:
    """Raises PromptError where several say where the object is."""
    given = [name for name, value in (("--box", box), ("--mask", mask), ("--detections", detections)) if value]
    if len(given) > 1:
        raise PromptError(f"{' and '.join(given)} were both given; one says where the object is: pass one of them.")

"""From ``--box``, ``--mask``, ``--detections`` and ``--detector`` to a Detector."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from posekit.cli.options import MaskFrom
from posekit.detect import BoxPrompt, Detector, MaskPrompt
from posekit.errors import PromptError
from posekit.load import load_mask, parse_box

if TYPE_CHECKING:
    from posekit.object_model import ObjectModel

NOVEL = "novel"


def detector_for(box: str | None, mask: Path | None, mask_from: MaskFrom) -> Detector:
    """Raises PromptError where neither is given, or both are."""
    found = prompt_for(box, mask, mask_from)
    if found is None:
        raise PromptError("where is the object? Pass --box x0,y0,x1,y1 (pixels) or --mask PNG.")
    return found


def prompt_for(
    box: str | None, mask: Path | None, mask_from: MaskFrom, detections: Path | None = None, image: Path | None = None
) -> Detector | None:
    """What a person or a file says; None where nothing does. Raises PromptError where several do."""
    given = [name for name, value in (("--box", box), ("--mask", mask), ("--detections", detections)) if value]
    if len(given) > 1:
        raise PromptError(f"{' and '.join(given)} were both given; one says where the object is: pass one of them.")
    if mask is not None:
        return MaskPrompt(load_mask(mask))
    if box is not None:
        return BoxPrompt(parse_box(box), mask_from)
    if detections is not None and image is not None:
        from posekit.detect.external import DetectionsFile

        return DetectionsFile.read(detections, image)
    return None


def make_detector(
    name: str | None,
    models: Sequence[ObjectModel],
    *,
    least: float | None = None,
    most: int = 3,
    threads: int | None = None,
) -> tuple[Detector, tuple[str, ...]]:
    """A network's Detector and the names that its detections may have. name: "novel" (the default), "coco", or a
    trained detector's file or folder. Raises WeightsError, ConfigError."""
    import torch

    from posekit.detect.maskrcnn import COCO, SHIPPED, MaskRCNN, load_coco, load_detector

    if threads is not None:
        torch.set_num_threads(threads)
    file = SHIPPED if name is None or name == NOVEL else Path(name)
    trained = load_coco() if name == COCO else load_detector(file)
    if not trained.config.novel:
        names = tuple(m.name for m in models) or trained.config.classes
        return MaskRCNN(trained, 0.5 if least is None else least), names

    from posekit.novel import NovelDetector, NovelOptions
    from posekit.render import Renderer

    options = NovelOptions(most=most) if least is None else NovelOptions(least=least, least_proposal=least, most=most)
    if models and least is not None:
        options = NovelOptions(least=least, most=most)
    return NovelDetector(trained, Renderer(), options), tuple(m.name for m in models) or trained.config.classes

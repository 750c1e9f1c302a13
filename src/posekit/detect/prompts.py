"""Detections that a person gives: a box, or a mask. Where a box's mask is asked for, it comes from GrabCut."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Box, Camera, box_mask, mask_box
from posekit.errors import PromptError
from posekit.mesh.model import ObjectModel
from posekit.results import Detection, Source
from posekit.view import View

Mask = NDArray[np.bool_]

MASK_SOURCES = ("none", "grabcut", "filled")

# Chosen on real crops: docs/decisions/0004-mask-from-a-box.md
_SIDE = 176  # longer side of the picture that GrabCut works on, pixels
_MARGIN = 0.12  # background round the box that it sees, of the box's longer side
# ellipses, of the box's own: inside the first is object, outside the second likely background
_SURE, _LIKELY = 0.45, 1.15
_ROUNDS = 3
_LEAST_COVER = 0.75  # of the box's width and height: a mask that reaches less far has lost a part of the object
_LEAST_AREA, _MOST_AREA = 0.2, 0.97  # of the box


class Detector(Protocol):
    """A detector: finds objects in a photograph."""

    def detect(self, view: View, models: Sequence[ObjectModel]) -> list[Detection]:
        """The instances of the models in a view; none is an empty list."""
        ...


@dataclass(frozen=True)
class BoxPrompt:
    """A box round the object, edges (x0, y0, x1, y1) in pixels.

    mask_from: "none" (first poses need no mask), "grabcut" or "filled" (the box itself). Where GrabCut's result cannot
    be the object's silhouette, the filled box is taken, and the detection's ``source`` says "box+filled" instead of
    "box+grabcut".
    """

    box: Box
    mask_from: str = "none"

    def __post_init__(self) -> None:
        if self.mask_from not in MASK_SOURCES:
            raise PromptError(f"the mask comes from one of {', '.join(MASK_SOURCES)}, not {self.mask_from!r}.")

    def detect(self, view: View, models: Sequence[ObjectModel]) -> list[Detection]:
        """One detection for each model. Raises PromptError where the box is inside out or outside the picture."""
        box = clip_box(self.box, view.camera)
        if self.mask_from == "none":
            return [Detection(box=box, label=model.name) for model in models]
        mask = grabcut_mask(view.image, box) if self.mask_from == "grabcut" else None
        source = Source.FILLED if mask is None else Source.GRABCUT
        mask = box_mask(box, view.camera.size) if mask is None else mask
        return [Detection(box=box, mask=mask, label=model.name, source=source) for model in models]


@dataclass(frozen=True, eq=False)
class MaskPrompt:
    """The object's mask, bool (H, W), of the picture's size."""

    mask: Mask

    def detect(self, view: View, models: Sequence[ObjectModel]) -> list[Detection]:
        """One detection for each model. Raises PromptError where the mask is empty or of another size."""
        height, width = self.mask.shape
        if (width, height) != view.camera.size:
            raise PromptError(
                f"the mask is {width}x{height}, the picture {view.camera.width}x{view.camera.height}: "
                "a mask has the size of its picture."
            )
        box = mask_box(self.mask)
        if box is None:
            raise PromptError("the mask is empty: its pixels must be brighter than 0 where the object is.")
        return [Detection(box=box, mask=self.mask, label=model.name, source=Source.MASK) for model in models]


def clip_box(box: Box, camera: Camera) -> Box:
    """The part of a box that lies in the picture. Raises PromptError where there is none, or less than a pixel."""
    x0, y0, x1, y1 = box
    if not np.isfinite(box).all() or x1 <= x0 or y1 <= y0:
        raise PromptError(f"box {_text(box)} is inside out: give x0,y0,x1,y1 with x0 < x1 and y0 < y1, in pixels.")
    width, height = camera.size
    clipped = (max(x0, 0.0), max(y0, 0.0), min(x1, float(width)), min(y1, float(height)))
    if clipped[2] - clipped[0] < 1 or clipped[3] - clipped[1] < 1:
        raise PromptError(f"box {_text(box)} lies outside the picture, which is {width}x{height} pixels.")
    return clipped


def grabcut_mask(image: NDArray[np.uint8], box: Box) -> Mask | None:
    """The object in a box, separated from the background by colour (GrabCut: Rother et al., 2004).

    image: uint8 RGB (H, W, 3). box: edges, inside the picture. The same picture and box give the same mask.
    Returns a bool (H, W); None where what comes out is not a silhouette that fills the box as an object would.
    """
    window = _window(image, box)
    x0, y0, x1, y1 = window
    part = image[y0:y1, x0:x1]
    scale = _SIDE / max(part.shape[:2])
    size = (max(1, round((x1 - x0) * scale)), max(1, round((y1 - y0) * scale)))
    small = cv2.resize(part, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    inner = _inner(box, window, size)
    labels = _first_labels(inner, size)
    if not ((labels == cv2.GC_BGD) | (labels == cv2.GC_PR_BGD)).any():
        return None  # no background to learn from
    cv2.setRNGSeed(0)
    models = np.zeros((2, 1, 65))
    cv2.grabCut(small[..., ::-1].copy(), labels, None, models[0], models[1], _ROUNDS, cv2.GC_INIT_WITH_MASK)
    found = largest_blob((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD))
    if not _fills(found, inner):
        return None
    mask = np.zeros(image.shape[:2], dtype=np.bool_)
    mask[y0:y1, x0:x1] = cv2.resize(found.astype(np.float32), (x1 - x0, y1 - y0)) > 0.5
    return mask if mask.any() else None


def _window(image: NDArray[np.uint8], box: Box) -> tuple[int, int, int, int]:
    """The box with its margin, in whole pixels of the picture."""
    margin = _MARGIN * max(box[2] - box[0], box[3] - box[1]) + 1
    height, width = image.shape[:2]
    x0, y0 = max(0, int(box[0] - margin)), max(0, int(box[1] - margin))
    return x0, y0, min(width, int(np.ceil(box[2] + margin))), min(height, int(np.ceil(box[3] + margin)))


def _inner(box: Box, window: tuple[int, int, int, int], size: tuple[int, int]) -> tuple[int, int, int, int]:
    """The box in the small picture's pixels, at least one pixel wide and high."""
    scale = (size[0] / (window[2] - window[0]), size[1] / (window[3] - window[1]))
    a, b = (min(round((box[k] - window[k]) * scale[k]), size[k] - 1) for k in (0, 1))
    c, d = (round((box[k + 2] - window[k]) * scale[k]) for k in (0, 1))
    return a, b, max(c, a + 1), max(d, b + 1)


def _first_labels(inner: tuple[int, int, int, int], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Background outside the box, object in its middle, and guesses between, (h, w)."""
    a, b, c, d = inner
    x, y = np.arange(size[0]), np.arange(size[1])[:, None]
    radius = np.hypot((x - 0.5 * (a + c - 1)) / (0.5 * (c - a)), (y - 0.5 * (b + d - 1)) / (0.5 * (d - b)))
    inside = (x >= a) & (x < c) & (y >= b) & (y < d)
    labels = np.full((size[1], size[0]), cv2.GC_BGD, dtype=np.uint8)
    labels[inside] = cv2.GC_PR_BGD
    labels[inside & (radius <= _LIKELY)] = cv2.GC_PR_FGD
    labels[inside & (radius <= _SURE)] = cv2.GC_FGD
    return labels


def largest_blob(mask: Mask) -> Mask:
    """The largest connected part, after opening, with holes filled."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
    smooth = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, kernel)
    outlines, _ = cv2.findContours(smooth, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not outlines:
        return np.zeros_like(mask)
    largest = max(outlines, key=cv2.contourArea)
    return np.asarray(cv2.drawContours(np.zeros_like(smooth), [largest], -1, 1, cv2.FILLED), dtype=np.bool_)


def _fills(mask: Mask, inner: tuple[int, int, int, int]) -> bool:
    """Whether a mask fills the box as an object with that box would."""
    found = mask_box(mask)
    if found is None:
        return False
    width, height = inner[2] - inner[0], inner[3] - inner[1]
    reaches = found[2] - found[0] >= _LEAST_COVER * width and found[3] - found[1] >= _LEAST_COVER * height
    return reaches and _LEAST_AREA <= mask.sum() / (width * height) <= _MOST_AREA


def _text(box: Box) -> str:
    return ",".join(f"{v:g}" for v in box)


class Successive:
    """A Detector that asks ``first``, where there is one, for the first picture, and for later ones another detector,
    which ``make`` makes when it is needed."""

    def __init__(self, first: Detector | None, make: Callable[[], Detector]) -> None:
        self._first, self._make = first, make
        self._then: Detector | None = None

    def detect(self, view: View, models: Sequence[ObjectModel]) -> list[Detection]:
        """The detections of whichever detector's turn it is."""
        if self._first is not None:
            first, self._first = self._first, None
            return first.detect(view, models)
        if self._then is None:
            self._then = self._make()
        return self._then.detect(view, models)

"""Masks and boxes as COCO's and BOP's files have them. Layer 2."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as rle

from posekit.camera import Box
from posekit.errors import PromptError

Mask = NDArray[np.bool_]


def encode(mask: Mask) -> dict[str, Any]:
    """A mask (H, W) as COCO's compressed run lengths: ``size`` [H, W] and ``counts``, a string."""
    found = rle.encode(np.asfortranarray(mask.astype(np.uint8)))
    return {"size": [int(n) for n in found["size"]], "counts": found["counts"].decode("ascii")}


def decode(segmentation: Any, size: tuple[int, int]) -> Mask:
    """A mask of ``size`` (width, height) from COCO's run lengths, as a string or as a list of numbers (BOP's), or from
    polygons. Raises PromptError."""
    width, height = size
    try:
        if isinstance(segmentation, list):
            coded = rle.merge(rle.frPyObjects(segmentation, height, width))
        elif isinstance(segmentation["counts"], list):
            coded = rle.frPyObjects(segmentation, *segmentation["size"])
        else:
            coded = {"size": segmentation["size"], "counts": segmentation["counts"].encode("ascii")}
        mask = rle.decode(coded).astype(np.bool_)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise PromptError(f"a segmentation is neither COCO's run lengths nor polygons ({error!r}).") from error
    if mask.shape != (height, width):
        raise PromptError(f"a mask is {mask.shape[1]}x{mask.shape[0]}, its picture {width}x{height}.")
    return np.asarray(mask)


def xywh(box: Box) -> list[float]:
    """Edges as COCO's x, y, width, height."""
    return [box[0], box[1], box[2] - box[0], box[3] - box[1]]

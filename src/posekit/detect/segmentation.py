"""Masks and boxes as COCO's and BOP's files have them. Layer 2."""

from __future__ import annotations

import re
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
            if not all(isinstance(p, list) and len(p) >= 6 and len(p) % 2 == 0 for p in segmentation):
                raise ValueError("a polygon has at least three points, x and y each")
            coded = rle.merge(rle.frPyObjects(segmentation, height, width))
        elif isinstance(segmentation["counts"], list):
            coded = rle.frPyObjects(segmentation, *segmentation["size"])
        else:
            coded = {"size": segmentation["size"], "counts": _text(segmentation["counts"]).encode("ascii")}
        if tuple(int(n) for n in coded["size"]) == (height, width):
            mask = rle.decode(coded).astype(np.bool_)
        else:
            raise PromptError(f"a mask is {coded['size'][1]}x{coded['size'][0]}, its picture {width}x{height}.")
    except PromptError:
        raise
    except Exception as error:  # pycocotools raises bare exceptions too
        raise PromptError(f"a segmentation is neither COCO's run lengths nor polygons ({error!r}).") from error
    return np.asarray(mask)


def _text(counts: str) -> str:
    """Run lengths that were written as Python's b'...' without it."""
    found = re.fullmatch(r"b(['\"])(.*)\1", counts, re.DOTALL)
    return counts if found is None else found[2].replace("\\\\", "\\")


def xywh(box: Box) -> list[float]:
    """Edges as COCO's x, y, width, height."""
    return [box[0], box[1], box[2] - box[0], box[3] - box[1]]

"""Masks and boxes as COCO's and BOP's files have them."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as rle

from posekit.camera import Box
from posekit.errors import PromptError

Mask = NDArray[np.bool_]

_FARTHEST = 100_000  # pixels, of a polygon's points


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
            return _polygons(segmentation, width, height)
        rows, columns = (int(n) for n in segmentation["size"])
        if (rows, columns) != (height, width):
            raise PromptError(f"a mask is {columns}x{rows}, its picture {width}x{height}.")
        counts = segmentation["counts"]
        return _filled(_lengths(counts) if isinstance(counts, str) else counts, width, height)
    except PromptError:
        raise
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise PromptError(f"a segmentation is neither COCO's run lengths nor polygons ({error!r}).") from error


def _filled(counts: Any, width: int, height: int) -> Mask:
    """Run lengths, of False and True in turn, column by column. pycocotools writes past its memory where they do not
    fill the picture, so they are checked here. Raises ValueError."""
    runs = np.asarray(counts, dtype=np.float64)
    if runs.ndim != 1 or not np.array_equal(runs, np.rint(runs)) or (runs < 0).any() or runs.sum() != width * height:
        raise ValueError(f"run lengths are whole numbers that fill the {width}x{height} pixels")
    values = np.arange(len(runs)) % 2 == 1
    return np.repeat(values, runs.astype(np.int64)).reshape(width, height).T


def _lengths(text: str) -> list[int]:
    """COCO's string as run lengths: six bits a character from 48 on, five of them a number's, each length but the first
    three less the one two before. Raises ValueError."""
    lengths: list[int] = []
    value = shift = 0
    for letter in _text(text).encode("ascii"):
        bits = letter - 48
        if not 0 <= bits < 64 or shift > 60:
            raise ValueError(f"the run lengths {text[:20]!r} hold what COCO's do not")
        value |= (bits & 31) << shift
        shift += 5
        if not bits & 32:
            if bits & 16:
                value -= 1 << shift
            lengths.append(value + (lengths[-2] if len(lengths) > 2 else 0))
            value = shift = 0
    if shift:
        raise ValueError("the run lengths end within a number")
    return lengths


def _polygons(polygons: list[Any], width: int, height: int) -> Mask:
    """Raises ValueError."""
    for polygon in polygons:
        if not isinstance(polygon, list) or len(polygon) < 6 or len(polygon) % 2:
            raise ValueError("a polygon has at least three points, x and y each")
        places = np.asarray(polygon, dtype=np.float64)
        if places.ndim != 1 or not (np.abs(places) <= _FARTHEST).all():  # pycocotools walks along every edge
            raise ValueError(f"a polygon has finite numbers, none beyond {_FARTHEST} pixels")
    if not polygons:
        raise ValueError("there is no polygon in it")
    coded = rle.merge(rle.frPyObjects([[float(v) for v in polygon] for polygon in polygons], height, width))
    return np.asarray(rle.decode(coded).astype(np.bool_))


def _text(counts: str) -> str:
    """Run lengths that were written as Python's b'...' without it."""
    found = re.fullmatch(r"b(['\"])(.*)\1", counts, re.DOTALL)
    return counts if found is None else found[2].replace("\\\\", "\\")


def xywh(box: Box) -> list[float]:
    """Edges as COCO's x, y, width, height."""
    return [box[0], box[1], box[2] - box[0], box[3] - box[1]]

"""A network's mask laid onto the colours of the photograph, by GrabCut (Rother et al., 2004)."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Box, mask_box
from posekit.detect.prompts import largest_blob
from posekit.results import Detection

Mask = NDArray[np.bool_]

SIDE = 96  # longer side of the picture that GrabCut works on, pixels
MARGIN = 0.35  # background round the box that it sees, of the box's longer side
UNCERTAIN = 0.1  # how far on both sides of the mask's outline the true one may lie, of the box's longer side
ROUNDS = 3
LEAST_OVERLAP = 0.4  # with the network's mask; what overlaps less is another object
LEAST = 20  # pixels of a mask, at least


def sharpened(image: NDArray[np.uint8], detection: Detection) -> Detection:
    """The detection with a sharp mask, and its own one as ``rough``; unchanged where GrabCut finds no better one.

    image: uint8 RGB (H, W, 3). The box stays the network's.
    """
    rough = detection.mask
    if rough is None:
        return detection
    sharp = _sharp(image, rough, detection.box)
    return detection if sharp is None else replace(detection, mask=sharp, rough=rough)


def _sharp(image: NDArray[np.uint8], rough: Mask, box: Box) -> Mask | None:
    height, width = rough.shape
    longer = max(box[2] - box[0], box[3] - box[1])
    x0, y0 = max(0, int(box[0] - MARGIN * longer)), max(0, int(box[1] - MARGIN * longer))
    x1, y1 = min(width, int(np.ceil(box[2] + MARGIN * longer))), min(height, int(np.ceil(box[3] + MARGIN * longer)))
    if min(x1 - x0, y1 - y0) < 4:
        return None
    scale = min(1.5, SIDE / max(x1 - x0, y1 - y0))
    size = (max(8, round((x1 - x0) * scale)), max(8, round((y1 - y0) * scale)))
    flags = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    small = cv2.resize(image[y0:y1, x0:x1], size, interpolation=flags)
    mask = cv2.resize(rough[y0:y1, x0:x1].astype(np.float32), size, interpolation=flags) > 0.5
    labels = _labels(mask, max(1, round(UNCERTAIN * longer * scale)))
    if mask.sum() < LEAST or not (labels == cv2.GC_BGD).any() or not (labels == cv2.GC_FGD).any():
        return None
    cv2.setRNGSeed(0)
    models = np.zeros((2, 1, 65))
    cv2.grabCut(small[..., ::-1].copy(), labels, None, models[0], models[1], ROUNDS, cv2.GC_INIT_WITH_MASK)
    found = largest_blob((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD))
    if (found & mask).sum() < LEAST_OVERLAP * (found | mask).sum():
        return None
    sharp = np.zeros_like(rough)
    sharp[y0:y1, x0:x1] = cv2.resize(found.astype(np.float32), (x1 - x0, y1 - y0)) > 0.5
    return sharp if mask_box(sharp) is not None else None


def _labels(mask: Mask, reach: int) -> NDArray[np.uint8]:
    """Sure within ``reach`` pixels of the outline neither of the object nor of the background, (h, w)."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    solid = mask.astype(np.uint8)
    inner = cv2.erode(solid, kernel, borderValue=0)
    if inner.sum() < LEAST // 2:  # a thin thing
        inner = cv2.erode(solid, np.ones((3, 3), np.uint8), borderValue=0)
    labels = np.full(mask.shape, cv2.GC_BGD, np.uint8)
    labels[cv2.dilate(solid, kernel) > 0] = cv2.GC_PR_BGD
    labels[mask] = cv2.GC_PR_FGD
    labels[inner > 0] = cv2.GC_FGD
    return labels

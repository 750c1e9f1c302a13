"""Pictures that are joined by depth: what is nearer is in front, and each pixel has a label."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera

Image = NDArray[np.uint8]
Depth = NDArray[np.float32]
Mask = NDArray[np.bool_]
Slices = tuple[slice, slice]


def tile(camera: Camera, points: NDArray[np.float64], sides: Sequence[int]) -> tuple[Camera, int, int] | None:
    """The smallest square of a picture, its side one of ``sides`` (pixels, rising), that holds the projections of
    points (N, 3) in the camera's frame, metres; it may reach out of the picture.

    Gives the square's camera and its left and upper edge in the picture, None where no side is large enough.
    """
    x0, y0, x1, y1 = camera.points_box(points)
    side = next((s for s in sides if s >= max(x1 - x0, y1 - y0) + 2), None)
    if side is None:
        return None
    left, top = int(np.floor(0.5 * (x0 + x1 - side))), int(np.floor(0.5 * (y0 + y1 - side)))
    return camera.cropped(left, top, side, side), left, top


def overlap(size: tuple[int, int], left: int, top: int, part: tuple[int, int]) -> tuple[Slices, Slices]:
    """Where a part (width, height) that is laid at (left, top) covers a picture of ``size`` (width, height): the
    slices of the picture, and the same of the part; both empty where it lies outside."""
    x0, x1 = (min(max(v, 0), size[0]) for v in (left, left + part[0]))
    y0, y1 = (min(max(v, 0), size[1]) for v in (top, top + part[1]))
    if x0 >= x1 or y0 >= y1:
        return (slice(0, 0), slice(0, 0)), (slice(0, 0), slice(0, 0))
    return (slice(y0, y1), slice(x0, x1)), (slice(y0 - top, y1 - top), slice(x0 - left, x1 - left))


class Canvas:
    """The picture so far. image: uint8 (H, W, 3), painted in place. depth: float32 (H, W), metres, 0 where nothing
    is. labels: int16 (H, W), the number of the part that is seen, 0 at first."""

    def __init__(self, image: Image, depth: Depth | None = None) -> None:
        self.image = image
        self.depth = np.zeros(image.shape[:2], np.float32) if depth is None else depth.copy()
        self.labels = np.zeros(image.shape[:2], np.int16)

    def paste(self, image: Image, mask: Mask, depth: Depth, label: int, left: int = 0, top: int = 0) -> None:
        """Put a part's pixels where its mask (h, w) is and nothing nearer; left, top: its place in the picture."""
        height, width = self.image.shape[:2]
        here, there = overlap((width, height), left, top, (mask.shape[1], mask.shape[0]))
        mine, known = depth[there], self.depth[here]
        nearer = mask[there] & ((known == 0) | (mine < known))
        self.image[here][nearer] = image[there][nearer]
        self.depth[here][nearer] = mine[nearer]
        self.labels[here][nearer] = label

    def smooth_edges(self) -> None:
        """Mix the colours where labels meet, as a lens does."""
        edge = np.zeros(self.labels.shape, bool)
        across, down = self.labels[:, 1:] != self.labels[:, :-1], self.labels[1:] != self.labels[:-1]
        edge[:, 1:] |= across
        edge[:, :-1] |= across
        edge[1:] |= down
        edge[:-1] |= down
        self.image[edge] = cv2.GaussianBlur(self.image, (3, 3), 0.7)[edge]

"""How well silhouettes and their colours explain a picture, without any segmentation of it.

Three scores, each about 1 where all is as it should be. Colour separation: how much a pixel's colour tells about
whether it lies inside the silhouette, the region-based likelihood of trackers (Prisacariu and Reid, 2012) as mutual
information. Colour agreement: correlation of seen and drawn colours inside. Edges: how strongly the picture changes
across the silhouette.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

FArray = NDArray[np.float32]
Mask = NDArray[np.bool_]
Image = NDArray[np.uint8]

CLUSTERS = 24  # of colours
QUIET = 6.0  # grey values: a spread of colours below which they say little
FAINT, CLEAR = 8.0, 2.0  # grey values added to a picture's mean gradient; multiples of the sum that count at most
LEVELS = 32.0  # steps of a normalised colour, kept as an int8
LEARNED = 2000  # pixels from which a palette is learned, about
BLOCK = 512  # silhouettes compared at a time


@dataclass(frozen=True)
class Weights:
    """Of the colour separation, the colour agreement, the edges, and the overlap with a mask where there is one."""

    separation: float = 1.0
    agreement: float = 0.5
    edges: float = 0.5
    overlap: float = 1.0


class Palette:
    """The colours of a picture, CLUSTERS at most, by k-means in CIELAB with L halved."""

    def __init__(self, image: Image, shown: Mask) -> None:
        """image: RGB (H, W, 3). shown: (H, W), the pixels that count; at least one."""
        values = _lab(image)[shown]
        values = values[:: max(1, len(values) // LEARNED)]
        count = min(CLUSTERS, len(values))
        cv2.setRNGSeed(0)
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 8, 0.5)
        first = np.zeros((len(values), 1), np.int32)
        _, _, centres = cv2.kmeans(values, count, first, criteria, 1, cv2.KMEANS_PP_CENTERS)
        self.centres: FArray = np.asarray(centres, np.float32)

    def indices(self, image: Image) -> NDArray[np.intp]:
        """The number (H, W) of each pixel's colour."""
        lab = _lab(image)
        far = (self.centres**2).sum(1) - 2 * lab.reshape(-1, 3) @ self.centres.T
        return np.asarray(far.argmin(1).reshape(lab.shape[:2]), np.intp)


@dataclass(frozen=True, eq=False)
class Picture:
    """What is compared of a picture with P pixels. sums: (P, K + 4), a column for each of K colours that is 1 where the
    pixel has it, then RGB and its squared length; zero where the picture shows nothing. colours: (3 P,), RGB.
    slopes: (P, 2), gradients, their length in [0, CLEAR]. mask: (P,) or None, the object's where it is known."""

    sums: FArray
    colours: FArray
    slopes: FArray
    mask: FArray | None = None

    @classmethod
    def of(cls, image: Image, shown: Mask, palette: Palette, mask: Mask | None = None) -> Picture:
        """image: RGB (H, W, 3). shown, mask: (H, W)."""
        on = shown.reshape(-1, 1).astype(np.float32)
        colours = image.reshape(-1, 3).astype(np.float32) * on
        sums = np.zeros((len(on), len(palette.centres) + 4), np.float32)
        sums[np.arange(len(on)), palette.indices(image).ravel()] = 1
        sums *= on
        sums[:, -4:-1], sums[:, -1] = colours, (colours**2).sum(1)
        flat = None if mask is None else mask.ravel().astype(np.float32)
        return cls(sums, colours.ravel(), _slopes(image, shown).reshape(-1, 2), flat)


@dataclass(frozen=True, eq=False)
class Silhouettes:
    """T silhouettes in pictures of P pixels, with their colours and edges.

    masks: uint8 (T, P). colours: int8 (T, 3 P), less their mean and over their spread, in 1 / LEVELS, 0 outside.
    edges: (E,) pixels of all edges, normals (E, 2); silhouette t has those from starts[t] to starts[t + 1].
    """

    masks: Image
    colours: NDArray[np.int8]
    edges: NDArray[np.int32]
    normals: FArray
    starts: NDArray[np.int64]

    @classmethod
    def of(cls, masks: Sequence[Mask], images: Sequence[Image]) -> Silhouettes:
        """masks: (H, W) each, images: RGB (H, W, 3) each."""
        found = [_edge(mask) for mask in masks]
        starts = np.concatenate([[0], np.cumsum([len(pixels) for pixels, _ in found])]).astype(np.int64)
        return cls(
            np.stack([mask.ravel() for mask in masks]).astype(np.uint8),
            np.stack([_normalised(image, mask) for image, mask in zip(images, masks, strict=True)]),
            np.concatenate([pixels for pixels, _ in found]),
            np.concatenate([normals for _, normals in found]),
            starts,
        )

    @classmethod
    def joined(cls, parts: Sequence[Silhouettes]) -> Silhouettes:
        """Those of all parts, in their order."""
        counts = np.concatenate([np.diff(part.starts) for part in parts])
        return cls(
            np.concatenate([part.masks for part in parts]),
            np.concatenate([part.colours for part in parts]),
            np.concatenate([part.edges for part in parts]),
            np.concatenate([part.normals for part in parts]),
            np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        )

    def turned(self) -> Silhouettes:
        """All by a quarter turn clockwise. Their pictures must be square."""
        side = round(self.masks.shape[1] ** 0.5)
        rows, columns = np.divmod(self.edges, side)
        return Silhouettes(
            _turned(self.masks.reshape(-1, side, side)).reshape(len(self), -1),
            _turned(self.colours.reshape(-1, side, side, 3)).reshape(len(self), -1),
            columns * side + side - 1 - rows,
            np.stack([-self.normals[:, 1], self.normals[:, 0]], 1),
            self.starts,
        )

    def packed(self) -> dict[str, NDArray[Any]]:
        """As arrays of a fifteenth of the size, for `unpacked`."""
        inside = self.colours.reshape(*self.masks.shape, 3)[self.masks > 0]
        return {
            "masks": np.packbits(self.masks, axis=1),
            "colours": inside,
            "edges": self.edges,
            "normals": self.normals,
            "starts": self.starts,
        }

    @classmethod
    def unpacked(cls, arrays: Mapping[str, NDArray[Any]], pixels: int) -> Silhouettes:
        """What `packed` gave, of pictures of so many pixels."""
        masks = np.unpackbits(arrays["masks"], axis=1, count=pixels)
        colours = np.zeros((*masks.shape, 3), np.int8)
        colours[masks > 0] = arrays["colours"]
        return cls(masks, colours.reshape(len(masks), -1), arrays["edges"], arrays["normals"], arrays["starts"])

    def __len__(self) -> int:
        return len(self.masks)

    def chosen(self, rows: NDArray[np.intp]) -> Silhouettes:
        """Those of the given numbers."""
        counts = np.diff(self.starts)[rows]
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        places = np.arange(starts[-1]) + np.repeat(self.starts[rows] - starts[:-1], counts)
        return Silhouettes(self.masks[rows], self.colours[rows], self.edges[places], self.normals[places], starts)

    def scores(self, picture: Picture, weights: Weights = Weights()) -> FArray:
        """The weighted sum (T,) of the scores of each silhouette in a picture."""
        parts = [self._regions(slice(k, k + BLOCK), picture, weights) for k in range(0, len(self), BLOCK)]
        return np.asarray(np.concatenate(parts) + weights.edges * self.crossed(picture), np.float32)

    def crossed(self, picture: Picture) -> FArray:
        """The mean strength (T,) of the picture's gradients across each edge."""
        strength = np.abs(np.einsum("ij,ij->i", picture.slopes[self.edges], self.normals))
        total = np.concatenate([[0.0], np.cumsum(strength, dtype=np.float64)])
        counts = np.diff(self.starts)
        return np.asarray((total[self.starts[1:]] - total[self.starts[:-1]]) / np.maximum(counts, 1), np.float32)

    def _regions(self, rows: slice, picture: Picture, weights: Weights) -> FArray:
        """All but the edges'."""
        masks = self.masks[rows].astype(np.float32)
        sums = masks @ picture.sums
        score = weights.separation * separation(sums[:, :-4], picture.sums[:, :-4].sum(0))
        if weights.agreement:
            area = np.maximum(sums[:, :-4].sum(1), 1)
            variance = (sums[:, -1] - (sums[:, -4:-1] ** 2).sum(1) / area) / (3 * area)
            product = self.colours[rows].astype(np.float32) @ picture.colours / (LEVELS * 3 * area)
            score += weights.agreement * product / (np.sqrt(np.maximum(variance, 0)) + QUIET)
        if picture.mask is not None:
            both = masks @ picture.mask
            score += weights.overlap * both / np.maximum(masks.sum(1) + picture.mask.sum() - both, 1)
        return np.asarray(score, np.float32)


def _turned(pictures: NDArray[Any]) -> NDArray[Any]:
    """(T, S, S) or (T, S, S, 3) of bytes, each by a quarter turn clockwise: as one picture, many times as fast as by
    NumPy."""
    count, side, _, *channels = pictures.shape
    wide = cv2.rotate(pictures.reshape(count * side, side, *channels), cv2.ROTATE_90_CLOCKWISE)
    return wide.reshape(side, count, side, *channels)[:, ::-1].swapaxes(0, 1)


def separation(inside: FArray, total: FArray) -> FArray:
    """How much information colours give about being inside: mutual information over the entropy of being inside, (T,),
    in [0, 1].

    inside: (T, K), pixels of each colour inside each silhouette. total: (K,), in the whole picture.
    """
    known = total > 0
    inside, total = inside[:, known], total[known]
    every = max(float(total.sum()), 1.0)
    left = _entropy(inside / total) @ (total / every)
    whole = _entropy(inside.sum(1) / every)
    return np.asarray(np.where(whole > 1e-6, 1 - left / np.maximum(whole, 1e-6), 0), np.float32)


def _entropy(p: FArray) -> FArray:
    p = np.clip(p, 1e-7, 1 - 1e-7)
    return np.asarray(-p * np.log(p) - (1 - p) * np.log1p(-p), np.float32)


def _lab(image: Image) -> FArray:
    """CIELAB (H, W, 3), L from 0 to 50."""
    lab = cv2.cvtColor(image.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
    return np.asarray(lab * np.array([0.5, 1, 1], np.float32), np.float32)


def _slopes(image: Image, shown: Mask) -> FArray:
    """Gradients (H, W, 2) of the channel that changes most; their length says how clear they are in this picture."""
    soft = image.astype(np.float32)
    x, y = (cv2.Sobel(soft, cv2.CV_32F, a, 1 - a, scale=0.25) for a in (1, 0))
    squared = x * x + y * y
    best = squared.argmax(2)[..., None]
    slope = np.concatenate([np.take_along_axis(each, best, 2) for each in (x, y)], 2)
    inner = cv2.erode(shown.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE) > 0
    slope[~inner] = 0
    length = np.linalg.norm(slope, axis=2)
    usual = float(length[inner].mean()) if inner.any() else 0.0
    clear = np.minimum(length / (usual + FAINT), CLEAR)
    return np.asarray(slope * (clear / np.maximum(length, 1e-6))[..., None], np.float32)


def _edge(mask: Mask) -> tuple[NDArray[np.int32], FArray]:
    """Pixels (E,) of a mask's edge, but for those at the picture's, and its normals (E, 2)."""
    solid = mask.astype(np.uint8)
    edge = (cv2.dilate(solid, np.ones((3, 3), np.uint8)) != cv2.erode(solid, np.ones((3, 3), np.uint8))) & mask
    edge[[0, -1]] = edge[:, [0, -1]] = False
    soft = cv2.GaussianBlur(solid.astype(np.float32), (0, 0), 1.0)
    pixels = np.flatnonzero(edge.ravel()).astype(np.int32)
    slope = np.stack([cv2.Sobel(soft, cv2.CV_32F, a, 1 - a).ravel()[pixels] for a in (1, 0)], 1)
    return pixels, np.asarray(slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-6), np.float32)


def _normalised(image: Image, mask: Mask) -> NDArray[np.int8]:
    """Colours (3 P,) less their mean and over their spread inside a mask, in 1 / LEVELS; 0 outside."""
    out = np.zeros((mask.size, 3), np.float32)
    inside = image[mask].astype(np.float32)
    if len(inside):
        inside -= inside.mean(0)
        out[mask.ravel()] = inside / (inside.std() + QUIET)
    return np.asarray(np.clip(np.rint(LEVELS * out), -127, 127).ravel(), np.int8)

"""How alike a photograph and the object drawn there look, by an ImageNet network's features.

Deep features of the early stages compare pictures much as people do (Zhang et al., "The Unreasonable Effectiveness of
Deep Features as a Perceptual Metric", 2018). Compared cell by cell at the pose, they tell right poses from wrong ones
better than brightness gradients or the similarity of a detection (docs/decisions/0027).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.view import View

Features = Callable[[NDArray[np.float32]], NDArray[np.float32]]
FArray = NDArray[np.float32]


def perceptual_similarity(
    features: Features, observed: Sequence[View], rendered: Sequence[View], visible: Sequence[FArray] | None = None
) -> list[float]:
    """Of each pair of crops, -1 to 1: the mean cosine of the features (C, h, w) over the cells that the drawn object
    covers; 0 where it covers none. features: of pairs (2, 3, H, W), see `posekit.nets.runtime.Runtime.features`.
    visible: (H', W') each, how much of the object is seen there, 0 to 1; cells count by that much."""
    weights: Sequence[FArray | None] = visible if visible is not None else [None] * len(observed)
    return [_of(features, o, r, w) for o, r, w in zip(observed, rendered, weights, strict=True)]


def _of(features: Features, observed: View, rendered: View, visible: FArray | None) -> float:
    assert rendered.mask is not None
    pictures = np.stack([observed.image, rendered.image]).transpose(0, 3, 1, 2).astype(np.float32) * np.float32(1 / 255)
    first, second = features(pictures)
    size = first.shape[2], first.shape[1]
    weight = cv2.resize(rendered.mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    if visible is not None:
        weight = weight * cv2.resize(visible, size, interpolation=cv2.INTER_AREA)
    return float(((first * second).sum(axis=0) * weight).sum() / (weight.sum() + 1e-6))

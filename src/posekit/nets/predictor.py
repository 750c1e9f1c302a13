"""What a network says about pairs of views, and how its outputs become that. Nothing here needs PyTorch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from posekit.geometry import quat_to_rotation
from posekit.nets.pose_delta import PoseDelta
from posekit.view import View

FArray = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Correspondences:
    """The dense head's output for one pair, on the anchors that lie on the rendered object.

    source: (N, 2) integer pixels (column, row) in the crop. target: (N, 2) pixel centres in the observed crop.
    scale_px: (N,), expected error of each. visible: (N,), probability that the observed picture shows it. weight: (N,),
    how much each should count for the pose beside its scale: its visibility times its certainty over the mean one.
    """

    source: NDArray[np.int64]
    target: NDArray[np.float64]
    scale_px: NDArray[np.float64]
    visible: NDArray[np.float64]
    weight: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PairPrediction:
    """A network's output for one pair. delta: from the rendered to the observed pose. angle: radians.
    silhouettes: float32 (2, H/4, W/4), how likely each 4x4 block of the observed crop shows the object, and would
    if nothing stood before it. score: in [0, 1], how near the pose is to the right one, for ranking hypotheses."""

    delta: PoseDelta
    angle: float
    correspondences: Correspondences | None = None
    silhouettes: FArray | None = None
    score: float | None = None


class Predictor(Protocol):
    """Anything that compares an observed with a rendered view of the same zoomed camera.

    size: (width, height) of the views it takes. dense: whether it gives correspondences.
    """

    size: tuple[int, int]
    dense: bool

    def predict(self, observed: Sequence[View], rendered: Sequence[View]) -> list[PairPrediction]:
        """A prediction for each pair of an observed and a rendered crop; both lists have the same length."""


def unpack(arrays: Sequence[FArray | None], k: int, rendered: View) -> PairPrediction:
    """The k-th pair of a batch of outputs, in the order of `answers`."""
    quat, v, angle, flow, log_scale, visibility, certainty, silhouettes, score = arrays
    assert quat is not None and v is not None and angle is not None
    delta = PoseDelta(quat_to_rotation(quat[k]), v[k].astype(np.float64))
    bounded = min(max(float(angle[k]), 0.0), math.pi)
    if flow is None or rendered.mask is None:
        return PairPrediction(delta, bounded)
    assert log_scale is not None and visibility is not None and certainty is not None
    assert silhouettes is not None and score is not None
    rows, columns = np.nonzero(rendered.mask[2::4, 2::4])
    source = np.stack([columns, rows], axis=1) * 4 + 2
    visible, certain = (sigmoid(x[k][rows, columns].astype(np.float64)) for x in (visibility, certainty))
    found = Correspondences(
        source=source,
        target=source + flow[k][:, rows, columns].T.astype(np.float64),
        scale_px=np.exp(log_scale[k][rows, columns].astype(np.float64)),
        visible=visible,
        weight=visible * certain / max(float(certain.mean()), 1e-6) if len(rows) else visible,
    )
    return PairPrediction(delta, bounded, found, sigmoid(silhouettes[k]), float(sigmoid(score[k])))


def sigmoid(x: Any) -> Any:
    """The logistic function, of numbers that may be large."""
    return 1 / (1 + np.exp(-np.clip(x, -60.0, 60.0)))

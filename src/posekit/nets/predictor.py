"""From views to predictions: SV-Net behind one call, in batches."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from posekit.geometry import quat_to_rotation
from posekit.nets.heads import Prediction
from posekit.nets.inputs import relief, to_input
from posekit.nets.lite import LiteSVNet
from posekit.nets.pose_delta import PoseDelta
from posekit.nets.precision import has_fast_bfloat16
from posekit.nets.weights import Networks
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


class NetworkPredictor:
    """SV-Net through PyTorch, where the networks are (`Networks.moved`). bfloat16: whether to compute in it; None =
    where the hardware does so faster."""

    def __init__(self, networks: Networks, bfloat16: bool | None = None) -> None:
        self.networks, self.device = networks, networks.device
        self.bfloat16 = has_fast_bfloat16(self.device.type) if bfloat16 is None else bfloat16
        self.size = networks.size
        self.dense = networks.dense

    def predict(self, observed: Sequence[View], rendered: Sequence[View]) -> list[PairPrediction]:
        """A prediction for each pair of crops of the network's size, in one batch."""
        svnet, device = self.networks.svnet, self.device
        dense = isinstance(svnet, LiteSVNet)
        first = np.stack([to_input(v.image, None)[:3] if dense else to_input(v.image, v.mask) for v in observed])
        second = np.stack([to_input(v.image, v.mask) for v in rendered])
        inputs = [first, second]
        if dense:
            inputs.append(np.stack([relief(v) for v in rendered]))
            inputs.append(np.array([v.camera.fx / v.camera.width for v in rendered], np.float32))
        lower = torch.autocast(device.type, torch.bfloat16) if self.bfloat16 else nullcontext()
        with torch.inference_mode(), lower:
            out = svnet(*(torch.from_numpy(array).to(device) for array in inputs))
        arrays = [None if x is None else x.float().cpu().numpy() for x in answers(out)]
        return [unpack(arrays, k, rendered[k]) for k in range(len(observed))]


def answers(out: Prediction) -> tuple[Tensor | None, ...]:
    """The fields of a prediction in the order that `unpack` takes them."""
    return (out.quat_wxyz, out.v, out.angle, out.flow, out.log_scale, out.visibility, out.certainty, out.silhouettes,
            out.score)  # fmt: skip


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

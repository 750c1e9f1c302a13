"""From views to predictions: SV-Net behind one call, in batches. Layer 2."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from posekit.geometry import quat_to_rotation
from posekit.nets.inputs import relief, to_input
from posekit.nets.lite import LiteSVNet
from posekit.nets.pose_delta import PoseDelta
from posekit.nets.precision import has_fast_bfloat16
from posekit.nets.weights import Networks
from posekit.view import View

FArray = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Correspondences:
    """The dense head's answer for one pair, on the anchors that lie on the rendered object.

    source: (N, 2) integer pixels (column, row) in the crop. target: (N, 2) pixel centres in the observed crop.
    scale_px: (N,), expected error of each. visible: (N,), probability that the observed picture shows it.
    """

    source: NDArray[np.int64]
    target: NDArray[np.float64]
    scale_px: NDArray[np.float64]
    visible: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PairPrediction:
    """What a network says about one pair. delta: from the rendered to the observed pose. angle: radians."""

    delta: PoseDelta
    angle: float
    correspondences: Correspondences | None = None


class Predictor(Protocol):
    """Anything that compares an observed with a rendered view of the same zoomed camera.

    size: (width, height) of the views it takes. dense: whether it gives correspondences.
    """

    size: tuple[int, int]
    dense: bool

    def predict(self, observed: Sequence[View], rendered: Sequence[View]) -> list[PairPrediction]: ...


class NetworkPredictor:
    """SV-Net through PyTorch. bfloat16: whether to compute in it; None = where the processor does so faster."""

    def __init__(self, networks: Networks, bfloat16: bool | None = None) -> None:
        self.networks = networks
        self.bfloat16 = has_fast_bfloat16("cpu") if bfloat16 is None else bfloat16
        self.size = networks.size
        self.dense = networks.dense

    def predict(self, observed: Sequence[View], rendered: Sequence[View]) -> list[PairPrediction]:
        svnet = self.networks.svnet
        first = torch.from_numpy(np.stack([to_input(v.image, v.mask) for v in observed]))
        second = torch.from_numpy(np.stack([to_input(v.image, v.mask) for v in rendered]))
        with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=self.bfloat16):
            if isinstance(svnet, LiteSVNet):
                reliefs = torch.from_numpy(np.stack([relief(v) for v in rendered]))
                focals = torch.tensor([v.camera.fx / v.camera.width for v in rendered], dtype=torch.float32)
                out = svnet(first, second, reliefs, focals)
            else:
                out = svnet(first, second)
        arrays = [None if x is None else x.float().numpy() for x in
                  (out.quat_wxyz, out.v, out.angle, out.flow, out.log_scale, out.visibility)]  # fmt: skip
        return [unpack(arrays, k, rendered[k]) for k in range(len(observed))]


def unpack(arrays: Sequence[FArray | None], k: int, rendered: View) -> PairPrediction:
    """The k-th pair of a batch of outputs, in the order of ``Prediction``'s fields."""
    quat, v, angle, flow, log_scale, visibility = arrays
    assert quat is not None and v is not None and angle is not None
    delta = PoseDelta(quat_to_rotation(quat[k]), v[k].astype(np.float64))
    found = None
    if flow is not None and log_scale is not None and visibility is not None and rendered.mask is not None:
        rows, columns = np.nonzero(rendered.mask[2::4, 2::4])
        source = np.stack([columns, rows], axis=1) * 4 + 2
        found = Correspondences(
            source=source,
            target=source + flow[k][:, rows, columns].T.astype(np.float64),
            scale_px=np.exp(log_scale[k][rows, columns].astype(np.float64)),
            visible=1 / (1 + np.exp(-visibility[k][rows, columns].astype(np.float64))),
        )
    return PairPrediction(delta, min(max(float(angle[k]), 0.0), math.pi), found)

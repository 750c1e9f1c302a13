"""SV-Net through PyTorch, in batches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from posekit.nets.heads import Prediction
from posekit.nets.inputs import relief, to_input
from posekit.nets.lite import LiteSVNet
from posekit.nets.lite0 import EarlyFeatures
from posekit.nets.precision import has_fast_bfloat16
from posekit.nets.predictor import PairPrediction, unpack
from posekit.nets.weights import Networks
from posekit.view import View


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


def torch_features(device: str) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
    """`EarlyFeatures` on a device, as a function of arrays (B, 3, H, W). Raises WeightsError."""
    network = EarlyFeatures().to(device)

    def features(pictures: NDArray[np.float32]) -> NDArray[np.float32]:
        with torch.inference_mode():
            return np.asarray(network(torch.from_numpy(pictures).to(device)).cpu().numpy(), np.float32)

    return features

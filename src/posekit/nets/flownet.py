"""The first ten convolutions of FlowNetSimple on 8 channels (paper, section 3.2; DeepIM)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from posekit.errors import WeightsError

# name, kernel, stride, channels at full width
LAYERS = (
    ("conv1", 7, 2, 64),
    ("conv2", 5, 2, 128),
    ("conv3", 5, 2, 256),
    ("conv3_1", 3, 1, 256),
    ("conv4", 3, 2, 512),
    ("conv4_1", 3, 1, 512),
    ("conv5", 3, 2, 512),
    ("conv5_1", 3, 1, 512),
    ("conv6", 3, 2, 1024),
    ("conv6_1", 3, 1, 1024),
)


class FlowNetEncoder(nn.Module):
    """(B, 8, H, W) -> (B, 1024 * width, H/64, W/64), sizes rounded up. LeakyReLU 0.1, no normalisation."""

    def __init__(self, width: float = 1.0, in_channels: int = 8) -> None:
        super().__init__()
        channels = in_channels
        for name, kernel, stride, full in LAYERS:
            out = max(8, round(full * width))
            self.add_module(name, nn.Conv2d(channels, out, kernel, stride, kernel // 2))
            channels = out
        self.out_channels = channels
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, a=0.1)
                assert module.bias is not None
                nn.init.zeros_(module.bias)

    def forward(self, x: Tensor) -> Tensor:
        """(B, in_channels, H, W) -> (B, out_channels, H/64, W/64), sizes rounded up."""
        for name, *_ in LAYERS:
            x = nn.functional.leaky_relu(self.get_submodule(name)(x), 0.1)
        return x

    def load_flownets(self, state: Mapping[str, Tensor]) -> None:
        """Take FlowNetS's public checkpoint: keys ``conv1.0.weight`` or ``conv1.weight``, 6 input channels.

        Our channels are observed RGB, rendered RGB, observed mask, rendered mask: the six RGB channels
        take FlowNetS's two pictures in their order, the mask channels start at zero.
        Raises WeightsError where a layer is missing or has another shape.
        """
        for name, *_ in LAYERS:
            module = self.get_submodule(name)
            assert isinstance(module, nn.Conv2d) and module.bias is not None
            weight = _find(state, name, "weight")
            bias = _find(state, name, "bias")
            if name == "conv1" and weight.shape[1] == 6:
                weight = torch.cat([weight, torch.zeros_like(weight[:, :2])], dim=1)
            if weight.shape != module.weight.shape or bias.shape != module.bias.shape:
                raise WeightsError(
                    f"FlowNetS layer {name} has weights of shape {tuple(weight.shape)}; this encoder needs "
                    f"{tuple(module.weight.shape)}. Only the full-width encoder (preset paper) takes them."
                )
            with torch.no_grad():
                module.weight.copy_(weight)
                module.bias.copy_(bias)


def _find(state: Mapping[str, Tensor], layer: str, kind: str) -> Tensor:
    for key in (f"{layer}.0.{kind}", f"{layer}.{kind}", f"module.{layer}.0.{kind}"):
        if key in state:
            return state[key]
    if kind == "bias" and any(key.startswith(f"{layer}.") for key in state):
        raise WeightsError(
            f"the checkpoint's {layer} has no bias: it is the batch-norm variant (FlowNetS_BN). "
            "Pass the plain FlowNetS checkpoint."
        )
    raise WeightsError(f"the checkpoint has no {layer}.{kind}: it is not in FlowNetS's layout.")

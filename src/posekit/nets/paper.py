"""MV-Net and SV-Net exactly as the paper has them (section 3.2 and 3.3, figure 2)."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from posekit.nets.flownet import FlowNetEncoder
from posekit.nets.heads import PoseHeads, Prediction, expand_angle


def _linear(features: int, out: int) -> nn.Linear:
    """A layer before LeakyReLU 0.1 that keeps the differences between samples, as the encoder's do: with torch's own
    start they shrank tenfold, and without FlowNetS's weights the networks did not begin to learn (docs/log.md)."""
    layer = nn.Linear(features, out)
    nn.init.kaiming_normal_(layer.weight, a=0.1)
    nn.init.zeros_(layer.bias)
    return layer


class Branch(nn.Module):
    """FlowNetS's encoder and one fully connected layer of 256; one set of weights for every branch."""

    def __init__(self, size: tuple[int, int], width: float) -> None:
        super().__init__()
        self.encoder = FlowNetEncoder(width)
        cells = math.ceil(size[0] / 64) * math.ceil(size[1] / 64)
        self.fc = _linear(self.encoder.out_channels * cells, 256)

    def forward(self, observed: Tensor, rendered: Tensor) -> Tensor:
        """Two (B, 4, H, W), RGB and mask -> (B, 256)."""
        x = torch.cat([observed[:, :3], rendered[:, :3], observed[:, 3:], rendered[:, 3:]], dim=1)
        return nn.functional.leaky_relu(self.fc(self.encoder(x).flatten(1)), 0.1)


class PaperSVNet(nn.Module):
    """One branch, fc 256, heads of 4, 3 and 1."""

    def __init__(self, branch: Branch) -> None:
        super().__init__()
        self.branch = branch
        self.fc = _linear(256, 256)
        self.heads = PoseHeads(256, with_angle=True)

    def forward(self, observed: Tensor, rendered: Tensor) -> Prediction:
        """observed, rendered: (B, 4, H, W)."""
        quat, v, angle = self.heads(nn.functional.leaky_relu(self.fc(self.branch(observed, rendered)), 0.1))
        assert angle is not None
        return Prediction(quat, v, expand_angle(angle))


class PaperMVNet(nn.Module):
    """Six branches, concatenated, fc 512, heads of 4 and 3: the pose relative to the frontal view."""

    def __init__(self, branch: Branch, views: int = 6) -> None:
        super().__init__()
        self.branch = branch
        self.views = views
        self.fc = _linear(256 * views, 512)
        self.heads = PoseHeads(512, with_angle=False)

    def forward(self, observed: Tensor, views: Tensor) -> Prediction:
        """observed: (B, 4, H, W); views: (B, M, 4, H, W), the frontal one first."""
        B, M = views.shape[:2]
        repeated = observed[:, None].expand(B, M, *observed.shape[1:]).flatten(0, 1)
        features = self.branch(repeated, views.flatten(0, 1)).view(B, M * 256)
        quat, v, _ = self.heads(nn.functional.leaky_relu(self.fc(features), 0.1))
        return Prediction(quat, v)

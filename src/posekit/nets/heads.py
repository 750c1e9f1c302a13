"""The paper's output layers, shared by both presets, and a network's outputs."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn


@dataclass(frozen=True, eq=False)
class Prediction:
    """The output of SV-Net (or MV-Net) for B pairs.

    quat_wxyz: (B, 4), not normalised. v: (B, 3), as in PoseDelta. angle: (B,), radians, unbounded, None
    for MV-Net.
    Dense head (lite only), on a grid of h x w anchors, every 4th pixel from (2, 2) on:
    flow: (B, 2, h, w) crop pixels from the rendered to the observed place; log_scale: (B, h, w), the
    logarithm of the flow's Laplace scale in pixels; visibility: (B, h, w), a logit; certainty: (B, h, w), a logit of
    how much the anchor should count for the pose beside these, learned through the pose alone.
    silhouettes: (B, 2, h, w), logits of the observed crop's 4x4 blocks: the object is visible there; it would be if
    nothing stood before it. score: (B,), a logit: the pose is right.
    """

    quat_wxyz: Tensor
    v: Tensor
    angle: Tensor | None = None
    flow: Tensor | None = None
    log_scale: Tensor | None = None
    visibility: Tensor | None = None
    certainty: Tensor | None = None
    silhouettes: Tensor | None = None
    score: Tensor | None = None


ANGLE_KNEE = 0.0349066  # 2 degrees, the paper's threshold: below it the angle's scale is linear, above logarithmic


def compress_angle(angle: Tensor) -> Tensor:
    """Radians (B,) -> a scale on which 1 against 2 degrees weighs as much as 30 against 60."""
    return torch.log1p(angle / ANGLE_KNEE)


def expand_angle(value: Tensor) -> Tensor:
    """The inverse of ``compress_angle``, for any output of a head: below zero for negative ones, so that a loss on it
    has a gradient everywhere (up to 14 radians). Bound it to [0, pi] where it is used."""
    return torch.expm1(value.clamp(max=6.0)) * ANGLE_KNEE


class PoseHeads(nn.Module):
    """Rotation (4), translation (3) and, for SV-Net, angle (1), each one fully connected layer.

    The layers' outputs are in normalised units; buffers hold the mean and the standard deviation measured
    over the training pairs (paper, section 3.2). The translation starts at zero and the quaternion
    near the identity, as in DeepIM.
    """

    quat_mean: Tensor
    quat_std: Tensor
    v_mean: Tensor
    v_std: Tensor

    def __init__(self, features: int, with_angle: bool) -> None:
        super().__init__()
        self.rotation = nn.Linear(features, 4)
        self.translation = nn.Linear(features, 3)
        self.angle = nn.Linear(features, 1) if with_angle else None
        self.register_buffer("quat_mean", torch.tensor([1.0, 0.0, 0.0, 0.0]))
        self.register_buffer("quat_std", torch.ones(4))
        self.register_buffer("v_mean", torch.zeros(3))
        self.register_buffer("v_std", torch.ones(3))
        nn.init.normal_(self.rotation.weight, std=1e-3)
        nn.init.zeros_(self.rotation.bias)
        nn.init.zeros_(self.translation.weight)
        nn.init.zeros_(self.translation.bias)

    @torch.no_grad()
    def set_statistics(self, quat_wxyz: Tensor, v: Tensor) -> None:
        """Measure the statistics over training targets: quat_wxyz (N, 4) with w >= 0, v (N, 3)."""
        self.quat_mean.copy_(quat_wxyz.mean(0))
        self.quat_std.copy_(quat_wxyz.std(0).clamp_min(1e-3))
        self.v_mean.copy_(v.mean(0))
        self.v_std.copy_(v.std(0).clamp_min(1e-3))

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """x: (B, features) -> quat_wxyz (B, 4), v (B, 3), compressed angle (B,) or None."""
        quat = self.rotation(x).float() * self.quat_std + self.quat_mean
        v = self.translation(x).float() * self.v_std + self.v_mean
        angle = None if self.angle is None else self.angle(x).float().squeeze(-1)
        return quat, v, angle

"""Losses: the paper's equations 1 and 2, and the lite preset's dense ones. See docs/decisions/0002."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from posekit.nets.heads import PoseHeads, Prediction, compress_angle
from posekit.nets.lite import CELL, LiteOutput


def paper_pose_loss(prediction: Prediction, heads: PoseHeads, quat_wxyz: Tensor, v: Tensor) -> Tensor:
    """The part that equations 1 and 2 share, averaged over the batch:

        |1 - q . q^/||q^|| | + ||t - t^|| + |1 - ||q^|| |

    quat_wxyz: (B, 4), unit, w >= 0. v: (B, 3). t is v in normalised units; ||t - t^|| is the Euclidean norm.
    """
    length = prediction.quat_wxyz.norm(dim=1)
    cosine = (quat_wxyz * prediction.quat_wxyz).sum(1) / length.clamp_min(1e-8)
    translation = ((v - prediction.v) / heads.v_std).norm(dim=1)
    return ((1 - cosine).abs() + translation + (1 - length).abs()).mean()


def mvnet_loss(prediction: Prediction, heads: PoseHeads, quat_wxyz: Tensor, v: Tensor, views: int = 6) -> Tensor:
    """Equation 1, N = views."""
    return paper_pose_loss(prediction, heads, quat_wxyz, v) / views


def svnet_loss(prediction: Prediction, heads: PoseHeads, quat_wxyz: Tensor, v: Tensor, angle: Tensor) -> Tensor:
    """Equation 2; angle: (B,), radians."""
    assert prediction.angle is not None
    return paper_pose_loss(prediction, heads, quat_wxyz, v) + (angle - prediction.angle).abs().mean()


@dataclass(frozen=True)
class DenseLossConfig:
    """Weights of the lite preset's losses. hidden: weight of anchors that the observed picture does not show.
    mvnet: of `first_pose_loss` beside all others."""

    gamma: float = 0.8
    hidden: float = 0.3
    flow: float = 0.25
    match: float = 1.0
    early: float = 0.3
    likelihood: float = 0.5
    rigid: float = 0.5
    visibility: float = 1.0
    rotation: float = 1.0
    translation: float = 1.0
    angle: float = 1.0
    mvnet: float = 1.0
    max_flow_px: float = 80.0
    knee_px: float = 8.0


@dataclass(frozen=True, eq=False)
class Target:
    """The truth of B pairs on h x w anchors; see ``data.pairs.Pair``. lost: bool (B,)."""

    flow: Tensor  # (B, 2, h, w)
    valid: Tensor  # (B, h, w) bool
    visible: Tensor  # (B, h, w) bool
    quat_wxyz: Tensor  # (B, 4)
    v: Tensor  # (B, 3)
    angle: Tensor  # (B,)
    lost: Tensor  # (B,) bool


def dense_loss(
    output: LiteOutput, heads: PoseHeads, target: Target, config: DenseLossConfig = DenseLossConfig()
) -> tuple[Tensor, dict[str, float]]:
    """The lite preset's loss and its parts. Lost pairs teach the angle only."""
    prediction, flows = output.prediction, output.flows
    assert prediction.flow is not None and prediction.log_scale is not None and prediction.visibility is not None
    near = (target.flow.abs().amax(1) < config.max_flow_px) & target.valid & ~target.lost[:, None, None]
    weight = near * (config.hidden + (1 - config.hidden) * target.visible)
    cells = F.avg_pool2d(weight[:, None], 2)
    flow_cells = F.avg_pool2d(target.flow.nan_to_num() * weight[:, None], 2) / cells.clamp_min(1e-6)
    total_cells = cells.sum().clamp_min(1.0)
    sequence = total_cells.new_zeros(())
    for k, flow in enumerate(flows):
        error = (flow - flow_cells).abs().sum(1, keepdim=True)
        sequence = sequence + config.gamma ** (len(flows) - 1 - k) * (error * cells).sum() / total_cells

    shown = F.avg_pool2d((near & target.visible)[:, None].float(), 2)[:, 0] > 0.5
    match = matching_loss(output.likenesses[-1], flow_cells, shown)
    early = matching_loss(output.likenesses[0], flow_cells, shown)

    total = weight.sum().clamp_min(1.0)
    error = (prediction.flow - target.flow).abs().sum(1)
    likelihood = ((error * torch.exp(-prediction.log_scale) + 2 * prediction.log_scale) * weight).sum() / total
    judged = near.float()
    visibility = F.binary_cross_entropy_with_logits(prediction.visibility, target.visible.float(), judged)
    visibility = visibility * judged.numel() / judged.sum().clamp_min(1.0)

    judged_rigid = (target.valid & ~target.lost[:, None, None]).float()
    rigids = [rigid_loss(flow, target.flow, judged_rigid, config.knee_px) for flow in output.rigid]
    rigid = sum(config.gamma ** (len(rigids) - 1 - k) * value for k, value in enumerate(rigids))

    kept = (~target.lost).float()
    count = kept.sum().clamp_min(1.0)
    quat = prediction.quat_wxyz
    rotation = (((quat - target.quat_wxyz) / heads.quat_std).abs().mean(1) * kept).sum() / count
    translation = (((prediction.v - target.v) / heads.v_std).abs().mean(1) * kept).sum() / count
    angle = (output.compressed_angle - compress_angle(target.angle)).abs().mean()
    loss = (
        config.flow * sequence
        + config.match * match
        + config.early * early
        + config.likelihood * likelihood
        + config.rigid * rigid
        + config.visibility * visibility
        + config.rotation * rotation
        + config.translation * translation
        + config.angle * angle
    )
    seen = (near & target.visible).float()
    epe = ((prediction.flow - target.flow).detach().norm(dim=1) * seen).sum() / seen.sum().clamp_min(1.0)
    parts = {"epe_px": epe, "match": match, "early": early, "rigid": rigids[-1], "rigid1": rigids[0],
             "likelihood": likelihood, "visibility": visibility, "rotation": rotation, "translation": translation,
             "angle": angle}  # fmt: skip
    return loss, {name: float(value.detach()) for name, value in parts.items()}


def rigid_loss(flow: Tensor, truth: Tensor, judged: Tensor, knee: float) -> Tensor:
    """Mean distance in pixels on the whole object, hidden parts too: the pose's own error as the crop shows it.

    flow, truth: (B, 2, h, w). judged: (B, h, w). knee: pixels from where the distance counts by its logarithm, so that
    a solver gone astray does not drown the rest.
    """
    error = (flow - truth.nan_to_num()).pow(2).sum(1).add(1e-6).sqrt()
    return (knee * torch.log1p(error / knee) * judged).sum() / judged.sum().clamp_min(1.0)


def first_pose_loss(
    prediction: Prediction, heads: PoseHeads, quat_wxyz: Tensor, v: Tensor
) -> tuple[Tensor, dict[str, float]]:
    """MV-Net lite's loss: the distance to the nearer of q and -q, which are one rotation, and the translation's in
    normalised units. Unlike equation 1 it does not jump at half a turn. quat_wxyz: (B, 4); v: (B, 3)."""
    near = (prediction.quat_wxyz - quat_wxyz).abs().sum(1)
    far = (prediction.quat_wxyz + quat_wxyz).abs().sum(1)
    rotation = torch.minimum(near, far).mean()
    translation = ((prediction.v - v) / heads.v_std).abs().mean()
    cosine = (F.normalize(prediction.quat_wxyz.detach()) * quat_wxyz).sum(1).abs().clamp(max=1.0)
    angle_deg = torch.rad2deg(2 * torch.acos(cosine)).mean()
    parts = {"mv_rotation": rotation, "mv_translation": translation, "mv_angle_deg": angle_deg}
    return rotation + translation, {name: float(value.detach()) for name, value in parts.items()}


def matching_loss(likeness: Tensor, flow: Tensor, shown: Tensor) -> Tensor:
    """Cross-entropy of the cell that each shown rendered cell lies on in the observed crop.

    likeness: (B, h * w, h * w), logits. flow: (B, 2, h, w), the truth in pixels. shown: (B, h, w) bool. A place
    between cells counts for its four neighbours, bilinearly; without it the features learn to match only
    through the recurrent updates, several times more slowly (docs/log.md).
    """
    B, _, h, w = flow.shape
    ys, xs = torch.meshgrid(*(torch.arange(n, device=flow.device) for n in (h, w)), indexing="ij")
    x, y = xs + flow[:, 0] / CELL, ys + flow[:, 1] / CELL
    inside = shown & (x >= 0) & (x <= w - 1) & (y >= 0) & (y <= h - 1)
    x, y = x.clamp(0, w - 1.001), y.clamp(0, h - 1.001)
    x0, y0 = x.floor(), y.floor()
    fx, fy = x - x0, y - y0
    first = (y0 * w + x0).long()
    logits = torch.log_softmax(likeness, dim=2).view(B, h, w, h * w)
    total = logits.new_zeros(())
    for dy, dx, share in ((0, 0, (1 - fx) * (1 - fy)), (0, 1, fx * (1 - fy)), (1, 0, (1 - fx) * fy), (1, 1, fx * fy)):
        found = logits.gather(3, (first + dy * w + dx).unsqueeze(3)).squeeze(3)
        total = total - (found * share * inside).sum()
    return total / inside.sum().clamp_min(1)

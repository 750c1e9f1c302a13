"""Losses: the paper's equations 1 and 2, and the lite preset's dense ones. See docs/decisions/0002."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from posekit.nets.config import CELL
from posekit.nets.heads import PoseHeads, Prediction, compress_angle
from posekit.nets.lite import LiteOutput


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
    """Weights of the lite preset's losses."""

    gamma: float = 0.8
    hidden: float = 0.3  # weight of anchors that the observed picture does not show
    flow: float = 0.25
    match: float = 1.0
    early: float = 0.3
    likelihood: float = 0.5
    rigid: float = 0.5
    visibility: float = 1.0
    rotation: float = 1.0
    translation: float = 1.0
    angle: float = 1.0
    silhouettes: float = 1.0
    score: float = 1.0
    # of the crop's width, the mean distance in it from the rendered to the true place at which a pose's score should
    # be 1/e
    near: float = 0.03
    mvnet: float = 1.0  # of MV-Net's loss beside all others
    max_flow_px: float = 80.0
    knee_px: float = 8.0


@dataclass(frozen=True, eq=False)
class Target:
    """The truth of B pairs on h x w anchors; see ``data.pairs.Pair``. lost: bool (B,). silhouettes: (B, 2, h, w), the
    shares of the observed crop's 4x4 blocks in which the object is visible, and would be if nothing stood before."""

    flow: Tensor  # (B, 2, h, w)
    valid: Tensor  # (B, h, w) bool
    visible: Tensor  # (B, h, w) bool
    quat_wxyz: Tensor  # (B, 4)
    v: Tensor  # (B, 3)
    angle: Tensor  # (B,)
    lost: Tensor  # (B,) bool
    silhouettes: Tensor  # (B, 2, h, w)


def dense_loss(
    output: LiteOutput, heads: PoseHeads, target: Target, config: DenseLossConfig = DenseLossConfig()
) -> tuple[Tensor, dict[str, Tensor]]:
    """The lite preset's loss and its parts, detached. Lost pairs count for angle, score and silhouettes only."""
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
    counted_cells = F.avg_pool2d((target.valid & ~target.lost[:, None, None])[:, None].float(), 2)[:, 0] > 0.5
    match = matching_loss(output.similarities[-1], flow_cells, shown, counted_cells)
    early = matching_loss(output.similarities[0], flow_cells, shown, counted_cells)

    total = weight.sum().clamp_min(1.0)
    error = (prediction.flow - target.flow).abs().sum(1)
    likelihood = ((error * torch.exp(-prediction.log_scale) + 2 * prediction.log_scale) * weight).sum() / total
    counted = near.float()
    visibility = F.binary_cross_entropy_with_logits(prediction.visibility, target.visible.float(), counted)
    visibility = visibility * counted.numel() / counted.sum().clamp_min(1.0)

    counted_anchors = (target.valid & ~target.lost[:, None, None]).float()
    rigids = [rigid_loss(flow, target.flow, counted_anchors, config.knee_px) for flow in output.rigid]
    rigid = sum(config.gamma ** (len(rigids) - 1 - k) * value for k, value in enumerate(rigids))

    kept = (~target.lost).float()
    count = kept.sum().clamp_min(1.0)
    quat = prediction.quat_wxyz
    rotation = (((quat - target.quat_wxyz) / heads.quat_std).abs().mean(1) * kept).sum() / count
    translation = (((prediction.v - target.v) / heads.v_std).abs().mean(1) * kept).sum() / count
    angle = (output.compressed_angle - compress_angle(target.angle)).abs().mean()
    assert prediction.silhouettes is not None and prediction.score is not None
    silhouettes = F.binary_cross_entropy_with_logits(prediction.silhouettes, target.silhouettes)
    width_px = 4 * target.flow.shape[3]
    score = F.binary_cross_entropy_with_logits(prediction.score, true_score(target, config.near * width_px))
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
        + config.silhouettes * silhouettes
        + config.score * score
    )
    seen = (near & target.visible).float()
    epe = ((prediction.flow - target.flow).detach().norm(dim=1) * seen).sum() / seen.sum().clamp_min(1.0)
    parts = {"epe_px": epe, "match": match, "early": early, "rigid": rigids[-1], "rigid1": rigids[0],
             "likelihood": likelihood, "visibility": visibility, "rotation": rotation, "translation": translation,
             "angle": angle, "silhouettes": silhouettes, "score": score}  # fmt: skip
    return loss, {name: value.detach() for name, value in parts.items()}


def true_score(target: Target, near_px: float) -> Tensor:
    """(B,) in [0, 1]: exp(-d / near_px), d the mean distance of the rendered from the true places of the surface."""
    valid = target.valid.float()
    distance = target.flow.nan_to_num().norm(dim=1).clamp(max=1e3)
    mean = (distance * valid).sum((1, 2)) / valid.sum((1, 2)).clamp_min(1.0)
    return torch.exp(-mean / near_px)


def rigid_loss(flow: Tensor, truth: Tensor, counted: Tensor, knee: float) -> Tensor:
    """Mean distance in pixels on the whole object, hidden parts too: the pose's own error as the crop shows it.

    flow, truth: (B, 2, h, w). counted: (B, h, w). knee: pixels from where the distance counts by its logarithm, so
    that a solver that diverged does not dominate.
    """
    error = (flow - truth.nan_to_num()).pow(2).sum(1).add(1e-6).sqrt()
    return (knee * torch.log1p(error / knee) * counted).sum() / counted.sum().clamp_min(1.0)


def matching_loss(similarity: Tensor, flow: Tensor, shown: Tensor, counted: Tensor) -> Tensor:
    """Cross-entropy of the cell that each rendered cell lies on in the observed crop, or of none.

    similarity: (B, h * w, h * w + 1), logits. flow: (B, 2, h, w), the truth in pixels. shown, counted: (B, h, w) bool;
    of the counted cells those that are not shown, or lie beside the crop, are none. A place between cells counts for
    its four neighbours, bilinearly; without this loss the features learn to match several times more slowly
    (docs/log.md).
    """
    B, _, h, w = flow.shape
    ys, xs = torch.meshgrid(*(torch.arange(n, device=flow.device) for n in (h, w)), indexing="ij")
    x, y = xs + flow[:, 0] / CELL, ys + flow[:, 1] / CELL
    inside = shown & counted & (x >= 0) & (x <= w - 1) & (y >= 0) & (y <= h - 1)
    x, y = x.clamp(0, w - 1.001), y.clamp(0, h - 1.001)
    x0, y0 = x.floor(), y.floor()
    fx, fy = x - x0, y - y0
    first = (y0 * w + x0).long()
    logits = torch.log_softmax(similarity, dim=2).view(B, h, w, h * w + 1)
    total = -(logits[..., -1] * (counted & ~inside)).sum()
    for dy, dx, share in ((0, 0, (1 - fx) * (1 - fy)), (0, 1, fx * (1 - fy)), (1, 0, (1 - fx) * fy), (1, 1, fx * fy)):
        found = logits.gather(3, (first + dy * w + dx).unsqueeze(3)).squeeze(3)
        total = total - (found * share * inside).sum()
    return total / counted.sum().clamp_min(1)

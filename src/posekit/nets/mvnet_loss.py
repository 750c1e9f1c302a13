"""The loss of the matching MV-Net."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from posekit.nets.mvnet import NONE, MVOutput


@dataclass(frozen=True)
class MVLossConfig:
    """Weights of the parts."""

    selection: float = 0.5
    match: float = 1.0
    none: float = 0.5  # of the cells that are in no view, beside ``match``
    early: float = 0.3  # of matches by codes alone
    offset: float = 1.0
    silhouette: float = 2.0
    dice: float = 0.5
    score: float = 0.5
    turn: float = 1.0
    presence: float = 0.5
    reach: float = 0.5  # cosine of the largest angle between two directions of view for which the turn counts


def mvnet_loss(
    output: MVOutput, target: Mapping[str, Tensor], config: MVLossConfig = MVLossConfig()
) -> tuple[Tensor, dict[str, Tensor]]:
    """The weighted sum, and its parts before weighting, detached.

    target: as `data.view_queries.collate_queries` gives it, on the output's device. Queries that do not show the mesh
    count for the silhouettes, which are empty, and the presence only.
    """
    m = output.matches
    there = target["mv_presence"].float()  # (B,)
    count = there.sum().clamp_min(1.0)
    parts = {"selection": _selection(output.selection, target["mv_near_all"].float(), there, count)}
    parts["match"], parts["none"] = _cells(m.cells, target["mv_cell"], there)
    parts["early"] = _early(output.early, target["mv_cell"], there)
    parts["offset"] = _offset(m.offsets, target["mv_offset"].float(), target["mv_cell"], there)
    parts["silhouette"], parts["dice"] = _silhouettes(m.silhouettes, target["mv_silhouettes"].float(), there, count)
    score = F.binary_cross_entropy_with_logits(m.scores, target["mv_near"].float(), reduction="none").mean(1)
    parts["score"] = (score * there).sum() / count
    near = (target["mv_facing"].float() > config.reach).float() * there[:, None]
    turn = (m.turns - target["mv_turn"].float()).square().sum(2)
    parts["turn"] = (turn * near).sum() / near.sum().clamp_min(1.0)
    parts["presence"] = F.binary_cross_entropy_with_logits(m.presence, there)
    loss = torch.stack([getattr(config, name) * part for name, part in parts.items()]).sum()
    return loss, {name: part.detach() for name, part in parts.items()}


def _selection(logits: Tensor, near: Tensor, there: Tensor, count: Tensor) -> Tensor:
    """Cross-entropy with the views' nearness (B, K), scaled to add up to 1."""
    share = near / near.sum(1, keepdim=True).clamp_min(1e-6)
    return (-(share * F.log_softmax(logits, dim=1)).sum(1) * there).sum() / count


def _cells(logits: Tensor, cell: Tensor, there: Tensor) -> tuple[Tensor, Tensor]:
    """Cross-entropy of matched cells, and of those in no view. cell: (B, k, h * w)."""
    error = F.cross_entropy(logits.flatten(0, 2), cell.flatten(), reduction="none").view(cell.shape)
    here = there[:, None, None].expand_as(error)
    matched = (cell != NONE).float() * here
    unmatched = here - matched
    return ((error * matched).sum() / matched.sum().clamp_min(1.0),
            (error * unmatched).sum() / unmatched.sum().clamp_min(1.0))  # fmt: skip


def _early(logits: Tensor, cell: Tensor, there: Tensor) -> Tensor:
    """Cross-entropy of matched cells. logits: (B, k, h * w, 64), without none."""
    error = F.cross_entropy(logits.flatten(0, 2), cell.clamp_max(NONE - 1).flatten(), reduction="none")
    matched = (cell != NONE).float() * there[:, None, None]
    return (error.view(cell.shape) * matched).sum() / matched.sum().clamp_min(1.0)


def _offset(offsets: Tensor, truth: Tensor, cell: Tensor, there: Tensor) -> Tensor:
    """Mean absolute error in cells. offsets: (B, k, 2, h, w). truth: (B, k, 2, h * w)."""
    matched = (cell != NONE).float() * there[:, None, None]
    error = (offsets.flatten(3) - truth).abs().sum(2)
    return (error * matched).sum() / matched.sum().clamp_min(1.0)


def _silhouettes(logits: Tensor, truth: Tensor, there: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
    """Cross-entropy of both, and 1 - Dice's coefficient where there is something. (B, 2, H, W)."""
    entropy = F.binary_cross_entropy_with_logits(logits, truth)
    soft = torch.sigmoid(logits)
    both, either = (soft * truth).sum((2, 3)), (soft + truth).sum((2, 3))
    dice = (1 - (2 * both + 1) / (either + 1)).mean(1)
    return entropy, (dice * there).sum() / count

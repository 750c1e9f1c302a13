"""MV-Net that matches: a rough box's crop against rendered views of the mesh; mask, score and first poses come out.

A view is a square picture of the mesh from one direction and at one in-plane turn. The tower, shared with SV-Net,
describes crop and views alike. Codes, cheap to compare, choose a few views; blocks of cross-attention between the
crop's cells and theirs then say for each cell of the crop which cell of which view it is, or none. Views depend on the
mesh alone: `encode` them once.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.modules.batchnorm import _BatchNorm

CELL = 8  # pixels per cell, in the crop and in the views
VIEW = 64  # a view's width and height in pixels
GRID = VIEW // CELL
NONE = GRID * GRID  # the class "no cell of this view"


class MatchingConfig(Protocol):
    """What MV-Net needs to know of the tower: widths, its channels at 1/4 and 1/8; size, (width, height) of crops."""

    @property
    def widths(self) -> tuple[int, int]:
        """The tower's channels at 1/4 and 1/8."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of crops, pixels."""


class Encoded(NamedTuple):
    """Of N views. tokens: (N, D, 8, 8). whole: (N, C), a unit vector for the view. parts: (N, 64, c), unit vectors for
    its cells. share: (N, 64), how much of the object's silhouette lies in each cell, adding up to 1."""

    tokens: Tensor
    whole: Tensor
    parts: Tensor
    share: Tensor


class Seen(NamedTuple):
    """Of B crops, h x w cells. fine: (B, c0, 2h, 2w). tokens: (B, h * w, D). whole: (B, C), parts: (B, h * w, c), as
    those of the views."""

    fine: Tensor
    tokens: Tensor
    whole: Tensor
    parts: Tensor


class Matches(NamedTuple):
    """Of B crops and k views of each, all logits float32.

    cells: (B, k, h * w, 65), which cell of the view a crop's cell shows, row by row; 64 = none. offsets: (B, k, 2, h,
    w), x and y of the place within that cell, in cells from its middle. silhouettes: (B, 2, 2h, 2w), the visible and
    the amodal one. scores: (B, k), how near the view is to the truth. turns: (B, k, 2), cosine and sine of the
    in-plane turn from the view to the crop. presence: (B,), whether the crop shows the mesh at all.
    """

    cells: Tensor
    offsets: Tensor
    silhouettes: Tensor
    scores: Tensor
    turns: Tensor
    presence: Tensor


class MVOutput(NamedTuple):
    """Of a training step. selection: (B, K), logits of the views. early: (B, k, h * w, 64), logits of the cells of the
    chosen ones by the codes alone. matches: with the chosen ones."""

    selection: Tensor
    early: Tensor
    matches: Matches


@contextmanager
def fixed_statistics(module: nn.Module) -> Iterator[None]:
    """Batch normalisations use their running statistics and leave them as they are, in training too.

    The tower's are SV-Net's: those of a batch of views would differ from what is used at inference.
    """
    norms = [m for m in module.modules() if isinstance(m, _BatchNorm) and m.training]
    for norm in norms:
        norm.training = False
    try:
        yield
    finally:
        for norm in norms:
            norm.training = True


class Within(nn.Module):
    """A bottleneck of 3x3 convolution among the cells of one picture."""

    def __init__(self, channels: int, inner: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(channels)
        self.reduce = nn.Linear(channels, inner)
        self.conv = nn.Conv2d(inner, inner, 3, 1, 1)
        self.expand = nn.Linear(inner, channels)

    def forward(self, x: Tensor, rows: int) -> Tensor:
        """x: (N, rows * columns, channels)."""
        y = F.relu(self.reduce(self.norm(x))).transpose(1, 2).unflatten(2, (rows, x.shape[1] // rows))
        return x + self.expand(F.relu(self.conv(y)).flatten(2).transpose(1, 2))


class Across(nn.Module):
    """Attention from some tokens to others, and a small perceptron."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm, self.norm_other = nn.LayerNorm(channels), nn.LayerNorm(channels)
        self.query, self.key_value = nn.Linear(channels, channels), nn.Linear(channels, 2 * channels)
        self.join = nn.Linear(channels, channels)
        self.perceptron = nn.Sequential(nn.LayerNorm(channels), nn.Linear(channels, 2 * channels), nn.GELU(),
                                        nn.Linear(2 * channels, channels))  # fmt: skip

    def forward(self, x: Tensor, other: Tensor) -> Tensor:
        """x: (B, n, channels), other: (B, m, channels) -> (B, n, channels)."""
        q = self.query(self.norm(x)).unflatten(2, (self.heads, -1)).transpose(1, 2)
        k, v = self.key_value(self.norm_other(other)).unflatten(2, (2, self.heads, -1)).transpose(1, 3).unbind(2)
        found = F.scaled_dot_product_attention(q, k, v)
        x = x + self.join(found.transpose(1, 2).flatten(2))
        return x + self.perceptron(x)


class Block(nn.Module):
    """Attention between the crop's cells and the views'."""

    def __init__(self, channels: int, heads: int, inner: int) -> None:
        super().__init__()
        self.crop_within, self.view_within = Within(channels, inner), Within(channels, inner)
        self.crop_across, self.view_across = Across(channels, heads), Across(channels, heads)

    def forward(self, crop: Tensor, views: Tensor, rows: int) -> tuple[Tensor, Tensor]:
        """crop: (B, h * w, D), rows = h. views: (B, k * 64, D)."""
        views = self.view_across(views, crop)
        views = self.view_within(views.unflatten(1, (-1, NONE)).flatten(0, 1), GRID).unflatten(0, (crop.shape[0], -1))
        views = views.flatten(1, 2)
        return self.crop_within(self.crop_across(crop, views), rows), views


class Code(nn.Module):
    """What is compared to choose views: (N, D, h, w) -> a unit vector (N, 128) that keeps the rough layout."""

    def __init__(self, channels: int, cells: tuple[int, int]) -> None:
        super().__init__()
        self.reduce = nn.Sequential(nn.Conv2d(channels, 48, 3, 2, 1), nn.GroupNorm(8, 48), nn.ReLU())
        rows, columns = ((n + 1) // 2 for n in cells)
        self.fc = nn.Linear(48 * rows * columns, 128)

    def forward(self, x: Tensor) -> Tensor:
        """(N, D, h, w) -> (N, 128), unit length, float32."""
        return F.normalize(self.fc(self.reduce(x).flatten(1)).float(), dim=1)


class Silhouettes(nn.Module):
    """Visible and amodal silhouette at 1/4."""

    def __init__(self, fine: int, channels: int, width: int = 48) -> None:
        super().__init__()
        self.look, self.know = nn.Conv2d(fine, width, 1), nn.Conv2d(channels, width, 1)
        self.merge = nn.Sequential(nn.Conv2d(2 * width, width, 3, 1, 1), nn.GroupNorm(8, width), nn.ReLU(),
                                   nn.Conv2d(width, width, 3, 1, 1), nn.ReLU(), nn.Conv2d(width, 2, 1))  # fmt: skip

    def forward(self, fine: Tensor, cells: Tensor) -> Tensor:
        """fine: (B, fine, 2h, 2w). cells: (B, channels, h, w). -> (B, 2, 2h, 2w)."""
        known = F.interpolate(self.know(cells), scale_factor=2.0, mode="nearest")
        return self.merge(torch.cat([self.look(fine), known], dim=1)).float()


class MatchingMVNet(nn.Module):
    """See the module's text. tower: (B, 3, H, W), RGB in [-0.5, 0.5] -> features at 1/4 and 1/8, config.widths wide.
    views: directions. kept: views that are compared in full. channels: of the tokens. part: of the codes of cells."""

    def __init__(self, tower: nn.Module, config: MatchingConfig, views: int = 42, kept: int = 8, *,
                 channels: int = 128, heads: int = 4, blocks: int = 3, inner: int = 64,
                 part: int = 32) -> None:  # fmt: skip
        super().__init__()
        self.tower, self.config, self.views, self.kept = tower, config, views, kept
        self.rows, self.columns = config.size[1] // CELL, config.size[0] // CELL
        fine, coarse = config.widths
        self.settle, self.enter = nn.GroupNorm(8, coarse), nn.Conv2d(coarse, channels, 1)
        self.cover = nn.Conv2d(4, channels, 1)
        self.crop_place = nn.Parameter(nn.init.normal_(torch.empty(1, channels, self.rows, self.columns), std=0.02))
        self.view_place = nn.Parameter(nn.init.normal_(torch.empty(1, channels, GRID, GRID), std=0.02))
        self.crop_code, self.view_code = Code(channels, (self.rows, self.columns)), Code(channels, (GRID, GRID))
        self.part = nn.Linear(channels, part)
        self.sharpness = nn.Parameter(torch.tensor([8.0, 8.0, 8.0]))
        self.blocks = nn.ModuleList([Block(channels, heads, inner) for _ in range(blocks)])
        self.leave, self.view_leave = nn.LayerNorm(channels), nn.LayerNorm(channels)
        self.match, self.view_match = nn.Linear(channels, channels), nn.Linear(channels, channels)
        self.none = nn.Linear(channels, channels)
        self.here, self.there = nn.Linear(channels, inner), nn.Linear(channels, inner)
        self.offset = nn.Linear(inner, 2)
        self.silhouettes = Silhouettes(fine, channels)
        self.judge = nn.Sequential(nn.Linear(2 * channels, channels), nn.ReLU(), nn.Linear(channels, 3))
        self.presence = nn.Sequential(nn.Linear(4 * channels, channels), nn.ReLU(), nn.Linear(channels, 1))

    def describe(self, rgb: Tensor) -> tuple[Tensor, Tensor]:
        """RGB (N, 3, H, W) in [-0.5, 0.5] -> the tower's (N, c0, H/4, W/4), and tokens (N, D, H/8, W/8)."""
        with fixed_statistics(self.tower):
            fine, coarse = self.tower(rgb)
        return fine, self.enter(self.settle(coarse))

    def encode(self, views: Tensor) -> Encoded:
        """views: (N, 4, 64, 64), RGB in [-0.5, 0.5] and mask 0 or 1."""
        mask = F.avg_pool2d(views[:, 3:], CELL // 2)
        cover = F.pixel_unshuffle(mask, 2)
        x = self.describe(views[:, :3])[1] + self.cover(cover)
        parts = F.normalize(self.part(x.flatten(2).transpose(1, 2)).float(), dim=2)
        share = cover.float().mean(1).flatten(1)
        share = share / share.sum(1, keepdim=True).clamp_min(1e-4)
        return Encoded(x + self.view_place, self.view_code(x), parts, share)

    def observe(self, observed: Tensor) -> Seen:
        """observed: (B, 3, H, W), RGB in [-0.5, 0.5]."""
        fine, x = self.describe(observed)
        parts = F.normalize(self.part(x.flatten(2).transpose(1, 2)).float(), dim=2)
        return Seen(fine, (x + self.crop_place).flatten(2).transpose(1, 2), self.crop_code(x), parts)

    def select(self, seen: Seen, whole: Tensor, parts: Tensor, share: Tensor) -> Tensor:
        """Logits (B, M) of M views' codes: whole (B or 1, M, C), parts (B or 1, M, 64, c), share (B or 1, M, 64)."""
        alike = (whole @ seen.whole[:, :, None])[..., 0]
        found = (parts.flatten(1, 2) @ seen.parts.transpose(1, 2)).amax(2)
        found = (found.unflatten(1, (-1, NONE)) * share).sum(2)
        return (self.sharpness[0] * alike + self.sharpness[1] * found).float()

    def compare(self, fine: Tensor, crop: Tensor, views: Tensor) -> Matches:
        """fine: (B, c0, 2h, 2w) and crop: (B, h * w, D) of `Seen`. views: (B, k, D, 8, 8), tokens of `Encoded`."""
        B, k = views.shape[:2]
        tokens = views.flatten(3).transpose(2, 3).flatten(1, 2)
        for block in self.blocks:
            crop, tokens = block(crop, tokens, self.rows)
        crop, tokens = self.leave(crop), self.view_leave(tokens).unflatten(1, (k, NONE))
        pooled = torch.cat([tokens.mean(2), tokens.amax(2)], dim=2)  # (B, k, 2D)
        keys = torch.cat([self.view_match(tokens), self.none(tokens.mean(2))[:, :, None]], dim=2)
        query = self.match(crop)[:, None] * crop.shape[2] ** -0.5
        cells = (query @ keys.transpose(2, 3)).float()
        share = torch.softmax(cells[..., :NONE], dim=3).to(tokens.dtype)
        pair = F.relu(self.here(crop)[:, None] + share @ self.there(tokens))
        offsets = self.offset(pair).float().transpose(2, 3).unflatten(3, (self.rows, self.columns))
        judged = self.judge(pooled).float()
        whole = torch.cat([crop.mean(1), crop.amax(1), pooled.amax(1)], dim=1)
        picture = crop.transpose(1, 2).unflatten(2, (self.rows, self.columns))
        return Matches(cells, offsets, self.silhouettes(fine, picture), judged[..., 0], judged[..., 1:],
                       self.presence(whole).float()[:, 0])  # fmt: skip

    def forward(self, observed: Tensor, views: Tensor, item: Tensor, chosen: Tensor) -> MVOutput:
        """observed: (B, 3, H, W). views: (n, K, 4, 64, 64) of n meshes. item: (B,), which mesh a crop is compared with.
        chosen: (B, k), which of its K views closely."""
        n, K = views.shape[:2]
        encoded, seen = self.encode(views.flatten(0, 1)), self.observe(observed)
        whole, parts, share = (t.unflatten(0, (n, K)).index_select(0, item) for t in encoded[1:])
        selection = self.select(seen, whole, parts, share)
        index = (item[:, None] * K + chosen).flatten()
        kept = encoded.tokens.index_select(0, index).unflatten(0, chosen.shape)
        near = encoded.parts.index_select(0, index).unflatten(0, chosen.shape)
        early = self.sharpness[2] * (seen.parts[:, None] @ near.transpose(2, 3)).float()
        return MVOutput(selection, early, self.compare(seen.fine, seen.tokens, kept))


def rgb_input(rgb: Tensor) -> Tensor:
    """uint8 (..., H, W, 3) -> float32 (..., 3, H, W) in [-0.5, 0.5]."""
    return (rgb.movedim(-1, -3).float() / 255.0 - 0.5).contiguous()


def view_input(rgbm: Tensor) -> Tensor:
    """uint8 (..., H, W, 4), alpha = mask (0 or 255) -> float32 (..., 4, H, W), RGB in [-0.5, 0.5] and mask."""
    x = rgbm.movedim(-1, -3).float() / 255.0
    return torch.cat([x[..., :3, :, :] - 0.5, x[..., 3:, :, :]], dim=-3)

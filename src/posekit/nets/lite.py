"""The preset that a laptop runs: a shared tower, exchange between both crops, matching, a dense head.

A shared tower describes the observed and the rendered crop, another one the two laid over each other, with the rendered
mask, normals and relief. No mask of the observed object is an input: its visible and its whole silhouette are outputs.
Exchange blocks (bottleneck convolutions within a crop, attention across the two) tell every cell of one what the other
shows. Matching all pairs of cells, with the further choice that a cell is not shown, gives a first flow (GMFlow's way:
Xu et al., 2022) and that a rigid motion; where this motion says that both crops show the same, a head at 1/4
resolution compares them and gives the fine flow with its confidence in three factors: visibility, precision and
certainty (GenFlow: Moon et al., 2024). The paper's heads stand on the rendered cells, and beside them a score: whether
the pose is right.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from posekit.nets.config import CELL, LiteConfig
from posekit.nets.heads import PoseHeads, Prediction, expand_angle
from posekit.nets.rigid import Motion, Surface, induced_flow, solve_motion

ANCHOR = 4  # pixels per anchor of the dense head; the first anchor is pixel (2, 2)
FACTS = 9  # see `facts_of`
PAIR = 11  # channels that the tower over both crops sees: two RGB pictures, mask, normals, relief


def conv_bn(cin: int, cout: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    """A convolution that keeps the size but for its stride, and batch normalisation."""
    return nn.Sequential(nn.Conv2d(cin, cout, kernel, stride, kernel // 2, bias=False), nn.BatchNorm2d(cout))


class Residual(nn.Module):
    """Two 3x3 convolutions and a shortcut: (B, cin, H, W) -> (B, cout, H / stride, W / stride)."""

    def __init__(self, cin: int, cout: int, stride: int = 1) -> None:
        super().__init__()
        self.first = conv_bn(cin, cout, 3, stride)
        self.second = conv_bn(cout, cout)
        self.skip = nn.Identity() if stride == 1 and cin == cout else conv_bn(cin, cout, 1, stride)

    def forward(self, x: Tensor) -> Tensor:
        """(B, cin, H, W) -> (B, cout, H / stride, W / stride), not negative."""
        return F.relu(self.second(F.relu(self.first(x))) + self.skip(x))


class Tower(nn.Module):
    """(B, C, H, W) -> (B, widths[0], H/4, W/4) and (B, widths[1], H/8, W/8)."""

    def __init__(self, cin: int, widths: tuple[int, int]) -> None:
        super().__init__()
        fine, coarse = widths
        self.stem = conv_bn(16 * cin, fine)
        self.fine = Residual(fine, fine)
        self.coarse = Residual(fine, coarse, 2)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(B, C, H, W) -> features at 1/4 and at 1/8 of the size."""
        x = F.pixel_unshuffle(x, 4).contiguous(memory_format=torch.channels_last)
        fine = self.fine(F.relu(self.stem(x)))
        return fine, self.coarse(fine)


class Exchange(nn.Module):
    """One exchange between two crops, the same weights both ways: bottleneck convolutions within, attention across."""

    def __init__(self, channels: int, heads: int, bottleneck: int) -> None:
        super().__init__()
        self.heads = heads
        self.within = nn.Sequential(
            nn.BatchNorm2d(channels),
            nn.Conv2d(channels, bottleneck, 1, bias=False),
            nn.BatchNorm2d(bottleneck),
            nn.ReLU(),
            nn.Conv2d(bottleneck, bottleneck, 3, 1, 1, bias=False),
            nn.BatchNorm2d(bottleneck),
            nn.ReLU(),
            nn.Conv2d(bottleneck, channels, 1),
        )
        self.norm = nn.LayerNorm(channels)
        self.project = nn.Linear(channels, 3 * channels)
        self.join = nn.Linear(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        """x: (2B, C, h, w), the observed crops and then the rendered ones."""
        x = x + self.within(x)
        B, C, h, w = x.shape
        cells = x.permute(0, 2, 3, 1).reshape(B, h * w, C)
        q, k, v = self.project(self.norm(cells)).unflatten(2, (3, self.heads, -1)).transpose(1, 3).unbind(2)
        # of the other crop, (2B, heads, h * w, C / heads)
        other = [t.unflatten(0, (2, -1)).flip(0).flatten(0, 1) for t in (k, v)]
        found = attention(q, *other).transpose(1, 2).reshape(B, h * w, C)
        return (cells + self.join(found)).reshape(B, h, w, C).permute(0, 3, 1, 2)


class Summary(nn.Module):
    """The cells of a whole crop, and ``facts`` numbers beside them, as 256 numbers for the paper's heads."""

    def __init__(self, channels: int, size: tuple[int, int], facts: int = 0) -> None:
        super().__init__()
        h, w = size[1] // CELL, size[0] // CELL
        self.convs = nn.Sequential(nn.Conv2d(channels, 128, 3, 2, 1), nn.ReLU(), nn.Conv2d(128, 64, 3, 2, 1), nn.ReLU())
        cells = ((h + 3) // 4) * ((w + 3) // 4)
        self.fc = nn.Sequential(nn.Linear(64 * cells + facts, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU())

    def forward(self, x: Tensor, facts: Tensor | None = None) -> Tensor:
        """x: (B, channels, h, w). facts: (B, facts)."""
        seen = self.convs(x).flatten(1)
        return self.fc(seen if facts is None else torch.cat([seen, facts.to(seen.dtype)], dim=1))


class Dense(nn.Module):
    """The fine flow: compares both crops at 1/4 resolution where the coarse flow says that they match."""

    def __init__(self, config: LiteConfig) -> None:
        super().__init__()
        width = config.fine
        self.look = nn.Conv2d(config.widths[0], width, 1)
        self.know = nn.Conv2d(config.widths[1], width, 1)
        self.recall = nn.Conv2d(config.widths[0], width, 1)
        self.merge = nn.Sequential(conv_bn(4 * width + 2, 2 * width), nn.ReLU(), Residual(2 * width, 2 * width))
        self.out = nn.Conv2d(2 * width, 16, 1)  # five are used; fewer channels than 16 are slow or worse on the CPU

    def forward(self, observed: Tensor, rendered: Tensor, pair: Tensor, cells: Tensor, flow: Tensor) -> Tensor:
        """observed, rendered, pair: (B, C, h, w) at 1/4. cells: (B, C, h/2, w/2), rendered. flow: (B, 2, h, w), pixels.
        -> (B, 5, h, w): change of flow, log scale, visibility, certainty."""
        there = warp(self.look(observed), flow.detach() / ANCHOR)
        known = F.interpolate(self.know(cells), scale_factor=CELL / ANCHOR, mode="nearest")
        both = torch.cat(
            [self.look(rendered), there, self.recall(pair), known, (flow.detach() / 16).to(known.dtype)], dim=1
        )
        return self.out(self.merge(both))[:, :5].float()


class Silhouettes(nn.Module):
    """Where the observed crop shows the object, and where it would if nothing stood before it."""

    def __init__(self, config: LiteConfig) -> None:
        super().__init__()
        width = config.fine
        self.look = nn.Conv2d(config.widths[0], width, 1)
        self.know = nn.Conv2d(config.widths[1], width, 1)
        self.merge = nn.Sequential(conv_bn(2 * width, width), nn.ReLU(), nn.Conv2d(width, 16, 3, 1, 1))

    def forward(self, fine: Tensor, cells: Tensor) -> Tensor:
        """fine: (B, C, h, w) at 1/4 and cells: (B, C, h/2, w/2), observed -> (B, 2, h, w), logits: visible, whole."""
        known = F.interpolate(self.know(cells), scale_factor=CELL / ANCHOR, mode="nearest")
        return self.merge(torch.cat([self.look(fine), known], dim=1))[:, :2].float()


def warp(x: Tensor, flow: Tensor) -> Tensor:
    """x (B, C, h, w) looked up at each place plus ``flow`` (B, 2, h, w), in x's own cells; zero outside."""
    h, w = x.shape[-2:]
    column, row = (_grid(h, w, x) + flow).float().unbind(1)
    grid = torch.stack([(2 * column + 1) / w - 1, (2 * row + 1) / h - 1], dim=3)
    # bfloat16 has places to a quarter of a pixel only
    return F.grid_sample(x.float(), grid, align_corners=False, padding_mode="zeros").to(x.dtype)


def attention(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """Scaled dot-product attention; written out on a CPU, where that trains faster than torch's fused one."""
    if q.is_cuda:
        return F.scaled_dot_product_attention(q, k.to(q.dtype), v.to(q.dtype))
    with torch.autocast(q.device.type, enabled=False):
        return torch.softmax((q * q.shape[-1] ** -0.5) @ k.transpose(2, 3), dim=3) @ v


def similarity_of(rendered: Tensor, observed: Tensor) -> Tensor:
    """Cosines of all pairs of cells: two (B, C, h, w) -> (B, h * w, h * w), rendered first."""
    a, b = F.normalize(rendered.flatten(2), dim=1), F.normalize(observed.flatten(2), dim=1)
    return torch.einsum("bcn,bcm->bnm", a, b).float()


@dataclass(frozen=True, eq=False)
class LiteOutput:
    """All that the lite losses need. flows: (B, 2, h, w) in pixels on cells, coarse to fine.
    rigid: (B, 2, h, w) in pixels on anchors, what the motions solved from the coarse and the fine flow induce.
    compressed_angle: (B,). similarities: (B, h * w, h * w + 1), logits of which observed cell each rendered one is, the
    last of them none, before and after the exchange."""

    prediction: Prediction
    flows: list[Tensor]
    rigid: list[Tensor]
    compressed_angle: Tensor
    similarities: list[Tensor]


class LiteSVNet(nn.Module):
    """SV-Net of the lite preset."""

    def __init__(self, config: LiteConfig = LiteConfig()) -> None:
        super().__init__()
        self.config = config
        h, w = config.cells
        channels = config.widths[1]
        self.tower = Tower(3, config.widths)
        self.pair = Tower(PAIR, config.widths)
        self.place = nn.Parameter(nn.init.normal_(torch.empty(2, channels, h, w), std=0.02))  # observed, rendered
        self.exchange = nn.ModuleList(
            [Exchange(channels, config.heads, config.bottleneck) for _ in range(config.blocks)]
        )
        self.settle = nn.BatchNorm2d(channels)
        self.match = nn.Conv2d(channels, channels, 1)
        self.none = nn.Conv2d(channels, 1, 1)
        self.early_none = nn.Parameter(torch.tensor(2.0))
        self.sharpness = nn.Parameter(torch.tensor([10.0, 10.0]))
        self.coarse = nn.Sequential(
            conv_bn(channels + 4, config.bottleneck), nn.ReLU(), Residual(config.bottleneck, config.bottleneck),
            nn.Conv2d(config.bottleneck, 16, 1),
        )  # fmt: skip
        self.dense = Dense(config)
        self.silhouettes = Silhouettes(config)
        self.summary = Summary(channels + 5, config.size, FACTS)
        self.heads = PoseHeads(256, with_angle=True)
        self.score = nn.Linear(256, 1)

    def forward(self, observed: Tensor, rendered: Tensor, relief: Tensor, focal: Tensor) -> Prediction:
        """observed: (B, 3, H, W), RGB. rendered: (B, 4, H, W), RGB and mask. relief: (B, H, W), see ``inputs.relief``.
        focal: (B,), the focal length in widths of the crop."""
        return self.predict(observed, rendered, relief, focal).prediction

    def predict(self, observed: Tensor, rendered: Tensor, relief: Tensor, focal: Tensor) -> LiteOutput:
        """As ``forward``, with what the losses need."""
        B = observed.shape[0]
        mask = rendered[:, 3]
        fine, first = self.tower(torch.cat([observed, rendered[:, :3]]))
        place = self.place.to(first.dtype)
        shape = [rendered[:, 3:], normals_of(relief, mask), relief[:, None]]
        together, near = self.pair(torch.cat([observed, rendered[:, :3], *shape], dim=1))
        x = torch.cat([first[:B] + place[0], first[B:] + place[1] + near])
        for block in self.exchange:
            x = block(x)
        x = self.settle(x)
        cells = x[B:]
        matched = self.match(x).float()
        none = self.none(cells).float().flatten(2).transpose(1, 2)  # (B, h * w, 1)
        similarities = [
            with_none(self.sharpness[0] * similarity_of(first[B:].float(), first[:B].float()),
                      self.early_none.expand_as(none)),
            with_none(self.sharpness[1] * similarity_of(matched[B:], matched[:B]), none),
        ]  # fmt: skip
        flow, found = soft_flow(similarities[-1], self.config.cells)
        known = torch.cat([flow / CELL, found], dim=1).to(cells.dtype)
        coarse = self.coarse(torch.cat([cells, known], dim=1))[:, :3].float()
        better = flow + CELL * coarse[:, :2]
        on, heights = mask[:, 2::ANCHOR, 2::ANCHOR], relief[:, 2::ANCHOR, 2::ANCHOR]
        first_motion = self._rigid(heights, on, focal, better, coarse[:, 2])
        dense = self.dense(fine[:B], fine[B:], together, cells, first_motion)
        silhouettes = self.silhouettes(fine[:B], x[:B])
        log_scale = dense[:, 2].clamp(-3.0, 4.0)
        fine_flow = first_motion + dense[:, :2]
        weight = on * torch.sigmoid(dense[:, 3]) * torch.sigmoid(dense[:, 4]) * torch.exp(-2 * log_scale)
        surface = Surface.of(heights, focal, ANCHOR, 2.0)
        motion = solve_motion(surface, points_of(fine_flow), weight.flatten(1))
        rigid = [first_motion, induced_flow(surface, motion).transpose(1, 2).unflatten(2, on.shape[1:])]
        masks = torch.cat([F.avg_pool2d(torch.sigmoid(silhouettes.detach()), CELL // ANCHOR),
                           F.avg_pool2d(rendered[:, 3:], CELL)], dim=1)  # fmt: skip
        seen = [cells, (better.detach() / CELL).to(cells.dtype), masks.to(cells.dtype)]
        facts = facts_of(motion, on, log_scale, dense[:, 3]).detach()
        summary = self.summary(torch.cat(seen, dim=1), facts)
        quat, v, angle = self.heads(summary)
        assert angle is not None
        prediction = Prediction(
            quat, v, expand_angle(angle), fine_flow, log_scale, dense[:, 3], dense[:, 4], silhouettes,
            self.score(summary).float()[:, 0],
        )  # fmt: skip
        return LiteOutput(prediction, [flow, better], rigid, angle, similarities)

    def _rigid(self, relief: Tensor, on: Tensor, focal: Tensor, flow: Tensor, log_weight: Tensor) -> Tensor:
        """The flow (B, 2, H/4, W/4) that the motion explaining the cells' flow induces on the anchors."""
        share = F.avg_pool2d(on[:, None], 2)[:, 0]
        mean = F.avg_pool2d((relief * on)[:, None], 2)[:, 0] / share.clamp_min(0.25)
        weight = share * torch.exp(log_weight.clamp(-6.0, 6.0))
        motion = solve_motion(Surface.of(mean, focal, CELL, 3.5), points_of(flow), weight.flatten(1))
        return induced_flow(Surface.of(relief, focal, ANCHOR, 2.0), motion).transpose(1, 2).unflatten(2, on.shape[1:])


def facts_of(motion: Motion, on: Tensor, log_scale: Tensor, visibility: Tensor) -> Tensor:
    """A summary of the dense output, (B, FACTS), of the size of 1: the motion's turn (axis times sine, cosine)
    and shift, and over the object the mean log scale and visibility."""
    R, t = motion.R, motion.t
    turn = torch.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], dim=1)
    cosine = 0.5 * ((R * torch.eye(3, device=R.device)).sum((1, 2))[:, None] - 1)
    share = on / on.sum((1, 2), keepdim=True).clamp_min(1.0)
    means = [(x * share).sum((1, 2))[:, None] for x in (log_scale, torch.sigmoid(visibility))]
    return torch.cat([turn, 4 * (1 - cosine), (10 * t).clamp(-3, 3), *means], dim=1)


def points_of(flow: Tensor) -> Tensor:
    """(B, 2, h, w) -> (B, h * w, 2)."""
    return flow.flatten(2).transpose(1, 2)


def with_none(similarity: Tensor, none: Tensor) -> Tensor:
    """(B, n, m) and (B, n, 1) -> (B, n, m + 1): the last choice is that the cell is not shown."""
    return torch.cat([similarity, none.to(similarity.dtype)], dim=2)


def soft_flow(similarity: Tensor, cells: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """The mean place that the softmax over each rendered cell's similarities (B, h * w, h * w + 1) gives, as flow
    (B, 2, h, w) in pixels; and (B, 2, h, w), the largest share of one place and the share of none."""
    grid = _grid(*cells, similarity)
    share = torch.softmax(similarity[:, :, :-1], dim=2)
    place = torch.einsum("bnm,cm->bcn", share, grid[0].flatten(1))
    none = torch.sigmoid(similarity[:, :, -1] - torch.logsumexp(similarity[:, :, :-1], dim=2))
    found = torch.stack([share.amax(2), none], dim=1).unflatten(2, cells)
    return (place.unflatten(2, cells) - grid) * CELL, found


def normals_of(relief: Tensor, mask: Tensor) -> Tensor:
    """Unit normals (B, 3, H, W) of the rendered surface, towards the camera along -z; zero beside it.

    relief: (B, H, W), see ``inputs.relief``. mask: (B, H, W). Of the differences to the two neighbours the smaller one
    counts, so that a fold in depth is no slope.
    """
    height = relief * relief.shape[2]
    slopes = []
    for dim in (2, 1):
        count = height.shape[dim] - 1
        ahead = height.narrow(dim, 1, count) - height.narrow(dim, 0, count)
        both = (mask.narrow(dim, 1, count) - mask.narrow(dim, 0, count)).abs() < 0.5  # on the object, or beside it
        ahead = torch.where(both, ahead, torch.full_like(ahead, 1e3))
        edge = torch.full_like(ahead.narrow(dim, 0, 1), 1e3)
        forward, backward = torch.cat([ahead, edge], dim), torch.cat([edge, ahead], dim)
        slope = torch.where(forward.abs() < backward.abs(), forward, backward)
        slopes.append(torch.where(slope.abs() > 500.0, torch.zeros_like(slope), slope))
    up = torch.stack([*slopes, -torch.ones_like(height)], dim=1)
    return up * (mask / up.pow(2).sum(1).sqrt())[:, None]


def _grid(h: int, w: int, like: Tensor) -> Tensor:
    ys, xs = torch.meshgrid(*(torch.arange(n, device=like.device) for n in (h, w)), indexing="ij")
    return torch.stack([xs, ys]).to(dtype=torch.float32)[None]

"""The preset that a laptop runs: a shared tower, exchange between both crops, matching, a dense head.

A shared tower describes the observed and the rendered crop, another one the two laid over each other. Exchange blocks
(convolutions within a crop, attention across the two) tell every cell of one what the other shows, and the rendered
cells also know where their surface lies in space. Matching all pairs of cells gives a first flow (GMFlow's way: Xu et
al., 2022) and that a rigid motion; where this motion says that both crops show the same, a head at 1/4 resolution
compares them and gives the fine flow with its uncertainty and visibility. The paper's heads stand on the rendered
cells.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from posekit.nets.heads import PoseHeads, Prediction, expand_angle
from posekit.nets.rigid import Motion, Surface, induced_flow, solve_motion

CELL = 8  # pixels per cell
ANCHOR = 4  # pixels per anchor of the dense head; the first anchor is pixel (2, 2)
FACTS = 9  # see `facts_of`


@dataclass(frozen=True)
class LiteConfig:
    """size: (width, height) of the crop in pixels, multiples of 8. widths: channels at 1/4 and 1/8. heads: of the
    attention across. blocks: exchanges. fine: channels of the dense head."""

    size: tuple[int, int] = (160, 120)
    widths: tuple[int, int] = (96, 192)
    heads: int = 1
    blocks: int = 4
    fine: int = 64

    @property
    def cells(self) -> tuple[int, int]:
        """(rows, columns) at 1/8."""
        return self.size[1] // CELL, self.size[0] // CELL


def conv_bn(cin: int, cout: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(cin, cout, kernel, stride, kernel // 2, bias=False), nn.BatchNorm2d(cout))


class Residual(nn.Module):
    def __init__(self, cin: int, cout: int, stride: int = 1) -> None:
        super().__init__()
        self.first = conv_bn(cin, cout, 3, stride)
        self.second = conv_bn(cout, cout)
        self.skip = nn.Identity() if stride == 1 and cin == cout else conv_bn(cin, cout, 1, stride)

    def forward(self, x: Tensor) -> Tensor:
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
        x = F.pixel_unshuffle(x, 4).contiguous(memory_format=torch.channels_last)
        fine = self.fine(F.relu(self.stem(x)))
        return fine, self.coarse(fine)


class Exchange(nn.Module):
    """One exchange between two crops, the same weights both ways: 3x3 convolutions within, attention across."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.within = nn.Sequential(
            nn.BatchNorm2d(channels),
            nn.Conv2d(channels, channels, 3, 1, 1, bias=False),
            nn.BatchNorm2d(channels),
            nn.ReLU(),
            nn.Conv2d(channels, channels, 3, 1, 1),
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
        other = [t.roll(B // 2, 0) for t in (k, v)]  # (2B, heads, h * w, C / heads), of the other crop
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
        self.out = nn.Conv2d(2 * width, 16, 1)  # four are used; fewer channels than 16 are slow or worse on the CPU

    def forward(self, observed: Tensor, rendered: Tensor, pair: Tensor, cells: Tensor, flow: Tensor) -> Tensor:
        """observed, rendered, pair: (B, C, h, w) at 1/4. cells: (B, C, h/2, w/2), rendered. flow: (B, 2, h, w), pixels.
        -> (B, 4, h, w): change of flow, log scale, visibility."""
        there = warp(self.look(observed), flow.detach() / ANCHOR)
        known = F.interpolate(self.know(cells), scale_factor=CELL / ANCHOR, mode="nearest")
        both = torch.cat(
            [self.look(rendered), there, self.recall(pair), known, (flow.detach() / 16).to(known.dtype)], dim=1
        )
        return self.out(self.merge(both))[:, :4].float()


def warp(x: Tensor, flow: Tensor) -> Tensor:
    """x (B, C, h, w) looked up at each place plus ``flow`` (B, 2, h, w), in x's own cells; zero outside."""
    h, w = x.shape[-2:]
    place = (_grid(h, w, x) + flow).permute(0, 2, 3, 1)
    grid = (2 * place + 1) / place.new_tensor([w, h]) - 1
    return F.grid_sample(x, grid.to(x.dtype), align_corners=False, padding_mode="zeros")


def attention(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """Scaled dot-product attention, written out: trains faster on a CPU than torch's fused one, in bfloat16 too."""
    with torch.autocast(q.device.type, enabled=False):
        return torch.softmax((q * q.shape[-1] ** -0.5) @ k.transpose(2, 3), dim=3) @ v


def likeness_of(rendered: Tensor, observed: Tensor) -> Tensor:
    """Cosines of all pairs of cells: two (B, C, h, w) -> (B, h * w, h * w), rendered first."""
    a, b = F.normalize(rendered.flatten(2), dim=1), F.normalize(observed.flatten(2), dim=1)
    return torch.einsum("bcn,bcm->bnm", a, b).float()


@dataclass(frozen=True, eq=False)
class LiteOutput:
    """All that the lite losses look at. flows: (B, 2, h, w) in pixels on cells, coarse to fine.
    rigid: (B, 2, h, w) in pixels on anchors, what the motions solved from the coarse and the fine flow induce.
    compressed_angle: (B,). likenesses: (B, h * w, h * w), logits of which observed cell each rendered one is, before
    and after the exchange."""

    prediction: Prediction
    flows: list[Tensor]
    rigid: list[Tensor]
    compressed_angle: Tensor
    likenesses: list[Tensor]


class LiteSVNet(nn.Module):
    """SV-Net of the lite preset."""

    def __init__(self, config: LiteConfig = LiteConfig()) -> None:
        super().__init__()
        self.config = config
        h, w = config.cells
        channels = config.widths[1]
        self.tower = Tower(4, config.widths)
        self.pair = Tower(8, config.widths)
        self.place = nn.Parameter(0.02 * torch.randn(2, channels, h, w))  # of the cells, observed and rendered
        self.space = nn.Conv2d(1, channels, 2, 2)
        self.exchange = nn.ModuleList([Exchange(channels, config.heads) for _ in range(config.blocks)])
        self.settle = nn.BatchNorm2d(channels)
        self.match = nn.Conv2d(channels, channels, 1)
        self.sharpness = nn.Parameter(torch.tensor([10.0, 10.0]))
        self.coarse = nn.Sequential(conv_bn(channels + 3, 128), nn.ReLU(), Residual(128, 128), nn.Conv2d(128, 16, 1))
        self.dense = Dense(config)
        self.summary = Summary(channels + 4, config.size, FACTS)
        self.heads = PoseHeads(256, with_angle=True)

    def forward(self, observed: Tensor, rendered: Tensor, relief: Tensor, focal: Tensor) -> Prediction:
        """observed, rendered: (B, 4, H, W). relief: (B, H/4, W/4), see ``inputs.relief``. focal: (B,), the focal length
        in widths of the crop."""
        return self.predict(observed, rendered, relief, focal).prediction

    def predict(self, observed: Tensor, rendered: Tensor, relief: Tensor, focal: Tensor) -> LiteOutput:
        """As ``forward``, with what the losses need."""
        B = observed.shape[0]
        fine, first = self.tower(torch.cat([observed, rendered]))
        place = self.place.repeat_interleave(B, 0).to(first.dtype)
        together, near = self.pair(torch.cat([observed, rendered], dim=1))
        x = first + place + F.pad(near + self.space(relief[:, None]), (0, 0, 0, 0, 0, 0, B, 0))
        for block in self.exchange:
            x = block(x)
        x = self.settle(x)
        cells = x[B:]
        matched = self.match(x).float()
        likenesses = [self.sharpness[0] * likeness_of(first[B:].float(), first[:B].float()),
                      self.sharpness[1] * likeness_of(matched[B:], matched[:B])]  # fmt: skip
        flow, peak = soft_flow(likenesses[-1], self.config.cells)
        found = torch.cat([flow / CELL, peak], dim=1).to(cells.dtype)
        coarse = self.coarse(torch.cat([cells, found], dim=1))[:, :3].float()
        better = flow + CELL * coarse[:, :2]
        on = rendered[:, 3, 2::ANCHOR, 2::ANCHOR]
        first_motion = self._rigid(relief, on, focal, better, coarse[:, 2])
        dense = self.dense(fine[:B], fine[B:], together, cells, first_motion)
        log_scale = dense[:, 2].clamp(-3.0, 4.0)
        fine_flow = first_motion + dense[:, :2]
        weight = on * torch.sigmoid(dense[:, 3]) * torch.exp(-2 * log_scale)
        surface = Surface.of(relief, focal, ANCHOR, 2.0)
        motion = solve_motion(surface, points_of(fine_flow), weight.flatten(1))
        rigid = [first_motion, induced_flow(surface, motion).transpose(1, 2).unflatten(2, on.shape[1:])]
        masks = F.avg_pool2d(torch.cat([observed[:, 3:], rendered[:, 3:]], dim=1), CELL)
        known = [cells, (better.detach() / CELL).to(cells.dtype), masks.to(cells.dtype)]
        facts = facts_of(motion, on, log_scale, dense[:, 3]).detach()
        quat, v, angle = self.heads(self.summary(torch.cat(known, dim=1), facts))
        assert angle is not None
        prediction = Prediction(quat, v, expand_angle(angle), fine_flow, log_scale, dense[:, 3])
        return LiteOutput(prediction, [flow, better], rigid, angle, likenesses)

    def _rigid(self, relief: Tensor, on: Tensor, focal: Tensor, flow: Tensor, log_weight: Tensor) -> Tensor:
        """The flow (B, 2, H/4, W/4) that the motion explaining the cells' flow induces on the anchors."""
        share = F.avg_pool2d(on[:, None], 2)[:, 0]
        mean = F.avg_pool2d((relief * on)[:, None], 2)[:, 0] / share.clamp_min(0.25)
        weight = share * torch.exp(log_weight.clamp(-6.0, 6.0))
        motion = solve_motion(Surface.of(mean, focal, CELL, 3.5), points_of(flow), weight.flatten(1))
        return induced_flow(Surface.of(relief, focal, ANCHOR, 2.0), motion).transpose(1, 2).unflatten(2, on.shape[1:])


def facts_of(motion: Motion, on: Tensor, log_scale: Tensor, visibility: Tensor) -> Tensor:
    """What the dense answer says as a whole, (B, FACTS), of the size of 1: the motion's turn (axis times sine, cosine)
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


def soft_flow(likeness: Tensor, cells: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """The mean place that the softmax over each rendered cell's likenesses gives, as flow (B, 2, h, w) in pixels, and
    the largest share of one place (B, 1, h, w)."""
    home = _grid(*cells, likeness)
    share = torch.softmax(likeness, dim=2)
    place = torch.einsum("bnm,cm->bcn", share, home[0].flatten(1))
    return (place.unflatten(2, cells) - home) * CELL, share.amax(2).unflatten(1, cells)[:, None]


class LiteMVNet(nn.Module):
    """MV-Net of the lite preset: SV-Net's tower, one branch's weights for all views, the paper's fused heads.

    The observed crop passes the tower once; the views' features depend on the mesh alone and can be kept
    (``encode``, then ``match``). A branch sees, for each cell of a view, where in the observed crop it
    finds itself (the mean of the softmax over its correlations), how surely, and both features there.
    """

    def __init__(self, tower: Tower, config: LiteConfig = LiteConfig(), views: int = 6) -> None:
        super().__init__()
        self.tower, self.config, self.views = tower, config, views
        self.sharpness = nn.Parameter(torch.tensor(10.0))
        self.reduce = nn.Conv2d(2 * config.widths[1] + 4, 64, 1)
        self.summary = Summary(64, config.size)
        self.fc = nn.Linear(256 * views, 512)
        self.heads = PoseHeads(512, with_angle=False)

    def encode(self, pictures: Tensor) -> Tensor:
        """(N, 4, H, W) -> features (N, C + 1, H/8, W/8): the tower's, and the mask pooled to cells."""
        return torch.cat([self.tower(pictures)[1].float(), F.avg_pool2d(pictures[:, 3:], CELL)], dim=1)

    def match(self, observed: Tensor, views: Tensor) -> Prediction:
        """observed: (B, C + 1, h, w) and views: (B, M, C + 1, h, w) as ``encode`` gives them."""
        B, M, _, h, w = views.shape
        near = observed[:, None].expand(B, M, *observed.shape[1:]).flatten(0, 1)
        quat, v, _ = self.heads(F.relu(self.fc(self._branch(near, views.flatten(0, 1)).view(B, M * 256))))
        return Prediction(quat, v)

    def _branch(self, observed: Tensor, view: Tensor) -> Tensor:
        """Two (N, C + 1, h, w) -> (N, 256)."""
        h, w = view.shape[-2:]
        likeness = likeness_of(view[:, :-1], observed[:, :-1])
        share = torch.softmax(self.sharpness * likeness, dim=2)
        home = _grid(h, w, view).flatten(2)  # (1, 2, h * w)
        place = torch.einsum("npq,xcq->ncp", share, home)
        there = torch.einsum("npq,ncq->ncp", share, observed[:, :-1].flatten(2))
        moved = (place - home) / w
        found = torch.cat([moved, likeness.amax(2)[:, None], there, view.flatten(2)], dim=1)
        return self.summary(F.relu(self.reduce(found.unflatten(2, (h, w)))))

    def forward(self, observed: Tensor, views: Tensor) -> Prediction:
        """observed: (B, 4, H, W); views: (B, M, 4, H, W), the frontal one first."""
        return self.match(self.encode(observed), self.encode(views.flatten(0, 1)).unflatten(0, views.shape[:2]))


def _grid(h: int, w: int, like: Tensor) -> Tensor:
    ys, xs = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    return torch.stack([xs, ys]).to(device=like.device, dtype=torch.float32)[None]

"""The preset that a laptop runs: two towers, all-pairs correlation, a few recurrent updates, a dense head.

The family is RAFT's (Teed and Deng, 2020): features of both pictures at 1/8 resolution, the correlation of
every pair of cells, looked up around the current flow, and a convolutional GRU that improves the flow.
Beside it a context branch on all 8 channels, as DeepIM's encoder sees them, and the paper's heads on the
recurrent state. The dense head answers on a grid of anchors at 1/4 resolution.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from posekit.nets.heads import PoseHeads, Prediction, expand_angle

CELL = 8  # pixels per cell of the recurrent state
ANCHOR = 4  # pixels per anchor of the dense head; the first anchor is pixel (2, 2)


@dataclass(frozen=True)
class LiteConfig:
    """size: (width, height) of the crop in pixels, multiples of 8; widths: channels at 1/2, 1/4 and 1/8."""

    size: tuple[int, int] = (160, 120)
    widths: tuple[int, int, int] = (32, 64, 128)
    features: int = 128
    hidden: int = 96
    context: int = 96
    radius: int = 4
    levels: int = 2
    updates: int = 4


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
    """(B, C, H, W) -> (B, out, H/8, W/8)."""

    def __init__(self, cin: int, widths: tuple[int, int, int], out: int) -> None:
        super().__init__()
        a, b, c = widths
        self.stem = conv_bn(cin, a, 7, 2)
        self.body = nn.Sequential(Residual(a, b, 2), Residual(b, b), Residual(b, c, 2), Residual(c, c))
        self.out = nn.Conv2d(c, out, 1)

    def forward(self, x: Tensor) -> Tensor:
        return self.out(self.body(F.relu(self.stem(x))))


class Correlation:
    """The likeness of every rendered with every observed cell, pooled ``levels`` times, looked up around a flow.

    likeness: (B, h * w, h' * w'), rendered first. shape: (h, w), the same for both.
    """

    def __init__(self, likeness: Tensor, shape: tuple[int, int], levels: int, radius: int) -> None:
        (B, n, _), (h, w) = likeness.shape, shape
        pooled = likeness.reshape(B * n, 1, h, w)
        self.pyramid = [pooled]
        for _ in range(levels - 1):
            pooled = F.avg_pool2d(pooled, 2, ceil_mode=True, count_include_pad=False)
            self.pyramid.append(pooled)
        self.shape = (B, h, w)
        steps = torch.arange(-radius, radius + 1, device=likeness.device, dtype=torch.float32)
        self.window = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=-1)  # (d, d, 2), x first

    def lookup(self, centre: Tensor) -> Tensor:
        """centre: (B, 2, h, w), in cells -> (B, levels * (2r + 1)^2, h, w)."""
        B, h, w = self.shape
        at = centre.permute(0, 2, 3, 1).reshape(B * h * w, 1, 1, 2)
        found = []
        for level, volume in enumerate(self.pyramid):
            H, W = volume.shape[-2:]
            place = (at + 0.5) / 2**level - 0.5 + self.window  # (n, d, d, 2) in this level's cells
            grid = (2 * place + 1) / place.new_tensor([W, H]) - 1
            sampled = F.grid_sample(volume, grid, align_corners=False, padding_mode="zeros")
            found.append(sampled.reshape(B, h, w, -1))
        return torch.cat(found, dim=-1).permute(0, 3, 1, 2)


class Update(nn.Module):
    """One recurrent update: correlation and flow in, a better state and a change of flow out."""

    def __init__(self, config: LiteConfig) -> None:
        super().__init__()
        hidden = config.hidden
        looked_up = config.levels * (2 * config.radius + 1) ** 2
        self.from_correlation = nn.Sequential(nn.Conv2d(looked_up, 128, 1), nn.ReLU(), nn.Conv2d(128, 96, 3, 1, 1))
        self.from_flow = nn.Sequential(nn.Conv2d(2, 64, 3, 1, 1), nn.ReLU(), nn.Conv2d(64, 32, 3, 1, 1))
        self.motion = nn.Conv2d(128, hidden - 2, 3, 1, 1)
        self.gates = nn.Conv2d(2 * hidden, 2 * hidden, 3, 1, 1)
        self.candidate = nn.Conv2d(2 * hidden, hidden, 3, 1, 1)
        self.to_flow = nn.Sequential(nn.Conv2d(hidden, 96, 3, 1, 1), nn.ReLU(), nn.Conv2d(96, 2, 3, 1, 1))

    def forward(self, state: Tensor, context: Tensor, correlation: Tensor, flow: Tensor) -> tuple[Tensor, Tensor]:
        """context: (B, 3 * hidden, h, w), added to the gates; flow in cells. -> the new state, the change of flow."""
        both = torch.cat([F.relu(self.from_correlation(correlation)), F.relu(self.from_flow(flow))], dim=1)
        motion = torch.cat([F.relu(self.motion(both)), flow.to(both.dtype)], dim=1)
        context_gates, context_candidate = context.split([2 * state.shape[1], state.shape[1]], dim=1)
        gates = torch.sigmoid(self.gates(torch.cat([state, motion], dim=1)) + context_gates)
        keep, reset = gates.chunk(2, dim=1)
        candidate = torch.tanh(self.candidate(torch.cat([reset * state, motion], dim=1)) + context_candidate)
        state = (1 - keep) * state + keep * candidate
        return state, self.to_flow(state).float()


class Summary(nn.Module):
    """The recurrent state of the whole crop as 256 numbers, for the paper's heads."""

    def __init__(self, channels: int, size: tuple[int, int]) -> None:
        super().__init__()
        h, w = size[1] // CELL, size[0] // CELL
        self.convs = nn.Sequential(nn.Conv2d(channels, 128, 3, 2, 1), nn.ReLU(), nn.Conv2d(128, 64, 3, 2, 1), nn.ReLU())
        cells = ((h + 3) // 4) * ((w + 3) // 4)
        self.fc = nn.Sequential(nn.Linear(64 * cells, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU())

    def forward(self, x: Tensor) -> Tensor:
        return self.fc(self.convs(x).flatten(1))


def likeness_of(rendered: Tensor, observed: Tensor) -> Tensor:
    """Cosines of all pairs of cells: two (B, C, h, w) -> (B, h * w, h * w), rendered first."""
    a, b = F.normalize(rendered.flatten(2), dim=1), F.normalize(observed.flatten(2), dim=1)
    return torch.einsum("bcn,bcm->bnm", a, b).float()


@dataclass(frozen=True, eq=False)
class LiteOutput:
    """All that the lite losses look at. flows: (B, 2, h, w) in pixels after each update, on cells.
    compressed_angle: (B,). likeness: (B, h * w, h * w), logits of which observed cell each rendered one is."""

    prediction: Prediction
    flows: list[Tensor]
    compressed_angle: Tensor
    likeness: Tensor


class LiteSVNet(nn.Module):
    """SV-Net of the lite preset."""

    def __init__(self, config: LiteConfig = LiteConfig()) -> None:
        super().__init__()
        self.config = config
        a, b, c = config.widths
        self.tower = Tower(4, config.widths, config.features)
        self.context = Tower(8, (a, b, config.context), 4 * config.hidden)
        self.sharpness = nn.Parameter(torch.tensor(10.0))
        self.update = Update(config)
        self.dense = nn.Sequential(
            nn.Conv2d(config.hidden + config.context, 128, 3, 1, 1), nn.ReLU(), nn.Conv2d(128, 4 * 4, 1)
        )
        self.summary = Summary(config.hidden + 4, config.size)
        self.heads = PoseHeads(256, with_angle=True)
        self.to_dense_context = nn.Conv2d(4 * config.hidden, config.context, 1)

    def forward(self, observed: Tensor, rendered: Tensor) -> Prediction:
        """observed, rendered: (B, 4, H, W)."""
        return self.predict(observed, rendered).prediction

    def predict(self, observed: Tensor, rendered: Tensor) -> LiteOutput:
        """As ``forward``, with what the losses need."""
        B = observed.shape[0]
        features = self.tower(torch.cat([observed, rendered]))
        observed_features, rendered_features = features.float().chunk(2)
        pair = torch.cat([observed[:, :3], rendered[:, :3], observed[:, 3:], rendered[:, 3:]], dim=1)
        context = self.context(pair)
        state = torch.tanh(context[:, : self.config.hidden])
        gates = context[:, self.config.hidden :]
        h, w = state.shape[-2:]
        likeness = self.sharpness * likeness_of(rendered_features, observed_features)
        correlation = Correlation(likeness, (h, w), self.config.levels, self.config.radius)
        home = _grid(h, w, observed)
        flow = home.new_zeros(B, 2, h, w)
        flows = []
        for _ in range(self.config.updates):
            found = correlation.lookup(home + flow.detach())
            state, change = self.update(state, gates, found, flow.detach())
            flow = flow.detach() + change
            flows.append(flow * CELL)
        dense = self.dense(torch.cat([state, F.relu(self.to_dense_context(context))], dim=1)).float()
        dense = F.pixel_shuffle(dense, CELL // ANCHOR)  # (B, 4, 2h, 2w)
        fine = F.interpolate(flow * CELL, scale_factor=CELL / ANCHOR, mode="bilinear") + dense[:, :2]
        log_scale = dense[:, 2].clamp(-3.0, 4.0)
        masks = F.avg_pool2d(torch.cat([observed[:, 3:], rendered[:, 3:]], dim=1), CELL)
        summary = self.summary(torch.cat([state, flow.detach().to(state.dtype), masks.to(state.dtype)], dim=1))
        quat, v, angle = self.heads(summary)
        assert angle is not None
        prediction = Prediction(quat, v, expand_angle(angle), fine, log_scale, dense[:, 3])
        return LiteOutput(prediction, flows, angle, likeness)


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
        self.reduce = nn.Conv2d(2 * config.features + 4, 64, 1)
        self.summary = Summary(64, config.size)
        self.fc = nn.Linear(256 * views, 512)
        self.heads = PoseHeads(512, with_angle=False)

    def encode(self, pictures: Tensor) -> Tensor:
        """(N, 4, H, W) -> features (N, C + 1, H/8, W/8): the tower's, and the mask pooled to cells."""
        return torch.cat([self.tower(pictures).float(), F.avg_pool2d(pictures[:, 3:], CELL)], dim=1)

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

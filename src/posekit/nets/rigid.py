"""The rigid motion that a weighted flow implies, differentiable: Gauss-Newton on reprojection.

Training through it teaches the weights what a PnP solver does with them, and the flow what the pose needs (EPro-PnP,
Chen et al., 2022; GenFlow, Moon et al., 2024). The rendered surface is known only up to its distance, and that
suffices: lengths are in units of its mean depth, the focal length in widths of the crop.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

DAMPING = 1e-2  # of the normal equations' diagonal


@dataclass(frozen=True, eq=False)
class Surface:
    """The rendered surface at N anchors in B crops. points: (B, N, 3), along the view's axes, mean depth 1.
    anchors: (1, N, 2), where they are drawn, in pixels from the principal point. focal: (B,), pixels."""

    points: Tensor
    anchors: Tensor
    focal: Tensor

    @classmethod
    def of(cls, relief: Tensor, focal: Tensor, step: int, first: float) -> Surface:
        """relief: (B, h, w) of every ``step``-th pixel from ``first`` on. focal: (B,), in widths of the crop."""
        h, w = relief.shape[1:]
        ys, xs = torch.meshgrid(*(torch.arange(n, device=relief.device) for n in (h, w)), indexing="ij")
        x, y = xs * step + first - 0.5 * (w * step - 1), ys * step + first - 0.5 * (h * step - 1)
        anchors = torch.stack([x, y], dim=-1).view(1, h * w, 2)
        depth = (1 + relief / focal[:, None, None]).flatten(1)[..., None]
        pixels = focal * w * step
        return cls(torch.cat([anchors / pixels[:, None, None] * depth, depth], dim=2), anchors, pixels)


@dataclass(frozen=True, eq=False)
class Motion:
    """R: (B, 3, 3) about (0, 0, 1). t: (B, 3), in mean depths."""

    R: Tensor
    t: Tensor

    @classmethod
    def none(cls, like: Tensor) -> Motion:
        """The identity for each of a batch; like: (B, ...), whose device it takes."""
        B = like.shape[0]
        return cls(torch.eye(3, device=like.device).expand(B, 3, 3), torch.zeros(B, 3, device=like.device))


def moved(surface: Surface, motion: Motion) -> tuple[Tensor, Tensor]:
    """The points about the centre after the turn (B, N, 3), and in front of the camera (B, N, 3)."""
    centre = surface.points.new_tensor([0.0, 0.0, 1.0])
    arm = (surface.points - centre) @ motion.R.transpose(1, 2)
    return arm, arm + centre + motion.t[:, None]


def induced_flow(surface: Surface, motion: Motion) -> Tensor:
    """Where the motion takes the anchors, (B, N, 2) in pixels."""
    _, p = moved(surface, motion)
    return p[..., :2] / p[..., 2:].clamp_min(0.1) * surface.focal[:, None, None] - surface.anchors


def solve_motion(surface: Surface, flow: Tensor, weight: Tensor, steps: int = 3) -> Motion:
    """The motion that explains a flow (B, N, 2) best, weighted by ``weight`` (B, N), not negative.

    The gradient passes through the last step alone: at the optimum that is the whole of it.
    """
    motion = Motion.none(flow[:1])  # broadcast, so that a traced graph holds for any batch
    for k in range(steps):
        last = k == steps - 1
        with torch.set_grad_enabled(last and torch.is_grad_enabled()), torch.autocast(flow.device.type, enabled=False):
            motion = _step(surface, motion, flow, weight)
    return motion


def _step(surface: Surface, motion: Motion, flow: Tensor, weight: Tensor) -> Motion:
    arm, p = moved(surface, motion)
    z = p[..., 2].clamp_min(0.1)
    f = surface.focal[:, None] / z
    residual = surface.anchors + flow - p[..., :2] * f[..., None]
    zero = torch.zeros_like(z)
    to_t = torch.stack([f, zero, -f * p[..., 0] / z, zero, f, -f * p[..., 1] / z], dim=-1).unflatten(2, (2, 3))
    # d(p)/d(turn) = -[arm]x, row by row of the projection
    turn = torch.linalg.cross(arm[:, :, None].expand(-1, -1, 2, -1), to_t, dim=3)
    J = torch.cat([turn, to_t], dim=3)  # (B, N, 2, 6)
    # the damping needs one scale for turns and shifts: a shift of a mean depth moves points f pixels
    share = weight / weight.sum(1, keepdim=True).clamp_min(1e-6)
    weighted = J * share[..., None, None]
    A = torch.einsum("bnki,bnkj->bij", weighted, J)
    g = torch.einsum("bnki,bnk->bi", weighted, residual)
    eye = torch.eye(6, device=A.device)
    delta = solved(A + eye * (DAMPING * A + 1e-6), g)
    return Motion(exp_so3(delta[:, :3]) @ motion.R, motion.t + delta[:, 3:])


def solved(A: Tensor, g: Tensor) -> Tensor:
    """x with A x = g; A (B, N, N) positive definite, g (B, N).

    While the network is traced for another runtime: Gauss-Jordan without pivots, in operations that each of them has.
    """
    if not torch.jit.is_tracing():  # type: ignore[attr-defined, no-untyped-call]
        return torch.linalg.solve_ex(A, g[..., None])[0][..., 0]  # unlike solve it does not wait for a GPU
    N = A.shape[1]
    M, eye = torch.cat([A, g[..., None]], dim=2), torch.eye(N)
    for k in range(N):
        M = M - (M[:, :, k : k + 1] - eye[:, k : k + 1]) * (M[:, k : k + 1] / M[:, k : k + 1, k : k + 1])
    return M[:, :, N]


def exp_so3(w: Tensor) -> Tensor:
    """Rotation vectors (B, 3) -> matrices (B, 3, 3), smooth at zero."""
    theta2 = (w * w).sum(1)[:, None, None]
    theta = torch.sqrt(theta2 + 1e-12)
    x, y, z = w.unbind(1)
    o = torch.zeros_like(x)
    K = torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=1).view(-1, 3, 3)
    eye = torch.eye(3, device=w.device)
    return eye + torch.sin(theta) / theta * K + (1 - torch.cos(theta)) / (theta2 + 1e-12) * (K @ K)

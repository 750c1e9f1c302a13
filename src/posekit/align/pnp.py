"""Pose from weighted correspondences, starting from a pose that is roughly right."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from posekit.camera import Camera
from posekit.geometry import Pose, nearest_rotation, so3_exp

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PnpConfig:
    """iterations: Gauss-Newton steps. knee: residual, in predicted standard deviations, at which a point loses half
    of its weight (Cauchy). prior: how strongly a step is damped, as a share of the Hessian's diagonal."""

    iterations: int = 12
    knee: float = 2.5
    prior: float = 1e-3
    min_points: int = 12


def solve_pnp(
    points: ArrayLike,
    pixels: ArrayLike,
    weight: ArrayLike,
    scale_px: ArrayLike,
    camera: Camera,
    start: Pose,
    config: PnpConfig = PnpConfig(),
) -> Pose | None:
    """The ``T_view_ctr`` that best projects points to pixels: iteratively reweighted Gauss-Newton.

    points: (N, 3) metres in ``ctr``. pixels: (N, 2), pixel centres in ``camera``. weight: (N,), 0 to 1 (visibility).
    scale_px: (N,), each pixel's expected error. start: the pose to improve. None where too few points carry weight
    or the pose left the camera's front.

    Residuals are measured in units of scale_px; the robust knee starts at the residuals' own size and tightens,
    so that a start far away does not make every point an outlier.
    """
    X, target = np.asarray(points, dtype=np.float64), np.asarray(pixels, dtype=np.float64)
    visible, sigma = np.asarray(weight, dtype=np.float64), np.asarray(scale_px, dtype=np.float64)
    if (visible > 0.1).sum() < config.min_points:
        return None
    R, t = start.R, start.t
    for _ in range(config.iterations):
        p = X @ R.T
        q = p + t
        if q[:, 2].min() < 1e-3:
            return None
        residual = (camera.project(q) - target) / sigma[:, None]
        size = np.linalg.norm(residual, axis=1)
        knee = max(config.knee, 1.5 * float(np.median(size)))
        w = visible / (1 + (size / knee) ** 2) / sigma**2
        J = projection_jacobian(p, q, camera)  # (N, 2, 6)
        weighted = J * w[:, None, None]
        H = np.einsum("nij,nik->jk", weighted, J)
        g = np.einsum("nij,ni->j", weighted, residual * sigma[:, None])
        step = -np.linalg.solve(H + config.prior * np.diag(np.diag(H)) + 1e-12 * np.eye(6), g)
        R, t = so3_exp(step[:3]) @ R, t + step[3:]
        if not np.isfinite(t).all() or t[2] < 1e-3:
            return None
        if np.abs(step[:3]).max() < 1e-6 and np.abs(step[3:]).max() < 1e-7:
            break
    return Pose(nearest_rotation(R), t)


def projection_jacobian(p: Array, q: Array, camera: Camera) -> Array:
    """d project(exp(w) p + t) / d(w, t) at zero; p: (N, 3) rotated points, q = p + t -> (N, 2, 6)."""
    x, y, z = p.T
    depth = q[:, 2]
    right, down = camera.fx / depth, camera.fy / depth
    across, along = -right * q[:, 0] / depth, -down * q[:, 1] / depth
    none = np.zeros(len(q))
    # a row d of the derivative by t gives p x d by w
    rows = [
        [y * across, z * right - x * across, -y * right, right, none, across],
        [y * along - z * down, -x * along, x * down, none, down, along],
    ]
    return np.array(rows).transpose(2, 0, 1)

"""Pose from weighted correspondences, starting from a pose that is roughly right."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from posekit.align.gauss_newton import NEAREST, Equations, cauchy, normal_equations, projection_jacobian, solve
from posekit.camera import Camera
from posekit.geometry import Pose

Array = NDArray[np.float64]

STILL = 1e-7  # a step in radians, or in distances of the object, that ends the loop


@dataclass(frozen=True)
class PnpConfig:
    """How `solve_pnp` works."""

    iterations: int = 12  # Gauss-Newton steps
    knee: float = 2.5  # residual, in predicted standard deviations, at which a point loses half of its weight (Cauchy)
    damping: float = 1e-3  # of a step, as a share of the normal matrix's diagonal
    min_points: int = 12  # with a weight above 0.1


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

    def equations(pose: Pose, _: Array) -> Equations | None:
        p = X @ pose.R.T
        q = p + pose.t
        if q[:, 2].min() < NEAREST:
            return None
        residual = camera.project(q) - target
        w = visible * cauchy(np.linalg.norm(residual, axis=1) / sigma, config.knee) / sigma**2
        normal, right = normal_equations(projection_jacobian(p, q, camera), residual, w)
        return normal + config.damping * np.diag(np.diag(normal)) + 1e-12 * np.eye(6), right

    found = solve(start, equations, steps=config.iterations, still=STILL)
    return None if found is None else found.pose

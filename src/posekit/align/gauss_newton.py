"""The Gauss-Newton solver of every pose, and the residuals that it weighs.

A step is a small turn (radians) and shift (metres) about the object's centre, in the axes of one camera. Each kind of
evidence gives normal equations of that step, robustly weighted; what was known of the pose before is one of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.geometry import Pose, nearest_rotation, so3_exp, so3_log

Array = NDArray[np.float64]
Equations = tuple[Array, Array]  # normal matrix (6 + k, 6 + k) and right side (6 + k,)

NEAREST = 1e-3  # metres before the camera


@dataclass(frozen=True, eq=False)
class Solution:
    """pose: ``T_cam_ctr``. extra: (k,), unknowns beside the pose. normal: (6 + k, 6 + k), the last normal matrix."""

    pose: Pose
    extra: Array
    normal: Array


def solve(
    start: Pose,
    equations: Callable[[Pose, Array], Equations | None],
    *,
    steps: int,
    still: float,
    extra: int = 0,
    nearest: float = NEAREST,
) -> Solution | None:
    """Gauss-Newton steps from a ``T_cam_ctr`` on.

    equations: the normal equations of turn, shift and the ``extra`` further unknowns (which start at zero) at a pose;
    None where there are none, which ends in None. steps: at most. still: the turn (radians) and shift (share of the
    distance) that end the loop. None too where the pose comes nearer than ``nearest`` (metres) to the camera.
    """
    pose, more, normal = start, np.zeros(extra), np.eye(6 + extra)
    for _ in range(steps):
        found = equations(pose, more)
        if found is None:
            return None
        normal, right = found
        step = np.linalg.solve(normal, right)
        pose, more = Pose(so3_exp(step[:3]) @ pose.R, pose.t + step[3:6]), more + step[6:]
        if not np.isfinite(pose.matrix).all() or pose.t[2] < nearest:
            return None
        if np.abs(step[:3]).max() < still and np.abs(step[3:6]).max() < still * pose.t[2]:
            break
    return Solution(Pose(nearest_rotation(pose.R), pose.t), more, normal)


class Residual(Protocol):
    """One kind of evidence for a pose."""

    def equations(self, pose: Pose, camera: Camera, /) -> Equations:
        """Normal matrix (6, 6) and right side (6,) of a small turn (radians) and shift (metres) of ``T_view_ctr``."""
        ...


@dataclass(frozen=True, eq=False)
class GaussianPose:
    """A pose and how well it is known.

    pose: ``T_view_ctr``. information: (6, 6), the inverse covariance of its turn (radians) and shift (metres).
    """

    pose: Pose
    information: Array

    @classmethod
    def about(cls, pose: Pose, camera: Camera, turn: float, shift: float, depth: float) -> GaussianPose:
        """turn: standard deviation in radians; shift: in pixels; depth: as a share of the distance."""
        distance = float(pose.t[2])
        sideways = shift / camera.fx * distance
        return cls(pose, np.diag(np.array([turn] * 3 + [sideways] * 2 + [depth * distance]) ** -2.0))

    @property
    def turn_std(self) -> float:
        """Standard deviation of the rotation, radians."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))

    @property
    def covariance(self) -> Array:
        """(6, 6), of turn (radians) and shift (metres)."""
        return np.asarray(np.linalg.inv(self.information))

    def turned(self, R: Array) -> GaussianPose:
        """The same in axes turned by R (3, 3)."""
        both = np.kron(np.eye(2), R)
        return GaussianPose(Pose.rotation(R) @ self.pose, both @ self.information @ both.T)

    def spread(self, covariance: Array) -> GaussianPose:
        """The same, less certain by a covariance (6, 6)."""
        return replace(self, information=np.asarray(np.linalg.inv(self.covariance + covariance)))

    def equations(self, pose: Pose, _: Camera) -> Equations:
        """As `Residual.equations`."""
        back = np.concatenate([so3_log(self.pose.R @ pose.R.T), self.pose.t - pose.t])
        return self.information, self.information @ back


@dataclass(frozen=True, eq=False)
class Points:
    """Points of the object that were seen at pixels.

    points: (N, 3) metres in ``ctr``. pixels: (N, 2). weight: (N,), 0 to 1. sigma: (N,), standard deviations in pixels.
    knee: in standard deviations, where a point loses three quarters of its weight (Geman and McClure). correlated: the
    number of them whose errors are correlated, which count as one.
    """

    points: Array
    pixels: Array
    weight: Array
    sigma: Array
    knee: float = 3.0
    correlated: float = 1.0

    def equations(self, pose: Pose, camera: Camera) -> Equations:
        """As `Residual.equations`."""
        arm, there = _placed(self.points, pose)
        residual = camera.project(there) - self.pixels
        size = np.linalg.norm(residual, axis=1) / self.sigma
        weight = geman_mcclure(size, self.knee) * self.weight / (self.sigma**2 * self.correlated)
        return normal_equations(projection_jacobian(arm, there, camera), residual, weight)


@dataclass(frozen=True, eq=False)
class Lines:
    """Points of the object's silhouette edge that lie somewhere on lines in the picture.

    points: (N, 3) metres in ``ctr``. places: (N, 2), a pixel of each line. normals: (N, 2), unit, across it.
    sigma: (N,), standard deviations across it in pixels. knee, correlated: as for `Points`.
    """

    points: Array
    places: Array
    normals: Array
    sigma: Array
    knee: float = 3.0
    correlated: float = 4.0

    def equations(self, pose: Pose, camera: Camera) -> Equations:
        """As `Residual.equations`."""
        arm, there = _placed(self.points, pose)
        residual = np.einsum("ni,ni->n", self.normals, camera.project(there) - self.places)
        weight = geman_mcclure(np.abs(residual) / self.sigma, self.knee) / (self.sigma**2 * self.correlated)
        along = np.einsum("ni,nij->nj", self.normals, projection_jacobian(arm, there, camera))
        return normal_equations(along[:, None], residual[:, None], weight)


def fuse(
    start: Pose, residuals: Sequence[Residual], camera: Camera, steps: int = 6, still: float = 5e-4
) -> GaussianPose | None:
    """The ``T_view_ctr`` on which the residuals agree best, from ``start`` on; see `solve`. All of them must determine
    it: a `GaussianPose` among them does. None where it leaves the camera's front."""

    def equations(pose: Pose, _: Array) -> Equations:
        parts = [residual.equations(pose, camera) for residual in residuals]
        return np.add.reduce([normal for normal, _ in parts]), np.add.reduce([right for _, right in parts])

    found = solve(start, equations, steps=steps, still=still)
    return None if found is None else GaussianPose(found.pose, found.normal)


def normal_equations(jacobian: Array, residual: Array, weight: Array) -> Equations:
    """Of weighted least squares. jacobian: (N, D, K); residual: (N, D); weight: (N,)."""
    K = jacobian.shape[2]
    weighted = (jacobian * weight[:, None, None]).reshape(-1, K)
    return weighted.T @ jacobian.reshape(-1, K), -weighted.T @ residual.ravel()


def geman_mcclure(size: Array, knee: float) -> Array:
    """Robust weights (N,) of residuals (N,) without sign, a quarter at the knee, which starts where the residuals are,
    so that a start far away keeps them."""
    return np.asarray(1 / (1 + (size / _widened(size, knee)) ** 2) ** 2)


def cauchy(size: Array, knee: float) -> Array:
    """Robust weights (N,) of residuals (N,) without sign, a half at the knee; else as `geman_mcclure`."""
    return np.asarray(1 / (1 + (size / _widened(size, knee)) ** 2))


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


def _widened(size: Array, knee: float) -> float:
    middle = len(size) // 2
    return max(knee, 1.5 * float(np.partition(size, middle)[middle])) if len(size) else knee


def _placed(points: Array, pose: Pose) -> tuple[Array, Array]:
    """Points (N, 3) of ``ctr`` turned, and in the view, before the camera."""
    arm = points @ pose.R.T
    there = arm + pose.t
    there[:, 2] = np.maximum(there[:, 2], NEAREST)
    return arm, there

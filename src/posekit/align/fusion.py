"""Several kinds of evidence for one pose, each weighed by what it can tell.

Gauss-Newton about the object's centre, in the axes of one view: every term gives equations that are linear in a small
turn and shift, robustly weighted. What was believed before is one of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from posekit.align.pnp import projection_jacobian
from posekit.camera import Camera
from posekit.geometry import Pose, nearest_rotation, so3_exp, so3_log

Array = NDArray[np.float64]

STILL = 5e-4  # a step in radians, or in distances of the object, that ends the loop
NEAREST = 1e-3  # metres before the camera


class Term(Protocol):
    """Evidence."""

    def equations(self, pose: Pose, camera: Camera, /) -> tuple[Array, Array]:
        """Normal matrix (6, 6) and right side (6,) of a small turn (radians) and shift (metres) of ``T_view_ctr``."""
        ...


@dataclass(frozen=True, eq=False)
class Belief:
    """What is held to be the pose, and how firmly.

    pose: ``T_view_ctr``. information: (6, 6), the inverse covariance of its turn (radians) and shift (metres).
    """

    pose: Pose
    information: Array

    @classmethod
    def about(cls, pose: Pose, camera: Camera, turn: float, shift: float, depth: float) -> Belief:
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
        return np.asarray(np.linalg.inv(self.information))

    def turned(self, R: Array) -> Belief:
        """The same in axes turned by R (3, 3)."""
        both = np.kron(np.eye(2), R)
        return Belief(Pose.rotation(R) @ self.pose, both @ self.information @ both.T)

    def spread(self, covariance: Array) -> Belief:
        """Held less firmly, by a covariance (6, 6)."""
        return replace(self, information=np.asarray(np.linalg.inv(self.covariance + covariance)))

    def equations(self, pose: Pose, _: Camera) -> tuple[Array, Array]:
        back = np.concatenate([so3_log(self.pose.R @ pose.R.T), self.pose.t - pose.t])
        return self.information, self.information @ back


@dataclass(frozen=True, eq=False)
class Points:
    """Points of the object that were seen at pixels.

    points: (N, 3) metres in ``ctr``. pixels: (N, 2). weight: (N,), 0 to 1. sigma: (N,), standard deviations in pixels.
    knee: in standard deviations, where a point loses three quarters of its weight (Geman and McClure). together: so
    many of them err alike.
    """

    points: Array
    pixels: Array
    weight: Array
    sigma: Array
    knee: float = 3.0
    together: float = 1.0

    def equations(self, pose: Pose, camera: Camera) -> tuple[Array, Array]:
        arm, there = _placed(self.points, pose)
        residual = camera.project(there) - self.pixels
        size = np.linalg.norm(residual, axis=1) / self.sigma
        weight = _robust(size, self.knee) * self.weight / (self.sigma**2 * self.together)
        along = projection_jacobian(arm, there, camera)
        weighted = (along * weight[:, None, None]).reshape(-1, 6)
        return weighted.T @ along.reshape(-1, 6), -weighted.T @ residual.ravel()


@dataclass(frozen=True, eq=False)
class Lines:
    """Points of the object's outline that lie somewhere on lines in the picture.

    points: (N, 3) metres in ``ctr``. places: (N, 2), a pixel of each line. normals: (N, 2), unit, across it.
    sigma: (N,), standard deviations across it in pixels. knee, together: as for `Points`.
    """

    points: Array
    places: Array
    normals: Array
    sigma: Array
    knee: float = 3.0
    together: float = 4.0

    def equations(self, pose: Pose, camera: Camera) -> tuple[Array, Array]:
        arm, there = _placed(self.points, pose)
        residual = np.einsum("ni,ni->n", self.normals, camera.project(there) - self.places)
        weight = _robust(np.abs(residual) / self.sigma, self.knee) / (self.sigma**2 * self.together)
        along = np.einsum("ni,nij->nj", self.normals, projection_jacobian(arm, there, camera))
        weighted = along * weight[:, None]
        return weighted.T @ along, -weighted.T @ residual


def fuse(start: Pose, terms: Sequence[Term], camera: Camera, steps: int = 6) -> Belief | None:
    """The ``T_view_ctr`` on which the terms agree best, from ``start`` on. Together they must determine it: a `Belief`
    among them does. None where it leaves the camera's front."""
    pose, normal = start, np.eye(6)
    for _ in range(steps):
        parts = [term.equations(pose, camera) for term in terms]
        normal = np.add.reduce([part for part, _ in parts])
        step = np.linalg.solve(normal, np.add.reduce([right for _, right in parts]))
        pose = Pose(so3_exp(step[:3]) @ pose.R, pose.t + step[3:])
        if not np.isfinite(pose.t).all() or pose.t[2] < NEAREST:
            return None
        if np.abs(step[:3]).max() < STILL and np.abs(step[3:]).max() < STILL * pose.t[2]:
            break
    return Belief(Pose(nearest_rotation(pose.R), pose.t), normal)


def _placed(points: Array, pose: Pose) -> tuple[Array, Array]:
    """Points (N, 3) of ``ctr`` turned, and in the view, before the camera."""
    arm = points @ pose.R.T
    there = arm + pose.t
    there[:, 2] = np.maximum(there[:, 2], NEAREST)
    return arm, there


def _robust(size: Array, knee: float) -> Array:
    """Geman and McClure's weights; the knee starts where the residuals are, so that a start far away keeps them."""
    middle = len(size) // 2
    widened = max(knee, 1.5 * float(np.partition(size, middle)[middle])) if len(size) else knee
    return np.asarray(1 / (1 + (size / widened) ** 2) ** 2)

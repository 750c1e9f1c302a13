"""Rigid poses as values, and how to disturb them. NumPy only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Pose:
    """A rigid transform ``T_a_b``: ``p_a = R @ p_b + t``.

    R: (3, 3) rotation; t: (3,) metres. Both float64 and read-only.
    """

    R: Array
    t: Array

    def __post_init__(self) -> None:
        R = np.array(self.R, dtype=np.float64).reshape(3, 3)
        t = np.array(self.t, dtype=np.float64).reshape(3)
        R.setflags(write=False)
        t.setflags(write=False)
        object.__setattr__(self, "R", R)
        object.__setattr__(self, "t", t)

    @classmethod
    def identity(cls) -> Pose:
        """The transform that moves nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def translation(cls, t: ArrayLike) -> Pose:
        """A pure translation; t: (3,) metres."""
        return cls(np.eye(3), np.asarray(t))

    @classmethod
    def rotation(cls, R: ArrayLike) -> Pose:
        """A pure rotation; R: (3, 3)."""
        return cls(np.asarray(R), np.zeros(3))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Pose:
        """matrix: (4, 4) or (3, 4). Raises ValueError where the rotation is not one (to 1e-3)."""
        m = np.asarray(matrix, dtype=np.float64)
        if m.shape not in ((4, 4), (3, 4)):
            raise ValueError(f"a pose matrix has shape (4, 4) or (3, 4), not {m.shape}")
        R = m[:3, :3]
        if not np.isfinite(m).all() or np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
            raise ValueError("the upper left 3x3 of the pose matrix is not a rotation")
        return cls(nearest_rotation(R), m[:3, 3])

    @property
    def matrix(self) -> Array:
        """(4, 4)."""
        m = np.eye(4)
        m[:3, :3] = self.R
        m[:3, 3] = self.t
        return m

    @property
    def quat_wxyz(self) -> Array:
        """(4,), w >= 0."""
        return rotation_to_quat(self.R)

    def inverse(self) -> Pose:
        """``T_b_a`` of ``T_a_b``."""
        return Pose(self.R.T, -self.R.T @ self.t)

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(self.R @ other.R, self.R @ other.t + self.t)

    def apply(self, points: ArrayLike) -> Array:
        """points: (..., 3) in b -> (..., 3) in a."""
        return np.asarray(points, dtype=np.float64) @ self.R.T + self.t


def nearest_rotation(R: ArrayLike) -> Array:
    """The rotation nearest to R (3, 3) in the Frobenius norm."""
    u, _, vt = np.linalg.svd(np.asarray(R, dtype=np.float64))
    return u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt


def hat(w: ArrayLike) -> Array:
    """w: (..., 3) -> skew matrices (..., 3, 3) with ``hat(w) @ v = cross(w, v)``."""
    w = np.asarray(w, dtype=np.float64)
    m = np.zeros((*w.shape[:-1], 3, 3))
    m[..., 0, 1], m[..., 0, 2], m[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    m[..., 1, 0], m[..., 2, 0], m[..., 2, 1] = w[..., 2], -w[..., 1], w[..., 0]
    return m


def so3_exp(w: ArrayLike) -> Array:
    """Rotation vectors (..., 3) in radians -> rotations (..., 3, 3). Accurate near zero."""
    w = np.asarray(w, dtype=np.float64)
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    W = hat(w)
    a = np.sinc(angle / np.pi)
    b = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.eye(3) + a * W + b * (W @ W)


def so3_log(R: ArrayLike) -> Array:
    """A rotation (3, 3) -> its rotation vector (3,), angle in [0, pi]."""
    q = rotation_to_quat(R)
    s = np.linalg.norm(q[1:])
    if s < 1e-9:
        return 2.0 * q[1:]
    return q[1:] * (2.0 * np.arctan2(s, q[0]) / s)


def rotation_angle(R: ArrayLike) -> Array:
    """Geodesic angle of rotations (..., 3, 3), radians in [0, pi]. Accurate near 0 and pi."""
    R = np.asarray(R, dtype=np.float64)
    sin2 = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1)
    return np.arctan2(np.linalg.norm(sin2, axis=-1), np.trace(R, axis1=-2, axis2=-1) - 1.0)


def rotation_to_quat(R: ArrayLike) -> Array:
    """(3, 3) -> (4,) wxyz with w >= 0 (Shepperd's choice of the largest component)."""
    m = np.asarray(R, dtype=np.float64)
    K = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], 0, 0, 0],
            [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], 0, 0],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], 0],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    full = K + np.tril(K, -1).T + np.eye(4)  # equals 4 q q^T for an exact rotation
    column = full[int(np.argmax(np.diag(full)))]
    q = column / np.linalg.norm(column)
    return -q if q[0] < 0 else q


def quat_to_rotation(quat_wxyz: ArrayLike) -> Array:
    """(4,) wxyz, any non-zero length -> (3, 3)."""
    q = np.asarray(quat_wxyz, dtype=np.float64)
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def euler_xyz(angles: ArrayLike) -> Array:
    """Angles (3,) in radians -> ``Rz @ Ry @ Rx`` (3, 3)."""
    ax, ay, az = np.asarray(angles, dtype=np.float64)
    return so3_exp([0, 0, az]) @ so3_exp([0, ay, 0]) @ so3_exp([ax, 0, 0])


def rotation_between(a: ArrayLike, b: ArrayLike) -> Array:
    """The smallest rotation (3, 3) with ``R @ a`` parallel to ``b``; a, b: (3,), not opposite."""
    a = np.asarray(a, dtype=np.float64) / np.linalg.norm(a)
    b = np.asarray(b, dtype=np.float64) / np.linalg.norm(b)
    v = np.cross(a, b)
    W = hat(v)
    return np.eye(3) + W + W @ W / (1.0 + float(a @ b))


def random_rotation(rng: np.random.Generator) -> Array:
    """Uniform over SO(3), (3, 3)."""
    return quat_to_rotation(rng.normal(size=4))


@dataclass(frozen=True)
class PoseNoise:
    """DeepIM's disturbance of a pose (its training pairs and its refinement test).

    Euler angles from N(0, rotation) per axis, redrawn while the geodesic angle exceeds
    max_rotation; translation from N(0, translation) per camera axis.
    """

    rotation_deg: float = 15.0
    max_rotation_deg: float = 45.0
    translation: tuple[float, float, float] = (0.01, 0.01, 0.05)

    def sample(self, rng: np.random.Generator) -> tuple[Array, Array]:
        """A rotation (3, 3) and a translation (3,) in metres."""
        while True:
            R = euler_xyz(rng.normal(size=3) * np.deg2rad(self.rotation_deg))
            if rotation_angle(R) <= np.deg2rad(self.max_rotation_deg):
                return R, rng.normal(size=3) * np.asarray(self.translation)

    def disturb(self, pose: Pose, rng: np.random.Generator) -> Pose:
        """``T_cam_x`` disturbed about x's origin, in axes parallel to the camera's."""
        R, t = self.sample(rng)
        return Pose(R @ pose.R, pose.t + t)


def fibonacci_sphere(n: int) -> Array:
    """n unit vectors (n, 3) spread evenly over the sphere."""
    i = np.arange(n) + 0.5
    z = 1.0 - 2.0 * i / n
    phi = np.pi * (1.0 + 5.0**0.5) * i
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)


def view_rotation(direction: ArrayLike) -> Array:
    """R_cam_obj (3, 3) of a camera that looks at the origin from ``direction`` (3,) in the object's frame.

    The object's z axis points up in the picture where the direction allows it, else its y axis.
    """
    forward = -np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def cube_views() -> list[Array]:
    """The paper's six views: R_cam_obj of a camera before each face of a cube, the frontal one first.

    The frontal view looks along +y onto the face at -y, z up (docs/decisions/0003).
    Yaw in steps of 90 degrees about the object's z axis, then pitch of +90 and -90 degrees.
    """
    directions = [[0, -1, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 0, 1], [0, 0, -1]]
    return [view_rotation(d) for d in directions]

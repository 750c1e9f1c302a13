"""How far a pose is from the truth: the field's measures, as functions. Layer 2.

Poses are ``T_cam_obj``: one `Pose`, a sequence of N, or matrices (4, 4) or (N, 4, 4); estimates and truths broadcast.
One pose gives a number, N poses give (N,). Symmetries are transforms ``T_obj_obj`` with the identity among them, as
`Symmetries.transforms` gives them; an error with symmetries is the smallest over the truths ``T_gt @ S``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from posekit.camera import Camera
from posekit.geometry import Pose, rotation_angle

Array = NDArray[np.float64]
Poses = Pose | Sequence[Pose] | ArrayLike

BOP_STEPS = 315  # turns that BOP makes of a continuous symmetry: Symmetries.transforms(BOP_STEPS)
_ALONE = (Pose.identity(),)


def pose_error(estimated: Poses, truth: Poses, symmetries: Sequence[Pose] = _ALONE) -> tuple[Array, Array]:
    """Rotation error (radians) and translation error (metres) to the symmetric truth with the nearest rotation."""
    est, gt = _matrices(estimated), _matrices(truth)
    symmetric = gt[..., None, :, :] @ _matrices(symmetries)  # (..., S, 4, 4)
    est = est[..., None, :, :]
    turns = rotation_angle(np.swapaxes(symmetric[..., :3, :3], -1, -2) @ est[..., :3, :3])
    shifts = np.linalg.norm(est[..., :3, 3] - symmetric[..., :3, 3], axis=-1)
    turns, shifts = np.broadcast_arrays(turns, shifts)
    nearest = turns.argmin(axis=-1)[..., None]
    return tuple(np.take_along_axis(e, nearest, axis=-1)[..., 0][()] for e in (turns, shifts))  # type: ignore[return-value]


def rotation_error(estimated: Poses, truth: Poses, symmetries: Sequence[Pose] = _ALONE) -> Array:
    """Geodesic angle, radians."""
    return pose_error(estimated, truth, symmetries)[0]


def translation_error(estimated: Poses, truth: Poses, symmetries: Sequence[Pose] = _ALONE) -> Array:
    """Distance of the origins, metres, to the symmetric truth with the nearest rotation."""
    return pose_error(estimated, truth, symmetries)[1]


def deepim_rotation_error(estimated: Poses, truth: Poses) -> Array:
    """DeepIM's rotation error of LINEMOD's eggbox, radians: an estimate that is more than 90 degrees off is turned by
    180 degrees about the object's z axis. The translation error stays as it is."""
    plain = rotation_error(estimated, truth)
    flipped = rotation_error(_matrices(estimated) @ np.diag([-1.0, -1.0, 1.0, 1.0]), truth)
    return np.where(plain > np.pi / 2, flipped, plain)[()]


def within(rotation: ArrayLike, translation: ArrayLike, degrees: float, centimetres: float) -> NDArray[np.bool_]:
    """(n degrees, n cm), strictly below, as DeepIM counts; errors in radians and metres."""
    turn, shift = np.rad2deg(rotation), 100.0 * np.asarray(translation, dtype=np.float64)
    return np.asarray((turn < degrees) & (shift < centimetres))


def add(estimated: Poses, truth: Poses, points: ArrayLike) -> Array:
    """ADD: the mean distance of corresponding points, metres. points: (P, 3) of the model, metres."""
    return _distances(_moved(estimated, points), _moved(truth, points)).mean(axis=-1)[()]


def adds(estimated: Poses, truth: Poses, points: ArrayLike) -> Array:
    """ADD-S (ADI): the mean distance from each true point to the nearest estimated one, metres."""
    est, gt = np.broadcast_arrays(_matrices(estimated), _matrices(truth))
    results = [
        cKDTree(_moved(e, points)).query(_moved(g, points))[0].mean()
        for e, g in zip(est.reshape(-1, 4, 4), gt.reshape(-1, 4, 4), strict=True)
    ]
    return np.array(results).reshape(est.shape[:-2])[()]


def proj2d(estimated: Poses, truth: Poses, camera: Camera, points: ArrayLike) -> Array:
    """The mean distance of corresponding points in the picture, pixels."""
    est, gt = (camera.project(_moved(poses, points)) for poses in (estimated, truth))
    return _distances(est, gt).mean(axis=-1)[()]


def mssd(estimated: Poses, truth: Poses, points: ArrayLike, symmetries: Sequence[Pose] = _ALONE) -> Array:
    """BOP's maximum symmetry-aware surface distance, metres.

    points: (P, 3); the convex hull's corners (`ObjectModel.outline`) give the same result as all vertices, because
    the distance is a convex function of the point.
    """
    est, gt = _moved(estimated, points), _matrices(truth)
    errors = [_distances(est, _moved(gt @ s.matrix, points)).max(axis=-1) for s in symmetries]
    return _least(errors)


def mspd(
    estimated: Poses, truth: Poses, camera: Camera, points: ArrayLike, symmetries: Sequence[Pose] = _ALONE
) -> Array:
    """BOP's maximum symmetry-aware projection distance, pixels. points: (P, 3), all vertices."""
    est, gt = camera.project(_moved(estimated, points)), _matrices(truth)
    errors = [_distances(est, camera.project(_moved(gt @ s.matrix, points))).max(axis=-1) for s in symmetries]
    return _least(errors)


def _matrices(poses: Poses) -> Array:
    """(..., 4, 4)."""
    if isinstance(poses, Pose):
        return poses.matrix
    if isinstance(poses, Sequence) and all(isinstance(pose, Pose) for pose in poses):
        return np.array([pose.matrix for pose in poses if isinstance(pose, Pose)]).reshape(-1, 4, 4)
    matrices = np.asarray(poses, dtype=np.float64)
    if matrices.shape[-2:] != (4, 4):
        raise ValueError(f"poses have shape (4, 4) or (N, 4, 4), not {matrices.shape}")
    return matrices


def _moved(poses: Poses, points: ArrayLike) -> Array:
    """Points (P, 3) moved by each pose, (..., P, 3)."""
    T = _matrices(poses)
    moved = np.asarray(points, dtype=np.float64) @ np.swapaxes(T[..., :3, :3], -1, -2)
    return np.asarray(moved + T[..., None, :3, 3])


def _least(errors: list[Array]) -> Array:
    return np.asarray(np.min(errors, axis=0))[()]


def _distances(a: Array, b: Array) -> Array:
    return np.asarray(np.linalg.norm(a - b, axis=-1))

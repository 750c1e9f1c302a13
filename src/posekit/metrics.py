"""How far a pose is from the truth: the field's measures, as functions.

Poses are ``T_cam_obj``: one `Pose`, a sequence of N, or matrices (4, 4) or (N, 4, 4); estimates and truths broadcast.
One pose gives a number, N poses give (N,). Symmetries are transforms ``T_obj_obj`` with the identity among them, as
`Symmetries.transforms` gives them; an error with symmetries is the smallest over the truths ``T_gt @ S``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from posekit.camera import Camera
from posekit.geometry import Pose, fibonacci_sphere, rotation_angle
from posekit.nearest import NearestPoints

Array = NDArray[np.float64]
Depth = NDArray[np.floating]
Poses = Pose | Sequence[Pose] | ArrayLike
Cameras = Camera | ArrayLike  # one for all poses, or matrices (3, 3) or (N, 3, 3)

BOP_STEPS = 315  # turns that BOP makes of a continuous symmetry: Symmetries.transforms(BOP_STEPS)
_ALONE = (Pose.identity(),)
_MANY, _FEWEST = 10_000_000, 500  # queries, and points, from which nearest points are looked up in cells
_CELLS = 3_000_000  # with fewer, more points have to be compared than preparing the cells saves
_CHUNK = 60_000  # distances that are computed at a time


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
    est, gt = np.broadcast_arrays(_matrices(estimated), _matrices(truth))
    cloud = _columns(points)
    return _by_chunk(lambda e, g: np.sqrt(_squares(_mapped(e - g, cloud))).mean(axis=-1), cloud.shape[1], est, gt)


def adds(estimated: Poses, truth: Poses, points: ArrayLike) -> Array:
    """ADD-S (ADI): the mean distance from each true point to the nearest estimated one, metres.

    A rigid motion keeps distances: the true points are brought into the estimated object's frame, whose points then
    need one search tree for all poses. Points that coincide (along the seams of a texture) are searched for once, and
    in the tree's order, so that one search finds the caches as the last one left them.
    """
    cloud, count = np.unique(np.asarray(points, dtype=np.float64), axis=0, return_counts=True)
    order = cKDTree(cloud, leafsize=32).indices
    cloud, count = cloud[order], count[order]
    tree = cKDTree(cloud, leafsize=32)
    est, gt = np.broadcast_arrays(_matrices(estimated), _matrices(truth))
    between = _inverse(est) @ gt
    share = count / count.sum()
    found = _nearest_points(cloud, tree, between)
    if found is None:
        return _by_chunk(lambda T: tree.query(_moved(T, cloud), workers=-1)[0] @ share, len(cloud), between)
    columns = np.ascontiguousarray(cloud.T)
    means = [found.distances(T[:3, :3] @ columns + T[:3, 3:]) @ share for T in between.reshape(-1, 4, 4)]
    return np.reshape(means, between.shape[:-2])[()]


def auc(errors: ArrayLike, limit: float = 0.1) -> Array:
    """Each error's share of the area under the curve of accuracy against threshold, from 0 to ``limit`` (metres).

    The mean over all instances is the area itself, exactly, in [0, 1]: PoseCNN's AUC of ADD and ADD-S up to 10 cm.
    """
    return np.clip(1.0 - np.asarray(errors, dtype=np.float64) / limit, 0.0, 1.0)[()]


def proj2d(estimated: Poses, truth: Poses, camera: Cameras, points: ArrayLike) -> Array:
    """The mean distance of corresponding points in the picture, pixels."""
    est, gt, K = _with_cameras(estimated, truth, camera)
    cloud = _columns(points)

    def mean(e: Array, g: Array, k: Array) -> Array:
        return np.sqrt(_squares(_projected(e, k, cloud) - _projected(g, k, cloud))).mean(axis=-1)

    return _by_chunk(mean, cloud.shape[1], est, gt, K)


def mssd(estimated: Poses, truth: Poses, points: ArrayLike, symmetries: Sequence[Pose] = _ALONE) -> Array:
    """BOP's maximum symmetry-aware surface distance, metres.

    points: (P, 3); the convex hull's corners (`ObjectModel.hull_vertices`) give the same result as all vertices,
    because the distance is a convex function of the point.
    """
    est, gt = np.broadcast_arrays(_matrices(estimated), _matrices(truth))

    def largest(cloud: Array, e: Array, g: Array) -> Array:
        return _squares(_mapped(e - g, cloud)).max(axis=-1)

    return _least(largest, symmetries, points, est, gt)


def mspd(
    estimated: Poses, truth: Poses, camera: Cameras, points: ArrayLike, symmetries: Sequence[Pose] = _ALONE
) -> Array:
    """BOP's maximum symmetry-aware projection distance, pixels. points: (P, 3), all vertices."""
    est, gt, K = _with_cameras(estimated, truth, camera)

    def largest(cloud: Array, e: Array, g: Array, k: Array) -> Array:
        return _squares(_projected(e, k, cloud) - _projected(g, k, cloud)).max(axis=-1)

    return _least(largest, symmetries, points, est, gt, K)


def vsd(
    depth_estimated: Depth,
    depth_truth: Depth,
    depth_scene: Depth,
    camera: Camera,
    diameter: float,
    taus: ArrayLike,
    delta: float = 0.015,
) -> Array:
    """BOP's visible surface discrepancy for each misalignment tolerance, in [0, 1], (T,).

    Depths (H, W), metres along z, 0 where nothing is: the object rendered at the two poses, and the sensor's.
    taus: (T,) shares of the diameter. delta: metres, tolerance of the visibility test. As the BOP challenge has it
    since 2019: a surface is visible where the sensor saw nothing.
    """
    rays = np.linalg.norm(camera.backproject(camera.pixel_grid()), axis=-1)
    est, gt, scene = (np.asarray(d, dtype=np.float64) * rays for d in (depth_estimated, depth_truth, depth_scene))
    seen_gt = (gt > 0) & ((gt - scene <= delta) | (scene == 0))
    seen_est = (est > 0) & ((est - scene <= delta) | (scene == 0) | seen_gt)
    both, either = seen_gt & seen_est, int((seen_gt | seen_est).sum())
    levels = np.asarray(taus, dtype=np.float64)
    if not either:
        return np.ones(len(levels))
    apart = np.sort(np.abs(gt[both] - est[both]) / diameter)
    wrong = len(apart) - np.searchsorted(apart, levels, side="left")  # as many as are at least tau apart
    return np.asarray((wrong + either - len(apart)) / either)


# --- which estimate belongs to which truth, recall and precision -----------------------------------------------------


def match(errors: ArrayLike, scores: ArrayLike, threshold: float) -> NDArray[np.int64]:
    """BOP's greedy matching: the estimates by falling score, each to the free truth with the least error below the
    threshold. errors: (E, G); scores: (E,). Returns each estimate's truth, (E,), -1 where it has none."""
    left = np.array(errors, dtype=np.float64)
    matched = np.full(len(left), -1)
    for e in np.argsort(-np.asarray(scores, dtype=np.float64), kind="stable"):
        if left.shape[1] and left[e].min() < threshold:
            matched[e] = left[e].argmin()
            left[:, matched[e]] = np.inf
    return matched


def average_precision(hits: ArrayLike, scores: ArrayLike, total: int) -> float:
    """Precision averaged over 101 levels of recall, as COCO and BOP'24 do. hits: (E,) whether an estimate is right;
    total: how many there are to be found, at least 1."""
    right = np.asarray(hits, dtype=np.bool_)[np.argsort(-np.asarray(scores, dtype=np.float64), kind="stable")]
    found = np.cumsum(right)
    precision = np.maximum.accumulate((found / np.arange(1, len(found) + 1))[::-1])[::-1]
    first = np.searchsorted(found / total, np.linspace(0, 1, 101), side="left")
    return float(np.append(precision, 0.0)[first].mean())


# --- inside ----------------------------------------------------------------------------------------------------------


def _by_chunk(measure: Callable[..., Array], width: int, *arrays: Array) -> Array:
    """``measure`` over the leading axes of arrays (..., 4, 4) or (..., 3, 3), in portions that suit the caches."""
    lead = arrays[0].shape[:-2]
    flat = [a.reshape(-1, *a.shape[-2:]) for a in arrays]
    step = max(1, _CHUNK // max(1, width))
    parts = [measure(*(a[k : k + step] for a in flat)) for k in range(0, len(flat[0]), step)]
    return np.concatenate([np.zeros(0), *parts]).reshape(lead)[()]


def _inverse(T: Array) -> Array:
    """Inverse rigid transforms (..., 4, 4)."""
    out = np.zeros_like(T)
    out[..., :3, :3] = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, 3] = -np.einsum("...ij,...j->...i", out[..., :3, :3], T[..., :3, 3])
    out[..., 3, 3] = 1.0
    return out


def _nearest_points(cloud: Array, tree: cKDTree, between: Array) -> NearestPoints | None:
    """For the points as transforms (..., 4, 4) move them; None where there are too few queries for its preparation.

    Its region holds the points of all but the two poses in a hundred that move them farthest."""
    flat = between.reshape(-1, 4, 4)
    if len(cloud) * len(flat) < _MANY or len(cloud) < _FEWEST:
        return None
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    corners = np.stack(np.meshgrid(*np.stack([low, high], axis=1), indexing="ij"), axis=-1).reshape(-1, 3)
    away = np.abs(_moved(flat, corners) - corners).max(axis=1)
    margin = np.minimum(np.quantile(away, 0.98, axis=0), 0.5 * float((high - low).max())) + 1e-3 * (high - low).max()
    return NearestPoints(cloud, tree, low - margin, high + margin, _CELLS)


def _least(largest: Callable[..., Array], symmetries: Sequence[Pose], points: ArrayLike, *arrays: Array) -> Array:
    """The least over the symmetries of the largest distance over the points.

    largest: from points (4, P), estimates, truths and what else is in ``arrays`` to the square of that distance. Many
    symmetries are searched by bounds: over a few extreme points the largest distance is at most that over all, so a
    symmetry whose bound is above the best result so far need not be looked at. The result is exact.
    """
    S, cloud = _matrices(symmetries), _columns(points)
    few = cloud[:, _extremes(cloud[:3].T)]

    def least(e: Array, g: Array, *rest: Array) -> Array:
        bound = largest(few, e[:, None], g[:, None] @ S, *(r[:, None] for r in rest))
        order = bound.argsort(axis=1)
        best = np.full(len(e), np.inf)
        for nth in order.T:
            left = np.flatnonzero(bound[np.arange(len(e)), nth] < best)
            if not left.size:
                break
            found = largest(cloud, e[left], g[left] @ S[nth[left]], *(r[left] for r in rest))
            best[left] = np.minimum(best[left], found)
        return np.sqrt(best)

    if len(S) == 1:
        return _by_chunk(lambda e, g, *rest: np.sqrt(largest(cloud, e, g @ S[0], *rest)), cloud.shape[1], *arrays)
    return _by_chunk(least, max(cloud.shape[1], few.shape[1] * len(S)), *arrays)


def _columns(points: ArrayLike) -> Array:
    """Points (P, 3) as homogeneous columns (4, P)."""
    cloud = np.asarray(points, dtype=np.float64)
    return np.vstack([cloud.T, np.ones(len(cloud))])


def _mapped(T: Array, columns: Array) -> Array:
    """The first three rows of ``T @ columns`` for all T (..., 3 or 4, 4), (..., 3, P); one product for all."""
    rows = T[..., :3, :]
    return np.asarray((rows.reshape(-1, 4) @ columns).reshape(*rows.shape[:-1], -1))


def _squares(vectors: Array) -> Array:
    """Squared lengths of vectors (..., D, P), (..., P)."""
    total = np.square(vectors[..., 0, :])
    for k in range(1, vectors.shape[-2]):
        total += np.square(vectors[..., k, :])
    return np.asarray(total)


def _projected(T: Array, K: Array, columns: Array) -> Array:
    """Pixels (..., 2, P) of homogeneous points (4, P) at poses (..., 4, 4) in cameras (..., 3, 3)."""
    image = _mapped(K @ T[..., :3, :], columns)
    return np.asarray(image[..., :2, :] / image[..., 2:, :])


def _with_cameras(estimated: Poses, truth: Poses, camera: Cameras) -> tuple[Array, Array, Array]:
    K = camera.K if isinstance(camera, Camera) else np.asarray(camera, dtype=np.float64)
    est, gt = np.broadcast_arrays(_matrices(estimated), _matrices(truth))
    return est, gt, np.broadcast_to(K, (*est.shape[:-2], 3, 3))


def _extremes(points: Array) -> NDArray[np.int64]:
    """Indices of the points that are outermost in some of 60 directions."""
    return np.unique((points @ fibonacci_sphere(60).T).argmax(axis=0))


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
    """Points (P, 3) moved by each pose, or by each matrix (..., 3, 4), (..., P, 3)."""
    T = poses if isinstance(poses, np.ndarray) else _matrices(poses)
    moved = np.asarray(points, dtype=np.float64) @ np.swapaxes(T[..., :3, :3], -1, -2)
    return np.asarray(moved + T[..., None, :3, 3])

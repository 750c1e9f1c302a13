"""Normals, hulls, simplification and checks of vertices and faces, as arrays.

SciPy takes a quarter of a second to import, and a mesh that is kept on disk does without: functions import it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from posekit.errors import MeshError

_FARTHEST = 1e12  # of a vertex from the origin, in a file's own units
_CREASE = np.cos(np.deg2rad(40.0))  # faces that meet more sharply are not smoothed together
_STEPS = 10_000  # in which a normal's coordinates are told apart
_PORTION = 50_000  # faces or corners that are worked on at a time, for the memory's sake, and the processor's caches

Floats = NDArray[np.float64]


def smooth_normals(vertices: Floats, faces: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    """Normals weighted by the faces' angles, smooth across texture seams, sharp at edges of more than 40 degrees.

    vertices: (V, 3); faces: (F, 3) with areas. A vertex on a sharp edge is split. Returns the source vertex of each
    new one (V',), the new faces (F, 3) and the unit normals (V', 3).
    """
    flat, angles = _face_normals(vertices, faces)
    place = coincident(vertices)[faces.ravel()]
    order = counting_order(place)
    place = place[order]
    ends = np.cumsum(np.bincount(place))  # of the corners of each place, which lie side by side
    unit, steps = np.empty((len(order), 3)), np.empty((len(order), 3), np.int16)
    portions = [0]
    while portions[-1] < len(order):
        portions.append(int(ends[place[min(portions[-1] + _PORTION, len(order)) - 1]]))

    def smooth(start: int, end: int) -> None:
        part = order[start:end]
        smoothed = _smoothed(flat[part // 3], angles.ravel()[part], ends[place[start:end]] - start)
        unit[part], steps[part] = smoothed, np.rint(smoothed * _STEPS)

    _in_threads(smooth, portions)
    first, inverse = _distinct(faces.ravel(), steps)
    return faces.ravel()[first], inverse.reshape(-1, 3), unit[first]


def _smoothed(normal: Floats, angle: Floats, ends: NDArray[np.int64]) -> Floats:
    """Unit normals (N, 3) of corners, from their faces' normals (N, 3) and their angles (N,), each place's side by
    side; ends: (N,), where those of a corner's place end."""
    weighted = normal * angle[:, None]
    total, left, step = weighted.copy(), np.arange(len(normal)), 1
    while left.size:  # each corner meets the one that lies `step` further on at the same place
        left = left[left + step < ends[left]]
        smooth = left[np.einsum("ij,ij->i", normal[left], normal[left + step]) > _CREASE]
        total[smooth] += weighted[smooth + step]
        total[smooth + step] += weighted[smooth]
        step += 1
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.asarray(np.where(length > 1e-9, total, normal) / np.where(length > 1e-9, length, 1.0))


def _distinct(vertex: NDArray[np.int64], normal: NDArray[np.int16]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The distinct pairs of a vertex (N,) and a normal (N, 3) in units of 1 / `_STEPS`, sorted: where each is first,
    and which of them each pair is."""
    side = 2 * _STEPS + 1
    if (int(vertex.max(initial=0)) + 1) * side**3 >= 2**64:
        keys = np.column_stack([vertex, normal])
        _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        return first, inverse.ravel()
    key = vertex.astype(np.uint64)
    for axis in range(3):
        key *= np.uint64(side)
        key += (normal[:, axis] + _STEPS).astype(np.uint64)
    order = np.argsort(key)
    key = key[order]
    new = np.concatenate([[True], key[1:] != key[:-1]])
    inverse = np.empty(len(key), dtype=np.int64)
    inverse[order] = np.cumsum(new) - 1
    return np.minimum.reduceat(order, np.flatnonzero(new)), inverse


def counting_order(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """As ``np.argsort(numbers, kind="stable")`` of whole numbers from 0 on without large gaps, in linear time."""
    from scipy.sparse import csr_array

    ones, rows = np.ones(len(numbers), dtype=np.int8), np.arange(len(numbers) + 1)
    return np.asarray(csr_array((ones, numbers, rows)).tocsc().indices)  # one number in each row, and rows by column


def _face_normals(vertices: Floats, faces: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Unit normals (F, 3) and the angles (F, 3) at the corners."""
    normals, angles = np.empty((len(faces), 3)), np.empty((len(faces), 3))

    def fill(start: int, end: int) -> None:
        part = slice(start, end)
        corners = vertices[faces[part]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals[part] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        edges = np.roll(corners, -1, axis=1) - corners
        edges /= np.maximum(np.linalg.norm(edges, axis=2, keepdims=True), 1e-300)
        cosines = -np.einsum("fij,fij->fi", edges, np.roll(edges, 1, axis=1))
        angles[part] = np.arccos(cosines.clip(-1, 1))

    _in_threads(fill, [*range(0, len(faces), _PORTION), len(faces)])
    return normals, angles


def _in_threads(work: Callable[[int, int], None], limits: Sequence[int]) -> None:
    """Call ``work`` with each pair of neighbouring limits, two at a time: NumPy lets other threads run meanwhile."""
    pairs = list(pairwise(limits))
    if len(pairs) == 1:
        work(*pairs[0])
        return
    with ThreadPoolExecutor(2) as pool:
        for done in [pool.submit(work, *pair) for pair in pairs]:
            done.result()


def coincident(vertices: Floats) -> NDArray[np.int64]:
    """A number (V,) for each vertex, equal where the vertices coincide (to a millionth of the mesh's size)."""
    grid = np.rint((vertices - vertices.min(axis=0)) / (1e-6 * np.ptp(vertices, axis=0).max())).astype(np.int64)
    order = np.lexsort(grid.T)
    changes = (np.diff(grid[order], axis=0) != 0).any(axis=1)
    numbers = np.empty(len(grid), dtype=np.int64)
    numbers[order] = np.concatenate([[0], np.cumsum(changes)])
    return numbers


def face_areas(vertices: Floats, faces: NDArray[Any]) -> Floats:
    """Areas (F,) of faces (F, 3) of vertices (V, 3), in the vertices' unit squared."""
    areas = np.empty(len(faces))
    for start in range(0, len(faces), _PORTION):
        corners = vertices[faces[start : start + _PORTION]]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas[start : start + _PORTION] = 0.5 * np.linalg.norm(cross, axis=1)
    return areas


def mean_colors(
    fewer: NDArray[np.float32], vertices: NDArray[np.float32], colors: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Of the vertices that each of fewer ones (V, 3) is nearest to; where there are none, of the nearest."""
    from scipy.spatial import KDTree

    _, owner = KDTree(fewer).query(vertices, workers=-1)
    count = np.bincount(owner, minlength=len(fewer))
    sums = np.stack([np.bincount(owner, channel, minlength=len(fewer)) for channel in colors.T], axis=1)
    means = sums / np.maximum(count, 1)[:, None]
    alone = np.flatnonzero(count == 0)
    if alone.size:  # the tree of all vertices takes as long as everything else
        means[alone] = colors[KDTree(vertices).query(fewer[alone])[1]]
    return np.asarray(np.rint(means), np.uint8)


def carried_uvs(
    vertices: NDArray[np.float32], faces: NDArray[Any], corners: NDArray[np.float32], corner_uvs: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    """Texture coordinates for a simplified mesh: those of the plane of the old face nearest to a new face's middle.

    corners: (F, 3, 3), corner_uvs: (F, 3, 2), the old faces'. A vertex on a seam is split. Returns the source vertex of
    each new one (V',), the new faces and the coordinates (V', 2).
    """
    from scipy.spatial import KDTree

    new = vertices[faces].astype(np.float64)
    _, under = KDTree(corners.mean(axis=1)).query(new.mean(axis=1))
    origin, first, second = np.moveaxis(corners[under].astype(np.float64), 1, 0)
    sides = np.stack([first - origin, second - origin], axis=2)  # (F', 3, 2)
    shares = np.einsum("fij,fkj->fki", np.linalg.pinv(sides), new - origin[:, None]).clip(
        -4, 4
    )  # unbounded for slivers
    start = corner_uvs[under, 0].astype(np.float64)
    across = corner_uvs[under, 1:].astype(np.float64) - start[:, None]
    uvs = (start[:, None] + shares @ across).reshape(-1, 2)
    spans = np.linalg.norm(np.diff(uvs.reshape(-1, 3, 2), axis=1), axis=2)
    near = 2 * float(np.percentile(spans, 95))  # what lies further apart is another place of the texture
    vertex, left = faces.ravel(), np.arange(faces.size)
    source: list[NDArray[np.int64]] = []
    means: list[Floats] = []
    index, count = np.zeros(faces.size, np.int64), 0
    while left.size:  # corners of a vertex that agree become one, then those that did not agree with them
        owners, head, owner = np.unique(vertex[left], return_index=True, return_inverse=True)
        agree = np.linalg.norm(uvs[left] - uvs[left[head]][owner], axis=1) <= near
        number = np.bincount(owner[agree], minlength=len(owners))[:, None]
        sums = [np.bincount(owner[agree], uvs[left[agree], k], minlength=len(owners)) for k in (0, 1)]
        means.append(np.stack(sums, axis=1) / number)
        source.append(owners.astype(np.int64))
        index[left[agree]] = count + owner[agree]
        left, count = left[~agree], count + len(owners)
    return np.concatenate(source), index.reshape(-1, 3), np.concatenate(means)


def subdivided(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], attributes: dict[str, NDArray[np.float32]]
) -> tuple[NDArray[np.float32], NDArray[np.int32], dict[str, NDArray[np.float32]]]:
    """Each triangle as four. vertices: (V, 3). faces: (F, 3). attributes: (V, C) each, interpolated along the edges."""
    import trimesh.remesh

    points, triangles, values = trimesh.remesh.subdivide(vertices, faces, vertex_attributes=attributes)  # type: ignore[no-untyped-call]
    return points.astype(np.float32), triangles.astype(np.int32), values


def convex_hull(points: Floats) -> Floats:
    """The corners (N, 3) of the convex hull of points (V, 3), flat ones too."""
    from scipy.spatial import ConvexHull

    middle = points.mean(axis=0)
    _, spread, axes = np.linalg.svd((points - middle).T @ (points - middle))
    rank = 3 if spread[2] > 1e-12 * spread[0] else 2
    return np.asarray(points[np.sort(ConvexHull((points - middle) @ axes[:rank].T).vertices)])


def used_vertices(faces: NDArray[np.int64], count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The vertices that faces use (V',), and the faces counted in these."""
    used = np.zeros(count, dtype=bool)
    used[faces] = True
    return np.flatnonzero(used), (np.cumsum(used) - 1)[faces]


def repaired_normals(normals: Floats, vertices: Floats, faces: NDArray[np.int64]) -> Floats:
    """Unit normals (V, 3), those without a direction replaced by the faces' mean."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    bad = ~np.isfinite(length[:, 0]) | (length[:, 0] < 1e-12)
    if bad.any():
        flat, angles = _face_normals(vertices, faces)
        mean = np.zeros_like(normals)
        np.add.at(mean, faces.ravel(), (flat[:, None] * angles[..., None]).reshape(-1, 3))
        normals = np.where(bad[:, None], np.where(np.abs(mean).max(axis=1, keepdims=True) > 1e-12, mean, 1.0), normals)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / length)


def checked_mesh(label: str, vertices: NDArray[Any], faces: NDArray[Any]) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices (V, 3) and faces (F, 3) that can be worked with. Raises MeshError."""
    if vertices.size == 0:
        raise MeshError(f"{label} is an empty mesh: it has no vertices. Export it again, as a triangle mesh.")
    if faces.size == 0:
        raise MeshError(
            f"{label} has {len(vertices)} vertices and no faces: posekit renders surfaces, so it needs a triangle mesh."
        )
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise MeshError(f"{label}: vertices are (V, 3) and faces (F, 3), not {vertices.shape} and {faces.shape}.")
    v, f = vertices.astype(np.float64), faces.astype(np.int64)
    bad = ~(np.abs(v) < _FARTHEST).all(axis=1)
    if bad.any():
        raise MeshError(
            f"{label} has {bad.sum()} vertices that are NaN, infinite or beyond {_FARTHEST:g} (the first is number "
            f"{bad.argmax()}): "
            "repair it, or export it again."
        )
    if f.min() < 0 or f.max() >= len(v):
        wrong = int(f.max() if f.max() >= len(v) else f.min())
        raise MeshError(
            f"{label} has a face that names vertex {wrong}, but its vertices are 0 to {len(v) - 1}: the file is "
            "damaged; export it again."
        )
    return v, f


def vertex_rows(label: str, name: str, values: ArrayLike, count: int) -> NDArray[Any]:
    """An array with a row of numbers for each vertex. Raises MeshError."""
    array = np.asarray(values)
    if array.ndim != 2 or len(array) != count or not np.isfinite(array).all():
        raise MeshError(
            f"{label}: {name} must be finite numbers in {count} rows, one for each vertex, not {array.shape}."
        )
    return array

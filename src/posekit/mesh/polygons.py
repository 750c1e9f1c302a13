"""Polygons cut into triangles, concave ones too. The only module that imports mapbox_earcut."""

from __future__ import annotations

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from posekit.errors import MeshError

Triples = NDArray[np.int64]


def triangulated(points: NDArray[np.float64], label: str) -> list[Triples]:
    """Triangles (M, 3), as numbers of corners, of each of n polygons with L corners: points (n, L, 3), in order.

    Convex ones become fans. A polygon in space is cut as it lies in its mean plane. Raises MeshError where one crosses
    itself, so that what it encloses is not defined; label: the mesh's name.
    """
    count = points.shape[1]
    fan = np.array([(0, k, k + 1) for k in range(1, count - 1)], dtype=np.int64)
    normals = _newell(points)
    return [
        fan if convex else _cut(polygon, normal, fan, label)
        for polygon, normal, convex in zip(points, normals, _convex(points, normals), strict=True)
    ]


def _newell(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normals (n, 3) whose length is twice the area."""
    centred = points - points.mean(axis=1, keepdims=True)
    return np.asarray(np.cross(centred, np.roll(centred, -1, axis=1)).sum(axis=1))


def _convex(points: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether all corners turn the same way, once round (n,)."""
    edges = np.roll(points, -1, axis=1) - points
    before = np.roll(edges, 1, axis=1)
    unit = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    sines = np.einsum("nlk,nk->nl", np.cross(before, edges), unit)
    cosines = np.einsum("nlk,nlk->nl", before, edges)
    lengths = np.linalg.norm(before, axis=2) * np.linalg.norm(edges, axis=2)
    turns = np.arctan2(sines, cosines).sum(axis=1) / (2 * np.pi)
    return np.asarray((sines >= -1e-6 * lengths).all(axis=1) & (turns < 1.5))


def _cut(polygon: NDArray[np.float64], normal: NDArray[np.float64], fan: Triples, label: str) -> Triples:
    twice = float(np.linalg.norm(normal))
    span = float(np.ptp(polygon, axis=0).max())
    if twice <= 1e-12 * span**2:
        return fan  # it has no area, nor have its triangles
    axis = normal / twice
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    across /= np.linalg.norm(across)
    flat = (polygon - polygon.mean(axis=0)) @ np.stack([across, np.cross(axis, across)], axis=1)
    found = mapbox_earcut.triangulate_float64(flat, np.array([len(flat)], dtype=np.uint32))
    triples = np.asarray(found, dtype=np.int64).reshape(-1, 3)
    a, b, c = (flat[triples[:, k]] for k in range(3))
    areas = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    if abs(np.abs(areas).sum() - twice) > 1e-3 * twice:
        raise MeshError(
            f"{label} has a polygon of {len(flat)} corners that crosses itself, so it cannot be cut into triangles: "
            "triangulate the mesh in the program that made it."
        )
    return np.where((areas < 0)[:, None], triples[:, ::-1], triples)

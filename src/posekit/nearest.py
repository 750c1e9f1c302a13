"""The nearest of a fixed set of points to very many others: exact, several times as fast as a search tree.

Space around the points is cut into cells. For each cell that is asked for, the points are found that can be nearest to
anything in it, once; a query then compares these few. ``p`` cannot be nearest in a cell where the point ``n`` that is
nearest to the cell's centre ``c`` is nearer everywhere: for a cube of half side ``a`` that is where
``|c - p|^2 - |c - n|^2 > 2 a |p - n|_1``, since the difference of the squared distances is linear in the place.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]
Indices = NDArray[Any]

_BLOCK = 8  # cells a side that are prepared together
_RANKS = 16  # points of a cell that are compared; where there are more, the tree is asked
_SLACK = 1 + 1e-9  # of a cell's half side, for rounding
_OFFSETS = np.stack(np.meshgrid(*[np.arange(_BLOCK)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


class NearestPoints:
    """points: (P, 3), all different. low, high: (3,), the region in which queries are fast; elsewhere the tree answers.
    cells: about how many the region is cut into, 33 bytes each (65 where there are more than 65,536 points)."""

    def __init__(self, points: Array, tree: cKDTree, low: Array, high: Array, cells: int) -> None:
        self._points, self._tree, self._low = points, tree, np.asarray(low, dtype=np.float64)
        side = (float(np.prod(high - low)) / cells) ** (1 / 3)
        self._side, blocks = side, np.maximum(1, np.ceil((high - low) / (side * _BLOCK))).astype(int)
        self._shape = blocks * _BLOCK
        self._steps = np.array([self._shape[1] * self._shape[2], self._shape[2], 1])
        self._count = np.zeros(int(np.prod(self._shape)), np.uint8)  # points of each cell, 0 where not yet prepared
        self._nearest = np.zeros((_RANKS, len(self._count)), np.uint16 if len(points) <= 65536 else np.int32)
        self._axes = [np.ascontiguousarray(axis) for axis in points.T]

    def distances(self, queries: Array) -> Array:
        """Of each of (3, N) to the nearest point, (N,)."""
        scaled = (queries - self._low[:, None]) * (1 / self._side)
        if (scaled.min(axis=1) < 0).any() or (scaled.max(axis=1) >= self._shape).any():
            inside = ((scaled >= 0) & (scaled < self._shape[:, None])).all(axis=0)
            out = np.empty(queries.shape[1])
            out[~inside] = self._searched(queries[:, ~inside])
            if inside.any():
                out[inside] = self._looked_up(queries[:, inside], scaled[:, inside])
            return out
        return self._looked_up(queries, scaled)

    def _searched(self, queries: Array) -> Array:
        return np.asarray(self._tree.query(queries.T)[0])

    def _looked_up(self, queries: Array, scaled: Array) -> Array:
        i, j, k = scaled.astype(np.intp)
        cell = (i * self._shape[1] + j) * self._shape[2] + k
        count = self._count.take(cell)
        new = np.flatnonzero(count == 0)
        if new.size:
            self._prepare(np.unique(np.stack([i[new], j[new], k[new]], axis=1) // _BLOCK, axis=0))
            count = self._count.take(cell)
        squares = self._squares(queries, self._nearest[0].take(cell))
        left = np.flatnonzero(count > 1)
        for rank in range(1, _RANKS):
            if not left.size:
                break
            other = self._squares(queries.take(left, axis=1), self._nearest[rank].take(cell.take(left)))
            squares[left] = np.minimum(squares.take(left), other)
            left = left[count.take(left) > rank + 1]
        distances = np.sqrt(squares)
        if left.size:  # in cells with more points than are kept
            distances[left] = self._searched(queries[:, left])
        return distances

    def _squares(self, queries: Array, points: Indices) -> Array:
        index = points.astype(np.intp)
        total = np.square(queries[0] - self._axes[0].take(index))
        for query, axis in zip(queries[1:], self._axes[1:], strict=True):
            apart = query - axis.take(index)
            apart *= apart
            total += apart
        return np.asarray(total)

    def _prepare(self, blocks: NDArray[np.intp]) -> None:
        """Find the points of all cells in blocks (B, 3)."""
        half = 0.5 * self._side * _SLACK
        for block in blocks:
            corner = block * _BLOCK
            middle = self._low + self._side * (corner + 0.5 * _BLOCK)
            away = sum(np.square(axis - at) for axis, at in zip(self._axes, middle, strict=True))
            nearest = int(away.argmin())
            beside = sum(np.abs(axis - axis[nearest]) for axis in self._axes)
            few = np.flatnonzero(away - away[nearest] <= 2 * _BLOCK * half * beside * _SLACK)
            points = self._points[few] - middle  # small numbers: their products are exact enough
            centres = self._side * (_OFFSETS + 0.5 * (1 - _BLOCK))
            square = np.square(points).sum(axis=1)
            power = square - 2 * (centres @ points.T)  # the squared distance but for the centre's own square
            first = power.argmin(axis=1)
            reach = 2 * half * np.abs(points[:, None] - points).sum(axis=2) + 1e-12 * square.max()
            power -= power[np.arange(len(power)), first, None]
            row, column = np.nonzero(power <= reach[first])
            cells = (corner + _OFFSETS) @ self._steps
            count = np.bincount(row, minlength=len(cells))
            rank = np.arange(len(row)) - (np.cumsum(count) - count)[row]
            kept = rank < _RANKS
            self._nearest[rank[kept], cells[row[kept]]] = few[column[kept]]
            self._count[cells] = np.minimum(count, 255)

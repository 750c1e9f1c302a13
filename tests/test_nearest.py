"""Looked-up nearest points and the ADD-S made of them, against plain searches."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from posekit import metrics, nearest
from posekit.geometry import Pose, random_rotation
from posekit.nearest import NearestPoints

KINDS = ("sphere", "grid", "line", "cluster")


def points_of(kind: str, rng: np.random.Generator) -> np.ndarray:
    if kind == "sphere":  # whose middle is as far from all of them
        return (lambda p: p / np.linalg.norm(p, axis=1, keepdims=True))(rng.normal(size=(400, 3)))
    if kind == "grid":  # with many ties
        return np.stack(np.meshgrid(*[np.linspace(-1, 1, 6)] * 3), axis=-1).reshape(-1, 3)
    if kind == "line":
        return np.linspace([-1, 0, 0], [1, 1e-9, 0], 50)
    return np.concatenate([rng.normal(0, 1e-4, (200, 3)), rng.normal(0, 1, (20, 3))])


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(KINDS), st.integers(0, 1000), st.integers(500, 20_000), st.booleans())
def test_distances_are_those_of_all_pairs(kind: str, seed: int, cells: int, off_centre: bool) -> None:
    rng = np.random.default_rng(seed)
    points = points_of(kind, rng) + (100.0 if off_centre else 0.0)
    low, high = points.min(axis=0) - 0.3, points.max(axis=0) + 0.3
    found = NearestPoints(points, cKDTree(points), low, high, cells)
    queries = rng.uniform(low - 0.2, high + 0.2, (300, 3))
    queries[:50] = points[:50]
    for _ in range(2):  # cells prepared for the first are used by the second
        np.testing.assert_allclose(
            found.distances(queries.T), cdist(queries, points).min(axis=1), rtol=1e-12, atol=1e-13
        )


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000), st.floats(1e-4, 2.0))
def test_add_s_is_the_same_by_both_ways(seed: int, shift: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(0, 0.05, (600, 3))
    truth = [Pose(random_rotation(rng), rng.normal(0, 1, 3)) for _ in range(8)]
    near = [Pose(t.R, t.t + rng.normal(0, shift, 3)) for t in truth[:4]]
    estimated = near + [Pose(random_rotation(rng), t.t) for t in truth[4:]]
    plain = metrics.adds(estimated, truth, points)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(metrics, "_MANY", 0)
        patch.setattr(metrics, "_CELLS", 30_000)
        patch.setattr(nearest, "_RANKS", 4)
        np.testing.assert_allclose(metrics.adds(estimated, truth, points), plain, rtol=1e-12)
        one = metrics.adds(estimated[0], truth[0], points)
    assert np.shape(one) == () and one == pytest.approx(plain[0], rel=1e-12)

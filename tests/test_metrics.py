"""Metrics against closed forms."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.spatial import cKDTree

from posekit import metrics
from posekit.camera import Camera
from posekit.geometry import Pose, random_rotation, so3_exp
from posekit.mesh.symmetries import Symmetries

GT = Pose(random_rotation(np.random.default_rng(5)), [0.1, -0.05, 0.8])
POINTS = np.random.default_rng(1).uniform(-0.05, 0.05, size=(200, 3))
CAMERA = Camera(500, 500, 320, 240, 640, 480)


def turned(angle: float, axis: tuple[float, float, float] = (0, 0, 1)) -> Pose:
    """The truth with the object turned about its own axis."""
    return GT @ Pose.rotation(so3_exp(np.array(axis) * angle))


def test_plain_errors() -> None:
    moved = Pose(turned(0.3).R, GT.t + [0.03, 0.0, 0.04])
    assert metrics.rotation_error(moved, GT) == pytest.approx(0.3)
    assert metrics.pose_error(moved, GT)[1] == pytest.approx(0.05)
    assert f"{metrics.rotation_error(GT, GT):.3f}" == "0.000"


def test_many_poses_at_once() -> None:
    angles = np.linspace(0, 1, 7)
    poses = [turned(a) for a in angles]
    np.testing.assert_allclose(metrics.rotation_error(poses, GT), angles, atol=1e-9)
    np.testing.assert_allclose(metrics.rotation_error(poses, [GT] * 7), angles, atol=1e-9)
    np.testing.assert_allclose(metrics.rotation_error(np.stack([p.matrix for p in poses]), GT), angles, atol=1e-9)
    symmetries = Symmetries.parse("z:2", [0, 0, 0]).transforms()
    for one, many in [
        (metrics.add(poses[3], GT, POINTS), metrics.add(poses, GT, POINTS)),
        (metrics.adds(poses[3], GT, POINTS), metrics.adds(poses, GT, POINTS)),
        (metrics.proj2d(poses[3], GT, CAMERA, POINTS), metrics.proj2d(poses, GT, CAMERA, POINTS)),
        (metrics.mssd(poses[3], GT, POINTS, symmetries), metrics.mssd(poses, GT, POINTS, symmetries)),
        (metrics.mspd(poses[3], GT, CAMERA, POINTS, symmetries), metrics.mspd(poses, GT, CAMERA, POINTS, symmetries)),
    ]:
        assert np.ndim(one) == 0
        assert many.shape == (7,)
        assert many[3] == pytest.approx(one)


def test_the_shift_of_many_poses() -> None:
    shifts = np.array([[0.03, 0.0, 0.04], [0.0, 0.0, 0.0], [-0.02, 0.04, 0.04]])
    moved = [Pose(GT.R, GT.t + shift) for shift in shifts]
    np.testing.assert_allclose(metrics.pose_error(moved, GT)[1], [0.05, 0.0, 0.06], atol=1e-12)


def test_poses_may_be_a_list_of_matrices_or_empty() -> None:
    matrices = [turned(0.1).matrix, turned(0.2).matrix]
    np.testing.assert_allclose(metrics.rotation_error(matrices, GT), [0.1, 0.2])
    np.testing.assert_allclose(metrics.rotation_error([m.tolist() for m in matrices], GT), [0.1, 0.2])
    assert metrics.rotation_error([], []).shape == (0,)


def test_two_symmetries_are_both_tried() -> None:
    symmetries = Symmetries.parse("z:2", [0.0, 0.0, 0.0]).transforms()
    assert len(symmetries) == 2
    assert metrics.mssd(turned(np.pi), GT, POINTS, symmetries) == pytest.approx(0, abs=1e-12)
    assert metrics.mspd(turned(np.pi), GT, CAMERA, POINTS, symmetries) == pytest.approx(0, abs=1e-9)


def test_an_array_of_another_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"shape \(4, 4\) or \(N, 4, 4\), not \(3, 3\)"):
        metrics.rotation_error(np.eye(3), GT)


def test_symmetries_count_the_nearest_truth() -> None:
    centre = np.array([0.02, 0.0, 0.0])
    symmetries = Symmetries.parse("z:2", centre).transforms()
    flipped = GT @ symmetries[1]
    assert metrics.rotation_error(flipped, GT) == pytest.approx(np.pi)
    assert metrics.pose_error(flipped, GT)[1] == pytest.approx(0.04)  # the axis is beside the origin
    assert metrics.rotation_error(flipped, GT, symmetries) == pytest.approx(0, abs=1e-9)
    assert metrics.pose_error(flipped, GT, symmetries)[1] == pytest.approx(0, abs=1e-9)


def test_continuous_symmetries_are_as_fine_as_their_steps() -> None:
    symmetries = Symmetries.parse("z:inf", [0, 0, 0]).transforms(metrics.BOP_STEPS)
    error = metrics.rotation_error(turned(1.234), GT, symmetries)
    assert error <= np.pi / metrics.BOP_STEPS + 1e-9
    tilted = GT @ Pose.rotation(so3_exp([0.2, 0, 0])) @ Pose.rotation(so3_exp([0, 0, 1.0]))
    assert metrics.rotation_error(tilted, GT, symmetries) == pytest.approx(0.2, abs=0.01)


def test_deepim_flips_beyond_a_right_angle_only() -> None:
    assert metrics.deepim_rotation_error(turned(np.deg2rad(170)), GT) == pytest.approx(np.deg2rad(10))
    assert metrics.deepim_rotation_error(turned(np.deg2rad(80)), GT) == pytest.approx(np.deg2rad(80))
    both = metrics.deepim_rotation_error([turned(np.deg2rad(100)), turned(np.deg2rad(30))], GT)
    np.testing.assert_allclose(np.rad2deg(both), [80, 30])


def test_deepim_flips_about_the_objects_own_z_axis() -> None:
    tilt = so3_exp([0.2, -0.3, 0.1])
    flipped = GT @ Pose.rotation(so3_exp([0, 0, np.pi])) @ Pose.rotation(tilt)
    back = Pose.rotation(tilt) @ Pose.rotation(so3_exp([0, 0, np.pi]))
    wanted = metrics.rotation_error(GT @ Pose.rotation(so3_exp([0, 0, np.pi])) @ back, GT)
    assert metrics.deepim_rotation_error(flipped, GT) == pytest.approx(wanted)


def test_within_is_strict() -> None:
    turn, shift = np.deg2rad([4.9, 5.0, 4.9, 1.0]), np.array([0.049, 0.01, 0.06, 0.0])
    assert metrics.within(turn, shift, 5, 5).tolist() == [True, False, False, True]


def test_add_and_adds() -> None:
    shifted = Pose(GT.R, GT.t + [0.003, 0.004, 0])
    assert metrics.add(shifted, GT, POINTS) == pytest.approx(0.005)
    square = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]) * 0.1
    quarter = turned(np.pi / 2)
    assert metrics.add(quarter, GT, square) == pytest.approx(0.2)
    assert metrics.adds(quarter, GT, square) == pytest.approx(0, abs=1e-12)
    assert metrics.adds(shifted, GT, square) == pytest.approx(0.005)


def test_proj2d_of_a_sideways_shift() -> None:
    flat = np.column_stack([POINTS[:, :2], np.zeros(len(POINTS))])
    near = Pose(np.eye(3), [0, 0, 0.5])
    beside = Pose(np.eye(3), [0.01, 0, 0.5])
    assert metrics.proj2d(beside, near, CAMERA, flat) == pytest.approx(500 * 0.01 / 0.5)
    assert metrics.mspd(beside, near, CAMERA, flat) == pytest.approx(10)


def test_mssd_is_the_largest_distance_over_the_best_symmetry() -> None:
    stick = np.array([[0, 0, 0], [0.1, 0, 0], [0.03, 0.01, 0]])
    assert metrics.mssd(turned(np.pi), GT, stick) == pytest.approx(0.2)
    quarter = metrics.mssd(turned(np.pi / 2), GT, stick)
    assert quarter == pytest.approx(0.1 * np.sqrt(2))
    symmetries = Symmetries.parse("z:4", [0, 0, 0]).transforms()
    assert metrics.mssd(turned(np.pi / 2), GT, stick, symmetries) == pytest.approx(0, abs=1e-12)
    off = turned(np.pi / 2 + 0.1)
    assert metrics.mssd(off, GT, stick, symmetries) == pytest.approx(0.2 * np.sin(0.05))
    assert metrics.mspd(off, GT, CAMERA, stick) > metrics.mspd(off, GT, CAMERA, stick, symmetries) > 0


def test_mssd_needs_the_hull_only() -> None:
    from scipy.spatial import ConvexHull

    hull = POINTS[ConvexHull(POINTS).vertices]
    assert len(hull) < len(POINTS)
    for angle in (0.1, 1.0, 2.5):
        assert metrics.mssd(turned(angle), GT, hull) == pytest.approx(metrics.mssd(turned(angle), GT, POINTS))


# --- vectorised forms against naive ones ----------------------------------------------------------------------------


def random_poses(n: int, seed: int) -> list[Pose]:
    rng = np.random.default_rng(seed)
    return [Pose(random_rotation(rng), [*rng.normal(0, 0.05, 2), rng.uniform(0.6, 1.0)]) for _ in range(n)]


def test_adds_against_all_distances() -> None:
    estimated, truth = random_poses(5, 1), random_poses(5, 2)
    naive = []
    for e, t in zip(estimated, truth, strict=True):
        apart = np.linalg.norm(t.apply(POINTS)[:, None] - e.apply(POINTS)[None], axis=-1)
        naive.append(apart.min(axis=1).mean())
    np.testing.assert_allclose(metrics.adds(estimated, truth, POINTS), naive, rtol=1e-9)


@pytest.mark.parametrize("text", ["z:inf", "x:2,y:2", "z:5"])
def test_the_search_of_symmetries_by_bounds_is_exact(text: str) -> None:
    symmetries = Symmetries.parse(text, [0.01, 0, 0]).transforms(metrics.BOP_STEPS)
    estimated, truth = random_poses(6, 3), random_poses(6, 4)
    estimated[0] = truth[0] @ symmetries[-1] @ Pose.translation([0.001, 0.002, 0.003])
    camera = Camera(500, 520, 310, 250, 640, 480)
    naive = [
        min(
            np.linalg.norm(camera.project(e.apply(POINTS)) - camera.project((t @ s).apply(POINTS)), axis=1).max()
            for s in symmetries
        )
        for e, t in zip(estimated, truth, strict=True)
    ]
    np.testing.assert_allclose(metrics.mspd(estimated, truth, camera, POINTS, symmetries), naive, rtol=1e-9)


def test_each_pose_may_have_its_own_camera() -> None:
    estimated, truth = random_poses(3, 5), random_poses(3, 6)
    cameras = [Camera(400 + 50 * k, 410, 300, 200 + k, 640, 480) for k in range(3)]
    K = np.stack([c.K for c in cameras])
    for measure in (metrics.proj2d, metrics.mspd):
        alone = [measure(e, t, c, POINTS) for e, t, c in zip(estimated, truth, cameras, strict=True)]
        np.testing.assert_allclose(measure(estimated, truth, K, POINTS), alone, rtol=1e-12)


def test_no_poses_give_no_errors() -> None:
    none = np.zeros((0, 4, 4))
    for values in (metrics.add(none, none, POINTS), metrics.mssd(none, none, POINTS), metrics.adds(none, none, POINTS)):
        assert values.shape == (0,)


def test_no_poses_need_no_nearest_points() -> None:
    none, many = np.zeros((0, 4, 4)), np.random.default_rng(2).uniform(-0.05, 0.05, (600, 3))
    assert metrics.adds(none, none, many).shape == (0,)


def test_cells_are_prepared_for_many_points_at_many_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "_MANY", 1000)
    monkeypatch.setattr(metrics, "_CELLS", 1000)
    cloud = np.random.default_rng(2).uniform(0, 1, (500, 3))
    for points, poses, prepared in ((500, 2, True), (500, 1, False), (499, 10, False)):
        tree, between = cKDTree(cloud[:points]), np.tile(np.eye(4), (poses, 1, 1))
        found = metrics._nearest_points(cloud[:points], tree, between)
        assert (found is not None) == prepared


@pytest.mark.parametrize("scale", [0.02, 0.2])
def test_the_cells_hold_the_points_of_all_but_the_farthest_poses(scale: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """At most half the object's longest side beside its box."""
    rng, regions = np.random.default_rng(4), []
    cloud = rng.uniform(0, 1, (600, 3)) * [1.0, 2.0, 4.0] + [5.0, -3.0, 1.0]
    poses = [Pose(so3_exp(rng.normal(size=3) * scale), rng.normal(size=3) * [0.1, 0.3, 0.2]) for _ in range(101)]
    monkeypatch.setattr(metrics, "_MANY", 0)
    monkeypatch.setattr(metrics, "NearestPoints", lambda *given: regions.append(given[2:4]))
    metrics._nearest_points(cloud, cKDTree(cloud), np.array([pose.matrix for pose in poses]))
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    corners = np.array(list(itertools.product(*zip(low, high, strict=True))))
    away = np.sort([np.abs(pose.apply(corners) - corners).max(axis=0) for pose in poses], axis=0)[98]
    longest = (high - low).max()
    margin = np.minimum(away, longest / 2) + 1e-3 * longest
    assert (away > longest / 2).any() == (scale == 0.2)
    [region] = regions
    np.testing.assert_allclose(region, [low - margin, high + margin])


def test_auc_is_the_area_under_accuracy_against_threshold() -> None:
    errors = np.array([0.0, 0.02, 0.05, 0.3])
    thresholds = np.linspace(0, 0.1, 100_001)
    area = (errors[:, None] < thresholds).mean()
    assert metrics.auc(errors).mean() == pytest.approx(area, abs=1e-4)
    assert metrics.auc(errors).tolist() == pytest.approx([1.0, 0.8, 0.5, 0.0])


# --- VSD -------------------------------------------------------------------------------------------------------------


def depths(*columns: tuple[int, int, float]) -> np.ndarray:
    """A 4 x 8 depth image with blocks of columns [a, b) at a depth."""
    image = np.zeros((4, 8), np.float32)
    for a, b, z in columns:
        image[:, a:b] = z
    return image


FAR = Camera(1e6, 1e6, 3.5, 1.5, 8, 4)  # rays along z, so that distances are depths
TAUS = np.linspace(0.05, 0.5, 10)


def test_vsd_of_the_truth_is_zero() -> None:
    gt = depths((1, 5, 1.0))
    assert metrics.vsd(gt, gt, gt, FAR, 0.1, TAUS).tolist() == [0.0] * 10


def test_vsd_counts_pixels_that_only_one_pose_covers() -> None:
    gt, est = depths((1, 5, 1.0)), depths((3, 7, 1.0))
    scene = depths((0, 8, 2.0))  # both are in front of what the sensor saw
    np.testing.assert_allclose(metrics.vsd(est, gt, scene, FAR, 0.1, TAUS), 4 / 6)


def test_vsd_counts_distances_against_the_tolerance() -> None:
    gt, est = depths((1, 5, 1.0)), depths((1, 5, 1.012))
    values = metrics.vsd(est, gt, depths(), FAR, 0.1, TAUS)
    assert values.tolist() == [1.0, 1.0] + [0.0] * 8  # 12 mm of a diameter of 100 mm


def test_vsd_leaves_out_what_is_hidden() -> None:
    gt, est = depths((1, 5, 1.0)), depths((1, 7, 1.0))
    scene = depths((0, 3, 0.5), (3, 5, 1.0), (5, 7, 0.5))  # something stands before columns 0-2 and 5-6
    np.testing.assert_allclose(metrics.vsd(est, gt, scene, FAR, 0.1, TAUS), 0.0)
    np.testing.assert_allclose(metrics.vsd(depths(), depths(), scene, FAR, 0.1, TAUS), 1.0)


def test_vsd_against_its_definition() -> None:
    """Pixel by pixel, with a wide lens, holes in the sensor's depth, and distances along the rays."""
    rng, camera = np.random.default_rng(0), Camera(6.0, 7.0, 5.5, 3.5, 12, 8)
    est, gt, scene = (rng.uniform(0.50, 0.56, (8, 12)) * (rng.random((8, 12)) < 0.7) for _ in range(3))
    taus = [0.05, 0.2, 0.4]
    for delta in (0.015, 0.03):
        costs = np.zeros((3, 0))
        for row in range(8):
            for column in range(12):
                length = float(np.linalg.norm([(column - 5.5) / 6, (row - 3.5) / 7, 1]))
                e, g, s = (d[row, column] * length for d in (est, gt, scene))
                seen_g = g > 0 and (s == 0 or g - s <= delta)
                seen_e = e > 0 and (s == 0 or e - s <= delta or seen_g)
                if seen_e and seen_g:
                    costs = np.column_stack([costs, [abs(e - g) / 0.1 >= tau for tau in taus]])
                elif seen_e or seen_g:
                    costs = np.column_stack([costs, np.ones(3)])
        found = metrics.vsd(est, gt, scene, camera, 0.1, taus, delta)
        np.testing.assert_allclose(found, costs.mean(axis=1))
        assert 0.2 < found[2] < found[0] < 1
        if delta == 0.015:
            np.testing.assert_array_equal(metrics.vsd(est, gt, scene, camera, 0.1, taus), found)


# --- matching, precision ---------------------------------------------------------------------------------------------


def test_matching_is_greedy_by_score() -> None:
    errors = [[1.0, 3.0], [0.5, 0.6], [9.0, 9.0]]
    assert metrics.match(errors, [0.9, 0.8, 0.7], 5.0).tolist() == [0, 1, -1]
    assert metrics.match(errors, [0.8, 0.9, 0.7], 5.0).tolist() == [1, 0, -1]
    assert metrics.match(errors, [0.9, 0.8, 0.7], 0.6).tolist() == [-1, 0, -1]  # strictly below
    assert metrics.match(np.zeros((2, 0)), [1, 2], 5.0).tolist() == [-1, -1]


def test_average_precision_of_hand_made_cases() -> None:
    assert metrics.average_precision([True, True], [0.9, 0.8], 2) == 1.0
    assert metrics.average_precision([], [], 3) == 0.0
    # right, wrong, right of 2: precision 1 up to recall 0.5 (51 of the levels), 2/3 beyond (50)
    assert metrics.average_precision([True, True, False], [0.9, 0.7, 0.8], 2) == pytest.approx((51 + 50 * 2 / 3) / 101)


def test_precision_is_read_at_a_hundred_and_one_levels_of_recall() -> None:
    rng = np.random.default_rng(1)
    hits, scores, total = rng.random(60) < 0.5, rng.random(60), 40
    order = np.argsort(-scores)
    precision = np.cumsum(hits[order]) / np.arange(1, 61)
    recall = np.cumsum(hits[order]) / total
    wanted = [max((p for p, r in zip(precision, recall, strict=True) if r >= k / 100), default=0) for k in range(101)]
    assert metrics.average_precision(hits, scores, total) == pytest.approx(np.mean(wanted))


def test_scores_that_are_alike_keep_their_order() -> None:
    assert metrics.match([[1.0], [0.5]], [0.5, 0.5], 2.0).tolist() == [0, -1]
    assert metrics.average_precision([False] + [True] * 20, [0.5] * 21, 20) < 1

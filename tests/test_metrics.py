"""Metrics against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from posekit import metrics
from posekit.camera import Camera
from posekit.geometry import Pose, random_rotation, so3_exp
from posekit.object_model import Symmetries

GT = Pose(random_rotation(np.random.default_rng(5)), [0.1, -0.05, 0.8])
POINTS = np.random.default_rng(1).uniform(-0.05, 0.05, size=(200, 3))
CAMERA = Camera(500, 500, 320, 240, 640, 480)


def turned(angle: float, axis: tuple[float, float, float] = (0, 0, 1)) -> Pose:
    """The truth with the object turned about its own axis."""
    return GT @ Pose.rotation(so3_exp(np.array(axis) * angle))


def test_plain_errors() -> None:
    moved = Pose(turned(0.3).R, GT.t + [0.03, 0.0, 0.04])
    assert metrics.rotation_error(moved, GT) == pytest.approx(0.3)
    assert metrics.translation_error(moved, GT) == pytest.approx(0.05)
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


def test_an_array_of_another_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"shape \(4, 4\) or \(N, 4, 4\), not \(3, 3\)"):
        metrics.rotation_error(np.eye(3), GT)


def test_symmetries_count_the_nearest_truth() -> None:
    centre = np.array([0.02, 0.0, 0.0])
    symmetries = Symmetries.parse("z:2", centre).transforms()
    flipped = GT @ symmetries[1]
    assert metrics.rotation_error(flipped, GT) == pytest.approx(np.pi)
    assert metrics.translation_error(flipped, GT) == pytest.approx(0.04)  # the axis is beside the origin
    assert metrics.rotation_error(flipped, GT, symmetries) == pytest.approx(0, abs=1e-9)
    assert metrics.translation_error(flipped, GT, symmetries) == pytest.approx(0, abs=1e-9)


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

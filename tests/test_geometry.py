"""Poses form a group, rotations have several forms, views lie all round."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conftest import points
from posekit.geometry import (
    Pose,
    PoseNoise,
    cube_views,
    euler_xyz,
    fibonacci_sphere,
    nearest_rotation,
    quat_to_rotation,
    random_rotation,
    rotation_angle,
    rotation_between,
    rotation_to_quat,
    so3_exp,
    so3_log,
    view_rotation,
)

unit = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.1)
sizes = st.one_of(st.floats(0, np.pi - 1e-3), st.floats(1e-9, 1e-6))  # radians; near the identity too
turns = st.builds(lambda axis, angle: axis / np.linalg.norm(axis) * angle, unit, sizes)
poses = st.builds(lambda w, t: Pose(so3_exp(w), t), turns, st.tuples(*[st.floats(-2, 2)] * 3).map(np.array))


def same(a: Pose, b: Pose, tolerance: float = 1e-9) -> bool:
    return float(np.abs(a.matrix - b.matrix).max()) < tolerance


@given(poses, poses, poses)
def test_poses_are_a_group(a: Pose, b: Pose, c: Pose) -> None:
    assert same((a @ b) @ c, a @ (b @ c))
    assert same(a @ Pose.identity(), a)
    assert same(Pose.identity() @ a, a)
    assert same(a @ a.inverse(), Pose.identity())
    assert same((a @ b).inverse(), b.inverse() @ a.inverse())


@given(poses, poses, points)
def test_a_product_applies_the_right_factor_first(a: Pose, b: Pose, p: np.ndarray) -> None:
    np.testing.assert_allclose((a @ b).apply(p), a.apply(b.apply(p)), atol=1e-12)
    np.testing.assert_allclose(a.inverse().apply(a.apply(p)), p, atol=1e-12)


@given(turns)
def test_exp_and_log_are_inverse(w: np.ndarray) -> None:
    np.testing.assert_allclose(so3_log(so3_exp(w)), w, atol=1e-9)
    np.testing.assert_allclose(rotation_angle(so3_exp(w)), np.linalg.norm(w), atol=1e-9)


def test_tiny_turns_keep_their_digits() -> None:
    w = np.array([1e-7, -2e-7, 3e-7])
    np.testing.assert_allclose(so3_log(so3_exp(w)), w, rtol=1e-6)
    np.testing.assert_allclose(rotation_angle(so3_exp(w)), np.linalg.norm(w), rtol=1e-6)


@given(turns)
def test_quaternions_are_scalar_first_and_non_negative(w: np.ndarray) -> None:
    R, q = so3_exp(w), rotation_to_quat(so3_exp(w))
    angle = np.linalg.norm(w)
    assert q[0] >= 0
    np.testing.assert_allclose(q[0], np.cos(angle / 2), atol=1e-9)
    np.testing.assert_allclose(quat_to_rotation(q), R, atol=1e-9)
    np.testing.assert_allclose(quat_to_rotation(-3 * q), R, atol=1e-9)


@pytest.mark.parametrize("axis", np.eye(3))
def test_half_turns(axis: np.ndarray) -> None:
    R = so3_exp(axis * np.pi)
    np.testing.assert_allclose(rotation_angle(R), np.pi, atol=1e-12)
    np.testing.assert_allclose(so3_exp(so3_log(R)), R, atol=1e-9)


@given(poses)
def test_matrices_round_trip(pose: Pose) -> None:
    assert same(Pose.from_matrix(pose.matrix), pose)
    assert same(Pose.from_matrix(pose.matrix[:3]), pose)
    assert same(Pose(quat_to_rotation(pose.quat_wxyz), pose.t), pose)


@pytest.mark.parametrize("matrix", [np.zeros((4, 4)), np.diag([1, 1, -1, 1]), np.full((4, 4), np.nan), 2 * np.eye(4)])
def test_what_is_no_rotation_is_refused(matrix: np.ndarray) -> None:
    with pytest.raises(ValueError, match="not a rotation"):
        Pose.from_matrix(matrix)
    with pytest.raises(ValueError, match=r"shape \(4, 4\) or \(3, 4\), not \(3, 3\)"):
        Pose.from_matrix(matrix[:3, :3])


def test_poses_are_values() -> None:
    R = np.eye(3)
    pose = Pose(R, np.zeros(3))
    R[0, 0] = 5
    assert pose.R[0, 0] == 1
    with pytest.raises(ValueError, match="read-only"):
        pose.t[0] = 1


@given(unit, unit)
def test_rotation_between_is_the_smallest(a: np.ndarray, b: np.ndarray) -> None:
    cosine = a @ b / np.linalg.norm(a) / np.linalg.norm(b)
    if cosine < -0.99:
        return
    R = rotation_between(a, b)
    np.testing.assert_allclose(R @ a / np.linalg.norm(a), b / np.linalg.norm(b), atol=1e-9)
    np.testing.assert_allclose(rotation_angle(R), np.arccos(np.clip(cosine, -1, 1)), atol=1e-6)


def test_noise_is_bounded_and_of_the_asked_size() -> None:
    rng, noise = np.random.default_rng(0), PoseNoise()
    start = Pose(random_rotation(rng), [0.1, 0.2, 0.9])
    moved = [noise.disturb(start, rng) for _ in range(400)]
    angles = np.array([rotation_angle(p.R @ start.R.T) for p in moved])
    assert angles.max() <= np.deg2rad(45)
    assert 18 < np.rad2deg(np.sqrt((angles**2).mean())) < 26.5  # 15 sqrt(3) = 26, a little less for the limit
    np.testing.assert_allclose(np.std([p.t for p in moved], axis=0), [0.01, 0.01, 0.05], rtol=0.15)


def test_cube_views_are_six_different_faces_with_z_up() -> None:
    views = cube_views()
    forward = np.array([R[2] for R in views])
    np.testing.assert_allclose(forward[0], [0, 1, 0])
    np.testing.assert_allclose(np.abs(forward).sum(axis=1), 1)
    assert len(np.unique(forward.round(), axis=0)) == 6
    for R in views:
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) > 0
    np.testing.assert_allclose([R[1] @ [0, 0, 1] for R in views[:4]], -1)  # down in the picture is -z


def test_views_over_the_sphere_look_at_the_origin() -> None:
    directions = fibonacci_sphere(50)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    np.testing.assert_allclose(directions.mean(axis=0), 0, atol=0.02)
    for d in directions:
        np.testing.assert_allclose(view_rotation(d) @ -d, [0, 0, 1], atol=1e-12)


def test_views_are_spread_by_the_golden_angle() -> None:
    np.testing.assert_allclose(fibonacci_sphere(4)[:, 2], [0.75, 0.25, -0.25, -0.75])
    views = fibonacci_sphere(300)
    azimuth = np.unwrap(np.arctan2(views[:, 1], views[:, 0]))
    np.testing.assert_allclose(np.mod(np.diff(azimuth), 2 * np.pi), np.pi * (5**0.5 - 1), atol=1e-9)
    apart = np.sort(np.arccos(np.clip(views @ views.T, -1, 1)), axis=1)[:, 1]
    assert apart.min() > 0.7 * np.sqrt(4 * np.pi / 300), "none is much nearer to another than all are"


def test_z_is_up_in_a_view_but_from_above_and_below() -> None:
    np.testing.assert_allclose(view_rotation([0, 0, 2]), [[1, 0, 0], [0, -1, 0], [0, 0, -1]], atol=1e-12)
    np.testing.assert_allclose(view_rotation([0, 0, -2]), [[-1, 0, 0], [0, -1, 0], [0, 0, 1]], atol=1e-12)
    for high, axis in ((0.9985, 2), (-0.9985, 2), (0.9995, 1), (-0.9995, 1)):
        R = view_rotation([0.6 * np.sqrt(1 - high**2), 0.8 * np.sqrt(1 - high**2), high])
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert R[0, axis] == pytest.approx(0) and abs(R[0, 3 - axis]) > 1e-3, "that axis has no part to the right"
        assert R[1, axis] < 0, "and points up"


def test_euler_angles_turn_about_x_first() -> None:
    a, b, c = 0.3, -0.5, 0.8
    Rx = [[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]]
    Ry = [[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]]
    Rz = [[np.cos(c), -np.sin(c), 0], [np.sin(c), np.cos(c), 0], [0, 0, 1]]
    np.testing.assert_allclose(euler_xyz([a, b, c]), np.array(Rz) @ Ry @ Rx, atol=1e-12)


def test_a_matrix_is_a_rotation_to_a_thousandth() -> None:
    matrix = np.eye(4)
    matrix[:3, 3] = 1, 2, 3
    matrix[:3, :3] = 1.0004 * so3_exp([0.1, 0.2, 0.3])
    np.testing.assert_allclose(Pose.from_matrix(matrix).R, so3_exp([0.1, 0.2, 0.3]), atol=1e-12)
    matrix[:3, :3] *= 1.0004
    with pytest.raises(ValueError, match="not a rotation"):
        Pose.from_matrix(matrix)


def test_the_nearest_rotation_is_no_reflection() -> None:
    R = so3_exp([0.3, -0.4, 0.5])
    np.testing.assert_allclose(nearest_rotation(R @ np.diag([2.0, 3.0, -0.1])), R, atol=1e-12)
    np.testing.assert_allclose(nearest_rotation(R @ np.diag([2.0, 3.0, 0.1])), R, atol=1e-12)


def test_rotations_are_drawn_all_over() -> None:
    rng = np.random.default_rng(2)
    drawn = np.array([random_rotation(rng) for _ in range(3000)])
    np.testing.assert_allclose(drawn.mean(axis=0), 0, atol=0.05)
    np.testing.assert_allclose((drawn**2).mean(axis=0), 1 / 3, atol=0.03)


def test_moves_of_one_kind() -> None:
    p, R = np.array([[0.1, 0.2, 0.3], [1.0, 2.0, 3.0]]), so3_exp([0.0, 0.0, np.pi / 2])
    np.testing.assert_allclose(Pose.translation([1.0, 2.0, 3.0]).apply(p), p + [1.0, 2.0, 3.0])
    np.testing.assert_allclose(Pose.rotation(R).apply(p), np.stack([-p[:, 1], p[:, 0], p[:, 2]], axis=1), atol=1e-12)
    np.testing.assert_allclose(Pose(R, [1.0, 0.0, 0.0]).apply([2.0, 3.0, 4.0]), [-2.0, 2.0, 4.0])
    assert Pose.translation([1.0, 2.0, 3.0]).matrix.shape == Pose.rotation(R).matrix.shape == (4, 4)


def test_a_matrix_with_one_number_missing_is_no_pose() -> None:
    matrix = np.eye(4)
    matrix[1, 3] = np.nan
    with pytest.raises(ValueError, match="is not a rotation"):
        Pose.from_matrix(matrix)


def test_tiny_turns_have_a_logarithm() -> None:
    for size in (1e-12, 1e-10, 1.5e-9, 3e-9, 1e-6):
        np.testing.assert_allclose(so3_log(so3_exp([size, 0.0, -size])), [size, 0.0, -size], rtol=1e-6)


def test_many_rotations_at_once() -> None:
    vectors = np.random.default_rng(0).normal(size=(2, 5, 3)) * 0.5
    R = so3_exp(vectors)
    assert R.shape == (2, 5, 3, 3)
    np.testing.assert_allclose(R[1, 3], so3_exp(vectors[1, 3]))
    np.testing.assert_allclose(rotation_angle(R), np.linalg.norm(vectors, axis=-1))


def test_noise_without_a_turn_adds_its_shift() -> None:
    noise, start = PoseNoise(0.0, 1.0, (0.1, 0.2, 0.3)), Pose(np.eye(3), [1.0, 2.0, 3.0])
    shift = noise.sample(np.random.default_rng(7))[1]
    np.testing.assert_allclose(noise.disturb(start, np.random.default_rng(7)).t, start.t + shift)

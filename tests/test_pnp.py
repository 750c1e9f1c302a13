"""The projection's Jacobian, and the robust weights of PnP."""

from __future__ import annotations

import numpy as np
import pytest

from conftest import differences, moved
from posekit.align.gauss_newton import projection_jacobian
from posekit.align.pnp import PnpConfig, solve_pnp
from posekit.camera import Camera
from posekit.geometry import Pose, rotation_angle, so3_exp

CAMERA = Camera(900.0, 870.0, 81.5, 57.5, 160, 120)


def case(seed: int) -> tuple[np.ndarray, Pose]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-0.08, 0.08, (40, 3)), Pose(so3_exp(rng.normal(size=3)), rng.normal(size=3) * 0.05 + [0, 0, 0.7])


@pytest.mark.parametrize("seed", range(4))
def test_the_projections_jacobian_is_its_derivative(seed: int) -> None:
    points, pose = case(seed)
    arm = points @ pose.R.T
    found = projection_jacobian(arm, arm + pose.t, CAMERA)
    wanted = differences(lambda step: CAMERA.project(moved(pose, step).apply(points)), 6)
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-4)


def solved(points: np.ndarray, pose: Pose, pixels: np.ndarray, start: Pose, **config: float) -> Pose:
    n = len(points)
    found = solve_pnp(points, pixels, np.ones(n), np.ones(n), CAMERA, start, PnpConfig(**config))  # type: ignore[arg-type]
    assert found is not None
    return found


def test_few_steps_suffice_from_nearby() -> None:
    """A wrong derivative still converges, slowly: Gauss-Newton squares the error."""
    points, pose = case(1)
    start = moved(pose, np.array([0.05, -0.04, 0.06, 0.004, -0.003, 0.01]))
    found = solved(points, pose, CAMERA.project(pose.apply(points)), start, iterations=3)
    assert rotation_angle(found.R @ pose.R.T) < 1e-4 and np.linalg.norm(found.t - pose.t) < 1e-4


def test_outliers_on_either_side_weigh_little() -> None:
    points, pose = case(2)
    pixels = CAMERA.project(pose.apply(points))
    for sign in (-1, 1):
        wrong = pixels.copy()
        wrong[:6, 0] += sign * 40.0
        found = solved(points, pose, wrong, pose)
        assert rotation_angle(found.R @ pose.R.T) < 0.004
        firm = solved(points, pose, wrong, pose, knee=1e6)
        assert rotation_angle(firm.R @ pose.R.T) > 5 * rotation_angle(found.R @ pose.R.T)


def test_a_points_scale_is_in_pixels() -> None:
    """Points that are expected to err more count less, by the square."""
    points, pose = case(3)
    pixels = CAMERA.project(pose.apply(points))
    pixels[:20, 1] += 1.0
    scale = np.where(np.arange(40) < 20, 10.0, 1.0)
    found = solve_pnp(points, pixels, np.ones(40), scale, CAMERA, pose)
    equal = solve_pnp(points, pixels, np.ones(40), np.ones(40), CAMERA, pose)
    assert found is not None and equal is not None
    away = [np.linalg.norm(p.t - pose.t) for p in (found, equal)]
    assert away[0] < 0.05 * away[1]


def test_weights_count_and_the_limits_are_exact() -> None:
    points, pose = case(0)
    pixels = CAMERA.project(pose.apply(points))
    pixels[:20] += 30.0
    weight = np.where(np.arange(40) < 20, 0.0, 1.0)
    found = solve_pnp(points, pixels, weight, np.ones(40), CAMERA, pose)
    assert found is not None and np.linalg.norm(found.t - pose.t) < 1e-9
    for count, known in ((11, False), (12, True)):
        there = solve_pnp(points, pixels, np.where(np.arange(40) < count, 0.2, 0.1), np.ones(40), CAMERA, pose)
        assert (there is not None) == known
    behind = Pose(pose.R, [0.0, 0.0, -0.7])
    assert solve_pnp(points, pixels, np.ones(40), np.ones(40), CAMERA, behind) is None


def test_the_pose_found_balances_the_robustly_weighted_residuals() -> None:
    """Cauchy's weights in units of each point's scale: the gradient vanishes there, and nowhere beside it."""
    points, pose = case(1)
    rng = np.random.default_rng(1)
    scale, visible = rng.uniform(0.3, 4.0, 40), rng.uniform(0.2, 1.0, 40)
    pixels = CAMERA.project(pose.apply(points)) + rng.normal(size=(40, 2)) * scale[:, None]
    pixels[:4] += 6 * scale[:4, None]
    found = solve_pnp(points, pixels, visible, scale, CAMERA, pose, PnpConfig(iterations=60))
    assert found is not None

    def residual(at: Pose) -> np.ndarray:
        return np.asarray(CAMERA.project(at.apply(points)) - pixels)

    size = np.linalg.norm(residual(found), axis=1) / scale
    assert 1.5 * np.median(size) < 2.5, "the knee is the configured one here"
    weight = np.repeat(visible / (1 + (size / 2.5) ** 2) / scale**2, 2)
    J = differences(lambda step: residual(moved(found, step)).ravel(), 6)
    away = np.linalg.solve(J.T @ (J * weight[:, None]), J.T @ (weight * residual(found).ravel()))
    np.testing.assert_allclose(away, 0, atol=1e-6)


def test_one_step_is_damped_by_a_share_of_the_diagonal() -> None:
    points, pose = case(2)
    start = moved(pose, np.array([0.02, -0.03, 0.01, 0.002, 0.001, -0.003]))
    pixels = CAMERA.project(pose.apply(points))
    J = differences(lambda step: CAMERA.project(moved(start, step).apply(points)).ravel(), 6)
    A, off = J.T @ J, (CAMERA.project(start.apply(points)) - pixels).ravel()
    for config, damping in ((PnpConfig(1, 1e9), 1e-3), (PnpConfig(1, 1e9, 0.5), 0.5)):
        step = np.linalg.solve(A + damping * np.diag(np.diag(A)), -J.T @ off)
        found = solve_pnp(points, pixels, np.ones(40), np.ones(40), CAMERA, start, config)
        assert found is not None
        np.testing.assert_allclose(found.matrix, moved(start, step).matrix, atol=1e-8)


def test_no_point_may_be_behind_the_camera() -> None:
    points, pose = case(0)
    pixels = CAMERA.project(pose.apply(points))
    points[5] = pose.inverse().apply([0.0, 0.0, 5e-4])
    assert solve_pnp(points, pixels, np.ones(40), np.ones(40), CAMERA, pose) is None

"""The equations of evidence against finite differences: fusion's, the contour's and the rigid solve's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from conftest import differences, moved
from posekit.align.gauss_newton import GaussianPose, Lines, Points, Solution, cauchy, fuse, geman_mcclure, solve
from posekit.align.mask_edge import MaskEdgeConfig, _Crop, _equations
from posekit.camera import Camera
from posekit.geometry import Pose, so3_exp, so3_log
from posekit.nets.rigid import Motion, Surface, _step, exp_so3, induced_flow

CAMERA = Camera(640.0, 655.0, 80.5, 58.5, 160, 120)
POSE = Pose(so3_exp([0.3, -0.5, 0.9]), np.array([0.02, -0.01, 0.6]))
RNG = np.random.default_rng(3)
POINTS = RNG.uniform(-0.05, 0.05, (30, 3))
PIXELS = CAMERA.project(POSE.apply(POINTS)) + RNG.normal(size=(30, 2)) * 2.0
SIGMA = RNG.uniform(0.5, 2.0, 30)
WEIGHT = RNG.uniform(0.2, 1.0, 30)
NORMALS = np.stack([np.cos(a := RNG.uniform(0, 6.28, 30)), np.sin(a)], axis=1)
FIRM = 1e9  # a knee beyond which nothing lies: then the equations are those of plain least squares


def about(residual, pose: Pose, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[no-untyped-def]
    """Normal matrix and right side of weighted least squares, by finite differences. residual: of a pose, (N,)."""
    J = differences(lambda step: residual(moved(pose, step)), 6)
    return J.T @ (J * weight[:, None]), -J.T @ (residual(pose) * weight)


@pytest.mark.parametrize("together", [1.0, 4.0])
def test_points_equations_are_weighted_least_squares(together: float) -> None:
    term = Points(POINTS, PIXELS, WEIGHT, SIGMA, FIRM, together)
    weight = np.repeat(WEIGHT / SIGMA**2 / together, 2)
    wanted = about(lambda pose: (CAMERA.project(pose.apply(POINTS)) - PIXELS).ravel(), POSE, weight)
    for found, expected in zip(term.equations(POSE, CAMERA), wanted, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-3 * np.abs(expected).max())


def test_lines_equations_are_weighted_least_squares() -> None:
    term = Lines(POINTS, PIXELS, NORMALS, SIGMA, FIRM, 4.0)
    wanted = about(
        lambda pose: ((CAMERA.project(pose.apply(POINTS)) - PIXELS) * NORMALS).sum(axis=1), POSE, 1 / SIGMA**2 / 4
    )
    for found, expected in zip(term.equations(POSE, CAMERA), wanted, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-3 * np.abs(expected).max())


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_robust_weights_depend_on_the_size_alone(sign: float) -> None:
    """A quarter of the weight at the knee, which is three standard deviations or 1.5 medians."""
    exact = CAMERA.project(POSE.apply(POINTS))
    far = exact.copy()
    far[0] -= sign * 6.0 * NORMALS[0]
    one, none = Lines(POINTS, far, NORMALS, np.full(30, 2.0)), Lines(POINTS, exact, NORMALS, np.full(30, 2.0))
    J = differences(
        lambda step: ((CAMERA.project(moved(POSE, step).apply(POINTS[:1])) - far[:1]) * NORMALS[:1]).sum(1), 6
    )
    lost = none.equations(POSE, CAMERA)[0] - one.equations(POSE, CAMERA)[0]
    np.testing.assert_allclose(lost, 0.75 * J.T @ J / 4.0 / 4.0, rtol=1e-4, atol=1e-3 * np.abs(lost).max())
    np.testing.assert_allclose(one.equations(POSE, CAMERA)[1], -J[0] * sign * 6.0 * 0.25 / 16.0, rtol=1e-4, atol=1e-3)


def test_a_belief_pulls_towards_its_pose_and_turns_with_its_axes() -> None:
    step = np.array([0.02, -0.01, 0.03, 0.002, 0.003, -0.004])
    belief = GaussianPose.about(moved(POSE, step), CAMERA, 0.1, 5.0, 0.02)
    np.testing.assert_allclose(np.diag(belief.covariance)[[0, 3, 5]],
                               [0.01, (5 / 640 * belief.pose.t[2]) ** 2, (0.02 * belief.pose.t[2]) ** 2])  # fmt: skip
    assert belief.turn_std == pytest.approx(0.1 * np.sqrt(3))
    normal, right = belief.equations(POSE, CAMERA)
    np.testing.assert_allclose(np.linalg.solve(normal, right), step, atol=1e-9)
    R = so3_exp([0.4, 0.1, -0.2])
    turned = belief.turned(R)
    found = fuse(Pose.rotation(R) @ POSE, [turned], CAMERA)
    assert found is not None
    np.testing.assert_allclose(found.pose.matrix, (Pose.rotation(R) @ belief.pose).matrix, atol=1e-6)
    np.testing.assert_allclose(turned.covariance[3:, 3:], R @ belief.covariance[3:, 3:] @ R.T)
    np.testing.assert_allclose(belief.spread(np.eye(6)).covariance, belief.covariance + np.eye(6))


def test_fusing_leaves_no_point_behind_the_camera() -> None:
    near = GaussianPose.about(Pose(POSE.R, np.array([0.0, 0.0, 5e-4])), CAMERA, 0.1, 1.0, 0.1)
    assert fuse(POSE, [near], CAMERA) is None


# --- the solver ------------------------------------------------------------------------------------------------------


def scripted(*rights: object, start: Pose = POSE, **options: float) -> tuple[Solution | None, int]:
    """What `solve` makes of given steps (None: no equations), and how many of them it takes."""
    size, calls = 6 + int(options.get("extra", 0)), []

    def equations(pose: Pose, more: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        right = rights[len(calls)]
        calls.append(pose)
        return None if right is None else (np.diag(np.arange(1.0, size + 1)), np.array(right) * np.arange(1, size + 1))

    found = solve(start, equations, **{"steps": len(rights), "still": 1e-3, **options})  # type: ignore[arg-type]
    return found, len(calls)


def test_steps_add_up_and_unknowns_beside_the_pose_too() -> None:
    first, second = np.array([0.1, -0.2, 0.3, 0.01, 0.02, -0.03, 0.5, -2.0]), np.full(8, 0.05)
    found, _ = scripted(first, second, extra=2)
    assert found is not None
    np.testing.assert_allclose(found.pose.matrix, moved(moved(POSE, first), second).matrix, atol=1e-12)
    np.testing.assert_allclose(found.extra, [0.55, -1.95])
    np.testing.assert_allclose(found.normal, np.diag(np.arange(1.0, 9)))
    none, _ = scripted(extra=2)
    assert none is not None and none.extra.tolist() == [0, 0]
    np.testing.assert_array_equal(none.normal, np.eye(8))
    plain, _ = scripted(np.full(6, 0.05))
    assert plain is not None and plain.extra.shape == (0,)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("k", range(6))
def test_the_loop_ends_when_turn_and_shift_are_still(k: int, sign: float) -> None:
    """The shift in shares of the distance, here 0.6 m."""
    limit = sign * 1e-3 * (1.0 if k < 3 else POSE.t[2])
    assert scripted(0.98 * limit * np.eye(6)[k], np.zeros(6), np.zeros(6))[1] == 1
    assert scripted(1.02 * limit * np.eye(6)[k], np.zeros(6), np.zeros(6))[1] == 2


def test_further_unknowns_do_not_keep_the_loop_going() -> None:
    assert scripted([0, 0, 0, 0, 0, 0, 5.0, 5.0], np.zeros(8), extra=2)[1] == 1


def test_a_point_three_standard_deviations_off_counts_a_quarter() -> None:
    points, sigma = POINTS[:3], np.array([2.0, 0.5, 2.0])
    pixels = CAMERA.project(POSE.apply(points))
    exact, _ = Points(points, pixels, np.ones(3), sigma).equations(POSE, CAMERA)
    alone, _ = Points(points[:1], pixels[:1], np.ones(1), sigma[:1]).equations(POSE, CAMERA)
    off = pixels + [[3.6, 4.8], [0, 0], [0, 0]]  # 6 pixels
    found, _ = Points(points, off, np.ones(3), sigma).equations(POSE, CAMERA)
    np.testing.assert_allclose(exact - found, 0.75 * alone, rtol=1e-6, atol=1e-9 * np.abs(alone).max())
    x, y, z = POSE.apply(points[0])
    along_z = [640.0 * x / z**2, 655.0 * y / z**2]  # how far a metre along z moves it, pixels
    assert alone[5, 5] == pytest.approx(np.dot(along_z, along_z) / 2.0**2)


def test_the_turn_that_ends_the_loop_does_not_depend_on_the_distance() -> None:
    far = Pose(POSE.R, np.array([0.1, 0.2, 3.0]))
    for right, calls in (([1.1e-3, 0, 0, 0, 0, 0], 2), ([0, 0, 0, 2.8e-3, 0, 0], 1), ([0, 0, 0, 0, 3.2e-3, 0], 2)):
        assert scripted(right, np.zeros(6), np.zeros(6), start=far)[1] == calls


def test_a_lines_side_does_not_matter() -> None:
    """Also where all residuals are large: then their median widens the knee."""
    for shift in (-20.0, 20.0):
        one = Lines(POINTS, PIXELS + shift * NORMALS, NORMALS, SIGMA)
        for a, b in zip(
            one.equations(POSE, CAMERA), replace(one, normals=-NORMALS).equations(POSE, CAMERA), strict=True
        ):
            np.testing.assert_allclose(a, b, rtol=1e-9)


@pytest.mark.parametrize("right", [None, [0, 0, 0, 0, 0, -0.5995], [0, 0, 0, np.nan, 0, 0], [0, 0, 0, 0, 0, -5]])
def test_a_pose_that_cannot_be_ends_the_loop(right: object) -> None:
    found, calls = scripted(right, np.full(6, 0.01))
    assert found is None and calls == 1


def test_a_pose_may_come_as_near_as_is_said() -> None:
    towards = [0, 0, 0, 0, 0, -0.3]
    assert scripted(towards)[0] is not None
    assert scripted(towards, nearest=0.31)[0] is None and scripted(towards, nearest=0.29)[0] is not None
    assert scripted([0, 0, 0, 0, 0, -0.5985])[0] is not None, "1.5 mm before the camera"


def test_rotations_stay_rotations() -> None:
    found, _ = scripted(*[np.full(6, 0.01)] * 9, start=Pose(POSE.R * 1.001, POSE.t))
    assert found is not None
    np.testing.assert_allclose(found.pose.R @ found.pose.R.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(("weights", "at_knee", "twice"), [(geman_mcclure, 1 / 4, 1 / 25), (cauchy, 1 / 2, 1 / 5)])
def test_robust_weights_by_size(weights, at_knee: float, twice: float) -> None:  # type: ignore[no-untyped-def]
    np.testing.assert_allclose(weights(np.array([0.0, 0.1, 0.2, 3.0, 6.0]), 3.0)[[0, 3, 4]], [1, at_knee, twice])
    far = np.array([0.0, 10.0, 20.0, 30.0, 60.0])  # 20 in the middle: the knee is 30
    np.testing.assert_allclose(weights(far, 3.0)[[0, 3, 4]], [1, at_knee, twice])
    even = weights(np.array([40.0, 0.0, 20.0, 10.0]), 3.0)  # the upper one of the two middle ones: 20
    assert even[2] == pytest.approx(1 / (1 + (2 / 3) ** 2) ** round(np.log2(1 / at_knee)))
    assert weights(np.zeros(0), 3.0).shape == (0,)


def test_points_behind_the_camera_are_brought_before_it() -> None:
    points, near = POINTS.copy(), POINTS.copy()
    points[3], near[3] = POSE.inverse().apply([[0.02, 0.01, -0.2], [0.02, 0.01, 1e-3]])
    for term in (Points(points, PIXELS, WEIGHT, SIGMA), Lines(points, PIXELS, NORMALS, SIGMA)):
        behind, before = term.equations(POSE, CAMERA), replace(term, points=near).equations(POSE, CAMERA)
        for a, b in zip(behind, before, strict=True):  # by the turn they differ: the arm is another one
            np.testing.assert_allclose(a[3:][..., -3:], b[3:][..., -3:], rtol=1e-6)


def test_fusing_takes_few_steps_and_weighs_by_certainty() -> None:
    step = np.array([0.02, -0.01, 0.03, 0.002, 0.003, -0.004])
    one = GaussianPose.about(POSE, CAMERA, 0.1, 5.0, 0.02)
    two = replace(one, pose=moved(POSE, step))
    found = fuse(POSE, [one, two], CAMERA)
    assert found is not None
    np.testing.assert_allclose(found.pose.matrix, moved(POSE, step / 2).matrix, atol=1e-5)
    np.testing.assert_allclose(found.information, one.information + two.information)
    for size, wanted in ((0.01, 6), (4.5e-4 * POSE.t[2], 1), (5.5e-4, 6)):
        restless = Restless(size)
        assert fuse(POSE, [restless], CAMERA) is not None
        assert restless.calls == wanted


class Restless:
    """Always asks for another step of a size."""

    def __init__(self, size: float) -> None:
        self.size, self.calls = size, 0

    def equations(self, pose: Pose, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        self.calls += 1
        return np.eye(6), np.full(6, self.size)


# --- the mask's edge -------------------------------------------------------------------------------------------------


def test_the_contours_equations_are_least_squares_with_a_prior() -> None:
    """The mask's distance is linear in the picture here, so that its change with the pose is known."""
    config = MaskEdgeConfig(knee=FIRM)
    start = moved(POSE, np.array([0.01, 0.02, -0.01, 0.001, 0.0, 0.002]))
    place = CAMERA.project(POSE.apply(POINTS))
    distance = RNG.normal(size=30)
    look = _Crop(CAMERA, np.eye(3), POSE, POINTS, distance, NORMALS, np.ones(30, bool), 1.5)
    grown = 0.7

    def residual(step: np.ndarray) -> np.ndarray:
        moves = ((CAMERA.project(moved(POSE, step).apply(POINTS)) - place) * NORMALS).sum(axis=1)
        return np.asarray(distance + moves - grown - step[6])

    J = differences(residual, 7)
    weight = 1 / config.sigma**2 / (config.correlated * 1.5)
    depth = POSE.t[2]
    sideways = config.shift / CAMERA.fx * depth
    prior = np.array([config.turn] * 3 + [sideways] * 2 + [config.depth * depth, config.grown]) ** -2.0
    back = np.concatenate([so3_log(start.R @ POSE.R.T), start.t - POSE.t, [-grown]])
    normal, right = _equations(look, start, grown, config)
    expected = weight * J.T @ J + np.diag(prior)
    np.testing.assert_allclose(normal, expected, rtol=1e-5, atol=1e-4 * np.abs(expected).max())
    np.testing.assert_allclose(right, prior * back - weight * J.T @ residual(np.zeros(7)), rtol=1e-4, atol=1e-2)
    hidden = replace(look, clear=np.arange(30) < 15)
    assert np.trace(_equations(hidden, start, grown, config)[0]) < np.trace(normal)


def edge_equations(distance: np.ndarray, **changed: object) -> tuple[np.ndarray, np.ndarray]:
    given = {"R_view_cam": np.eye(3), "clear": np.ones(30, bool), "start": POSE, "grown": 0.0} | changed
    crop = _Crop(CAMERA, given["R_view_cam"], POSE, POINTS, distance, NORMALS, given["clear"], 1.5)  # type: ignore[arg-type]
    return _equations(crop, given["start"], given["grown"], MaskEdgeConfig())  # type: ignore[arg-type]


def test_a_masks_edge_without_clear_points_leaves_the_given_pose() -> None:
    """Known to 8 degrees, 6 pixels of the crop, 2 % of the distance; the mask's size to a pixel."""
    normal, right = edge_equations(np.ones(30), clear=np.zeros(30, bool))
    sideways = 6.0 / 640.0 * 0.6
    deviations = np.array([np.deg2rad(8.0)] * 3 + [sideways] * 2 + [0.02 * 0.6, 1.0])
    np.testing.assert_allclose(normal, np.diag(deviations**-2.0))
    np.testing.assert_allclose(right, 0, atol=1e-9)


def test_a_distance_of_a_pixel_counts_a_quarter() -> None:
    distance = np.zeros(30)
    distance[4] = 1.0
    normal, _ = edge_equations(distance)
    assert normal[6, 6] - 1.0 == pytest.approx((29 + 1 / 4) / (0.3**2 * 4.0 * 1.5))


def test_distances_on_either_side_of_a_masks_edge_weigh_the_same() -> None:
    """Also where all are large: then their median widens the knee."""
    np.testing.assert_allclose(edge_equations(np.full(30, -20.0))[0], edge_equations(np.full(30, 20.0))[0])


def test_the_equations_of_a_masks_edge_are_in_the_photographs_axes() -> None:
    R, start = so3_exp([0.2, -0.4, 0.1]), moved(POSE, np.array([0.01, 0.02, -0.01, 0.001, 0.0, 0.002]))
    distance = RNG.normal(size=30)
    normal, right = edge_equations(distance, start=start, grown=0.3)
    turned = edge_equations(distance, start=Pose.rotation(R.T) @ start, grown=0.3, R_view_cam=R)
    axes = np.eye(7)
    axes[:3, :3] = axes[3:6, 3:6] = R
    np.testing.assert_allclose(turned[0], axes.T @ normal @ axes, rtol=1e-9, atol=1e-9 * np.abs(normal).max())
    np.testing.assert_allclose(turned[1], axes.T @ right, rtol=1e-9, atol=1e-9 * np.abs(right).max())


# --- the solve inside the network ------------------------------------------------------------------------------------


def surface() -> Surface:
    relief = 0.1 * torch.rand(1, 6, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return Surface.of(relief, torch.tensor([4.0], dtype=torch.float64), 4, 2.0)


def test_rotation_vectors_become_rotations() -> None:
    w = torch.tensor([[0.3, -0.2, 0.9], [1e-5, 0.0, 0.0]], dtype=torch.float64)
    for vector, R in zip(w.numpy(), exp_so3(w).numpy(), strict=True):
        np.testing.assert_allclose(R, so3_exp(vector), atol=1e-9)


def test_one_rigid_step_solves_the_damped_equations() -> None:
    """Against central differences of the flow that a motion induces."""
    there, rng = surface(), np.random.default_rng(5)
    flow = torch.from_numpy(rng.normal(size=(1, 48, 2)))
    weight = torch.from_numpy(rng.uniform(0.1, 1, (1, 48)))
    start = Motion(torch.from_numpy(so3_exp([0.05, 0.02, -0.03])[None]), torch.tensor([[0.01, -0.02, 0.03]]).double())

    def induced(step: np.ndarray) -> np.ndarray:
        R = torch.from_numpy(so3_exp(step[:3])[None]) @ start.R
        return induced_flow(there, Motion(R, start.t + torch.from_numpy(step[None, 3:]))).numpy().ravel()

    J, share = differences(induced, 6), np.repeat((weight / weight.sum()).numpy().ravel(), 2)
    A = J.T @ (J * share[:, None])
    g = J.T @ (share * (flow.numpy().ravel() - induced(np.zeros(6))))
    wanted = np.linalg.solve(A + np.eye(6) * (1e-2 * A + 1e-6), g)
    found = _step(there, start, flow, weight)
    np.testing.assert_allclose((found.t - start.t).numpy()[0], wanted[3:], rtol=1e-4, atol=1e-7)
    turn = so3_log(found.R.numpy()[0] @ start.R.numpy()[0].T)
    np.testing.assert_allclose(turn, wanted[:3], rtol=1e-4, atol=1e-7)

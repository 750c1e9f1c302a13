"""The refinement loop, proved with an oracle instead of a network: frames, units, zoom and update."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
import pytest

from objects import CAMERA, bracket
from posekit.align.pnp import solve_pnp
from posekit.camera import Camera
from posekit.errors import ConfigError
from posekit.estimate.refine import Refinement, RefineOptions, refine
from posekit.geometry import Pose, PoseNoise, rotation_angle, rotation_between, so3_exp, view_rotation
from posekit.mesh.model import ObjectModel
from posekit.nets.pose_delta import PoseDelta, apply_delta, delta_between
from posekit.nets.predictor import Correspondences, PairPrediction
from posekit.render import Renderer
from posekit.results import Step
from posekit.view import View

RENDERER = Renderer()
PLACES = [(0.0, 0.0, 0.7), (0.33, -0.2, 0.8), (-0.4, 0.27, 0.9)]  # the middle and near two corners


class Oracle:
    """Knows the truth and answers as the networks do. biased: answers the angle of ``angle`` whatever it sees."""

    size = (160, 120)
    dense = True

    def __init__(self, model: ObjectModel, truth: Pose, angles: Sequence[float] | None = None) -> None:
        self.model, self.truth, self.angles, self.calls = model, truth, angles, 0

    def predict(self, observed: Sequence[View], rendered: Sequence[View]) -> list[PairPrediction]:
        self.calls += 1
        return [self._one(o, r) for o, r in zip(observed, rendered, strict=True)]

    def _one(self, observed: View, rendered: View) -> PairPrediction:
        assert rendered.mask is not None and rendered.coords is not None and rendered.depth is not None
        target = Pose.rotation(observed.R_view_cam) @ self.truth @ self.model.T_obj_ctr
        rows, columns = np.nonzero(rendered.mask[2::4, 2::4])
        source = np.stack([columns, rows], axis=1) * 4 + 2
        points = rendered.coords[source[:, 1], source[:, 0]] - self.model.center
        place = rendered.camera.project(target.apply(points))
        ones = np.ones(len(source))
        found = Correspondences(source, place, ones, ones, ones)
        # the rendered pose, recovered from what was drawn: the oracle is told no pose
        drawn = rendered.camera.backproject(source, rendered.depth[source[:, 1], source[:, 0]])
        start = _align(points, drawn)
        delta = delta_between(start, target, rendered.camera.fx)
        angle = delta.angle if self.angles is None else self.angles[min(self.calls, len(self.angles)) - 1]
        return PairPrediction(delta, angle, found)


def _align(points: np.ndarray, drawn: np.ndarray) -> Pose:
    """The rigid transform of points onto drawn (Kabsch)."""
    a, b = points - points.mean(0), drawn - drawn.mean(0)
    u, _, vt = np.linalg.svd(b.T @ a)
    R = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return Pose(R, drawn.mean(0) - R @ points.mean(0))


def photograph(renderer: Renderer, model: ObjectModel, truth: Pose) -> View:
    view = renderer.render(model, [truth], CAMERA)[0]
    return View(view.image, CAMERA, view.mask)


def errors(pose: Pose, truth: Pose) -> tuple[float, float]:
    return float(np.rad2deg(rotation_angle(pose.R.T @ truth.R))), float(np.linalg.norm(pose.t - truth.t))


@pytest.mark.parametrize("update", ["regression", "correspondence"])
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (0.3, -0.2, 0.5)])
def test_an_oracle_brings_refine_to_the_truth_in_one_step(renderer, update, place, offset) -> None:
    model = bracket(offset)
    truth = Pose(view_rotation([0.5, -1.0, 0.6]), place) @ model.T_ctr_obj
    rng = np.random.default_rng(4)
    start = PoseNoise().disturb(truth @ model.T_obj_ctr, rng) @ model.T_ctr_obj
    assert errors(start, truth)[0] > 5
    options = RefineOptions(update=update, stop="fixed", iterations=1)
    found = refine(photograph(renderer, model, truth), model, [start], Oracle(model, truth), renderer, options)[0]
    turn, shift = errors(found.T_cam_obj, truth)
    # the rendered depth is float32: the oracle's own knowledge of the start is good to about 1e-5
    assert turn < 0.02 and shift < 2e-4
    assert found.iterations == 1 and found.trace[0].T_cam_obj is start


class Biased(Oracle):
    """Sees where the object is, and is wrong about how it is turned: by ``turn`` (3,), a rotation vector."""

    turn = np.deg2rad([3.0, -2.0, 1.0])

    def _one(self, observed: View, rendered: View) -> PairPrediction:
        right = super()._one(observed, rendered)
        target = Pose.rotation(observed.R_view_cam) @ self.truth @ self.model.T_obj_ctr
        mask = RENDERER.render(self.model, [target @ self.model.T_ctr_obj], rendered.camera)[0].mask
        assert mask is not None and right.correspondences is not None and rendered.coords is not None
        share = cv2.resize(mask.astype(np.float32), (40, 30), interpolation=cv2.INTER_AREA)
        found, wrong = right.correspondences, Pose(so3_exp(self.turn) @ target.R, target.t)
        points = rendered.coords[found.source[:, 1], found.source[:, 0]] - self.model.center
        moved = dataclasses.replace(found, target=rendered.camera.project(wrong.apply(points)))
        return PairPrediction(right.delta, 0.01, moved, np.stack([share, share]))


def test_the_outline_mends_what_correspondences_get_wrong(renderer) -> None:
    model = bracket()
    truth = Pose(view_rotation([0.5, -1.0, 0.6]), PLACES[0]) @ model.T_ctr_obj
    rng = np.random.default_rng(0)
    view = photograph(renderer, model, truth)
    noise = rng.integers(150, 200, view.image.shape).astype(np.uint8)
    view = View(np.where(view.mask[..., None], view.image, noise), CAMERA)
    turns = []
    for outline in (False, True):
        options = RefineOptions(stop="fixed", iterations=4, colour_edge=outline)
        turns.append(
            errors(refine(view, model, [truth], Biased(model, truth), renderer, options)[0].T_cam_obj, truth)[0]
        )
    assert turns[0] > 3 and turns[1] < 0.5 * turns[0]


def test_the_predicted_angle_stops_the_loop(renderer) -> None:
    model = bracket()
    truth = Pose(view_rotation([0.5, -1.0, 0.6]), PLACES[0]) @ model.T_ctr_obj
    start = Pose(so3_exp([0, 0, 0.3]) @ truth.R, truth.t)
    found = refine(photograph(renderer, model, truth), model, [start, truth], Oracle(model, truth), renderer)
    assert [f.iterations for f in found] == [2, 1] and all(f.converged for f in found)
    assert found[0].angle < np.deg2rad(2)


def test_a_small_angle_beside_a_large_correction_is_no_convergence(renderer) -> None:
    model = bracket()
    truth = Pose(view_rotation([0.5, -1.0, 0.6]), PLACES[0]) @ model.T_ctr_obj
    start = Pose(so3_exp([0, 0, 0.3]) @ truth.R, truth.t)
    view, oracle = photograph(renderer, model, truth), Oracle(model, truth, angles=[0.01])
    found = refine(view, model, [start], oracle, renderer)[0]
    assert found.iterations == 2 and found.trace[0].angle == pytest.approx(0.3, abs=0.01)
    found = refine(view, model, [start], oracle, renderer, RefineOptions(update="regression"))[0]
    assert found.iterations == 1, "the regressed update has the angle head alone"


class Wandering(Oracle):
    """Sees the object turned by 3 degrees about the view, to one side and then to the other."""

    def predict(self, observed: Sequence[View], rendered: Sequence[View]) -> list[PairPrediction]:
        turn = Pose.rotation(so3_exp([0.0, 0.0, np.deg2rad(3.0 if self.calls % 2 else -3.0)]))
        self.truth = turn @ self.truth
        return super().predict(observed, rendered)


def test_a_pose_at_rest_ends_the_loop(renderer) -> None:
    model = bracket()
    truth = Pose(view_rotation([0.5, -1.0, 0.6]), PLACES[0]) @ model.T_ctr_obj
    start = Pose(so3_exp([0, 0, 0.3]) @ truth.R, truth.t)
    oracle = Oracle(model, truth, angles=[0.5, 0.5])
    found = refine(photograph(renderer, model, truth), model, [start], oracle, renderer)[0]
    assert found.iterations == 2 and not found.converged and errors(found.T_cam_obj, truth)[0] < 0.1


def test_without_convergence_the_lowest_predicted_angle_wins(renderer) -> None:
    model = bracket()
    truth = Pose(view_rotation([0.5, -1.0, 0.6]), PLACES[0]) @ model.T_ctr_obj
    oracle = Wandering(model, truth, angles=[0.5, 0.2, 0.4, 0.3])
    options = RefineOptions(iterations=4, last_update=False)
    found = refine(photograph(renderer, model, truth), model, [truth], oracle, renderer, options)[0]
    assert not found.converged and found.iterations == 4 and oracle.calls == 4
    assert found.angle == 0.2 and found.T_cam_obj is found.trace[1].T_cam_obj


def test_patience_ends_a_loop_that_no_longer_improves(renderer) -> None:
    model = bracket()
    truth = Pose(view_rotation([0.5, -1.0, 0.6]), PLACES[0]) @ model.T_ctr_obj
    oracle = Wandering(model, truth, angles=[0.5, 0.2, 0.4, 0.3, 0.1, 0.3, 0.3, 0.3, 0.01])
    options = RefineOptions(patience=3)
    found = refine(photograph(renderer, model, truth), model, [truth], oracle, renderer, options)[0]
    assert found.iterations == 8 and not found.converged and found.angle == 0.1


@pytest.mark.parametrize(("stop", "later_angle", "converged", "wins"), [
    ("angle", 0.5, False, "first"), ("angle", 0.1, False, "later"), ("angle", 0.5, True, "later"),
    ("fixed", 0.5, False, "later"),
])  # fmt: skip
def test_what_went_on_does_not_forget_a_better_pose(stop: str, later_angle: float, converged: bool, wins: str) -> None:
    """The lowest predicted angle wins over all rounds."""
    steps = [Step(Pose.translation([0.0, 0.0, float(k)]), 1.0) for k in range(3)]
    first = Refinement(Pose.translation([1.0, 0, 0]), 0.2, 1, False, tuple(steps[:1]))
    later = Refinement(Pose.translation([2.0, 0, 0]), later_angle, 2, converged, tuple(steps[1:]))
    found = first.then(later, stop)
    best = first if wins == "first" else later
    assert found.T_cam_obj is best.T_cam_obj and found.angle == best.angle and found.converged == best.converged
    assert found.iterations == 3 and found.trace == tuple(steps)


def test_the_fixed_policy_takes_the_last_iterate(renderer) -> None:
    model = bracket()
    truth = Pose(view_rotation([0.5, -1.0, 0.6]), PLACES[0]) @ model.T_ctr_obj
    oracle = Oracle(model, truth, angles=[0.001, 0.2, 0.4])
    options = RefineOptions(stop="fixed", iterations=3)
    found = refine(photograph(renderer, model, truth), model, [truth], oracle, renderer, options)[0]
    assert found.iterations == 3 and not found.converged and found.angle == 0.4


def test_an_update_that_the_predictor_cannot_give_is_refused(renderer) -> None:
    model = bracket()
    truth = Pose(view_rotation([0.5, -1.0, 0.6]), PLACES[0]) @ model.T_ctr_obj
    oracle = Oracle(model, truth)
    oracle.dense = False
    with pytest.raises(ConfigError, match="the update is regression"):
        refine(photograph(renderer, model, truth), model, [truth], oracle, renderer)


def test_options_are_checked() -> None:
    with pytest.raises(ConfigError, match="regression"):
        RefineOptions(update="magic")
    with pytest.raises(ConfigError, match="at least 1"):
        RefineOptions(iterations=0)
    with pytest.raises(ConfigError, match="between 0 and 180"):
        RefineOptions(stop_angle=4.0)


def test_a_side_of_the_picture_does_not_bias_the_rotation(renderer) -> None:
    """The same object, turned with its viewing ray, must give the same crop wherever it is in the photograph; an axis-
    parallel crop would show another side of it. The pose found there must be the true egocentric one."""
    model = bracket()
    centred = Pose(view_rotation([0.5, -1.0, 0.6]), [0.0, 0.0, 0.8])
    crops = []
    for ray in ([0.0, 0.0, 1.0], [0.45, -0.3, 1.0]):
        turn = rotation_between([0.0, 0.0, 1.0], ray)
        truth = Pose.rotation(turn) @ centred @ model.T_ctr_obj
        oracle = Recorder(model, truth)
        view = photograph(renderer, model, truth)
        found = refine(view, model, [truth], oracle, renderer, RefineOptions(stop="fixed", iterations=1))[0]
        assert errors(found.T_cam_obj, truth)[0] < 0.02
        crops.append(oracle)
    assert _overlap(crops[0].rendered.mask, crops[1].rendered.mask) > 0.995
    assert _overlap(crops[0].observed.mask, crops[1].observed.mask) > 0.95
    np.testing.assert_allclose(crops[0].rendered.camera.fx, crops[1].rendered.camera.fx, rtol=1e-6)


class Recorder(Oracle):
    observed: View
    rendered: View

    def predict(self, observed: Sequence[View], rendered: Sequence[View]) -> list[PairPrediction]:
        self.observed, self.rendered = observed[0], rendered[0]
        return super().predict(observed, rendered)


def _overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_delta_round_trip() -> None:
    rng = np.random.default_rng(0)
    for scale in (1e-7, 1e-3, 1.0):
        for _ in range(20):
            a = Pose(so3_exp(rng.normal(size=3)), rng.normal(size=3) * 0.1 + [0, 0, 1])
            b = Pose(so3_exp(scale * rng.normal(size=3)) @ a.R, a.t * np.exp(0.1 * scale * rng.normal(size=3)))
            again = apply_delta(a, delta_between(a, b, 700.0), 700.0)
            np.testing.assert_allclose(again.matrix, b.matrix, atol=1e-12)


def test_delta_is_deepims() -> None:
    """Numbers by hand: a move to the right by 0.1 at depth 1, f = 100 px; half the depth is ln 2 nearer."""
    a, b = Pose(np.eye(3), [0, 0, 1]), Pose(np.eye(3), [0.05, 0, 0.5])
    delta = delta_between(a, b, 100.0)
    np.testing.assert_allclose(delta.v, [10.0, 0.0, np.log(2)])
    turned = apply_delta(a, PoseDelta(so3_exp([0, 0, np.pi / 2]), np.zeros(3)), 100.0)
    np.testing.assert_allclose(turned.R @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def pnp_case(seed: int, noise_px: float, wrong: float):  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(seed)
    camera = Camera(900, 900, 79.5, 59.5, 160, 120)
    points = rng.uniform(-0.06, 0.06, size=(300, 3))
    truth = Pose(so3_exp(rng.normal(size=3)), [0.0, 0.0, 0.9])
    start = PoseNoise(10.0).disturb(truth, rng)
    pixels = camera.project(truth.apply(points)) + rng.normal(size=(300, 2)) * noise_px
    bad = rng.random(300) < wrong
    pixels[bad] += rng.uniform(-30, 30, size=(int(bad.sum()), 2))
    return camera, points, pixels, truth, start


def test_pnp_is_exact_on_exact_correspondences() -> None:
    camera, points, pixels, truth, start = pnp_case(0, 0.0, 0.0)
    found = solve_pnp(points, pixels, np.ones(300), np.ones(300), camera, start)
    assert found is not None
    np.testing.assert_allclose(found.matrix, truth.matrix, atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_pnp_survives_outliers(seed: int) -> None:
    camera, points, pixels, truth, start = pnp_case(seed, 0.5, 0.3)
    found = solve_pnp(points, pixels, np.ones(300), np.full(300, 0.5), camera, start)
    assert found is not None
    turn, shift = errors(found, truth)
    assert turn < 0.6 and shift < 0.006


def test_pnp_refuses_too_little() -> None:
    camera, points, pixels, _, start = pnp_case(0, 0.0, 0.0)
    assert solve_pnp(points[:5], pixels[:5], np.ones(5), np.ones(5), camera, start) is None
    assert solve_pnp(points, pixels, np.zeros(300), np.ones(300), camera, start) is None

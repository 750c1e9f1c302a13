"""The whole chain with the shipped weights, on pictures made on the spot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from posekit.camera import Camera
from posekit.errors import ConfigError, WeightsError
from posekit.estimate.estimator import EstimateOptions, PoseEstimator, existence_score, hypothesis_score
from posekit.estimate.refine import pose_change
from posekit.first_pose.hypotheses import perturbed_poses
from posekit.geometry import Pose, PoseNoise
from posekit.metrics import pose_error
from posekit.nets.weights import build, save_networks
from posekit.render import Renderer
from posekit.results import Detection, Source
from posekit.synth.example import make_example
from posekit.synth.tabletop import procedural_objects
from posekit.view import View


@pytest.fixture(scope="module")
def examples():  # type: ignore[no-untyped-def]
    renderer = Renderer()
    return [make_example(renderer, seed) for seed in range(3)]


def masked(renderer: Renderer, example) -> Detection:  # type: ignore[no-untyped-def]
    [seen] = renderer.render(example.model, [example.T_cam_obj], example.view.camera, rgb=False, coords=False)
    return Detection(example.box, seen.mask, 1.0, example.model.name, Source.MASK)


def test_refinement_brings_disturbed_poses_nearer(examples) -> None:
    """DeepIM's disturbance; the network has never seen this object."""
    estimator = PoseEstimator(examples[0].model, options=EstimateOptions(iterations=6))
    rng = np.random.default_rng(0)
    before, after = [], []
    for example in examples * 2:
        start = PoseNoise().disturb(example.T_cam_obj @ example.model.T_obj_ctr, rng)
        start = start @ example.model.T_ctr_obj
        view = example.view.with_mask(masked(estimator.renderer, example).mask)
        found = estimator.refine(view, start)
        assert 1 <= found.iterations <= 6 and len(found.trace) == found.iterations
        before.append(pose_error(start, example.T_cam_obj)[0])
        after.append(pose_error(found.T_cam_obj, example.T_cam_obj)[0])
    assert np.median(after) < 0.5 * np.median(before)


def test_the_whole_chain_from_a_mask(examples) -> None:
    options = EstimateOptions(iterations=6, hypotheses=3)
    estimator = PoseEstimator(examples[0].model, options=options)
    turns, shifts = [], []
    for example in examples:
        [found] = estimator.estimate(example.view, [masked(estimator.renderer, example)])
        turn, shift = pose_error(found.T_cam_obj, example.T_cam_obj)
        turns.append(float(np.rad2deg(turn)))
        shifts.append(float(shift))
        assert 0 <= found.score <= 1 and set(found.timings) == {"first_pose", "refine", "total"}
        assert found.detection is not None and found.detection.source == "mask"
    assert np.median(turns) < 10 and np.median(shifts) < 0.05


def test_only_the_best_hypotheses_go_on(examples) -> None:
    """All are refined a little, two to the end; a fixed number of iterations stays what was asked for. The last look is
    the score's."""
    options = EstimateOptions(stop="fixed", iterations=5, hypotheses=4)
    estimator = PoseEstimator(examples[0].model, options=options)
    compared = []
    predict = estimator.predictor.predict
    estimator.predictor.predict = lambda seen, drawn: compared.append(len(seen)) or predict(seen, drawn)  # type: ignore
    [found] = estimator.estimate(examples[0].view, [masked(estimator.renderer, examples[0])])
    assert compared == [4, 4, 4, 2, 2, 1] and found.iterations == 5 and len(found.trace) == 5


def test_nothing_detected_is_an_empty_list(examples) -> None:
    estimator = PoseEstimator(examples[0].model)
    assert estimator.estimate(examples[0].view, []) == []


def test_the_paper_preset_runs_the_whole_chain(examples, tmp_path: Path) -> None:
    """Full size, untrained: the same loops, MV-Net's first pose, the regression update."""
    save_networks(tmp_path / "paper", build("paper"), {"trained_on": "nothing"})
    options = EstimateOptions(init="mvnet", update="regression", stop="fixed", iterations=1)
    estimator = PoseEstimator(examples[0].model, preset="paper", weights=tmp_path, options=options)
    found = estimator.estimate(examples[0].view, [masked(estimator.renderer, examples[0])])
    assert len(found) <= 1 and estimator.predictor.size == (640, 480)
    assert all(np.isfinite(f.T_cam_obj.matrix).all() and f.iterations == 1 for f in found)


def test_what_is_not_there_is_said(examples, tmp_path: Path) -> None:
    model = examples[0].model
    with pytest.raises(WeightsError, match="ships no trained weights for preset 'paper'"):
        PoseEstimator(model, preset="paper")
    save_networks(tmp_path / "paper", build("paper"), {})
    options = EstimateOptions(iterations=1, update="correspondence")
    estimator = PoseEstimator(model, preset="paper", weights=tmp_path, options=options)
    with pytest.raises(ConfigError, match="--update regression"):
        estimator.refine(View(examples[0].view.image, examples[0].view.camera), examples[0].T_cam_obj)
    with pytest.raises(ConfigError, match="at least 1 hypothesis"):
        EstimateOptions(hypotheses=0)
    with pytest.raises(ConfigError, match="init is one of"):
        EstimateOptions(init="guess")


def test_a_pose_outside_the_picture_does_not_break_the_loop(examples) -> None:
    example = examples[0]
    estimator = PoseEstimator(example.model, options=EstimateOptions(iterations=2))
    away = Pose(example.T_cam_obj.R, example.T_cam_obj.t + [3.0, 0, 0])
    found = estimator.refine(example.view, away)
    assert np.isfinite(found.T_cam_obj.matrix).all()
    assert isinstance(found.box, tuple) and isinstance(example.view.camera, Camera)


def test_poses_beside_a_known_one_compete_with_it(examples) -> None:
    example = examples[0]
    around = perturbed_poses(example.T_cam_obj, example.model, np.deg2rad(12))
    centre = example.model.center
    for pose in around:
        turn, _ = pose_change(pose, example.T_cam_obj)
        assert np.isclose(np.rad2deg(turn), 12)
        np.testing.assert_allclose(pose.apply(centre), example.T_cam_obj.apply(centre), atol=1e-9)
    assert len({tuple(np.round(pose.R.ravel(), 6)) for pose in around}) == 4


@pytest.mark.parametrize(("stop_angle", "beside", "tried"), [(0.01, True, [1, 4]), (180, True, [1]), (0.01, False, [])])
def test_poses_beside_are_tried_where_the_given_one_does_not_converge(
    stop_angle: float, beside: bool, tried: list[int], examples, monkeypatch: pytest.MonkeyPatch
) -> None:  # type: ignore[no-untyped-def]
    example, starts = examples[0], []
    options = EstimateOptions(iterations=4, stop_angle_deg=stop_angle, perturb=beside)
    estimator = PoseEstimator(example.model, options=options)
    heats = estimator._candidates
    monkeypatch.setattr(estimator, "_candidates", lambda view, poses: starts.append(len(poses)) or heats(view, poses))
    found = estimator.refine(example.view, perturbed_poses(example.T_cam_obj, example.model, np.deg2rad(20))[0])
    assert starts == tried
    assert found.iterations == (1 if stop_angle == 180 else 4)


def test_an_exact_mask_finishes_the_pose(examples) -> None:
    """With the outline nearer than without, and a rough mask leaves the network's pose."""
    example = examples[0]
    there, networks = (
        PoseEstimator(example.model, options=EstimateOptions(iterations=1, mask_edge=contour))
        for contour in (True, False)
    )
    mask = masked(there.renderer, example).mask
    assert mask is not None
    view, start = example.view.with_mask(mask), perturbed_poses(example.T_cam_obj, example.model, np.deg2rad(12))[0]
    with_it, without = there.refine(view, start), networks.refine(view, start)
    assert with_it.iterations == without.iterations
    turns = [pose_change(found.T_cam_obj, example.T_cam_obj)[0] for found in (with_it, without)]
    assert turns[0] < turns[1] and np.rad2deg(turns[0]) < 1.5, np.rad2deg(turns)
    assert (
        with_it.mask_edge_std is not None
        and 0 < with_it.mask_edge_std < np.deg2rad(4)
        and without.mask_edge_std is None
    )
    box = np.zeros_like(mask)
    x0, y0, x1, y1 = (int(edge) for edge in example.box)
    box[y0:y1, x0:x1] = True
    rough = example.view.with_mask(box)
    left, right = (estimator.refine(rough, start).T_cam_obj for estimator in (there, networks))
    np.testing.assert_array_equal(left.matrix, right.matrix)


def test_the_score_prefers_small_angles_evidence_and_likeness() -> None:
    assert hypothesis_score(0.5, 1.2, 0.5) < hypothesis_score(0.02, 1.2, 0.5)
    assert hypothesis_score(0.02, 0.8, 0.5) < hypothesis_score(0.02, 1.2, 0.5)
    assert hypothesis_score(0.02, 1.2, 0.4) < hypothesis_score(0.02, 1.2, 0.5)


def test_what_is_not_there_is_doubted(examples) -> None:
    """One photograph, two meshes: the one that it shows, and another one taken for it."""
    example = examples[0]
    [other] = procedural_objects(1, np.random.default_rng(5), unit=example.model.diameter)
    detection = masked(PoseEstimator(example.model).renderer, example)
    [shown], [absent] = (PoseEstimator(m).estimate(example.view, [detection]) for m in (example.model, other))
    assert shown.score > 0.8 > 0.4 > absent.score
    [again] = PoseEstimator(other).estimate(example.view, [detection], 1.0)
    assert again.score < 0.5 and again.iterations == 3 and not again.converged, "not refined to the end"
    usual = existence_score(0.6, 2.0, 0.05)
    assert 0 < existence_score(0.5, 2.0, 0.05) < usual < 1, "less alike"
    assert existence_score(0.6, 4.0, 0.05) < usual, "less exact"
    assert existence_score(0.6, 2.0, 0.1) < usual, "further off"
    assert existence_score(0.6, 2.0, 0.0) == existence_score(0.6, 2.0, 1e-3), "no angle is too small"
    assert existence_score(0.4, 2.0, 0.05, coloured=False) > existence_score(0.4, 2.0, 0.05), "colours look unlike"


def test_first_poses_come_from_both_masks(examples) -> None:
    example = examples[0]
    estimator = PoseEstimator(example.model, options=EstimateOptions(hypotheses=2))
    mask = masked(estimator.renderer, example).mask
    assert mask is not None
    rough = np.zeros_like(mask)
    x0, y0, x1, y1 = (int(edge) for edge in example.box)
    rough[y0:y1, x0:x1] = True
    alone = [estimator.first_poses(example.view, Detection(example.box, m)) for m in (mask, rough)]
    both = estimator.first_poses(example.view, Detection(example.box, mask, rough=rough))
    assert len(both) == 4
    for found, wanted in zip(both[2:], alone[1], strict=True):
        assert found.score == pytest.approx(wanted.score, abs=0.02)
    assert both[0].score > both[2].score

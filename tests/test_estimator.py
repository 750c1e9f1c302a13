"""PoseEstimator with an oracle, or with weights that nobody trained: what it does with what a network says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from bop_scene import brick
from objects import CAMERA, bracket
from posekit.estimate.estimator import EstimateOptions, PoseEstimator
from posekit.first_pose.hypotheses import BoxSearch, TemplateSearch
from posekit.geometry import Pose, rotation_angle, so3_exp, view_rotation
from posekit.mesh.model import ObjectModel
from posekit.mesh.symmetries import Symmetries
from posekit.metrics import pose_error
from posekit.nets.config import PaperConfig
from posekit.nets.paper import PaperSVNet
from posekit.nets.weights import Networks, build, save_networks
from posekit.render import Renderer
from posekit.results import Branch, Detection, Estimate, Source
from posekit.tracking.tracker import LOST, TRACKED, TrackConfig, Tracker
from posekit.view import View
from test_refine import Oracle


@pytest.fixture(scope="module")
def networks() -> Networks:
    return build("lite")


def photograph(model: ObjectModel, pose: Pose) -> View:
    [drawn] = Renderer().render(model, [pose], CAMERA)
    image = np.random.default_rng(1).integers(90, 160, (480, 640, 3)).astype(np.uint8)
    assert drawn.mask is not None
    return View(np.where(drawn.mask[..., None], drawn.image, image).astype(np.uint8), CAMERA, drawn.mask)


def half_turned(text: str = "z:2") -> ObjectModel:
    model = brick()
    return replace(model, symmetries=Symmetries.parse(text, model.center))


TRUTH = Pose(view_rotation([0.5, -1.0, 0.6]), np.array([0.02, 0.01, 0.5]))


def oracle(model: ObjectModel, truth: Pose, networks: Networks, **options: object) -> PoseEstimator:
    estimator = PoseEstimator(model, networks=networks, options=EstimateOptions(**options))  # type: ignore[arg-type]
    estimator.predictor = Oracle(model, truth)  # type: ignore[assignment]
    return estimator


def test_nothing_global_is_set(networks: Networks) -> None:
    threads, state = torch.get_num_threads(), torch.get_rng_state()
    PoseEstimator(bracket(), networks=networks)
    assert torch.get_num_threads() == threads
    np.testing.assert_array_equal(torch.get_rng_state(), state)


def test_the_angle_is_that_of_the_pose_which_is_told(networks: Networks) -> None:
    """Not of one before the last update, or before the outline was fitted."""
    model = bracket()
    start = Pose(so3_exp([0.0, 0.0, 0.3]) @ TRUTH.R, TRUTH.t)
    estimator = oracle(model, TRUTH, networks, stop="fixed", iterations=1, mask_edge=False, colour_edge=False)
    found = estimator.refine(photograph(model, TRUTH).with_mask(None), start)
    assert found.trace[0].angle == pytest.approx(0.3, abs=0.01)
    assert found.angle < 0.01 and found.converged and found.mask_edge_std is None
    far = oracle(model, TRUTH, networks, stop="fixed", iterations=1, mask_edge=False, colour_edge=False)
    far.predictor = Oracle(model, TRUTH, angles=[0.4])  # type: ignore[assignment]
    doubted = far.refine(photograph(model, TRUTH).with_mask(None), start)
    assert doubted.angle == pytest.approx(0.4) and not doubted.converged
    masked = oracle(model, TRUTH, networks, stop="fixed", iterations=1).refine(photograph(model, TRUTH), start)
    assert masked.mask_edge_std is not None and masked.mask_edge_std > 0
    assert masked.converged == (masked.mask_edge_std < np.deg2rad(2)) and masked.angle != masked.mask_edge_std


def test_the_paper_preset_needs_no_option(tmp_path: Path) -> None:
    save_networks(tmp_path / "paper", build("paper", PaperConfig((128, 128), 0.125)), {})
    model = bracket()
    estimator = PoseEstimator(model, preset="paper", weights=tmp_path, options=EstimateOptions(iterations=1))
    assert isinstance(estimator.networks.svnet, PaperSVNet) and estimator.refine_options.update == "regression"
    assert estimator.refine(photograph(model, TRUTH), TRUTH).iterations == 1
    assert PoseEstimator(model, networks=build("lite")).refine_options.update == "correspondence"


# --- symmetries ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["z:2", "z:4", "x:2,y:2", "z:inf", "z:inf,x:2", "x:inf,y:inf"])
def test_the_nearest_equivalent_pose(text: str) -> None:
    symmetries, rng = Symmetries.parse(text, [0.01, 0.02, 0.03]), np.random.default_rng(0)
    for _ in range(5):
        pose, reference = (Pose(so3_exp(rng.normal(size=3)), rng.normal(size=3)) for _ in range(2))
        found = symmetries.nearest(pose, reference)
        angle = rotation_angle(found.R @ reference.R.T)
        others = [rotation_angle((pose @ S).R @ reference.R.T) for S in symmetries.transforms(360)]
        fine = 0.2 if text == "x:inf,y:inf" else 1e-9  # several axes are as fine as their steps
        assert angle <= min(others) + fine
        np.testing.assert_allclose(found.apply([0.01, 0.02, 0.03]), pose.apply([0.01, 0.02, 0.03]), atol=1e-12)
        if text != "x:inf,y:inf":
            again = min(float(rotation_angle((pose @ S).R @ found.R.T)) for S in symmetries.transforms(3600))
            assert again < 2e-3, "it looks the same"
    assert symmetries and not Symmetries.none()
    assert Symmetries.none().nearest(pose, reference) is pose


@pytest.mark.parametrize("search", [BoxSearch, TemplateSearch])
def test_equivalent_hypotheses_count_once(search: type) -> None:
    model = half_turned("x:2,y:2")
    view = photograph(model, TRUTH)
    rows, columns = np.nonzero(view.mask)
    box = (float(columns.min()), float(rows.min()), float(columns.max() + 1), float(rows.max() + 1))
    found = search(model, Renderer()).search(view, Detection(box, view.mask, 1.0, model.name, Source.MASK), 6)
    assert len(found) == 6
    for k, one in enumerate(found):
        for other in found[:k]:
            assert pose_error(one.T_cam_obj, other.T_cam_obj, model.symmetries.transforms())[0] > np.deg2rad(20)


def test_refine_returns_the_pose_nearest_to_the_given_one(networks: Networks) -> None:
    model = half_turned()
    [S] = model.symmetries.discrete
    start = Pose(so3_exp([0.05, 0.1, 0.0]) @ TRUTH.R, TRUTH.t)
    estimator = oracle(model, TRUTH @ S, networks, update="regression", stop="fixed", iterations=1, mask_edge=False,
                       colour_edge=False)  # fmt: skip
    found = estimator.refine(photograph(model, TRUTH), start)
    assert found.branch is Branch.GIVEN
    assert pose_error(found.T_cam_obj, TRUTH)[0] < 0.02
    plain = oracle(brick(), TRUTH, networks, stop="fixed", iterations=1).refine(photograph(model, TRUTH), start)
    assert plain.branch is None


def test_a_tracked_pose_stays_on_its_branch() -> None:
    """A symmetric object that was lost and is found again is told as it stood."""
    model, renderer = half_turned(), Renderer()
    [S] = model.symmetries.discrete

    class Finding:
        def __init__(self) -> None:
            self.model, self.renderer = model, renderer

        def estimate(self, view: View, detections: list[Detection], min_score: float = 0.0) -> list[Estimate]:
            return [Estimate(TRUTH @ S, 0.1, 3, True, 0.9, d.box, model.name, d) for d in detections]

        def detect(self, view: View, models: list[ObjectModel]) -> list[Detection]:
            return [Detection((10.0, 10.0, 50.0, 50.0), None, 1.0, model.name, Source.TRAINED)]

    tracker = Tracker(model, CAMERA, pose=TRUTH, estimator=Finding(), detector=Finding(),  # type: ignore[arg-type]
                      predictor=Oracle(model, TRUTH), config=TrackConfig(search=1))  # fmt: skip
    shown, empty = (
        photograph(model, TRUTH).image,
        np.random.default_rng(2).integers(0, 60, (480, 640, 3)).astype(np.uint8),
    )
    first = tracker.step(shown)
    assert first.estimate is not None and first.estimate.branch is Branch.GIVEN
    assert first.estimate.converged and first.estimate.angle < 0.02, "as the network says"
    second = tracker.step(shown)
    assert second.estimate is not None and second.estimate.branch is Branch.LAST
    tracker._reset()
    tracker.detector = None
    assert tracker.step(empty).state == LOST
    tracker.detector = Finding()  # type: ignore[assignment]
    found = tracker.step(shown)
    assert found.state == TRACKED and found.T_cam_obj is not None and found.estimate is not None
    assert found.estimate.branch is Branch.LAST and pose_error(found.T_cam_obj, TRUTH)[0] < 0.02


def test_a_frame_in_doubt_has_not_converged() -> None:
    model, renderer = bracket(), Renderer()
    tracker = Tracker(model, CAMERA, pose=TRUTH, predictor=Oracle(model, TRUTH, angles=[0.2]),
                      estimator=PoseEstimator(model, networks=build("lite")))  # fmt: skip
    assert renderer is not None
    for _ in range(2):
        found = tracker.step(photograph(model, TRUTH).image)
        assert found.estimate is not None and found.estimate.angle == 0.2 and not found.estimate.converged


# --- a quick look at many proposals ----------------------------------------------------------------------------------


def test_of_many_proposals_the_network_compares_those_that_similarity_and_evidence_speak_for(
    networks: Networks, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("posekit.estimate.estimator.COMPARED", 3)
    model = bracket()
    view = photograph(model, TRUTH)
    rows, columns = np.nonzero(view.mask)
    right = (float(columns.min()), float(rows.min()), float(columns.max() + 1), float(rows.max() + 1))
    elsewhere = [(20.0 + 90 * k, 20.0, 80.0 + 90 * k, 90.0) for k in range(4)]
    estimator = oracle(model, TRUTH, networks)

    def screened(*similarities: float) -> list[float]:
        boxes = [*elsewhere, right]
        proposals = zip(boxes, similarities, strict=True)
        return estimator.screen(view, [Detection(box, None, s, model.name, Source.NOVEL) for box, s in proposals])

    scores = screened(0.5, 0.5, 0.5, 0.1, 0.5)
    assert np.isfinite(scores).sum() == 3 and np.isfinite(scores[4]) and scores[3] == -np.inf
    assert np.argmax(scores) == 4
    assert screened(0.9, 0.9, 0.9, 0.1, 0.0)[4] == -np.inf, "too unlike the mesh"
    assert estimator.screen(view, []) == []

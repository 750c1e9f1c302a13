"""Outlines laid onto masks: exact ones, grown ones, rough ones, hidden ones."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from objects import bracket
from posekit.align.mask_edge import fit_mask_edge
from posekit.camera import Camera
from posekit.estimate.refine import pose_change
from posekit.geometry import Pose, PoseNoise, random_rotation
from posekit.mesh.model import ObjectModel
from posekit.render import Renderer
from posekit.view import View

CAMERA = Camera.from_fov(1.0, 640, 480)
NOISE = PoseNoise(3.0, 9.0, (0.002, 0.002, 0.006))


@pytest.fixture(scope="module")
def model() -> ObjectModel:
    return bracket()


def cases(model: ObjectModel, renderer: Renderer, count: int = 6) -> list[tuple[View, Pose, Pose]]:
    """Views with exact masks, the truth, and a pose near it."""
    rng = np.random.default_rng(2)
    found = []
    for _ in range(count):
        truth = Pose(random_rotation(rng), np.array([*rng.uniform(-0.05, 0.05, 2), 6 * model.diameter]))
        [drawn] = renderer.render(model, [truth], CAMERA, coords=False)
        near = NOISE.disturb(truth @ model.T_obj_ctr, rng) @ model.T_ctr_obj
        found.append((drawn, truth, near))
    return found


def rough(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """An outline that strays by some pixels."""
    rng = np.random.default_rng(4)
    waves = cv2.GaussianBlur(rng.normal(size=mask.shape), (0, 0), 4)
    inside = mask.astype(np.uint8)
    distance = cv2.distanceTransform(inside, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)
    return np.asarray(distance + 4 * waves / waves.std() > 0)


def test_an_exact_mask_gives_the_pose(model: ObjectModel, renderer: Renderer) -> None:
    before, after = [], []
    for view, truth, near in cases(model, renderer):
        fit = fit_mask_edge(view, model, near, renderer)
        assert fit is not None and fit.exact and fit.covered > 0.95 and 0 < fit.turn_std < np.deg2rad(3)
        before.append(pose_change(near, truth))
        after.append(pose_change(fit.T_cam_obj, truth))
    turns, shifts = np.array(after).T
    assert np.rad2deg(turns).max() < 1.5 and np.rad2deg(np.median(turns)) < 0.5
    assert np.median(shifts) < 0.4 * np.median(np.array(before)[:, 1])


def test_a_mask_may_be_too_large_all_round(model: ObjectModel, renderer: Renderer) -> None:
    turns, depths = [], []
    for view, truth, near in cases(model, renderer):
        assert view.mask is not None
        grown = cv2.dilate(view.mask.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))) > 0
        fit = fit_mask_edge(view.with_mask(grown), model, near, renderer)
        assert fit is not None
        turns.append(pose_change(fit.T_cam_obj, truth)[0])
        depths.append(abs(fit.T_cam_obj.t[2] / truth.t[2] - 1))
    assert np.rad2deg(np.median(turns)) < 1.5 and np.median(depths) < 0.02


def test_a_part_may_be_hidden(model: ObjectModel, renderer: Renderer) -> None:
    turns = []
    for view, truth, near in cases(model, renderer):
        assert view.mask is not None
        columns = np.flatnonzero(view.mask.any(0))
        seen = view.mask.copy()
        seen[:, : int(np.quantile(columns, 0.25))] = False
        fit = fit_mask_edge(view.with_mask(seen), model, near, renderer)
        assert fit is not None and fit.covered < 0.97
        turns.append(pose_change(fit.T_cam_obj, truth)[0])
    assert np.rad2deg(np.median(turns)) < 1.0


def test_a_rough_mask_is_known_as_such(model: ObjectModel, renderer: Renderer) -> None:
    for view, _, near in cases(model, renderer):
        assert view.mask is not None
        fit = fit_mask_edge(view.with_mask(rough(view.mask)), model, near, renderer)
        assert fit is None or not fit.exact


def test_what_cannot_be_fitted(model: ObjectModel, renderer: Renderer) -> None:
    view, truth, _ = cases(model, renderer, 1)[0]
    assert fit_mask_edge(view.with_mask(np.zeros((480, 640), bool)), model, truth, renderer) is None
    aside = Pose(truth.R, truth.t + [5.0, 0, 0])
    assert fit_mask_edge(view, model, aside, renderer) is None
    with pytest.raises(ValueError, match="mask"):
        fit_mask_edge(view.with_mask(None), model, truth, renderer)

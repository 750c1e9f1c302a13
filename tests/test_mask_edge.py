"""Outlines laid onto masks: exact ones, grown ones, rough ones, hidden ones."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from objects import bracket
from posekit.align import mask_edge
from posekit.align.mask_edge import MaskEdgeConfig, _crop, _outline, _signed_distance, fit_mask_edge
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
        assert fit is not None and fit.exact and fit.covered > 0.95
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


def test_what_is_covered_lies_within_four_pixels_and_shared_within_one(model: ObjectModel, renderer: Renderer) -> None:
    config = MaskEdgeConfig(grown=1e-6)  # the mask's size is known
    counted = []
    for view, _, near in cases(model, renderer, 3):
        assert view.mask is not None
        view = view.with_mask(rough(view.mask))
        fit = fit_mask_edge(view, model, near, renderer, config)
        if fit is None:
            continue
        crop = _crop(view, model, fit.T_cam_obj @ model.T_obj_ctr, renderer, config)
        assert crop is not None
        off = np.abs(crop.distance)
        assert fit.covered == pytest.approx((off < 4).mean(), abs=0.02)
        assert fit.share == pytest.approx((off < 1).sum() / (off < 4).sum(), abs=0.02)
        counted.append(((off < 8).mean() - (off < 4).mean(), fit.share))
    assert max(further for further, _ in counted) > 0.04 and min(share for _, share in counted) < 0.9


def test_a_large_object_is_fitted(model: ObjectModel, renderer: Renderer) -> None:
    """Nearer than 1.2 diameters; its crop is coarser than the photograph, and its distances are the crop's."""
    truth = Pose(random_rotation(np.random.default_rng(3)), np.array([0.0, 0.0, 1.1 * model.diameter]))
    [view] = renderer.render(model, [truth], CAMERA, coords=False)
    assert fit_mask_edge(view, model, truth, renderer) is not None
    crop = _crop(view, model, truth @ model.T_obj_ctr, renderer, MaskEdgeConfig())
    assert crop is not None and crop.pixel == 1.0
    assert crop.camera.size == (320, 240)
    assert abs(np.median(crop.distance)) < 0.2


def test_the_pose_may_leave_the_mask_in_the_last_step(
    model: ObjectModel, renderer: Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    view, _, near = cases(model, renderer, 1)[0]
    crops = iter([_crop(view, model, near @ model.T_obj_ctr, renderer, MaskEdgeConfig()), None])
    monkeypatch.setattr(mask_edge, "_crop", lambda *_: next(crops))
    assert fit_mask_edge(view, model, near, renderer, MaskEdgeConfig(steps=1)) is None


def test_a_crop_needs_an_edge_in_the_mask_and_in_the_rendering(model: ObjectModel, renderer: Renderer) -> None:
    view, truth, _ = cases(model, renderer, 1)[0]
    assert view.mask is not None
    small = _crop(view, model, truth @ model.T_obj_ctr, renderer, MaskEdgeConfig(size=(12, 9)))
    assert small is not None and 12 <= len(small.points) < 24
    assert _crop(view, model, truth @ model.T_obj_ctr, renderer, MaskEdgeConfig(size=(6, 4))) is None
    for filled in (False, True):
        flat = view.with_mask(np.full(view.mask.shape, filled))
        assert _crop(flat, model, truth @ model.T_obj_ctr, renderer, MaskEdgeConfig()) is None


def test_an_outline_is_the_masks_pixels_beside_others() -> None:
    mask = np.random.default_rng(0).random((9, 12)) < 0.9
    wanted = np.zeros_like(mask)
    for y in range(1, 8):
        for x in range(1, 11):
            wanted[y, x] = mask[y, x] and not mask[y - 1 : y + 2, x - 1 : x + 2].all()
    assert all(wanted[edge].any() for edge in (np.s_[1], np.s_[-2], np.s_[:, 1], np.s_[:, -2]))
    assert (mask & ~wanted)[1:-1, 1:-1].any()
    np.testing.assert_array_equal(_outline(mask), wanted)


def test_distances_to_an_edge_are_half_a_pixel_beside_it() -> None:
    mask = np.zeros((7, 8), bool)
    mask[:, :3] = True
    np.testing.assert_allclose(_signed_distance(mask), np.tile(2.5 - np.arange(8), (7, 1)), atol=1e-3)

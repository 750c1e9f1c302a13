"""How alike pictures look: with made-up features in closed form, with the network on drawings."""

from __future__ import annotations

import numpy as np
import pytest

from objects import bracket
from posekit.camera import Camera
from posekit.estimate.perceptual import perceptual_similarity
from posekit.geometry import Pose, so3_exp, view_rotation
from posekit.nets.runtime import Runtime
from posekit.render import Light, Renderer
from posekit.view import View

CAMERA = Camera(128.0, 128.0, 63.5, 47.5, 128, 96)


def halves(pair: np.ndarray) -> np.ndarray:
    """Features that agree in the left half of the picture and are opposite in the right one."""
    out = np.zeros((2, 1, 12, 16), np.float32)
    out[0], out[1, :, :, :8], out[1, :, :, 8:] = 1.0, 1.0, -1.0
    assert pair.shape == (2, 3, 96, 128) and pair.dtype == np.float32 and 0 <= pair.min() <= pair.max() <= 1
    return out


def drawn(mask: np.ndarray) -> View:
    return View(np.full((96, 128, 3), 255, np.uint8), CAMERA, mask)


def test_cells_count_as_far_as_they_are_covered_and_seen() -> None:
    mask = np.zeros((96, 128), bool)
    mask[:48, 32:128] = True  # a third of it in the left half
    seen = np.zeros((24, 32), np.float32)
    seen[:, :16] = 1.0
    observed, rendered = View(np.zeros((96, 128, 3), np.uint8), CAMERA), drawn(mask)
    assert perceptual_similarity(halves, [observed], [rendered]) == pytest.approx([-1 / 3], abs=1e-4)
    assert perceptual_similarity(halves, [observed], [rendered], [seen]) == pytest.approx([1.0], abs=1e-4)
    assert perceptual_similarity(halves, [observed], [drawn(np.zeros_like(mask))]) == [0.0]
    assert perceptual_similarity(halves, [], []) == []


def test_a_right_pose_looks_more_alike_than_wrong_ones(renderer: Renderer) -> None:
    model, rng = bracket(), np.random.default_rng(2)
    truth = Pose(view_rotation([0.5, -1.0, 0.6]), [0.0, 0.0, 0.2]) @ model.T_ctr_obj
    turned = [Pose(so3_exp([0, 0, a]) @ truth.R, truth.t) for a in (0.5, 1.5, 3.0)]
    photo = renderer.render(model, [truth], CAMERA, light=Light(direction=(1.0, 0.0, -0.3)))[0]
    assert photo.mask is not None
    image = np.where(photo.mask[..., None], photo.image, rng.integers(0, 255, photo.image.shape)).astype(np.uint8)
    views = renderer.render(model, [truth, *turned], CAMERA)
    right, *wrong = perceptual_similarity(Runtime().features, [View(image, CAMERA)] * 4, views)
    assert right > 0.1 + max(wrong)

"""Boxes and masks that a person gives."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from objects import bracket
from posekit.camera import Camera, box_mask
from posekit.detect import BoxPrompt, Detector, MaskPrompt
from posekit.detect.prompts import clip_box, grabcut_mask
from posekit.detect.sharpen import sharpened
from posekit.errors import PromptError
from posekit.results import Detection
from posekit.view import View

CAMERA = Camera(500.0, 500.0, 99.5, 74.5, 200, 150)
BOX = (60.0, 40.0, 141.0, 111.0)


def scene(colour: tuple[int, int, int] = (200, 60, 40)) -> tuple[View, np.ndarray]:
    """An ellipse that fills BOX before a noisy ground, and its mask."""
    rng = np.random.default_rng(0)
    image = np.clip(rng.normal((70, 90, 110), 8, (150, 200, 3)), 0, 255).astype(np.uint8)
    mask = cv2.ellipse(np.zeros((150, 200), np.uint8), (100, 75), (40, 35), 0, 0, 360, 1, -1).astype(bool)
    image[mask] = np.clip(rng.normal(colour, 8, (mask.sum(), 3)), 0, 255).astype(np.uint8)
    return View(image, CAMERA), mask


def test_grabcut_finds_the_object_in_its_box() -> None:
    view, truth = scene()
    detector: Detector = BoxPrompt(BOX, "grabcut")
    [detection] = detector.detect(view, [bracket()])
    assert detection.source == "box+grabcut"
    assert detection.box == BOX
    assert detection.mask is not None
    assert (detection.mask & truth).sum() / (detection.mask | truth).sum() > 0.95


def test_a_box_alone_has_no_mask() -> None:
    [detection] = BoxPrompt(BOX).detect(scene()[0], [bracket()])
    assert detection.box == BOX and detection.mask is None and detection.source == "box"


def test_grabcut_gives_the_same_mask_every_time() -> None:
    view, _ = scene()
    first = grabcut_mask(view.image, BOX)
    cv2.setRNGSeed(7)
    np.testing.assert_array_equal(first, grabcut_mask(view.image, BOX))


def test_a_mask_that_cannot_be_right_is_refused() -> None:
    flat = View(np.full((150, 200, 3), 128, np.uint8), CAMERA)
    [detection] = BoxPrompt(BOX, "grabcut").detect(flat, [bracket()])
    assert detection.source == "box+filled"
    np.testing.assert_array_equal(detection.mask, box_mask(BOX, CAMERA.size))


def test_a_box_of_the_whole_picture() -> None:
    view, _ = scene()
    [detection] = BoxPrompt((0, 0, 200, 150), "grabcut").detect(view, [bracket()])
    assert detection.mask is not None
    assert detection.mask.any()


@pytest.mark.parametrize("box", [(10, 10, 11, 11), (199, 149, 200, 150), (0, 0, 1, 150), (3.4, 3.4, 5.1, 5.2)])
def test_tiny_boxes_have_a_mask(box: tuple[float, float, float, float]) -> None:
    view, _ = scene()
    [detection] = BoxPrompt(box, "grabcut").detect(view, [bracket()])
    assert detection.mask is not None
    assert detection.mask.any()


def test_a_filled_box_covers_the_edges() -> None:
    mask = box_mask((0, 0, 200, 150), CAMERA.size)
    assert mask.all()
    mask = box_mask((10, 20, 13, 22), CAMERA.size)
    assert mask.sum() == 6
    assert mask[20:22, 10:13].all()


@pytest.mark.parametrize(
    ("box", "pixels"),
    [((-5, -5, 3, 2), 6), ((198.2, 149.4, 300, 300), 2), ((50.2, 60.2, 50.4, 60.4), 1), ((-9, 0, -1, 9), 0),
     ((200, 0, 210, 9), 0)],
)  # fmt: skip
def test_a_filled_box_keeps_to_the_picture(box: tuple[float, float, float, float], pixels: int) -> None:
    assert box_mask(box, CAMERA.size).sum() == pixels


def test_filled_on_request() -> None:
    view, _ = scene()
    [detection] = BoxPrompt(BOX, mask_from="filled").detect(view, [bracket()])
    assert detection.source == "box+filled"


def test_a_box_that_reaches_outside_is_clipped() -> None:
    assert clip_box((-10, -5, 50, 400), CAMERA) == (0, 0, 50, 150)


@pytest.mark.parametrize(
    ("box", "words"),
    [
        ((50, 50, 40, 60), "inside out"),
        ((50, 50, 50, 60), "inside out"),
        ((float("nan"), 0, 10, 10), "inside out"),
        ((200, 0, 240, 50), "outside the picture, which is 200x150"),
        ((-40, 0, 0.5, 50), "outside the picture"),
    ],
)
def test_bad_boxes(box: tuple[float, float, float, float], words: str) -> None:
    with pytest.raises(PromptError, match=words):
        BoxPrompt(box).detect(scene()[0], [bracket()])


def test_unknown_mask_source() -> None:
    with pytest.raises(PromptError, match="none, grabcut, filled, not 'guess'"):
        BoxPrompt(BOX, mask_from="guess")


def test_mask_prompt() -> None:
    view, truth = scene()
    [detection] = MaskPrompt(truth).detect(view, [bracket()])
    assert (detection.box, detection.source, detection.label) == (BOX, "mask", "bracket")
    with pytest.raises(PromptError, match="100x75, the picture 200x150"):
        MaskPrompt(truth[::2, ::2]).detect(view, [bracket()])
    with pytest.raises(PromptError, match="empty"):
        MaskPrompt(np.zeros_like(truth)).detect(view, [bracket()])


# --- a network's masks ---------------------------------------------------------------------------------------------


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_a_rough_mask_is_laid_onto_the_colours() -> None:
    view, truth = scene()
    shifted = np.roll(truth, (5, -4), (0, 1))
    for rough in (shifted, cv2.erode(truth.astype(np.uint8), np.ones((11, 11))) > 0):
        found = sharpened(view.image, Detection(BOX, rough))
        assert found.mask is not None and found.rough is rough and found.box == BOX
        assert overlap(found.mask, truth) > 0.93 > 0.87 > overlap(rough, truth)
    again = sharpened(view.image, Detection(BOX, rough))
    np.testing.assert_array_equal(again.mask, found.mask)


def test_a_mask_without_an_outline_in_the_picture_stays() -> None:
    view, truth = scene()
    elsewhere = np.zeros_like(truth)
    elsewhere[45:60, 5:25] = True  # plain ground: no colours to part
    tiny = np.zeros_like(truth)
    tiny[75:77, 100:102] = True
    for detection in (Detection((100.0, 75.0, 102.0, 77.0), tiny), Detection(BOX, None)):
        assert sharpened(view.image, detection) is detection
    found = sharpened(view.image, Detection((5.0, 45.0, 25.0, 60.0), elsewhere))
    assert found.mask is not None and (found.rough is None or overlap(found.mask, elsewhere) >= 0.4)

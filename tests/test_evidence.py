"""Evidence for silhouettes in a picture, against closed forms and a picture made of what is sought."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from posekit.first_pose.evidence import CLEAR, Palette, Picture, Silhouettes, Weights, separation

SIDE = 48


def ellipse(centre: tuple[int, int], axes: tuple[int, int], angle: float = 0.0) -> np.ndarray:
    return cv2.ellipse(np.zeros((SIDE, SIDE), np.uint8), centre, axes, angle, 0, 360, 1, -1).astype(bool)


def scene() -> tuple[np.ndarray, np.ndarray]:
    """A red and green ellipse on grey ground, RGB and mask."""
    rng = np.random.default_rng(0)
    mask = ellipse((24, 22), (15, 8), 30)
    image = rng.integers(110, 130, (SIDE, SIDE, 3)).astype(np.uint8)
    image[mask] = (200, 40, 40)
    image[mask & (np.arange(SIDE) > 24)] = (40, 180, 60)
    return image, mask


def picture(image: np.ndarray, shown: np.ndarray | None = None, mask: np.ndarray | None = None) -> Picture:
    shown = np.ones(image.shape[:2], bool) if shown is None else shown
    return Picture.of(image, shown, Palette(image, shown), mask)


def test_separation_is_all_or_nothing_where_colours_tell_all_or_nothing() -> None:
    total = np.array([60, 40, 0], np.float32)
    inside = np.array([[60, 0, 0], [30, 20, 0], [0, 0, 0]], np.float32)
    np.testing.assert_allclose(separation(inside, total), [1, 0, 0], atol=1e-3)


def test_the_true_silhouette_has_the_most_evidence() -> None:
    image, mask = scene()
    others = [ellipse((24, 22), (15, 8), 60), ellipse((28, 22), (15, 8), 30), ellipse((24, 22), (11, 11))]
    masks = [mask, *others]
    drawn = Silhouettes.of(masks, [image] * 4)
    seen = picture(image)
    for weights in (Weights(1, 0, 0), Weights(0, 0, 1), Weights()):
        scores = drawn.scores(seen, weights)
        assert scores.shape == (4,) and scores.argmax() == 0
    assert drawn.scores(seen, Weights(1, 0, 0))[0] > 0.9
    assert drawn.scores(seen, Weights(0, 1, 0))[0] == pytest.approx(0.85, abs=0.1), "less than 1 by QUIET alone"
    assert 1 < drawn.crossed(seen)[0] <= CLEAR


def test_colours_agree_with_themselves_and_not_with_others() -> None:
    image, mask = scene()
    swapped = image[:, :, [1, 0, 2]]
    drawn = Silhouettes.of([mask, mask, mask], [image, swapped, np.full_like(image, 90)])
    same, other, plain = drawn.scores(picture(image), Weights(0, 1, 0))
    assert same > 0.7 and other < 0 and plain == pytest.approx(0, abs=1e-4)


def test_pixels_that_are_not_shown_say_nothing() -> None:
    image, mask = scene()
    shown = np.ones_like(mask)
    shown[:, 30:] = False
    changed = image.copy()
    changed[:, 32:] = np.random.default_rng(1).integers(0, 255, (SIDE, SIDE - 32, 3))
    drawn = Silhouettes.of([mask, ellipse((20, 30), (9, 9))], [image, image])
    np.testing.assert_allclose(drawn.scores(picture(image, shown)), drawn.scores(picture(changed, shown)), atol=1e-5)


def test_a_mask_counts_by_its_overlap() -> None:
    image, mask = scene()
    drawn = Silhouettes.of([mask, ~mask], [image, image])
    scores = drawn.scores(picture(image, mask=mask), Weights(0, 0, 0, 1))
    np.testing.assert_allclose(scores, [1, 0], atol=1e-6)


def test_a_quarter_turn_of_silhouettes_and_picture_changes_nothing() -> None:
    image, mask = scene()
    drawn = Silhouettes.of([mask, ellipse((20, 30), (9, 5))], [image, image])
    palette = Palette(image, np.ones_like(mask))
    upright, turned = (
        Picture.of(np.ascontiguousarray(i), np.ones_like(mask), palette) for i in (image, np.rot90(image, -1))
    )
    both = Silhouettes.joined([drawn, drawn.turned()])
    np.testing.assert_allclose(both.scores(upright)[:2], both.scores(turned)[2:], atol=0.02)
    np.testing.assert_array_equal(both.chosen(np.array([3, 0])).scores(turned), both.scores(turned)[[3, 0]])


def test_packed_silhouettes_are_the_same() -> None:
    image, mask = scene()
    drawn = Silhouettes.of([mask, ellipse((20, 30), (9, 5)), np.zeros_like(mask)], [image, image, image])
    again = Silhouettes.unpacked(drawn.packed(), mask.size)
    for name in ("masks", "colours", "edges", "normals", "starts"):
        np.testing.assert_array_equal(getattr(again, name), getattr(drawn, name), strict=True)


def test_turned_silhouettes_are_turned_pictures() -> None:
    image, mask = scene()
    masks = [mask, ellipse((20, 30), (9, 5))]
    turned = Silhouettes.of(masks, [image, image]).turned()
    again = Silhouettes.of([np.ascontiguousarray(np.rot90(m, -1)) for m in masks],
                           [np.ascontiguousarray(np.rot90(image, -1))] * 2)  # fmt: skip
    np.testing.assert_array_equal(turned.masks, again.masks)
    np.testing.assert_allclose(turned.colours, again.colours, atol=1)  # rounding of the mean

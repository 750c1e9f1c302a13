"""Pictures for people: right place, right colours, inputs untouched."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from posekit.camera import Camera
from posekit.geometry import Pose
from posekit.visualise import draw
from posekit.visualise.draw import WHITE

CAMERA = Camera(500.0, 500.0, 79.5, 59.5, 160, 120)


@pytest.fixture
def image() -> draw.Image:
    return np.full((120, 160, 3), 90, dtype=np.uint8)


def test_contour_follows_the_mask_and_leaves_its_inside(image: draw.Image) -> None:
    mask = np.zeros((120, 160), dtype=np.bool_)
    mask[30:90, 40:120] = True
    mask[50:70, 60:100] = False  # a hole has a contour too
    drawn = draw.contour(image, mask, (0, 255, 0))
    assert (image == 90).all()
    for row, column in [(30, 80), (89, 80), (60, 40), (60, 119), (60, 59)]:
        red, green, blue = drawn[row, column]
        assert green > 180
        assert max(red, blue) < 60
    for row, column in [(40, 50), (60, 80), (10, 10)]:
        assert tuple(drawn[row, column]) == (90, 90, 90)


def test_a_contour_is_the_masks_outermost_pixels_and_no_other(image: draw.Image) -> None:
    mask = cv2.circle(np.zeros((120, 160), np.uint8), (70, 60), 31, 1, -1) > 0
    drawn = draw.contour(image, mask, (0, 255, 0))
    green = (drawn == (0, 255, 0)).all(axis=-1)
    edge = mask & ~(cv2.erode(mask.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))) > 0)
    np.testing.assert_array_equal(green, edge)
    assert (drawn[mask & ~edge] == 90).all(), "the inside is as it was"
    rim = (cv2.dilate(mask.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))) > 0) & ~mask
    assert (drawn[rim] == 36).all()
    assert (drawn[~mask & ~rim] == 90).all()


def test_a_finer_mask_smooths_the_contour_and_does_not_move_or_widen_it(image: draw.Image) -> None:
    fine = 8
    rows, columns = (np.indices((60 * fine, 80 * fine)) + 0.5) / fine - 0.5  # pixel centres of the part from (20, 10)
    radius = np.hypot(rows + 10 - 40.3, columns + 20 - 61.7)
    drawn = draw.contour(np.zeros_like(image), radius < 21.0, WHITE, fine=fine, corner=(20, 10)).astype(float)[..., 0]
    share = drawn / 255
    assert share.sum() == pytest.approx(2 * np.pi * 20.5, rel=0.03), "one pixel wide"
    y, x = np.indices(share.shape)
    away = np.hypot(y - 40.3, x - 61.7)
    assert (share * away).sum() / share.sum() == pytest.approx(20.5, abs=0.1), "from the edge one pixel inwards"
    assert share[(away > 20) & (away < 21)].min() > 0.2, "no gaps"
    assert (share > 0).sum() > 1.5 * (share > 0.8).sum(), "smooth"


@pytest.mark.parametrize("ground", [(0, 0, 0), (255, 255, 255), draw.GREEN, draw.RED, (128, 128, 128)])
def test_a_contour_shows_on_any_ground(ground: draw.Colour) -> None:
    mask = np.zeros((40, 40), np.bool_)
    mask[10:30, 10:30] = True
    drawn = draw.contour(np.full((40, 40, 3), ground, np.uint8), mask).astype(float)
    line, rim, beside = drawn[20, 10], drawn[20, 9], drawn[20, 5]
    assert max(np.abs(line - beside).max(), np.abs(line - rim).max()) > 120


def test_blend_mixes_inside_the_mask_only(image: draw.Image) -> None:
    mask = np.zeros((120, 160), np.bool_)
    mask[:60] = True
    mixed = draw.blend(image, np.full_like(image, 190), mask, 0.25)
    assert (mixed[:60] == 115).all()
    assert (mixed[60:] == 90).all()


def test_lines_of_text_fit_their_width() -> None:
    drawn = draw.lines(["duck", "a very long line that would never fit " * 3], 200)
    assert drawn.shape == (2 * draw.LINE + 4, 200, 3)
    assert [(row > 120).any() for row in np.split(drawn[: 2 * draw.LINE], 2)] == [True, True]
    assert (drawn[:, 198:] == draw.PAPER).all()


def test_a_label_stays_in_the_picture(image: draw.Image) -> None:
    for corner in [(-50.0, -50.0), (500.0, 500.0), (80.0, 60.0)]:
        drawn = draw.label(image, "duck", corner)
        assert (drawn > 200).any()
        assert 20 < (drawn != 90).any(axis=-1).sum() < 1500


def test_tiles_beside_a_picture_fill_columns(image: draw.Image) -> None:
    sheet = draw.beside(image, [np.full((50, 50, 3), k, np.uint8) for k in (1, 2, 3)], gap=2)
    assert sheet.shape == (120, 160 + 2 * 52, 3)
    assert [int(sheet[y, x, 0]) for y, x in ((10, 170), (60, 170), (10, 220))] == [1, 2, 3]
    assert (sheet[:, :160] == image).all()


def test_contour_of_nothing_changes_nothing(image: draw.Image) -> None:
    assert (draw.contour(image, np.zeros((120, 160), dtype=np.bool_)) == image).all()


def test_axes_point_where_the_camera_sees_them(image: draw.Image) -> None:
    drawn = draw.axes(image, CAMERA, Pose.translation([0, 0, 1.0]), 0.08)
    assert tuple(drawn[60, 100]) == draw.AXES[0]  # x to the right
    assert tuple(drawn[85, 80]) == draw.AXES[1]  # y down
    assert (image == 90).all()


def test_axes_carry_their_letters(image: draw.Image) -> None:
    drawn = draw.axes(image, CAMERA, Pose.translation([0, 0, 1.0]), 0.08)
    for letter, colour in ((drawn[50:70, 123:136], draw.AXES[0]), (drawn[103:118, 70:90], draw.AXES[1])):
        assert (np.abs(letter.astype(int) - colour).max(axis=-1) < 60).sum() > 4


def test_axes_behind_the_camera_are_left_out(image: draw.Image) -> None:
    assert (draw.axes(image, CAMERA, Pose.translation([0, 0, -1.0]), 0.1) == image).all()
    close = draw.axes(image, CAMERA, Pose.translation([0, 0, 1e-6]), 0.1)  # projects far outside
    assert close.shape == image.shape


def test_box_lies_on_the_outermost_pixels(image: draw.Image) -> None:
    drawn = draw.box(image, (10, 20, 30, 50), (255, 0, 0))
    red = (drawn == (255, 0, 0)).all(axis=-1)
    rows, columns = np.flatnonzero(red.any(axis=1)), np.flatnonzero(red.any(axis=0))
    assert (rows[0], rows[-1], columns[0], columns[-1]) == (20, 49, 10, 29)
    assert not red[30, 20]


@pytest.mark.parametrize("width", [16, 160, 1600])
def test_caption_fits_any_width(width: int) -> None:
    picture = np.full((width, width, 3), 200, dtype=np.uint8)
    drawn = draw.caption(picture, "a rather long caption with 12.3 deg")
    assert drawn.shape == picture.shape
    assert (drawn[width // 2 :] == 200).all()
    assert (drawn != picture).any()


def test_grid_places_pictures_row_by_row() -> None:
    pictures = [np.full((10, 20, 3), 50 * k, dtype=np.uint8) for k in range(1, 5)]
    sheet = draw.grid(pictures, columns=3, gap=2)
    assert sheet.shape == (22, 64, 3)
    assert [int(sheet[5, x, 0]) for x in (10, 32, 54)] == [50, 100, 150]
    assert int(sheet[17, 10, 0]) == 200
    assert tuple(sheet[17, 40]) == draw.PAPER


@pytest.mark.parametrize("count", [1, 2, 5, 6, 200])
def test_grid_is_about_square(count: int) -> None:
    sheet = draw.grid([np.zeros((30, 40, 3), dtype=np.uint8)] * count)
    assert sheet.shape[0] * sheet.shape[1] >= count * 1200
    assert count < 6 or 0.5 < sheet.shape[1] / sheet.shape[0] < 3


def test_grid_refuses_other_sizes() -> None:
    with pytest.raises(ValueError, match="one size"):
        draw.grid([np.zeros((3, 4, 3), np.uint8), np.zeros((4, 4, 3), np.uint8)])
    with pytest.raises(ValueError, match="one size"):
        draw.grid([])


@pytest.mark.parametrize("count", [1, 3, 6])
def test_strip_has_the_width_asked_for(count: int, image: draw.Image) -> None:
    row = draw.strip([image] * count, [f"step {k}" for k in range(count)], 641)
    assert row.shape[1] == 641
    assert row.shape[0] == pytest.approx(641 / count * 0.75, abs=4)


def test_stack_keeps_every_picture() -> None:
    sheet = draw.stack([np.full((5, 8, 3), 10, np.uint8), np.full((3, 4, 3), 20, np.uint8)], gap=1)
    assert sheet.shape == (9, 8, 3)
    assert (sheet[:5] == 10).all()
    assert (sheet[6:, :4] == 20).all()
    assert tuple(sheet[7, 6]) == draw.PAPER


def test_png_keeps_colours_and_masks() -> None:
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (7, 9, 3), dtype=np.uint8)
    decoded = cv2.imdecode(np.frombuffer(draw.png(picture), np.uint8), cv2.IMREAD_COLOR)
    assert (decoded[..., ::-1] == picture).all()
    mask = picture[..., 0] > 100
    decoded = cv2.imdecode(np.frombuffer(draw.png(mask), np.uint8), cv2.IMREAD_UNCHANGED)
    assert decoded.shape == (7, 9)
    assert ((decoded == 255) == mask).all()
    assert set(np.unique(decoded)) <= {0, 255}

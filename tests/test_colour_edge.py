"""The outline that colours show: each step against a closed form or the formula written out with loops."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from posekit.align import colour_edge as edge
from posekit.align.colour_edge import Colours, Tint, contrast, find_outline, learn, outline_lines
from posekit.camera import Camera
from posekit.view import View

WIDTH, HEIGHT = 160, 120
CAMERA = Camera(300.0, 300.0, 79.5, 59.5, WIDTH, HEIGHT)
RED, BLUE, GREEN = (200, 40, 40), (40, 40, 200), (40, 200, 40)
CENTRE = np.array([80.25, 60.5])


def disc(radius: float, centre: np.ndarray = CENTRE) -> np.ndarray:
    """Pixels (H, W) whose centre is within a circle."""
    return np.linalg.norm(CAMERA.pixel_grid() - centre, axis=-1) < radius


@cache
def painted(radius: float, inner: tuple[int, ...] = RED, outer: tuple[int, ...] = BLUE) -> np.ndarray:
    """A picture of a circle whose border pixels mix both colours by the area that each covers, to 1/64."""
    fine = (np.arange(8) + 0.5) / 8 - 0.5
    x = (np.arange(WIDTH)[:, None] + fine).ravel() - CENTRE[0]
    y = (np.arange(HEIGHT)[:, None] + fine).ravel() - CENTRE[1]
    inside = (x**2 + y[:, None] ** 2 < radius**2).reshape(HEIGHT, 8, WIDTH, 8).mean(axis=(1, 3))[..., None]
    return np.rint(inside * np.array(inner) + (1 - inside) * np.array(outer)).astype(np.uint8)


def drawn(radius: float, centre: np.ndarray = CENTRE) -> View:
    """A rendering of a circle; its coords tell the pixel: (column, row, 5)."""
    mask = disc(radius, centre)
    coords = np.dstack([CAMERA.pixel_grid(), np.full((HEIGHT, WIDTH), 5.0)]).astype(np.float32) * mask[..., None]
    return View(painted(radius), CAMERA, mask, coords=coords)


def one_colour(colour: tuple[int, ...]) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), colour, np.uint8)


# --- colours ---------------------------------------------------------------------------------------------------------


def test_colours_are_counted_in_bins_of_eight_grey_values() -> None:
    image = np.array([[[0, 0, 0], [7, 7, 7], [8, 0, 0], [0, 8, 0], [0, 0, 8], [255, 255, 255]]], np.uint8)
    np.testing.assert_array_equal(edge._index(image), [[0, 0, 1024, 32, 1, 32**3 - 1]])


def test_a_colour_counts_for_its_neighbours_too() -> None:
    index = edge._index(np.array([RED] * 3, np.uint8))
    share = edge._histogram(index).reshape(32, 32, 32)
    r, g, b = (v // 8 for v in RED)
    smooth = np.array([0.25, 0.5, 0.25])
    near = share[r - 1 : r + 2, g - 1 : g + 2, b - 1 : b + 2]
    np.testing.assert_allclose(near, smooth[:, None, None] * smooth[:, None] * smooth)
    assert share.sum() == pytest.approx(1) and near.sum() == pytest.approx(1)
    assert not edge._histogram(np.zeros(0, np.intp)).any()
    two = edge._histogram(np.concatenate([index, edge._index(np.array([BLUE], np.uint8))])).reshape(32, 32, 32)
    assert two[r, g, b] == pytest.approx(0.75 / 8) and two[b, g, r] == pytest.approx(0.25 / 8)


def test_chances_follow_from_both_histograms() -> None:
    inside, outside = np.zeros(32**3, np.float32), np.zeros(32**3, np.float32)
    inside[1], outside[1], inside[2], outside[3] = 0.3, 0.1, 0.5, 0.5
    colours = Colours(inside, outside)
    np.testing.assert_allclose(colours.chance[:4], [0.5, 0.75, 1, 0], atol=1e-5)
    np.testing.assert_allclose(colours.chance[1:3], [0.300001 / 0.400002, 0.500001 / 0.500002], rtol=1e-6)
    np.testing.assert_allclose(colours.posterior(np.array([[[0, 0, 8], [0, 0, 17]]], np.uint8)), [[0.75, 1]], atol=1e-5)
    mixed = colours.mixed(Colours(np.full(32**3, 0.2, np.float32), np.full(32**3, 0.4, np.float32)), 0.25)
    np.testing.assert_allclose(mixed.inside[:4], [0.05, 0.275, 0.425, 0.05], rtol=1e-6)
    np.testing.assert_allclose(mixed.outside[:4], [0.1, 0.175, 0.1, 0.475], rtol=1e-6)


def test_pixels_are_the_objects_by_the_smoothed_chance() -> None:
    colours = learn(View(painted(30), CAMERA), disc(30), disc(30))
    seen = colours.seen(View(painted(30), CAMERA))
    assert seen[disc(28)].all() and not seen[~disc(32)].any()
    half = Colours(np.full(32**3, 0.3, np.float32), np.full(32**3, 0.7, np.float32))
    assert not half.seen(View(one_colour(RED), CAMERA)).any(), "0.3 is below the limit"
    more = Colours(np.full(32**3, 0.4, np.float32), np.full(32**3, 0.6, np.float32))
    assert more.seen(View(one_colour(RED), CAMERA)).all(), "0.4 is above it"
    speck = one_colour(BLUE)
    speck[50, 50] = RED
    assert not colours.seen(View(speck, CAMERA)).any(), "a single pixel is outvoted by its neighbours"


def test_learning_keeps_off_the_border_the_hidden_and_what_is_not_shown() -> None:
    radius, grey, white = 30, (120, 120, 120), (250, 250, 250)
    apart = np.linalg.norm(CAMERA.pixel_grid() - CENTRE, axis=-1)
    image = one_colour(grey)  # beyond the ring that teaches
    image[apart < radius + 13] = BLUE
    image[apart < radius + 1.9] = GREEN  # a pixel to either side of the border
    image[apart < radius - 0.9] = RED
    seen = disc(radius)
    image[40:60, 70:80] = white
    seen[40:60, 70:80] = False
    valid = np.ones((HEIGHT, WIDTH), bool)
    image[:, 90:100] = (0, 0, 0)
    valid[:, 90:100] = False
    colours = learn(View(image, CAMERA, valid=valid), disc(radius), seen)

    def at(histogram: np.ndarray, colour: tuple[int, ...]) -> float:
        return float(histogram[edge._index(np.array(colour, np.uint8))])

    assert at(colours.inside, RED) == pytest.approx(0.125, rel=0.01) and at(colours.outside, BLUE) > 0.08
    for other in (BLUE, white, (0, 0, 0), grey):
        assert at(colours.inside, other) < 0.001
    for other in (RED, white, (0, 0, 0)):
        assert at(colours.outside, other) < 0.001
    assert at(colours.inside, GREEN) < 0.02 * 0.125 and 0 < at(colours.outside, grey) < 0.015


def test_chromaticities_are_shares_of_brightness() -> None:
    np.testing.assert_allclose(edge.chromaticity(one_colour((92, 32, 52)))[5, 5], np.array([100, 40, 60]) / 200)
    view, mesh = View(one_colour((92, 32, 52)), CAMERA), View(one_colour((72, 12, 92)), CAMERA)
    np.testing.assert_allclose(edge.off_colour(view, mesh)[9, 9], [0.1, 0.1, -0.2], atol=1e-6)
    assert not edge.like_mesh(view, mesh).any() and edge.like_mesh(view, view).all()
    near = View(one_colour((82, 32, 62)), CAMERA)  # (0.45, 0.2, 0.35): 0.071 away
    assert edge.like_mesh(near, view).all()


def test_a_mesh_of_another_colour_does_not_hide_the_object() -> None:
    radius = 30
    mesh = replace(drawn(radius), image=one_colour(GREEN))
    assert not edge.like_mesh(View(painted(radius), CAMERA), mesh).any()
    assert edge.unhidden(View(painted(radius), CAMERA), mesh)[disc(radius)].all()
    half = painted(radius).copy()  # one half has the mesh's colour
    half[:, :80][disc(radius)[:, :80]] = GREEN
    assert edge.unhidden(View(half, CAMERA), mesh)[disc(radius)].all()


def test_what_goes_on_beyond_the_outline_hides_the_object() -> None:
    radius = 30
    mesh = replace(drawn(radius), image=one_colour(RED))
    image = painted(radius).copy()
    bar = np.zeros((HEIGHT, WIDTH), bool)
    bar[:, 60:75] = True
    image[bar] = GREEN
    visible = edge.unhidden(View(image, CAMERA), mesh)
    covered = disc(radius) & bar
    assert (covered & visible).sum() < 0.2 * covered.sum()
    assert (disc(radius) & ~bar & ~visible).sum() < 0.1 * disc(radius).sum(), "the bar's edge is smoothed"


def test_chromaticities_are_smoothed_along_both_axes() -> None:
    speck = np.full((31, 31, 3), 60, np.uint8)
    speck[15, 15] = 255, 60, 60
    found = edge.chromaticity(speck)[..., 0]
    np.testing.assert_allclose(found, found.T, atol=1e-6)
    assert found[15, 15] > found[15, 16] > found[15, 17] > found[15, 22] == pytest.approx(1 / 3)


def test_a_tint_is_smoothed_where_seen_and_the_median_elsewhere() -> None:
    rng = np.random.default_rng(0)
    apart = rng.normal(size=(HEIGHT, WIDTH, 3)).astype(np.float32)
    seen = disc(20)
    tint = Tint.of(apart, seen)
    np.testing.assert_allclose(tint.apart[seen], cv2.GaussianBlur(apart, (0, 0), 1.0)[seen])
    np.testing.assert_allclose(tint.apart[~seen], np.median(apart[seen], axis=0) + np.zeros((int((~seen).sum()), 3)))
    assert not Tint.of(apart, np.zeros((HEIGHT, WIDTH), bool)).apart.any()
    mixed = Tint(np.full((2, 2, 3), 2.0, np.float32)).mixed(Tint(np.full((2, 2, 3), 4.0, np.float32)), 0.25)
    np.testing.assert_allclose(mixed.apart, 2.5)


def test_what_is_suddenly_further_from_the_mesh_hides_it() -> None:
    usual, silhouette = Tint(np.full((HEIGHT, WIDTH, 3), 0.05, np.float32)), disc(30)
    now = usual.apart.copy()
    now[50:60, 70:80] += np.float32([0.08, -0.08, 0.06])  # 0.128 away
    now[65:75, 70:80] += np.float32([0.08, -0.05, 0.06])  # 0.112 away
    now[60, 95] += 1  # a single pixel
    now[80:83, 75:85] += 1  # three pixels thin
    now[5:15, 5:15] += 1  # not on the object
    wanted = np.zeros((HEIGHT, WIDTH), bool)
    wanted[50:60, 70:80] = wanted[80:83, 75:85] = True
    found = usual.hides(now, silhouette)
    assert not (found & ~wanted).any() and found[51:59, 71:79].all() and found[81, 76:84].all()


# --- outlines --------------------------------------------------------------------------------------------------------


def test_an_outline_has_the_masks_border_and_normals_outwards() -> None:
    mask = disc(30)
    pixels, normals = find_outline(mask)
    assert 100 < len(pixels) <= edge.COUNT
    columns, rows = pixels.astype(int).T
    assert mask[rows, columns].all()
    away = pixels - CENTRE
    radius = np.linalg.norm(away, axis=1)
    assert radius.min() > 28 and radius.max() < 30
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    assert (normals * away / radius[:, None]).sum(axis=1).min() > 0.99
    border = mask & (cv2.erode(mask.astype(np.uint8), np.ones((3, 3))) == 0)
    assert {(r, c) for c, r in pixels.tolist()} == set(zip(*(v.tolist() for v in np.nonzero(border)), strict=True))


def test_an_outline_leaves_out_the_pictures_edge_and_has_at_most_so_many_points() -> None:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[0:100, 0:50] = True
    pixels, _ = find_outline(mask)
    assert len(pixels) == 99 + 49 - 1 and pixels.min() == 1
    mask[:, :] = False
    mask[20:, 30:] = True
    pixels, _ = find_outline(mask)
    assert pixels.max(axis=0).tolist() == [WIDTH - 2, HEIGHT - 2]
    mask[:, :] = False
    mask[2:118, 2:158] = True
    pixels, _ = find_outline(mask)
    assert len(pixels) == edge.COUNT
    assert pixels[0].tolist() == [2, 2] and pixels[-1].tolist() == [157, 117], "spread from the first to the last"
    assert len(find_outline(np.zeros((HEIGHT, WIDTH), bool))[0]) == 0


def test_a_lines_offset_is_the_mean_over_all_steps() -> None:
    """The formula of correspondence lines, written out."""
    rng = np.random.default_rng(1)
    along = np.arange(-10, 11, dtype=np.float32)
    posterior = rng.uniform(0.05, 0.95, (4, 21)).astype(np.float32)
    posterior[3] = along < 2.5  # a clean step: pixels up to 2 are the object's
    mean, sigma = edge._offsets(posterior, along)
    for k, line in enumerate(posterior):
        likely = []
        for shift in range(-6, 7):
            inside = [0.5 - 0.42 * np.tanh((s - shift - 0.5) / 1.4) for s in along]
            likely.append(np.prod([p * h + (1 - p) * (1 - h) for p, h in zip(line, inside, strict=True)]))
        share, shifts = np.array(likely) / np.sum(likely), np.arange(-6, 7)
        assert mean[k] == pytest.approx(share @ shifts, abs=1e-4)
        variance = share @ (shifts - share @ shifts) ** 2
        assert sigma[k] == pytest.approx(np.sqrt(max(variance, 0.25)), abs=1e-4)
    assert mean[3] == pytest.approx(2.0, abs=0.02) and sigma[:3].min() > 0.5


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
@pytest.mark.parametrize("last", [-3, 0, 4])
def test_a_clear_step_lies_where_the_mixed_pixel_says(last: int, share: float) -> None:
    """Pixels up to ``last`` are the object's, and a share of the next one."""
    along = np.arange(-10, 11)
    inside = np.where(along <= last, 1.0, np.where(along == last + 1, share, 0.0))[:, None]
    line = np.rint(inside * np.array(RED) + (1 - inside) * np.array(BLUE)).astype(np.uint8)
    near = np.float32([last + 0.4, last + 1.2, last - 0.6])
    found = edge._halfway(np.stack([line] * 3), near)
    np.testing.assert_allclose(found, last + share, atol=0.01)


def test_an_offset_stays_where_there_is_no_clear_step() -> None:
    along = np.arange(-10, 11)
    faint = np.where(along[:, None] <= 0, (100, 100, 100), (115, 115, 115)).astype(np.uint8)  # 26 grey values
    strong = np.where(along[:, None] <= 0, (100, 100, 100), (118, 118, 118)).astype(np.uint8)  # 31 grey values
    np.testing.assert_allclose(edge._halfway(np.stack([faint, strong]), np.float32([0.7, 0.7])), [0.7, 0.0], atol=0.01)
    np.testing.assert_allclose(edge._halfway(np.stack([strong]), np.float32([2.4])), [2.4])  # more than 2 pixels off
    flat = np.full((1, 21, 3), 90, np.uint8)
    np.testing.assert_allclose(edge._halfway(flat, np.float32([1.3])), [1.3])
    assert np.isfinite(edge._halfway(np.stack([strong] * 2), np.float32([-9.0, 9.0]))).all()


def test_the_window_of_a_clear_step_ends_at_the_lines_ends() -> None:
    along = np.arange(-10, 11)
    for last, mean in ((7, 7.2), (-8, -7.8)):
        line = np.where(along[:, None] <= last, RED, BLUE).astype(np.uint8)
        np.testing.assert_allclose(edge._halfway(line[None], np.float32([mean])), [last], atol=0.01)


def test_places_become_pixels_of_the_photograph() -> None:
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[7, 3] = False
    view = View(one_colour(RED), CAMERA, valid=valid)
    places = np.float32([[3.4, 7.3], [4.4, 7.4], [-0.6, 5], [-0.4, 5], [159.4, 119.4], [159.6, 5], [5, 119.6], [5, -3]])
    pixels, inside = edge._pixels(places, view)
    assert pixels.tolist() == [[3, 7], [4, 7], [0, 5], [0, 5], [159, 119], [159, 5], [5, 119], [5, 0]]
    assert inside.tolist() == [False, True, False, True, True, False, False, False]


@pytest.mark.parametrize("off", [-3.0, 0.0, 2.5])
def test_lines_lie_on_the_circle_that_the_picture_shows(off: float) -> None:
    """The rendering is smaller or larger than what the picture shows."""
    radius, center = 30.0, np.array([1.0, 2.0, 3.0])
    view, render = View(painted(radius), CAMERA), drawn(radius + off)
    colours = learn(view, disc(radius), disc(radius))
    lines = outline_lines(view, render, colours, disc(radius), center)
    assert lines is not None
    pixels, normals = find_outline(disc(radius + off))
    assert len(lines.points) == len(pixels)
    np.testing.assert_allclose(lines.points, np.column_stack([pixels, np.full(len(pixels), 5.0)]) - center)
    np.testing.assert_allclose(lines.normals, normals)
    away = np.linalg.norm(lines.places - CENTRE, axis=1)
    # a place is half a pixel inside the circle, as an outline's pixel is
    assert abs(away.mean() - (radius - 0.5)) < 0.1 and away.std() < 0.35
    assert (lines.sigma >= edge.SIGMA - 1e-6).all() and (lines.sigma < 3).all()
    again = outline_lines(view, render, colours, disc(radius), center, (pixels[::4], normals[::4]))
    assert again is not None and len(again.points) == len(pixels[::4]), "an outline that is known is taken"


def test_lines_need_what_is_seen_valid_and_told_by_colours() -> None:
    radius, center = 30.0, np.zeros(3)
    view, render, whole = View(painted(radius), CAMERA), drawn(radius), disc(radius)
    colours = learn(view, whole, whole)
    every = outline_lines(view, render, colours, whole, center)
    assert every is not None
    seen = whole.copy()
    seen[:, 90:] = False
    half = outline_lines(view, render, colours, seen, center)
    assert half is not None
    columns = half.points[:, 0]
    # hidden are the columns from 90 on; they spoil outlines five pixels beside them
    assert 80 < columns.max() <= 86 and len(half.points) > 0.4 * len(every.points)
    thin = whole.copy()
    thin[:, 90:92] = False  # thinner than a pose's error may explain
    assert len(outline_lines(view, render, colours, thin, center).points) >= len(every.points) - 12  # type: ignore[union-attr]
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[:, 100:] = False
    cut = outline_lines(replace(view, valid=valid), render, colours, whole, center)
    assert cut is not None and 88 < cut.points[:, 0].max() <= 100
    assert outline_lines(view, render, colours, np.zeros_like(whole), center) is None
    assert outline_lines(View(one_colour(RED), CAMERA), render, colours, whole, center) is None, "no step to be seen"
    assert outline_lines(view, drawn(2.0), colours, whole, center) is None, "too few pixels"
    few = tuple(a[: edge.LEAST] for a in find_outline(whole))
    assert outline_lines(view, render, colours, whole, center, few) is not None  # type: ignore[arg-type]
    fewer = tuple(a[: edge.LEAST - 1] for a in find_outline(whole))
    assert outline_lines(view, render, colours, whole, center, fewer) is None  # type: ignore[arg-type]


def test_lines_whose_step_is_at_the_ends_of_their_reach_are_left_out() -> None:
    view, whole = View(painted(30), CAMERA), disc(36)
    colours = learn(view, disc(30), disc(30))
    assert outline_lines(view, drawn(34), colours, whole, np.zeros(3)) is not None  # 4 pixels off
    assert outline_lines(view, drawn(35.4), colours, whole, np.zeros(3)) is None  # 5.4 pixels off, of a reach of 6


def test_contrast_is_largest_at_the_right_silhouette() -> None:
    view = View(painted(30.0), CAMERA)
    colours = learn(view, disc(30.0), np.ones((HEIGHT, WIDTH), bool))
    right = contrast(view, disc(30.0), colours)
    assert right > 0.9
    for wrong in (disc(24.0), disc(36.0), disc(30.0, CENTRE + 5)):
        assert contrast(view, wrong, colours) < right - 0.2
    assert contrast(view, np.zeros((HEIGHT, WIDTH), bool), colours) == 0
    assert abs(contrast(View(one_colour(RED), CAMERA), disc(30.0), colours)) < 0.05


def test_contrast_compares_bands_of_three_pixels() -> None:
    """The pixels that lie up to three pixels inside and outside the edge's own row, also at the picture's border."""
    rng = np.random.default_rng(6)
    view = View(rng.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8), CAMERA)
    colours = Colours(*rng.random((2, 32**3)).astype(np.float32))
    silhouette = np.zeros((HEIGHT, WIDTH), bool)
    silhouette[:70, 40:100] = True
    chance = colours.posterior(view.image)
    inner = np.zeros((HEIGHT, WIDTH), bool)
    inner[:69, 41:99] = True
    inner[:66, 44:96] = False
    beside = np.hypot(*np.maximum(0, np.abs(CAMERA.pixel_grid() - [69.5, 34.5]) - [29.5, 34.5]).transpose(2, 0, 1))
    outer = (beside > 1) & (cv2.dilate(silhouette.astype(np.uint8), edge._disc(4)) > 0)
    assert beside[outer].max() < 4.5
    found = contrast(view, silhouette, colours)
    assert found == pytest.approx(chance[inner].mean() - chance[outer].mean(), abs=1e-6)


def test_contrast_needs_an_inside_and_an_outside() -> None:
    colours = Colours(*np.random.default_rng(6).random((2, 32**3)).astype(np.float32))
    view = View(one_colour(RED), CAMERA)
    assert contrast(view, np.ones((HEIGHT, WIDTH), bool), colours) == 0
    assert contrast(view, disc(0.9), colours) == 0, "a few pixels without an inside"

"""Cameras invert themselves, boxes are edges, a zoom may come before or after the projection."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conftest import points
from posekit.camera import Box, Camera, Zoom, box_iou, box_mask, mask_box, mask_iou
from posekit.errors import CameraError
from posekit.view import View

cameras = st.builds(
    lambda f, stretch, cx, cy: Camera(f, f * stretch, cx, cy, 640, 480),
    st.floats(200, 2000), st.floats(0.8, 1.25), st.floats(200, 440), st.floats(150, 330),
)  # fmt: skip


@given(cameras, points)
def test_projection_and_back(camera: Camera, p: np.ndarray) -> None:
    np.testing.assert_allclose(camera.backproject(camera.project(p), p[:, 2]), p, atol=1e-9)
    homogeneous = p @ camera.K.T
    np.testing.assert_allclose(camera.project(p), homogeneous[:, :2] / homogeneous[:, 2:], atol=1e-9)


@given(cameras, points, st.integers(100, 2000), st.integers(100, 2000))
def test_resizing_moves_edges_with_the_picture(camera: Camera, p: np.ndarray, width: int, height: int) -> None:
    edge, resized = camera.project(p) + 0.5, camera.resized(width, height)
    np.testing.assert_allclose(resized.project(p) + 0.5, edge * (width / 640, height / 480), atol=1e-6)


@given(cameras, points)
def test_cropping_shifts(camera: Camera, p: np.ndarray) -> None:
    np.testing.assert_allclose(camera.cropped(30, 40, 200, 100).project(p), camera.project(p) - (30, 40), atol=1e-9)


@given(cameras, points)
def test_gl_projection_puts_pixel_centres_where_opengl_samples(camera: Camera, p: np.ndarray) -> None:
    near, far = 0.1, 10.0
    clip = np.column_stack([p, np.ones(len(p))]) @ camera.gl_projection(near, far).T
    ndc = clip[:, :3] / clip[:, 3:]
    window = (ndc[:, :2] + 1) / 2 * (camera.width, camera.height)  # edge coordinates, first row first
    np.testing.assert_allclose(window - 0.5, camera.project(p), atol=1e-6)
    depth = [camera.gl_projection(near, far) @ [0, 0, z, 1] for z in (near, far)]
    np.testing.assert_allclose([d[2] / d[3] for d in depth], [-1, 1], atol=1e-9)
    along_axis = [camera.gl_projection(near, far) @ [0, 0, z, 1] for z in p[:, 2]]  # depth is that of z alone
    np.testing.assert_allclose(ndc[:, 2], [d[2] / d[3] for d in along_axis], atol=1e-9)


@given(cameras, points, st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)), st.floats(0.02, 0.5))
def test_project_after_zoom_is_zoom_after_project(
    camera: Camera, p: np.ndarray, ray: tuple[float, float], half_width: float
) -> None:
    zoom = Zoom.look_at(camera, [*ray, 1.0], half_width, (160, 120))
    turned = p @ zoom.R_view_cam.T
    mapped = np.column_stack([camera.project(p), np.ones(len(p))]) @ zoom.homography.T
    np.testing.assert_allclose(zoom.camera.project(turned), mapped[:, :2] / mapped[:, 2:], rtol=1e-6, atol=1e-6)


@given(cameras, st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)))
def test_a_zoom_looks_along_its_ray_without_rolling(camera: Camera, ray: tuple[float, float]) -> None:
    zoom = Zoom.look_at(camera, [*ray, 1.0], 0.1, (160, 120))
    np.testing.assert_allclose(zoom.camera.project(zoom.R_view_cam @ [*ray, 1.0]), [79.5, 59.5], atol=1e-6)
    edge = zoom.camera.backproject([[-0.5, 59.5], [159.5, 59.5]])
    np.testing.assert_allclose(edge[:, 0], [-0.1, 0.1], atol=1e-12)


def test_a_zoomed_picture_shows_what_its_camera_sees() -> None:
    camera = Camera(500, 510, 315, 245, 640, 480)
    x, y = np.meshgrid(np.arange(640), np.arange(480))
    image = np.stack([x * 0.35, y * 0.5, 0 * x + 90], axis=-1).astype(np.uint8)
    mask = (x > 400) & (x < 500) & (y > 100) & (y < 200)
    zoom = Zoom.look_at(camera, camera.backproject([450, 150]), 0.12, (160, 120))
    seen = View(image, camera, mask).zoomed(zoom)
    rays = zoom.camera.backproject(zoom.camera.pixel_grid()) @ zoom.R_view_cam
    pixels = camera.project(rays)
    np.testing.assert_allclose(seen.image[..., 0], pixels[..., 0] * 0.35, atol=1.6)
    np.testing.assert_allclose(seen.image[..., 1], pixels[..., 1] * 0.5, atol=1.6)
    inside = (np.abs(pixels - (450, 150)) < 48).all(axis=-1)
    assert seen.mask is not None
    assert seen.mask[inside].all()
    np.testing.assert_allclose(seen.R_view_cam, zoom.R_view_cam)


@pytest.mark.parametrize("middle", [(320, 240), (15, 20), (630, 400), (-150, 200), (-900, 240)])
def test_where_it_shrinks_a_zoom_smooths_as_if_the_whole_picture_were_smoothed(middle: tuple[int, int]) -> None:
    camera = Camera(500, 510, 315, 245, 640, 480)
    noise = np.random.default_rng(3).integers(0, 256, (480, 640, 3)).astype(np.uint8)
    zoom = Zoom.look_at(camera, camera.backproject(middle), 0.25, (40, 30))
    smooth = cv2.GaussianBlur(noise, (0, 0), 0.4 * camera.fx / zoom.camera.fx)
    expected = cv2.warpPerspective(smooth, zoom.homography, (40, 30), flags=cv2.INTER_LINEAR)
    seen = View(noise, camera).zoomed(zoom)
    assert np.abs(seen.image.astype(int) - expected).max() <= 1, "interpolation rounds to 1/32 of a pixel"
    assert seen.image.any() == (middle[0] > -900)


def test_boxes_are_edges() -> None:
    camera = Camera(100, 100, 9.5, 9.5, 20, 20)
    np.testing.assert_allclose(camera.box_centre_ray((0, 0, 20, 20)), [0, 0, 1])
    np.testing.assert_allclose(camera.points_box([[0, 0, 1]]), (10, 10, 10, 10))
    np.testing.assert_allclose(camera.project(camera.box_corner_rays((0, 0, 20, 20)))[2], [19.5, 19.5])
    mask = np.zeros((20, 20), dtype=bool)
    assert mask_box(mask) is None
    mask[0, 0] = True
    assert mask_box(mask) == (0, 0, 1, 1)
    mask[3, 5] = True
    assert mask_box(mask) == (0, 0, 6, 4)


def test_field_of_view() -> None:
    camera = Camera.from_fov(np.deg2rad(60), 640, 480)
    left, right = camera.backproject([[-0.5, 240], [639.5, 240]])
    np.testing.assert_allclose(np.rad2deg(np.arctan(right[0]) - np.arctan(left[0])), 60)


@pytest.mark.parametrize("values", [(0, 1, 0, 0), (1, 0, 0, 0), (-5, 5, 0, 0), (np.nan, 5, 0, 0), (5, 5, np.inf, 0)])
def test_bad_intrinsics_are_refused(values: tuple[float, ...]) -> None:
    with pytest.raises(CameraError, match=r"must be positive numbers of pixels. Give fx,fy,cx,cy"):
        Camera(*values, 640, 480)
    with pytest.raises(CameraError, match="at least 1 pixel"):
        Camera(5, 5, 0, 0, 0, 480)
    with pytest.raises(CameraError, match="3x3 numbers"):
        Camera.from_K([1, 2, 3], 640, 480)


def test_a_picture_and_a_camera_of_different_sizes_make_no_view() -> None:
    with pytest.raises(ValueError, match=r"image is \(10, 10\), its camera \(480, 640\)"):
        View(np.zeros((10, 10, 3), np.uint8), Camera(500, 500, 320, 240, 640, 480))


def test_the_box_round_points_and_masks() -> None:
    camera = Camera(100.0, 200.0, 49.5, 29.5, 100, 60)
    assert camera.points_box([[0.0, 0.0, 1.0], [0.1, 0.05, 1.0]]) == pytest.approx((50, 30, 60, 40))
    assert camera.points_box([[0.0, 0.0, 2.0], [0.1, 0.05, 2.0]]) == pytest.approx((50, 30, 55, 35))
    mask = np.zeros((6, 9), bool)
    assert mask_box(mask) is None
    mask[2:4, 3:8] = True
    assert mask_box(mask) == (3, 2, 8, 4)


def test_rays_through_a_box() -> None:
    camera = Camera(100.0, 200.0, 49.5, 29.5, 100, 60)
    np.testing.assert_allclose(camera.box_centre_ray((50, 30, 70, 50)), [0.1, 0.05, 1])
    wanted = [[0, 0, 1], [0.2, 0, 1], [0.2, 0.1, 1], [0, 0.1, 1]]
    np.testing.assert_allclose(camera.box_corner_rays((50, 30, 70, 50)), wanted)


@pytest.mark.parametrize("size", [(0, 10), (10, 0), (-1, 10)])
def test_a_camera_has_pixels(size: tuple[int, int]) -> None:
    with pytest.raises(CameraError, match="at least 1 pixel"):
        Camera(100.0, 100.0, 5.0, 5.0, *size)
    assert Camera(0.5, 0.75, 0.0, 0.0, 1, 1).size == (1, 1)
    with pytest.raises(CameraError, match="3x3"):
        Camera.from_K(np.eye(2), 10, 10)
    np.testing.assert_array_equal(
        Camera.from_K([[3, 0, 1], [0, 4, 2], [0, 0, 1]], 10, 20).K[:2], [[3, 0, 1], [0, 4, 2]]
    )


def test_a_pictures_longer_side_has_the_field_of_view() -> None:
    for width, height in ((640, 480), (480, 640)):
        camera = Camera.from_fov(1.2, width, height)
        assert camera.fx == camera.fy == pytest.approx(320 / np.tan(0.6))
        assert (camera.cx, camera.cy) == (width / 2 - 0.5, height / 2 - 0.5)


def test_pixels_have_whole_coordinates() -> None:
    grid = Camera(100.0, 100.0, 1.0, 1.0, 4, 3).pixel_grid()
    assert grid.shape == (3, 4, 2) and grid.dtype == np.float64
    assert grid[2, 1].tolist() == [1, 2] and grid[0, 0].tolist() == [0, 0]


def test_a_depth_is_along_z() -> None:
    camera = Camera(100.0, 200.0, 10.0, 20.0, 40, 30)
    np.testing.assert_allclose(camera.backproject([30.0, 30.0]), [0.2, 0.05, 1.0])
    wanted = [[0.4, 0.1, 2.0], [0.0, 0.0, 3.0]]
    np.testing.assert_allclose(camera.backproject([[30.0, 30.0], [10.0, 20.0]], [2.0, 3.0]), wanted)


def test_a_zooms_homography_maps_between_the_cameras() -> None:
    source, zoomed = Camera(500.0, 510.0, 315.0, 245.0, 640, 480), Camera(900.0, 900.0, 79.5, 59.5, 160, 120)
    c, s = np.cos(0.2), np.sin(0.2)
    R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    ray = np.array([0.1, -0.05, 1.0])
    mapped = Zoom(source, zoomed, R).homography @ [*source.project(ray), 1.0]
    np.testing.assert_allclose(mapped[:2] / mapped[2], zoomed.project(R @ ray))


def test_intersection_over_union() -> None:
    boxes = np.array([(0, 0, 2, 2), (1, 0, 3, 2), (5, 5, 6, 6), (5, 5, 5, 5)])
    np.testing.assert_allclose(box_iou(boxes[:, None], boxes[None])[0], [1, 1 / 3, 0, 0])
    assert box_iou(boxes[3], boxes[3]) == 0, "boxes without an area"
    assert box_iou(np.zeros((0, 1, 4)), boxes[None]).shape == (0, 4)
    mask = np.zeros((4, 6), bool)
    assert mask_iou(mask, mask) == 0
    mask[:, :2] = True
    assert mask_iou(mask, mask) == 1
    assert mask_iou(mask, np.roll(mask, 1, axis=1)) == pytest.approx(1 / 3)
    mask[:] = False
    mask[1, 2] = True
    assert mask_iou(mask, mask) == 1, "a single pixel"


def test_intersection_over_union_in_both_directions() -> None:
    assert box_iou((0, 0, 4, 10), (1, 2, 6, 5)) == pytest.approx(9 / (40 + 15 - 9))
    assert box_iou((0, 0, 10, 4), (2, 1, 5, 6)) == pytest.approx(9 / (40 + 15 - 9))
    assert box_iou((0, 0, 0.2, 0.1), (0.1, 0, 0.3, 0.1)) == pytest.approx(1 / 3), "less than a pixel"


@pytest.mark.parametrize(
    ("box", "columns", "rows"),
    [
        ((2, 1, 5, 4), range(2, 5), range(1, 4)),
        ((1.6, 0.7, 4.4, 3.6), range(2, 4), range(1, 4)),  # the greater part of a pixel counts
        ((-3, -2, 20, 30), range(9), range(6)),
        ((3.2, 2.2, 3.3, 2.3), [3], [2]),  # at least one pixel
        ((-4, -4, 0.2, 0.3), [0], [0]),
        ((8.8, 5.9, 12, 12), [8], [5]),
        ((-4, 1, 0, 4), [], []),  # beside the picture
        ((1, -4, 4, 0), [], []),
        ((9, 1, 12, 4), [], []),
        ((1, 6, 4, 9), [], []),
        ((9, 6, 12, 9), [], []),
        ((-4, -4, 0, 0), [], []),
    ],
)
def test_a_filled_box(box: Box, columns: list[int], rows: list[int]) -> None:
    wanted = np.zeros((6, 9), bool)
    wanted[np.ix_(list(rows), list(columns))] = True
    np.testing.assert_array_equal(box_mask(box, (9, 6)), wanted)

"""Windows round boxes and poses: their direct properties."""

from __future__ import annotations

import numpy as np
import pytest

from objects import CAMERA, bracket
from posekit.camera import Camera
from posekit.geometry import Pose, view_rotation
from posekit.zoom import box_window, frontal_camera, frontal_pose, zoom_to_box, zoom_to_pose

MODEL = bracket()
HULL = MODEL.hull_ctr
POSE = Pose(view_rotation([0.5, -1.0, 0.6]), np.array([0.1, -0.05, 0.7]))


@pytest.mark.parametrize("size", [(160, 120), (120, 160), (128, 128)])
@pytest.mark.parametrize("enlarge", [1.0, 1.4])
def test_a_poses_window_is_centred_and_as_wide_as_the_object(size: tuple[int, int], enlarge: float) -> None:
    zoom = zoom_to_pose(CAMERA, POSE, HULL, size, enlarge=enlarge)
    centre = zoom.camera.project(zoom.R_view_cam @ POSE.t)
    np.testing.assert_allclose(centre, [0.5 * size[0] - 0.5, 0.5 * size[1] - 0.5], atol=1e-9)
    away = np.abs(zoom.camera.project(POSE.apply(HULL) @ zoom.R_view_cam.T) - centre) / (0.5 * np.array(size))
    assert away.max() == pytest.approx(1 / enlarge), "the furthest point touches the border before it is enlarged"
    assert zoom.camera.fx == zoom.camera.fy and zoom.camera.size == size
    default = zoom_to_pose(CAMERA, POSE, HULL, size)
    assert default.camera.fx * 1.4 == pytest.approx(zoom_to_pose(CAMERA, POSE, HULL, size, enlarge=1.0).camera.fx)


def test_a_poses_window_holds_a_box_beside_it_too() -> None:
    box = (500.0, 300.0, 560.0, 340.0)
    zoom = zoom_to_pose(CAMERA, POSE, HULL, (160, 120), enlarge=1.0, box=box)
    corners = zoom.camera.project(CAMERA.box_corner_rays(box) @ zoom.R_view_cam.T) + 0.5
    assert (corners >= -1e-9).all() and (corners <= [160 + 1e-9, 120 + 1e-9]).all()
    assert np.isclose(corners, 160).any() or np.isclose(corners, 120).any()


def test_a_point_beside_the_camera_does_not_blow_the_window_up() -> None:
    near = Pose(np.eye(3), np.array([0.0, 0.0, 0.02]))
    points = np.array([[0.01, 0.0, -0.05], [0.0, 0.005, 0.0]])
    zoom = zoom_to_pose(CAMERA, near, points, (160, 120), enlarge=1.0)
    assert zoom.camera.fx == pytest.approx(80 / (0.01 / (0.1 * 0.02)))
    for t in ([0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, np.nan, 1.0]):
        with pytest.raises(ValueError, match="not in front"):
            zoom_to_pose(CAMERA, Pose(np.eye(3), np.array(t)), points, (160, 120))


@pytest.mark.parametrize("box", [(100.0, 80.0, 180.0, 120.0), (500.0, 300.0, 530.0, 420.0)])
@pytest.mark.parametrize("enlarge", [1.0, 1.3])
def test_a_boxs_window_touches_its_corners(box: tuple[float, float, float, float], enlarge: float) -> None:
    zoom = zoom_to_box(CAMERA, box, (160, 120), enlarge=enlarge)
    middle = np.array([[0.5 * (box[0] + box[2]) - 0.5, 0.5 * (box[1] + box[3]) - 0.5]])
    seen = zoom.camera.project(CAMERA.backproject(middle) @ zoom.R_view_cam.T)
    np.testing.assert_allclose(seen, [[79.5, 59.5]], atol=1e-9)
    corners = zoom.camera.project(CAMERA.box_corner_rays(box) @ zoom.R_view_cam.T)
    assert (np.abs(corners - [79.5, 59.5]) / [80, 60]).max() == pytest.approx(1 / enlarge)


def test_a_square_window_has_a_boxs_area() -> None:
    centred = Camera(500.0, 500.0, 319.5, 239.5, 640, 480)
    zoom = box_window(centred, (270.0, 215.0, 370.0, 265.0), 96, 0.5)
    corners = zoom.camera.project(centred.box_corner_rays((270.0, 215.0, 370.0, 265.0)) @ zoom.R_view_cam.T)
    width, height = np.ptp(corners, axis=0)
    assert np.sqrt(width * height) == pytest.approx(0.5 * 96) and width / height == pytest.approx(2.0)
    assert zoom.camera.size == (96, 96)


def test_a_square_window_far_from_the_middle_has_a_boxs_area_too() -> None:
    box = (560.0, 400.0, 639.0, 470.0)
    wide = Camera(300.0, 300.0, 319.5, 239.5, 640, 480)
    zoom = box_window(wide, box, 96, 0.4)
    width, height = np.ptp(zoom.camera.project(wide.box_corner_rays(box) @ zoom.R_view_cam.T), axis=0)
    assert np.sqrt(width * height) == pytest.approx(0.4 * 96)


def test_a_boxs_window_is_not_enlarged_unless_asked() -> None:
    box = (100.0, 80.0, 180.0, 120.0)
    assert zoom_to_box(CAMERA, box, (160, 120)).camera == zoom_to_box(CAMERA, box, (160, 120), enlarge=1.0).camera


def test_the_frontal_view_fills_its_camera() -> None:
    camera, distance = frontal_camera(MODEL, (160, 120))
    assert distance == pytest.approx(5 * MODEL.diameter) and camera.size == (160, 120)
    pose = frontal_pose(camera, distance, camera)
    seen = (np.abs(camera.project(pose.apply(HULL)) - [79.5, 59.5]) / [80, 60]).max()
    assert seen == pytest.approx(1.0)
    nearer = frontal_pose(camera, distance, Camera(camera.fx / 2, camera.fx / 2, 79.5, 59.5, 160, 120))
    np.testing.assert_allclose(nearer.t, [0, 0, 0.5 * distance])

"""Poses form a group, cameras invert themselves, a zoom may come before or after the projection."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from posekit.camera import Camera, Zoom, box_iou, mask_box, mask_iou
from posekit.errors import CameraError
from posekit.geometry import (
    Pose,
    PoseNoise,
    cube_views,
    fibonacci_sphere,
    quat_to_rotation,
    random_rotation,
    rotation_angle,
    rotation_between,
    rotation_to_quat,
    so3_exp,
    so3_log,
    view_rotation,
)
from posekit.view import View

settings.register_profile("posekit", deadline=None, max_examples=60, derandomize=True)
settings.load_profile("posekit")

unit = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.1)
sizes = st.one_of(st.floats(0, np.pi - 1e-3), st.floats(1e-9, 1e-6))  # radians; near the identity too
turns = st.builds(lambda axis, angle: axis / np.linalg.norm(axis) * angle, unit, sizes)
poses = st.builds(lambda w, t: Pose(so3_exp(w), t), turns, st.tuples(*[st.floats(-2, 2)] * 3).map(np.array))
cameras = st.builds(
    lambda f, stretch, cx, cy: Camera(f, f * stretch, cx, cy, 640, 480),
    st.floats(200, 2000), st.floats(0.8, 1.25), st.floats(200, 440), st.floats(150, 330),
)  # fmt: skip
points = st.lists(st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0.4, 3)), min_size=1, max_size=8).map(
    np.array
)


def same(a: Pose, b: Pose, tolerance: float = 1e-9) -> bool:
    return float(np.abs(a.matrix - b.matrix).max()) < tolerance


@given(poses, poses, poses)
def test_poses_are_a_group(a: Pose, b: Pose, c: Pose) -> None:
    assert same((a @ b) @ c, a @ (b @ c))
    assert same(a @ Pose.identity(), a)
    assert same(Pose.identity() @ a, a)
    assert same(a @ a.inverse(), Pose.identity())
    assert same((a @ b).inverse(), b.inverse() @ a.inverse())


@given(poses, poses, points)
def test_a_product_applies_the_right_factor_first(a: Pose, b: Pose, p: np.ndarray) -> None:
    np.testing.assert_allclose((a @ b).apply(p), a.apply(b.apply(p)), atol=1e-12)
    np.testing.assert_allclose(a.inverse().apply(a.apply(p)), p, atol=1e-12)


@given(turns)
def test_exp_and_log_are_inverse(w: np.ndarray) -> None:
    np.testing.assert_allclose(so3_log(so3_exp(w)), w, atol=1e-9)
    np.testing.assert_allclose(rotation_angle(so3_exp(w)), np.linalg.norm(w), atol=1e-9)


def test_tiny_turns_keep_their_digits() -> None:
    w = np.array([1e-7, -2e-7, 3e-7])
    np.testing.assert_allclose(so3_log(so3_exp(w)), w, rtol=1e-6)
    np.testing.assert_allclose(rotation_angle(so3_exp(w)), np.linalg.norm(w), rtol=1e-6)


@given(turns)
def test_quaternions_are_scalar_first_and_non_negative(w: np.ndarray) -> None:
    R, q = so3_exp(w), rotation_to_quat(so3_exp(w))
    angle = np.linalg.norm(w)
    assert q[0] >= 0
    np.testing.assert_allclose(q[0], np.cos(angle / 2), atol=1e-9)
    np.testing.assert_allclose(quat_to_rotation(q), R, atol=1e-9)
    np.testing.assert_allclose(quat_to_rotation(-3 * q), R, atol=1e-9)


@pytest.mark.parametrize("axis", np.eye(3))
def test_half_turns(axis: np.ndarray) -> None:
    R = so3_exp(axis * np.pi)
    np.testing.assert_allclose(rotation_angle(R), np.pi, atol=1e-12)
    np.testing.assert_allclose(so3_exp(so3_log(R)), R, atol=1e-9)


@given(poses)
def test_matrices_round_trip(pose: Pose) -> None:
    assert same(Pose.from_matrix(pose.matrix), pose)
    assert same(Pose.from_matrix(pose.matrix[:3]), pose)
    assert same(Pose(quat_to_rotation(pose.quat_wxyz), pose.t), pose)


@pytest.mark.parametrize("matrix", [np.zeros((4, 4)), np.diag([1, 1, -1, 1]), np.full((4, 4), np.nan), 2 * np.eye(4)])
def test_what_is_no_rotation_is_refused(matrix: np.ndarray) -> None:
    with pytest.raises(ValueError, match="not a rotation"):
        Pose.from_matrix(matrix)
    with pytest.raises(ValueError, match=r"shape \(4, 4\) or \(3, 4\), not \(3, 3\)"):
        Pose.from_matrix(matrix[:3, :3])


def test_poses_are_values() -> None:
    R = np.eye(3)
    pose = Pose(R, np.zeros(3))
    R[0, 0] = 5
    assert pose.R[0, 0] == 1
    with pytest.raises(ValueError, match="read-only"):
        pose.t[0] = 1


@given(unit, unit)
def test_rotation_between_is_the_smallest(a: np.ndarray, b: np.ndarray) -> None:
    cosine = a @ b / np.linalg.norm(a) / np.linalg.norm(b)
    if cosine < -0.99:
        return
    R = rotation_between(a, b)
    np.testing.assert_allclose(R @ a / np.linalg.norm(a), b / np.linalg.norm(b), atol=1e-9)
    np.testing.assert_allclose(rotation_angle(R), np.arccos(np.clip(cosine, -1, 1)), atol=1e-6)


def test_noise_is_bounded_and_of_the_asked_size() -> None:
    rng, noise = np.random.default_rng(0), PoseNoise()
    start = Pose(random_rotation(rng), [0.1, 0.2, 0.9])
    moved = [noise.disturb(start, rng) for _ in range(400)]
    angles = np.array([rotation_angle(p.R @ start.R.T) for p in moved])
    assert angles.max() <= np.deg2rad(45)
    assert 18 < np.rad2deg(np.sqrt((angles**2).mean())) < 26.5  # 15 sqrt(3) = 26, a little less for the limit
    np.testing.assert_allclose(np.std([p.t for p in moved], axis=0), [0.01, 0.01, 0.05], rtol=0.15)


def test_cube_views_are_six_different_faces_with_z_up() -> None:
    views = cube_views()
    forward = np.array([R[2] for R in views])
    np.testing.assert_allclose(forward[0], [0, 1, 0])
    np.testing.assert_allclose(np.abs(forward).sum(axis=1), 1)
    assert len(np.unique(forward.round(), axis=0)) == 6
    for R in views:
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) > 0
    np.testing.assert_allclose([R[1] @ [0, 0, 1] for R in views[:4]], -1)  # down in the picture is -z


def test_views_over_the_sphere_look_at_the_origin() -> None:
    directions = fibonacci_sphere(50)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    np.testing.assert_allclose(directions.mean(axis=0), 0, atol=0.02)
    for d in directions:
        np.testing.assert_allclose(view_rotation(d) @ -d, [0, 0, 1], atol=1e-12)


# --- cameras ---


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

"""Which 4:3 window to look at: round a box, or round a pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from posekit.camera import Box, Camera, Zoom
from posekit.geometry import Pose, cube_views, rotation_between
from posekit.mesh.model import ObjectModel

Array = NDArray[np.float64]

ENLARGE_POSE = 1.4  # DeepIM's lambda


def zoom_to_pose(
    camera: Camera,
    T_cam_ctr: Pose,
    outline: ArrayLike,
    size: tuple[int, int],
    *,
    enlarge: float = ENLARGE_POSE,
    box: Box | None = None,
) -> Zoom:
    """The window centred on a pose's origin, wide enough for the object and, where given, for a box.

    outline: (N, 3) points of the object in ``ctr`` whose hull is the object's (its convex hull's corners).
    box: where the object was seen (edges in the photograph), which may lie beside the pose. size: (width, height).
    Raises ValueError where the pose's origin is not in front of the camera.
    """
    if not T_cam_ctr.t[2] > 0 or not np.isfinite(T_cam_ctr.t).all():
        raise ValueError(f"the pose's origin {T_cam_ctr.t} is not in front of the camera")
    ray = T_cam_ctr.t / T_cam_ctr.t[2]
    points = T_cam_ctr.apply(outline)
    # a part of the object that is nearly beside the camera must not make the window too large
    points[:, 2] = np.maximum(points[:, 2], 0.1 * T_cam_ctr.t[2])
    if box is not None:
        points = np.concatenate([points, camera.box_corner_rays(box)])
    return Zoom.look_at(camera, ray, enlarge * _half_width(ray, points, size), size)


def zoom_to_box(camera: Camera, box: Box, size: tuple[int, int], *, enlarge: float = 1.0) -> Zoom:
    """The window centred on a box (edges), expanded to the crop's aspect ratio (paper, section 3.1)."""
    ray = camera.box_centre_ray(box)
    return Zoom.look_at(camera, ray, enlarge * _half_width(ray, camera.box_corner_rays(box), size), size)


def box_window(camera: Camera, box: Box, side: int, root: float) -> Zoom:
    """The square window centred on a box (edges) in which the square root of the box's area is ``root`` of the side.

    side: pixels."""
    ray = camera.box_centre_ray(box)
    turned = camera.box_corner_rays(box) @ rotation_between(ray, [0.0, 0.0, 1.0]).T
    width, height = np.ptp(turned[:, :2] / np.maximum(turned[:, 2:], 1e-6), axis=0)
    return Zoom.look_at(camera, ray, 0.5 * float(np.sqrt(width * height)) / root, (side, side))


def frontal_camera(model: ObjectModel, size: tuple[int, int]) -> tuple[Camera, float]:
    """The camera of MV-Net's views and the object's distance: a crop 4:3 round the frontal view's box.

    size: (width, height) in pixels.
    """
    distance = 5.0 * model.diameter
    frontal = Pose(cube_views()[0], np.array([0, 0, distance]))
    whole = Camera.from_fov(1.0, *size)
    return zoom_to_pose(whole, frontal, model.hull_ctr, size, enlarge=1.0).camera, distance


def frontal_pose(camera: Camera, distance: float, crop_camera: Camera) -> Pose:
    """The ``T_view_ctr`` to which MV-Net's output is relative: the frontal view in the middle of a crop, at the depth
    at which it looks as large there as in ``camera`` at ``distance`` (both from `frontal_camera`)."""
    return Pose(cube_views()[0], np.array([0, 0, distance * crop_camera.fx / camera.fx]))


def _half_width(ray: Array, points: Array, size: tuple[int, int]) -> float:
    """Tangent half width of the window round ``ray`` that holds the points (N, 3), at the aspect of ``size``."""
    turned = points @ rotation_between(ray, [0.0, 0.0, 1.0]).T
    tangent = np.abs(turned[:, :2] / np.maximum(turned[:, 2:], 1e-6)).max(axis=0)
    return float(max(tangent[0], tangent[1] * size[0] / size[1]))

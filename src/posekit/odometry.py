"""How an object moved from one frame to the next, by following points of its picture. Layer 3.

Corners of the last frame that lie on the object are followed into the next one (Lucas and Kanade, forwards and
backwards), and the pose that explains them starts the comparison with the mesh. It needs no mask of the new frame, and
it drifts: what corrects it is the comparison.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Zoom
from posekit.geometry import Pose
from posekit.object_model import ObjectModel
from posekit.pnp import solve_pnp
from posekit.render import Renderer
from posekit.view import View
from posekit.zoom import zoom_to_pose

SIZE = (320, 240)  # of the crops in which points are followed
WINDOW, LEVELS = (13, 13), 3
CORNERS, QUALITY, APART = 200, 0.005, 4  # at most; of the best one; pixels between two
AGAIN = 0.7  # pixels from where it started that a point followed forwards and backwards may end
LEAST = 12  # points
SCALE = 0.5  # pixels, expected error of a followed point


@dataclass(frozen=True, eq=False)
class Look:
    """A frame's crop round the object at a pose. seen: what the frame shows. drawn: the mesh there. T_cam_obj: the
    pose. T_view_cam: the crop's turn. size: (width, height) of the frame."""

    seen: View
    drawn: View
    T_cam_obj: Pose
    T_view_cam: Pose
    size: tuple[int, int]


def look(view: View, T_cam_obj: Pose, model: ObjectModel, renderer: Renderer) -> Look:
    """Raises ValueError where the pose is behind the camera."""
    zoom = zoom_to_pose(view.camera, T_cam_obj @ model.T_obj_ctr, model.outline - model.center, SIZE)
    T_view_cam = Pose.rotation(zoom.R_view_cam)
    [drawn] = renderer.render(model, [T_view_cam @ T_cam_obj], zoom.camera, rgb=False)
    return Look(view.zoomed(zoom), drawn, T_cam_obj, T_view_cam, view.camera.size)


def colours(at: Look) -> NDArray[np.float32]:
    """The share of each of 8 x 8 x 8 colours in what the frame shows inside the silhouette, flat; zeros where the
    silhouette is empty."""
    assert at.drawn.mask is not None
    counts = cv2.calcHist([at.seen.image], [0, 1, 2], at.drawn.mask.astype(np.uint8), [8, 8, 8], [0, 256] * 3).ravel()
    return np.asarray(counts / max(1.0, float(counts.sum())), np.float32)


@dataclass(frozen=True, eq=False)
class Followed:
    """pose: ``T_cam_obj`` in the next frame, None where too few points could be followed. share: of the points that
    could."""

    pose: Pose | None
    share: float


def follow_points(before: Look, after: View, model: ObjectModel) -> Followed:
    """From the last frame's crop into the next frame, which has the same size."""
    drawn, zoom_camera = before.drawn, before.drawn.camera
    assert drawn.mask is not None and drawn.coords is not None
    zoom = Zoom(after.camera, zoom_camera, before.T_view_cam.R)
    first, second = (cv2.cvtColor(v.image, cv2.COLOR_RGB2GRAY) for v in (before.seen, after.zoomed(zoom)))
    inside = cv2.erode(drawn.mask.astype(np.uint8), np.ones((5, 5), np.uint8))
    corners = cv2.goodFeaturesToTrack(first, CORNERS, QUALITY, APART, mask=inside)
    if corners is None or len(corners) < LEAST:
        return Followed(None, 0.0)
    places, steady = _followed(first, second, corners)
    if steady.sum() < LEAST:
        return Followed(None, float(steady.mean()))
    pixels = np.rint(corners[:, 0]).astype(int)
    points = drawn.coords[pixels[:, 1], pixels[:, 0]][steady] - model.center
    targets = (places - corners[:, 0] + pixels)[steady]
    start = before.T_view_cam @ before.T_cam_obj @ model.T_obj_ctr
    weights = np.ones(len(points))
    found = solve_pnp(points, targets, weights, SCALE * weights, zoom_camera, start)
    pose = None if found is None else before.T_view_cam.inverse() @ found @ model.T_obj_ctr.inverse()
    return Followed(pose, float(steady.mean()))


def _followed(
    first: NDArray[np.uint8], second: NDArray[np.uint8], corners: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Places (N, 2) in the second picture, and which of them lead back to where they came from."""
    there, ahead, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, None, winSize=WINDOW, maxLevel=LEVELS)
    back, behind, _ = cv2.calcOpticalFlowPyrLK(second, first, there, None, winSize=WINDOW, maxLevel=LEVELS)
    away = np.linalg.norm((back - corners)[:, 0], axis=1)
    return there[:, 0], (ahead.ravel() > 0) & (behind.ravel() > 0) & (away < AGAIN)

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
class Followed:
    """pose: ``T_cam_obj`` in the next frame, None where too few points could be followed. share: of the points that
    could."""

    pose: Pose | None
    share: float


def follow_points(before: View, after: View, T_cam_obj: Pose, model: ObjectModel, renderer: Renderer) -> Followed:
    """T_cam_obj: in the frame ``before``; it lies in front of the camera. Both frames have the same size."""
    zoom = zoom_to_pose(before.camera, T_cam_obj @ model.T_obj_ctr, model.outline - model.center, SIZE)
    T_view_cam = Pose.rotation(zoom.R_view_cam)
    [drawn] = renderer.render(model, [T_view_cam @ T_cam_obj], zoom.camera, rgb=False)
    assert drawn.mask is not None and drawn.coords is not None
    first, second = (cv2.cvtColor(v.zoomed(zoom).image, cv2.COLOR_RGB2GRAY) for v in (before, after))
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
    start = T_view_cam @ T_cam_obj @ model.T_obj_ctr
    weights = np.ones(len(points))
    found = solve_pnp(points, targets, weights, SCALE * weights, zoom.camera, start)
    pose = None if found is None else T_view_cam.inverse() @ found @ model.T_obj_ctr.inverse()
    return Followed(pose, float(steady.mean()))


def _followed(
    first: NDArray[np.uint8], second: NDArray[np.uint8], corners: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Places (N, 2) in the second picture, and which of them lead back to where they came from."""
    there, ahead, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, None, winSize=WINDOW, maxLevel=LEVELS)
    back, behind, _ = cv2.calcOpticalFlowPyrLK(second, first, there, None, winSize=WINDOW, maxLevel=LEVELS)
    away = np.linalg.norm((back - corners)[:, 0], axis=1)
    return there[:, 0], (ahead.ravel() > 0) & (behind.ravel() > 0) & (away < AGAIN)

"""How an object moved from one frame to the next, by following points of its picture. Layer 3.

Corners of the last frame that lie on the object are followed into the next one (Lucas and Kanade, forwards and
backwards). It needs no mask of the new frame, and it drifts: what corrects it is the comparison with the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Zoom
from posekit.fusion import Points
from posekit.geometry import Pose
from posekit.object_model import ObjectModel
from posekit.view import View

WINDOW, LEVELS = (13, 13), 3
CORNERS, QUALITY, APART = 200, 0.005, 3  # at most; of the best one; pixels between two
AGAIN = 0.7  # pixels from where it started that a point followed forwards and backwards may end
LEAST = 6  # points
SIGMA, TOGETHER = 0.5, 3.0  # pixels, expected error of a followed point; so many err alike


@dataclass(frozen=True, eq=False)
class Look:
    """A frame's crop round the object, and the mesh drawn there.

    seen: what the frame shows. drawn: with image, mask and coords, at ``T_view_ctr``. visible: (H, W), where the crop
    shows the object rather than something before it.
    """

    seen: View
    drawn: View
    T_view_ctr: Pose
    visible: NDArray[np.bool_]

    def again(self, view: View) -> View:
        """The same crop of the next frame."""
        return view.zoomed(Zoom(view.camera, self.seen.camera, self.seen.R_view_cam))


def follow_points(before: Look, pose: Pose, after: View, model: ObjectModel) -> Points | None:
    """Points of the object, and where they are in the next frame.

    before: the last frame's crop; pose: ``T_view_ctr`` in it, near the one at which it was drawn. after: the same crop
    of the next frame. None where too few can be followed.
    """
    drawn, camera = before.drawn, before.drawn.camera
    assert drawn.mask is not None and drawn.coords is not None
    first, second = (cv2.cvtColor(v.image, cv2.COLOR_RGB2GRAY) for v in (before.seen, after))
    solid = drawn.mask & before.visible & before.seen.shown & after.shown
    inside = cv2.erode(solid.astype(np.uint8), np.ones((5, 5), np.uint8))
    corners = cv2.goodFeaturesToTrack(first, CORNERS, QUALITY, APART, mask=inside)
    if corners is None or len(corners) < LEAST:
        return None
    places, steady = _followed(first, second, corners)
    corners = corners[:, 0]
    # which point of the mesh is seen at a corner: the one drawn where the corner was, before the pose was corrected
    here = drawn.coords[tuple(np.rint(corners).astype(int).T[::-1])] - model.center
    corrected = camera.project(pose.apply(here)) - camera.project(before.T_view_ctr.apply(here))
    columns, rows = np.clip(np.rint(corners - corrected).astype(int), 0, np.array(camera.size) - 1).T
    steady &= drawn.mask[rows, columns]
    if steady.sum() < LEAST:
        return None
    points = drawn.coords[rows, columns][steady].astype(np.float64) - model.center
    targets = camera.project(pose.apply(points)) + (places - corners)[steady]
    return Points(points, targets, np.ones(len(points)), np.full(len(points), SIGMA), together=TOGETHER)


def _followed(
    first: NDArray[np.uint8], second: NDArray[np.uint8], corners: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Places (N, 2) in the second picture, and which of them lead back to where they came from."""
    there, ahead, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, None, winSize=WINDOW, maxLevel=LEVELS)
    back, behind, _ = cv2.calcOpticalFlowPyrLK(second, first, there, None, winSize=WINDOW, maxLevel=LEVELS)
    away = np.linalg.norm((back - corners)[:, 0], axis=1)
    return there[:, 0], (ahead.ravel() > 0) & (behind.ravel() > 0) & (away < AGAIN)

"""Points that are followed, from one frame to the next and from the drawn mesh to the frame.

Corners of the last frame that lie on the object are followed into the next one (Lucas and Kanade, forwards and
backwards). It needs no mask of the new frame, and it drifts. Corners of the mesh as it is drawn, followed into the
frame, do not drift; they need a texture that the mesh has too.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.align.colour_edge import Outline, find_outline
from posekit.align.gauss_newton import Points
from posekit.camera import Zoom
from posekit.geometry import Pose
from posekit.mesh.model import ObjectModel
from posekit.view import View

WINDOW, LEVELS = (13, 13), 3
CORNERS, QUALITY, LEAST_DISTANCE = 200, 0.005, 3  # at most; of the best one; pixels between two
MOST_RETURN_ERROR = 0.7  # pixels from where it started that a point followed forwards and backwards may end
LEAST = 6  # points
# pixels, expected error of a followed point; the number of neighbours whose errors are correlated
SIGMA, CORRELATED = 0.5, 3.0
# the same where the mesh's drawing is matched with the frame; and how far off a match may be, pixels
TEXTURE_QUALITY, TEXTURE_SIGMA, TEXTURE_CORRELATED, FARTHEST = 0.02, 1.0, 0.7, 5.0
TEXTURE_LEVELS = 1  # of the pyramid for that: in a coarser one a small object's surroundings, which differ, take part
CORRELATION_RANGE = (0.5, 0.8)  # correlations of patches from which on a match counts, and counts wholly
PATCH, CONTRAST_SIGMA, LEAST_CONTRAST = 9, 4.0, 4.0  # pixels; pixels; grey values below which contrast is noise


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A frame's crop round the object, and the mesh drawn there.

    seen: what the frame shows. drawn: with image, mask and coords, at ``T_view_ctr``. visible: (H, W), where the crop
    shows the object rather than something before it.
    """

    seen: View
    drawn: View
    T_view_ctr: Pose
    visible: NDArray[np.bool_]

    @cached_property
    def grey(self) -> NDArray[np.uint8]:
        """What the frame shows (H, W)."""
        return np.asarray(cv2.cvtColor(self.seen.image, cv2.COLOR_RGB2GRAY))

    @cached_property
    def corners(self) -> NDArray[np.float32]:
        """Pixels (N, 1, 2) of the object that can be followed into the next frame."""
        assert self.drawn.mask is not None
        solid = self.drawn.mask & self.visible & self.seen.shown
        inside = cv2.erode(solid.astype(np.uint8), np.ones((5, 5), np.uint8))
        corners = cv2.goodFeaturesToTrack(self.grey, CORNERS, QUALITY, LEAST_DISTANCE, mask=inside)
        return np.zeros((0, 1, 2), np.float32) if corners is None else np.asarray(corners, np.float32)

    @cached_property
    def outline(self) -> Outline:
        """Of the drawn mesh."""
        assert self.drawn.mask is not None
        return find_outline(self.drawn.mask)

    def prepare(self) -> None:
        """Find now what the next frame is going to need."""
        self.corners, self.outline  # noqa: B018 - they keep what they find

    def again(self, view: View) -> View:
        """The same crop of the next frame."""
        return view.zoomed(Zoom(view.camera, self.seen.camera, self.seen.R_view_cam))


def follow_points(before: Keyframe, pose: Pose, after: View, model: ObjectModel) -> Points | None:
    """Points of the object, and where they are in the next frame.

    before: the last frame's crop; pose: ``T_view_ctr`` in it, near the one at which it was drawn. after: the same crop
    of the next frame. None where too few can be followed.
    """
    drawn, camera, corners = before.drawn, before.drawn.camera, before.corners
    assert drawn.mask is not None and drawn.coords is not None
    second = cv2.cvtColor(after.image, cv2.COLOR_RGB2GRAY)
    shown = cv2.erode(after.shown.astype(np.uint8), np.ones((5, 5), np.uint8))
    corners = corners[shown[tuple(corners[:, 0].astype(int).T[::-1])] > 0]
    if len(corners) < LEAST:
        return None
    places, steady = _followed(before.grey, second, corners)
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
    return Points(points, targets, np.ones(len(points)), np.full(len(points), SIGMA), correlated=CORRELATED)


def match_texture(keyframe: Keyframe, model: ObjectModel) -> Points | None:
    """Points of the mesh, as drawn, and where the frame shows the same texture; None where too few are similar.

    Both pictures are compared by their local contrast on the object, since the light and the surroundings differ.
    """
    drawn, camera = keyframe.drawn, keyframe.drawn.camera
    assert drawn.mask is not None and drawn.coords is not None
    solid = drawn.mask & keyframe.visible & keyframe.seen.shown
    first, second = (
        _contrast(drawn.image, drawn.mask, drawn.mask),
        _contrast(keyframe.seen.image, solid, cv2.dilate(solid.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0),
    )
    inside = cv2.erode(solid.astype(np.uint8), np.ones((7, 7), np.uint8))
    corners = cv2.goodFeaturesToTrack(first, CORNERS, TEXTURE_QUALITY, LEAST_DISTANCE, mask=inside)
    if corners is None or len(corners) < LEAST:
        return None
    places, steady = _followed(first, second, corners, TEXTURE_LEVELS)
    corners = corners[:, 0]
    steady &= np.linalg.norm(places - corners, axis=1) < FARTHEST
    if steady.sum() < LEAST:
        return None
    corners, places = corners[steady], places[steady]
    columns, rows = np.rint(corners).astype(int).T
    least, best = CORRELATION_RANGE
    weight = np.clip((_correlation(first, second, corners, places) - least) / (best - least), 0, 1).astype(np.float64)
    if (weight > 0).sum() < LEAST:
        return None
    points = drawn.coords[rows, columns].astype(np.float64) - model.center
    targets = camera.project(keyframe.T_view_ctr.apply(points)) + (places - corners)
    return Points(points, targets, weight, np.full(len(points), TEXTURE_SIGMA), correlated=TEXTURE_CORRELATED)


def _contrast(image: NDArray[np.uint8], mask: NDArray[np.bool_], kept: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Grey values (H, W) less the mean of what the mask shows round them, over its spread; 128 where not kept."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    weight = mask.astype(np.float32) + np.float32(1e-3)
    share = cv2.GaussianBlur(weight, (0, 0), CONTRAST_SIGMA)
    centred = grey - cv2.GaussianBlur(grey * weight, (0, 0), CONTRAST_SIGMA) / share
    spread = np.sqrt(cv2.GaussianBlur(centred * centred * weight, (0, 0), CONTRAST_SIGMA) / share) + LEAST_CONTRAST
    return np.where(kept, np.clip(128 + 40 * centred / spread, 0, 255), 128).astype(np.uint8)


def _correlation(
    first: NDArray[np.uint8], second: NDArray[np.uint8], corners: NDArray[np.float32], places: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Correlation (N,), -1 to 1, of the first picture round each corner with the second round its place."""
    one, other = _patches(first, corners), _patches(second, places)
    return np.asarray((one * other).sum(axis=1))


def _patches(picture: NDArray[np.uint8], centres: NDArray[np.float32]) -> NDArray[np.float32]:
    """Pixels round each centre (N, 2), without mean and of length one: (N, PATCH**2)."""
    reach = np.arange(PATCH) - PATCH // 2
    offsets = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    at = np.clip(np.rint(centres)[:, None].astype(int) + offsets, 0, np.array(picture.shape[::-1]) - 1)
    values = picture[at[..., 1], at[..., 0]].astype(np.float32)
    values -= values.mean(axis=1, keepdims=True)
    return np.asarray(values / (np.linalg.norm(values, axis=1, keepdims=True) + 1))


def _followed(
    first: NDArray[np.uint8], second: NDArray[np.uint8], corners: NDArray[np.float32], levels: int = LEVELS
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Places (N, 2) in the second picture, and which of them lead back to where they came from."""
    there, ahead, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, None, winSize=WINDOW, maxLevel=levels)
    back, behind, _ = cv2.calcOpticalFlowPyrLK(second, first, there, None, winSize=WINDOW, maxLevel=levels)
    away = np.linalg.norm((back - corners)[:, 0], axis=1)
    return there[:, 0], (ahead.ravel() > 0) & (behind.ravel() > 0) & (away < MOST_RETURN_ERROR)

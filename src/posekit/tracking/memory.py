"""What is kept of an object while it is followed, to find it again after it was lost.

A few frames' crops from different sides, each with its pose. When the object is lost, their local features are matched
with the new frame, and their silhouettes are looked for where the frame has the object's colours. So an object is found
by how it looks in the video, whatever the mesh's own colours.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.align.colour_edge import Colours
from posekit.camera import Zoom
from posekit.first_pose.features import FeatureModel, FeatureSearch
from posekit.geometry import Pose, rotation_between
from posekit.mesh.model import ObjectModel
from posekit.render import Renderer
from posekit.tracking.points import Keyframe
from posekit.view import View

FArray = NDArray[np.float32]
Mask = NDArray[np.bool_]

MOST = 24  # views that are kept
APART = math.radians(15.0)  # between the directions of two of them
SIZE = 320, 240  # of a kept crop, pixels
WIDTH = 160  # of the frame in which silhouettes are looked for, pixels
SCALES = (0.75, 1.0, 1.33)  # of a silhouette, to its size at the last known distance
LOOKED_FOR = 12  # kept views whose silhouettes are looked for, those nearest to the last one
LEAST_AREA, RING = 12, 3  # pixels of a silhouette that is looked for, and of its surroundings
LEAST_SHOWN = 0.6  # share of a silhouette that a kept view shows


@dataclass(frozen=True, eq=False)
class KeptView:
    """A frame's crop round the object. seen: of `SIZE` pixels. T_view_ctr: the pose. silhouette, visible: (H, W), of
    the rendering and what of it is seen, in a crop of the same window. direction: (3,), unit, from the object's centre
    to the camera, in ``ctr``."""

    seen: View
    T_view_ctr: Pose
    silhouette: Mask
    visible: Mask
    direction: NDArray[np.float64]


class Memory:
    """Views of an object from different sides, at most `MOST`, and the search by them."""

    def __init__(self, model: ObjectModel, renderer: Renderer) -> None:
        self.model, self.renderer = model, renderer
        self.views: list[KeptView] = []
        self._features: FeatureModel | None = None

    def wants(self, T_view_ctr: Pose) -> bool:
        """Whether no view like this one is kept."""
        direction = _direction(T_view_ctr)
        return all(float(direction @ kept.direction) < math.cos(APART) for kept in self.views)

    def keep(self, view: View, keyframe: Keyframe, T_view_ctr: Pose) -> None:
        """A frame's view. keyframe: its crop; T_view_ctr: its pose in the crop's camera. Where there are too many, one
        of the two that are most alike is dropped. Nothing is kept of an object that is hidden for the most part."""
        silhouette = keyframe.drawn.mask
        assert silhouette is not None
        visible = silhouette & keyframe.visible & keyframe.seen.shown
        if visible.sum() < LEAST_SHOWN * silhouette.sum():
            return
        window = Zoom(view.camera, keyframe.seen.camera.resized(*SIZE), keyframe.seen.R_view_cam)
        kept = KeptView(view.zoomed(window), T_view_ctr, silhouette, visible, _direction(T_view_ctr))
        self.views.append(kept)
        self._features = None
        if len(self.views) > MOST:
            directions = np.stack([each.direction for each in self.views])
            alike = directions @ directions.T - 2 * np.eye(len(directions))
            del self.views[int(np.argmax(alike.max(axis=1)))]

    def by_features(self, view: View) -> list[Pose]:
        """``T_cam_obj`` by local features of the kept views, matched with a frame; none where they have too few."""
        if not self.views:
            return []
        if self._features is None:
            self._features = FeatureModel.of_views([self._drawn(kept) for kept in self.views])
        found = FeatureSearch(self.model, self.renderer, features=self._features).search(view)
        return [each.T_cam_obj for each in found]

    def by_colours(self, view: View, colours: Colours, last: Pose, count: int) -> list[Pose]:
        """``T_cam_obj`` where kept silhouettes separate the object's colours from others best, best first, at most
        ``count``. last: the last known ``T_cam_ctr``, whose distance is taken."""
        small = view.camera.resized(WIDTH, max(1, round(WIDTH * view.camera.height / view.camera.width)))
        chance = colours.posterior(cv2.resize(view.image, small.size, interpolation=cv2.INTER_AREA))
        distance = float(np.linalg.norm(last.t))
        ray = rotation_between(last.t, [0.0, 0.0, 1.0])
        seen_from = _direction(Pose(ray @ last.R, np.array([0.0, 0.0, distance])))
        nearest = sorted(self.views, key=lambda kept: -float(seen_from @ kept.direction))[:LOOKED_FOR]
        peaks = []
        for kept in nearest:
            for scale in SCALES:
                factor = small.fx / kept.seen.camera.fx * SIZE[0] / kept.silhouette.shape[1]
                kept_distance = float(np.linalg.norm(kept.T_view_ctr.t))
                kernel = _kernel(kept.silhouette, factor * scale * kept_distance / distance)
                if kernel is None:
                    continue
                fit = cv2.filter2D(chance, cv2.CV_32F, kernel, borderType=cv2.BORDER_REPLICATE)
                _, best, _, at = cv2.minMaxLoc(fit)
                peaks.append((best, at, kept, distance / scale))
        peaks.sort(key=lambda peak: -peak[0])
        found = []
        for _, (u, v), kept, far in peaks[:count]:
            [ray_there] = small.backproject(np.array([[u, v]], np.float64), np.ones(1))
            R_view_cam = rotation_between(ray_there, [0.0, 0.0, 1.0])
            T_view_ctr = Pose(kept.T_view_ctr.R, np.array([0.0, 0.0, far]))
            found.append(Pose.rotation(R_view_cam.T) @ T_view_ctr @ self.model.T_ctr_obj)
        return found

    def _drawn(self, kept: KeptView) -> tuple[View, Pose]:
        """A kept view with where it shows the object, and the mesh's depth there."""
        pose = kept.T_view_ctr @ self.model.T_ctr_obj
        [drawn] = self.renderer.render(self.model, [pose], kept.seen.camera, rgb=False)
        assert drawn.mask is not None
        visible = cv2.resize(kept.visible.astype(np.uint8), SIZE, interpolation=cv2.INTER_NEAREST) > 0
        return replace(kept.seen, mask=drawn.mask & visible, depth=drawn.depth), kept.T_view_ctr


def _direction(T_view_ctr: Pose) -> NDArray[np.float64]:
    """From the object's centre to the camera, in ``ctr``, unit."""
    towards = -T_view_ctr.R.T @ T_view_ctr.t
    return np.asarray(towards / max(float(np.linalg.norm(towards)), 1e-9))


def _kernel(silhouette: Mask, factor: float) -> FArray | None:
    """Weights whose sum with a picture is its mean inside a silhouette less that in a ring round it, the silhouette
    enlarged by ``factor``; None where too little is left of it."""
    height, width = silhouette.shape
    size = 2 * (max(1, round(factor * width)) // 2) + 1, 2 * (max(1, round(factor * height)) // 2) + 1
    solid = cv2.resize(silhouette.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
    if solid.sum() < LEAST_AREA:
        return None
    solid = np.pad(solid, RING + 1)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * RING + 1, 2 * RING + 1))
    ring = (cv2.dilate(solid.astype(np.uint8), disc) > 0) & ~solid
    return np.asarray(solid / solid.sum() - ring / max(1, ring.sum()), np.float32)


def distinct(poses: Sequence[Pose], model: ObjectModel) -> list[Pose]:
    """Those of ``T_cam_obj`` that differ from earlier ones by over 10 degrees or a tenth of a diameter."""
    kept: list[Pose] = []
    for pose in poses:
        turns = [math.acos(float(np.clip((np.trace(pose.R.T @ k.R) - 1) / 2, -1, 1))) for k in kept]
        shifts = [float(np.linalg.norm(pose.apply(model.center) - k.apply(model.center))) for k in kept]
        if all(t > APART * 2 / 3 or s > 0.1 * model.diameter for t, s in zip(turns, shifts, strict=True)):
            kept.append(pose)
    return kept

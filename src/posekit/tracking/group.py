"""Several objects in one video: each is told where the others hide it."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.errors import CameraError
from posekit.geometry import Pose
from posekit.render import Renderer
from posekit.tracking.tracker import TRACKED, Tracked, Tracker
from posekit.view import View

WIDTH = 320  # pixels, at most, of the pictures in which objects are compared by depth
REACH = 1  # pixels of them by which a hidden part is enlarged: poses are a little wrong

Mask = NDArray[np.bool_]


class TrackerGroup:
    """Follows several objects from frame to frame, one tracker each, in threads.

    Before a frame, every object that was followed in the last one is drawn where its motion leads. What lies behind
    another object is marked as not visible, so that neither the other one's colours nor its outline are taken for the
    object's own. trackers: may be added to between frames; each is used by one thread at a time.
    """

    def __init__(self, trackers: Sequence[Tracker]) -> None:
        self.trackers = list(trackers)

    @cached_property
    def _threads(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(thread_name_prefix="posekit-tracker")

    @cached_property
    def _renderer(self) -> Renderer:
        return Renderer()

    def step(self, image: NDArray[np.uint8], camera: Camera | None = None, valid: Mask | None = None) -> list[Tracked]:
        """The objects in the next frame, in the order of the trackers. image: uint8 RGB (H, W, 3). valid: as a `View`
        has it. Raises CameraError where no camera is known."""
        if len(self.trackers) < 2:
            return [tracker.step(image, camera, valid) for tracker in self.trackers]
        known = camera or self.trackers[0].camera
        if known is None:
            raise CameraError("the trackers were made without a camera: pass one with each frame.")
        hidden = self.hidden(known)
        masks = [valid if each is None else ~each if valid is None else valid & ~each for each in hidden]
        steps = [
            self._threads.submit(tracker.step, image, known, mask)
            for tracker, mask in zip(self.trackers, masks, strict=True)
        ]
        return [step.result() for step in steps]

    def hidden(self, camera: Camera) -> list[Mask | None]:
        """Of each object, the pixels (H, W) of the next frame at which another one is nearer to the camera, if the last
        motions are repeated; None where there are none, or where it was not followed. Only objects that were tracked
        in the last frame hide others."""
        width = min(WIDTH, camera.width)
        small = camera.resized(width, max(1, round(camera.height * width / camera.width)))
        poses = [tracker.expected for tracker in self.trackers]
        drawn = [self._drawn(tracker, pose, small) for tracker, pose in zip(self.trackers, poses, strict=True)]
        return [self._behind(k, pose, drawn, camera) for k, pose in enumerate(poses)]

    def _drawn(self, tracker: Tracker, pose: Pose | None, camera: Camera) -> View | None:
        if pose is None:
            return None
        [drawn] = self._renderer.render(tracker.drawn, [pose], camera, rgb=False)
        return drawn

    def _behind(self, k: int, pose: Pose | None, drawn: Sequence[View | None], camera: Camera) -> Mask | None:
        """Of the k-th object, at a ``T_cam_obj``."""
        own = drawn[k]
        if own is None or pose is None:
            return None
        assert own.mask is not None and own.depth is not None
        centre = float(pose.apply(self.trackers[k].model.center)[2])
        own_depth = np.where(own.mask, own.depth, centre)
        behind = np.zeros(own.mask.shape, np.bool_)
        for other, tracker in zip(drawn, self.trackers, strict=True):
            if other is None or other is own or tracker.last is None or tracker.last.state != TRACKED:
                continue
            assert other.mask is not None and other.depth is not None
            behind |= other.mask & (other.depth < own_depth)
        if not behind.any():
            return None
        enlarged = cv2.dilate(behind.astype(np.uint8), np.ones((2 * REACH + 1, 2 * REACH + 1), np.uint8))
        return np.asarray(cv2.resize(enlarged, camera.size, interpolation=cv2.INTER_NEAREST) > 0)

"""Tracker: the last pose seeds the next frame's. Layer 5.

Paper, section 3.4: the first frame is estimated and refined; each next frame starts from the last pose. A predicted
angle above 25 degrees restarts with a new first pose, one below 2 degrees leaves the pose as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.errors import CameraError, ConfigError
from posekit.estimate import PoseEstimator
from posekit.geometry import Pose, so3_exp, so3_log
from posekit.object_model import ObjectModel
from posekit.refine import RefineOptions
from posekit.results import Detection, Estimate
from posekit.view import View

TRACKED, RESTARTED, LOST = "tracked", "restarted", "lost"
MASKS = ("pose", "none")


class Finder(Protocol):
    """Whatever finds objects in a photograph, such as posekit.detect's and posekit.novel's detectors."""

    def detect(self, view: View, models: Sequence[ObjectModel]) -> list[Detection]: ...


@dataclass(frozen=True)
class TrackOptions:
    """restart_deg, stop_deg: predicted angles of the paper, degrees. iterations: of a frame at most. prior: share of
    the last frame's motion that the next one is expected to repeat; 0 = none. mask: what a frame's mask is taken to be,
    the silhouette at the expected pose ("pose") or nothing ("none"). least: score (as of an Estimate, without a mask)
    below which the pose is not believed. doubts: frames in a row that it may not be believed. search: frames between
    two attempts to find an object that is lost. first: least score of a first pose."""

    restart_deg: float = 25.0
    stop_deg: float = 2.0
    iterations: int = 2
    prior: float = 0.5
    mask: str = "pose"
    least: float = 0.55
    doubts: int = 3
    search: int = 10
    first: float = 0.35

    def __post_init__(self) -> None:
        if not 0 < self.stop_deg < self.restart_deg <= 180:
            raise ConfigError(
                f"the stop angle is above 0 and below the restart angle, which is at most 180 degrees; not "
                f"{self.stop_deg:g} and {self.restart_deg:g}."
            )
        if min(self.iterations, self.doubts, self.search) < 1 or not 0 <= self.prior <= 1:
            raise ConfigError("iterations, doubts and search are at least 1, and prior is in [0, 1].")
        if self.mask not in MASKS:
            raise ConfigError(f"mask is one of {', '.join(MASKS)}, not {self.mask!r}.")


@dataclass(frozen=True, eq=False)
class Tracked:
    """What a frame says about the object. state: "tracked", "restarted" (a new first pose) or "lost". estimate: None
    where it is lost."""

    state: str
    estimate: Estimate | None = None

    @property
    def T_cam_obj(self) -> Pose | None:
        return None if self.estimate is None else self.estimate.T_cam_obj

    @property
    def angle(self) -> float | None:
        """The predicted rotation error, radians."""
        return None if self.estimate is None else self.estimate.angle


class Tracker:
    """Follows one object from frame to frame. Its memory does not grow with the number of frames.

    camera: of all frames, unless `step` is given another. pose: ``T_cam_obj`` in the first frame, where it is known.
    estimator: of this model; made with the shipped weights where it is not given. detector: finds the object in the
    first frame and when it is lost; without one a lost object stays lost.
    Not thread-safe: one tracker per thread. Raises ConfigError where neither pose nor detector is given.
    """

    def __init__(
        self,
        model: ObjectModel,
        camera: Camera | None = None,
        *,
        pose: Pose | None = None,
        estimator: PoseEstimator | None = None,
        detector: Finder | None = None,
        options: TrackOptions = TrackOptions(),
    ) -> None:
        if pose is None and detector is None:
            raise ConfigError("a tracker needs the first pose, or a detector that finds the object.")
        self.model, self.camera, self.options = model, camera, options
        self.estimator = estimator or PoseEstimator(model)
        self.detector = detector
        self._pose = pose
        self._motion = Pose.identity()  # of the object's centre and axes, from the frame before the last to the last
        self._doubts = 0
        self._waiting = 0  # frames until the next search

    def step(self, image: NDArray[np.uint8], camera: Camera | None = None) -> Tracked:
        """The object in the next frame. image: uint8 RGB (H, W, 3). Raises CameraError where no camera is known."""
        chosen = camera or self.camera
        if chosen is None:
            raise CameraError("the tracker was made without a camera: pass one with each frame.")
        view = View(image, chosen)
        if self._pose is None:
            return self._find(view)
        found = self._follow(view, self._pose)
        if found is None or found.angle > np.deg2rad(self.options.restart_deg):
            self._lose()
            return self._find(view)
        self._doubts = 0 if found.score >= self.options.least else self._doubts + 1
        if self._doubts >= self.options.doubts:
            self._lose()
            return self._find(view)
        self._motion = self._moved(self._pose, found.T_cam_obj)
        self._pose = found.T_cam_obj
        return Tracked(TRACKED, found)

    # --- inside ---

    def _follow(self, view: View, last: Pose) -> Estimate | None:
        """Refined from where the object is expected; None where it has left the picture."""
        start = self._expected(last)
        options = self.options
        seen = view
        if options.mask == "pose":
            [drawn] = self.estimator.renderer.render(self.model, [start], view.camera, rgb=False, coords=False)
            assert drawn.mask is not None
            if not drawn.mask.any():
                return None
            seen = view.with_mask(drawn.mask)
        update = "correspondence" if self.estimator.predictor.dense else "regression"
        loop = RefineOptions(update, "angle", options.iterations, float(np.deg2rad(options.stop_deg)), patience=50)
        found = self.estimator.refine(seen, start, loop)
        height, width = view.image.shape[:2]
        x0, y0, x1, y1 = found.box
        gone = x1 <= 0 or y1 <= 0 or x0 >= width or y0 >= height
        return None if gone else found

    def _expected(self, last: Pose) -> Pose:
        """Constant velocity, damped: the share ``prior`` of the last motion once more, about the object's centre."""
        share = self.options.prior
        centred = last @ self.model.T_obj_ctr
        R = so3_exp(so3_log(self._motion.R) * share) @ centred.R
        return Pose(R, centred.t + share * self._motion.t) @ self.model.T_obj_ctr.inverse()

    def _moved(self, before: Pose, after: Pose) -> Pose:
        a, b = before @ self.model.T_obj_ctr, after @ self.model.T_obj_ctr
        return Pose(b.R @ a.R.T, b.t - a.t)

    def _lose(self) -> None:
        self._pose, self._motion, self._doubts, self._waiting = None, Pose.identity(), 0, 0

    def _find(self, view: View) -> Tracked:
        """A new first pose, where there is one. A search takes seconds, so not every frame is searched."""
        self._waiting -= 1
        if self.detector is None or self._waiting > 0:
            return Tracked(LOST)
        self._waiting = self.options.search
        detections = [d for d in self.detector.detect(view, [self.model]) if d.label in (None, self.model.name)]
        found = max(self.estimator.estimate(view, detections), key=lambda e: e.score, default=None)
        if found is None or found.score < self.options.first:
            return Tracked(LOST)
        self._pose, self._waiting = found.T_cam_obj, 0
        return Tracked(RESTARTED, found)

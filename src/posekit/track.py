"""Tracker: the last pose seeds the next frame's. Layer 5.

Paper, section 3.4: the first frame is estimated and refined; each next frame starts from the last pose. A predicted
angle above 25 degrees restarts with a new first pose, one below 2 degrees leaves the pose as it is. What goes beyond
the paper, and why, is in docs/tracking.md.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.errors import CameraError, ConfigError
from posekit.estimate import PoseEstimator
from posekit.geometry import Pose, rotation_angle, so3_exp, so3_log
from posekit.nets.predictor import PairPrediction, Predictor
from posekit.object_model import ObjectModel
from posekit.odometry import Look, colours, follow_points, look
from posekit.refine import compare, predicted_angle, update_pose
from posekit.results import Detection, Estimate
from posekit.view import View

TRACKED, RESTARTED, LOST = "tracked", "restarted", "lost"
MASKS, MOTIONS, RUNTIMES = ("pose", "none"), ("points", "velocity", "none"), ("openvino", "torch")
NEAR = 0.6  # diameters, the least distance of an object's centre that is believed


class Finder(Protocol):
    """Whatever finds objects in a photograph, such as posekit.detect's and posekit.novel's detectors."""

    def detect(self, view: View, models: Sequence[ObjectModel]) -> list[Detection]: ...


@dataclass(frozen=True)
class TrackConfig:
    """restart_deg, still_deg: predicted angles that restart, and that leave the pose where the comparison started, both
    degrees. iterations: comparisons of a frame at most; a second one follows a turn of more than ``again_deg``.
    motion: where a frame's comparison starts: where followed points lead ("points"), the share ``prior`` of the last
    motion once more ("velocity"), or the last pose ("none"). mask: what a frame's mask is taken to be, the silhouette
    where the comparison starts ("pose") or nothing ("none"). gain: share of the comparison's update that is made.
    alike: likeness of the colours inside the silhouette to what they were (overlap of their histograms), below which a
    pose is in doubt. learn: share of a frame in what they were. least_inside: share of the silhouette's box in the
    picture, likewise. doubts: frames in a row after which the object is lost. search: frames between two attempts to
    find it. first: least score of a first pose. runtime: of the network."""

    restart_deg: float = 25.0
    still_deg: float = 2.0
    again_deg: float = 8.0
    iterations: int = 1
    motion: str = "points"
    prior: float = 0.7
    mask: str = "pose"
    gain: float = 1.0
    alike: float = 0.65
    learn: float = 0.02
    least_inside: float = 0.3
    doubts: int = 3
    search: int = 5
    first: float = 0.35
    runtime: str = "openvino"

    def __post_init__(self) -> None:
        if not 0 <= self.still_deg < self.restart_deg <= 180:
            raise ConfigError(
                f"the angle that leaves a pose is from 0 on and below the one that restarts, which is at most 180 "
                f"degrees; not {self.still_deg:g} and {self.restart_deg:g}."
            )
        if min(self.iterations, self.doubts, self.search) < 1:
            raise ConfigError("iterations, doubts and search are at least 1.")
        if not (0 <= self.prior <= 1 and 0 <= self.gain <= 1 and 0 <= self.least_inside <= 1):
            raise ConfigError("prior, gain and least_inside are shares between 0 and 1.")
        for name, known in (("mask", MASKS), ("motion", MOTIONS), ("runtime", RUNTIMES)):
            if getattr(self, name) not in known:
                raise ConfigError(f"{name} is one of {', '.join(known)}, not {getattr(self, name)!r}.")


@dataclass(frozen=True, eq=False)
class Tracked:
    """What a frame says about the object. state: "tracked", "restarted" (a new first pose) or "lost". estimate: None
    where it is lost; its score is the confidence, the likeness of its colours to what they were."""

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
    first frame and when it is lost; without one a lost object stays lost. predictor: in place of the one that
    ``config.runtime`` names.
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
        predictor: Predictor | None = None,
        config: TrackConfig = TrackConfig(),
    ) -> None:
        if pose is None and detector is None:
            raise ConfigError("a tracker needs the first pose, or a detector that finds the object.")
        self.model, self.camera, self.config = model, camera, config
        self.estimator = estimator or PoseEstimator(model)
        self.predictor = predictor or _predictor(self.estimator, config)
        self.renderer, self.detector = self.estimator.renderer, detector
        self._outline = model.outline - model.center
        self._pose = pose
        self._motion = Pose.identity()  # of the object's centre and axes, from the frame before the last to the last
        self._before: Look | None = None
        self._colours: NDArray[np.float32] | None = None  # of the object, as it was seen
        self._doubts = 0
        self._waiting = 0  # frames until the next search

    def step(self, image: NDArray[np.uint8], camera: Camera | None = None) -> Tracked:
        """The object in the next frame. image: uint8 RGB (H, W, 3). Raises CameraError where no camera is known."""
        chosen = camera or self.camera
        if chosen is None:
            raise CameraError("the tracker was made without a camera: pass one with each frame.")
        view = View(image, chosen)
        last, found = self._pose, None
        if last is not None:
            found = self._follow(view, last)
            if (
                found is None
                or math.degrees(found[0].angle) > self.config.restart_deg
                or self._lost_sight(view, found[0])
            ):
                self._lose()
        if self._pose is None:
            return self._find(view)
        assert last is not None and found is not None
        estimate, self._before = found
        self._motion, self._pose = self._moved(last, estimate.T_cam_obj), estimate.T_cam_obj
        if not self._doubts:
            self._learn(self._before, self.config.learn)
        return Tracked(TRACKED, estimate)

    # --- following ---

    def _follow(self, view: View, last: Pose) -> tuple[Estimate, Look] | None:
        """From where the object is expected; None where it cannot be compared."""
        started = time.perf_counter()
        pose, angle, network = self._expected(view, last), 0.0, 0.0
        for k in range(self.config.iterations):
            if not self._in_front(pose):
                return None
            updated, angle, seconds = self._compared(view, pose)
            network += seconds
            if updated is None:
                return None
            turn = math.degrees(rotation_angle(updated.R @ pose.R.T))
            if math.degrees(angle) >= self.config.still_deg:
                pose = self._between(pose, updated)
            if turn < self.config.again_deg or k + 1 == self.config.iterations:
                break
        if not self._in_front(pose):
            return None
        at = look(view, pose, self.model, self.renderer)
        now = colours(at)
        likeness = float(np.minimum(now, now if self._colours is None else self._colours).sum())
        timings = {"network": network, "total": time.perf_counter() - started}
        box = view.camera.points_box(_before_camera(pose.apply(self.model.outline)))
        return Estimate(pose, angle, k + 1, True, likeness, box, self.model.name, timings=timings), at

    def _compared(self, view: View, pose: Pose) -> tuple[Pose | None, float, float]:
        """The pose after one prediction, the predicted angle, and the seconds that the network took."""
        masking = _Masking(self.predictor, self.config.mask == "pose")
        [prediction], [seen], [drawn] = compare(view, self.model, self._outline, [pose], masking, self.renderer)
        update = "correspondence" if self.predictor.dense else "regression"
        updated = update_pose(pose, self.model, prediction, seen, drawn, update)
        return updated, predicted_angle(pose, prediction, updated, update), masking.seconds

    def _expected(self, view: View, last: Pose) -> Pose:
        """Where the object should be in this frame, by ``config.motion``."""
        if self.config.motion == "points":
            if self._before is None or self._before.size != view.camera.size:
                return last
            return follow_points(self._before, view, self.model).pose or last
        share = self.config.prior if self.config.motion == "velocity" else 0.0
        centred = last @ self.model.T_obj_ctr
        R = so3_exp(so3_log(self._motion.R) * share) @ centred.R
        return Pose(R, centred.t + share * self._motion.t) @ self.model.T_obj_ctr.inverse()

    def _between(self, pose: Pose, updated: Pose) -> Pose:
        """The share ``gain`` of the way, about the object's centre."""
        a, b, gain = pose @ self.model.T_obj_ctr, updated @ self.model.T_obj_ctr, self.config.gain
        R = so3_exp(gain * so3_log(b.R @ a.R.T)) @ a.R
        return Pose(R, a.t + gain * (b.t - a.t)) @ self.model.T_obj_ctr.inverse()

    def _moved(self, before: Pose, after: Pose) -> Pose:
        a, b = before @ self.model.T_obj_ctr, after @ self.model.T_obj_ctr
        return Pose(b.R @ a.R.T, b.t - a.t)

    def _in_front(self, pose: Pose) -> bool:
        return bool(np.isfinite(pose.matrix).all() and pose.apply(self.model.center)[2] > NEAR * self.model.diameter)

    # --- losing and finding ---

    def _lost_sight(self, view: View, found: Estimate) -> bool:
        """Whether too little of the object has been seen for too long; at once where it is outside the picture."""
        x0, y0, x1, y1 = found.box
        width, height = view.camera.size
        inside = max(0.0, min(x1, width) - max(x0, 0.0)) * max(0.0, min(y1, height) - max(y0, 0.0))
        share = inside / max((x1 - x0) * (y1 - y0), 1e-9)
        doubted = share < self.config.least_inside or found.score < self.config.alike
        self._doubts = self._doubts + 1 if doubted else 0
        return share == 0 or self._doubts >= self.config.doubts

    def _learn(self, at: Look, share: float) -> None:
        """What the object's colours are, from what they were and from this frame."""
        now = colours(at)
        self._colours = now if self._colours is None else (1 - share) * self._colours + share * now

    def _lose(self) -> None:
        self._pose, self._before, self._motion = None, None, Pose.identity()
        self._colours = None
        self._doubts = self._waiting = 0

    def _find(self, view: View) -> Tracked:
        """A new first pose, where there is one. A search takes seconds, so not every frame is searched."""
        self._waiting -= 1
        if self.detector is None or self._waiting > 0:
            return Tracked(LOST)
        self._waiting = self.config.search
        detections = [d for d in self.detector.detect(view, [self.model]) if d.label in (None, self.model.name)]
        found = max(self.estimator.estimate(view, detections), key=lambda e: e.score, default=None)
        if found is None or found.score < self.config.first:
            return Tracked(LOST)
        self._pose, self._waiting = found.T_cam_obj, 0
        self._before = look(view, found.T_cam_obj, self.model, self.renderer)
        self._learn(self._before, 1.0)
        return Tracked(RESTARTED, found)


class _Masking:
    """A predictor that is given the rendered mask as the observed one, or none, and that counts its seconds."""

    def __init__(self, predictor: Predictor, rendered: bool) -> None:
        self.predictor, self.rendered, self.seconds = predictor, rendered, 0.0
        self.size, self.dense = predictor.size, predictor.dense

    def predict(self, observed: Sequence[View], rendered: Sequence[View]) -> list[PairPrediction]:
        pairs = zip(observed, rendered, strict=True)
        seen = [view.with_mask(drawn.mask if self.rendered else None) for view, drawn in pairs]
        started = time.perf_counter()
        answers = self.predictor.predict(seen, rendered)
        self.seconds += time.perf_counter() - started
        return answers


def _predictor(estimator: PoseEstimator, config: TrackConfig) -> Predictor:
    if config.runtime == "torch":
        return estimator.predictor
    from posekit.nets.openvino import OpenVinoPredictor

    return OpenVinoPredictor(estimator.networks)


def _before_camera(points: NDArray[np.float64]) -> NDArray[np.float64]:
    points[:, 2] = np.maximum(points[:, 2], 1e-3)
    return points

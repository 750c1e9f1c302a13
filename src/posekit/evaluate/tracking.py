"""Sequences: each object is followed from its true pose in the first frame in which it counts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from posekit.camera import mask_box
from posekit.estimate.estimator import PoseEstimator
from posekit.evaluate.truths import Truth
from posekit.mesh.model import ObjectModel
from posekit.results import Detection, Source
from posekit.tracking.tracker import TrackConfig, Tracked, Tracker
from posekit.view import View


class TrueMask:
    """Stands for a detector: the object's own mask, where the frame shows a tenth of it. truth: of this frame."""

    truth: Truth | None = None

    def detect(self, view: View, models: Sequence[ObjectModel]) -> list[Detection]:
        """The annotated mask as the first model's detection, score 1; nothing where it is hidden or of another size."""
        if self.truth is None or self.truth.visible < 0.1:
            return []
        mask = self.truth.read_mask()
        box = mask_box(mask)
        known = box is not None and mask.shape == view.image.shape[:2]
        return [Detection(box, mask, 1.0, models[0].name, Source.MASK)] if box is not None and known else []


class Sequences:
    """One tracker for each object of the current scene; frames come in order. A lost object's true mask stands
    for the detector. Objects that a scene has several times are followed once, the first of them."""

    def __init__(self, estimator: Callable[[int], PoseEstimator], runtime: str) -> None:
        self.estimator, self.config, self.scene = estimator, TrackConfig(runtime=runtime), -1
        self.trackers: dict[int, tuple[Tracker, TrueMask]] = {}

    def step(self, scene: int, view: View, truths: Sequence[Truth], chosen: Sequence[Truth]) -> list[tuple[Any, ...]]:
        """(what was found, obj_id, the truth's index or None) of every object that is followed."""
        if scene != self.scene:
            self.scene, self.trackers = scene, {}
        for truth in chosen:
            if truth.instance.obj_id not in self.trackers:
                self._begin(truth)
        return [self._one(obj_id, view, truths) for obj_id in self.trackers]

    def _begin(self, truth: Truth) -> None:
        estimator, mask = self.estimator(truth.instance.obj_id), TrueMask()
        tracker = Tracker(
            estimator.model, pose=truth.instance.T_cam_obj, estimator=estimator, detector=mask, config=self.config
        )
        self.trackers[truth.instance.obj_id] = tracker, mask

    def _one(self, obj_id: int, view: View, truths: Sequence[Truth]) -> tuple[Tracked, int, int | None]:
        tracker, mask = self.trackers[obj_id]
        mask.truth = next((t for t in truths if t.instance.obj_id == obj_id), None)
        found = tracker.step(view.image, view.camera, view.valid)
        return found, obj_id, None if mask.truth is None else mask.truth.instance.index

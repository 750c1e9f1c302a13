"""Sequences: each object is followed from its true pose in the first frame in which it counts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from posekit.camera import mask_box
from posekit.estimate.estimator import PoseEstimator
from posekit.evaluate.truths import Truth
from posekit.mesh.model import ObjectModel
from posekit.results import Detection, Source
from posekit.tracking.group import TrackerGroup
from posekit.tracking.tracker import TrackConfig, Tracker
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
    for the detector. Objects that a scene has several times are followed once, the first of them. Those of a scene
    know where they hide each other, as with several ``--model`` of ``posekit track``."""

    def __init__(self, estimator: Callable[[int], PoseEstimator], runtime: str) -> None:
        self.estimator, self.config, self.scene = estimator, TrackConfig(runtime=runtime), -1
        self.group, self.masks = TrackerGroup([]), dict[int, TrueMask]()

    def step(self, scene: int, view: View, truths: Sequence[Truth], chosen: Sequence[Truth]) -> list[tuple[Any, ...]]:
        """(what was found, obj_id, the truth's index or None) of every object that is followed."""
        if scene != self.scene:
            self.scene, self.group, self.masks = scene, TrackerGroup([]), {}
        for truth in chosen:
            if truth.instance.obj_id not in self.masks:
                self._begin(truth)
        for obj_id, mask in self.masks.items():
            mask.truth = next((t for t in truths if t.instance.obj_id == obj_id), None)
        found = self.group.step(view.image, view.camera, view.valid)
        indices = [None if mask.truth is None else mask.truth.instance.index for mask in self.masks.values()]
        return list(zip(found, self.masks, indices, strict=True))

    def _begin(self, truth: Truth) -> None:
        """The trackers are in the order of the masks."""
        estimator, mask = self.estimator(truth.instance.obj_id), TrueMask()
        self.group.trackers.append(
            Tracker(
                estimator.model, pose=truth.instance.T_cam_obj, estimator=estimator, detector=mask, config=self.config
            )
        )
        self.masks[truth.instance.obj_id] = mask

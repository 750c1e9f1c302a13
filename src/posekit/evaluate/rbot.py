"""RBOT's protocol (Tjaden et al., 2018).

Each object is followed from its true pose in the first frame. A frame is right where the rotation is within 5 degrees
and the translation within 5 cm; where it is not, the tracker begins anew from that frame's true pose. The score is the
share of right frames, the first one not counted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from posekit.datasets.registry import Dataset, DatasetInfo
from posekit.datasets.sequences import followed
from posekit.estimate.estimator import PoseEstimator
from posekit.evaluate.options import EvalOptions
from posekit.evaluate.truths import Truth
from posekit.metrics import pose_error, within
from posekit.tracking.tracker import TrackConfig, Tracked, Tracker
from posekit.view import View

DEGREES, CENTIMETRES = 5.0, 5.0


@dataclass(frozen=True, eq=False)
class Judged:
    """A followed object in a frame. given: whether its pose was told, as in the first frame. right: by the protocol.
    reset: whether the tracker began anew from this frame's true pose."""

    found: Tracked
    truth: Truth
    given: bool
    right: bool
    reset: bool


class RbotProtocol:
    """One tracker for each followed object of the current scene; frames come in order. Nothing of the truth is told
    but the first pose, and with resets that of each frame that went wrong: there is no detector.

    An object that a scene has several times is followed once, the first of them. Symmetries do not count.
    """

    def __init__(
        self, data: Dataset, estimator: Callable[[int], PoseEstimator], runtime: str, resets: bool = True
    ) -> None:
        self.data, self.estimator, self.resets = data, estimator, resets
        self.config, self.scene = TrackConfig(runtime=runtime), -1
        self.trackers: dict[int, Tracker] = {}

    def step(self, scene: int, view: View, chosen: Sequence[Truth]) -> list[Judged]:
        """The followed objects that are asked for in this frame. Those that are not, being out of the picture or
        hidden more than was allowed, are followed without being judged."""
        if scene != self.scene:
            self.scene, self.trackers = scene, {}
        wanted = followed(self.data, scene).obj_id
        truths: dict[int, Truth] = {}
        for truth in chosen:
            if wanted in (None, truth.instance.obj_id):
                truths.setdefault(truth.instance.obj_id, truth)
        for obj_id in self.trackers.keys() - truths.keys():
            self.trackers[obj_id].step(view.image, view.camera, view.valid)
        return [self._judged(view, truth) for truth in truths.values()]

    def _judged(self, view: View, truth: Truth) -> Judged:
        obj_id = truth.instance.obj_id
        if obj_id not in self.trackers:
            return Judged(self._begun(view, truth), truth, given=True, right=True, reset=False)
        found = self.trackers[obj_id].step(view.image, view.camera, view.valid)
        right = is_right(found, truth)
        reset = self.resets and not right
        if reset:
            self._begun(view, truth)
        return Judged(found, truth, given=False, right=right, reset=reset)

    def _begun(self, view: View, truth: Truth) -> Tracked:
        """A new tracker that is given the true pose in this frame."""
        i = truth.instance
        estimator = self.estimator(i.obj_id)
        tracker = Tracker(estimator.model, pose=i.T_cam_obj, estimator=estimator, config=self.config)
        self.trackers[i.obj_id] = tracker
        return tracker.step(view.image, view.camera, view.valid)


def is_right(found: Tracked, truth: Truth) -> bool:
    """Whether there is a pose and it is strictly within both limits."""
    if found.T_cam_obj is None:
        return False
    return bool(within(*pose_error(found.T_cam_obj, truth.instance.T_cam_obj), DEGREES, CENTIMETRES))


def summary(
    options: EvalOptions, data: Dataset, info: DatasetInfo, records: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """``protocol`` of the results: by sequence, by variant (means over its sequences) and in all; percentages.

    records: of the pictures, in order.
    """
    frames: dict[tuple[int, int], list[tuple[int, bool, bool]]] = {}
    for record in records:
        for t in record["truths"]:
            if t["counted"]:
                frames.setdefault((record["scene"], t["obj_id"]), []).append((record["image"], t["right"], t["reset"]))
    sequences = [
        {
            "scene": scene,
            "variant": followed(data, scene).variant,
            "obj_id": obj_id,
            "name": info.label(obj_id),
            "frames": len(judged),
            "right": 100 * float(np.mean([right for _, right, _ in judged])),
            "resets": sum(reset for *_, reset in judged),
            "first_wrong": next((image for image, right, _ in judged if not right), None),
        }
        for (scene, obj_id), judged in frames.items()
    ]
    variants = dict.fromkeys(s["variant"] for s in sequences)
    return {
        "name": options.protocol,
        "with_resets": options.resets,
        "degrees": DEGREES,
        "cm": CENTIMETRES,
        **_together(sequences),
        "by_variant": {v: _together([s for s in sequences if s["variant"] == v]) for v in variants},
        "by_sequence": sequences,
    }


def _together(sequences: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    return {
        "sequences": len(sequences),
        "frames": sum(s["frames"] for s in sequences),
        "right": float(np.mean([s["right"] for s in sequences])),
        "resets": sum(s["resets"] for s in sequences),
    }


def rows(protocol: Mapping[str, Any]) -> tuple[list[str], list[tuple[str, list[float | None]]]]:
    """The table as papers print it: the variants' names, and for each object and their mean the shares of right frames
    (percent), None where an object has no such sequence. protocol: as `summary` gives it."""
    variants = list(protocol["by_variant"])
    objects = sorted({(s["obj_id"], s["name"]) for s in protocol["by_sequence"]})
    lines: list[tuple[str, list[float | None]]] = []
    for obj_id, name in objects:
        mine = [s for s in protocol["by_sequence"] if s["obj_id"] == obj_id]
        lines.append((f"{obj_id} {name}", [_mean([s["right"] for s in mine if s["variant"] == v]) for v in variants]))
    lines.append(("mean over sequences", [protocol["by_variant"][v]["right"] for v in variants]))
    return variants, lines


def told(protocol: Mapping[str, Any]) -> str:
    """What the table shows, in a sentence. protocol: as `summary` gives it."""
    how = f"{protocol['resets']} resets to the true pose" if protocol["with_resets"] else "no resets"
    return (
        f"Share of the {protocol['frames']} frames after the first that are within {protocol['degrees']:g} degrees and "
        f"{protocol['cm']:g} cm, percent; {how} in {protocol['sequences']} sequences."
    )


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None

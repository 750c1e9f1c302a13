"""From detections that may be wrong to an object's instances: estimate, keep what the render bears out. Layer 5."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from posekit.camera import Box
from posekit.errors import ConfigError
from posekit.estimate import PoseEstimator
from posekit.novel import ANY, USUAL, WEIGHT, shifted
from posekit.results import Detection, Estimate
from posekit.view import View


@dataclass(frozen=True)
class SearchOptions:
    """instances: kept at most; 0 = all. least: score of an estimate below which it is no instance. overlap: of the
    boxes (intersection over union) from which two estimates are of one instance."""

    instances: int = 1
    least: float = 0.5
    overlap: float = 0.5

    def __post_init__(self) -> None:
        if self.instances < 0 or not 0 <= self.least <= 1 or not 0 < self.overlap <= 1:
            raise ConfigError("instances is not negative, least in [0, 1] and overlap in (0, 1].")

    @classmethod
    def given(cls, by_hand: bool) -> SearchOptions:
        """For detections that somebody vouches for: a person's, or another program's."""
        return cls(0, 0.0, 1.0 if by_hand else 0.5)


def estimate_instances(
    estimator: PoseEstimator, view: View, detections: Sequence[Detection], options: SearchOptions = SearchOptions()
) -> list[Estimate]:
    """The instances among an object's detections, best first; none is an empty list."""
    return instances_of(estimates_of(estimator, view, detections, options), options)


def estimates_of(
    estimator: PoseEstimator, view: View, detections: Sequence[Detection], options: SearchOptions = SearchOptions()
) -> list[Estimate]:
    """An estimate for each detection that leads to one, in their order. What the novel detector found is scored by
    how much it looks like the mesh as well: a logistic function's argument grows by `WEIGHT` times what the likeness
    is above `USUAL` (docs/decisions/0015)."""
    found = []
    for detection in detections:
        shift = WEIGHT * (detection.score - USUAL) if detection.source == ANY else 0.0
        for estimate in estimator.estimate(view, [detection], shifted(options.least, -shift)):
            others = tuple(replace(e, score=shifted(e.score, shift)) for e in estimate.alternatives)
            found.append(replace(estimate, score=shifted(estimate.score, shift), alternatives=others))
    return found


def instances_of(estimates: Sequence[Estimate], options: SearchOptions = SearchOptions()) -> list[Estimate]:
    """Those of an object's estimates that are instances of it, best first."""
    kept: list[Estimate] = []
    for each in sorted(estimates, key=lambda e: -e.score):
        if each.score >= options.least and all(box_overlap(each.box, k.box) < options.overlap for k in kept):
            kept.append(each)
    return kept[: options.instances] if options.instances else kept


def judged(detections: Sequence[Detection], estimates: Sequence[Estimate]) -> list[Detection]:
    """The detections with the scores of the estimates that they led to, best first; 0 for one that led to none. A
    detector that was trained for the object has its say: its own score is a factor."""
    scores = {id(each.detection): each.score for each in estimates}
    found = [
        replace(each, score=scores.get(id(each), 0.0) * (1.0 if each.source == ANY else each.score))
        for each in detections
    ]
    return sorted(found, key=lambda d: -d.score)


def box_overlap(a: Box, b: Box) -> float:
    """Intersection over union of two boxes (edges)."""
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    both = max(width, 0.0) * max(height, 0.0)
    return both / max((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - both, 1e-9)

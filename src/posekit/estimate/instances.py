"""From detections that may be wrong to objects' instances: estimate, and keep what the rendering confirms.

The one way from a picture, meshes and detections to poses, for ``posekit estimate``, ``eval``, ``detect --verify`` and
the tracker's search.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from posekit.camera import box_iou
from posekit.detect.sharpen import sharpened
from posekit.detect.similarity import USUAL, WEIGHT
from posekit.errors import ConfigError
from posekit.mesh.model import ObjectModel
from posekit.results import Detection, Estimate, Source
from posekit.view import View


class Estimator(Protocol):
    """What a `PoseEstimator` does for the search."""

    def screen(self, view: View, detections: Sequence[Detection]) -> list[float]:
        """How much a quick look at each detection speaks for the object, as log odds."""
        ...

    def estimate(self, view: View, detections: Sequence[Detection], min_score: float = 0.0) -> list[Estimate]:
        """Estimates of its model at the detections, by falling score, those of at least ``min_score``."""


EstimatorOf = Callable[[ObjectModel], Estimator]


@dataclass(frozen=True)
class SearchOptions:
    """Which of the estimates of a picture are instances."""

    instances: int = 1  # kept at most; 0 = all
    min_score: float = 0.5  # score of an estimate below which it is no instance
    overlap: float = 0.5  # of the boxes (intersection over union) from which two estimates are of one instance
    candidates: int = 5  # the novel detector's detections that are estimated, the most promising ones
    sure: float = 0.95  # score from which an estimate is an instance whatever the remaining detections would give

    def __post_init__(self) -> None:
        shares = (self.min_score, self.sure)
        if (
            self.instances < 0
            or self.candidates < 1
            or not 0 < self.overlap <= 1
            or not all(0 <= s <= 1 for s in shares)
        ):
            raise ConfigError(
                "instances is not negative, candidates at least 1, min_score and sure in [0, 1], overlap in (0, 1]."
            )

    @classmethod
    def usual(cls, detections: Sequence[Detection]) -> SearchOptions:
        """By the source of the detections. A person's are taken as they are; another program's give all instances that
        do not overlap; a detector's detections must be confirmed by the rendering."""
        sources = [detection.source for detection in detections]
        if sources and all(source.given for source in sources):
            return cls(0, 0.0, 1.0 if all(source.by_hand for source in sources) else 0.5)
        return cls()


@dataclass(frozen=True, eq=False)
class Found:
    """What a picture shows of one mesh. detections: that were estimated. estimates: what they led to, in their order.
    instances: those of the estimates that are kept, best first."""

    model: ObjectModel
    detections: Sequence[Detection]
    estimates: Sequence[Estimate]
    instances: Sequence[Estimate]


def find_instances(
    estimator_of: EstimatorOf,
    view: View,
    models: Sequence[ObjectModel],
    detections: Sequence[Detection],
    options: SearchOptions | None = None,
) -> list[Found]:
    """The instances of each model among a picture's detections, in the order of the models.

    A detection belongs to the model whose name is its label, one without a label to every model. estimator_of: gives
    a model's estimator; it is asked for models that have detections only. options: by default
    `SearchOptions.usual`.
    """
    options = options or SearchOptions.usual(detections)
    found = []
    for model in models:
        mine = [detection for detection in detections if detection.label in (None, model.name)]
        mine = promising(estimator_of, model, view, mine, options.candidates)
        estimates = estimates_of(estimator_of(model), view, mine, options) if mine else []
        found.append(Found(model, mine, estimates, instances_of(estimates, options)))
    return found


def promising(
    estimator_of: EstimatorOf, model: ObjectModel, view: View, detections: Sequence[Detection], count: int
) -> list[Detection]:
    """The detections, but of the novel detector's only the ``count`` that similarity and a quick look at a pose speak
    for most, last and with masks fitted to the photograph's colours."""
    novel = [each for each in detections if each.source is Source.NOVEL]
    if len(novel) > count:
        quick = estimator_of(model).screen(view, novel)
        odds = [WEIGHT * (each.score - USUAL) + look for each, look in zip(novel, quick, strict=True)]
        novel = [novel[k] for k in np.argsort(np.negative(odds), kind="stable")[:count]]
    others = [each for each in detections if each.source is not Source.NOVEL]
    return others + [each if each.rough is not None else sharpened(view.image, each) for each in novel]


def estimates_of(
    estimator: Estimator, view: View, detections: Sequence[Detection], options: SearchOptions
) -> list[Estimate]:
    """An estimate for each detection that leads to one, in their order, until as many sure instances are found as are
    wanted; detections by hand are all estimated."""
    found: list[Estimate] = []
    for detection in detections:
        if not detection.source.by_hand and _enough(found, options):
            break
        found += estimator.estimate(view, [detection], options.min_score)
    return found


def _enough(estimates: Sequence[Estimate], options: SearchOptions) -> bool:
    sure = instances_of([each for each in estimates if each.score >= options.sure], replace(options, instances=0))
    return 0 < options.instances <= len(sure)


def instances_of(estimates: Sequence[Estimate], options: SearchOptions) -> list[Estimate]:
    """Those of an object's estimates that are instances of it, best first."""
    kept: list[Estimate] = []
    for each in sorted(estimates, key=lambda e: -e.score):
        if each.score >= options.min_score and all(box_iou(each.box, k.box) < options.overlap for k in kept):
            kept.append(each)
    return kept[: options.instances] if options.instances else kept


def scored_by_poses(found: Found) -> list[Detection]:
    """A model's detections with the scores of the estimates that they led to (0 where to none), best first."""
    scores = {id(each.detection): each.score for each in found.estimates}
    scored = [replace(each, score=scores.get(id(each), 0.0)) for each in found.detections]
    return sorted(scored, key=lambda d: -d.score)

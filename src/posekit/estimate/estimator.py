"""PoseEstimator: detect, first pose, refine, choose."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from posekit.align.mask_edge import fit_mask_edge
from posekit.camera import Box, mask_box
from posekit.detect.similarity import USUAL, WEIGHT
from posekit.errors import ConfigError
from posekit.estimate.perceptual import perceptual_similarity
from posekit.estimate.refine import Refinement, RefineOptions, compare, crops, predicted_angle, refine, update_pose
from posekit.first_pose.features import FeatureSearch
from posekit.first_pose.hypotheses import (
    BoxSearch,
    EvidenceScorer,
    FirstPoseSearch,
    Hypothesis,
    perturbed_poses,
)
from posekit.geometry import Pose, rotation_angle
from posekit.mesh.model import ObjectModel
from posekit.nets.predictor import PairPrediction, Predictor
from posekit.nets.runtime import Runtime
from posekit.render import Renderer
from posekit.results import Branch, Detection, Estimate
from posekit.view import View

if TYPE_CHECKING:
    from posekit.nets.weights import Networks
log = logging.getLogger("posekit")

SCREENED_POSES, SCREENED_EVIDENCE = 2, 2.0  # first poses of a detection that is screened; weight of their evidence
COMPARED, COMPARED_EVIDENCE = 12, 6.0  # detections whose first poses the network compares; weight of their evidence
INITS = ("templates", "mvnet")
AUTO = "auto"  # correspondences where the network gives them, else the regressed delta
# of `existence_score`, fitted: similarity, logarithms of expected error and angle, constant; docs/decisions/0027
EXISTENCE, EXISTENCE_PLAIN = (15.4, -1.97, -0.94, -6.53), (9.7, -0.80, -1.85, -0.72)
SMALLEST_ANGLE_DEG = 0.3  # degrees: smaller predicted errors say no more
DEFAULT_SCALE_PX = 2.0  # pixels of the crop: the correspondences' expected error, where the network gives none
FIRST, SEMIFINALISTS, PRUNING_ITERATIONS, FINALISTS = 1, 4, 3, 2  # iterations after which only so many hypotheses go on
EVIDENCE_PER_RADIAN = 0.3  # evidence that outweighs a radian of predicted angle
SIMILARITY = 0.5  # weight of the perceptual similarity beside the evidence
DIFFERENT = float(np.deg2rad(10.0))  # turn, or shift in diameters, from which an alternative is another pose
PERTURBED = float(np.deg2rad(12.0))  # how far from a known pose others are tried


@dataclass(frozen=True)
class EstimateOptions:
    """What `PoseEstimator` does with a detection, or with a given pose."""

    init: str = "templates"  # where first poses come from: "templates" or "mvnet"
    hypotheses: int = 5  # first poses that are refined, for each of a detection's masks
    update: str = AUTO  # what moves the pose: one of RefineOptions', or AUTO
    stop: str = "angle"  # as RefineOptions'
    iterations: int = 50  # as RefineOptions'
    stop_angle_deg: float = 2.0  # as RefineOptions', degrees
    perturb: bool = True  # try poses turned by 12 degrees from a given one too, where that does not converge at once
    mask_edge: bool = True  # fit the pose to the edge of a mask that proves exact
    colour_edge: bool = True  # weigh the silhouette's edge that the photograph's colours show
    top: int = 1  # poses that an estimate keeps: itself and alternatives

    def __post_init__(self) -> None:
        if self.init not in INITS:
            raise ConfigError(f"init is one of {INITS}, not {self.init!r}.")
        if self.hypotheses < 1:
            raise ConfigError(f"at least 1 hypothesis is needed, not {self.hypotheses}.")
        if not 1 <= self.top <= self.hypotheses:
            raise ConfigError(f"top {self.top}: from 1 to {self.hypotheses}, the number of hypotheses (--hypotheses).")
        _ = self.refine_options(True)  # checks the rest

    def refine_options(self, dense: bool) -> RefineOptions:
        """dense: whether the network gives correspondences."""
        update = ("correspondence" if dense else "regression") if self.update == AUTO else self.update
        stop_angle = float(np.deg2rad(self.stop_angle_deg))
        return RefineOptions(update, self.stop, self.iterations, stop_angle, colour_edge=self.colour_edge)


Tell = Callable[[str], None]


def _tell_nobody(stage: str) -> None:
    """Where nobody watches."""


class PoseEstimator:
    """Estimates the pose of one object in photographs.

    networks: those of a training, or what several estimators share (see `Estimators`), in place of those that preset
    and weights name. device: of the networks: "auto" (a GPU where there is one), "cpu" or "cuda". runtime: what runs
    them: "openvino", "torch" or "auto", see `Runtime`.
    ``tell`` may be set to a function that is told what is being done. Not thread-safe: one estimator per thread. Raises
    WeightsError where the preset has no weights, ConfigError where there is no such device.
    """

    def __init__(
        self,
        model: ObjectModel,
        *,
        preset: str = "lite",
        weights: Path | None = None,
        options: EstimateOptions = EstimateOptions(),
        networks: Networks | Runtime | None = None,
        device: str = "auto",
        runtime: str = "auto",
    ) -> None:
        self.model, self.options = model, options
        self.tell: Tell = _tell_nobody
        if not isinstance(networks, Runtime):
            networks = Runtime(preset, weights, device=device, runtime=runtime, networks=networks)
        self.runtime = networks
        self.refine_options = options.refine_options(networks.dense)
        self.renderer = Renderer()
        self._search: FirstPoseSearch | None = None  # in place of the search by boxes
        self._features = FeatureSearch(model, self.renderer)
        if options.init == "mvnet":
            from posekit.first_pose.mvnet import mvnet_search

            self._search = mvnet_search(model, self.networks, self.renderer)

    @cached_property
    def _box_search(self) -> BoxSearch:
        return BoxSearch(self.model, self.renderer)

    @cached_property
    def predictor(self) -> Predictor:
        """SV-Net for batches of pairs, made when it is first used."""
        return self.runtime.predictor

    @property
    def weights_hash(self) -> str:
        """16 hex digits of the weights' SHA-256."""
        return self.runtime.digest

    @property
    def networks(self) -> Networks:
        """PyTorch's networks; they are loaded where they were not needed before."""
        return self.runtime.networks

    def estimate(self, view: View, detections: Sequence[Detection], min_score: float = 0.0) -> list[Estimate]:
        """One estimate for each detection that gives a silhouette to start from, in their order. min_score: the score
        that is needed; a pose with less than half of it after a few iterations is not refined to the end."""
        estimates = []
        for detection in detections:
            started = time.perf_counter()
            self.tell(f"looking for first poses of {self.model.name}")
            first = self.first_poses(view, detection)
            searched = time.perf_counter()
            log.debug(
                "%s: %d first poses in %.2f s, scores %s", self.model.name, len(first), searched - started,
                " ".join(f"{h.score:.2f}" for h in first),
            )  # fmt: skip
            if not first:
                continue
            masked = view.with_mask(detection.mask)
            scorer = EvidenceScorer(masked, detection.box, self.model, self.renderer)
            refined = self._refined(masked, scorer, [h.T_cam_obj for h in first], 0.5 * min_score)
            done = time.perf_counter()
            timings = {"first_pose": searched - started, "refine": done - searched, "total": done - started}
            estimates.append(self._choose(masked, scorer, refined, detection, timings))
        return estimates

    def screen(self, view: View, detections: Sequence[Detection]) -> list[float]:
        """How much each detection's first poses, updated once, speak for the object: log odds of `existence_score` and
        the evidence of the search, the best of `SCREENED_POSES`; -inf where there is no first pose, or where the
        detection's similarity and the evidence leave it behind `COMPARED` others. Much quicker than
        `estimate`."""
        scores = np.full(len(detections), -np.inf)
        found = self._compared_poses(view, detections)
        if not found:
            return scores.tolist()
        hull, update = self.model.hull_ctr, self.refine_options.update
        poses = [hypothesis.T_cam_obj for _, hypothesis in found]
        compared = zip(poses, *compare(view, self.model, hull, poses, self.predictor, self.renderer), strict=True)
        updated = [update_pose(T, self.model, p, o, d, update) or T for T, p, o, d in compared]
        compared_again = zip(*compare(view, self.model, hull, updated, self.predictor, self.renderer), strict=True)
        for (k, hypothesis), (prediction, observed, rendered) in zip(found, compared_again, strict=True):
            exists = self._existence(prediction, observed, rendered, prediction.angle)
            odds = np.log(max(exists, 1e-6) / max(1 - exists, 1e-6)) + SCREENED_EVIDENCE * hypothesis.score
            scores[k] = max(scores[k], odds)
        return scores.tolist()

    def _compared_poses(self, view: View, detections: Sequence[Detection]) -> list[tuple[int, Hypothesis]]:
        """First poses with the numbers of their detections: of those `COMPARED` whose similarity and evidence are
        best."""
        poses = [
            self._box_search.search(view, replace(detection, mask=None), SCREENED_POSES, moved=False)
            for detection in detections
        ]
        odds = [
            WEIGHT * (detection.score - USUAL) + COMPARED_EVIDENCE * max((h.score for h in mine), default=-np.inf)
            for detection, mine in zip(detections, poses, strict=True)
        ]
        best = sorted(np.argsort(np.negative(odds), kind="stable")[:COMPARED])
        return [(int(k), hypothesis) for k in best for hypothesis in poses[k]]

    def refine(self, view: View, T_cam_obj: Pose) -> Estimate:
        """Refine a known pose; view.mask, where there is one, helps. Where it does not converge within a few
        iterations, the four poses turned by 12 degrees towards a tetrahedron's corners compete with it."""
        started = time.perf_counter()
        options, scorer = self.refine_options, self._scorer_of(view, T_cam_obj)
        if self.options.perturb and options.stop == "angle" and options.iterations > PRUNING_ITERATIONS:
            candidates = self._candidates(view, [T_cam_obj])
            if not candidates[0].converged:
                candidates += self._candidates(view, perturbed_poses(T_cam_obj, self.model, PERTURBED))
            refined = self._finals(view, scorer, candidates)
        else:
            refined = refine(view, self.model, [T_cam_obj], self.predictor, self.renderer, options)
        seconds = time.perf_counter() - started
        found = self._choose(view, scorer, refined, None, {"refine": seconds, "total": seconds})
        return nearest_to(T_cam_obj, found, self.model, Branch.GIVEN)

    def _refined(
        self, view: View, scorer: EvidenceScorer, starts: Sequence[Pose], min_score: float
    ) -> list[Refinement]:
        """Every start for a few iterations, and the best of them to the end, unless its score is below
        ``min_score``."""
        options = self.refine_options
        if len(starts) <= FINALISTS or options.iterations <= PRUNING_ITERATIONS:
            return refine(view, self.model, starts, self.predictor, self.renderer, options)
        candidates = self._best(
            view, scorer, self._candidates(view, starts, FIRST), max(SEMIFINALISTS, self.options.top)
        )
        candidates = self._continued(view, candidates, PRUNING_ITERATIONS - FIRST)
        if min_score > 0 and self._assess(view, self._best(view, scorer, candidates, 1)[0].T_cam_obj)[0] < min_score:
            return candidates
        return self._finals(view, scorer, candidates)

    def _candidates(self, view: View, starts: Sequence[Pose], iterations: int = PRUNING_ITERATIONS) -> list[Refinement]:
        self._tell_refining(len(starts))
        short = replace(self.refine_options, iterations=iterations)
        return refine(view, self.model, starts, self.predictor, self.renderer, short)

    def _tell_refining(self, count: int) -> None:
        self.tell(f"refining {self.model.name}: {count} {'hypothesis' if count == 1 else 'hypotheses'}")

    def _finals(self, view: View, scorer: EvidenceScorer, candidates: Sequence[Refinement]) -> list[Refinement]:
        """The best go on to the end."""
        finalists = self._best(view, scorer, candidates, max(FINALISTS, self.options.top))
        return self._continued(view, finalists, self.refine_options.iterations - PRUNING_ITERATIONS)

    def _best(
        self, view: View, scorer: EvidenceScorer, candidates: Sequence[Refinement], count: int
    ) -> list[Refinement]:
        scores = self._scores(view, scorer, candidates)
        order = np.argsort([-s for s in scores], kind="stable")
        for place, k in enumerate(order):
            log.debug(
                "%s: pose %d of %d%s: rank %.3f, expected rotation error %.1f degrees, %d iterations", self.model.name,
                place + 1, len(order), "" if place < count else " (dropped)", scores[k],
                np.rad2deg(candidates[k].angle), candidates[k].iterations,
            )  # fmt: skip
        return [candidates[k] for k in order[:count]]

    def _continued(self, view: View, candidates: Sequence[Refinement], iterations: int) -> list[Refinement]:
        """So many more; with the paper's policy only for what has not converged."""
        options = replace(self.refine_options, iterations=iterations)
        there = [candidate.converged and options.stop == "angle" for candidate in candidates]
        poses = [candidate.T_cam_obj for candidate, done in zip(candidates, there, strict=True) if not done]
        self._tell_refining(len(poses))
        ends = iter(refine(view, self.model, poses, self.predictor, self.renderer, options))
        return [
            candidate if done else candidate.then(next(ends), options.stop)
            for candidate, done in zip(candidates, there, strict=True)
        ]

    def first_poses(self, view: View, detection: Detection) -> list[Hypothesis]:
        """The first poses that ``options.init`` gives, best first; those for a detection's rough mask come last. Those
        that the mesh's texture gives come before ``templates``'s."""
        search = self._search or self._box_search
        found: list[Hypothesis] = []
        for mask in (detection.mask, detection.rough):
            if mask is not None or not found:
                box = detection.box if mask is None or detection.rough is None else mask_box(mask) or detection.box
                found += search.search(view, replace(detection, box=box, mask=mask), self.options.hypotheses)
        if self.options.init != "templates":
            return found
        textured = self._features.search(view, detection.box)
        return [Hypothesis(each.T_cam_obj, each.share) for each in textured] + found

    def _choose(
        self,
        view: View,
        scorer: EvidenceScorer,
        refined: Sequence[Refinement],
        detection: Detection | None,
        timings: dict[str, float],
    ) -> Estimate:
        """The hypothesis that `hypothesis_score` puts first. The next best ones that differ from it and from each other
        are its alternatives."""
        first, *others = self._best(view, scorer, refined, len(refined) if self.options.top > 1 else 1)
        kept = [self._estimate_of(view, first, detection, timings)]
        for other in others:
            if len(kept) < self.options.top and all(self._differ(other.T_cam_obj, k.T_cam_obj) for k in kept):
                kept.append(self._estimate_of(view, other, detection, timings))
        return replace(kept[0], alternatives=tuple(kept[1:]))

    def _differ(self, a: Pose, b: Pose) -> bool:
        """Whether two ``T_cam_obj`` are more than one pose that refinement ended in by two ways."""
        moved = a.apply(self.model.center) - b.apply(self.model.center)
        return bool(rotation_angle(a.R.T @ b.R) > DIFFERENT or np.linalg.norm(moved) > DIFFERENT * self.model.diameter)

    def _estimate_of(
        self, view: View, refined: Refinement, detection: Detection | None, timings: dict[str, float]
    ) -> Estimate:
        best, mask_edge_std = self._on_mask_edge(view, refined)
        existence, angle = self._assess(view, best.T_cam_obj)
        return Estimate(
            T_cam_obj=best.T_cam_obj,
            angle=angle,
            mask_edge_std=mask_edge_std,
            iterations=best.iterations,
            converged=(angle if mask_edge_std is None else mask_edge_std) < self.refine_options.stop_angle,
            branch=Branch.ANY if self.model.symmetries else None,
            score=existence,
            box=self._box(view, best.T_cam_obj),
            model=self.model.name,
            detection=detection,
            trace=best.trace,
            timings=timings,
        )

    def _on_mask_edge(self, view: View, refined: Refinement) -> tuple[Refinement, float | None]:
        """With its outline on the mask's, where there is an exact one, and the fit's standard deviation; else as it is,
        and None."""
        if self.options.mask_edge and view.mask is not None:
            fit = fit_mask_edge(view, self.model, refined.T_cam_obj, self.renderer)
            if fit is not None and fit.exact:
                return replace(refined, T_cam_obj=fit.T_cam_obj), fit.turn_std
        return refined, None

    def _assess(self, view: View, T_cam_obj: Pose) -> tuple[float, float]:
        """How sure it is that the photograph shows the object there, by what the network sees of it; and the rotation
        error that the network predicts there, radians."""
        outline = self.model.hull_ctr
        [prediction], [observed], [rendered] = compare(
            view, self.model, outline, [T_cam_obj], self.predictor, self.renderer
        )
        update = self.refine_options.update
        outlined = self.refine_options.colour_edge
        updated = update_pose(T_cam_obj, self.model, prediction, observed, rendered, update, outlined)
        angle = predicted_angle(T_cam_obj, prediction, updated, update)
        return self._existence(prediction, observed, rendered, angle), angle

    def _existence(self, prediction: PairPrediction, observed: View, rendered: View, angle: float) -> float:
        """`existence_score` of a pose that was compared."""
        found = prediction.correspondences
        error = float(np.median(found.scale_px)) if found is not None and len(found.scale_px) else DEFAULT_SCALE_PX
        visible = None if prediction.silhouettes is None else [prediction.silhouettes[0]]
        [similarity] = perceptual_similarity(self.runtime.features, [observed], [rendered], visible)
        return existence_score(similarity, error, angle, coloured=self.model.coloured)

    def _scores(self, view: View, scorer: EvidenceScorer, refined: Sequence[Refinement]) -> list[float]:
        poses = [r.T_cam_obj for r in refined]
        observed, rendered = crops(
            view, self.model, self.model.hull_ctr, poses, self.runtime.size, self.renderer, coords=False
        )
        similarities = perceptual_similarity(self.runtime.features, observed, rendered)
        scored = zip(refined, scorer.scores(poses), similarities, strict=True)
        return [hypothesis_score(r.angle, evidence, similarity) for r, evidence, similarity in scored]

    def _scorer_of(self, view: View, T_cam_obj: Pose) -> EvidenceScorer:
        """Of a known pose's surroundings."""
        return EvidenceScorer(view, self._box(view, T_cam_obj), self.model, self.renderer)

    def _box(self, view: View, T_cam_obj: Pose) -> Box:
        points = T_cam_obj.apply(self.model.hull_vertices)
        points[:, 2] = np.maximum(points[:, 2], 1e-3)
        return view.camera.points_box(points)


class Estimators:
    """One estimator for each mesh, all with the same networks; an estimator is made when it is first asked for.

    Raises WeightsError where the preset has no weights.
    """

    def __init__(
        self,
        *,
        preset: str = "lite",
        weights: Path | None = None,
        options: EstimateOptions = EstimateOptions(),
        device: str = "auto",
        runtime: str = "auto",
    ) -> None:
        self.runtime, self.options = Runtime(preset, weights, device=device, runtime=runtime), options
        self.tell: Tell = _tell_nobody  # of all of them
        self._made: dict[ObjectModel, PoseEstimator] = {}

    def __call__(self, model: ObjectModel) -> PoseEstimator:
        if model not in self._made:
            self._made[model] = PoseEstimator(model, options=self.options, networks=self.runtime)
        self._made[model].tell = self.tell
        return self._made[model]


def nearest_to(reference: Pose, estimate: Estimate, model: ObjectModel, branch: Branch) -> Estimate:
    """An estimate of an object with symmetries in the equivalent pose nearest to a reference; others as they are."""
    if not model.symmetries:
        return estimate
    return replace(estimate, T_cam_obj=model.symmetries.nearest(estimate.T_cam_obj, reference), branch=branch)


def hypothesis_score(angle: float, evidence: float, similarity: float) -> float:
    """What hypotheses are chosen by, of a predicted angle (radians), the evidence and the perceptual similarity:
    docs/decisions/0018 and 0027."""
    return evidence + SIMILARITY * similarity - EVIDENCE_PER_RADIAN * angle


def existence_score(similarity: float, error_px: float, angle: float, *, coloured: bool = True) -> float:
    """Between 0 and 1: how likely it is that the object is there in this pose. similarity: `perceptual_similarity` of
    what is seen of it. error_px: median of the errors that the network expects of its correspondences, pixels of the
    crop. angle: predicted rotation error, radians. coloured: whether the mesh has colours. A logistic function fitted
    to estimates of objects, shown and not shown, in composed scenes: docs/decisions/0027."""
    degrees = max(float(np.rad2deg(angle)), SMALLEST_ANGLE_DEG)
    weights = np.array(EXISTENCE if coloured else EXISTENCE_PLAIN)
    total = float(weights @ [similarity, np.log(error_px), np.log(degrees), 1.0])
    return float(1 / (1 + np.exp(-total)))

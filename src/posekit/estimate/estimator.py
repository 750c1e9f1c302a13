"""PoseEstimator: detect, first pose, refine, choose."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from posekit.align.mask_edge import fit_contour
from posekit.camera import Box, mask_box
from posekit.errors import ConfigError
from posekit.estimate.refine import Refinement, RefineOptions, compare, predicted_angle, refine, update_pose
from posekit.first_pose.features import FeatureSearch
from posekit.first_pose.hypotheses import BoxSearch, Hypothesis, Judge, agreement_of, poses_beside
from posekit.first_pose.mvnet import FirstPoseSearch, mvnet_search
from posekit.geometry import Pose, rotation_angle
from posekit.mesh.model import ObjectModel
from posekit.nets.precision import choose_device
from posekit.nets.predictor import NetworkPredictor
from posekit.nets.weights import Networks, load_networks
from posekit.render import Renderer
from posekit.results import Branch, Detection, Estimate
from posekit.view import View

INITS = ("templates", "mvnet")
AUTO = "auto"  # correspondences where the network gives them, else the regressed delta
STRUCTURE, BLUR, ANGLE, BIAS = 5.7, -1.6, -1.6, 1.2  # of `presence`, fitted: docs/decisions/0020
SMALLEST = 0.3  # degrees: smaller predicted errors say no more
USUAL = 2.0  # pixels of the crop: the correspondences' expected error, where the network gives none
FIRST, SEMIFINALISTS, HEATS, FINALISTS = 1, 4, 3, 2  # iterations after which only so many hypotheses go on
DOUBT = 0.3  # evidence that outweighs a radian of predicted angle
DIFFERENT = float(np.deg2rad(10.0))  # turn, or shift in diameters, from which an alternative is another pose
BESIDE = float(np.deg2rad(12.0))  # how far from a known pose others are tried


@dataclass(frozen=True)
class EstimateOptions:
    """init: where first poses come from. hypotheses: how many of them are refined, for each of a detection's masks.
    update: what moves the pose, one of RefineOptions' or AUTO. beside: whether poses beside a known one are tried too
    where it does not converge at once. contour: whether the pose is laid onto the mask's outline where the mask proves
    exact. outline: whether refinement weighs the outline that the photograph's colours show. top: poses that an
    estimate keeps, itself and alternatives. The rest is RefineOptions', with the angle in degrees."""

    init: str = "templates"
    hypotheses: int = 5
    update: str = AUTO
    stop: str = "angle"
    iterations: int = 50
    stop_angle_deg: float = 2.0
    beside: bool = True
    contour: bool = True
    outline: bool = True
    top: int = 1

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
        return RefineOptions(update, self.stop, self.iterations, stop_angle, outline=self.outline)


class PoseEstimator:
    """Estimates the pose of one object in photographs.

    networks: where several estimators share them, in place of those that preset and weights name; see `Estimators`.
    device: of the networks: "auto" (a GPU where there is one), "cpu" or "cuda".
    Not thread-safe: one estimator per thread. Raises WeightsError where the preset has no weights, ConfigError where
    there is no such device.
    """

    def __init__(
        self,
        model: ObjectModel,
        *,
        preset: str = "lite",
        weights: Path | None = None,
        options: EstimateOptions = EstimateOptions(),
        networks: Networks | None = None,
        device: str = "auto",
    ) -> None:
        self.model, self.options = model, options
        self.networks = load_networks(preset, weights).moved(choose_device(device)) if networks is None else networks
        self.predictor = NetworkPredictor(self.networks)
        self.refine_options = options.refine_options(self.predictor.dense)
        self.renderer = Renderer()
        self._search: BoxSearch | FirstPoseSearch | None = None
        self._features = FeatureSearch(model, self.renderer)
        if options.init == "mvnet":
            self._search = mvnet_search(model, self.networks, self.renderer)

    @property
    def weights_hash(self) -> str:
        return self.networks.digest

    def estimate(self, view: View, detections: Sequence[Detection], least: float = 0.0) -> list[Estimate]:
        """One estimate for each detection that gives a silhouette to start from, in their order. least: the score that
        is asked for; what has not half of it after a few iterations is not refined to the end."""
        estimates = []
        for detection in detections:
            started = time.perf_counter()
            first = self.first_poses(view, detection)
            searched = time.perf_counter()
            if not first:
                continue
            masked = view.with_mask(detection.mask)
            judge = Judge(masked, detection.box, self.model, self.renderer)
            refined = self._refined(masked, judge, [h.T_cam_obj for h in first], 0.5 * least)
            done = time.perf_counter()
            timings = {"first_pose": searched - started, "refine": done - searched, "total": done - started}
            estimates.append(self._choose(masked, judge, refined, detection, timings))
        return estimates

    def refine(self, view: View, T_cam_obj: Pose) -> Estimate:
        """Refine a known pose; view.mask, where there is one, helps. Where it does not converge within a few
        iterations, the four poses turned by 12 degrees towards a tetrahedron's corners compete with it."""
        started = time.perf_counter()
        options, judge = self.refine_options, self._judge_of(view, T_cam_obj)
        if self.options.beside and options.stop == "angle" and options.iterations > HEATS:
            heats = self._heats(view, [T_cam_obj])
            if not heats[0].converged:
                heats += self._heats(view, poses_beside(T_cam_obj, self.model, BESIDE))
            refined = self._finals(view, judge, heats)
        else:
            refined = refine(view, self.model, [T_cam_obj], self.predictor, self.renderer, options)
        seconds = time.perf_counter() - started
        found = self._choose(view, judge, refined, None, {"refine": seconds, "total": seconds})
        return nearest_to(T_cam_obj, found, self.model, Branch.GIVEN)

    def _refined(self, view: View, judge: Judge, starts: Sequence[Pose], least: float) -> list[Refinement]:
        """Every start for a few iterations, and the best of them to the end, unless its score is below ``least``."""
        options = self.refine_options
        if len(starts) <= FINALISTS or options.iterations <= HEATS:
            return refine(view, self.model, starts, self.predictor, self.renderer, options)
        heats = self._best(judge, self._heats(view, starts, FIRST), max(SEMIFINALISTS, self.options.top))
        heats = self._onward(view, heats, HEATS - FIRST)
        if least > 0 and self._last_look(view, self._best(judge, heats, 1)[0].T_cam_obj)[0] < least:
            return heats
        return self._finals(view, judge, heats)

    def _heats(self, view: View, starts: Sequence[Pose], iterations: int = HEATS) -> list[Refinement]:
        short = replace(self.refine_options, iterations=iterations)
        return refine(view, self.model, starts, self.predictor, self.renderer, short)

    def _finals(self, view: View, judge: Judge, heats: Sequence[Refinement]) -> list[Refinement]:
        """The best go on to the end."""
        finalists = self._best(judge, heats, max(FINALISTS, self.options.top))
        return self._onward(view, finalists, self.refine_options.iterations - HEATS)

    def _best(self, judge: Judge, heats: Sequence[Refinement], count: int) -> list[Refinement]:
        order = np.argsort([-s for s in self._scores(judge, heats)], kind="stable")
        return [heats[k] for k in order[:count]]

    def _onward(self, view: View, heats: Sequence[Refinement], iterations: int) -> list[Refinement]:
        """So many more; with the paper's policy only for what has not converged."""
        options = replace(self.refine_options, iterations=iterations)
        there = [heat.converged and options.stop == "angle" for heat in heats]
        poses = [heat.T_cam_obj for heat, done in zip(heats, there, strict=True) if not done]
        ends = iter(refine(view, self.model, poses, self.predictor, self.renderer, options))
        return [heat if done else heat.then(next(ends), options.stop) for heat, done in zip(heats, there, strict=True)]

    def first_poses(self, view: View, detection: Detection) -> list[Hypothesis]:
        """The first poses that ``options.init`` gives, best first; those for a detection's rough mask come last. Those
        that the mesh's texture gives come before ``templates``'s."""
        if self._search is None:
            self._search = BoxSearch(self.model, self.renderer)
        found: list[Hypothesis] = []
        for mask in (detection.mask, detection.rough):
            if mask is not None or not found:
                box = detection.box if mask is None or detection.rough is None else mask_box(mask) or detection.box
                found += self._search.search(view, replace(detection, box=box, mask=mask), self.options.hypotheses)
        if self.options.init != "templates":
            return found
        textured = self._features.search(view, detection.box)
        return [Hypothesis(each.T_cam_obj, each.share) for each in textured] + found

    def _choose(
        self,
        view: View,
        judge: Judge,
        refined: Sequence[Refinement],
        detection: Detection | None,
        timings: dict[str, float],
    ) -> Estimate:
        """The hypothesis with the best score: much evidence in the photograph, and a low predicted angle. The next best
        ones that differ from it and from each other are its alternatives."""
        first, *others = self._best(judge, refined, len(refined) if self.options.top > 1 else 1)
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
        best, contour_std = self._on_contour(view, refined)
        presence, angle = self._last_look(view, best.T_cam_obj)
        return Estimate(
            T_cam_obj=best.T_cam_obj,
            angle=angle,
            contour_std=contour_std,
            iterations=best.iterations,
            converged=(angle if contour_std is None else contour_std) < self.refine_options.stop_angle,
            branch=Branch.ANY if self.model.symmetries else None,
            score=presence,
            box=self._box(view, best.T_cam_obj),
            model=self.model.name,
            detection=detection,
            trace=best.trace,
            timings=timings,
        )

    def _on_contour(self, view: View, refined: Refinement) -> tuple[Refinement, float | None]:
        """With its outline on the mask's, where there is an exact one, and the fit's standard deviation; else as it is,
        and None."""
        if self.options.contour and view.mask is not None:
            fit = fit_contour(view, self.model, refined.T_cam_obj, self.renderer)
            if fit is not None and fit.exact:
                return replace(refined, T_cam_obj=fit.T_cam_obj), fit.turn_std
        return refined, None

    def _last_look(self, view: View, T_cam_obj: Pose) -> tuple[float, float]:
        """How sure it is that the photograph shows the object there, by what the network sees of it; and the rotation
        error that the network predicts there, radians."""
        outline = self.model.outline - self.model.center
        [prediction], [observed], [rendered] = compare(
            view, self.model, outline, [T_cam_obj], self.predictor, self.renderer
        )
        found = prediction.correspondences
        error = float(np.median(found.scale_px)) if found is not None and len(found.scale_px) else USUAL
        update = self.refine_options.update
        outlined = self.refine_options.outline
        updated = update_pose(T_cam_obj, self.model, prediction, observed, rendered, update, outlined)
        angle = predicted_angle(T_cam_obj, prediction, updated, update)
        return presence(agreement_of(observed, rendered).structure, error, angle), angle

    def _scores(self, judge: Judge, refined: Sequence[Refinement]) -> list[float]:
        evidence = judge.scores([r.T_cam_obj for r in refined])
        return [score(r.angle, each) for r, each in zip(refined, evidence, strict=True)]

    def _judge_of(self, view: View, T_cam_obj: Pose) -> Judge:
        """Of a known pose's surroundings."""
        return Judge(view, self._box(view, T_cam_obj), self.model, self.renderer)

    def _box(self, view: View, T_cam_obj: Pose) -> Box:
        points = T_cam_obj.apply(self.model.outline)
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
    ) -> None:
        self.networks, self.options = load_networks(preset, weights).moved(choose_device(device)), options
        self._made: dict[ObjectModel, PoseEstimator] = {}

    def __call__(self, model: ObjectModel) -> PoseEstimator:
        if model not in self._made:
            self._made[model] = PoseEstimator(model, options=self.options, networks=self.networks)
        return self._made[model]


def nearest_to(reference: Pose, estimate: Estimate, model: ObjectModel, branch: Branch) -> Estimate:
    """An estimate of an object with symmetries in the equivalent pose nearest to a reference; others as they are."""
    if not model.symmetries:
        return estimate
    return replace(estimate, T_cam_obj=model.symmetries.nearest(estimate.T_cam_obj, reference), branch=branch)


def score(angle: float, evidence: float) -> float:
    """What hypotheses are chosen by, of a predicted angle (radians) and the evidence: docs/decisions/0018."""
    return evidence - DOUBT * angle


def presence(structure: float, error_px: float, angle: float) -> float:
    """Between 0 and 1: how likely it is that the object is there in this pose. structure: `Agreement`'s, how alike the
    brightness gradients of picture and drawing are. error_px: median of the errors that the network expects of its
    correspondences, pixels of the crop. angle: predicted rotation error, radians. A logistic function fitted to
    estimates of objects, shown and not shown, in composed scenes: docs/decisions/0020."""
    degrees = max(float(np.rad2deg(angle)), SMALLEST)
    total = STRUCTURE * structure + BLUR * np.log(error_px) + ANGLE * np.log(degrees) + BIAS
    return float(1 / (1 + np.exp(-total)))

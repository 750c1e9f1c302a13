"""How good networks are: the refinement loop on cases that the training does not see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from posekit.datasets.bop import BopDataset
from posekit.estimate.refine import RefineOptions, refine
from posekit.first_pose.hypotheses import FirstPoseSearch
from posekit.first_pose.mvnet import mvnet_search
from posekit.geometry import Pose
from posekit.mesh.model import ObjectModel
from posekit.metrics import add, pose_error, within
from posekit.nets.pytorch import NetworkPredictor
from posekit.nets.weights import Networks
from posekit.render import Renderer
from posekit.results import Detection, Source
from posekit.synth.appearance import variants
from posekit.synth.procedural import random_object
from posekit.train.data.augment import AugmentConfig, observe
from posekit.train.data.crops import (
    SceneConfig,
    disturbed_box,
    disturbed_pose,
    render_scenes,
    usable_instances,
    view_of,
)
from posekit.view import View

ITERATIONS = 4
HELD_BACK = 1_000_003  # the seed of held-back cases, apart from all that trainings use


@dataclass(frozen=True, eq=False)
class Case:
    """An observed object, where it is and from where the loop starts (``T_cam_obj``), and its detection."""

    view: View
    model: ObjectModel
    truth: Pose
    start: Pose
    detection: Detection


@dataclass(frozen=True, eq=False)
class CaseSource:
    """What renderings for cases are made of. models: in turn; none = new procedural objects. unlike, deformed,
    scans: the shares of cases whose mesh has other colours than the object that is shown, or another shape
    (`appearance.variants`)."""

    models: Sequence[ObjectModel]
    photos: Sequence[NDArray[np.uint8]]
    scenes: SceneConfig
    augment: AugmentConfig
    unlike: float = 0.0
    deformed: float = 0.0
    scans: float = 0.0


def rendered_cases(source: CaseSource, renderer: Renderer, count: int, seed: int = HELD_BACK) -> list[Case]:
    """``count`` augmented renderings."""
    models, photos, config, augment = source.models, source.photos, source.scenes, source.augment
    rng = np.random.default_rng(seed)
    cases: list[Case] = []
    others: list[NDArray[np.uint8]] = []
    while len(cases) < count:
        model = models[len(cases) % len(models)] if models else random_object(rng, photos)
        known, shown = variants(model, photos, source.unlike, source.deformed, rng, source.scans)
        for scene in render_scenes(renderer, shown, 1, config, rng):
            picture, _ = observe(scene.rgba, others, photos, replace(augment, no_mask=0.0), rng)
            others.append(scene.rgba)
            view = view_of(picture, scene.camera)
            truth = scene.T_view_ctr @ shown.T_ctr_obj
            detection = Detection(disturbed_box(scene.box, config, rng), mask=view.mask, source=Source.MASK)
            cases.append(_case(view, known, truth, detection, rng))
    return cases


def bop_cases(dataset: BopDataset, count: int) -> list[Case]:
    """At most ``count`` annotated objects, over 90 % visible, spread evenly over a data set."""
    found = usable_instances(dataset, SceneConfig(visible=0.9))
    chosen = [found[int(k)] for k in np.unique(np.linspace(0, len(found) - 1, min(count, len(found))).astype(int))]
    rng = np.random.default_rng(HELD_BACK)
    cases = []
    for instance in chosen:
        mask = instance.mask()
        if mask.any() and instance.box_visib is not None:
            view = dataset.view(instance.scene, instance.image).with_mask(mask)
            detection = Detection(instance.box_visib, mask=mask, source=Source.MASK)
            cases.append(_case(view, dataset.model(instance.obj_id), instance.T_cam_obj, detection, rng))
    return cases


def _case(view: View, model: ObjectModel, truth: Pose, detection: Detection, rng: np.random.Generator) -> Case:
    """Starts from DeepIM's disturbance."""
    start = disturbed_pose(truth @ model.T_obj_ctr, model.diameter, rng) @ model.T_ctr_obj
    return Case(view, model, truth, start, detection)


def measure(cases: Sequence[Case], networks: Networks, renderer: Renderer) -> dict[str, float]:
    """Errors after `ITERATIONS` refinements from the disturbed truth, and of MV-Net's first poses where there is one.

    rotation_deg, translation_cm: medians. within_5: share within (5 degrees, 5 cm). add: mean distance of the model's
    points in diameters, at most 0.5. start_*: the same before. first_*: MV-Net's.
    """
    predictor = NetworkPredictor(networks)
    update = "correspondence" if networks.dense else "regression"
    options = RefineOptions(update=update, stop="fixed", iterations=ITERATIONS)
    poses = [refine(c.view, c.model, [c.start], predictor, renderer, options)[0].T_cam_obj for c in cases]
    found = _errors(cases, poses) | {f"start_{k}": v for k, v in _errors(cases, [c.start for c in cases]).items()}
    if networks.mvnet is not None:
        found |= {f"first_{k}": v for k, v in _first_poses(cases, networks, renderer).items()}
    return found


def _first_poses(cases: Sequence[Case], networks: Networks, renderer: Renderer) -> dict[str, float]:
    searches: dict[int, FirstPoseSearch] = {}
    turns = []
    for case in cases:
        if id(case.model) not in searches:
            searches[id(case.model)] = mvnet_search(case.model, networks, renderer)
        found = searches[id(case.model)].search(case.view, case.detection, 1)
        turn = pose_error(found[0].T_cam_obj, case.truth, case.model.symmetries.transforms())[0] if found else np.pi
        turns.append(float(np.rad2deg(turn)))
    return {"rotation_deg": float(np.median(turns)), "within_25deg": float(np.mean(np.array(turns) < 25))}


def _errors(cases: Sequence[Case], poses: Sequence[Pose]) -> dict[str, float]:
    pairs = [pose_error(p, c.truth, c.model.symmetries.transforms()) for p, c in zip(poses, cases, strict=True)]
    turns, shifts = (np.array(values, dtype=np.float64) for values in zip(*pairs, strict=True))
    distances = [
        min(
            0.5,
            min(float(add(p, c.truth @ S, c.model.hull_vertices)) for S in c.model.symmetries.transforms())
            / c.model.diameter,
        )
        for p, c in zip(poses, cases, strict=True)
    ]
    return {
        "rotation_deg": float(np.rad2deg(np.median(turns))),
        "translation_cm": float(100 * np.median(shifts)),
        "within_5": float(within(turns, shifts, 5, 5).mean()),
        "add": float(np.mean(distances)),
    }

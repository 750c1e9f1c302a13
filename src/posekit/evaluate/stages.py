"""What is done with one picture: refine from disturbed truth, or estimate from detections.

A picture's record is plain JSON, so that it can be kept, and is the same whatever was computed before it: random
numbers come from a seed of the instance's own.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from posekit.camera import mask_box
from posekit.data.datasets import open_dataset
from posekit.detect import BoxPrompt, Detector
from posekit.detect.prompts import clip_box
from posekit.detect.segmentation import encode
from posekit.errors import ConfigError, PromptError
from posekit.estimate import Estimators, PoseEstimator
from posekit.evaluate.bop_results import FoundRegion, read_detections
from posekit.evaluate.options import DETECTOR, GIVEN, EvalOptions
from posekit.evaluate.tracking import Sequences
from posekit.evaluate.truths import Truth, TruthReader, selected
from posekit.geometry import Pose
from posekit.metrics import box_iou
from posekit.novel import make_detector
from posekit.object_model import ObjectModel
from posekit.results import Detection, Estimate, Source
from posekit.search import SearchOptions, find_instances, judged
from posekit.view import View

Record = dict[str, Any]
IGNORED_BELOW = 0.1  # visible share below which BOP's detection measures ignore a truth


class ImageStage:
    """Runs a stage on pictures, one after the other; one object in each worker."""

    def __init__(self, options: EvalOptions) -> None:
        self.options = options
        self.data, self.info = open_dataset(options.dataset, options.root, options.split)
        self.truths = TruthReader(self.data)
        self._estimators: Estimators | None = None
        self._sequences = Sequences(self._estimator, "openvino" if options.preset == "lite" else "torch")
        self._files: Mapping[tuple[int, int], Sequence[FoundRegion]] = {}
        self._detector: Detector | None = None
        if options.stage == "estimate" and options.detections not in (*GIVEN, DETECTOR):
            self._files = detections_for(self.data, options)

    def run(self, scene: int, image: int) -> Record:
        """A picture's record: truths, estimates, and how detections overlap with truths."""
        truths = self.truths.read(scene, image)
        chosen = selected(self.data, truths, scene, image, self.options)
        record: Record = {"scene": scene, "image": image, "truths": [_truth(t, chosen) for t in truths]}
        detects = self.options.stage == "estimate" and self.options.detections == DETECTOR
        wanted = chosen or (scene, image) in self._files or self.options.stage == "track" or detects
        view = self.data.view(scene, image) if wanted else None
        if view is not None and detects:
            record["estimates"], found = self._detected(view, scene, image)
            record["detections"] = overlaps(found, truths)
            return record
        record["estimates"] = [] if view is None else self._estimates(view, truths, chosen)
        if self._files:
            record["detections"] = overlaps(self._files.get((scene, image), ()), truths)
        return record

    def _estimates(self, view: View, truths: list[Truth], chosen: list[Truth]) -> list[Record]:
        if self.options.stage == "refine":
            return [self._refined(view, truth) for truth in chosen]
        if self.options.stage == "track":
            return self._tracked(view, truths, chosen)
        if self.options.detections in GIVEN:
            found = [self._from_truth(view, truth) for truth in chosen]
            return [entry for entry in found if entry is not None]
        scene, image = truths[0].instance.scene, truths[0].instance.image
        return self._from_file(view, self._files.get((scene, image), ()))

    def _tracked(self, view: View, truths: list[Truth], chosen: list[Truth]) -> list[Record]:
        """Of every object that is not lost, with its state."""
        if not truths:
            return []
        found = self._sequences.step(truths[0].instance.scene, view, truths, chosen)
        entries = [(each.state, _entry(each.estimate, obj_id, index)) for each, obj_id, index in found if each.estimate]
        return [entry | {"state": state} for state, entry in entries]

    def _refined(self, view: View, truth: Truth) -> Record:
        instance, estimator = truth.instance, self._estimator(truth.instance.obj_id)
        start = disturbed(truth, estimator, self.options)
        mask = truth.read_mask() if self.options.masks == "true" else None
        estimate = estimator.refine(view.with_mask(mask), start)
        return _entry(estimate, instance.obj_id, instance.index) | {"start": start.matrix.tolist()}

    def _from_truth(self, view: View, truth: Truth) -> Record | None:
        """From an instance's own box or mask; None where nothing of it is seen, or no pose was found."""
        estimator, mask = self._estimator(truth.instance.obj_id), truth.read_mask()
        if self.options.detections == "gt-masks":
            box = mask_box(mask)
            detections = [] if box is None else [Detection(box, mask, 1.0, estimator.model.name, Source.MASK)]
        else:
            detections = _prompted(view, truth.box_visib, estimator)
        [found] = find_instances(self._estimators_of, view, [estimator.model], detections)
        return _entry(found.instances[0], truth.instance.obj_id, truth.instance.index) if found.instances else None

    def _from_file(self, view: View, regions: Sequence[FoundRegion]) -> list[Record]:
        """Of every object that the file has in this picture, as `posekit estimate --detections` finds them."""
        numbers = [k for k in dict.fromkeys(r.obj_id for r in regions) if k in (self.options.objects or (k,))]
        entries = []
        for obj_id in numbers:
            model = self.data.model(obj_id)
            detections = [d for r in regions if r.obj_id == obj_id for d in self._told(view, r, model.name)]
            [found] = find_instances(self._estimators_of, view, [model], detections)
            entries += [_entry(e, obj_id, None) | {"detection_score": _detection_score(e)} for e in found.instances]
        return entries

    def _told(self, view: View, region: FoundRegion, name: str) -> list[Detection]:
        """A file's region as a detection; none where its box lies outside the picture. Raises ConfigError."""
        mask = region.mask()
        if mask is not None and mask.shape != view.image.shape[:2]:
            raise ConfigError(
                f"{self.options.detections}: a mask of scene {region.scene}, image {region.image} is "
                f"{mask.shape[1]}x{mask.shape[0]}, the picture {view.camera.width}x{view.camera.height}."
            )
        try:
            box = clip_box(region.box, view.camera)
        except PromptError:
            return []
        return [Detection(box, mask if mask is not None and mask.any() else None, region.score, name, Source.FILE)]

    def _detected(self, view: View, scene: int, image: int) -> tuple[list[Record], list[FoundRegion]]:
        """Estimates from what the detector finds of the data set's objects, and the detections. As `posekit estimate`
        does, only what the render bears out is kept, but any number of instances; detections are scored by the poses
        that they lead to."""
        numbers = self.options.objects or tuple(self.data.model_ids())
        models = {obj_id: self.data.model(obj_id) for obj_id in numbers}
        if self._detector is None:
            self._detector, _ = make_detector(self.options.detector, list(models.values()), doubtful=True)
        started = time.perf_counter()
        found = self._detector.detect(view, list(models.values()))
        seconds = time.perf_counter() - started
        entries, regions = [], []
        results = find_instances(self._estimators_of, view, list(models.values()), found, SearchOptions(instances=0))
        for obj_id, each in zip(models, results, strict=True):
            regions += [_region(d, scene, image, obj_id, seconds) for d in judged(each)]
            entries += [_entry(e, obj_id, None) | {"detection_score": _detection_score(e)} for e in each.instances]
        return entries, regions

    def _estimators_of(self, model: ObjectModel) -> PoseEstimator:
        if self._estimators is None:
            o = self.options
            self._estimators = Estimators(preset=o.preset, weights=o.weights, options=o.estimate, device=o.device)
        return self._estimators(model)

    def _estimator(self, obj_id: int) -> PoseEstimator:
        return self._estimators_of(self.data.model(obj_id))


def _detection_score(estimate: Estimate) -> float:
    assert estimate.detection is not None
    return estimate.detection.score


def disturbed(truth: Truth, estimator: PoseEstimator, options: EvalOptions) -> Pose:
    """The truth disturbed about the object's centre, by random numbers of this instance alone."""
    i, model = truth.instance, estimator.model
    rng = np.random.default_rng([options.seed, i.scene, i.image, i.index])
    return options.pose_noise.disturb(i.T_cam_obj @ model.T_obj_ctr, rng) @ model.T_obj_ctr.inverse()


def detections_for(data: Any, options: EvalOptions) -> dict[tuple[int, int], list[FoundRegion]]:
    """A detections file, checked against the whole data set."""
    known = dict.fromkeys(data.images(), ())
    return read_detections(Path(options.detections), known, data.model_ids())


def _region(detection: Detection, scene: int, image: int, obj_id: int, seconds: float) -> FoundRegion:
    rle = None if detection.mask is None else encode(detection.mask)
    return FoundRegion(scene, image, obj_id, detection.box, detection.score, rle, seconds)


def _prompted(view: View, box: Any, estimator: PoseEstimator) -> list[Detection]:
    """A box as a person would give it; none where it is empty or outside the picture."""
    if box is None:
        return []
    try:
        clip_box(box, view.camera)
    except PromptError:
        return []
    return BoxPrompt(box).detect(view, [estimator.model])


def _truth(truth: Truth, chosen: list[Truth]) -> Record:
    i = truth.instance
    counted = any(truth is other for other in chosen)
    return {"index": i.index, "obj_id": i.obj_id, "visible": truth.visible, "counted": counted, "mask": truth.source}


def _entry(estimate: Estimate, obj_id: int, index: int | None) -> Record:
    return {
        "obj_id": obj_id,
        "index": index,
        "T_cam_obj": estimate.T_cam_obj.matrix.tolist(),
        "score": float(estimate.score),
        "angle_deg": float(np.rad2deg(estimate.angle)),
        "iterations": int(estimate.iterations),
        "converged": bool(estimate.converged),
        "seconds": estimate.timings["total"],
        "trace": [[step.T_cam_obj.matrix.tolist(), float(np.rad2deg(step.angle))] for step in estimate.trace],
    }


def overlaps(found: Sequence[FoundRegion], truths: Sequence[Truth]) -> dict[str, Record]:
    """For each object the detections' scores, and their IoU with the truths by box and by mask."""
    result: dict[str, Record] = {}
    for obj_id in sorted({r.obj_id for r in found} | {t.instance.obj_id for t in truths}):
        regions = [r for r in found if r.obj_id == obj_id]
        here = [t for t in truths if t.instance.obj_id == obj_id]
        shape = (len(regions), len(here))
        boxes = [t.box_all or (0.0, 0.0, 0.0, 0.0) for t in here]
        masked = bool(regions) and all(r.rle is not None for r in regions)
        result[str(obj_id)] = {
            "scores": [r.score for r in regions],
            "ignored": [t.visible < IGNORED_BELOW for t in here],
            "box_iou": box_iou([r.box for r in regions], boxes).reshape(shape).tolist(),
            "mask_iou": mask_iou(regions, here).tolist() if masked or not regions else None,
        }
    return result


def mask_iou(regions: Sequence[FoundRegion], truths: Sequence[Truth]) -> NDArray[np.float64]:
    """(D, G)."""
    found, true = [r.mask() for r in regions], [t.read_mask() for t in truths]
    iou = np.zeros((len(found), len(true)))
    for d, a in enumerate(found):
        for g, b in enumerate(true):
            either = (a | b).sum() if a is not None else 0
            iou[d, g] = (a & b).sum() / either if a is not None and either else 0.0
    return iou


def run_once(stage: ImageStage, scene: int, image: int) -> Record:
    """A picture's record with the seconds it took."""
    started = time.perf_counter()
    record = stage.run(scene, image)
    return record | {"seconds": time.perf_counter() - started}

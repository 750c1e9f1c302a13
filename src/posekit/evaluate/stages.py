"""What is done with one picture: refine from disturbed truth, or estimate from detections.

A picture's record is plain JSON, so that it can be kept, and is the same whatever was computed before it: random
numbers come from a seed of the instance's own.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from posekit.camera import Box, box_iou, mask_box, mask_iou
from posekit.datasets.registry import open_dataset
from posekit.datasets.results_csv import FoundRegion, read_detections
from posekit.detect import BoxPrompt, Detector
from posekit.detect.external import are_corners
from posekit.detect.novel import make_detector
from posekit.detect.prompts import clip_box
from posekit.detect.segmentation import encode, xywh
from posekit.errors import PromptError
from posekit.estimate.estimator import Estimators, PoseEstimator
from posekit.estimate.instances import SearchOptions, find_instances, scored_by_poses
from posekit.evaluate.options import DETECTOR, GIVEN, RBOT, EvalOptions
from posekit.evaluate.rbot import RbotProtocol
from posekit.evaluate.tracking import Sequences
from posekit.evaluate.truths import Truth, TruthReader, pictures, selected
from posekit.geometry import Pose
from posekit.mesh.model import ObjectModel
from posekit.results import Detection, Estimate, Source
from posekit.view import View

log = logging.getLogger("posekit")

Record = dict[str, Any]
Regions = Mapping[tuple[int, int], Sequence[FoundRegion]]  # by scene and image
IGNORED_BELOW = 0.1  # visible share below which BOP's detection measures ignore a truth


class ImageStage:
    """Runs a stage on pictures, one after the other; one object in each worker. files: what `detections_for` read."""

    def __init__(self, options: EvalOptions, files: Regions | None = None) -> None:
        self.options = options
        self.data, self.info = open_dataset(
            options.dataset, options.root, options.split, options.units, options.targets
        )
        self.truths = TruthReader(self.data)
        self._estimators: Estimators | None = None
        runtime = "openvino" if options.preset == "lite" else "torch"
        self._sequences = Sequences(self._estimator, runtime)
        self._rbot = RbotProtocol(self.data, self._estimator, runtime, options.resets)
        self._files: Regions = detections_for(self.data, options) if files is None else files
        self._detector: Detector | None = None

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
        if view is not None and self.options.protocol == RBOT:
            return record | self._judged(record["truths"], view, truths, chosen)
        regions = [] if view is None else self._regions(view, scene, image)
        record["estimates"] = [] if view is None else self._estimates(view, truths, chosen, regions)
        if self._files:
            record["detections"] = overlaps(regions, truths)
        return record

    def _estimates(
        self, view: View, truths: list[Truth], chosen: list[Truth], regions: Sequence[FoundRegion]
    ) -> list[Record]:
        if self.options.stage == "refine":
            return [self._refined(view, truth) for truth in chosen]
        if self.options.stage == "track":
            return self._tracked(view, truths, chosen)
        if self.options.detections in GIVEN:
            found = [self._from_truth(view, truth) for truth in chosen]
            return [entry for entry in found if entry is not None]
        return self._from_file(view, regions)

    def _tracked(self, view: View, truths: list[Truth], chosen: list[Truth]) -> list[Record]:
        """Of every object that is not lost, with its state."""
        if not truths:
            return []
        found = self._sequences.step(truths[0].instance.scene, view, truths, chosen)
        entries = [(each.state, _entry(each.estimate, obj_id, index)) for each, obj_id, index in found if each.estimate]
        return [entry | {"state": state} for state, entry in entries]

    def _judged(self, entries: list[Record], view: View, truths: list[Truth], chosen: list[Truth]) -> Record:
        """Truths and estimates by RBOT's protocol. A pose that was given is no estimate, and its frame not counted."""
        if not truths:
            return {"estimates": []}
        judged = self._rbot.step(truths[0].instance.scene, view, chosen)
        by_index = {each.truth.instance.index: each for each in judged}
        for entry in entries:
            each = by_index.get(entry["index"])
            entry["counted"] = each is not None and not each.given
            if each is not None and not each.given:
                entry |= {"right": each.right, "reset": each.reset}
        return {
            "truths": entries,
            "estimates": [
                _entry(e.found.estimate, e.truth.instance.obj_id, e.truth.instance.index) | {"state": e.found.state}
                for e in judged
                if not e.given and e.found.estimate is not None
            ],
        }

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
            detections = [_detection(view, r, model.name) for r in regions if r.obj_id == obj_id]
            [found] = find_instances(self._estimators_of, view, [model], detections)
            entries += [_entry(e, obj_id, None) | {"detection_score": _detection_score(e)} for e in found.instances]
        return entries

    def _regions(self, view: View, scene: int, image: int) -> list[FoundRegion]:
        """What the file has for a picture; what does not fit the picture is skipped and logged."""
        found = []
        for region in self._files.get((scene, image), ()):
            try:
                clip_box(region.box, view.camera)
                region.mask(view.camera.size)
                found.append(region)
            except PromptError as error:
                log.warning("%s, line %d (scene %d, image %d): the entry is skipped: %s", self.options.detections,
                            region.line, scene, image, error)  # fmt: skip
        return found

    def _detected(self, view: View, scene: int, image: int) -> tuple[list[Record], list[FoundRegion]]:
        """Estimates from what the detector finds of the data set's objects, and the detections. As `posekit estimate`
        does, only what the rendering confirms is kept, but any number of instances; detections are scored by the poses
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
            regions += [_region(d, scene, image, obj_id, seconds) for d in scored_by_poses(each)]
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
    return options.pose_noise.disturb(i.T_cam_obj @ model.T_obj_ctr, rng) @ model.T_ctr_obj


def detections_for(data: Any, options: EvalOptions) -> Regions:
    """The detections file of the options, by picture, checked against the whole data set; empty where they name none.
    Raises InputError."""
    if options.stage != "estimate" or options.detections in (*GIVEN, DETECTOR):
        return {}
    found = read_detections(Path(options.detections), dict.fromkeys(data.images(), ()), data.model_ids())
    here = next((picture for picture in pictures(data, options) if picture in found), None)
    boxes = [xywh(region.box) for regions in found.values() for region in regions]
    if here is None or not are_corners(boxes, data.picture_size(*here), options.detections):
        return found
    return {k: [replace(r, box=_edges(r)) for r in regions] for k, regions in found.items()}


def _edges(region: FoundRegion) -> Box:
    """What was read as x, y, width, height."""
    x0, y0, x1, y1 = xywh(region.box)
    return x0, y0, x1, y1


def _detection(view: View, region: FoundRegion, name: str) -> Detection:
    """A file's region, which fits the picture, as a detection."""
    mask = region.mask(view.camera.size)
    box = clip_box(region.box, view.camera)
    return Detection(box, mask if mask is not None and mask.any() else None, region.score, name, Source.FILE)


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
        boxes = [t.box_all or (0.0, 0.0, 0.0, 0.0) for t in here]
        masked = bool(regions) and all(r.rle is not None for r in regions)
        result[str(obj_id)] = {
            "scores": [r.score for r in regions],
            "ignored": [t.visible < IGNORED_BELOW for t in here],
            "box_iou": box_iou(_rows(r.box for r in regions)[:, None], _rows(boxes)[None]).tolist(),
            "mask_iou": _mask_overlaps(regions, here).tolist() if masked or not regions else None,
        }
    return result


def _rows(boxes: Iterable[Box]) -> NDArray[np.float64]:
    """(N, 4), where there are none too."""
    return np.array(list(boxes), dtype=np.float64).reshape(-1, 4)


def _mask_overlaps(regions: Sequence[FoundRegion], truths: Sequence[Truth]) -> NDArray[np.float64]:
    """(D, G)."""
    found, true = [r.mask() for r in regions], [t.read_mask() for t in truths]
    iou = [[0.0 if a is None else mask_iou(a, b) for b in true] for a in found]
    return np.array(iou, dtype=np.float64).reshape(len(found), len(true))


def run_once(stage: ImageStage, scene: int, image: int) -> Record:
    """A picture's record with the seconds it took."""
    started = time.perf_counter()
    record = stage.run(scene, image)
    return record | {"seconds": time.perf_counter() - started}

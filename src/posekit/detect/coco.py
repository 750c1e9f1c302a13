"""COCO's measure of detections: average precision."""

from __future__ import annotations

import contextlib
import io
import itertools
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from posekit.camera import mask_box
from posekit.detect.maskrcnn import Found
from posekit.detect.segmentation import Mask, encode, xywh


@dataclass(frozen=True, eq=False)
class Truth:
    """The instances of a picture. labels: (N,), numbers of classes; masks: N of bool (H, W), none empty. ignored:
    (N,), True where finding one counts neither for nor against (COCO's crowds); empty = none."""

    labels: NDArray[np.int64]
    masks: Sequence[Mask]
    ignored: Sequence[bool] = ()


def average_precision(truths: Sequence[Truth], found: Sequence[Found]) -> dict[str, float]:
    """COCO's measures over pictures, by pycocotools: box_ap, box_ap50, mask_ap, mask_ap50, in [0, 1].

    0 where there is no instance at all.
    """
    annotations: list[dict[str, Any]] = []
    results: list[dict[str, Any]] = []
    for image, (truth, here) in enumerate(zip(truths, found, strict=True)):
        for k, (label, mask) in enumerate(zip(truth.labels, truth.masks, strict=True)):
            box = mask_box(mask)
            assert box is not None
            ignored = int(bool(len(truth.ignored)) and truth.ignored[k])
            annotations.append({"id": len(annotations) + 1, "image_id": image, "category_id": int(label) + 1,
                                "bbox": xywh(box), "area": float(mask.sum()), "iscrowd": ignored,
                                "segmentation": encode(mask)})  # fmt: skip
        for k, label in enumerate(here.labels):
            x0, y0, x1, y1 = (float(v) for v in here.boxes[k])
            results.append({"image_id": image, "category_id": int(label) + 1, "bbox": xywh((x0, y0, x1, y1)),
                            "score": float(here.scores[k]), "segmentation": encode(here.masks[k])})  # fmt: skip
    sizes = [here.masks.shape[1:] for here in found]
    out = {}
    for kind, name in (("bbox", "box"), ("segm", "mask")):
        out[f"{name}_ap"], out[f"{name}_ap50"] = _evaluate(annotations, results, sizes, kind)
    return out


@dataclass(frozen=True, eq=False)
class Overlaps:
    """Detections and instances of one class in one picture. scores: (D,). ignored: (G,), True where finding an
    instance counts neither for nor against. iou: (D, G), of boxes or of masks."""

    scores: NDArray[np.float64]
    ignored: NDArray[np.bool_]
    iou: NDArray[np.float64]


def average_precision_of_overlaps(pictures: Sequence[Overlaps]) -> tuple[float, float]:
    """COCO's AP and AP50 of one class by pycocotools, in [0, 1], from overlaps that are known; 100 detections of a
    picture count. Unlike COCO's crowds, an ignored instance excuses one detection only, as the BOP challenge has it.
    NaN where there is nothing to be found."""
    if all(each.ignored.all() for each in pictures):
        return math.nan, math.nan
    evaluation = _KnownOverlaps(pictures)
    evaluation.evaluate()
    evaluation.accumulate()
    precision = evaluation.eval["precision"][:, :, 0, 0, 0]  # (thresholds, recalls)
    return float(precision.mean()), float(precision[0].mean())


class _KnownOverlaps(COCOeval):  # type: ignore[misc]
    """pycocotools' evaluation with overlaps that are given instead of computed."""

    def __init__(self, pictures: Sequence[Overlaps]) -> None:
        super().__init__(iouType="bbox")
        self.pictures = pictures
        self.params.imgIds, self.params.catIds = list(range(len(pictures))), [1]
        self.params.areaRng, self.params.areaRngLbl, self.params.maxDets = [[0, 1e10]], ["all"], [100]

    def evaluate(self) -> None:
        """As COCOeval, which prints."""
        with contextlib.redirect_stdout(io.StringIO()):
            super().evaluate()

    def accumulate(self, p: Any = None) -> None:
        """As COCOeval, which prints."""
        with contextlib.redirect_stdout(io.StringIO()):
            super().accumulate(p)

    def _prepare(self) -> None:
        self._gts: dict[Any, Any] = defaultdict(list)
        self._dts: dict[Any, Any] = defaultdict(list)
        number = itertools.count(1)  # 0 means "not matched"
        for image, here in enumerate(self.pictures):
            common = {"area": 1.0, "iscrowd": 0}
            self._gts[image, 1] = [{**common, "id": next(number), "ignore": int(v)} for v in here.ignored]
            self._dts[image, 1] = [{**common, "id": next(number), "score": float(v)} for v in here.scores]
        self.evalImgs: dict[Any, Any] = defaultdict(list)
        self.eval: dict[str, Any] = {}

    def computeIoU(self, imgId: int, catId: int) -> NDArray[np.float64]:  # noqa: ARG002
        """(D, G), detections by falling score."""
        here = self.pictures[imgId]
        return here.iou[np.argsort(-here.scores, kind="mergesort")[: self.params.maxDets[-1]]]


def _evaluate(
    annotations: Sequence[Mapping[str, Any]],
    results: Sequence[Mapping[str, Any]],
    sizes: Sequence[Sequence[int]],
    kind: str,
) -> tuple[float, float]:
    if not annotations or not results:
        return 0.0, 0.0
    with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints
        coco = COCO()
        coco.dataset = {
            "info": {}, "images": [{"id": k, "height": h, "width": w} for k, (h, w) in enumerate(sizes)],
            "annotations": [dict(a) for a in annotations],
            "categories": [{"id": k} for k in sorted({a["category_id"] for a in annotations})],
        }  # fmt: skip
        coco.createIndex()
        evaluation = COCOeval(coco, coco.loadRes([_for(kind, r) for r in results]), kind)
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
    return float(max(evaluation.stats[0], 0.0)), float(max(evaluation.stats[1], 0.0))


def _for(kind: str, result: Mapping[str, Any]) -> dict[str, Any]:
    """loadRes decides by the keys: boxes without masks, masks without boxes."""
    left_out = "segmentation" if kind == "bbox" else "bbox"
    return {k: v for k, v in result.items() if k != left_out}

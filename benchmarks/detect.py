"""How well objects are found in photographs with known truth.

    python benchmarks/detect.py ROOT [--detector novel|FILE] [--min-visible 0.9] [--images N] [--min-score 0.05]

ROOT is a data set in BOP layout. Prints, for instances at least so visible, the share of those whose object's
best-scored detection overlaps the true box (of the visible part) by half at least, and their mask; for those over 10 %
visible COCO's average precision of boxes and masks, all detections of a picture's own objects counted; and the seconds
of a picture. Detections of meshes that a picture does not show are counted as false alarms.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from posekit.camera import box_iou, mask_box, mask_iou
from posekit.datasets.bop import BopDataset
from posekit.detect.coco import Found, Truth, average_precision
from posekit.detect.novel import make_detector
from posekit.results import Detection

LEAST = 0.1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root")
    parser.add_argument("--detector", default="novel")
    parser.add_argument("--min-visible", type=float, default=0.9)
    parser.add_argument("--images", type=int)
    parser.add_argument("--min-score", type=float, help="least score of a detection; average precision wants it low")
    args = parser.parse_args()
    data = BopDataset(args.root)
    numbers = data.model_ids()
    models = {number: data.model(number) for number in numbers}
    detector, _ = make_detector(args.detector, list(models.values()), min_score=args.min_score)
    by_name = {model.name: number for number, model in models.items()}
    truths: list[Truth] = []
    found: list[Found] = []
    hits: dict[int, list[tuple[bool, bool]]] = {number: [] for number in numbers}
    seconds, alarms, absent = 0.0, 0, 0
    pictures = data.images()
    chosen = np.linspace(0, len(pictures) - 1, min(args.images or len(pictures), len(pictures))).astype(int)
    for k in chosen:
        scene, image = pictures[k]
        view = data.view(scene, image)
        started = time.perf_counter()
        detections = [d for d in detector.detect(view, list(models.values())) if d.label is not None]
        seconds += time.perf_counter() - started
        instances = data.instances(scene, image, every=True)
        shown = {instance.obj_id for instance in instances if instance.visib_fract >= LEAST}
        alarms += len({d.label for d in detections if by_name[d.label or ""] not in shown})
        absent += len(set(numbers) - shown)
        found.append(as_found(detections, by_name, view.camera.size))
        seen = [(instance, instance.mask()) for instance in instances if instance.mask().any()]
        labels = np.array([instance.obj_id for instance, _ in seen], np.int64)
        truths.append(Truth(labels, [mask for _, mask in seen], [i.visib_fract < LEAST for i, _ in seen]))
        for instance, mask in seen:
            if instance.visib_fract >= args.min_visible:
                box = mask_box(mask)
                assert box is not None
                mine = [d for d in detections if by_name[d.label or ""] == instance.obj_id]
                best: Any = max(mine, key=lambda d: d.score, default=None)
                overlaps = (0.0, 0.0)
                if best is not None:
                    overlaps = box_iou(best.box, box), mask_iou(best.mask, mask)
                hits[instance.obj_id].append((overlaps[0] >= 0.5, overlaps[1] >= 0.5))
    for number, rows in hits.items():
        if rows:
            boxes, masks = 100 * np.mean(rows, axis=0)
            print(f"{models[number].name}: {len(rows)} instances, box {boxes:.0f} %, mask {masks:.0f} %")
    boxes, masks = 100 * np.mean([row for rows in hits.values() for row in rows], axis=0)
    print(f"best-scored detection half on it: box {boxes:.1f} %, mask {masks:.1f} %")
    print({name: round(100 * value, 1) for name, value in average_precision(truths, found).items()})
    print(f"false alarms: {alarms} of {absent} meshes that a picture does not show")
    print(f"{seconds / len(chosen):.2f} s a picture")


def as_found(detections: Sequence[Detection], numbers: dict[str, int], size: tuple[int, int]) -> Found:
    masks = [d.mask for d in detections if d.mask is not None]
    return Found(
        np.array([d.box for d in detections], np.float32).reshape(-1, 4),
        np.array([numbers[d.label or ""] for d in detections], np.int64),
        np.array([d.score for d in detections], np.float32),
        np.array(masks, bool).reshape(-1, size[1], size[0]),
    )


if __name__ == "__main__":
    main()

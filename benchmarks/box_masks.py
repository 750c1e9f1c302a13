"""How good the mask is that a box becomes: intersection over union with a BOP data set's visible masks.

python benchmarks/box_masks.py ROOT [--min-visible 0.9]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import cv2
import numpy as np

from posekit.camera import box_mask, mask_iou
from posekit.datasets.bop import BopDataset
from posekit.detect.prompts import clip_box, grabcut_mask

NAMES = ("filled", "grabcut")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root")
    parser.add_argument("--min-visible", type=float, default=0.9)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    data = BopDataset(args.root)
    overlaps: list[list[float]] = []
    objects: list[int] = []
    refused, seconds = 0, 0.0
    for scene, image in data.images():
        view = data.view(scene, image)
        for instance in data.instances(scene, image, every=True):
            if instance.box_obj is None or instance.visib_fract <= args.min_visible:
                continue
            box = clip_box(instance.box_obj, view.camera)
            started = time.perf_counter()
            found = grabcut_mask(view.image, box)
            seconds += time.perf_counter() - started
            filled = box_mask(box, view.camera.size)
            truth = instance.mask()
            refused += found is None
            masks = [filled, filled if found is None else found]
            overlaps.append([mask_iou(mask, truth) for mask in masks])
            objects.append(instance.obj_id)
    report(np.array(overlaps), np.array(objects))
    print(f"{len(objects)} boxes, {refused} where GrabCut was refused, {1000 * seconds / len(objects):.0f} ms each")


def report(overlaps: np.ndarray, objects: np.ndarray) -> None:
    numbers: Sequence[int] = np.unique(objects).tolist()
    print("IoU      mean median  <0.5  " + " ".join(f"obj{k:3d}" for k in numbers))
    for name, values in zip(NAMES, overlaps.T, strict=True):
        each = " ".join(f"{values[objects == k].mean():6.3f}" for k in numbers)
        print(f"{name:8s} {values.mean():.3f} {np.median(values):.3f} {(values < 0.5).mean():5.1%}  {each}")


if __name__ == "__main__":
    main()

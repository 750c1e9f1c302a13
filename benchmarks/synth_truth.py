"""Is a synthetic data set true to itself? Its ground truth scored as estimates, its masks and depth drawn anew.

    python benchmarks/synth_truth.py DIR [--split train]

Prints the measures of `posekit eval --stage score`, all of which have to be 100, and the least overlap (IoU) of the
masks of what nothing hides with the mesh drawn at its pose.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from posekit.camera import mask_iou
from posekit.datasets.bop import BopDataset
from posekit.datasets.results_csv import ResultRow, results_csv
from posekit.evaluate import evaluate
from posekit.evaluate.options import EvalOptions
from posekit.render import Renderer

LEAST = 300  # pixels of a mask whose overlap says something


def score(data: BopDataset, split: str) -> dict[str, float]:
    """The pooled measures of the truth, percent, by the test's own targets."""
    rows = [
        ResultRow(scene, image, i.obj_id, 1.0, i.T_cam_obj.R, i.T_cam_obj.t, 0.5)
        for scene, image in data.images()
        for i in data.instances(scene, image, every=True)
        if i.visib_fract >= 0.1
    ]
    with tempfile.TemporaryDirectory() as folder:
        csv = Path(folder) / "truth.csv"
        csv.write_text(results_csv(rows))
        options = EvalOptions("score", root=data.root, split=split, min_visible=0.1)
        results = evaluate(options, Path(folder) / "out", csv=csv).results
    print(f"{len(data.images())} images, {len(rows)} instances at least 10 % visible; missing:",
          results["counts"]["missing"])  # fmt: skip
    return {key: value for key, value in results["pooled"].items() if isinstance(value, float)}


def overlaps(data: BopDataset) -> list[float]:
    """IoU of each whole mask with the mesh drawn at its pose."""
    renderer, found = Renderer(), []
    for scene, image in data.images():
        camera = data.view(scene, image).camera
        for i in data.instances(scene, image, every=True):
            if i.visib_fract == 1.0 and (mask := i.mask()).sum() > LEAST:
                [drawn] = renderer.render(data.model(i.obj_id), [i.T_cam_obj], camera, rgb=False, coords=False)
                found.append(mask_iou(drawn.mask, mask))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path)
    parser.add_argument("--split", default="train")
    args = parser.parse_args()
    data = BopDataset(args.root, args.split, targets=None)
    print(", ".join(f"{key} {value:g}" for key, value in score(data, args.split).items()))
    found = overlaps(data)
    print(f"masks of {len(found)} instances that nothing hides, drawn anew: IoU at least {np.min(found):.4f}, "
          f"median {np.median(found):.4f}")  # fmt: skip


if __name__ == "__main__":
    main()

"""How long scoring takes: estimates near random truths, held against them in every measure but VSD.

    python benchmarks/score.py ROOT --estimates 100000

ROOT: a data set in BOP layout. The objects take turns; each picture shows one.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from posekit.datasets.bop import BopDataset
from posekit.datasets.registry import dataset_info
from posekit.evaluate.scoring import Case, Guess, score
from posekit.geometry import Pose, PoseNoise, random_rotation

K = np.array([[572.4114, 0, 325.2611], [0, 573.57043, 242.04899], [0, 0, 1]])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path)
    parser.add_argument("--estimates", type=int, default=100_000)
    args = parser.parse_args()
    data, rng, noise = BopDataset(args.root), np.random.default_rng(0), PoseNoise(5.0, 15.0, (0.005, 0.005, 0.02))
    objects = data.model_ids()
    cases, guesses = [], []
    for k in range(args.estimates):
        obj_id = objects[k % len(objects)]
        truth = Pose(random_rotation(rng), [*rng.normal(0, 0.1, 2), rng.uniform(0.5, 1.2)])
        cases.append(Case(1, k, 0, obj_id, 1.0, truth, K, 640))
        guesses.append(Guess(1, k, obj_id, noise.disturb(truth, rng), 1.0))
    for obj_id in objects:
        data.measured_model(obj_id)
    wall, cpu = time.perf_counter(), time.process_time()
    scored = score(cases, guesses, data, dataset_info("lmo"))
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    vertices = ", ".join(str(len(data.measured_model(o).model.vertices)) for o in objects)
    print(f"{len(cases)} estimates of {len(objects)} objects ({vertices} vertices): {wall:.1f} s, {cpu:.1f} s of CPU; "
          f"AR MSSD {100 * scored.hits['mssd_ar'].mean():.1f}")  # fmt: skip


if __name__ == "__main__":
    main()

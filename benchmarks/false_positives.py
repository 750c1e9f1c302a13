"""How often an object is found in photographs that do not show it, and how long it takes to say so.

    python benchmarks/false_positives.py ROOT MESH [MESH ...] [--units m] [--detector novel|FILE] [--images 50]

ROOT is a data set in BOP layout, whose pictures show none of the meshes. Each picture is searched for one of them, in
turn, as `posekit estimate` does it. Prints the share of pictures in which something is found, at the default score and
at others, and the seconds of a picture's stages.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from posekit.datasets.bop import BopDataset
from posekit.detect.novel import make_detector
from posekit.estimate.estimator import Estimators
from posekit.estimate.instances import SearchOptions, find_instances
from posekit.mesh.model import ObjectModel


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root")
    parser.add_argument("meshes", nargs="+", type=Path)
    parser.add_argument("--split")
    parser.add_argument("--units", default="auto")
    parser.add_argument("--detector", default="novel")
    parser.add_argument("--images", type=int, default=50)
    args = parser.parse_args()
    data = BopDataset(args.root, split=args.split) if args.split else BopDataset(args.root)
    models = [ObjectModel.load(path, units=args.units) for path in args.meshes]
    detector, _ = make_detector(args.detector, models, doubtful=True)
    estimators = Estimators()
    pictures = data.images()
    chosen = np.linspace(0, len(pictures) - 1, min(args.images, len(pictures))).astype(int)
    scores, seconds = [], []
    for n, k in enumerate(chosen):
        view, model = data.view(*pictures[k]), models[n % len(models)]
        started = time.perf_counter()
        found = detector.detect(view, [model])
        detected = time.perf_counter()
        [best] = find_instances(estimators, view, [model], found, SearchOptions(min_score=0.0))
        seconds.append((detected - started, time.perf_counter() - detected))
        scores.append(best.instances[0].score if best.instances else 0.0)
        print(f"{pictures[k]} {model.name}: {len(found)} detections, best estimate {scores[-1]:.2f}", flush=True)
    usual = SearchOptions().min_score
    for min_score in sorted({usual, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 0.9}):
        alarms = sum(score >= min_score for score in scores)
        print(
            f"score from {min_score:g}{' (default)' if min_score == usual else ''}: found in {alarms} of {len(scores)}"
        )
    detect, estimate = np.mean(seconds[1:] or seconds, axis=0)
    print(f"seconds of a picture: detect {detect:.2f}, estimate {estimate:.2f}")


if __name__ == "__main__":
    main()

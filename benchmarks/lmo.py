"""How far posekit gets on real photographs in BOP layout: the refiner from disturbed truth, and the whole chain.

    python benchmarks/lmo.py ROOT --stage refine
    python benchmarks/lmo.py ROOT --stage estimate --from masks|boxes --limit 50

Prints the share of instances within (2 deg, 2 cm), (5, 5) and (10, 10), strictly, pooled over instances and as the
unweighted mean over objects; and the same with symmetries handled as BOP does.
"""

from __future__ import annotations

import argparse
import csv
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from posekit.data.bop import BopDataset, Instance
from posekit.detect.prompts import BoxPrompt
from posekit.estimate import EstimateOptions, PoseEstimator
from posekit.geometry import Pose, PoseNoise, rotation_angle
from posekit.object_model import ObjectModel
from posekit.results import Detection, Estimate
from posekit.view import View

LEVELS = (2, 5, 10)


@dataclass(frozen=True)
class Row:
    obj_id: int
    scene: int
    image: int
    start: tuple[float, float]  # degrees, centimetres
    plain: tuple[float, float]
    symmetric: tuple[float, float]
    angle_deg: float
    iterations: int
    seconds: float


def errors(estimate: Pose, truth: Pose) -> tuple[float, float]:
    turn = float(np.rad2deg(rotation_angle(estimate.R @ truth.R.T)))
    return turn, 100 * float(np.linalg.norm(estimate.t - truth.t))


def symmetric_errors(estimate: Pose, truth: Pose, model: ObjectModel) -> tuple[float, float]:
    return min(errors(estimate, truth @ S) for S in model.symmetries.transforms())


def one(
    estimator: PoseEstimator, view: View, instance: Instance, args: argparse.Namespace, rng: np.random.Generator
) -> Row:
    truth, model = instance.T_cam_obj, estimator.model
    mask = instance.mask()
    started = time.perf_counter()
    start = (180.0, 100.0)
    found: list[Estimate]
    if args.stage == "refine":
        T_start = PoseNoise().disturb(truth @ model.T_obj_ctr, rng) @ model.T_obj_ctr.inverse()
        start = errors(T_start, truth)
        found = [estimator.refine(view.with_mask(mask if args.mask == "true" else None), T_start)]
    elif args.source == "masks":
        found = estimator.estimate(view, [Detection(instance.box_visib, mask, 1.0, model.name, "mask")])
    else:
        found = estimator.estimate(view, BoxPrompt(instance.box_visib, args.mask_from).detect(view, [model]))
    seconds = time.perf_counter() - started
    if not found:
        return Row(instance.obj_id, instance.scene, instance.image, start, (180, 1e3), (180, 1e3), 180.0, 0, seconds)
    best = found[0]
    return Row(instance.obj_id, instance.scene, instance.image, start, errors(best.T_cam_obj, truth),
               symmetric_errors(best.T_cam_obj, truth, model), float(np.rad2deg(best.angle)), best.iterations,
               seconds)  # fmt: skip


def table(rows: list[Row], name: str) -> str:
    e = np.array([getattr(r, name) for r in rows])
    objects = np.array([r.obj_id for r in rows])
    shares = [(e < level).all(1) for level in LEVELS]
    pooled = " ".join(f"({n},{n}) {100 * s.mean():5.1f}" for n, s in zip(LEVELS, shares, strict=True))
    mean = " ".join(f"{100 * np.mean([s[objects == o].mean() for o in np.unique(objects)]):5.1f}" for s in shares)
    turn, shift = np.median(e, axis=0)
    return f"{name:>9}: {pooled} | mean over objects {mean} | median {turn:.2f} deg {shift:.2f} cm"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path)
    parser.add_argument("--stage", choices=("refine", "estimate"), default="refine")
    parser.add_argument("--from", dest="source", choices=("masks", "boxes"), default="masks")
    parser.add_argument("--mask", choices=("true", "none"), default="true", help="the refine stage's mask")
    parser.add_argument("--mask-from", default="grabcut")
    parser.add_argument("--min-visible", type=float, default=0.9)
    parser.add_argument("--limit", type=int, help="instances, spread evenly")
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--preset", default="lite")
    parser.add_argument("--update", default="correspondence")
    parser.add_argument("--stop", default="angle")
    parser.add_argument("--iterations", type=int, default=EstimateOptions().iterations)
    parser.add_argument("--hypotheses", type=int, default=EstimateOptions().hypotheses)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--csv", type=Path)
    args = parser.parse_args()

    data = BopDataset(args.root)
    chosen = [
        i for s, im in data.images() for i in data.instances(s, im, every=True) if i.visib_fract > args.min_visible
    ]
    if args.limit:
        chosen = [chosen[k] for k in np.linspace(0, len(chosen) - 1, args.limit).round().astype(int)]
    options = EstimateOptions(
        hypotheses=args.hypotheses, update=args.update, stop=args.stop, iterations=args.iterations
    )
    estimators: dict[int, PoseEstimator] = {}
    rng = np.random.default_rng(args.seed)
    rows: list[Row] = []
    for instance in chosen:
        if instance.obj_id not in estimators:
            estimators[instance.obj_id] = PoseEstimator(
                data.model(instance.obj_id),
                preset=args.preset,
                weights=args.weights,
                options=options,
                threads=args.threads,
            )
        view = data.view(instance.scene, instance.image)
        rows.append(one(estimators[instance.obj_id], view, instance, args, rng))
    print(f"{len(rows)} instances over {100 * args.min_visible:.0f} % visible, weights "
          f"{next(iter(estimators.values())).weights_hash}, seed {args.seed}")  # fmt: skip
    for name in ("start", "plain", "symmetric"):
        print(table(rows, name))
    for o in sorted({r.obj_id for r in rows}):
        print(f"  object {o:2d}", table([r for r in rows if r.obj_id == o], "symmetric"))
    error = np.array([r.symmetric[0] for r in rows])
    angle = np.array([r.angle_deg for r in rows])
    from scipy.stats import spearmanr

    print(f"predicted angle: rank correlation with the error {spearmanr(angle, error).statistic:.2f}; "
          f"{(angle < 2).sum()} below 2 deg, {((angle < 2) & (error < 5)).sum()} of these within 5 deg; "
          f"iterations {np.mean([r.iterations for r in rows]):.1f}, "
          f"{np.median([r.seconds for r in rows]):.2f} s per instance")  # fmt: skip
    if args.csv:
        with args.csv.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["obj_id", "scene", "image", "start", "plain", "symmetric", "angle_deg", "iterations", "s"])
            for r in rows:
                writer.writerow(
                    [r.obj_id, r.scene, r.image, r.start, r.plain, r.symmetric, r.angle_deg, r.iterations, r.seconds]
                )


if __name__ == "__main__":
    main()

"""What tells a right pose from a wrong one: measures of estimates whose truth is known, and a logistic fit to them.

    python benchmarks/existence.py collect ROOT --split train --out FILE.jsonl [--proposals] [--scans] [--plain]
    python benchmarks/existence.py fit FILE.jsonl ... --measures similarity,blur,angle

`collect` estimates poses in a data set in BOP layout, at boxes of which every edge is wrong by up to 5 %, each box
asked for the object shown and for another one; with ``--proposals`` at the novel detector's best proposals of each
mesh. ``--scans``: the estimator is given a scan (`posekit.synth.appearance.scanned`) instead of the mesh; ``--plain``:
one without colours. An estimate is right within 10 degrees and a quarter of the diameter, counting symmetries. `fit`
weighs right and wrong alike, and prints the coefficients, the area under the curve in five folds, and how many are
accepted at 0.5.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from posekit.camera import box_iou
from posekit.datasets.bop import BopDataset, Instance
from posekit.detect.novel import make_detector
from posekit.detect.prompts import clip_box
from posekit.estimate.estimator import Estimators, PoseEstimator
from posekit.estimate.instances import promising
from posekit.estimate.perceptual import perceptual_similarity
from posekit.estimate.refine import compare, predicted_angle, update_pose
from posekit.first_pose.hypotheses import EvidenceScorer
from posekit.geometry import rotation_angle
from posekit.metrics import pose_error
from posekit.results import Detection, Estimate
from posekit.synth.appearance import scanned
from posekit.view import View

FOLDS, STRENGTH = 5, 1e-3  # of the cross-validation, and of the fit's regularisation
RIGHT_DEG, RIGHT_DIAMETERS = 10.0, 0.25


def measures_of(estimator: PoseEstimator, view: View, found: Estimate) -> dict[str, float]:
    """Everything that might say whether a pose is right."""
    model, pose, options = estimator.model, found.T_cam_obj, estimator.refine_options
    drawing = (model, model.hull_ctr)
    [prediction], [observed], [drawn] = compare(view, *drawing, [pose], estimator.predictor, estimator.renderer)
    updated = update_pose(pose, model, prediction, observed, drawn, options.update, options.colour_edge)
    alone = update_pose(pose, model, prediction, observed, drawn, options.update)
    angle = predicted_angle(pose, prediction, updated, options.update)
    features = estimator.runtime.features
    points = prediction.correspondences
    assert points is not None and prediction.silhouettes is not None and drawn.mask is not None
    share = drawn.mask.reshape(drawn.mask.shape[0] // 4, 4, -1, 4).mean((1, 3))
    whole = prediction.silhouettes[1]
    box = estimator._box(view, pose)
    scorer = EvidenceScorer(view, box, model, estimator.renderer)
    size = max(box[2] - box[0], box[3] - box[1])
    return {
        "evidence": scorer.scores([pose])[0],
        "similarity": perceptual_similarity(features, [observed], [drawn], [prediction.silhouettes[0]])[0],
        "similarity_whole": perceptual_similarity(features, [observed], [drawn])[0],
        "blur": float(np.log(np.median(points.scale_px))) if len(points.scale_px) else 2.0,
        "angle": float(np.log(max(np.rad2deg(angle), 0.3))),
        "head": float(np.log(max(np.rad2deg(prediction.angle), 0.3))),
        "apart": _turn(alone, updated),
        "visible": float(points.visible.mean()) if len(points.visible) else 0.0,
        "net_score": _odds(prediction.score or 0.0),
        "silhouette": float(np.minimum(share, whole).sum() / max(np.maximum(share, whole).sum(), 1e-6)),
        "size": float(np.log(size)),
    }


def _turn(a: Any, b: Any) -> float:
    return 3.0 if a is None or b is None else float(np.log(np.rad2deg(rotation_angle(a.R.T @ b.R)) + 0.3))


def _odds(p: float) -> float:
    p = min(max(p, 1e-4), 1 - 1e-4)
    return float(np.log(p / (1 - p)))


def correct(found: Estimate, instances: Sequence[Instance], model: Any) -> tuple[bool, float, float]:
    """Whether it is right, and its smallest error, degrees and diameters, among the picture's instances of the mesh."""
    errors = [(180.0, 9.0)]
    for each in instances:
        angle, shift = pose_error(found.T_cam_obj, each.T_cam_obj, model.symmetries.transforms())
        errors.append((float(np.rad2deg(float(angle))), float(shift) / model.diameter))
    turn, far = min(errors, key=lambda e: e[0] / RIGHT_DEG + e[1] / RIGHT_DIAMETERS)
    return turn < RIGHT_DEG and far < RIGHT_DIAMETERS, turn, far


def collect(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A row for each estimate."""
    data, rng = BopDataset(args.root, split=args.split), np.random.default_rng(args.seed)
    models = {k: data.model(k) for k in data.model_ids()}
    given = {k: scanned(m, rng) if args.scans else m for k, m in models.items()}
    if args.plain:
        given = {k: replace(m, colors=None, uvs=None, texture=None) for k, m in given.items()}
    estimators, pictures = Estimators(), data.images()
    detector, _ = make_detector("novel", list(given.values()), doubtful=True) if args.proposals else (None, None)
    chosen = np.linspace(0, len(pictures) - 1, min(args.images, len(pictures))).astype(int)
    for k in np.unique(chosen):
        scene, image = pictures[k]
        view, instances = data.view(scene, image), data.instances(scene, image, every=True)
        shown = [i for i in instances if i.visib_fract >= args.visible and i.box_visib is not None]
        for obj_id, detection in _asked(args, view, shown, given, detector, estimators, rng):
            model = given[obj_id]
            for found in estimators(model).estimate(view, [detection]):
                same = [i for i in instances if i.obj_id == obj_id]
                right, turn, shift = correct(found, same, models[obj_id])
                visible = max((i.visib_fract for i in same if box_iou(found.box, i.box_visib or found.box) > 0.3),
                              default=0.0)  # fmt: skip
                row = {"picture": str(pictures[k]), "object": obj_id, "right": right, "degrees": turn,
                       "diameters": shift, "detection": detection.score, "score": found.score,
                       "visible_share": visible}  # fmt: skip
                yield row | {"measures": measures_of(estimators(model), view, found)}


def _asked(args: argparse.Namespace, view: View, shown: Sequence[Instance], given: Any, detector: Any,
           estimators: Estimators, rng: np.random.Generator) -> Iterator[tuple[int, Detection]]:  # fmt: skip
    if detector is not None:
        for obj_id, model in given.items():
            found = [d for d in detector.detect(view, [model]) if d.label in (None, model.name)]
            yield from ((obj_id, d) for d in promising(estimators, model, view, found, args.candidates))
        return
    for instance in shown:
        assert instance.box_visib is not None
        x0, y0, x1, y1 = instance.box_visib
        moved = np.array([x0, y0, x1, y1]) + rng.uniform(-0.05, 0.05, 4) * ([x1 - x0, y1 - y0] * 2)
        box = clip_box(tuple(moved.tolist()), view.camera)
        others = [k for k in given if k != instance.obj_id]
        for obj_id in (instance.obj_id, int(rng.choice(others))):
            yield obj_id, Detection(box)


def fit(x: NDArray[np.float64], right: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Coefficients (M + 1,), the last one constant, of a logistic function of standardised measures, given back for
    the measures as they are. Right and wrong weigh alike."""
    mean, spread = x.mean(0), x.std(0) + 1e-9
    inputs = np.column_stack([(x - mean) / spread, np.ones(len(x))])
    weight = np.where(right, 0.5 / max(right.sum(), 1), 0.5 / max((~right).sum(), 1))

    def loss(w: NDArray[np.float64]) -> float:
        total = inputs @ w
        return float((weight * np.logaddexp(0, np.where(right, -total, total))).sum() + STRENGTH * (w[:-1] ** 2).sum())

    w = np.asarray(minimize(loss, np.zeros(inputs.shape[1])).x)
    scaled = w[:-1] / spread
    return np.append(scaled, w[-1] - scaled @ mean)


def area(score: NDArray[np.float64], right: NDArray[np.bool_]) -> float:
    """Under the receiver operating characteristic."""
    ranks = score.argsort(kind="stable").argsort() + 1
    n, m = int(right.sum()), int((~right).sum())
    return float((ranks[right].sum() - n * (n + 1) / 2) / max(n * m, 1))


def report(rows: Sequence[dict[str, Any]], names: Sequence[str]) -> None:
    """The fit to rows, and how it does on rows that it did not see (a picture is in one fold only)."""
    x = np.array([[r["measures"].get(n, r.get(n)) for n in names] for r in rows], dtype=np.float64)
    right = np.array([r["right"] for r in rows])
    pictures = sorted({r["picture"] + r["file"] for r in rows})
    fold = np.array([pictures.index(r["picture"] + r["file"]) % FOLDS for r in rows])
    score = np.empty(len(rows))
    for k in range(FOLDS):
        w = fit(x[fold != k], right[fold != k])
        score[fold == k] = x[fold == k] @ w[:-1] + w[-1]
    w = fit(x, right)
    near = np.array([r["degrees"] < 30 and r["diameters"] < 0.5 for r in rows]) & ~right
    taken = [(score > 0)[chosen].mean() for chosen in (right, ~right, near)]
    print(
        f"{'+'.join(names)}: area {area(score, right):.3f}, accepted right {taken[0]:.1%}, wrong {taken[1]:.1%}, "
        f"nearly right (below 30 degrees) {taken[2]:.1%}"
    )
    print("   ", ", ".join(f"{n} {c:.3g}" for n, c in zip([*names, "constant"], w, strict=True)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("collect", "fit"))
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--split")
    parser.add_argument("--out", type=Path, help="collect: the file that rows are added to")
    parser.add_argument("--images", type=int, default=40)
    parser.add_argument("--visible", type=float, default=0.5)
    parser.add_argument("--proposals", action="store_true")
    parser.add_argument("--candidates", type=int, default=3)
    parser.add_argument("--scans", action="store_true")
    parser.add_argument("--plain", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--measures", default="similarity,blur,angle", help="fit: joined by commas; sets by semicolons")
    args = parser.parse_args()
    if args.what == "collect":
        args.root = args.files[0]
        with args.out.open("a", encoding="utf-8") as out:
            for row in collect(args):
                print(json.dumps(row), file=out, flush=True)
        return
    rows = [json.loads(line) | {"file": str(path)} for path in args.files for line in path.read_text().splitlines()]
    print(f"{len(rows)} estimates, {sum(r['right'] for r in rows)} right")
    for names in args.measures.split(";"):
        report(rows, names.split(","))


if __name__ == "__main__":
    main()

"""Tracking on sequences with known truth: speed from the video's bytes to the pose, and how good the poses are.

    python benchmarks/track.py DIR [DIR ...] [--weights FILE] [--frames N] [--set KEY=VALUE ...]
                               [--colours own|plain|turned|uniform] [--json FILE] [--plot SVG]

DIR is a data set in BOP layout made by `posekit synth --kind sequence`. Every scene becomes a video, and every object
in it is followed alone from its true pose in the first frame that shows half of it; when it is lost, its true mask,
where a tenth of it is seen, stands for the detector. ``--colours`` takes the meshes' colours away (plain), turns their
hue by 120 degrees (turned), or makes them all magenta (uniform); the frames keep the true ones. Prints for each object

- fps, and cpu: frames per second of wall and of processor time, reading the video included, the first frame and
  searches not; outside: the share of time that is spent outside the network;
- 5,5: the share of frames in which a tenth of the object is seen and that are within 5 degrees and 5 cm;
- false: the longest run of frames called tracked while nothing of the object is seen;
- back: the most frames from its return (half of it is seen) until it is followed within 5 degrees and 5 cm;
- jitter: median turn (degrees) and shift (mm) from frame to frame beyond the true one.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from posekit.camera import mask_box
from posekit.datasets.bop import BopDataset, Instance
from posekit.estimate.estimator import PoseEstimator
from posekit.evaluate.charts import Axes, lines
from posekit.geometry import Pose, rotation_angle
from posekit.io.video import ReadAhead, SceneFrames, VideoFrames, VideoWriter
from posekit.mesh.model import ObjectModel
from posekit.metrics import pose_error
from posekit.results import Detection, Source
from posekit.tracking.tracker import LOST, TRACKED, UNCERTAIN, TrackConfig, Tracked, Tracker
from posekit.view import View

SEEN, HALF = 0.1, 0.5
BINS, LEAST = (0, 1, 2, 3, 5, 8, 12, 18, 25, 40), 10  # degrees of predicted angle; frames
COLOURS, MAGENTA = ("own", "plain", "turned", "uniform"), (170, 40, 150)
SVG = "http://www.w3.org/2000/svg"
STYLE = (
    "text{font:12px sans-serif}.left{text-anchor:end}.middle{text-anchor:middle}.grid{stroke:#ddd}"
    ".line{fill:none;stroke-width:2}.c0{stroke:#2b6cb0}.c1{stroke:#2f855a}.c2{stroke:#c05621}"
)


def recoloured(model: ObjectModel, colours: str) -> ObjectModel:
    """The model with its own, no, or wrong colours, see `COLOURS`."""
    if colours == "own":
        return model
    if colours == "turned":  # channels that change places turn every hue by 120 degrees
        turned = [None if each is None else each[..., [1, 2, 0]] for each in (model.colors, model.texture)]
        return dataclasses.replace(model, colors=turned[0], texture=turned[1])
    flat = np.full(model.vertices.shape, MAGENTA, np.uint8) if colours == "uniform" else None
    return dataclasses.replace(model, colors=flat, uvs=None, texture=None)


class TrueMasks:
    """Stands for a detector: finds what is there."""

    instance: Instance | None = None

    def detect(self, _: View, models: Sequence[ObjectModel]) -> list[Detection]:
        if self.instance is None or self.instance.visib_fract < SEEN:
            return []
        mask = self.instance.mask()
        box = mask_box(mask)
        return [] if box is None else [Detection(box, mask, 1.0, models[0].name, Source.MASK)]


def beginnings(data: BopDataset, scene: int, images: Sequence[int]) -> dict[int, tuple[int, Pose]]:
    """The first frame (its place in the sequence) that shows half of each object, and the pose there."""
    found: dict[int, tuple[int, Pose]] = {}
    for k, image in enumerate(images):
        for instance in data.instances(scene, image, every=True):
            if instance.visib_fract >= HALF:
                found.setdefault(instance.obj_id, (k, instance.T_cam_obj))
    return found


def follow(data: BopDataset, scene: int, images: list[int], begin: int, obj_id: int, video: Path, tracker: Tracker,
           detector: TrueMasks) -> list[dict[str, Any]]:  # fmt: skip
    """What was said of each frame from ``begin`` on, with its errors and seconds."""
    model, rows = tracker.model, []
    known = []  # before anything is timed
    for image in images[begin:]:
        truth = next((i for i in data.instances(scene, image, every=True) if i.obj_id == obj_id), None)
        known.append((image, truth, data.view(scene, image).camera))
    frames = itertools.islice(ReadAhead(VideoFrames(video, None)), begin, None)
    for image, truth, camera in known:
        detector.instance = truth
        started, cpu = time.perf_counter(), time.process_time()
        frame = next(frames)
        assert frame.image is not None
        found = tracker.step(frame.image, camera)
        wall, cpu = time.perf_counter() - started, time.process_time() - cpu
        rows.append(
            row(found, truth, model) | {"scene": scene, "obj": obj_id, "image": image, "wall": wall, "cpu": cpu}
        )
    return rows


def row(found: Tracked, truth: Instance | None, model: ObjectModel) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "state": found.state,
        "restarted": found.restarted,
        "visible": truth.visib_fract if truth else 0.0,
    }
    if found.estimate is not None:
        pose = found.estimate.T_cam_obj
        turn, shift = pose_error(pose, truth.T_cam_obj, model.symmetries.transforms()) if truth else (np.inf, np.inf)
        entry |= {
            "pose": pose,
            "truth": truth and truth.T_cam_obj,
            "re": float(np.rad2deg(turn)),
            "te": float(shift),
            "score": found.estimate.score,
            "angle": float(np.rad2deg(found.estimate.angle)),
            "network": found.estimate.timings.get("network"),
        }
    return entry


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    good = [r["state"] != LOST and r["re"] < 5 and r["te"] < 0.05 for r in rows]
    seen = [g for g, r in zip(good, rows, strict=True) if r["visible"] >= SEEN]
    timed = [r for r in rows[1:] if r.get("network")]
    wall = sum(r["wall"] for r in timed)
    result = {
        "frames": len(rows),
        "fps": len(timed) / wall if wall else 0.0,
        "cpu": len(timed) / max(sum(r["cpu"] for r in timed), 1e-9),
        "outside": 1 - sum(r["network"] for r in timed) / wall if wall else 0.0,
        "5,5": 100 * float(np.mean(seen)) if seen else 0.0,
        "lost": sum(r["state"] == LOST for r in rows),
        "restarted": sum(r["restarted"] for r in rows),
        "uncertain": sum(r["state"] == UNCERTAIN for r in rows),
        "false": longest([r["visible"] == 0 and r["state"] == TRACKED for r in rows]),
        "back": recovery(rows, good),
    }
    return result | dict(zip(("jitter_deg", "jitter_mm"), jitter(rows), strict=True))


def longest(flags: Sequence[bool]) -> int:
    best = run = 0
    for flag in flags:
        run = run + 1 if flag else 0
        best = max(best, run)
    return best


def recovery(rows: list[dict[str, Any]], good: list[bool]) -> int | None:
    """Frames from each return until the object is followed, the most of all; None where it never left."""
    worst, gone, since = None, False, None
    for k, r in enumerate(rows):
        gone = gone or r["visible"] == 0
        if gone and r["visible"] >= HALF:
            gone, since = False, k
        if since is not None and (good[k] or k == len(rows) - 1):
            worst, since = max(worst or 0, k - since), None
    return worst


def jitter(rows: list[dict[str, Any]]) -> tuple[float | None, float | None]:
    turns, shifts = [], []
    for a, b in itertools.pairwise(rows):
        if a.get("truth") and b.get("truth") and not b["restarted"]:
            true = b["truth"] @ a["truth"].inverse()
            off: Pose = (b["pose"] @ a["pose"].inverse()) @ true.inverse()
            turns.append(np.rad2deg(rotation_angle(off.R)))
            shifts.append(1000 * np.linalg.norm((b["pose"].t - a["pose"].t) - (b["truth"].t - a["truth"].t)))
    return (float(np.median(turns)), float(np.median(shifts))) if turns else (None, None)


def calibration(rows: Sequence[dict[str, Any]]) -> str:
    """An SVG: median and quantiles of the rotation error over the predicted angle, in bins; and prints the table."""
    told = [r for r in rows if r["state"] == TRACKED and r["visible"] >= SEEN and r["angle"] is not None and "re" in r]
    angles, errors = (np.array([r[key] for r in told]) for key in ("angle", "re"))
    places, shares = [], []
    for low, high in itertools.pairwise(BINS):
        chosen = (angles >= low) & (angles < high)
        if chosen.sum() >= LEAST:
            places.append(float(angles[chosen].mean()))
            shares.append(np.percentile(errors[chosen], (50, 68, 95)))
            quantiles = " / ".join(f"{value:.1f}" for value in shares[-1])
            within = 100 * (errors[chosen] < 5).mean()
            print(
                f"predicted {low} to {high} deg: {chosen.sum()} frames, error {quantiles} deg, {within:.0f} % below 5"
            )
    print(f"rank correlation {spearmanr(angles, errors)[0]:.2f} over {len(told)} frames")
    axes = Axes("predicted angle, degrees", "rotation error, degrees", float(BINS[-1]), 50.0)
    curves = [(name, places, [row[k] for row in shares]) for k, name in enumerate(("median", "68 %", "95 %"))]
    clipped = [(name, x, np.minimum(y, axes.y_to)) for name, x, y in curves]
    figure = lines(axes, clipped, "Error of tracked frames")
    drawing = figure[figure.index("<svg") : figure.index("</svg>") + len("</svg>")]
    return drawing.replace("<svg ", f'<svg xmlns="{SVG}" ', 1).replace(">", f"><style>{STYLE}</style>", 1)


def changed(texts: Sequence[str]) -> TrackConfig:
    """``--set``, with each option's own type."""
    config = TrackConfig()
    for text in texts:
        name, _, value = text.partition("=")
        config = dataclasses.replace(config, **{name: type(getattr(config, name))(value)})
    return config


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("roots", type=Path, nargs="+")
    parser.add_argument("--split", default="train")
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--frames", type=int)
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="of TrackConfig")
    parser.add_argument("--colours", choices=COLOURS, default="own", help="of the meshes, default: own")
    parser.add_argument("--json", type=Path, help="every frame, for plots")
    parser.add_argument("--plot", type=Path, metavar="SVG", help="the true error against the predicted angle")
    args = parser.parse_args()
    config, kept, shares = changed(args.set), [], list[float]()
    for root in args.roots:
        data = BopDataset(root, split=args.split)
        for scene in sorted({scene for scene, _ in data.images()}):
            frames = SceneFrames(
                root / args.split / f"{scene:06d}" / "scene_camera.json"
            )  # those where nothing is, too
            images = list(frames.cameras)[: args.frames]
            with tempfile.TemporaryDirectory() as folder:
                video = Path(folder) / "scene.mp4"
                with VideoWriter(video, 30.0, quality=18) as writer:
                    for image in images:
                        writer.write(data.view(scene, image).image)
                for obj_id, (begin, pose) in beginnings(data, scene, images).items():
                    detector = TrueMasks()
                    estimator = PoseEstimator(recoloured(data.model(obj_id), args.colours), weights=args.weights)
                    tracker = Tracker(estimator.model, pose=pose, estimator=estimator, detector=detector, config=config)
                    rows = follow(data, scene, images, begin, obj_id, video, tracker, detector)
                    kept += [
                        {k: v for k, v in r.items() if k not in ("pose", "truth")} | {"root": root.name} for r in rows
                    ]
                    values = "  ".join(f"{k} {v:.3g}" if v is not None else f"{k} -" for k, v in summary(rows).items())
                    print(f"{root.name} scene {scene} object {obj_id}: {values}", flush=True)
                    shares.append(summary(rows)["5,5"])
    print(f"5,5 in the mean of {len(shares)} tracks, colours {args.colours}: {np.mean(shares):.1f}")
    if args.plot:
        args.plot.write_text(calibration(kept))
    if args.json:
        args.json.write_text(json.dumps(kept))


if __name__ == "__main__":
    main()

"""The whole evaluation: pictures to records, records to scores, scores to files."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from posekit._version import __version__
from posekit.datasets.registry import Dataset, DatasetInfo, open_dataset
from posekit.datasets.results_csv import ResultRow, csv_name, read_results, results_csv
from posekit.detect.coco import Overlaps, average_precision_of_overlaps
from posekit.errors import ConfigError, OutputError
from posekit.evaluate import table
from posekit.evaluate.options import RBOT, EvalOptions
from posekit.evaluate.rbot import summary
from posekit.evaluate.report import report
from posekit.evaluate.scoring import Case, Guess, Scored, score
from posekit.evaluate.stages import Record, Regions, detections_for
from posekit.evaluate.store import RunFolder
from posekit.evaluate.truths import TruthReader, pictures, selected
from posekit.evaluate.vsd import VsdMeter
from posekit.evaluate.workers import run_pictures
from posekit.geometry import Pose
from posekit.io.files import check_writable, write_text_atomic
from posekit.nets.config import WeightsFile

log = logging.getLogger("posekit")

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Outcome:
    """What an evaluation gives: the results (as in results.json) and the files that were written."""

    results: dict[str, Any]
    files: tuple[Path, ...]


def evaluate(
    options: EvalOptions,
    out: Path,
    *,
    command: str = "",
    csv: Path | None = None,
    force: bool = False,
    with_vsd: bool = True,
    progress: Progress = lambda _done, _all: None,
) -> Outcome:
    """Run a stage, score it, and write results.json, the BOP CSV and report.html into ``out``.

    A run that was interrupted is continued. csv: the results file of the ``score`` stage. with_vsd: where the
    data set has depth. progress: called with the numbers of finished and of all pictures.
    Raises ConfigError, InputError, OutputError and what the stages raise.
    """
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out} is a file: --out names a folder.")
    check_writable(out, f"the output folder {out} cannot be written")
    data, info = open_dataset(options.dataset, options.root, options.split, options.units, options.targets)
    wanted = pictures(data, options)
    if not wanted:
        raise ConfigError(f"no picture of {info.title} is left: check --images and the test's targets.")
    _check_objects(data, options)
    weights = None if options.stage == "score" else WeightsFile.read(options.preset, options.weights)
    about = weights.about if weights is not None else {}
    source = table.Provenance(
        command,
        table.commit(),
        table.machine(),
        None if weights is None else weights.digest,
        None if weights is None else options.preset,
        None if weights is None else str(about.get("trained_on", "")) or None,
        frozenset(about["seen"]) if "seen" in about else None,
    )
    folder = RunFolder(out, _identity(options, source, csv), force)
    if options.stage == "score":
        if csv is None:
            raise ConfigError("what is to be scored? Pass --csv FILE, a BOP results file.")
        cases, guesses, notes = _from_csv(data, options, wanted, csv)
    else:
        records = _records(options, detections_for(data, options), folder, wanted, progress)
        cases, guesses, notes = _from_records(data, records)
        if options.protocol == RBOT and any(c.counted for c in cases):
            notes["protocol"] = summary(options, data, info, records)
    if not any(c.counted for c in cases):
        raise ConfigError("no instance is left to be found: check --objects and --min-visible.")
    meter = VsdMeter(data, info.vsd_delta) if with_vsd and _has_depth(data, wanted) else None
    scored = score(cases, guesses, data, info, None if meter is None else meter.errors)
    results = _results(options, data, info, source, scored, notes)
    return Outcome(results, _write(folder.path, results, scored, data, options, guesses, notes))


def _identity(options: EvalOptions, source: table.Provenance, csv: Path | None) -> dict[str, Any]:
    """What decides the results of a run."""
    files = [path for path in (csv, Path(options.detections)) if path is not None and path.is_file()]
    return {
        **options.identity(),
        "weights_hash": source.weights,
        "files": {str(path): _digest(path) for path in files},
        "posekit": __version__,
    }


def _digest(path: Path) -> str:
    import hashlib

    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def _check_objects(data: Dataset, options: EvalOptions) -> None:
    unknown = sorted(set(options.objects) - set(data.model_ids()))
    if unknown:
        raise ConfigError(f"the data set has no objects {unknown}; there are {data.model_ids()}.")


def _records(
    options: EvalOptions, files: Regions, folder: RunFolder, wanted: Sequence[tuple[int, int]], progress: Progress
) -> list[Record]:
    """All records, the missing ones computed."""
    left = [picture for picture in wanted if not folder.has(picture)]
    if options.stage == "track" and left:
        left = list(wanted)  # a sequence cannot be begun in its middle
    done = len(wanted) - len(left)
    if done and left:
        log.info("going on after %d of %d pictures", done, len(wanted))
    progress(done, len(wanted))
    for picture, record in run_pictures(options, files, left):
        folder.write(picture, record)
        done += 1
        progress(done, len(wanted))
    return [folder.read(picture) for picture in wanted]


# --- what is to be found, and what was ------------------------------------------------------------------------------


def _cases(data: Dataset, scene: int, image: int, truths: Sequence[Mapping[str, Any]]) -> list[Case]:
    """truths: as in a record: index, obj_id, visible, counted."""
    size = data.picture_size(scene, image)
    K = data.camera(scene, image, size).K
    poses = {i.index: i.T_cam_obj for i in data.instances(scene, image, every=True)}
    return [
        Case(scene, image, t["index"], t["obj_id"], t["visible"], poses[t["index"]], K, size[0], t["counted"])
        for t in truths
    ]


def _from_records(data: Dataset, records: Sequence[Record]) -> tuple[list[Case], list[Guess], dict[str, Any]]:
    cases: list[Case] = []
    guesses: list[Guess] = []
    sources: dict[str, int] = {}
    kept = ("seconds", "angle_deg", "iterations", "converged", "trace", "start", "detection_score", "state")
    for record in records:
        scene, image = record["scene"], record["image"]
        cases += _cases(data, scene, image, record["truths"])
        for truth in record["truths"]:
            if truth["counted"]:
                sources[truth["mask"]] = sources.get(truth["mask"], 0) + 1
        for e in record["estimates"]:
            about = {k: e[k] for k in kept if k in e}
            pose = _pose(e["T_cam_obj"])
            guesses.append(Guess(scene, image, e["obj_id"], pose, e["score"], e["index"], about))
    notes: dict[str, Any] = {"masks": sources, "pictures": {(r["scene"], r["image"]): r["seconds"] for r in records}}
    detections = [r["detections"] for r in records if "detections" in r]
    if detections:
        notes["detection_ap"] = detection_ap(detections)
    return cases, guesses, notes


def _pose(matrix: Sequence[Sequence[float]]) -> Pose:
    """A kept pose, bit for bit."""
    m = np.asarray(matrix, dtype=np.float64)
    return Pose(m[:3, :3], m[:3, 3])


def _from_csv(
    data: Dataset, options: EvalOptions, wanted: Sequence[tuple[int, int]], csv: Path
) -> tuple[list[Case], list[Guess], dict[str, Any]]:
    rows = read_results(csv, dict.fromkeys(data.images(), ()), data.model_ids())
    reader, cases = TruthReader(data), []
    rank_by_visibility = options.min_visible is not None
    for scene, image in wanted:
        instances = reader.instances(scene, image)
        if rank_by_visibility:
            truths = reader.read(scene, image, masks=False)
            chosen = {t.instance.index for t in selected(data, truths, scene, image, options)}
            shares = [t.visible for t in truths]
        else:
            wanted_objects = set(options.objects) or set(data.model_ids())
            chosen = {i.index for i in data.instances(scene, image) if i.obj_id in wanted_objects}
            shares = [i.visib_fract for i in instances]
        cases += _cases(
            data,
            scene,
            image,
            [
                {"index": i.index, "obj_id": i.obj_id, "visible": v, "counted": i.index in chosen}
                for i, v in zip(instances, shares, strict=True)
            ],
        )
    inside = set(wanted)
    used = [r for r in rows if (r.scene, r.image) in inside and (not options.objects or r.obj_id in options.objects)]
    guesses = [Guess(r.scene, r.image, r.obj_id, Pose(r.R, r.t), r.score) for r in used]
    times = {(r.scene, r.image): r.time for r in used}
    known = [t for t in times.values() if t >= 0]
    notes: dict[str, Any] = {"csv": str(csv), "rows": len(rows), "rows_used": len(used)}
    notes["seconds_per_picture"] = float(np.mean(known)) if len(known) == len(times) and known else None
    return cases, guesses, notes


def detection_ap(records: Sequence[Mapping[str, Record]]) -> dict[str, float | None]:
    """COCO's box and mask AP and AP50 (percent), means over the objects, from the overlaps kept for each picture."""
    result: dict[str, float | None] = {}
    for kind in ("box", "mask"):
        values: list[tuple[float, float]] = []
        for obj_id in sorted({o for r in records for o in r}):
            here = [r[obj_id] for r in records if obj_id in r]
            if any(e[f"{kind}_iou"] is None for e in here):
                values = []
                break
            shape = [(len(e["scores"]), len(e["ignored"])) for e in here]
            pictures = [
                Overlaps(np.array(e["scores"], dtype=np.float64), np.array(e["ignored"], dtype=np.bool_),
                         np.array(e[f"{kind}_iou"], dtype=np.float64).reshape(s))
                for e, s in zip(here, shape, strict=True)
            ]  # fmt: skip
            values.append(average_precision_of_overlaps(pictures))
        known = [v for v in values if np.isfinite(v).all()]
        result[f"coco_{kind}_ap"], result[f"coco_{kind}_ap50"] = (
            (100 * np.mean(known, axis=0)).tolist() if known else (None, None)
        )
    return result


def _has_depth(data: Dataset, wanted: Sequence[tuple[int, int]]) -> bool:
    return data.depth(*wanted[0]) is not None


# --- files ----------------------------------------------------------------------------------------------------------


def _results(
    options: EvalOptions,
    data: Dataset,
    info: DatasetInfo,
    source: table.Provenance,
    scored: Scored,
    notes: Mapping[str, Any],
) -> dict[str, Any]:
    ids = sorted({c.obj_id for c in scored.cases})
    objects = {o: {"novelty": table.novelty(source.seen, data.model(o).digest)} for o in ids}
    results: dict[str, Any] = {
        "schema": table.SCHEMA,
        "posekit": __version__,
        "date": time.strftime("%Y-%m-%d"),
        "stage": options.stage,
        "title": f"{info.title}: {options.title}",
        "true_masks": options.true_masks,
        "dataset": {
            "name": info.name,
            "title": info.title,
            "root": str(data.root),
            "split": data.split,
            "split_list": getattr(data, "split_label", None),
            "split_hash": getattr(data, "split_hash", None),
            "instances": _chosen(options),
            "masks": notes.get("masks", {}),
        },
        "options": options.as_dict(),
        "command": source.command,
        "commit": source.commit,
        "machine": source.machine,
        "weights": {"hash": source.weights, "preset": source.preset, "trained_on": source.trained_on},
        **table.summarise(scored, info, objects),
        "seconds_per_picture": notes.get("seconds_per_picture", _mean(notes.get("pictures", {}))),
    }
    for key in ("protocol", "detection_ap", "csv", "rows", "rows_used"):
        if key in notes:
            results[key] = notes[key]
    return results | {"instances": table.instances(scored)}


def _chosen(options: EvalOptions) -> str:
    """Which instances were measured, in words."""
    if options.min_visible is None:
        return "all frames after the first" if options.protocol == RBOT else "the test's targets"
    return f"at least {100 * options.min_visible:g} % visible" if options.min_visible > 0 else "all annotated"


def _mean(times: Mapping[Any, float]) -> float | None:
    return float(np.mean(list(times.values()))) if times else None


def _write(
    out: Path,
    results: dict[str, Any],
    scored: Scored,
    data: Dataset,
    options: EvalOptions,
    guesses: Sequence[Guess],
    notes: Mapping[str, Any],
) -> tuple[Path, ...]:
    files = [out / "results.json", out / "report.html"]
    write_text_atomic(files[0], json.dumps(results, indent=1, allow_nan=False) + "\n")
    write_text_atomic(files[1], report(results, scored, data))
    if options.stage != "score":
        times = notes["pictures"]
        rows = [
            ResultRow(g.scene, g.image, g.obj_id, g.score, g.T_cam_obj.R, g.T_cam_obj.t, times[g.scene, g.image])
            for g in guesses
        ]
        name = csv_name(f"posekit-{options.preset}-{options.stage}", data.name, data.split)
        files.append(out / name)
        write_text_atomic(files[2], results_csv(rows))
    return tuple(files)

"""From scored cases to the results: means, counts, ``results.json``. Its schema is in docs/evaluation.md."""

from __future__ import annotations

import math
import platform
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from posekit._version import __version__
from posekit.datasets.registry import DatasetInfo
from posekit.evaluate.scoring import MEASURES, Scored
from posekit.nets.precision import usable_cores

SCHEMA = 1
TRUE_MASKS = "True masks: drawn from the annotated poses, as no user has them; expect less without."
AP_MEASURES = ("mssd_ap", "mspd_ap", "ap")
# Percentages on LINEMOD with RGB alone: the paper's table, with the ADD-0.1d published for the same methods.
PUBLISHED: dict[str, dict[str, float | None]] = {
    "BB8 w/ ref.": {"2deg_2cm": None, "5deg_5cm": 69.0, "10deg_10cm": None, "add_01d": 62.7},
    "PoseCNN": {"2deg_2cm": None, "5deg_5cm": 19.4, "10deg_10cm": None, "add_01d": 62.7},
    "PoseCNN+DeepIM": {"2deg_2cm": 39.0, "5deg_5cm": 85.2, "10deg_10cm": 97.9, "add_01d": 88.6},
    "the paper": {"2deg_2cm": 24.3, "5deg_5cm": 73.1, "10deg_10cm": 97.5, "add_01d": None},
}
PAPER_MEASURES = ("2deg_2cm", "5deg_5cm", "10deg_10cm", "add_01d")


@dataclass(frozen=True)
class Provenance:
    """Where results come from. weights: their hash, None where nothing was computed. trained_on: of the weights.
    seen: digests of the meshes that they were trained on, None where that is not known."""

    command: str
    commit: str
    machine: str
    weights: str | None = None
    preset: str | None = None
    trained_on: str | None = None
    seen: frozenset[str] | None = None


def commit() -> str:
    """The checkout's commit, with "+changes" where files differ; else posekit's version."""
    here = Path(__file__).resolve().parent
    try:
        head, state = (
            subprocess.run(["git", *args], cwd=here, capture_output=True, text=True, check=True, timeout=20).stdout
            for args in (["rev-parse", "--short=12", "HEAD"], ["status", "--porcelain", "--", str(here.parent)])
        )
    except (OSError, subprocess.SubprocessError):
        return f"posekit {__version__}"
    return head.strip() + ("+changes" if state.strip() else "")


def machine() -> str:
    """The processor and its number of cores, as this process may use them."""
    try:
        text = Path("/proc/cpuinfo").read_text()
        model = next(line.split(":", 1)[1].strip() for line in text.splitlines() if line.startswith("model name"))
    except (OSError, StopIteration):
        model = platform.processor() or platform.machine()
    return f"{model}, {usable_cores()} cores, {platform.system()}"


def novelty(seen: frozenset[str] | None, digest: str) -> str:
    """Whether a mesh was in the training, by the digests that the weights name: "seen", "novel" or "unknown"."""
    if seen is None:
        return "unknown"
    return "seen" if digest in seen else "novel"


def summarise(scored: Scored, info: DatasetInfo, objects: Mapping[int, Mapping[str, Any]]) -> dict[str, Any]:
    """``counts``, ``mean``, ``pooled``, ``per_object`` and ``seconds_per_instance`` of the results.

    objects: further entries for each object. Means are unweighted over the objects, pooled values are over all
    instances (BOP's AR is pooled; its AP is a mean over objects). Percentages.
    """
    ids = np.array([c.obj_id for c in scored.cases], dtype=np.int64)
    present = sorted(set(ids.tolist()))
    measures = [m for m in MEASURES if m in scored.hits]
    per_object: dict[str, Any] = {}
    for obj_id in present:
        mine = ids == obj_id
        entry: dict[str, Any] = {"name": info.label(obj_id), **objects.get(obj_id, {})}
        entry |= _counts(scored, mine)
        entry |= {m: 100 * float(scored.hits[m][mine].mean()) for m in measures}
        entry |= {k: 100 * v[obj_id] for k, v in scored.ap.items() if obj_id in v}
        if {"mssd_ap", "mspd_ap"} <= set(entry):
            entry["ap"] = (entry["mssd_ap"] + entry["mspd_ap"]) / 2
        per_object[str(obj_id)] = entry
    means = {
        m: float(np.mean([e[m] for e in per_object.values() if m in e]))
        for m in (*measures, *AP_MEASURES)
        if any(m in e for e in per_object.values())
    }
    pooled = {m: 100 * float(scored.hits[m].mean()) for m in measures} if len(ids) else {}
    return {
        "counts": _counts(scored, np.ones(len(ids), dtype=np.bool_)),
        "mean": means,
        "pooled": pooled,
        "per_object": per_object,
        "seconds_per_instance": _seconds(scored),
    }


def _counts(scored: Scored, mine: Any) -> dict[str, int]:
    chosen = [g for g, m in zip(scored.guesses, mine, strict=True) if m]
    missing = sum(g is None for g in chosen)
    return {"instances": len(chosen), "estimates": len(chosen) - missing, "missing": missing}


def _seconds(scored: Scored) -> dict[str, float | None]:
    times = [g.about["seconds"] for g in scored.guesses if g is not None and "seconds" in g.about]
    if not times:
        return {"mean": None, "median": None}
    return {"mean": float(np.mean(times)), "median": float(np.median(times))}


def instances(scored: Scored) -> list[dict[str, Any]]:
    """One entry for each case: what it is, what was estimated, its errors and its value in every measure, all in
    percent."""
    entries = []
    for k, (case, guess) in enumerate(zip(scored.cases, scored.guesses, strict=True)):
        entry: dict[str, Any] = {
            "scene": case.scene,
            "image": case.image,
            "index": case.index,
            "obj_id": case.obj_id,
            "visible": _finite(case.visible),
            "found": guess is not None,
            "errors": {name: _finite(float(v[k])) for name, v in scored.errors.items()},
            "hits": {name: 100 * float(v[k]) for name, v in scored.hits.items()},
        }
        if guess is not None:
            entry |= {"T_cam_obj": guess.T_cam_obj.matrix.tolist(), "score": guess.score, **guess.about}
        entries.append(entry)
    return entries


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def paper_table(results: Mapping[str, Any]) -> list[tuple[str, dict[str, float | None]]]:
    """The paper's own table: the published rows, then ours: each object's, and the mean."""
    rows = list(PUBLISHED.items())
    for entry in results["per_object"].values():
        rows.append((f"posekit, {entry['name']}", {m: entry.get(m) for m in PAPER_MEASURES}))
    rows.append(("posekit, mean", {m: results["mean"].get(m) for m in PAPER_MEASURES}))
    return rows

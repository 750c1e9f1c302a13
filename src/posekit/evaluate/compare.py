"""Two evaluations side by side, over the instances that both have."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from posekit.errors import InputError
from posekit.evaluate.scoring import MEASURES

RESAMPLES = 10_000
INTERVAL = (2.5, 97.5)  # percentiles


@dataclass(frozen=True)
class Difference:
    """A measure's mean over objects in both runs, percent; the difference B - A with its 95 % interval."""

    measure: str
    a: float
    b: float
    low: float
    high: float

    @property
    def difference(self) -> float:
        """B - A, percent."""
        return self.b - self.a

    @property
    def clear(self) -> bool:
        """Whether the interval leaves out zero."""
        return self.low > 0 or self.high < 0


@dataclass(frozen=True)
class Comparison:
    """instances: paired ones; only_a, only_b: those that the other run lacks."""

    differences: tuple[Difference, ...]
    instances: int
    only_a: int
    only_b: int
    notes: tuple[str, ...]


def compare(a: Path, b: Path, seed: int = 0) -> Comparison:
    """Pair two result folders (or results.json files) by instance.

    The interval is the paired bootstrap's: instances are drawn again with replacement within each object, the same
    ones in both runs, 10,000 times. Raises InputError where a folder has no results, or none in common.
    """
    first, second = read(a), read(b)
    left, right = _by_key(first), _by_key(second)
    common = sorted(set(left) & set(right))
    if not common:
        raise InputError(f"{a} and {b} have no instance in common: they are of other data or other pictures.")
    objects = np.array([key[2] for key in common])
    measures = [m for m in MEASURES if m in left[common[0]]["hits"] and m in right[common[0]]["hits"]]
    table_a, table_b = (np.array([[run[k]["hits"][m] for m in measures] for k in common]) for run in (left, right))
    means = [_means(t, objects) for t in (table_a, table_b)]
    drawn = _bootstrap(table_b - table_a, objects, seed)
    low, high = np.percentile(drawn, INTERVAL, axis=0)
    differences = tuple(Difference(m, *(float(v[k]) for v in (*means, low, high))) for k, m in enumerate(measures))
    return Comparison(
        differences, len(common), len(left) - len(common), len(right) - len(common), _notes(first, second)
    )


def read(path: Path) -> dict[str, Any]:
    """A results.json, or that of a folder. Raises InputError where it is missing or something else."""
    file = path / "results.json" if path.is_dir() else path
    try:
        results = json.loads(file.read_text(encoding="utf-8"))
        if results["schema"] != 1 or not isinstance(results["instances"], list):
            raise ValueError("its schema is another")
    except OSError as error:
        raise InputError(f"{file} cannot be read ({error.strerror}): give a folder of posekit eval.") from error
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{file} is no results.json of posekit eval: {error}.") from error
    return dict(results)


def _by_key(results: Mapping[str, Any]) -> dict[tuple[int, int, int, int], Any]:
    return {(e["scene"], e["image"], e["obj_id"], e["index"]): e for e in results["instances"]}


def _means(values: NDArray[np.float64], objects: NDArray[np.int64]) -> NDArray[np.float64]:
    """Unweighted mean over objects of (N, M) values, (M,)."""
    return np.asarray(np.mean([values[objects == o].mean(axis=0) for o in np.unique(objects)], axis=0))


def _bootstrap(values: NDArray[np.float64], objects: NDArray[np.int64], seed: int) -> NDArray[np.float64]:
    """Means over objects of RESAMPLES redrawn samples, (RESAMPLES, M)."""
    rng = np.random.default_rng(seed)
    groups = [values[objects == o] for o in np.unique(objects)]
    total = np.zeros((RESAMPLES, values.shape[1]))
    for group in groups:
        n = len(group)
        counts = rng.multinomial(n, np.full(n, 1 / n), size=RESAMPLES)
        total += counts @ group / n
    return total / len(groups)


def _notes(a: Mapping[str, Any], b: Mapping[str, Any]) -> tuple[str, ...]:
    """What differs between the runs beside the results."""
    notes = []
    for name, x, y in (
        ("data set", a["dataset"]["name"], b["dataset"]["name"]),
        ("split", a["dataset"]["split_hash"], b["dataset"]["split_hash"]),
        ("stage", a["stage"], b["stage"]),
        ("weights", a["weights"]["hash"], b["weights"]["hash"]),
        ("commit", a["commit"], b["commit"]),
    ):
        if x != y:
            notes.append(f"{name}: {x} and {y}")
    options = sorted(set(a["options"]) | set(b["options"]))
    notes += [f"{k}: {a['options'].get(k)} and {b['options'].get(k)}" for k in options
              if a["options"].get(k) != b["options"].get(k) and k not in ("root", "stage", "workers")]  # fmt: skip
    return tuple(notes)

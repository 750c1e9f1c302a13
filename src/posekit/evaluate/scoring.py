"""Estimates against truths, vectorised over each object: errors and what they are worth in every measure."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from posekit import metrics
from posekit.data.bop import MeasuredModel
from posekit.data.datasets import Dataset, DatasetInfo
from posekit.geometry import Pose

Array = NDArray[np.float64]
Picture = tuple[int, int]

LEVELS = (2, 5, 10)
SHARES: Array = np.linspace(0.05, 0.5, 10)  # MSSD's thresholds in diameters, VSD's tolerances and thresholds
PIXELS: Array = np.linspace(5.0, 50.0, 10)  # MSPD's, in a picture 640 pixels wide
AP_MOST = 100  # estimates per picture
IGNORED_BELOW = 0.1

# The order of the tables.
MEASURES = (
    "2deg_2cm", "5deg_5cm", "10deg_10cm", "2deg_2cm_sym", "5deg_5cm_sym", "10deg_10cm_sym", "add_01d", "add_auc",
    "adds_auc", "proj_5px", "vsd_ar", "mssd_ar", "mspd_ar", "ar", "ar_mssd_mspd",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Case:
    """An instance that is to be found. counted: whether it is asked for; others are only not held against estimates.
    K: (3, 3). width: of the picture, pixels."""

    scene: int
    image: int
    index: int
    obj_id: int
    visible: float
    T_cam_obj: Pose
    K: Array
    width: int
    counted: bool = True


@dataclass(frozen=True, eq=False)
class Guess:
    """An estimate. index: of the instance that it was made for, None where it is to be matched. about: what is to be
    kept with it in the results."""

    scene: int
    image: int
    obj_id: int
    T_cam_obj: Pose
    score: float
    index: int | None = None
    about: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Scored:
    """cases: the counted ones. guesses: for each case the estimate that was held against it, or None. errors: by name,
    (N,), infinite where there is none. hits: by measure, (N,) in [0, 1]. ap: by measure and object, in [0, 1]."""

    cases: list[Case]
    guesses: list[Guess | None]
    errors: dict[str, Array]
    hits: dict[str, Array]
    ap: dict[str, dict[int, float]]


VsdErrors = Callable[[Case, Guess], Array]  # (10,), one for each tolerance in SHARES


def score(
    cases: Sequence[Case], guesses: Sequence[Guess], data: Dataset, info: DatasetInfo, vsd: VsdErrors | None = None
) -> Scored:
    """Score all estimates. vsd: where the data set has depth.

    Of an object's estimates in a picture as many as there are instances count, those with the highest scores (BOP's
    rule). Each is held against the instance that it was made for, else by rising MSSD against one still free; AR and
    AP follow BOP's own matching at every threshold.
    """
    parts = [
        _score_object(_Group.collect(obj_id, cases, guesses), data.measured_model(obj_id), info, vsd)
        for obj_id in sorted({c.obj_id for c in cases})
    ]
    return _joined(parts)


@dataclass(frozen=True, eq=False)
class _Group:
    """One object's cases and guesses. blocks: by picture, the positions of its cases and of its guesses, these by
    falling score. pairs: (P, 2), guess and case; starts: where each block's pairs begin, guess by guess."""

    obj_id: int
    cases: list[Case]
    guesses: list[Guess]
    blocks: list[tuple[list[int], list[int]]]

    @classmethod
    def collect(cls, obj_id: int, cases: Sequence[Case], guesses: Sequence[Guess]) -> _Group:
        mine = [c for c in cases if c.obj_id == obj_id]
        by_picture: dict[Picture, tuple[list[int], list[int]]] = {}
        for k, case in enumerate(mine):
            by_picture.setdefault((case.scene, case.image), ([], []))[0].append(k)
        here = [g for g in guesses if g.obj_id == obj_id]
        for k, guess in enumerate(here):  # those in pictures without the object count for the precision
            by_picture.setdefault((guess.scene, guess.image), ([], []))[1].append(k)
        blocks = [(cs, sorted(gs, key=lambda g: -here[g].score)) for cs, gs in by_picture.values()]
        return cls(obj_id, mine, here, blocks)

    def pairs(self) -> NDArray[np.int64]:
        """(P, 2), all guesses against all cases of the same picture, block by block, guess by guess."""
        return np.array([(g, c) for cs, gs in self.blocks for g in gs for c in cs], dtype=np.int64).reshape(-1, 2)


def _score_object(group: _Group, measured: MeasuredModel, info: DatasetInfo, vsd: VsdErrors | None) -> Scored:
    model, pairs = measured.model, group.pairs()
    symmetries = model.symmetries.transforms(metrics.BOP_STEPS)
    est = np.array([g.T_cam_obj.matrix for g in group.guesses]).reshape(-1, 4, 4)
    gt = np.array([c.T_cam_obj.matrix for c in group.cases]).reshape(-1, 4, 4)
    K = np.array([c.K for c in group.cases]).reshape(-1, 3, 3)
    scale = np.array([640.0 / c.width for c in group.cases])
    g, c = pairs.T
    vertices = model.vertices.astype(np.float64)
    surface = metrics.mssd(est[g], gt[c], model.outline, symmetries) / measured.diameter
    pixels = metrics.mspd(est[g], gt[c], K[c], vertices, symmetries) * scale[c]
    found = _assigned(group, surface)
    errors = _errors(group, est, gt, K, found, measured, info, symmetries, vertices)
    errors["mssd_share"], errors["mspd_px"] = _of_assigned(group, surface, found), _of_assigned(group, pixels, found)
    hits = _hits(errors, measured.diameter)
    hits["mssd_ar"], hits["mspd_ar"] = _recall(group, surface, SHARES), _recall(group, pixels, PIXELS)
    if vsd is not None:
        hits["vsd_ar"] = _vsd_recall(group, vsd)
        hits["ar"] = (hits["vsd_ar"] + hits["mssd_ar"] + hits["mspd_ar"]) / 3
    hits["ar_mssd_mspd"] = (hits["mssd_ar"] + hits["mspd_ar"]) / 2
    ap = {"mssd_ap": _precision(group, surface, SHARES), "mspd_ap": _precision(group, pixels, PIXELS)}
    counted = np.array([case.counted for case in group.cases], dtype=np.bool_)
    return Scored(
        [case for case in group.cases if case.counted],
        [group.guesses[f] if f >= 0 else None for f in found[counted]],
        {k: v[counted] for k, v in errors.items()},
        {k: v[counted] for k, v in hits.items()},
        {k: {} if v is None else {group.obj_id: v} for k, v in ap.items()},
    )


def _errors(
    group: _Group,
    est: Array,
    gt: Array,
    K: Array,
    found: NDArray[np.int64],
    measured: MeasuredModel,
    info: DatasetInfo,
    symmetries: Sequence[Pose],
    vertices: Array,
) -> dict[str, Array]:
    """Errors of the assigned estimates, (cases,), infinite where there is none."""
    there = np.flatnonzero(found >= 0)
    e, t, k = est[found[there]], gt[there], K[there]
    flips = group.obj_id in info.flipped
    turn, shift = metrics.pose_error(e, t) if len(there) else (np.zeros(0), np.zeros(0))
    turn_sym, shift_sym = _symmetric_error(e, t, symmetries)
    plain = metrics.add(e, t, vertices)
    alone = len(symmetries) == 1 and info.name != "ycbv"  # ADD-S is asked for of symmetric objects, and by YCB-Video
    nearest = plain if alone else metrics.adds(e, t, vertices)
    values = {
        "rotation_deg": np.rad2deg(metrics.deepim_rotation_error(e, t) if flips and len(there) else turn),
        "translation_cm": 100 * shift,
        "rotation_sym_deg": np.rad2deg(turn_sym),
        "translation_sym_cm": 100 * shift_sym,
        "add_m": plain if len(symmetries) == 1 else nearest,
        "proj_px": metrics.proj2d(e, t, k, vertices),
    }
    if info.name == "ycbv":
        values["adds_m"] = nearest
    whole = {}
    for name, value in values.items():
        whole[name] = np.full(len(found), np.inf)
        whole[name][there] = value
    whole["add_share"] = whole["add_m"] / measured.diameter
    return whole


def _symmetric_error(est: Array, gt: Array, symmetries: Sequence[Pose]) -> tuple[Array, Array]:
    """`metrics.pose_error` in portions, since all symmetries of all poses would not fit the memory."""
    step = max(1, 100_000 // len(symmetries))
    parts = [metrics.pose_error(est[k : k + step], gt[k : k + step], symmetries) for k in range(0, len(est), step)]
    turns, shifts = zip(*parts, strict=True) if parts else ((), ())
    return np.concatenate([np.zeros(0), *turns]), np.concatenate([np.zeros(0), *shifts])


def _hits(errors: Mapping[str, Array], diameter: float) -> dict[str, Array]:
    """What each case is worth in the measures that follow from its errors."""
    hits = {}
    for n in LEVELS:
        for suffix in ("", "_sym"):
            near = (errors[f"rotation{suffix}_deg"] < n) & (errors[f"translation{suffix}_cm"] < n)
            hits[f"{n}deg_{n}cm{suffix}"] = near.astype(np.float64)
    hits["add_01d"] = (errors["add_m"] < 0.1 * diameter).astype(np.float64)
    hits["add_auc"] = np.asarray(metrics.auc(errors["add_m"]))
    if "adds_m" in errors:
        hits["adds_auc"] = np.asarray(metrics.auc(errors["adds_m"]))
    hits["proj_5px"] = (errors["proj_px"] < 5.0).astype(np.float64)
    return hits


def _block_errors(group: _Group, pair_errors: Array) -> Iterable[tuple[list[int], list[int], Array]]:
    """Each picture's cases, guesses and errors (guesses, cases)."""
    start = 0
    for cs, gs in group.blocks:
        size = len(cs) * len(gs)
        yield cs, gs, pair_errors[start : start + size].reshape(len(gs), len(cs))
        start += size


def _assigned(group: _Group, surface: Array) -> NDArray[np.int64]:
    """For each case the guess that is held against it, -1 where there is none."""
    found = np.full(len(group.cases), -1)
    for cs, gs, errors in _block_errors(group, surface):
        linked = {group.guesses[g].index: g for g in gs}
        if None not in linked:
            for c in cs:
                found[c] = linked.get(group.cases[c].index, -1)
            continue
        counted = [k for k, c in enumerate(cs) if group.cases[c].counted]
        top = gs[: len(counted)]
        matched = metrics.match(errors[: len(top)][:, counted], [group.guesses[g].score for g in top], np.inf)
        for g, m in zip(top, matched, strict=True):
            if m >= 0:
                found[cs[counted[m]]] = g
    return found


def _of_assigned(group: _Group, pair_errors: Array, found: NDArray[np.int64]) -> Array:
    values = np.full(len(group.cases), np.inf)
    for cs, gs, errors in _block_errors(group, pair_errors):
        for k, c in enumerate(cs):
            if found[c] >= 0:
                values[c] = errors[gs.index(int(found[c])), k]
    return values


def _recall(group: _Group, pair_errors: Array, thresholds: Array) -> Array:
    """For each case the share of the thresholds at which BOP's matching finds it."""
    found = np.zeros(len(group.cases), dtype=np.int64)
    for cs, gs, errors in _block_errors(group, pair_errors):
        counted = [k for k, c in enumerate(cs) if group.cases[c].counted]
        top = errors[: len(counted)][:, counted]
        if len(counted) == 1 and len(top):
            found[cs[counted[0]]] = (top[0, 0] < thresholds).sum()
            continue
        scores = [group.guesses[g].score for g in gs[: len(counted)]]
        for threshold in thresholds:
            matched = metrics.match(top, scores, threshold)
            for m in matched[matched >= 0]:
                found[cs[counted[m]]] += 1
    return found / len(thresholds)


def _vsd_recall(group: _Group, vsd: VsdErrors) -> Array:
    """As `_recall`, averaged over the ten tolerances."""
    errors = []
    for cs, gs in group.blocks:
        asked = sum(group.cases[c].counted for c in cs)
        for rank, g in enumerate(gs):
            for c in cs:
                needed = rank < asked and group.cases[c].counted
                errors.append(vsd(group.cases[c], group.guesses[g]) if needed else np.ones(len(SHARES)))
    table = np.array(errors).reshape(-1, len(SHARES))
    return np.asarray(np.mean([_recall(group, table[:, k], SHARES) for k in range(len(SHARES))], axis=0))


def _precision(group: _Group, pair_errors: Array, thresholds: Array) -> float | None:
    """BOP'24's AP of one object; None where nothing was asked for."""
    total = sum(case.counted for case in group.cases)
    if not total:
        return None
    values = []
    for threshold in thresholds:
        hits: list[bool] = []
        scores: list[float] = []
        for cs, gs, errors in _block_errors(group, pair_errors):
            best = [group.guesses[g].score for g in gs[:AP_MOST]]
            for m, value in zip(metrics.match(errors[:AP_MOST], best, threshold), best, strict=True):
                if m < 0 or group.cases[cs[m]].counted:  # what hits an instance that is not asked for does not count
                    hits.append(m >= 0)
                    scores.append(value)
        values.append(metrics.average_precision(hits, scores, total))
    return float(np.mean(values))


def _joined(parts: Sequence[Scored]) -> Scored:
    def together(name: str) -> dict[str, Array]:
        keys = list(getattr(parts[0], name)) if parts else []
        return {k: np.concatenate([getattr(p, name)[k] for p in parts]) for k in keys}

    ap: dict[str, dict[int, float]] = {"mssd_ap": {}, "mspd_ap": {}}
    for part in parts:
        for key, values in part.ap.items():
            ap[key] |= values
    cases = [c for p in parts for c in p.cases]
    return Scored(cases, [g for p in parts for g in p.guesses], together("errors"), together("hits"), ap)

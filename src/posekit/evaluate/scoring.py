"""Estimates against truths, vectorised over each object: errors, and their value in every measure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from posekit import metrics
from posekit.datasets.bop import MeasuredModel
from posekit.datasets.registry import Dataset, DatasetInfo
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
class _Block:
    """A picture's cases and guesses (their positions; guesses by falling score), and where its pairs begin: each guess
    with each case, guess by guess."""

    cases: list[int]
    guesses: list[int]
    start: int

    def of(self, of_pairs: NDArray[Any]) -> NDArray[Any]:
        """Its part of what there is for each pair, (guesses, cases)."""
        shape = len(self.guesses), len(self.cases)
        return of_pairs[self.start : self.start + shape[0] * shape[1]].reshape(shape)


@dataclass(frozen=True, eq=False)
class _Group:
    """One object's cases and guesses. blocks: by picture, those that need matching. single: (S, 3), guess, case and
    pair of the pictures with one of each. pairs: (P, 2), guess and case. order: the guesses by picture. counted: (C,),
    of the cases."""

    obj_id: int
    cases: list[Case]
    guesses: list[Guess]
    blocks: list[_Block]
    single: NDArray[np.int64]
    pairs: NDArray[np.int64]
    order: NDArray[np.int64]
    counted: NDArray[np.bool_]

    @classmethod
    def collect(cls, obj_id: int, cases: Sequence[Case], guesses: Sequence[Guess]) -> _Group:
        mine = [c for c in cases if c.obj_id == obj_id]
        by_picture: dict[Picture, tuple[list[int], list[int]]] = {}
        for k, case in enumerate(mine):
            by_picture.setdefault((case.scene, case.image), ([], []))[0].append(k)
        here = [g for g in guesses if g.obj_id == obj_id]
        for k, guess in enumerate(here):  # those in pictures without the object count for the precision
            by_picture.setdefault((guess.scene, guess.image), ([], []))[1].append(k)
        blocks: list[_Block] = []
        single: list[tuple[int, int, int]] = []
        pairs: list[tuple[int, int]] = []
        order: list[int] = []
        for cs, unsorted in by_picture.values():
            gs = sorted(unsorted, key=lambda g: -here[g].score)
            if len(cs) == len(gs) == 1:
                single.append((gs[0], cs[0], len(pairs)))
            else:
                blocks.append(_Block(cs, gs, len(pairs)))
            pairs += [(g, c) for g in gs for c in cs]
            order += gs
        return cls(
            obj_id,
            mine,
            here,
            blocks,
            np.array(single, dtype=np.int64).reshape(-1, 3),
            np.array(pairs, dtype=np.int64).reshape(-1, 2),
            np.array(order, dtype=np.int64),
            np.array([case.counted for case in mine], dtype=np.bool_),
        )

    def asked(self, block: _Block) -> list[int]:
        """Which of a picture's cases are counted, as positions among them."""
        return [k for k, c in enumerate(block.cases) if self.counted[c]]

    def scores(self, guesses: Sequence[int]) -> list[float]:
        return [self.guesses[g].score for g in guesses]


def _score_object(group: _Group, measured: MeasuredModel, info: DatasetInfo, vsd: VsdErrors | None) -> Scored:
    model = measured.model
    symmetries = model.symmetries.transforms(metrics.BOP_STEPS)
    est = np.array([g.T_cam_obj.matrix for g in group.guesses]).reshape(-1, 4, 4)
    gt = np.array([c.T_cam_obj.matrix for c in group.cases]).reshape(-1, 4, 4)
    K = np.array([c.K for c in group.cases]).reshape(-1, 3, 3)
    scale = np.array([640.0 / c.width for c in group.cases])
    g, c = group.pairs.T
    vertices = model.vertices.astype(np.float64)
    surface = metrics.mssd(est[g], gt[c], model.hull_vertices, symmetries) / measured.diameter
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
    counted = group.counted
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
    """Each case's value in the measures that follow from its errors."""
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


def _assigned(group: _Group, surface: Array) -> NDArray[np.int64]:
    """For each case the guess that is held against it, -1 where there is none."""
    found = np.full(len(group.cases), -1)
    for g, c, _ in group.single:
        index = group.guesses[g].index
        if group.counted[c] if index is None else index == group.cases[c].index:
            found[c] = g
    for block in group.blocks:
        linked = {group.guesses[g].index: g for g in block.guesses}
        if None not in linked:
            for c in block.cases:
                found[c] = linked.get(group.cases[c].index, -1)
            continue
        asked = group.asked(block)
        top = block.guesses[: len(asked)]
        matched = metrics.match(block.of(surface)[: len(top)][:, asked], group.scores(top), np.inf)
        for g, m in zip(top, matched, strict=True):
            if m >= 0:
                found[block.cases[asked[m]]] = g
    return found


def _of_assigned(group: _Group, pair_errors: Array, found: NDArray[np.int64]) -> Array:
    """The errors of the pairs that `_assigned` made, (cases,), infinite where there is none."""
    values = np.full(len(group.cases), np.inf)
    g, c = group.pairs.T
    mine = found[c] == g
    values[c[mine]] = pair_errors[mine]
    return values


def _recall(group: _Group, pair_errors: Array, thresholds: Array) -> Array:
    """For each case the share of the thresholds at which BOP's matching finds it."""
    found = np.zeros(len(group.cases), dtype=np.int64)
    _, c, pair = group.single.T
    found[c] = (pair_errors[pair, None] < thresholds).sum(axis=1)
    for block in group.blocks:
        asked = group.asked(block)
        top = block.of(pair_errors)[: len(asked)][:, asked]
        scores = group.scores(block.guesses[: len(asked)])
        for threshold in thresholds:
            matched = metrics.match(top, scores, threshold)
            for m in matched[matched >= 0]:
                found[block.cases[asked[m]]] += 1
    return np.where(group.counted, found / len(thresholds), 0.0)


def _vsd_recall(group: _Group, vsd: VsdErrors) -> Array:
    """As `_recall`, averaged over the ten tolerances."""
    needed = np.zeros(len(group.pairs), dtype=np.bool_)
    needed[group.single[:, 2]] = True
    for block in group.blocks:
        block.of(needed)[: len(group.asked(block))] = True
    needed &= group.counted[group.pairs[:, 1]]
    table = np.ones((len(group.pairs), len(SHARES)))
    for k in np.flatnonzero(needed):
        g, c = group.pairs[k]
        table[k] = vsd(group.cases[c], group.guesses[g])
    return np.asarray(np.mean([_recall(group, table[:, k], SHARES) for k in range(len(SHARES))], axis=0))


def _precision(group: _Group, pair_errors: Array, thresholds: Array) -> float | None:
    """BOP'24's AP of one object; None where nothing was asked for."""
    total = int(group.counted.sum())
    if not total:
        return None
    scores = np.array(group.scores(group.order.tolist()))
    values = []
    for threshold in thresholds:
        right, used = _right_and_used(group, pair_errors, float(threshold))
        values.append(
            metrics.average_precision(right[group.order][used[group.order]], scores[used[group.order]], total)
        )
    return float(np.mean(values))


def _right_and_used(group: _Group, pair_errors: Array, threshold: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which guesses are right, and which count at all: not those beyond AP_MOST in a picture, nor those that hit an
    instance which is not asked for."""
    right, used = np.zeros(len(group.guesses), dtype=np.bool_), np.zeros(len(group.guesses), dtype=np.bool_)
    g, c, pair = group.single.T
    right[g] = pair_errors[pair] < threshold
    used[g] = ~right[g] | group.counted[c]
    for block in group.blocks:
        best = block.guesses[:AP_MOST]
        matched = metrics.match(block.of(pair_errors)[:AP_MOST], group.scores(best), threshold)
        right[best] = matched >= 0
        used[best] = [m < 0 or group.counted[block.cases[m]] for m in matched]
    return right, used


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

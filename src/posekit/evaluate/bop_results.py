"""Files that others make: BOP's results CSV and detections JSON. Whatever is wrong in them is refused with its line."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from posekit.camera import Box
from posekit.detect.segmentation import decode
from posekit.errors import InputError

COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
_LOOSE = 0.01  # how far R R^T may be from the identity: files are rounded
_SAME_TIME = 1e-3  # seconds


@dataclass(frozen=True, eq=False)
class ResultRow:
    """An estimate in BOP's terms. R: (3, 3), t: (3,) metres. time: seconds for the whole picture, -1 unknown."""

    scene: int
    image: int
    obj_id: int
    score: float
    R: NDArray[np.float64]
    t: NDArray[np.float64]
    time: float


def results_csv(rows: Sequence[ResultRow]) -> str:
    """The CSV that the BOP server takes: R row by row, t in mm, the same time on all rows of a picture."""
    lines = [",".join(COLUMNS)]
    for row in rows:
        R = " ".join(repr(float(v)) for v in row.R.ravel())
        t = " ".join(repr(float(v) * 1000.0) for v in row.t)
        lines.append(f"{row.scene},{row.image},{row.obj_id},{row.score!r},{R},{t},{row.time!r}")
    return "\n".join(lines) + "\n"


def csv_name(method: str, dataset: str, split: str) -> str:
    """``METHOD_DATASET-SPLIT.csv``; underscores separate, so the method has none."""
    return f"{method.replace('_', '-')}_{dataset.replace('_', '-')}-{split.replace('_', '-')}.csv"


def read_results(
    path: Path, known: Mapping[tuple[int, int], Collection[int]], objects: Collection[int]
) -> list[ResultRow]:
    """Read a results CSV. known: the data set's pictures, each with anything; objects: its object numbers.

    Raises InputError, naming the line, for missing columns, wrong counts, numbers that are not finite, a matrix that
    is no rotation, unknown scenes, pictures or objects, duplicate rows, and times that differ within one picture.
    """
    text = _text(path)
    lines = text.splitlines()
    if not lines:
        raise InputError(f"{path} is empty: a BOP results file starts with the line {','.join(COLUMNS)}.")
    header = tuple(name.strip() for name in lines[0].lstrip("\ufeff").split(","))
    missing = [name for name in COLUMNS if name not in header]
    if missing:
        raise InputError(f"{path}, line 1: the columns {', '.join(missing)} are missing; needed: {','.join(COLUMNS)}.")
    checker = _RowChecker(path, header, known, objects)
    rows = [checker.row(k, fields) for k, fields in enumerate(csv.reader(io.StringIO(text)), 1) if k > 1 and fields]
    _check_rotations(path, rows, checker.lines)
    return rows


class _RowChecker:
    """Turns fields into rows and remembers what must agree between rows."""

    def __init__(
        self,
        path: Path,
        header: Sequence[str],
        known: Mapping[tuple[int, int], Collection[int]],
        objects: Collection[int],
    ) -> None:
        self.path, self.header, self.known, self.objects = path, header, known, set(objects)
        self.place = [header.index(name) for name in COLUMNS]
        self.scenes = {scene for scene, _ in known}
        self.times: dict[tuple[int, int], tuple[float, int]] = {}
        self.seen: dict[tuple[Any, ...], int] = {}
        self.lines: list[int] = []

    def row(self, line: int, fields: list[str]) -> ResultRow:
        if len(fields) != len(self.header):
            self._refuse(line, f"{len(fields)} fields where the header has {len(self.header)}")
        scene_text, image_text, obj_text, score_text, R_text, t_text, time_text = (fields[k] for k in self.place)
        scene, image, obj_id = (
            self._whole(line, name, text)
            for name, text in (("scene_id", scene_text), ("im_id", image_text), ("obj_id", obj_text))
        )
        self._check_ids(line, scene, image, obj_id)
        [score] = self._numbers(line, "score", score_text, 1)
        R = self._numbers(line, "R", R_text, 9)
        t = self._numbers(line, "t", t_text, 3)
        [seconds] = self._numbers(line, "time", time_text, 1)
        self._check_time(line, (scene, image), seconds)
        self._check_new(line, (scene, image, obj_id, score, *R, *t))
        self.lines.append(line)
        return ResultRow(scene, image, obj_id, score, np.array(R).reshape(3, 3), np.array(t) / 1000.0, seconds)

    def _check_ids(self, line: int, scene: int, image: int, obj_id: int) -> None:
        if scene not in self.scenes:
            self._refuse(line, f"scene {scene} is not in the data set, which has {_some(self.scenes)}")
        if (scene, image) not in self.known:
            self._refuse(line, f"scene {scene} has no image {image} in this test")
        if obj_id not in self.objects:
            self._refuse(line, f"object {obj_id} is not in the data set, which has {_some(self.objects)}")

    def _check_time(self, line: int, picture: tuple[int, int], seconds: float) -> None:
        first, where = self.times.setdefault(picture, (seconds, line))
        if abs(first - seconds) > _SAME_TIME:
            self._refuse(
                line,
                f"time {seconds:g} differs from {first:g} in line {where} of the same image; time is for the whole "
                "image and the same on all of its rows",
            )

    def _check_new(self, line: int, content: tuple[Any, ...]) -> None:
        before = self.seen.setdefault(content, line)
        if before != line:
            self._refuse(line, f"the row repeats line {before}")

    def _whole(self, line: int, name: str, text: str) -> int:
        if not re.fullmatch(r"\s*\d+\s*", text):
            self._refuse(line, f"{name} {text!r} is no whole number")
        return int(text)

    def _numbers(self, line: int, name: str, text: str, count: int) -> list[float]:
        try:
            values = [float(v) for v in text.split()]
        except ValueError:
            self._refuse(line, f"{name} {text!r} is not made of numbers separated by spaces")
        if len(values) != count:
            self._refuse(line, f"{name} has {len(values)} numbers; needed: {count}")
        if not all(map(math.isfinite, values)):
            self._refuse(line, f"{name} {text!r} holds a number that is not finite")
        return values

    def _refuse(self, line: int, reason: str) -> Any:
        raise InputError(f"{self.path}, line {line}: {reason}. Correct the file.")


def _check_rotations(path: Path, rows: list[ResultRow], lines: list[int]) -> None:
    if not rows:
        return
    R = np.stack([row.R for row in rows])
    off = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero((off > _LOOSE) | (np.linalg.det(R) < 0))
    if bad.size:
        raise InputError(
            f"{path}, line {lines[bad[0]]}: R is no rotation (row by row, nine numbers). Correct the file."
        )


# --- detections ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class FoundRegion:
    """A detection of a file. rle: COCO's counts and size, or None."""

    scene: int
    image: int
    obj_id: int
    box: Box
    score: float
    rle: dict[str, Any] | None
    time: float

    def mask(self) -> NDArray[np.bool_] | None:
        """bool (H, W), None where the file has none."""
        if self.rle is None:
            return None
        height, width = self.rle["size"]
        return decode(self.rle, (width, height))


def read_detections(
    path: Path, known: Mapping[tuple[int, int], Collection[int]], objects: Collection[int]
) -> dict[tuple[int, int], list[FoundRegion]]:
    """Read a BOP detections file, by picture. Pictures of the data set that this run leaves out are left out too.

    Raises InputError, naming the line, for what is malformed, as `read_results` does.
    """
    found: dict[tuple[int, int], list[FoundRegion]] = {}
    seen: dict[str, int] = {}
    times: dict[tuple[int, int], tuple[float, int]] = {}
    for line, entry in _entries(path):
        region = _region(path, line, entry)
        key = json.dumps(entry, sort_keys=True)
        if seen.setdefault(key, line) != line:
            raise InputError(f"{path}, line {line}: the entry repeats line {seen[key]}. Correct the file.")
        if region.obj_id not in objects:
            raise InputError(
                f"{path}, line {line}: category {region.obj_id} is not in the data set, which has {_some(objects)}."
            )
        picture = (region.scene, region.image)
        if picture not in known:
            raise InputError(f"{path}, line {line}: scene {region.scene} has no image {region.image} in this data set.")
        first, where = times.setdefault(picture, (region.time, line))
        if abs(first - region.time) > _SAME_TIME:
            raise InputError(
                f"{path}, line {line}: time {region.time:g} differs from {first:g} in line {where} of the same image."
            )
        found.setdefault(picture, []).append(region)
    return found


_LARGEST = 1e300  # integers beyond are no floats


def _region(path: Path, line: int, entry: Any) -> FoundRegion:
    def refuse(reason: str) -> InputError:
        return InputError(f"{path}, line {line}: {reason}. Correct the file.")

    if not isinstance(entry, dict):
        raise refuse("an entry is {...} with scene_id, image_id, category_id, score, bbox")
    missing = [k for k in ("scene_id", "image_id", "category_id", "score", "bbox") if k not in entry]
    if missing:
        raise refuse(f"{', '.join(missing)} missing")
    ids = [
        int(v) if isinstance(v, str) and v.isascii() and v.isdigit() else v
        for v in (entry[k] for k in ("scene_id", "image_id", "category_id"))
    ]
    if not all(type(v) is int for v in ids):
        raise refuse(f"scene_id, image_id and category_id are whole numbers, not {ids}")
    box, score, seconds = entry["bbox"], entry["score"], entry.get("time", -1.0)
    if not isinstance(box, list) or len(box) != 4:
        raise refuse("bbox has four numbers, x, y, width and height")
    if not all(type(v) in (int, float) and abs(v) < _LARGEST for v in (*box, score, seconds)):
        raise refuse("bbox, score and time are finite numbers")
    x, y, w, h = box
    if w <= 0 or h <= 0:
        raise refuse(f"bbox has the size {w:g}x{h:g}")
    rle = entry.get("segmentation")
    if rle is not None and not _is_rle(rle):
        raise refuse("segmentation has size [height, width] and counts that fill it")
    scene, image, obj_id = ids
    return FoundRegion(scene, image, obj_id, (x, y, x + w, y + h), float(score), rle, float(seconds))


def _is_rle(rle: Any) -> bool:
    if not isinstance(rle, dict) or set(rle) != {"size", "counts"}:
        return False
    size, counts = rle["size"], rle["counts"]
    if not (isinstance(size, list) and len(size) == 2 and all(type(v) is int and v > 0 for v in size)):
        return False
    if isinstance(counts, str):
        return bool(counts)
    return (
        isinstance(counts, list) and all(type(v) is int and v >= 0 for v in counts) and sum(counts) == math.prod(size)
    )


def _entries(path: Path) -> Iterator[tuple[int, Any]]:
    """The entries of a JSON list, each with the line that it starts in."""
    text = _text(path)
    decoder = json.JSONDecoder()
    at, line, counted = _skip(text, 0), 1, 0
    if not text[at : at + 1] == "[":
        raise InputError(f"{path}, line 1: a detections file is a JSON list of entries.")
    at = _skip(text, at + 1)
    while text[at : at + 1] != "]":
        line, counted = line + text.count("\n", counted, at), at
        try:
            entry, end = decoder.raw_decode(text, at)
        except json.JSONDecodeError as error:
            raise InputError(f"{path}, line {error.lineno}: {error.msg}. Correct the file.") from error
        yield line, entry
        at = _skip(text, end)
        if text[at : at + 1] == ",":
            at = _skip(text, at + 1)
        elif text[at : at + 1] != "]":
            where = text.count("\n", 0, at) + 1
            raise InputError(f"{path}, line {where}: a comma or the list's end is missing. Correct the file.")


def _skip(text: str, at: int) -> int:
    """Past white space."""
    while at < len(text) and text[at].isspace():
        at += 1
    return at


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{path} cannot be read: {reason}. Check the path.") from error


def _some(values: Collection[int]) -> str:
    listed = sorted(values)
    return ", ".join(map(str, listed[:12])) + (" ..." if len(listed) > 12 else "")

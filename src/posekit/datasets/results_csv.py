"""Files that others make: BOP's results CSV, refused with the line where anything is wrong, as BOP's server does, and
detections JSON, whose bad entries are skipped and logged."""

from __future__ import annotations

import csv
import io
import json
import logging
import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from posekit.camera import Box
from posekit.detect.external import json_lines
from posekit.detect.segmentation import decode
from posekit.errors import InputError
from posekit.io.files import read_text

COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
_LOOSE = 0.01  # how far R R^T may be from the identity: files are rounded
_SAME_TIME = 1e-3  # seconds
_MOST_LOGGED = 10  # skipped entries of a file that are logged one by one

log = logging.getLogger("posekit")


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
    header = tuple(name.strip() for name in lines[0].split(","))
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
    """A detection of a file. rle: COCO's counts and size, or None. line: in the file, 0 where it is of none."""

    scene: int
    image: int
    obj_id: int
    box: Box
    score: float
    rle: dict[str, Any] | None
    time: float
    line: int = 0

    def mask(self, size: tuple[int, int] | None = None) -> NDArray[np.bool_] | None:
        """bool (H, W), None where the file has none. size: (width, height) that it must have. Raises PromptError."""
        if self.rle is None:
            return None
        height, width = self.rle["size"]
        return decode(self.rle, size or (width, height))


def read_detections(
    path: Path, known: Mapping[tuple[int, int], Collection[int]], objects: Collection[int]
) -> dict[tuple[int, int], list[FoundRegion]]:
    """Read a BOP detections file, by picture. known: the data set's pictures; objects: its object numbers.

    Entries that cannot be used are skipped, and logged with their line and the reason. Raises InputError where the file
    is no list of entries, or has some and none that can be used.
    """
    found: dict[tuple[int, int], list[FoundRegion]] = {}
    skipped = _Skipped(path)
    checker = _RegionChecker(known, objects)
    for line, entry in _entries(path):
        try:
            region = checker.region(line, entry)
        except _Unusable as reason:
            skipped.tell(line, str(reason))
            continue
        found.setdefault((region.scene, region.image), []).append(region)
    skipped.end(sum(map(len, found.values())))
    return found


class _Unusable(Exception):
    """An entry that is skipped; its text is the reason."""


class _Skipped:
    """Logs the entries of a file that are skipped: the first ones each, the others by their number."""

    def __init__(self, path: Path) -> None:
        self.path, self.count, self.first = path, 0, ""

    def tell(self, line: int, reason: str) -> None:
        self.count += 1
        self.first = self.first or f"line {line}: {reason}"
        if self.count <= _MOST_LOGGED:
            log.warning("%s, line %d: the entry is skipped: %s.", self.path, line, reason)

    def end(self, used: int) -> None:
        """used: entries that are left. Raises InputError where there are none but skipped ones."""
        if self.count > _MOST_LOGGED:
            log.warning("%s: %d entries in all are skipped, %d are used.", self.path, self.count, used)
        if not self.count and not used:
            log.warning("%s holds no detections at all.", self.path)
        if self.count and not used:
            raise InputError(f"{self.path} has {self.count} entries and none that can be used; {self.first}.")


class _RegionChecker:
    """Turns entries into regions and remembers what must agree between them."""

    def __init__(self, known: Mapping[tuple[int, int], Collection[int]], objects: Collection[int]) -> None:
        self.known, self.objects = known, objects
        self.seen: dict[str, int] = {}
        self.times: dict[tuple[int, int], tuple[float, int]] = {}

    def region(self, line: int, entry: Any) -> FoundRegion:
        """Raises _Unusable."""
        region = _region(line, entry)
        if region.obj_id not in self.objects:
            raise _Unusable(f"category {region.obj_id} is not in the data set, which has {_some(self.objects)}")
        picture = (region.scene, region.image)
        if picture not in self.known:
            raise _Unusable(f"scene {region.scene} has no image {region.image} in this data set")
        key = json.dumps(entry, sort_keys=True)
        if key in self.seen:
            raise _Unusable(f"it repeats line {self.seen[key]}")
        first, where = self.times.setdefault(picture, (region.time, line))
        if abs(first - region.time) > _SAME_TIME:
            raise _Unusable(
                f"time {region.time:g} differs from {first:g} in line {where} of the same image; time is for the whole "
                "image and the same in all of its entries"
            )
        self.seen[key] = line
        return region


_LARGEST = 1e300  # integers beyond are no floats
_LONGEST = 19  # digits of a number that is given as text


def _region(line: int, entry: Any) -> FoundRegion:
    """Raises _Unusable."""
    if not isinstance(entry, dict):
        raise _Unusable("an entry is {...} with scene_id, image_id, category_id, score, bbox")
    missing = [k for k in ("scene_id", "image_id", "category_id", "score", "bbox") if k not in entry]
    if missing:
        raise _Unusable(f"{', '.join(missing)} missing")
    ids = [
        int(v) if isinstance(v, str) and v.isascii() and v.isdigit() and len(v) < _LONGEST else v
        for v in (entry[k] for k in ("scene_id", "image_id", "category_id"))
    ]
    if not all(type(v) is int for v in ids):
        raise _Unusable(f"scene_id, image_id and category_id are whole numbers, not {ids}")
    box, score, seconds = entry["bbox"], entry["score"], entry.get("time", -1.0)
    if not isinstance(box, list) or len(box) != 4:
        raise _Unusable("bbox has four numbers, x, y, width and height")
    if not all(type(v) in (int, float) and abs(v) < _LARGEST for v in (*box, score, seconds)):
        raise _Unusable("bbox, score and time are finite numbers")
    x, y, w, h = box
    if w <= 0 or h <= 0:
        raise _Unusable(f"bbox has the size {w:g}x{h:g}")
    rle = entry.get("segmentation")
    if rle is not None and not _is_rle(rle):
        raise _Unusable("segmentation has size [height, width] and counts that fill it")
    scene, image, obj_id = ids
    return FoundRegion(scene, image, obj_id, (x, y, x + w, y + h), float(score), rle, float(seconds), line)


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
    """The entries of a JSON list or of JSON Lines, each with the line that it starts in."""
    text = _text(path)
    lines = json_lines(text)
    if lines is not None:
        numbers = [k + 1 for k, line in enumerate(text.split("\n")) if line.strip()]
        yield from zip(numbers, lines, strict=True)
        return
    decoder = json.JSONDecoder()
    at, line, counted = _skip(text, 0), 1, 0
    if not text[at : at + 1] == "[":
        raise InputError(
            f"{path}, line 1: "
            "a detections file for a data set is a JSON list of {scene_id, image_id, category_id, "
            "score, bbox: [x, y, width, height]}, as BOP has it; other forms do not name the scene."
        )
    at = _skip(text, at + 1)
    while text[at : at + 1] != "]":
        line, counted = line + text.count("\n", counted, at), at
        try:
            entry, end = decoder.raw_decode(text, at)
        except json.JSONDecodeError as error:
            raise InputError(f"{path}, line {error.lineno}: {error.msg}. Correct the file.") from error
        except (ValueError, RecursionError) as error:  # thousands of digits, or of brackets
            raise InputError(f"{path}, line {line}: {error}. Correct the file.") from error
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
        return read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{path} cannot be read: {reason}. Check the path.") from error


def _some(values: Collection[int]) -> str:
    listed = sorted(values)
    return ", ".join(map(str, listed[:12])) + (" ..." if len(listed) > 12 else "")

"""Detections in files: BOP's and COCO's JSON, to and from."""

from __future__ import annotations

import json
import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from posekit.camera import Box, mask_box
from posekit.detect.prompts import clip_box
from posekit.detect.segmentation import decode, encode, xywh
from posekit.errors import PromptError
from posekit.io.documents import camera_entry
from posekit.io.files import read_text
from posekit.mesh.model import ObjectModel
from posekit.results import DETECTIONS_SCHEMA, Detection, Source, check_schema, document_to_json
from posekit.view import View

log = logging.getLogger("posekit")

_BEYOND = 1.1  # of a picture's side: a box that ends further out was not given by width and height

_FORMS = (
    "a list of {image_id, category_id, score, bbox: [x, y, width, height], segmentation} as BOP and COCO results have "
    "it, one of them a line, or COCO's {images, annotations, categories}"
)


@dataclass(frozen=True, eq=False)
class DetectionsFile:
    """A Detector that reads what another program, or `posekit detect`, found. entries: of one picture; names: of
    categories, by number."""

    entries: Sequence[Mapping[str, Any]]
    names: Mapping[int, str]
    label: str
    undistorted: bool = False  # whether boxes and masks are of the undistorted picture, as posekit's own are

    @classmethod
    def read(cls, path: Path, image: Path) -> DetectionsFile:
        """The entries for a photograph: `Detections.read`, and its ``of``."""
        return Detections.read(path).of(image)

    def detect(self, view: View, models: Sequence[ObjectModel]) -> list[Detection]:
        """Each model's detections by falling score. A category belongs to the model of its name, or of its number
        (``obj_000005`` is 5); with one model and one category they belong together anyway. Raises PromptError."""
        categories = {int(entry["category_id"]) for entry in self.entries}
        found = []
        for model in models:
            wanted = {
                c
                for c in categories
                if self.names.get(c, "").lower() == model.name.lower() or c == model_number(model.name)
            }
            if not wanted and len(models) == 1 and len(categories) == 1:
                wanted = categories
            if not wanted and self.entries:
                text = (
                    f"{self.label} has nothing for {model.name} in this picture, only for the categories "
                    f"{self._categories(categories)}: name the mesh after its category (NAME.ply, or obj_000005.ply "
                    "for category 5)."
                )
                if len(models) == 1:
                    raise PromptError(text)
                log.warning("%s", text)
            chosen = [(k, e) for k, e in enumerate(self.entries) if int(e["category_id"]) in wanted]
            corners = self._corners(view)
            mine = [d for k, e in chosen if (d := self._usable_detection(k, e, view, model, corners)) is not None]
            if chosen and not mine:
                raise PromptError(f"{self.label}: none of its {len(chosen)} detections of {model.name} can be used.")
            found += sorted(mine, key=lambda d: -d.score)
        return found

    def _categories(self, numbers: set[int]) -> str:
        return ", ".join(f"{n} ({self.names[n]})" if n in self.names else str(n) for n in sorted(numbers))

    def _corners(self, view: View) -> bool:
        """Whether all boxes of the picture are x0, y0, x1, y1, which is logged."""
        size = (view.camera if view.lens is None else view.lens.camera).size
        return are_corners([e["bbox"] for e in self.entries if _four(e.get("bbox"))], size, self.label)

    def _usable_detection(
        self, k: int, entry: Mapping[str, Any], view: View, model: ObjectModel, corners: bool
    ) -> Detection | None:
        """The detection, or None where it cannot be used, which is logged."""
        try:
            return self._detection(entry, view, model, corners)
        except PromptError as error:
            log.warning("%s: entry %d for this picture is skipped: %s", self.label, k + 1, error)
            return None

    def _detection(self, entry: Mapping[str, Any], view: View, model: ObjectModel, corners: bool) -> Detection:
        try:
            score = float(entry.get("score", 1.0))
            lens = None if self.undistorted else view.lens
            taken = view.camera if lens is None else lens.camera
            mask = decode(entry["segmentation"], taken.size) if entry.get("segmentation") else None
            box = _box(entry["bbox"], corners) if entry.get("bbox") is not None else None
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise PromptError(f"{self.label} has an entry that is no detection ({error!r}): give {_FORMS}.") from error
        if mask is not None and not mask.any():
            mask = None
        if box is None:
            box = mask_box(mask) if mask is not None else None
        if box is None or not math.isfinite(score):
            raise PromptError(f"{self.label} has a detection with neither box nor mask, or without a finite score.")
        if lens is not None:
            box = lens.undistorted_box(clip_box(box, taken))
            mask = None if mask is None else lens.undistorted_mask(mask)
        return Detection(clip_box(box, view.camera), mask, score, model.name, Source.FILE)


@dataclass(frozen=True, eq=False)
class Detections:
    """A file with the detections of one picture or of many, read once. files: names of pictures, by number. The rest is
    as `DetectionsFile` has it."""

    entries: Sequence[Mapping[str, Any]]
    names: Mapping[int, str]
    files: Mapping[int, str]
    label: str
    undistorted: bool = False

    @classmethod
    def read(cls, path: Path) -> Detections:
        """Entries that cannot be used are skipped and logged. Raises PromptError where the file is no detections."""
        try:
            text = read_text(path)
            data = json_lines(text) or json.loads(text)
        except (OSError, ValueError, RecursionError) as error:
            raise PromptError(f"the detections {path} cannot be read ({error}): give {_FORMS}.") from error
        try:
            documents = _documents(data)
            for document in data if isinstance(data, list) else [data]:
                check_schema(document, str(path))
            every, names, files = _parts(_as_coco(documents) if documents else data)
            entries = [e for k, e in enumerate(every) if _usable(e, k, path.name)]
        except (KeyError, TypeError, AttributeError, ValueError, OverflowError) as error:
            raise PromptError(f"{path} holds no detections ({error!r}): give {_FORMS}.") from error
        if every and not entries:
            raise PromptError(f"{path} has {len(every)} entries and none that can be used: give {_FORMS}.")
        if not every:
            log.warning("%s holds no detections at all.", path.name)
        return cls(entries, names, files, path.name, bool(documents))

    def of(self, image: Path) -> DetectionsFile:
        """The entries for a photograph: its number is the last one in its name, as BOP has it; a file about one picture
        only is taken to be about this one. Of several scenes the one of the picture's folder counts. Raises PromptError
        where there are none for this picture, and says which pictures there are."""
        pictures = self._pictures[self._scene(image)]
        own = self._number(image)
        if own not in pictures and len(pictures) <= 1 and (own is None or own not in self.files):
            found = [entry for entries in pictures.values() for entry in entries]
        else:
            found = [] if own is None else pictures.get(own, [])
        if not found and pictures and own not in self.files:
            which = "a picture without a number in its name" if own is None else f"image {own}"
            raise PromptError(
                f"{self.label} has nothing for {image.name} ({which}); it is about the images {_some(set(pictures))}. "
                "Name the picture by its number, or keep its entries alone."
            )
        return DetectionsFile(found, self.names, self.label, self.undistorted)

    @cached_property
    def _pictures(self) -> dict[int | None, dict[int, list[Mapping[str, Any]]]]:
        """By scene, where there are several (else None), the entries of each picture."""
        scenes = {int(e["scene_id"]) for e in self.entries if e.get("scene_id") is not None}
        several = scenes if len(scenes) > 1 else {None}
        found: dict[int | None, dict[int, list[Mapping[str, Any]]]] = {scene: {} for scene in several}
        for entry in self.entries:
            stated = entry.get("scene_id")
            for scene in several if stated is None or len(scenes) < 2 else [int(stated)]:
                found[scene].setdefault(int(entry["image_id"]), []).append(entry)
        return found

    def _scene(self, image: Path) -> int | None:
        """Of several scenes the one that the picture's folder is named after. Raises PromptError."""
        scenes = {scene for scene in self._pictures if scene is not None}
        if not scenes:
            return None
        own = next((int(p.name) for p in image.resolve().parents if p.name.isascii() and p.name.isdigit()), None)
        if own not in scenes:
            where = (
                "the picture lies in no folder of a scene's number" if own is None else f"the picture is of scene {own}"
            )
            raise PromptError(
                f"{self.label} is about the scenes {_some(scenes)}, and {where}: keep the entries of its scene."
            )
        return own

    @cached_property
    def _numbers(self) -> dict[str, int]:
        """Of pictures that have a name, by path and by name, of several with a name the first."""
        found: dict[str, int] = {}
        for number, name in self.files.items():
            found.setdefault(Path(name).name, number)
        return found | {name: number for number, name in self.files.items()}

    def _number(self, image: Path) -> int | None:
        named = self._numbers.get(str(image), self._numbers.get(image.name))
        return named if named is not None else _last_number(image)


def json_lines(text: str) -> list[Any] | None:
    """The entries of a file that has one detection, or one picture's `to_document`, a line (JSON Lines); None where it
    has another form."""
    lines = [line for line in text.split("\n") if line.strip()]
    if not lines or not all(line.lstrip().startswith("{") for line in lines):
        return None
    try:
        found = [json.loads(line) for line in lines]
    except ValueError:
        return None
    known = all("category_id" in entry or entry.get("schema") == DETECTIONS_SCHEMA for entry in found)
    return found if known else None


def _parts(data: Any) -> tuple[list[Any], dict[int, str], dict[int, str]]:
    """Entries, names of categories, and file names of pictures, by number."""
    if isinstance(data, list):
        return data, {}, {}
    if "annotations" not in data and data and all(str(key).isdigit() for key in data):  # by picture
        return [{"image_id": key, **entry} for key, entries in data.items() for entry in entries], {}, {}
    names = {int(c["id"]): str(c.get("name", "")) for c in data.get("categories", [])}
    files = {int(i["id"]): str(i.get("file_name", "")) for i in data.get("images", [])}
    return list(data["annotations"]), names, files


def _documents(data: Any) -> list[Mapping[str, Any]]:
    """The documents of `to_document` in a file, none where it has another form."""
    found = data if isinstance(data, list) else [data]
    own = bool(found) and all(isinstance(d, Mapping) and d.get("schema") == DETECTIONS_SCHEMA for d in found)
    return list(found) if own else []


def _as_coco(documents: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Documents of `to_document` as COCO has it."""
    labels = sorted({str(d["label"] or "") for document in documents for d in document["detections"]})
    return {
        "images": [{"id": n, "file_name": document.get("image", "")} for n, document in enumerate(documents)],
        "categories": [{"id": k, "name": name} for k, name in enumerate(labels)],
        "annotations": [
            {
                "image_id": n,
                "category_id": labels.index(str(d["label"] or "")),
                "score": d["score"],
                "bbox": xywh(tuple(d["box"])),
                "segmentation": d["mask"],
            }
            for n, document in enumerate(documents)
            for d in document["detections"]
        ],
    }


def _usable(entry: Any, k: int, label: str) -> bool:
    """Whether an entry names its picture and its category; logged where not."""
    try:
        int(entry["category_id"]), int(entry["image_id"])
        if entry.get("scene_id") is not None:
            int(entry["scene_id"])
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        log.warning("%s: entry %d is skipped: %s.", label, k + 1, reason)
        return False
    return True


def _some(numbers: set[int]) -> str:
    return ", ".join(map(str, sorted(numbers)[:8])) + (", ..." if len(numbers) > 8 else "")


def _last_number(image: Path) -> int | None:
    digits = re.findall(r"\d+", image.stem)
    return int(digits[-1]) if digits else None


def model_number(name: str) -> int | None:
    """The number at the end of a mesh's name, as BOP numbers objects; None without one."""
    found = re.search(r"(\d+)$", name)
    return int(found[1]) if found else None


def are_corners(boxes: Sequence[Sequence[float]], size: tuple[int, int], label: str) -> bool:
    """Whether boxes that should be x, y, width, height are x0, y0, x1, y1, which is logged: so all lie within the
    picture (size: its width, height), and some do not as the former. label: of the file."""
    width, height = size
    inside = all(x0 < x1 <= width + 1 and y0 < y1 <= height + 1 for x0, y0, x1, y1 in boxes)
    beyond = any(x + w > _BEYOND * width or y + h > _BEYOND * height for x, y, w, h in boxes)
    if inside and beyond:
        log.warning(
            "%s: its boxes go beyond the picture of %dx%d pixels as x, y, width, height, and lie within it as "
            "x0, y0, x1, y1: they are taken for the latter. COCO and BOP have the former: correct the file.",
            label, width, height,
        )  # fmt: skip
    return inside and beyond


def _four(values: Any) -> bool:
    """Whether these are a box's four numbers: whole numbers of any length can be in JSON, and no pixel is that far."""
    return (
        isinstance(values, list) and len(values) == 4 and all(type(v) in (int, float) and abs(v) < 1e9 for v in values)
    )


def _box(values: Sequence[float], corners: bool) -> Box:
    """corners: whether they are x0, y0, x1, y1, else x, y, width, height."""
    x, y, width, height = (float(v) for v in values)
    return (x, y, width, height) if corners else (x, y, x + width, y + height)


def categories_of(names: Sequence[str]) -> dict[str, int]:
    """A number for each name: the one at its end where all have different ones, else 1, 2, 3 ..."""
    numbers = [model_number(name) for name in names]
    if None in numbers or len(set(numbers)) < len(numbers):
        return {name: k + 1 for k, name in enumerate(names)}
    return {name: number for name, number in zip(names, numbers, strict=True) if number is not None}


def to_coco(detections: Sequence[Detection], names: Sequence[str], image: Path, size: tuple[int, int]) -> str:
    """COCO's {images, annotations, categories}, annotations with scores. names: of all classes. size: (width,
    height)."""
    numbers = categories_of(names)
    number = _last_number(image) or 0
    document = {
        "images": [{"id": number, "file_name": image.name, "width": size[0], "height": size[1]}],
        "categories": [{"id": number, "name": name} for name, number in numbers.items()],
        "annotations": [
            {"id": k + 1, "iscrowd": 0, "area": _area(d), **_entry(d, number, numbers)}
            for k, d in enumerate(detections)
        ],
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def to_bop(
    detections: Sequence[Detection], names: Sequence[str], image: Path, seconds: float, scene: int | None = None
) -> str:
    """BOP's list of detections. seconds: of the whole picture. scene: the number of the folder above ``rgb`` where it
    is not given, 0 where there is none."""
    numbers = categories_of(names)
    if scene is None:
        folder = image.resolve().parent.parent.name
        scene = int(folder) if folder.isdigit() else 0
    number = _last_number(image) or 0
    entries = [{"scene_id": scene, **_entry(d, number, numbers), "time": seconds} for d in detections]
    return json.dumps(entries, indent=1, allow_nan=False) + "\n"


def to_document(
    detections: Sequence[Detection], view: View, image: Path, seconds: float, indent: int | None = 1
) -> str:
    """posekit's own form (docs/result-json.md), best first. seconds: of the whole picture. indent: None writes one
    line."""
    entries = [
        {
            "box": list(d.box),
            "score": d.score,
            "label": d.label,
            "source": d.source.value,
            "mask": None if d.mask is None else encode(d.mask),
        }
        for d in sorted(detections, key=lambda d: -d.score)
    ]
    about = {"image": image, "camera": camera_entry(view), "seconds": seconds, "detections": entries}
    return document_to_json(DETECTIONS_SCHEMA, about, indent)


def _entry(detection: Detection, image: int, numbers: Mapping[str, int]) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "image_id": image,
        "category_id": numbers[detection.label or "object"],
        "score": detection.score,
        "bbox": xywh(detection.box),
    }
    return entry if detection.mask is None else entry | {"segmentation": encode(detection.mask)}


def _area(detection: Detection) -> float:
    if detection.mask is not None:
        return float(detection.mask.sum())
    x0, y0, x1, y1 = detection.box
    return (x1 - x0) * (y1 - y0)

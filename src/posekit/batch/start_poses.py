"""Poses to refine, by picture: of a results.jsonl, of a folder, or one for all pictures."""

from __future__ import annotations

import json
from pathlib import Path

from posekit.batch.results_file import LINES
from posekit.errors import PromptError
from posekit.geometry import Pose
from posekit.io.load import load_pose
from posekit.results import RESULT_SCHEMA, estimates_from_json


class StartPoses:
    """path: a file of lines as ``estimate`` writes them for several pictures (.jsonl), the folder that has it, a folder
    with NAME/result.json, NAME.json or NAME.txt for each picture, or a file with one pose. Raises PromptError."""

    def __init__(self, path: Path) -> None:
        self.path = path
        lines = path / LINES if path.is_dir() else path
        self.lines = lines if lines.suffix == ".jsonl" and lines.is_file() else None
        self.places: dict[str, list[int]] = {}  # where a picture's line begins, by its path and by its name
        if self.lines is not None:
            self._index(self.lines)
        self.one = None if self.lines is not None or path.is_dir() else load_pose(path)

    def _index(self, lines: Path) -> None:
        place = 0
        try:
            with lines.open("rb") as file:
                for k, line in enumerate(file):
                    document = json.loads(line)
                    if document.get("schema") != RESULT_SCHEMA:
                        raise ValueError(f"line {k + 1} is no {RESULT_SCHEMA}")
                    image = str(document["image"])
                    for name in {image, Path(image).name}:
                        self.places.setdefault(name, []).append(place)
                    place += len(line)
        except (OSError, ValueError, KeyError, AttributeError) as error:
            raise PromptError(
                f"the poses {lines} cannot be read ({error}): give results.jsonl of posekit estimate or refine."
            ) from error

    def of(self, image: Path, model: str) -> list[Pose]:
        """``T_cam_obj`` of the object in a picture, of each instance; none where it was not found there. model: the
        mesh's name. Raises PromptError where nothing is said about the picture."""
        if self.one is not None:
            return [self.one]
        if self.lines is not None:
            return self._in_lines(self.lines, image, model)
        tried = [self.path / image.stem / "result.json", self.path / f"{image.stem}.json"]
        for file in tried:
            if file.is_file():
                return self._in_result(file, model)
        return [load_pose(self._text_file(image))]

    def first(self, image: Path, model: str) -> Pose:
        """The first of them. Raises PromptError where there is none."""
        found = self.of(image, model)
        if not found:
            raise PromptError(f"{self.path} has no pose of {model} in {image.name} to start from.")
        return found[0]

    def _text_file(self, image: Path) -> Path:
        file = self.path / f"{image.stem}.txt"
        if not file.is_file():
            raise PromptError(
                f"{self.path} has no pose for {image.name}: neither {LINES} nor {image.stem}/result.json, "
                f"{image.stem}.json or {image.stem}.txt is there."
            )
        return file

    def _in_lines(self, lines: Path, image: Path, model: str) -> list[Pose]:
        found = self.places.get(str(image)) or self.places.get(image.name, [])
        if len(found) != 1:
            count = f"{len(found)} lines" if found else "no line"
            raise PromptError(f"{lines} has {count} about {image}: give the pictures as they were given before.")
        with lines.open("rb") as file:
            file.seek(found[0])
            line = file.readline().decode("utf-8")
        return [each.T_cam_obj for each in estimates_from_json(line) if each.model == model]

    def _in_result(self, file: Path, model: str) -> list[Pose]:
        """Of a result those of the mesh; of other files the one pose."""
        try:
            text = file.read_text(encoding="utf-8")
            document = json.loads(text)
        except (OSError, ValueError):
            return [load_pose(file)]  # which says what is wrong with it
        if not isinstance(document, dict) or "estimates" not in document:
            return [load_pose(file)]
        return [each.T_cam_obj for each in estimates_from_json(text) if each.model == model]

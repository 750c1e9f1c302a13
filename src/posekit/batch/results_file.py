"""results.jsonl of a folder: a line for each picture, in the pictures' order, which a later run goes on with.

settings.json beside it says what the lines were made with, so that no file has results of two kinds.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from posekit.batch.pictures import Picture
from posekit.errors import OutputError
from posekit.io.files import check_writable, write_text_atomic

LINES, SETTINGS = "results.jsonl", "settings.json"

Settings = Mapping[str, Any]  # by name; JSON's values


class ResultsFile:
    """A folder's lines. Raises OutputError where the folder cannot be written, holds something else, or results of
    other settings. force: begin anew in it."""

    def __init__(self, folder: Path, settings: Settings, force: bool = False) -> None:
        if folder.exists() and not folder.is_dir():
            raise OutputError(f"{folder} is a file: --out names a folder.")
        check_writable(folder, f"the output folder {folder} cannot be written")
        self.folder, self.path = folder, folder / LINES
        if force:
            self.path.unlink(missing_ok=True)
        elif (folder / SETTINGS).is_file():
            self._compare(settings)
        elif folder.is_dir() and any(folder.iterdir()):
            raise OutputError(
                f"the folder {folder} holds files, but no {SETTINGS} of a run to go on with: pass --force to write "
                "into it, or another --out."
            )
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"the folder {folder} cannot be made: {error.strerror}.") from error
        write_text_atomic(folder / SETTINGS, json.dumps(settings, indent=1) + "\n")

    def _compare(self, settings: Settings) -> None:
        try:
            before = json.loads((self.folder / SETTINGS).read_text(encoding="utf-8"))
            differ = [k for k in sorted({*before, *settings}) if before.get(k) != settings.get(k)]
        except (OSError, ValueError, TypeError, AttributeError) as error:
            raise OutputError(
                f"{self.folder / SETTINGS} cannot be read ({error}): pass --force to begin anew, or another --out."
            ) from error
        if differ:
            told = "; ".join(f"{k} was {_text(before.get(k))}, now {_text(settings.get(k))}" for k in differ)
            raise OutputError(
                f"{self.folder} holds results of other settings ({told}): give the same ones to go on, --force to "
                "begin anew, or another --out."
            )

    def begun(self, pictures: Sequence[Picture]) -> list[dict[str, Any]]:
        """What is known of the pictures that have a line already: ``summary`` of each. Cuts off a line that a killed
        run left unfinished. Raises OutputError where the lines are of other pictures."""
        return list(self._begun(pictures))

    def _begun(self, pictures: Sequence[Picture]) -> Iterator[dict[str, Any]]:
        whole = 0
        with suppress(FileNotFoundError), self.path.open("rb") as file:
            for k, line in enumerate(file):
                if not line.endswith(b"\n"):
                    break
                document = self._document(line, k)
                given = str(pictures[k].path) if k < len(pictures) else "none"
                if document.get("image") != given:
                    raise OutputError(
                        f"line {k + 1} of {self.path} is about {document.get('image')}, and picture {k + 1} is "
                        f"{given}: give the same pictures (further ones at the end), --force to begin anew, or another "
                        "--out."
                    )
                whole += len(line)
                yield summary(document)
        if self.path.exists() and whole < self.path.stat().st_size:
            with self.path.open("rb+") as file:
                file.truncate(whole)

    def _document(self, line: bytes, k: int) -> dict[str, Any]:
        try:
            return dict(json.loads(line))
        except ValueError as error:
            raise OutputError(
                f"line {k + 1} of {self.path} is damaged ({error}): pass --force to begin anew, or another --out."
            ) from error

    def read(self) -> Iterator[str]:
        """The lines that are there, without their ends."""
        with suppress(FileNotFoundError), self.path.open(encoding="utf-8") as file:
            for line in file:
                yield line.rstrip("\n")

    def add(self, line: str) -> None:
        """Write a picture's line. Raises OutputError where that fails."""
        try:
            with self.path.open("ab") as file:
                file.write(line.encode("utf-8") + b"\n")
        except OSError as error:
            raise OutputError(
                f"{self.path} cannot be written: {error.strerror}. Make room and give the same command again."
            ) from error


def summary(document: Mapping[str, Any]) -> dict[str, Any]:
    """Of a line's document, what is counted at the end. problem: why the picture could not be used, or "". reliable:
    whether there are estimates, all of them reliable."""
    found = document.get("estimates", [])
    reliable = bool(found) and all(each["reliable"] for each in found)
    return {"problem": document.get("problem", ""), "reliable": reliable}


def _text(value: Any) -> str:
    return "not given" if value is None else json.dumps(value)

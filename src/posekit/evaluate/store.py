"""An evaluation's folder: one file for each finished picture, so that a killed run can be continued.

``run.json`` says what decides the results; a folder of another run is refused. ``pictures/SCENE_IMAGE.json`` are the
records, each written whole or not at all.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from posekit.errors import OutputError
from posekit.io.files import write_text_atomic

Picture = tuple[int, int]


class RunFolder:
    """Records on disk. identity: what decides the results, plain values.

    Raises OutputError where the folder holds other files or another run; with ``force`` a run in it is deleted.
    """

    def __init__(self, path: Path, identity: Mapping[str, Any], force: bool = False) -> None:
        self.path = path
        self._pictures = path / "pictures"
        text = json.dumps(identity, sort_keys=True, indent=1) + "\n"
        if path.exists() and not path.is_dir():
            raise OutputError(f"{path} is a file: --out names a folder.")
        occupied = path.is_dir() and any(path.iterdir())
        marker = path / "run.json"
        if occupied and not marker.is_file():
            raise OutputError(f"the folder {path} holds files, but no evaluation: pass another --out.")
        if occupied and marker.read_text(encoding="utf-8") != text:
            if not force:
                raise OutputError(
                    f"the folder {path} holds an evaluation with other {_differences(marker, identity)}: pass another "
                    "--out, or --force to throw it away."
                )
            self._clear()
        elif occupied and force:
            self._clear()
        try:
            self._pictures.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"the folder {path} cannot be made: {error.strerror}.") from error
        write_text_atomic(marker, text)

    def _clear(self) -> None:
        shutil.rmtree(self._pictures, ignore_errors=True)
        for name in ("results.json", "report.html"):
            (self.path / name).unlink(missing_ok=True)

    def has(self, picture: Picture) -> bool:
        """Whether there is a record of the picture."""
        return self._file(picture).is_file()

    def read(self, picture: Picture) -> dict[str, Any]:
        """A picture's record. Raises OutputError where it is missing or damaged."""
        path = self._file(picture)
        try:
            record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise OutputError(f"{path} is damaged ({error}): delete it and run again.") from error
        return record

    def write(self, picture: Picture, record: Mapping[str, Any]) -> None:
        """Write a picture's record, whole or not at all."""
        write_text_atomic(self._file(picture), json.dumps(record))

    def _file(self, picture: Picture) -> Path:
        return self._pictures / f"{picture[0]:06d}_{picture[1]:06d}.json"


def _differences(marker: Path, identity: Mapping[str, Any]) -> str:
    """The names of what differs."""
    try:
        before = json.loads(marker.read_text(encoding="utf-8"))
    except ValueError:
        return "settings"
    wanted = json.loads(json.dumps(identity))
    names = [k for k in sorted(set(before) | set(wanted)) if before.get(k) != wanted.get(k)]
    return ", ".join(names) or "settings"

"""Which pictures a command is about."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from posekit.errors import InputError
from posekit.io.video import PICTURES, pictures_in


@dataclass(frozen=True)
class Picture:
    """A picture of several. name: of the folder for its own files, different for each."""

    path: Path
    name: str


def several(images: Sequence[Path]) -> bool:
    """Whether these arguments may stand for several pictures: not where one file alone is named."""
    return len(images) != 1 or images[0].is_dir() or _is_glob(images[0])


def _is_glob(path: Path) -> bool:
    return glob.has_magic(str(path)) and not path.exists()


def pictures_of(images: Sequence[Path]) -> list[Picture]:
    """The pictures that arguments name: files as they are, folders' pictures and those of globs in the order of the
    numbers in their names. Raises InputError where a folder or a glob has none."""
    paths: list[Path] = []
    for image in images:
        if image.is_dir():
            paths += pictures_in(image.iterdir(), str(image))
        elif _is_glob(image):
            paths += pictures_in(map(Path, glob.glob(str(image), recursive=True)), str(image))  # noqa: PTH207 - absolute
        else:
            paths.append(image)
    if not paths:
        raise InputError(f"no pictures were given: name files, a folder or a glob ({', '.join(PICTURES)}).")
    used: set[str] = set()
    return [Picture(path, _new_name(path.stem, used)) for path in paths]


def _new_name(stem: str, used: set[str]) -> str:
    """The stem; with a number behind it where that is taken."""
    name, number = stem, 1
    while name in used:
        number += 1
        name = f"{stem}-{number}"
    used.add(name)
    return name


def folder_name(images: Sequence[Path]) -> str:
    """How the default output folder of these arguments is called."""
    [*_, last] = [Path.cwd(), *images]
    return last.resolve().name if len(images) == 1 and last.is_dir() else "pictures"

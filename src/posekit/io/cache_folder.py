"""What posekit keeps on disk because it takes long to make: all of it can be made anew."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from posekit.io.files import user_cache

# Folders (patterns) in the user's cache and what lies in them. Downloaded data sets are no part of it.
KINDS = {
    "openvino": "networks converted for OpenVINO",
    "openvino/compiled": "networks compiled for this processor",
    "templates-*": "views of meshes that first poses are compared with",
    "silhouettes": "these views turned, with their outlines and colours",
    "culled": "whether meshes look the same without the faces at their back",
    "features": "local features of meshes",
    "meshes": "large meshes as they were read",
    "meshes-small": "other meshes as they were read",
    "light": "large meshes as they are drawn",
}


@dataclass(frozen=True)
class Kept:
    """One folder. count: entries in it, files or folders; size: bytes."""

    folder: Path
    what: str
    count: int
    size: int


def kept() -> list[Kept]:
    """Every folder that is there, in the order of `KINDS`."""
    found = []
    for pattern, what in KINDS.items():
        for folder in sorted(user_cache("").glob(pattern)):
            entries = _entries(folder)
            found.append(Kept(folder, what, len(entries), sum(map(_size, entries))))
    return found


def clear() -> int:
    """Delete all of it; a process that uses some of it makes it anew. Returns how many bytes there were. What cannot be
    deleted stays."""
    size = 0
    for each in kept():
        size += each.size
        _delete(_entries(each.folder))
    return size - sum(each.size for each in kept())


def make_room(entries: Iterable[Path], most: int) -> None:
    """Delete files or folders, the oldest first, until ``most`` are left."""
    aged = []
    for entry in entries:
        with suppress(OSError):  # another process deleted it
            aged.append((entry.stat().st_mtime, entry))
    _delete(entry for _, entry in sorted(aged)[: max(0, len(aged) - most)])


def _entries(folder: Path) -> list[Path]:
    """But for a folder that is a kind of its own."""
    own = {user_cache(pattern) for pattern in KINDS}
    return [entry for entry in folder.iterdir() if entry not in own] if folder.is_dir() else []


def _size(entry: Path) -> int:
    files = entry.rglob("*") if entry.is_dir() else [entry]
    size = 0
    for file in files:
        with suppress(OSError):
            size += file.stat().st_size if file.is_file() else 0
    return size


def _delete(entries: Iterable[Path]) -> None:
    for entry in entries:
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry, ignore_errors=True)
        else:
            with suppress(OSError):
                entry.unlink(missing_ok=True)

"""Large PLY files as they were read the last time: reading, checking and shading millions of faces takes seconds."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from posekit.io.array_cache import keep_arrays, read_arrays
from posekit.io.files import user_cache
from posekit.io.limits import limit

FACES = 100_000  # of a mesh that is kept, at least
MOST = 5  # meshes that are kept
_VERSION = 1
_BYTES = 1_000_000  # a smaller file has fewer faces
_NEEDED = {"vertices", "faces", "normals", "hull", "size"}
_COLOURS = re.compile(rb"red|green|blue|colou?r|rgb|intensity|gr[ae]y", re.IGNORECASE)


def kept_file(path: Path, units: str) -> Path | None:
    """Where the mesh of a large PLY file is kept, by the file's bytes and the units asked for; None for other files,
    and for those that cannot be read."""
    try:
        if path.suffix.lower() != ".ply" or not _BYTES < path.stat().st_size <= limit("POSEKIT_MOST_MESH_BYTES"):
            return None
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return None
    return user_cache("meshes") / f"{digest[:32]}-{units}-{_VERSION}.npz"


def read_kept(file: Path) -> dict[str, NDArray[Any]] | None:
    """What `keep` wrote; None where there is nothing that can be used."""
    arrays = read_arrays(file)
    if arrays is None or not _NEEDED <= set(arrays) <= _NEEDED | {"colors"}:
        return None
    return arrays if len(arrays["faces"]) <= limit("POSEKIT_MOST_FACES") else None


def is_large(faces: NDArray[Any]) -> bool:
    """Whether a mesh has so many faces that what is drawn of it is kept simplified."""
    return len(faces) > FACES


def keep(file: Path, path: Path, arrays: dict[str, NDArray[Any] | None]) -> None:
    """arrays: vertices, faces, normals, colors (or None), hull, size. A mesh without colours whose file
    speaks of some is not kept: what is wrong with them is to be said each time."""
    if arrays["colors"] is None:
        with path.open("rb") as source:
            if _COLOURS.search(source.read(65536).partition(b"end_header")[0]):
                return
    kept = {name: array for name, array in arrays.items() if array is not None}
    keep_arrays(file, kept, most=MOST, compressed=False)

"""PLY files as they were read the last time.

Of a small one, later uses do without trimesh and SciPy, which take half a second to import; reading, checking and
shading a large one takes seconds.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from posekit.io.array_cache import keep_arrays, read_arrays
from posekit.io.files import user_cache
from posekit.io.limits import limit

FACES = 100_000  # of a mesh that is large
_BYTES = 5_000_000  # of a file that is large
MOST = {"meshes": 5, "meshes-small": 50}  # files that are kept in each folder
_VERSION = 2
_NEEDED = {"vertices", "faces", "normals", "hull", "diameter", "size"}
_COLOURS = re.compile(rb"red|green|blue|colou?r|rgb|intensity|gr[ae]y", re.IGNORECASE)
_PROPERTY = re.compile(rb"^property[^\r\n]* (\w+) *\r?$", re.MULTILINE)
_PLAIN = frozenset(b"x y z nx ny nz red green blue alpha vertex_index vertex_indices".split())


def kept_file(path: Path, units: str) -> Path | None:
    """Where the mesh of a PLY file is kept, by the file's bytes and the units asked for; None for other files, and for
    those that cannot be read."""
    try:
        if path.suffix.lower() != ".ply" or path.stat().st_size > limit("POSEKIT_MOST_MESH_BYTES"):
            return None
        folder = "meshes" if path.stat().st_size > _BYTES else "meshes-small"
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return None
    return user_cache(folder) / f"{digest[:32]}-{units}-{_VERSION}.npz"


def read_kept(file: Path) -> dict[str, NDArray[Any]] | None:
    """What `keep` wrote; None where there is nothing that can be used."""
    arrays = read_arrays(file)
    if arrays is None or not _NEEDED <= set(arrays) <= _NEEDED | {"colors"}:
        return None
    return arrays if len(arrays["faces"]) <= limit("POSEKIT_MOST_FACES") else None


def keep(file: Path, path: Path, arrays: dict[str, NDArray[Any] | None]) -> None:
    """arrays: vertices, faces, normals, colors (or None), hull, diameter, size; of a mesh without texture. Kept is what
    nothing can be said about at later uses: meshes with plain properties alone, and large ones; but none without
    colours whose file speaks of some."""
    with path.open("rb") as source:
        header = source.read(65536).partition(b"end_header")[0]
    assert arrays["faces"] is not None
    plain = set(_PROPERTY.findall(header)) <= _PLAIN
    if not (plain or len(arrays["faces"]) > FACES) or (arrays["colors"] is None and _COLOURS.search(header)):
        return
    kept = {name: array for name, array in arrays.items() if array is not None}
    keep_arrays(file, kept, most=MOST[file.parent.name], compressed=False)

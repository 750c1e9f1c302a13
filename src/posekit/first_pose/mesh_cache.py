"""What is made once per mesh and kept on disk: arrays, by the mesh's shape and looks."""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from posekit.errors import OutputError
from posekit.io.files import user_cache, write_bytes_atomic
from posekit.mesh.model import ObjectModel

KEPT = 100  # meshes whose arrays of one kind stay on disk


def cache_file(kind: str, model: ObjectModel, version: int) -> Path:
    """Where a mesh's arrays are kept: in the folder of the kind, named by shape, colours or texture, and version."""
    look = hashlib.sha256(model.digest.encode())
    for array in (model.colors, model.uvs, model.texture):
        if array is not None:
            look.update(str(array.shape).encode() + np.ascontiguousarray(array).tobytes())
    return user_cache(kind) / f"{model.digest}-{look.hexdigest()[:16]}-{version}.npz"


def read_arrays(path: Path) -> dict[str, NDArray[Any]] | None:
    """The arrays that `keep_arrays` wrote; None where there are none, or the file is damaged."""
    with (
        suppress(OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile),
        np.load(path, allow_pickle=False) as kept,
    ):
        return {name: kept[name] for name in kept.files}
    return None


def keep_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Written whole or not at all; the oldest files make room. A cache that cannot be written costs time only."""
    with suppress(OSError, OutputError):
        path.parent.mkdir(parents=True, exist_ok=True)
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
        write_bytes_atomic(path, buffer.getvalue())
        files = sorted(path.parent.glob("*.npz"), key=lambda p: p.stat().st_mtime)
        for old in files[:-KEPT]:
            old.unlink(missing_ok=True)

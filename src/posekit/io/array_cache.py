"""Arrays that are kept on disk because making them takes long: a bounded number of files of each kind."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from posekit.errors import OutputError
from posekit.io.cache_folder import make_room
from posekit.io.files import write_bytes_atomic

KEPT = 100  # files of one kind that stay on disk


def read_arrays(path: Path) -> dict[str, NDArray[Any]] | None:
    """The arrays that `keep_arrays` wrote; None where there are none, or the file is damaged."""
    with (
        suppress(OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile),
        path.open("rb") as file,
        np.load(file, allow_pickle=False) as kept,
    ):
        return {name: kept[name] for name in kept.files}
    return None


def keep_arrays(
    path: Path, arrays: Mapping[str, NDArray[Any]], *, most: int | None = None, compressed: bool = True
) -> None:
    """Written whole or not at all; the oldest files make room. A cache that cannot be written costs time only.

    most: files that stay in the folder, `KEPT` where not given. compressed: smaller, and slower to read.
    """
    with suppress(OSError, OutputError):
        path.parent.mkdir(parents=True, exist_ok=True)
        buffer = io.BytesIO()
        (np.savez_compressed if compressed else np.savez)(buffer, **arrays)  # type: ignore[arg-type]
        write_bytes_atomic(path, buffer.getvalue())
        make_room(path.parent.glob("*.npz"), KEPT if most is None else most)

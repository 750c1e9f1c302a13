"""The objects of a data set, read from where a person keeps them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from posekit.datasets.symmetry import DETECT, declared, load_detecting
from posekit.errors import ConfigError, MeshError
from posekit.mesh.model import ObjectModel
from posekit.mesh.reading import FORMATS
from posekit.render import Renderer


def read_objects(paths: Sequence[Path], units: str, symmetry: str) -> dict[int, ObjectModel]:
    """Meshes by obj_id: BOP's numbers where every file is named obj_NNNNNN, else 1, 2, ... in order.

    paths: mesh files, and folders of them. symmetry: for meshes without a models_info.json beside them: "detect", or
    as `Symmetries.parse` takes it. Raises MeshError or ConfigError.
    """
    files = [file for path in paths for file in _files(path)]
    numbers = [re.fullmatch(r"obj_(\d+)", file.stem) for file in files]
    ids = [int(n[1]) if n else 0 for n in numbers] if all(numbers) else list(range(1, len(files) + 1))
    if len(set(ids)) < len(ids):
        raise ConfigError("two of the meshes have the same number obj_NNNNNN: give each its own.")
    renderer = Renderer() if symmetry == DETECT else None
    return {obj_id: _read(file, units, symmetry, renderer) for obj_id, file in zip(ids, files, strict=True)}


def _read(file: Path, units: str, symmetry: str, renderer: Renderer | None) -> ObjectModel:
    if renderer is not None:
        return load_detecting(file, units, renderer)
    return ObjectModel.load(file, units=units, symmetry=None if declared(file) else symmetry)


def _files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    found = sorted(file for file in path.rglob("*") if file.suffix.lower() in FORMATS)
    if not found:
        raise MeshError(f"the folder {path} holds no meshes ({', '.join(FORMATS)}).")
    return found

"""Meshes as commands' options name them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from posekit.mesh.model import ObjectModel


def load_meshes(paths: Sequence[Path], units: str, symmetry: str | None) -> list[ObjectModel]:
    """symmetry: as `ObjectModel.load` takes it, or "detect": looked for where no models_info.json tells them. Raises
    MeshError."""
    from posekit.datasets.symmetry import DETECT, load_detecting
    from posekit.render import Renderer

    if symmetry != DETECT:
        return [ObjectModel.load(path, units=units, symmetry=symmetry) for path in paths]
    renderer = Renderer()
    return [load_detecting(path, units, renderer) for path in paths]

"""What a training is fed with, read from where its configuration says. Layer 5."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.data.bop import BopDataset
from posekit.data.stream import load_photos
from posekit.errors import ConfigError, MeshError
from posekit.object_model import ObjectModel
from posekit.train.config import SourceConfig

TEXTURE = 512  # pixels: longer sides are shrunk, since a crop shows fewer
MESHES = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")


@dataclass(frozen=True, eq=False)
class Sources:
    """models: the meshes to render; none = procedural ones. photos: backgrounds. bop: data sets with their weights.
    validation: a data set to measure on. about: a line for the weights' description."""

    models: list[ObjectModel]
    photos: list[NDArray[np.uint8]]
    bop: list[tuple[BopDataset, float]]
    validation: BopDataset | None

    @property
    def about(self) -> str:
        meshes = [m.name for m in self.models]
        shown = ", ".join(meshes[:8]) + (" and more" if len(meshes) > 8 else "")
        return f"renderings of {shown}" if meshes else "procedural shapes"


def read_sources(config: SourceConfig) -> Sources:
    """Raises MeshError, InputError or ConfigError where something is missing or cannot be read."""
    models = [ObjectModel.load(path, units=config.units) for path in config.models]
    for folder in config.meshes:
        models += _meshes(Path(folder), config.units)
    backgrounds = Path(config.backgrounds) if config.backgrounds else None
    if backgrounds is not None and not backgrounds.is_dir():
        raise ConfigError(f"there is no folder of backgrounds {backgrounds}.")
    photos = load_photos(backgrounds)
    if backgrounds is not None and not photos:
        raise ConfigError(f"the folder {backgrounds} holds no JPEG, PNG or WebP pictures for backgrounds.")
    validation = BopDataset(config.validate_on) if config.validate_on else None
    return Sources(models, photos, [_weighted(text) for text in config.bop], validation)


def _meshes(folder: Path, units: str) -> list[ObjectModel]:
    if not folder.is_dir():
        raise MeshError(f"there is no folder of meshes {folder}.")
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in MESHES)
    if not paths:
        raise MeshError(f"the folder {folder} holds no meshes ({', '.join(MESHES)}).")
    return [_light(ObjectModel.load(path, units=units)) for path in paths]


def _light(model: ObjectModel) -> ObjectModel:
    """With a texture no larger than `TEXTURE`: a folder may hold a thousand meshes."""
    if model.texture is None or max(model.texture.shape[:2]) <= TEXTURE:
        return model
    scale = TEXTURE / max(model.texture.shape[:2])
    return replace(model, texture=cv2.resize(model.texture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def _weighted(text: str) -> tuple[BopDataset, float]:
    """``FOLDER``, ``FOLDER:SPLIT`` or ``FOLDER:SPLIT=WEIGHT``."""
    place, _, weight = text.partition("=")
    folder, _, split = place.partition(":")
    try:
        number = float(weight or 1.0)
    except ValueError as error:
        raise ConfigError(f"{text!r}: the weight {weight!r} is no number. Write FOLDER:SPLIT=WEIGHT.") from error
    if not number > 0:
        raise ConfigError(f"{text!r}: a weight is above 0.")
    return BopDataset(folder, split or "train", targets=None), number

"""What a training learns from, read from where its configuration says."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.datasets.bop import BopDataset
from posekit.errors import ConfigError, MeshError
from posekit.mesh.model import ObjectModel
from posekit.mesh.reading import FORMATS
from posekit.train.config import SourceConfig
from posekit.train.data.stream import load_photos

TEXTURE = 512  # pixels: longer sides are shrunk, since a crop shows fewer
log = logging.getLogger("posekit")


@dataclass(frozen=True, eq=False)
class Sources:
    """models: the meshes to render; none = procedural ones. photos: backgrounds. bop: data sets with their weights.
    validation: a data set to measure on. folders: where models came from, with how many each. distractors: meshes
    beside them, in any unit."""

    models: list[ObjectModel]
    photos: list[NDArray[np.uint8]]
    bop: list[tuple[BopDataset, float]]
    validation: BopDataset | None
    folders: tuple[tuple[str, int], ...] = ()
    distractors: Sequence[ObjectModel] = ()

    def about(self, share: float) -> str:
        """A line for the weights' description. share: of samples that show the models."""
        given = self.models[: len(self.models) - sum(count for _, count in self.folders)]
        parts = [", ".join(m.name for m in given)] if given else []
        parts += [f"{count} meshes of {name}" for name, count in self.folders]
        told = [f"photographs of {data.root.name}" for data, _ in self.bop]
        if parts and share > 0:
            told.append("renderings of " + ", ".join(parts))
        if (not self.models and not self.bop) or (self.models and share < 1):
            told.append("procedural shapes" + (f" ({1 - share:.0%})" if self.models else ""))
        return "; ".join(told)

    @property
    def seen(self) -> set[str]:
        """The digests of all meshes that a training sees."""
        shown = [m for data, _ in self.bop for m in map(data.model, data.model_ids())]
        return {m.digest for m in [*self.models, *shown]}


def read_sources(config: SourceConfig) -> Sources:
    """Raises MeshError, InputError or ConfigError where something is missing or cannot be read."""
    models = [ObjectModel.load(path, units=config.units) for path in config.models]
    folders = []
    for folder in config.meshes:
        found = _meshes(Path(folder), config.units)
        models += found
        folders.append((Path(folder).name, len(found)))
    backgrounds = Path(config.backgrounds) if config.backgrounds else None
    if backgrounds is not None and not backgrounds.is_dir():
        raise ConfigError(f"there is no folder of backgrounds {backgrounds}.")
    photos = load_photos(backgrounds)
    if backgrounds is not None and not photos:
        raise ConfigError(f"the folder {backgrounds} holds no JPEG, PNG or WebP pictures for backgrounds.")
    validation = BopDataset(config.validate_on) if config.validate_on else None
    distractors = [model for folder in config.distractors for model in _meshes(Path(folder), "m")]
    bop = [_weighted(text) for text in config.bop]
    return Sources(models, photos, bop, validation, tuple(folders), distractors)


def _meshes(folder: Path, units: str) -> list[ObjectModel]:
    if not folder.is_dir():
        raise MeshError(f"there is no folder of meshes {folder}.")
    paths = sorted(path for path in folder.rglob("*") if path.suffix.lower() in FORMATS)
    if not paths:
        raise MeshError(f"the folder {folder} holds no meshes ({', '.join(FORMATS)}).")
    models = [model for path in paths if (model := _loaded(path, units)) is not None]
    if not models:
        raise MeshError(f"none of the {len(paths)} meshes in {folder} can be used; the notes above say why.")
    return models


def _loaded(path: Path, units: str) -> ObjectModel | None:
    """A mesh of a folder; None where it cannot be used, which is logged: one of a thousand must not end a training."""
    try:
        return _light(ObjectModel.load(path, units=units))
    except MeshError as error:
        log.warning("a mesh is left out: %s", error)
        return None


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

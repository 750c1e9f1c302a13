"""An endless stream of composed scenes as a detector learns from them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import IterableDataset

from posekit.errors import ConfigError
from posekit.mesh.model import ObjectModel
from posekit.render import Renderer
from posekit.synth.tabletop import TabletopConfig, compose, procedural_objects, resized
from posekit.train.data.augment import AugmentConfig, observe_photo
from posekit.train.data.stream import BATCHES, OBJECTS, SCENES, Batch, Window, worker_position

Image = NDArray[np.uint8]
Rng = np.random.Generator
UNIT = 0.15  # metres, the usual diameter of objects in class-agnostic scenes
AGNOSTIC_SHARE = 0.5  # of given meshes among the objects of class-agnostic scenes


@dataclass(frozen=True)
class TabletopStreamConfig:
    """How a detector sees scenes on tables."""

    batch: int = 4  # scenes in a batch
    pool: int = 64  # scenes kept to draw from
    reuse: int = 5  # how often each is used, mirrored and photographed anew
    per_block: int = 8  # scenes composed from one set of procedural meshes
    meshes: int = 6  # procedural meshes in a set
    visible: float = 0.1  # least visible share of an instance that is to be found
    least_px: int = 40  # its least visible pixels
    scenes: TabletopConfig = TabletopConfig(size=(320, 240))
    augment: AugmentConfig = AugmentConfig(shrink=1.8)

    def __post_init__(self) -> None:
        if min(self.batch, self.pool, self.reuse, self.per_block, self.meshes) < 1:
            raise ConfigError("a stream's batch, pool, reuse, per_block and meshes are at least 1.")


@dataclass(frozen=True, eq=False)
class LabelledImage:
    """image: uint8 RGB (H, W, 3). labels: int16 (H, W), k + 1 for instance k, 0 elsewhere. classes: of each instance,
    from 0; -1 for one that is not to be found: it belongs to the ground."""

    image: Image
    labels: NDArray[np.int16]
    classes: tuple[int, ...]


def labelled_scenes(
    renderer: Renderer, models: Sequence[ObjectModel], agnostic: bool, count: int, config: TabletopStreamConfig,
    rng: Rng, photos: Sequence[Image], distractors: Sequence[ObjectModel] = (),
) -> list[LabelledImage]:  # fmt: skip
    """``count`` scenes over one set of fresh procedural meshes.

    agnostic: everything is of class 0, procedural meshes too; else classes are the models' numbers, and procedural
    meshes belong to the ground, as do the distractors that take the place of half of them.
    """
    unit = UNIT if agnostic else float(np.median([m.diameter for m in models]))
    others = procedural_objects(config.meshes, rng, photos, unit)
    shown = _mixed(models, others, rng) if agnostic else models
    if distractors and not agnostic:
        others = _mixed(distractors, others, rng)
    found: list[LabelledImage] = []
    while len(found) < count:
        scene = compose(renderer, shown, config.scenes, rng, distractors=others, photos=photos)
        classes = tuple(
            -1 if p.visib_fract < config.visible or p.visible_px < config.least_px or (p.number < 0 and not agnostic)
            else 0 if agnostic else p.number
            for p in scene.placed
        )  # fmt: skip
        if any(c >= 0 for c in classes):
            found.append(LabelledImage(scene.view.image, scene.labels, classes))
    return found


def _mixed(models: Sequence[ObjectModel], others: Sequence[ObjectModel], rng: Rng) -> list[ObjectModel]:
    """Some of the meshes in the sizes of procedural ones, and some of these."""
    chosen = [models[int(k)] if len(models) and rng.random() < AGNOSTIC_SHARE else None
              for k in rng.integers(max(1, len(models)), size=len(others))]  # fmt: skip
    return [other if own is None else resized(own, other.diameter) for own, other in zip(chosen, others, strict=True)]


class TabletopStream(IterableDataset[Batch]):
    """Batches: image uint8 (B, H, W, 3); labels int16 (B, H, W); classes int64 (B, N), -1 where there is no instance.

    Batch k is a function of the seed, k and the number of workers. rank: the process's number.
    """

    def __init__(self, config: TabletopStreamConfig, seed: int, models: Sequence[ObjectModel] = (), *, agnostic: bool,
                 photos: Sequence[Image] = (), distractors: Sequence[ObjectModel] = (), start: int = 0, rank: int = 0
                 ) -> None:  # fmt: skip
        self.config, self.seed, self.models, self.agnostic = config, seed, models, agnostic
        self.distractors = distractors
        self.photos, self.start, self.rank = photos, start, rank

    def __iter__(self) -> Iterator[Batch]:
        first, workers = worker_position(self.start)
        config, worker, renderer = self.config, first % workers, Renderer()

        def block(number: int) -> list[LabelledImage]:
            rng = np.random.default_rng([self.seed, SCENES, OBJECTS, self.rank, worker, number])
            return labelled_scenes(renderer, self.models, self.agnostic, config.per_block, config, rng, self.photos,
                                   self.distractors)  # fmt: skip

        most = max(1, config.pool // config.per_block)
        blocks = Window(block, max(1, most // 4), most, config.batch / config.reuse / config.per_block)
        for k in itertools.count(first, workers):
            rng = np.random.default_rng([self.seed, BATCHES, self.rank, k])
            pool = [scene for each in blocks.at(k // workers) for scene in each]
            chosen = rng.integers(len(pool), size=config.batch)
            yield collate([photographed(pool[int(i)], config.augment, rng) for i in chosen])


def photographed(scene: LabelledImage, config: AugmentConfig, rng: Rng) -> LabelledImage:
    """The scene as a bad photograph, mirrored half of the time."""
    rgba = np.dstack([scene.image, (scene.labels > 0).astype(np.uint8)])
    image, labels = observe_photo(rgba, replace(config, no_mask=1.0), rng)[..., :3], scene.labels
    if rng.random() < 0.5:
        image, labels = image[:, ::-1], labels[:, ::-1]
    return LabelledImage(np.ascontiguousarray(image), np.ascontiguousarray(labels), scene.classes)


def collate(scenes: Sequence[LabelledImage]) -> Batch:
    """As `TabletopStream` describes a batch."""
    most = max(len(s.classes) for s in scenes)
    classes = np.full((len(scenes), most), -1, np.int64)
    for row, scene in zip(classes, scenes, strict=True):
        row[: len(scene.classes)] = scene.classes
    return {
        "image": torch.from_numpy(np.stack([s.image for s in scenes])),
        "labels": torch.from_numpy(np.stack([s.labels for s in scenes])),
        "classes": torch.from_numpy(classes),
    }

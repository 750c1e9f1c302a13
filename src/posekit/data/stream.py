"""An endless stream of training batches, rendered and augmented in worker processes. Layer 3."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from posekit.data.augment import AugmentConfig, Sample, augment
from posekit.data.pairs import Pair, PairConfig, render_pairs
from posekit.data.procedural import random_object
from posekit.object_model import ObjectModel

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class StreamConfig:
    """batch: samples. pool: pairs that a worker keeps. reuse: how often a pair is used, with fresh augmentation.
    per_object: pairs rendered of one object at a time. objects: how many random objects a worker keeps at once."""

    batch: int = 32
    pool: int = 1024
    reuse: int = 3
    per_object: int = 8
    objects: int = 64
    pairs: PairConfig = PairConfig()
    augment: AugmentConfig = AugmentConfig()


def load_photos(folder: Path | None, longest: int = 800) -> list[Image]:
    """The pictures of a folder, shrunk to ``longest`` pixels, in the order of their names."""
    if folder is None:
        return []
    photos = []
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in (".jpg", ".jpeg", ".png", ".webp"):
            continue
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None:
            continue
        scale = longest / max(image.shape[:2])
        if scale < 1:
            image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        photos.append(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
    return photos


class PairStream(IterableDataset[dict[str, Tensor]]):
    """Batches as dictionaries of tensors. Deterministic for a seed, a start and a number of workers.

    models: the objects to train on; none = procedural ones, always new. share: the share of pairs that show
    ``models`` where both are wanted.
    """

    def __init__(self, config: StreamConfig, seed: int, photos: Sequence[Image] = (),
                 models: Sequence[ObjectModel] = (), share: float = 1.0) -> None:  # fmt: skip
        self.config, self.seed, self.photos = config, seed, photos
        self.models, self.share = models, share

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        from posekit.render import Renderer

        info = get_worker_info()
        rng = np.random.default_rng([self.seed, 0 if info is None else info.id])
        if info is not None:  # a worker shares the machine with the training
            os.environ.setdefault("LP_NUM_THREADS", "0")
            cv2.setNumThreads(0)
            torch.set_num_threads(1)
        renderer = Renderer()
        config = self.config
        pool: list[Pair] = []
        shapes: list[ObjectModel] = []
        fresh_per_batch = config.batch / config.reuse
        due = float(config.pool) / 4
        while True:
            while due >= config.per_object:
                pool.extend(render_pairs(renderer, self._object(shapes, rng), config.per_object, config.pairs, rng))
                due -= config.per_object
            while len(pool) > config.pool:  # a random old pair makes room
                k = int(rng.integers(len(pool) - config.per_object))
                pool[k] = pool[-1]
                pool.pop()
            chosen = rng.integers(len(pool), size=config.batch)
            yield collate([augment(pool[k], pool, self.photos, config.augment, rng) for k in chosen])
            due += fresh_per_batch

    def _object(self, shapes: list[ObjectModel], rng: np.random.Generator) -> ObjectModel:
        """The next object: one of the given models or a procedural one, each of which serves a few times."""
        if len(self.models) and rng.random() < self.share:
            return self.models[int(rng.integers(len(self.models)))]
        if len(shapes) < self.config.objects:
            shapes.append(random_object(rng, self.photos))
            return shapes[-1]
        k = int(rng.integers(len(shapes)))
        if rng.random() < 0.3:
            shapes[k] = random_object(rng, self.photos)
        return shapes[k]


def collate(samples: Sequence[Sample]) -> dict[str, Tensor]:
    """observed, rendered: uint8 (B, H, W, 4); flow (B, 2, h, w); valid, visible (B, h, w); the rest (B, ...)."""
    pairs = [s.pair for s in samples]

    def stack(arrays: Sequence[NDArray]) -> Tensor:  # type: ignore[type-arg]
        return torch.from_numpy(np.stack(arrays))

    return {
        "observed": stack([s.observed for s in samples]),
        "rendered": stack([s.rendered for s in samples]),
        "flow": stack([p.flow for p in pairs]).permute(0, 3, 1, 2).contiguous(),
        "valid": stack([p.valid for p in pairs]),
        "visible": stack([s.visible for s in samples]),
        "quat_wxyz": stack([p.quat_wxyz for p in pairs]),
        "v": stack([p.v for p in pairs]),
        "angle": torch.tensor([p.angle for p in pairs], dtype=torch.float32),
        "lost": torch.tensor([p.lost for p in pairs]),
    }

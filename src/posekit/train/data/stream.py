"""Endless streams of training batches, rendered and augmented in worker processes.

Batch k is a pure function of the seed, k, the number of workers and the shards that a process draws: a training that
was killed goes on with the batch it would have had next. What makes it so: every random number comes from a generator
seeded for one purpose, and a pool of renderings is a window of numbered blocks, each of which can be made again.
A batch consists of shards with pools of their own; processes divide the shards among them, so that two processes see
together what one with twice the batch sees.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Generic, TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from posekit.errors import ConfigError
from posekit.first_pose.view_bank import ViewBank
from posekit.mesh.model import ObjectModel
from posekit.render import Renderer
from posekit.synth.procedural import random_object
from posekit.train.data.augment import AugmentConfig, Sample, augment
from posekit.train.data.crops import SceneConfig
from posekit.train.data.pairs import Pair, PairConfig, render_pairs
from posekit.train.data.view_queries import (
    QueryConfig,
    QueryGroup,
    QueryScene,
    collate_queries,
    draw_queries,
    render_queries,
    training_bank,
)

Image = NDArray[np.uint8]
Batch = dict[str, Tensor]
T = TypeVar("T")

# What a generator is for, the second number of its seed
OBJECTS, PAIRS, SCENES, BATCHES, QUERIES = range(5)
QUERIED = 12  # meshes that a shard keeps for MV-Net's queries


@dataclass(frozen=True)
class StreamConfig:
    """How training samples are drawn and shared."""

    batch: int = 32  # pairs in a process's batch
    shard: int = 8  # pairs drawn from one pool at most; the greatest common divisor with the batch counts
    pool: int = 1024  # pairs kept for a batch, over all its shards
    reuse: int = 3  # how often a pair is used, with fresh augmentation
    per_object: int = 8  # pairs rendered of one object at a time
    serves: int = 3  # how often an object is rendered
    mvnet: int = 0  # MV-Net's queries in a batch, a multiple of the number of shards; 0 = none
    share: float = 1.0  # share of the user's meshes where procedural ones are wanted too
    pairs: PairConfig = PairConfig()
    scenes: SceneConfig = SceneConfig()
    queries: QueryConfig = QueryConfig()
    augment: AugmentConfig = AugmentConfig()

    def __post_init__(self) -> None:
        if min(self.batch, self.shard, self.pool, self.reuse, self.per_object, self.serves) < 1:
            raise ConfigError("a stream's batch, shard, pool, reuse, per_object and serves are at least 1.")
        if self.mvnet % self.shards:
            raise ConfigError(f"mvnet is {self.mvnet}; it must be a multiple of the batch's {self.shards} shards.")

    @property
    def shards(self) -> int:
        """Pools that a batch is drawn from."""
        return self.batch // math.gcd(self.batch, self.shard)


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


class Window(Generic[T]):
    """The newest blocks of an endless row, each made by its number. As batches go by the window moves on."""

    def __init__(self, make: Callable[[int], T], first: int, most: int, per_batch: float) -> None:
        self.make, self.first, self.most, self.per_batch = make, first, most, per_batch
        self.blocks: dict[int, T] = {}

    def at(self, batch: int) -> list[T]:
        """The blocks that batch number ``batch`` is drawn from; only those that are not at hand are made."""
        end = self.first + int(batch * self.per_batch)
        wanted = range(max(0, end - self.most), end)
        self.blocks = {k: self.blocks[k] if k in self.blocks else self.make(k) for k in wanted}
        return list(self.blocks.values())


def window(make: Callable[[int], T], config: StreamConfig, drawn: int) -> Window[T]:
    """A pool for a shard from which ``drawn`` samples a batch are drawn."""
    most = max(1, config.pool // config.shards // config.per_object)
    return Window(make, max(1, most // 4), most, drawn / config.reuse / config.per_object)


class Source:
    """The objects of one worker and shard: the user's meshes, or procedural ones, always new."""

    def __init__(self, stream: PairStream, worker: int, shard: int) -> None:
        self.stream, self.worker, self.shard = stream, worker, shard
        self._last: tuple[tuple[int, int], ObjectModel] | None = None

    def rng(self, purpose: int, k: int) -> np.random.Generator:
        """The generator of ``purpose`` and number k, the same in every run."""
        return np.random.default_rng([self.stream.seed, purpose, self.worker, self.shard, k])

    def object(self, purpose: int, block: int) -> ObjectModel:
        """What block number ``block`` shows; the last one is kept, because the next block often shows it too."""
        key = (purpose, block // self.stream.config.serves)
        if self._last is None or self._last[0] != key:
            self._last = (
                key,
                self._make(np.random.default_rng([self.stream.seed, OBJECTS, self.worker, self.shard, *key])),
            )
        return self._last[1]

    def _make(self, rng: np.random.Generator) -> ObjectModel:
        models = self.stream.models
        if len(models) and rng.random() < self.stream.config.share:
            return models[int(rng.integers(len(models)))]
        return random_object(rng, self.stream.photos)


class _Shard:
    """What one worker draws a shard of each of its batches from."""

    def __init__(self, stream: PairStream, worker: int, shard: int, renderer: Renderer) -> None:
        self.stream, self.config, self.shard, self.renderer = stream, stream.config, shard, renderer
        self.source = Source(stream, worker, shard)
        self.pairs = window(self._pairs, self.config, self.config.batch // self.config.shards)
        self.for_queries = Source(stream, worker, shard)
        self.queries = replace(self.config.queries, queries=self.config.mvnet // self.config.shards)
        per_batch = self.queries.queries / self.config.reuse / self.config.per_object
        self.meshes = Window(self._mesh, QUERIED // 4, QUERIED, per_batch)

    def _pairs(self, block: int) -> list[Pair]:
        model, rng = self.source.object(PAIRS, block), self.source.rng(PAIRS, block)
        return render_pairs(self.renderer, model, self.config.per_object, self.config.pairs, rng, self.stream.photos)

    def _mesh(self, block: int) -> tuple[ViewBank, list[QueryScene]]:
        model, rng = self.for_queries.object(SCENES, block), self.for_queries.rng(SCENES, block)
        scenes = render_queries(self.renderer, model, self.config.per_object, self.queries, rng)
        return training_bank(model, self.renderer, self.queries, rng, scenes), scenes

    def draw_queries(self, k: int, workers: int) -> QueryGroup:
        """This shard's queries of batch k, of one mesh."""
        rng = np.random.default_rng([self.stream.seed, QUERIES, k, self.shard])
        meshes = self.meshes.at(k // workers)
        chosen = int(rng.integers(len(meshes)))
        bank, scenes = meshes[chosen]
        strange = [scene for n, (_, found) in enumerate(meshes) if n != chosen for scene in found]
        others = [scene.rgba for scene in [*scenes, *strange]]
        return draw_queries(bank, scenes, others, self.stream.photos, self.queries, rng, strange, self.config.augment)

    def draw(self, k: int, workers: int) -> list[Sample]:
        """This shard of batch k."""
        config, photos = self.config, self.stream.photos
        rng = np.random.default_rng([self.stream.seed, BATCHES, k, self.shard])
        pool = [pair for block in self.pairs.at(k // workers) for pair in block]
        chosen = rng.integers(len(pool), size=config.batch // config.shards)
        return [augment(pool[i], pool, photos, config.augment, rng) for i in chosen]


class PairStream(IterableDataset[Batch]):
    """Batches for the lite recipe, as dictionaries of tensors: `collate`'s, and with ``mvnet`` `collate_queries`'.

    models: the objects to train on; none = procedural ones. start: the first batch's number. rank: the process's
    number, which says which shards it draws.
    """

    def __init__(self, config: StreamConfig, seed: int, photos: Sequence[Image] = (),
                 models: Sequence[ObjectModel] = (), *, start: int = 0, rank: int = 0) -> None:  # fmt: skip
        self.config, self.seed, self.photos, self.models = config, seed, photos, models
        self.start, self.rank = start, rank

    def __iter__(self) -> Iterator[Batch]:
        first, workers = worker_position(self.start)
        renderer, count = Renderer(), self.config.shards
        shards = [_Shard(self, first % workers, self.rank * count + i, renderer) for i in range(count)]
        for k in itertools.count(first, workers):
            batch = collate([sample for shard in shards for sample in shard.draw(k, workers)])
            if self.config.mvnet:
                batch |= collate_queries([shard.draw_queries(k, workers) for shard in shards])
            yield batch


def worker_position(start: int) -> tuple[int, int]:
    """The first batch of this worker process, and how many workers there are. A batch's number modulo theirs says
    whose random numbers it is drawn with, whichever process makes it."""
    info = get_worker_info()
    if info is None:
        return start, 1
    os.environ.setdefault("LP_NUM_THREADS", "0")  # a worker shares the machine with the training
    cv2.setNumThreads(0)
    torch.set_num_threads(1)
    return start + info.id, info.num_workers


def collate(samples: Sequence[Sample]) -> Batch:
    """observed: uint8 (B, H, W, 3); rendered: uint8 (B, H, W, 4); flow (B, 2, h, w); relief (B, H, W); valid, visible
    (B, h, w); silhouettes uint8 (B, 2, h, w); others (B, ...)."""
    pairs = [s.pair for s in samples]

    def stack(arrays: Sequence[NDArray]) -> Tensor:  # type: ignore[type-arg]
        return torch.from_numpy(np.stack(arrays))

    return {
        "observed": stack([s.observed for s in samples]),
        "rendered": stack([s.rendered for s in samples]),
        "flow": stack([p.flow for p in pairs]).permute(0, 3, 1, 2).contiguous(),
        "relief": stack([p.relief for p in pairs]),
        "focal": torch.tensor([p.focal for p in pairs], dtype=torch.float32),
        "valid": stack([p.valid for p in pairs]),
        "visible": stack([s.visible for s in samples]),
        "silhouettes": stack([s.silhouettes for s in samples]),
        "quat_wxyz": stack([p.quat_wxyz for p in pairs]),
        "v": stack([p.v for p in pairs]),
        "angle": torch.tensor([p.angle for p in pairs], dtype=torch.float32),
        "lost": torch.tensor([p.lost for p in pairs]),
    }

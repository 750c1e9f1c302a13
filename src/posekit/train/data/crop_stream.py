"""An endless stream of scenes for training that renders within its step: the paper's."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import IterableDataset

from posekit.datasets.bop import BopDataset, Instance
from posekit.errors import ConfigError
from posekit.geometry import Pose
from posekit.mesh.model import ObjectModel
from posekit.render import Renderer
from posekit.train.data.augment import observe, observe_photo
from posekit.train.data.crops import BoxSample, Frontal, Scene, SceneConfig, box_sample, photo_scene, render_scenes
from posekit.train.data.crops import usable_instances as usable
from posekit.train.data.stream import BATCHES, SCENES, Batch, StreamConfig, window, worker_position


@dataclass(frozen=True, eq=False)
class Photos:
    """A data set's annotated objects. numbers: of its meshes in the catalogue, by obj_id. weight: its share."""

    dataset: BopDataset
    instances: Sequence[Instance]
    numbers: dict[int, int]
    weight: float


class Catalogue:
    """All objects of a training by number, and where pictures of them come from.

    meshes: to render. bop: data sets and weights; their meshes are rendered too. renders: the weight of renderings.
    Raises ConfigError where nothing is left to train on.
    """

    def __init__(self, meshes: Sequence[ObjectModel], bop: Sequence[tuple[BopDataset, float]], renders: float,
                 config: SceneConfig) -> None:  # fmt: skip
        self.models, self.renders, self.photos = list(meshes), renders, []
        for dataset, weight in bop:
            instances = usable(dataset, config)
            ids = sorted({i.obj_id for i in instances})
            numbers = {obj_id: len(self.models) + k for k, obj_id in enumerate(ids)}
            self.models += [dataset.model(obj_id) for obj_id in ids]
            self.photos.append(Photos(dataset, instances, numbers, weight))
        if not self.models or sum(self.weights) <= 0:
            raise ConfigError(
                "there is nothing to train on: no mesh and no annotated object that is visible enough. Pass --model, "
                "--meshes or --bop, and a weight of renderings above 0 where there are no photographs."
            )

    @property
    def weights(self) -> list[float]:
        """Of the renderings, then of each data set that has instances."""
        return [self.renders, *(p.weight if p.instances else 0.0 for p in self.photos)]

    @cached_property
    def epoch(self) -> int:
        """Samples in an epoch: every annotated object, and 5000 renderings of each mesh (paper, section 4.1)."""
        return sum(len(p.instances) for p in self.photos) + (5000 * len(self.models) if self.renders > 0 else 0)


class SceneStream(IterableDataset[Batch]):
    """Batches: scene uint8 (B, Hs, Ws, 4); camera (B, 4), its fx, fy, cx, cy; pose (B, 4, 4), ``T_view_ctr``; object
    (B,), its number in the catalogue; observed uint8 (B, H, W, 4), the crop round the detection's box; turn (B, 3, 3)
    and focal (B,), that crop's ``R_crop_view`` and fx; mv_quat_wxyz (B, 4) and mv_v (B, 3), MV-Net's truth.

    Batch k is a function of its number as `PairStream`'s is.
    """

    def __init__(self, config: StreamConfig, seed: int, catalogue: Catalogue,
                 backgrounds: Sequence[NDArray[np.uint8]] = (), *, start: int = 0, rank: int = 0) -> None:  # fmt: skip
        self.config, self.seed, self.catalogue, self.backgrounds = config, seed, catalogue, backgrounds
        self.start, self.rank = start, rank

    def __iter__(self) -> Iterator[Batch]:
        first, workers = worker_position(self.start)
        count, renderer = self.config.shards, Renderer()
        shards = [_Shard(self, first % workers, self.rank * count + i, renderer) for i in range(count)]
        for k in itertools.count(first, workers):
            yield _collate([drawn for shard in shards for drawn in shard.draw(k, workers)])


Drawn = tuple[int, Scene, NDArray[np.uint8], BoxSample]


class _Shard:
    def __init__(self, stream: SceneStream, worker: int, shard: int, renderer: Renderer) -> None:
        self.stream, self.config, self.worker, self.shard = stream, stream.config, worker, shard
        self.renderer = renderer
        self.blocks = window(self._block, self.config, self.config.batch // self.config.shards)
        self.frontals: dict[int, Frontal] = {}

    def _block(self, number: int) -> list[tuple[int, Scene]]:
        """Renderings of one object, or photographs of several."""
        rng = np.random.default_rng([self.stream.seed, SCENES, self.worker, self.shard, number])
        catalogue, config = self.stream.catalogue, self.config
        weights = np.array(catalogue.weights)
        source = int(rng.choice(len(weights), p=weights / weights.sum()))
        if source == 0:
            k = int(rng.integers(len(catalogue.models)))
            scenes = render_scenes(self.renderer, catalogue.models[k], config.per_object, config.scenes, rng)
            return [(k, scene) for scene in scenes]
        photos = catalogue.photos[source - 1]
        chosen = [photos.instances[int(i)] for i in rng.integers(len(photos.instances), size=config.per_object)]
        found = [(photos.numbers[i.obj_id], photo_scene(photos.dataset, i, config.scenes, rng)) for i in chosen]
        return [(k, scene) for k, scene in found if scene is not None]

    def draw(self, k: int, workers: int) -> list[Drawn]:
        """This shard of batch k."""
        rng = np.random.default_rng([self.stream.seed, BATCHES, k, self.shard])
        pool = [pair for block in self.blocks.at(k // workers) for pair in block]
        if not pool:
            raise ConfigError("none of the objects is seen in its own training scenes: are the meshes or masks empty?")
        chosen = rng.integers(len(pool), size=self.config.batch // self.config.shards)
        return [self._sample(*pool[int(i)], [s.rgba for _, s in pool if not s.photo], rng) for i in chosen]

    def _sample(self, k: int, scene: Scene, others: list[NDArray[np.uint8]], rng: np.random.Generator) -> Drawn:
        if scene.photo:
            picture = observe_photo(scene.rgba, self.config.augment, rng)
        else:
            picture, _ = observe(scene.rgba, others, self.stream.backgrounds, self.config.augment, rng)
        if k not in self.frontals:
            model = self.stream.catalogue.models[k]
            self.frontals[k] = Frontal.of(model, self.renderer, self.config.scenes.crop)
        return k, scene, picture, box_sample(picture, scene, self.frontals[k], self.config.scenes, rng)


def _collate(drawn: Sequence[Drawn]) -> Batch:
    def floats(rows: Sequence[object]) -> torch.Tensor:
        return torch.from_numpy(np.array(rows, dtype=np.float32))

    boxed = [sample for *_, sample in drawn]
    cameras = [scene.camera for _, scene, _, _ in drawn]
    return {
        "scene": torch.from_numpy(np.stack([picture for _, _, picture, _ in drawn])),
        "camera": floats([(c.fx, c.fy, c.cx, c.cy) for c in cameras]),
        "pose": floats([scene.T_view_ctr.matrix for _, scene, _, _ in drawn]),
        "object": torch.tensor([k for k, *_ in drawn]),
        "observed": torch.from_numpy(np.stack([s.observed for s in boxed])),
        "turn": floats([s.R_crop_view for s in boxed]),
        "focal": floats([s.camera.fx for s in boxed]),
        "mv_quat_wxyz": floats([Pose.rotation(s.delta.R).quat_wxyz for s in boxed]),
        "mv_v": floats([s.delta.v for s in boxed]),
    }

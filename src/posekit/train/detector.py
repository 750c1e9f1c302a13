"""Train Mask R-CNN on composed scenes: for given meshes, or class-agnostic for objects of any kind."""

from __future__ import annotations

import dataclasses
import time
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import IterableDataset

from posekit._version import __version__
from posekit.detect.coco import Truth, average_precision
from posekit.detect.maskrcnn import (
    NOVEL,
    MaskRCNNConfig,
    TrainedDetector,
    build,
    find,
    load_detector,
    paper_config,
    save_detector,
)
from posekit.errors import ConfigError, OutputError
from posekit.io.files import read_text, write_text_atomic
from posekit.render import Renderer
from posekit.train.config import MachineConfig, OptimiserConfig, SourceConfig, changed, write_config
from posekit.train.data.stream import Batch
from posekit.train.data.tabletop_stream import (
    AGNOSTIC_SHARE,
    LabelledImage,
    TabletopStream,
    TabletopStreamConfig,
    labelled_scenes,
    photographed,
)
from posekit.train.loop import Show, Trainer, make_fabric
from posekit.train.pose import CONFIG, claim, is_first, sources_of
from posekit.train.sources import Sources

HELD_BACK = 1_000_003  # the seed of the validation's scenes, apart from all that trainings use


@dataclass(frozen=True)
class DetectorConfig:
    """The training of a detector."""

    recipe: str = "detector"
    agnostic: bool = False  # detect objects of any kind, procedural ones beside the given meshes
    epochs: int = 10  # of ``epoch`` scenes each, where above 0; they give the steps
    epoch: int = 2000
    steps: int = 5000
    minutes: float = 0.0
    seed: int = 1
    validate: int = 500
    export_seconds: float = 0.0
    save: int = 250
    log: int = 20
    keep: int = 2
    scenes: int = 24  # of the validation. The rest is as `TrainConfig` has it.
    overfit: bool = False
    profile: bool = False
    optimiser: OptimiserConfig = OptimiserConfig("sgd", 5e-3, warmup=200, floor=0.02, decay=5e-4, clip=10.0, ema=0.995)
    machine: MachineConfig = MachineConfig()
    sources: SourceConfig = SourceConfig()
    stream: TabletopStreamConfig = TabletopStreamConfig()
    network: MaskRCNNConfig = MaskRCNNConfig()

    def __post_init__(self) -> None:
        if self.recipe != "detector":
            raise ConfigError(f"this configuration is of recipe {self.recipe!r}: train it with posekit train pose.")
        if min(self.steps, self.validate, self.save, self.log, self.keep, self.epoch, self.scenes) < 1:
            raise ConfigError("steps, validate, save, log, keep, epoch and scenes are at least 1.")
        if self.minutes < 0 or self.epochs < 0:
            raise ConfigError("minutes and epochs are not negative.")

    @property
    def world(self) -> int:
        """Processes in all."""
        return self.machine.devices * self.machine.nodes


def default_config(backbone: str = "lite0") -> DetectorConfig:
    """The light detector at 320x240, or the paper's ResNet-50 at 640x480; both by SGD, rate 0.005, 10 epochs."""
    config = DetectorConfig()
    if backbone == "lite0":
        return config
    network = paper_config(NOVEL)
    scenes = dataclasses.replace(config.stream.scenes, size=network.size)
    return dataclasses.replace(config, network=network, stream=dataclasses.replace(config.stream, scenes=scenes))


def read_config(path: Path) -> DetectorConfig:
    """A TOML file; what it does not name stays as `default_config` has it. Raises ConfigError."""
    try:
        values = tomllib.loads(read_text(path))
    except FileNotFoundError as error:
        raise ConfigError(f"there is no configuration {path}.") from error
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is no readable TOML file: {error}") from error
    network = values.get("network", {})
    backbone = network.get("backbone", "lite0") if isinstance(network, Mapping) else "lite0"
    return changed(default_config(str(backbone)), values, str(path))


def train_detector(
    config: DetectorConfig, out: Path, show: Show | None = None, force: bool = False
) -> list[dict[str, str]]:
    """Train anew into the folder ``out``; returns the validations' rows in the first process, nothing in the others.

    Raises OutputError where the folder holds files and ``force`` is not given, ConfigError, MeshError, WeightsError,
    and what `Trainer.run` raises.
    """
    if is_first():
        claim(out, force)
    return _train(config, out, show)


def resume_detector(out: Path, show: Show | None = None) -> list[dict[str, str]]:
    """Go on with the training in a folder, by the configuration that it holds. Raises as `train_detector`."""
    if not (out / CONFIG).is_file():
        raise ConfigError(f"{out} holds no training to resume: it has no {CONFIG}. Start one without --resume.")
    return _train(read_config(out / CONFIG), out, show)


def _train(config: DetectorConfig, out: Path, show: Show | None) -> list[dict[str, str]]:
    began = time.monotonic()
    fabric = make_fabric(config)
    sources = sources_of(config.sources, show)
    if not config.agnostic and not sources.models:
        raise ConfigError("a detector is trained for meshes: pass --models MESH ..., or --agnostic for any object.")
    if config.agnostic and sources.distractors:
        raise ConfigError("an agnostic detector finds objects of any kind: pass --meshes instead of --distractors.")
    torch.manual_seed(config.seed)  # the same new networks in every process
    config = dataclasses.replace(config, network=dataclasses.replace(config.network, classes=_classes(config, sources)))
    task = DetectorTask(config, sources)
    if fabric.global_rank == 0:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"the folder {out} cannot be made: {error.strerror}.") from error
        write_text_atomic(out / CONFIG, write_config(config))
    if config.epochs:
        steps = max(1, config.epochs * config.epoch // (config.stream.batch * fabric.world_size))
        config = dataclasses.replace(config, steps=steps)
    return Trainer(config, task, fabric, out, show).run(began)


def _classes(config: DetectorConfig, sources: Sources) -> tuple[str, ...]:
    if config.agnostic:
        return NOVEL
    names = tuple(m.name for m in sources.models)
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise ConfigError(f"two meshes are called {', '.join(twice)}: a detector tells them apart by name. Rename one.")
    return names


class DetectorModule(nn.Module):
    """A batch in, the loss out."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.nets = network

    def forward(self, batch: Batch, seed: int) -> tuple[Tensor, dict[str, float]]:
        """Mask R-CNN's five losses. seed: the samples of anchors and regions are drawn by it."""
        torch.manual_seed(seed)
        images = [image.permute(2, 0, 1).float() / 255 for image in batch["image"]]
        targets = [target(labels, classes) for labels, classes in zip(batch["labels"], batch["classes"], strict=True)]
        losses: dict[str, Tensor] = self.nets(images, targets)
        parts = {name.removeprefix("loss_"): float(value.detach()) for name, value in losses.items()}
        return torch.stack([value.float() for value in losses.values()]).sum(), parts


def target(labels: Tensor, classes: Tensor) -> dict[str, Tensor]:
    """torchvision's target from labels (H, W) and the instances' classes (N,), of those that are to be found."""
    wanted = torch.nonzero(classes >= 0)[:, 0]
    masks = labels[None] == (wanted + 1)[:, None, None].to(labels.dtype)
    boxes = [_edges(mask) for mask in masks]
    kept = [k for k, box in enumerate(boxes) if box is not None]
    found = torch.tensor([box for box in boxes if box is not None], dtype=torch.float32, device=labels.device)
    return {
        "boxes": found.reshape(-1, 4),
        "labels": classes[wanted[kept]] + 1,
        "masks": masks[kept].to(torch.uint8),
    }


def _edges(mask: Tensor) -> tuple[int, int, int, int] | None:
    rows, columns = torch.nonzero(mask.any(1))[:, 0], torch.nonzero(mask.any(0))[:, 0]
    if not len(rows):
        return None
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


class DetectorTask:
    """Mask R-CNN as the loop trains it."""

    def __init__(self, config: DetectorConfig, sources: Sources) -> None:
        self.config, self.sources = config, sources
        self.nets: nn.Module = make_network(config)
        self.module: nn.Module = DetectorModule(self.nets)

    def stream(self, start: int, rank: int) -> IterableDataset[Batch]:
        """Process ``rank``'s batches from number ``start`` on."""
        return TabletopStream(self.config.stream, self.config.seed, self.sources.models, agnostic=self.config.agnostic,
                              photos=self.sources.photos, distractors=self.sources.distractors, start=start,
                              rank=rank)  # fmt: skip

    measured = 0

    def prepare(self, batches: Sequence[Batch]) -> None:
        """Nothing has to be measured before."""

    def validate(self, nets: nn.Module) -> dict[str, float]:
        """COCO's average precision on held-back scenes, boxes and masks; the score is what masks lack to AP50 = 1."""
        nets.eval()
        detector = TrainedDetector(self.config.network, nets)
        truths = [truth(scene) for scene in self.held_back]
        found = [find(detector, scene.image, size=self.config.network.size) for scene in self.held_back]
        measured = average_precision(truths, found)
        return {"score": 1.0 - measured["mask_ap50"], **measured}

    def export(self, nets: nn.Module, out: Path, about: Mapping[str, Any]) -> None:
        """Write ``out/detector.safetensors`` and ``.toml``; about: what the file says of the training."""
        own = self.sources.about(AGNOSTIC_SHARE if self.config.agnostic else 1.0)
        about = {**about, "version": __version__, "trained_on": f"composed scenes: {own}"}
        save_detector(out / "detector", self.config.network, nets, about)

    @cached_property
    def held_back(self) -> list[LabelledImage]:
        """Composed scenes that are the same in every training of this seed, and never trained on."""
        rng = np.random.default_rng([HELD_BACK, self.config.seed])
        stream, renderer = self.config.stream, Renderer()
        scenes: list[LabelledImage] = []
        while len(scenes) < self.config.scenes:
            count = min(stream.per_block, self.config.scenes - len(scenes))
            scenes += labelled_scenes(renderer, self.sources.models, self.config.agnostic, count, stream, rng,
                                      self.sources.photos, self.sources.distractors)  # fmt: skip
        return [photographed(scene, stream.augment, rng) for scene in scenes]


def truth(scene: LabelledImage) -> Truth:
    """The instances that are to be found."""
    wanted: Sequence[int] = [k for k, c in enumerate(scene.classes) if c >= 0]
    return Truth(
        labels=np.array([scene.classes[k] for k in wanted], np.int64), masks=[scene.labels == k + 1 for k in wanted]
    )


def make_network(config: DetectorConfig) -> nn.Module:
    """From ImageNet's weights, or from a detector's (``sources.init``): with other classes than it had, all but the
    last layers are taken over. Raises WeightsError, ConfigError."""
    init = config.sources.init
    if not init:
        fresh: nn.Module = build(config.network, imagenet=True)
        return fresh
    found = load_detector(Path(init))
    shape = {"classes": NOVEL, "size": (1, 1), "use_size": (1, 1)}  # may differ
    if dataclasses.replace(found.config, **shape) != dataclasses.replace(config.network, **shape):  # type: ignore[arg-type]
        raise ConfigError(f"the detector {init} is of another shape ({found.config}) than [network] asks for.")
    network: nn.Module = build(config.network)
    own = network.state_dict()
    network.load_state_dict(
        {k: v if v.shape == own[k].shape else own[k] for k, v in found.network.state_dict().items()}
    )
    return network

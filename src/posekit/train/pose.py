"""Train the pose networks: from a configuration to a folder that ``estimate --weights`` takes."""

from __future__ import annotations

import dataclasses
import logging
import math
import os
import time
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from posekit._version import __version__
from posekit.errors import ConfigError, OutputError, WeightsError
from posekit.io.files import write_text_atomic
from posekit.nets.config import LiteConfig
from posekit.nets.lite import LiteSVNet
from posekit.nets.mvnet import MatchingMVNet
from posekit.nets.weights import Networks, build, load_networks, save_networks
from posekit.render import Renderer
from posekit.synth.procedural import random_object
from posekit.train.calibrate import SEED, calibrate
from posekit.train.config import SourceConfig, TrainConfig, read_config, write_config
from posekit.train.data.crop_stream import Catalogue
from posekit.train.lite import LiteTask
from posekit.train.loop import Progress, Show, Task, Trainer, keep_memory, make_fabric
from posekit.train.measure import CaseSource, rendered_cases
from posekit.train.paper import PaperTask
from posekit.train.sources import Sources, read_sources

log = logging.getLogger("posekit")

CONFIG = "config.toml"
# Of the minutes of a training: at most so much is left for the calibration; a rendering takes so much longer there than
# in a validation (five refinements instead of four, and it is drawn first); on fewer renderings it learns nothing.
CALIBRATION_SHARE, CALIBRATION_PACE, FEWEST_CALIBRATED = 0.25, 1.5, 60
PROCEDURAL = 64  # objects of the paper recipe where no mesh is given


def train_pose(config: TrainConfig, out: Path, show: Show | None = None, force: bool = False) -> list[dict[str, str]]:
    """Train anew into the folder ``out``; returns the validations' rows in the first process, nothing in the others.

    Raises OutputError where the folder holds files and ``force`` is not given, ConfigError, MeshError, WeightsError,
    and what `Trainer.run` raises.
    """
    if is_first():
        claim(out, force)
    return _train(config, out, show)


def resume_pose(out: Path, show: Show | None = None) -> list[dict[str, str]]:
    """Go on with the training in a folder, by the configuration that it holds. Raises as `train_pose`."""
    if not (out / CONFIG).is_file():
        raise ConfigError(f"{out} holds no training to resume: it has no {CONFIG}. Start one without --resume.")
    return _train(read_config(out / CONFIG), out, show)


def _train(config: TrainConfig, out: Path, show: Show | None) -> list[dict[str, str]]:
    began = time.monotonic()
    keep_memory()
    fabric = make_fabric(config)
    sources = sources_of(config.sources, show)
    torch.manual_seed(config.seed)  # the same new networks in every process
    task = make_task(config, sources)
    if fabric.global_rank == 0:
        _make(out)
        write_text_atomic(out / CONFIG, write_config(config))
    trainer = Trainer(_scheduled(config, task, fabric.world_size), task, fabric, out, show)
    rows = trainer.run(began, lambda validation: _calibration_cases(config, validation)[1])
    count = config.calibrate
    if config.minutes > 0:
        left = 60 * config.minutes - trainer.seconds
        count = min(count, _calibration_cases(config, trainer.took["validation"], left)[0])
    if rows and config.calibrate:
        if count < config.calibrate:
            log.info(
                "the predicted angle is %scalibrated (%d of %d renderings): the %g minutes allow no more. To do it on "
                "all: posekit train angle --weights %s.",
                "" if count else "not ", count, config.calibrate, config.minutes, out,
            )  # fmt: skip
        if count:
            _calibrate(dataclasses.replace(config, calibrate=count), sources, config.recipe, out, out, show)
    return rows


def sources_of(config: SourceConfig, show: Show | None) -> Sources:
    """What is trained on, which is told while it is read. Raises MeshError, ConfigError."""
    if show is not None and is_first():
        show(Progress(0, 0.0, 0.0, {}, "preparing meshes"))
    return read_sources(config)


def _calibration_cases(config: TrainConfig, validation: float, left: float | None = None) -> tuple[int, float]:
    """On how many renderings the angle is calibrated within a training's minutes, and the seconds that this takes: all,
    or as many as fit into a part of them, or none where that is too few to learn from. validation: its seconds. left:
    seconds that there are; by default that part."""
    left = CALIBRATION_SHARE * 60 * config.minutes if left is None else left
    each = CALIBRATION_PACE * validation / max(1, config.cases)
    count = config.calibrate if each * config.calibrate <= left else int(left / each)
    count = 0 if count < min(FEWEST_CALIBRATED, config.calibrate) else count
    return count, each * count


def calibrate_angle(config: TrainConfig, weights: Path | None, out: Path, show: Show | None = None) -> None:
    """Fit the angle head of weights (None = the shipped ones) for ``config.sources``, and write them into ``out``.

    Raises OutputError where ``out`` holds files, WeightsError, MeshError, TrainingError.
    """
    claim(out, force=False)
    _make(out)
    _calibrate(config, read_sources(config.sources), config.recipe, weights, out, show)


def _calibrate(
    config: TrainConfig, sources: Sources, preset: str, weights: Path | None, out: Path, show: Show | None
) -> None:
    """With renderings as the stream has them: of given meshes, of procedural ones, or both by the stream's share."""
    networks, renderer, stream = load_networks(preset, weights), Renderer(), config.stream
    models = sources.models or [m for data, _ in sources.bop for m in map(data.model, data.model_ids())]
    source = CaseSource(
        models,
        sources.photos,
        stream.scenes,
        stream.augment,
        stream.pairs.unlike,
        stream.pairs.deformed,
        stream.pairs.scans,
    )
    given = round(config.calibrate * (stream.share if models else 0.0))
    cases = rendered_cases(source, renderer, given, SEED) if given else []
    cases += rendered_cases(dataclasses.replace(source, models=[]), renderer, config.calibrate - given, SEED)

    def tell(done: int, count: int) -> None:
        if show is not None:
            show(Progress(done, done / count, 0.0, {}, "calibrating the angle"))

    calibrated = calibrate(networks, cases, renderer, tell)
    save_networks(out / preset, calibrated, {**networks.about, "calibrated_on": len(cases)})


def _make(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"the folder {out} cannot be made: {error.strerror}.") from error


def make_task(config: TrainConfig, sources: Sources) -> Task:
    """The recipe with its networks. Raises ConfigError, WeightsError."""
    networks, fresh = make_networks(config)
    config = fitted(config, networks.size)
    if config.recipe == "paper":
        return PaperTask(config, networks, sources, fresh, catalogue_of(config, sources))
    if sources.bop:
        raise ConfigError("--bop feeds the paper recipe; the lite recipe trains on renderings: leave --bop out.")
    return LiteTask(config, networks, sources, fresh)


def fitted(config: TrainConfig, size: tuple[int, int]) -> TrainConfig:
    """With a stream that makes crops of the networks' ``size``; what the augmentation has in pixels grows along."""
    stream = config.stream
    dilate = round(stream.augment.dilate * size[0] / stream.pairs.size[0])
    stream = dataclasses.replace(
        stream,
        pairs=dataclasses.replace(stream.pairs, size=size),
        scenes=dataclasses.replace(stream.scenes, crop=size),
        queries=dataclasses.replace(stream.queries, crop=size),
        augment=dataclasses.replace(stream.augment, dilate=dilate),
    )
    return dataclasses.replace(config, stream=stream)


def catalogue_of(config: TrainConfig, sources: Sources) -> Catalogue:
    """The paper recipe's objects: the meshes given, or as many procedural ones where there is nothing else."""
    models = sources.models
    if not models and not sources.bop:
        models = [random_object(np.random.default_rng([config.seed, k]), sources.photos) for k in range(PROCEDURAL)]
    return Catalogue(models, sources.bop, config.sources.renders, config.stream.scenes)


def _scheduled(config: TrainConfig, task: Task, world: int) -> TrainConfig:
    """With the steps that its epochs make, where it counts in epochs."""
    if not config.epochs:
        return config
    if not isinstance(task, PaperTask):
        raise ConfigError("epochs need a set of samples: the lite recipe draws without end. Give --steps or --minutes.")
    steps = math.ceil(config.epochs * task.catalogue.epoch / (config.stream.batch * world))
    return dataclasses.replace(config, steps=max(1, steps))


def make_networks(config: TrainConfig) -> tuple[Networks, frozenset[str]]:
    """New networks, or those of ``sources.init``; and the names of those whose statistics are still to be measured."""
    init, chosen = config.sources.init, config.lite if config.recipe == "lite" else config.paper
    if not init:
        networks = build(config.recipe, chosen)
        if config.sources.flownets:
            _load_flownets(networks, Path(config.sources.flownets))
        return networks, frozenset({"svnet", "mvnet"})
    networks = load_networks(config.recipe, None if init == "shipped" else Path(init))
    kept = {key: networks.about[key] for key in ("trained_on", "seen") if key in networks.about}
    networks = dataclasses.replace(networks, about={"init": networks.digest, "version": __version__, **kept})
    if networks.mvnet is not None:
        return networks, frozenset()
    if isinstance(networks.svnet, LiteSVNet):
        assert isinstance(networks.config, LiteConfig)
        return dataclasses.replace(networks, mvnet=MatchingMVNet(networks.svnet.tower, networks.config)), frozenset()
    raise WeightsError(f"the weights {init} hold no MV-Net, which the paper recipe trains too: start without --init.")


def _load_flownets(networks: Networks, path: Path) -> None:
    """Take the encoder from a FlowNetS checkpoint: safetensors, or a PyTorch file with nothing but tensors in it."""
    if isinstance(networks.svnet, LiteSVNet):
        raise ConfigError("a FlowNetS checkpoint fits the paper's encoder only: pass --recipe paper.")
    try:
        state: dict[str, Tensor] = (
            load_file(path)
            if path.suffix == ".safetensors"
            else torch.load(path, map_location="cpu", weights_only=True)
        )
    except (OSError, SafetensorError, RuntimeError, ValueError, EOFError) as error:
        raise WeightsError(f"the FlowNetS checkpoint {path} cannot be read: {error}") from error
    except Exception as error:  # pickle's errors have no common class
        raise WeightsError(f"{path} is no checkpoint of tensors alone: {error}") from error
    nested = state.get("state_dict", state)
    assert isinstance(nested, dict)
    networks.svnet.branch.encoder.load_flownets(nested)


def is_first() -> bool:
    """Whether this process was not started by another one of the same training."""
    return all(os.environ.get(name, "0") == "0" for name in ("RANK", "LOCAL_RANK", "NODE_RANK"))


def claim(out: Path, force: bool) -> None:
    """Make ``out`` ready for a new training; force: delete a former one's checkpoints and logs there. Raises
    OutputError where it is a file, or holds files and ``force`` is not given."""
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out} is a file: --out names a folder.")
    if out.is_dir() and any(out.iterdir()):
        if not force:
            raise OutputError(
                f"the folder {out} holds files: pass --resume to go on with a training there, --force to begin anew "
                "in it, or another --out."
            )
        for old in [*out.glob("checkpoints/*"), out / "train.csv", out / "validation.csv"]:
            old.unlink(missing_ok=True)

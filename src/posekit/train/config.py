"""What a training does, as one frozen dataclass and a TOML file of the same shape."""

from __future__ import annotations

import dataclasses
import difflib
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import tomli_w

from posekit.errors import ConfigError
from posekit.io.files import read_text
from posekit.nets.config import LiteConfig, PaperConfig
from posekit.nets.losses import DenseLossConfig
from posekit.train.data.stream import StreamConfig

RECIPES = ("lite", "paper")
OPTIMISERS = ("adamw", "sgd")
PRECISIONS = ("auto", "32-true", "bf16-mixed", "16-mixed")
C = TypeVar("C")


def _one_of(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ConfigError(f"{name} is one of {', '.join(choices)}, not {value!r}.")


def _sensible(values: Mapping[str, Any], table: str) -> None:
    """Raises ConfigError for a number that is not finite or negative: nothing in a training is."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            _sensible(value, f"{table}{key}.")
            continue
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, int | float) and not 0 <= number < math.inf:
                raise ConfigError(f"{table}{key} is {value}: numbers are finite and not negative.")


@dataclass(frozen=True)
class OptimiserConfig:
    """The optimiser and its schedule."""

    kind: str = "adamw"
    rate: float = 5e-4  # the highest learning rate
    warmup: int = 300  # steps until it is reached
    floor: float = 0.02  # its share at the end of the cosine
    decay: float = 1e-4  # weight decay
    momentum: float = 0.9
    clip: float = 1.0  # largest norm of the gradient
    ema: float = 0.998  # decay of the averaged weights per step

    def __post_init__(self) -> None:
        _one_of("optimiser.kind", self.kind, OPTIMISERS)
        if self.rate <= 0 or self.clip <= 0 or not 0 <= self.ema < 1:
            raise ConfigError(
                f"optimiser: rate {self.rate} and clip {self.clip} are positive, ema {self.ema} is in [0, 1)."
            )


@dataclass(frozen=True)
class MachineConfig:
    """What a training runs on."""

    accelerator: str = "auto"  # Lightning Fabric's name
    # devices, nodes: processes per machine and machines
    devices: int = 1
    nodes: int = 1
    precision: str = "auto"  # "auto" is bfloat16 where the processor multiplies in it, else float32
    threads: int = 0  # of torch in each process; 0 = its own choice
    workers: int = 1  # processes that render for each process

    def __post_init__(self) -> None:
        _one_of("machine.precision", self.precision, PRECISIONS)
        if self.devices < 1 or self.nodes < 1 or self.workers < 0 or self.threads < 0:
            raise ConfigError("machine: devices and nodes are at least 1, workers and threads at least 0.")


@dataclass(frozen=True)
class SourceConfig:
    """What is trained on."""

    models: tuple[str, ...] = ()  # mesh files
    units: str = "auto"
    meshes: tuple[str, ...] = ()  # folders of mesh files
    # folders in BOP layout with a weight each, as ``FOLDER``, ``FOLDER:SPLIT`` or ``FOLDER:SPLIT=WEIGHT`` (paper
    # recipe)
    bop: tuple[str, ...] = ()
    renders: float = 1.0  # weight of renderings beside them
    # folders of further meshes for a detector's scenes, which are not to be detected
    distractors: tuple[str, ...] = ()
    backgrounds: str = ""  # a folder of photographs
    init: str = ""  # weights to start from; empty = none
    flownets: str = ""  # a FlowNetS checkpoint for the paper's encoder
    validate_on: str = ""  # a folder in BOP layout


@dataclass(frozen=True)
class TrainConfig:
    """A training."""

    recipe: str = "lite"
    steps: int = 7000  # optimiser steps of the schedule
    minutes: float = 0.0  # of wall clock for all that is done, where above 0; whichever ends first
    epochs: int = 0  # where above 0, the steps follow from the sources (paper recipe)
    seed: int = 1
    # validate, save, log: every so many steps
    validate: int = 500
    export_seconds: float = 60.0  # weights and a checkpoint are written every so many seconds too, where above 0
    save: int = 250
    log: int = 50
    keep: int = 3  # checkpoints kept beside the best
    cases: int = 48  # held-back renderings that the loop is measured on
    calibrate: int = 240  # renderings that the angle head is fitted on at the end; 0 = not at all
    overfit: bool = False  # train on the first batch again and again
    profile: bool = False
    optimiser: OptimiserConfig = OptimiserConfig()
    machine: MachineConfig = MachineConfig()
    sources: SourceConfig = SourceConfig()
    stream: StreamConfig = StreamConfig(shard=32, mvnet=8)
    lite: LiteConfig = LiteConfig()
    loss: DenseLossConfig = DenseLossConfig()
    paper: PaperConfig = field(default_factory=PaperConfig)

    def __post_init__(self) -> None:
        _one_of("recipe", self.recipe, RECIPES)
        if min(self.steps, self.validate, self.save, self.log, self.keep) < 1:
            raise ConfigError("steps, validate, save, log and keep are at least 1.")
        if min(self.minutes, self.cases, self.epochs, self.calibrate, self.export_seconds) < 0:
            raise ConfigError("minutes, epochs, cases, calibrate and export_seconds are not negative.")
        _sensible(dataclasses.asdict(self), "")

    @property
    def world(self) -> int:
        """Processes in all."""
        return self.machine.devices * self.machine.nodes


def default_config(recipe: str) -> TrainConfig:
    """A recipe as it is meant. The paper's: SGD, rate 0.001, 48 epochs, 640x480, no warm-up and no cosine."""
    if recipe != "paper":
        return TrainConfig(recipe)
    optimiser = OptimiserConfig("sgd", 1e-3, warmup=1, floor=1.0, decay=0.0, clip=10.0, ema=0.998)
    machine = MachineConfig(precision="32-true")
    stream = StreamConfig(batch=8, pool=256)
    return TrainConfig(recipe, epochs=48, optimiser=optimiser, machine=machine, stream=stream)


def read_config(path: Path) -> TrainConfig:
    """A TOML file; what it does not name stays as `default_config` has it. Raises ConfigError."""
    try:
        values = tomllib.loads(read_text(path))
    except FileNotFoundError as error:
        raise ConfigError(f"there is no configuration {path}.") from error
    except (OSError, ValueError, RecursionError) as error:  # also thousands of digits, or of brackets
        raise ConfigError(f"{path} is no readable TOML file: {error}") from error
    return changed(default_config(str(values.get("recipe", "lite"))), values, str(path))


def write_config(config: Any) -> str:
    """TOML text that `read_config` reads back."""
    return tomli_w.dumps(_plain(dataclasses.asdict(config)))


def changed(config: C, values: Mapping[str, Any], where: str) -> C:
    """``config`` (a dataclass) with the values of a table of the same shape. where: for errors.

    Raises ConfigError for an unknown key, which names the nearest one, and for a value of another kind.
    """
    known = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}  # type: ignore[arg-type]
    found: dict[str, Any] = {}
    for key, value in values.items():
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1, cutoff=0.0)
            raise ConfigError(f"{where}: unknown key {key!r}; did you mean {near[0]!r}? There are {', '.join(known)}.")
        present = known[key]
        if dataclasses.is_dataclass(present) and not isinstance(present, type):
            if not isinstance(value, Mapping):
                raise ConfigError(f"{where}: {key} is a table, not {value!r}.")
            found[key] = changed(present, value, f"{where}: [{key}]")
        else:
            found[key] = _like(present, value, f"{where}: {key}")
    return dataclasses.replace(config, **found)  # type: ignore[type-var]


def _like(present: Any, value: Any, where: str) -> Any:
    """``value`` as the kind that ``present`` is."""
    if isinstance(present, tuple):
        if not isinstance(value, list | tuple) or (present and len(value) != len(present)):
            raise ConfigError(f"{where} is a list{f' of {len(present)}' if present else ''}, not {value!r}.")
        return tuple(_like(present[0] if present else "", v, where) for v in value)
    if isinstance(present, float) and isinstance(value, int) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError as error:
            raise ConfigError(f"{where} is a float, not a number of {len(str(value))} digits.") from error
    if type(value) is not type(present):
        raise ConfigError(f"{where} is a {type(present).__name__}, not {value!r}.")
    return value


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, tuple | list) else value

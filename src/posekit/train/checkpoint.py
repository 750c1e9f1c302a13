"""Checkpoints: ``STEP.safetensors`` (tensors) beside ``STEP.toml`` (numbers). No pickle.

The TOML file is written last and names the other's hash: a checkpoint without it does not count, so that a kill at any
moment leaves the one before in force.
"""

from __future__ import annotations

import hashlib
import math
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomli_w
import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from posekit.errors import OutputError, WeightsError
from posekit.io.files import write_bytes_atomic, write_text_atomic


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """step: optimiser steps done, which is also the data's position. seconds: of training. score: the validation's
    at this step, lower is better; NaN where there was none. means: running means of the loss and its parts."""

    step: int
    seconds: float
    score: float
    means: Mapping[str, float]
    tensors: Mapping[str, Tensor]


class Checkpoints:
    """The checkpoints of one training: the last ``keep`` and the best."""

    def __init__(self, folder: Path, keep: int = 3) -> None:
        self.folder, self.keep = folder, keep

    def save(self, checkpoint: Checkpoint) -> None:
        """Raises OutputError where it cannot be written; those before stay as they are."""
        stem = self.folder / f"{checkpoint.step:08d}"
        state = {k: v.detach().to("cpu", memory_format=torch.contiguous_format, copy=True)
                 for k, v in checkpoint.tensors.items()}  # fmt: skip
        data = save(state)
        digest = hashlib.sha256(data).hexdigest()[:16]
        head = {"step": checkpoint.step, "seconds": checkpoint.seconds, "score": checkpoint.score, "sha256_16": digest,
                "means": dict(checkpoint.means)}  # fmt: skip
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            stem.with_suffix(".toml").unlink(missing_ok=True)
            write_bytes_atomic(stem.with_suffix(".safetensors"), data)
            write_text_atomic(stem.with_suffix(".toml"), tomli_w.dumps(head))
        except (OutputError, OSError) as error:
            last = self.last()
            held = (
                f"the last good checkpoint, of step {last}, is intact" if last is not None else "there is none before"
            )
            raise OutputError(
                f"the checkpoint of step {checkpoint.step} could not be written ({error}); {held}. Free some space, "
                f"{len(data) / 1e6:.0f} MB are needed for each checkpoint, and go on with --resume."
            ) from error
        self._prune()

    def last(self) -> int | None:
        """The newest step that there is a whole checkpoint of."""
        return max(self._heads(), default=None)

    def best(self) -> int | None:
        """The step with the lowest score."""
        scored = {step: head["score"] for step, head in self._heads().items() if not math.isnan(head["score"])}
        return min(scored, key=lambda step: scored[step], default=None)

    def load(self, step: int) -> Checkpoint:
        """Raises WeightsError where its files are missing, damaged or of two trainings."""
        file = self.folder / f"{step:08d}.safetensors"
        head = self._heads().get(step)
        if head is None:
            raise WeightsError(f"there is no checkpoint of step {step} in {self.folder}.")
        try:
            data = file.read_bytes()
            tensors = load(data)
        except (OSError, SafetensorError) as error:
            raise WeightsError(
                f"the checkpoint {file} cannot be read: {error}. Delete it to use the one before."
            ) from error
        if hashlib.sha256(data).hexdigest()[:16] != head["sha256_16"]:
            raise WeightsError(f"the checkpoint {file} is damaged: its hash is not the one in its .toml. Delete both.")
        return Checkpoint(step, float(head["seconds"]), float(head["score"]), head["means"], tensors)

    def _heads(self) -> dict[int, dict[str, Any]]:
        heads = {}
        for path in self.folder.glob("*.toml"):
            with suppress(tomllib.TOMLDecodeError, OSError, KeyError):
                head = tomllib.loads(path.read_text(encoding="utf-8"))
                heads[int(head["step"])] = head
        return {step: heads[step] for step in sorted(heads) if (self.folder / f"{step:08d}.safetensors").is_file()}

    def _prune(self) -> None:
        steps = list(self._heads())
        kept = {f"{step:08d}" for step in {*steps[-self.keep :], self.best()} if step is not None}
        for path in self.folder.iterdir():
            if path.suffix == ".part" or (path.suffix in (".toml", ".safetensors") and path.stem not in kept):
                path.unlink(missing_ok=True)


def optimiser_tensors(optimiser: torch.optim.Optimizer) -> dict[str, Tensor]:
    """An optimiser's state as ``INDEX.NAME`` -> tensor."""
    state = optimiser.state_dict()["state"]
    return {f"{index}.{name}": value for index, values in state.items()
            for name, value in values.items() if isinstance(value, Tensor)}  # fmt: skip


def restore_optimiser(optimiser: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """The inverse of `optimiser_tensors`."""
    whole = optimiser.state_dict()
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        index, name = key.split(".", 1)
        if value.ndim:  # a fused optimiser needs the moments in their parameter's memory layout
            value = torch.empty_like(parameters[int(index)]).copy_(value)
        state.setdefault(int(index), {})[name] = value
    whole["state"] = state
    optimiser.load_state_dict(whole)


def part(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors below a prefix, without it."""
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}

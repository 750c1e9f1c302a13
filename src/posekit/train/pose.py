"""Train SV-Net lite on rendered pairs: ``python -m posekit.train.pose --out runs/svnet``. Layer 5.

A process trains while its worker renders; under torchrun several do, each with its own batches, gradients averaged
over all. A checkpoint every few minutes; the same command resumes from it.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import math
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.distributed as dist
from safetensors.torch import load_file, save
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel
from torch.utils.data import DataLoader

from posekit.data.stream import PairStream, StreamConfig, load_photos
from posekit.files import write_bytes_atomic
from posekit.nets.heads import PoseHeads
from posekit.nets.inputs import images_to_tensor
from posekit.nets.lite import LiteSVNet
from posekit.nets.losses import DenseLossConfig, Target, dense_loss
from posekit.nets.weights import build, save_networks

HELD_BACK = 12  # batches of the validation


@dataclass(frozen=True)
class PoseTrainConfig:
    """steps: optimiser steps of the whole schedule. ema: decay per step. validate, save: every so many steps."""

    steps: int = 7000
    rate: float = 5e-4
    warmup: int = 300
    decay: float = 1e-4
    clip: float = 1.0
    ema: float = 0.998
    validate: int = 500
    save: int = 250
    seed: int = 1
    threads: int = 2
    workers: int = 1
    loss: DenseLossConfig = DenseLossConfig()
    stream: StreamConfig = StreamConfig()


def rate_at(step: int, config: PoseTrainConfig) -> float:
    """Linear warm-up, then a cosine down to 2 % of the peak."""
    if step < config.warmup:
        return config.rate * (step + 1) / config.warmup
    done = min(1.0, (step - config.warmup) / max(1, config.steps - config.warmup))
    return config.rate * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * done)))


def to_target(batch: dict[str, Tensor]) -> Target:
    return Target(batch["flow"], batch["valid"], batch["visible"], batch["quat_wxyz"], batch["v"], batch["angle"],
                  batch["lost"])  # fmt: skip


def batches(config: PoseTrainConfig, seed: int, photos: Path | None, workers: int) -> Iterator[dict[str, Tensor]]:
    stream = PairStream(config.stream, seed, load_photos(photos))
    context = "fork" if workers else None
    return iter(DataLoader(stream, batch_size=None, num_workers=workers, multiprocessing_context=context,
                           prefetch_factor=6 if workers else None))  # fmt: skip


def measure_statistics(heads: PoseHeads, stream: Iterator[dict[str, Tensor]], count: int = 20) -> None:
    """The paper's zero mean and unit variance, over ``count`` batches."""
    found = [next(stream) for _ in range(count)]
    quat = torch.cat([b["quat_wxyz"][~b["lost"]] for b in found])
    v = torch.cat([b["v"][~b["lost"]] for b in found])
    heads.set_statistics(quat, v)


@torch.no_grad()
def validate(net: LiteSVNet, held_back: list[dict[str, Tensor]], config: DenseLossConfig) -> dict[str, float]:
    """Mean losses and errors over fixed batches."""
    net.eval()
    sums: dict[str, float] = {}
    for batch in held_back:
        with torch.autocast("cpu", dtype=torch.bfloat16):
            output = net.predict(images_to_tensor(batch["observed"]), images_to_tensor(batch["rendered"]))
        loss, parts = dense_loss(output, net.heads, to_target(batch), config)
        for name, value in {"loss": float(loss), **parts}.items():
            sums[name] = sums.get(name, 0.0) + value / len(held_back)
    return sums


def average_gradients(parameters: list[nn.Parameter]) -> None:
    """Average the gradients over all processes, in one message; nothing where there is only one."""
    if not dist.is_initialized():
        return
    gradients = [p.grad for p in parameters if p.grad is not None]
    flat = torch.cat([g.flatten() for g in gradients])
    dist.all_reduce(flat)
    flat /= dist.get_world_size()
    for gradient, part in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
        gradient.copy_(part.view(gradient.shape))


class Trainer:
    """The network, its moving average, the optimiser, and their checkpoint."""

    def __init__(self, config: PoseTrainConfig, run: Path) -> None:
        self.config, self.run = config, run
        self.networks = build("lite")
        assert isinstance(self.networks.svnet, LiteSVNet)
        self.net = self.networks.svnet.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.average = AveragedModel(self.net, multi_avg_fn=self._average, use_buffers=True)
        weights = [p for p in self.net.parameters() if p.ndim > 1]
        others = [p for p in self.net.parameters() if p.ndim <= 1]
        groups = [{"params": weights, "weight_decay": config.decay}, {"params": others, "weight_decay": 0.0}]
        self.optimiser = torch.optim.AdamW(groups, lr=config.rate, fused=True)
        self.step = 0
        self.seconds = 0.0

    @torch.no_grad()
    def _average(self, averages: Sequence[Tensor], currents: Sequence[Tensor], count: Tensor | int) -> None:
        """An exponential moving average that forgets its first values faster: the decay grows to ``ema``."""
        decay = min(self.config.ema, (1.0 + float(count)) / (10.0 + float(count)))
        for average, current in zip(averages, currents, strict=True):
            if average.is_floating_point():
                average.lerp_(current.to(average.dtype), 1.0 - decay)
            else:
                average.copy_(current)

    @property
    def averaged(self) -> LiteSVNet:
        module = self.average.module
        assert isinstance(module, LiteSVNet)
        return module

    @property
    def checkpoint(self) -> Path:
        return self.run / "checkpoint.safetensors"

    def save(self) -> None:
        state: dict[str, Tensor] = {"step": torch.tensor(self.step), "seconds": torch.tensor(self.seconds)}
        state |= {f"net.{k}": v.contiguous() for k, v in self.net.state_dict().items()}
        state |= {f"average.{k}": v.contiguous() for k, v in self.average.state_dict().items()}
        for index, values in self.optimiser.state_dict()["state"].items():
            state |= {f"optimiser.{index}.{k}": v.contiguous() for k, v in values.items()}
        write_bytes_atomic(self.checkpoint, save({k: v.clone() for k, v in state.items()}))

    def load(self) -> bool:
        if not self.checkpoint.is_file():
            return False
        state = load_file(self.checkpoint)
        self.step, self.seconds = int(state["step"]), float(state["seconds"])
        self.net.load_state_dict(_part(state, "net."))
        self.average.load_state_dict(_part(state, "average."))
        whole = self.optimiser.state_dict()
        parameters = [p for group in self.optimiser.param_groups for p in group["params"]]
        moments: dict[int, dict[str, Tensor]] = {}
        for key, value in _part(state, "optimiser.").items():
            index, name = key.split(".", 1)
            if name != "step":  # the fused optimiser needs the moments in their parameter's memory layout
                value = torch.empty_like(parameters[int(index)]).copy_(value)
            moments.setdefault(int(index), {})[name] = value
        whole["state"] = moments
        self.optimiser.load_state_dict(whole)
        return True

    def train_step(self, batch: dict[str, Tensor]) -> dict[str, float]:
        for group in self.optimiser.param_groups:
            group["lr"] = rate_at(self.step, self.config)
        self.net.train()
        with torch.autocast("cpu", dtype=torch.bfloat16):
            output = self.net.predict(images_to_tensor(batch["observed"]), images_to_tensor(batch["rendered"]))
        loss, parts = dense_loss(output, self.net.heads, to_target(batch), self.config.loss)
        if not torch.isfinite(loss):
            raise FloatingPointError(
                f"the loss became {float(loss.detach())} at step {self.step}; {self.checkpoint} is intact"
            )
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        average_gradients(list(self.net.parameters()))
        nn.utils.clip_grad_norm_(self.net.parameters(), self.config.clip)
        self.optimiser.step()
        self.average.update_parameters(self.net)
        self.step += 1
        return {"loss": float(loss.detach()), **parts}

    def export(self, about: dict[str, object]) -> str:
        """The averaged weights as fp16 safetensors in the run's folder; returns their hash."""
        networks = dataclasses.replace(self.networks, svnet=self.averaged, mvnet=None)
        return save_networks(self.run / "lite", networks, about)  # this recipe trains no MV-Net


def _part(state: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}


def train(config: PoseTrainConfig, run: Path, photos: Path | None) -> None:
    run.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(config.seed)
    torch.set_num_threads(config.threads)
    trainer = Trainer(config, run)
    resumed = trainer.load()
    rank = dist.get_rank() if dist.is_initialized() else 0
    seed = config.seed + trainer.step + 1_000_003 * rank
    stream = batches(config, seed, photos, config.workers)
    small = dataclasses.replace(config.stream, pool=256, reuse=1)
    held_back_stream = batches(dataclasses.replace(config, stream=small), 10**6, photos, config.workers)
    held_back = [next(held_back_stream) for _ in range(HELD_BACK)] if rank == 0 else []
    del held_back_stream
    if not resumed:
        measure_statistics(trainer.net.heads, stream)
    if dist.is_initialized():
        for value in trainer.net.state_dict().values():
            dist.broadcast(value, 0)
    log = run / "log.csv"
    running: dict[str, float] = {}
    started = time.monotonic() - trainer.seconds
    while trainer.step < config.steps:
        parts = trainer.train_step(next(stream))
        trainer.seconds = time.monotonic() - started
        if rank:
            continue
        running = {k: v if k not in running else 0.98 * running[k] + 0.02 * v for k, v in parts.items()}
        if trainer.step % 50 == 0:
            _log(log, {"step": trainer.step, "seconds": trainer.seconds, "set": "train", **running})
        if trainer.step % config.validate == 0 or trainer.step == config.steps:
            found = validate(trainer.averaged, held_back, config.loss)
            _log(log, {"step": trainer.step, "seconds": trainer.seconds, "set": "held-back", **found})
            about = {"trained_on": "procedural shapes", "steps": trainer.step, "hours": trainer.seconds / 3600,
                     "held_back": found}  # fmt: skip
            trainer.export(about)
        if trainer.step % config.save == 0 or trainer.step == config.steps:
            trainer.save()


def _log(path: Path, row: dict[str, object]) -> None:
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, list(row))
        if new:
            writer.writeheader()
        writer.writerow({k: f"{v:.4f}" if isinstance(v, float) else v for k, v in row.items()})
    print(" ".join(f"{k}={v:.3f}" if isinstance(v, float) else f"{k}={v}" for k, v in row.items()), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--out", type=Path, required=True, help="folder of checkpoints and logs; resumed where it exists"
    )
    parser.add_argument("--backgrounds", type=Path, help="folder of photographs for backgrounds and textures")
    parser.add_argument("--steps", type=int, default=PoseTrainConfig.steps)
    parser.add_argument("--batch", type=int, default=StreamConfig.batch)
    parser.add_argument("--rate", type=float, default=PoseTrainConfig.rate)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    args = parser.parse_args()
    stream = StreamConfig(batch=args.batch)
    if "WORLD_SIZE" in os.environ:
        dist.init_process_group("gloo")
    config = PoseTrainConfig(steps=args.steps, rate=args.rate, threads=args.threads, stream=stream)
    train(config, args.out, args.backgrounds)


if __name__ == "__main__":
    main()

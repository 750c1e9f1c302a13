"""The training loop, on Lightning Fabric: one process or many, CPU or GPU.

    with batches:  loss, backward, clip, step, average
    now and then:  log, validate, export, checkpoint

No random state outlives a step: batch k is a function of (seed, k), and torch is seeded anew for each step. A
checkpoint therefore needs the weights, their average, the optimiser's moments and the step's number, and a training
that was killed ends as one that was not.
"""

from __future__ import annotations

import ctypes
import itertools
import logging
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel
from torch.utils.data import DataLoader, IterableDataset

from posekit.errors import ConfigError, TrainingError
from posekit.io.files import write_text_atomic
from posekit.nets.precision import has_fast_bfloat16
from posekit.train.checkpoint import Checkpoint, Checkpoints, optimiser_tensors, part, restore_optimiser
from posekit.train.config import MachineConfig, OptimiserConfig
from posekit.train.log import Curves

Batch = dict[str, Tensor]
M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4  # malloc.h
PROFILED = (3, 10)  # steps that --profile leaves out, and then records
PATIENCE = 20  # steps in a row without a finite gradient that a GPU leaves out before the training ends
READ_EVERY = 0.5  # seconds between two reads of the losses: a read waits for the GPU


class Schedule(Protocol):
    """What the loop needs to know of a training's configuration; `TrainConfig` says what each means."""

    @property
    def recipe(self) -> str:
        """What is trained: the name that checkpoints carry."""

    @property
    def steps(self) -> int:
        """Steps of the whole training."""

    @property
    def minutes(self) -> float:
        """Wall-clock minutes in which all is done, from the meshes to the last export, if the steps have not ended it
        before; 0 = no limit."""

    @property
    def seed(self) -> int:
        """Of all that is drawn at random."""

    @property
    def validate(self) -> int:
        """Steps between validations."""

    @property
    def export_seconds(self) -> float:
        """Weights and a checkpoint are also written every so many seconds; 0 = not."""

    @property
    def save(self) -> int:
        """Steps between checkpoints."""

    @property
    def log(self) -> int:
        """Steps between rows of the log."""

    @property
    def keep(self) -> int:
        """Checkpoints that are kept."""

    @property
    def overfit(self) -> bool:
        """Whether every step sees the first batch."""

    @property
    def profile(self) -> bool:
        """Whether some steps are recorded by torch's profiler."""

    @property
    def optimiser(self) -> OptimiserConfig:
        """The optimiser and its rates."""

    @property
    def machine(self) -> MachineConfig:
        """What it runs on."""

    @property
    def world(self) -> int:
        """Processes in all."""


class Task(Protocol):
    """A recipe: what is trained, on what, by which loss.

    nets: the networks alone, whose weights are averaged and kept. module: has ``nets`` inside; its forward takes a
    batch and a seed for what it draws at random, and gives the loss and its parts.
    """

    @property
    def nets(self) -> nn.Module:
        """The networks alone, whose weights are averaged and kept."""

    @property
    def module(self) -> nn.Module:
        """Has ``nets`` inside; from a batch and a seed to the loss and its parts."""

    def stream(self, start: int, rank: int) -> IterableDataset[Batch]:
        """Process ``rank``'s batches from number ``start`` on."""
        ...

    @property
    def measured(self) -> int:
        """Batches that `prepare` measures."""
        ...

    def prepare(self, batches: Sequence[Batch]) -> None:
        """Measure what has to be known before the first step, on the first batches. Called by one process, for a new
        training."""
        ...

    def validate(self, nets: nn.Module) -> dict[str, float]:
        """Measures of ``nets``, with ``score``, the lower the better. Called by one process."""
        ...

    def export(self, nets: nn.Module, out: Path, about: Mapping[str, Any]) -> None:
        """Write ``nets`` into ``out`` as the estimator loads them."""
        ...


@dataclass(frozen=True)
class Progress:
    """What a progress bar may show. done: in [0, 1]. values: running means of the loss and its parts. label: what is
    being done, where it is not the training's steps."""

    step: int
    done: float
    seconds: float
    values: Mapping[str, float]
    label: str = ""


Show = Callable[[Progress], None]


def rate_at(step: int, done: float, config: OptimiserConfig) -> float:
    """Linear warm-up by steps, then a cosine by the share ``done`` of the whole training down to the floor."""
    warm = min(1.0, (step + 1) / max(1, config.warmup))
    return config.rate * warm * (config.floor + (1 - config.floor) * 0.5 * (1 + math.cos(math.pi * min(1.0, done))))


def keep_memory() -> None:
    """Have glibc keep the large blocks that a step frees: given back and fetched anew, zeroed page by page, they cost
    a third of a training's time on a CPU (docs/log.md). Elsewhere than with glibc nothing happens."""
    if "glibc" in (os.confstr("CS_GNU_LIBC_VERSION") or "" if hasattr(os, "confstr") else ""):
        libc = ctypes.CDLL(None)
        libc.mallopt(M_MMAP_MAX, 0)
        libc.mallopt(M_TRIM_THRESHOLD, 2**31 - 1)


def make_fabric(config: Schedule) -> Any:
    """Lightning Fabric for the configured machines, launched: under torchrun, Slurm and so on as these say, else it
    starts this program again for each further process. Raises ConfigError where Fabric is not installed."""
    try:
        from lightning_fabric import Fabric
        from lightning_fabric.plugins.environments.torchelastic import TorchElasticEnvironment
    except ImportError as error:
        raise ConfigError("training needs Lightning Fabric: pip install 'posekit[train]'.") from error
    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)  # it repeats the configuration in every run
    machine = config.machine
    accelerator = machine.accelerator
    if accelerator == "auto":
        accelerator = "cuda" if torch.cuda.is_available() else "cpu"
    precision = machine.precision
    if precision == "auto":
        precision = "bf16-mixed" if has_fast_bfloat16(accelerator) else "32-true"
    several = config.world > 1 or TorchElasticEnvironment.detect()
    strategy = "ddp" if several else "auto"
    try:
        fabric = Fabric(accelerator=accelerator, devices=machine.devices, num_nodes=machine.nodes, strategy=strategy,
                        precision=precision)  # type: ignore[arg-type]  # fmt: skip
        fabric.launch()
    except (RuntimeError, ValueError) as error:
        raise ConfigError(
            f"the training cannot start on {machine.devices} x {accelerator} of {machine.nodes} machine(s), "
            f"precision {precision}: {error}"
        ) from error
    if machine.threads:
        torch.set_num_threads(machine.threads)
    torch.backends.cudnn.benchmark = True  # crops of one size: the fastest convolution is sought once
    return fabric


def make_optimiser(nets: nn.Module, config: Schedule) -> torch.optim.Optimizer:
    """Weight decay on weights only, neither on biases nor on norms."""
    chosen = config.optimiser
    weights = [p for p in nets.parameters() if p.ndim > 1]
    others = [p for p in nets.parameters() if p.ndim <= 1]
    groups = [{"params": weights, "weight_decay": chosen.decay}, {"params": others, "weight_decay": 0.0}]
    if chosen.kind == "sgd":
        return torch.optim.SGD(groups, lr=chosen.rate, momentum=chosen.momentum)
    return torch.optim.AdamW(groups, lr=chosen.rate, fused=config.machine.precision != "16-mixed")


class Means:
    """Running means of the loss and its parts, kept on the training's device so that a step need not wait for it.

    A step with a value that is not finite leaves them alone; ``failed`` counts such steps in a row.
    """

    def __init__(self, values: Mapping[str, float] = MappingProxyType({})) -> None:
        self.names = tuple(values)
        self.mean: Tensor | None = torch.tensor(list(values.values())) if values else None
        self.failed: Tensor | None = None

    def update(self, values: Mapping[str, Tensor]) -> None:
        """values: scalars, of the same names in every step."""
        names, new = tuple(values), torch.stack([v.detach().float() for v in values.values()])
        finite = torch.isfinite(new).all()
        if self.mean is None or names != self.names:
            self.names, self.mean = names, new
        old = self.mean.to(new.device)
        self.mean = torch.where(finite, 0.98 * old + 0.02 * new, old)
        failed = torch.zeros((), device=new.device) if self.failed is None else self.failed
        self.failed = torch.where(finite, torch.zeros_like(failed), failed + 1)

    def read(self) -> dict[str, float]:
        """Waits for the device."""
        return {} if self.mean is None else dict(zip(self.names, self.mean.tolist(), strict=True))


Reserve = Callable[[float], float]  # from a validation's seconds to those of what follows the training
MARGIN = 1.1  # how much longer than the last time the last validation and export may take


def _nothing_follows(_: float) -> float:
    """Where the training is all."""
    return 0.0


def _show_nothing(progress: Progress) -> None:
    """Where nobody watches."""


class Trainer:
    """One training in the folder ``out``. show: called after every step by the first process."""

    def __init__(self, config: Schedule, task: Task, fabric: Any, out: Path, show: Show | None = None) -> None:
        self.config, self.task, self.fabric, self.out = config, task, fabric, out
        self.show = show or _show_nothing
        self.first = fabric.global_rank == 0
        self.checkpoints = Checkpoints(out / "checkpoints", config.keep)
        raw = make_optimiser(task.nets, config)
        self.module, self.optimiser = fabric.setup(task.module, raw)
        self.raw = raw
        self.average = AveragedModel(task.nets, multi_avg_fn=self._average, use_buffers=True)
        self.step, self.seconds, self.score = 0, 0.0, math.nan
        self.running = Means()
        self.shown = self.exported = 0.0
        self.logged = self.validated = self.saved = -1  # the step of the last time
        self.took = {"step": 0.0, "validation": 0.0, "export": 0.0, "checkpoint": 0.0}  # seconds, the last time
        self.reserve: Reserve = _nothing_follows
        self.began = time.monotonic()  # where ``seconds`` begins

    # --- the loop ---

    def run(self, began: float | None = None, reserve: Reserve = _nothing_follows) -> list[dict[str, str]]:
        """Train to the end; returns the validations' rows, the first before and the last after the training.

        With ``minutes`` the steps end so early that the last validation, export and checkpoint still fit, by what they
        took before; there is one step in any case. began: when the minutes began, of `time.monotonic`; by default now.
        reserve: how many seconds are left for what follows.
        Goes on from the last checkpoint where there is one. Raises TrainingError where the loss is not finite,
        OutputError where the disk is full.
        """
        self.began, self.reserve = time.monotonic() if began is None else began, reserve
        resumed = self._resume()
        self.began -= self.seconds
        first = self.step
        batches = self._batches(self.step)
        ready = [next(batches) for _ in range(1 if resumed else max(1, self.task.measured))]
        if not resumed:
            self._start(ready)
        batches = itertools.chain(ready, batches)  # the workers have begun before the clock does
        curves = Curves(self.out, self.step) if self.first else None
        if curves and not curves.rows("validation"):
            self._validate(curves)
        overfitted = next(batches) if self.config.overfit else None
        self._look_at_the_clock()
        self.shown = self.exported = self.seconds
        try:
            with self._profiler() as profiler:
                while (done := self._done()) < 1 or self.step == 0:
                    started = time.monotonic()
                    batch = overfitted or next(batches)
                    waited = time.monotonic() - started
                    self.train_step(batch, done, {"waited": waited})
                    self._look_at_the_clock()
                    self.took["step"] = time.monotonic() - started
                    if profiler is not None:
                        profiler.step()
                    if curves:
                        self._now_and_then(curves)
                if curves and self.step > first:
                    self._finish(curves)
        finally:
            if curves:
                curves.close()
        self.fabric.barrier()
        return curves.rows("validation") if curves else []

    def _batches(self, start: int) -> Iterator[Batch]:
        on_gpu = self.fabric.device.type == "cuda"
        return loader(self.task.stream(start, self.fabric.global_rank), self.config.machine.workers, on_gpu)

    @property
    def means(self) -> dict[str, float]:
        """Running means of the loss and its parts."""
        return self.running.read()

    def train_step(self, batch: Batch, done: float, also: Mapping[str, float] | None = None) -> dict[str, Tensor]:
        """One optimiser step; returns the loss and its parts, detached scalars. also: further values to log.

        On a GPU nothing in it waits for the device: a gradient that is not finite is left out there, and noticed when
        the losses are read next. On a CPU it ends the training. Raises TrainingError.
        """
        rank, world = self.fabric.global_rank, self.fabric.world_size
        drawn = 0 if self.config.overfit else self.step
        seed = (self.config.seed * 1_000_003 + drawn) * world + rank
        torch.manual_seed(seed)
        for group in self.raw.param_groups:
            group["lr"] = rate_at(self.step, done, self.config.optimiser)
        self.module.train()
        loss, parts = self.module(self.fabric.to_device(batch), seed)
        self.raw.zero_grad(set_to_none=True)
        self.fabric.backward(loss)
        norm = self.fabric.clip_gradients(
            self.module, self.optimiser, max_norm=self.config.optimiser.clip, error_if_nonfinite=False
        )
        if self.on_gpu:
            self.raw.found_inf = (~torch.isfinite(norm)).float()  # type: ignore[attr-defined]  # a fused step skips
        else:
            self._check_finite(float(loss.detach()), float(norm))
        self.optimiser.step()
        self.average.update_parameters(self.task.nets)
        self.step += 1
        found = {"loss": loss.detach(), **parts, "norm": norm.detach(), **(also or {})}
        values = {k: torch.as_tensor(v, dtype=torch.float32, device=loss.device) for k, v in found.items()}
        self.running.update(values)
        return values

    @property
    def on_gpu(self) -> bool:
        """Whether the training runs on a CUDA device without a loss scaler."""
        return bool(self.fabric.device.type == "cuda") and self.config.machine.precision != "16-mixed"

    def _check_finite(self, loss: float, norm: float) -> None:
        """The gradient is averaged over all processes: one that is not finite stops them together, before the weights
        are changed. With 16-mixed a gradient may overflow, and the scaler leaves out that step."""
        if math.isfinite(loss) and (math.isfinite(norm) or self.config.machine.precision == "16-mixed"):
            return
        last = self.checkpoints.last()
        held = (
            f"the checkpoint of step {last} in {self.checkpoints.folder} is intact"
            if last is not None
            else "no checkpoint was written before"
        )
        raise TrainingError(
            f"the loss became {loss} at step {self.step} (norm of the gradient {norm}); {held}. "
            "Start from it with --resume and a lower --rate, or look at the meshes and pictures given."
        )

    def _done(self) -> float:
        """How much of the training is behind, the same number in all processes: the first one's."""
        self._look_at_the_clock()
        done = self._share()
        if self.config.minutes > 0 and self.fabric.world_size > 1:
            done = self.fabric.broadcast(done)
        return float(done)

    def _look_at_the_clock(self) -> None:
        self.seconds = time.monotonic() - self.began

    def _now_and_then(self, curves: Curves) -> None:
        logged = self.step % self.config.log == 0
        if logged or self.seconds - self.shown >= READ_EVERY:
            self._read_losses(curves if logged else None)
        self.score = math.nan
        due = 0 < self.config.export_seconds <= self.seconds - self.exported
        if self.step % self.config.validate == 0:
            self._validate(curves)
        elif due:
            self._export({})
        if self.step % self.config.save == 0 or due:
            self.save()
            self.exported = self.seconds

    def _finish(self, curves: Curves) -> None:
        """What the last step has not led to yet."""
        if self.logged != self.step:
            self._read_losses(curves)
        if self.validated != self.step:
            self._validate(curves)
        if self.saved != self.step:
            self.save()
        self._look_at_the_clock()

    def _read_losses(self, curves: Curves | None) -> None:
        """Read the losses, which waits for the device."""
        self.shown, means = self.seconds, self.means
        if self.running.failed is not None and float(self.running.failed) > PATIENCE:
            self._check_finite(math.nan, math.nan)
        self.show(Progress(self.step, min(1.0, self._share()), self.seconds, means))
        if curves is not None:
            self.logged = self.step
            curves.add("train", self.step, self.seconds, means)

    def _share(self) -> float:
        """As `_done`, by this process's own clock: of the minutes without what is still to be done after the steps."""
        done = self.step / self.config.steps
        if self.config.minutes <= 0:
            return done
        left = 60 * self.config.minutes - MARGIN * sum(self.took.values()) - self.reserve(self.took["validation"])
        return max(done, self.seconds / left if left > 0 else 1.0)

    @contextmanager
    def _stage(self, name: str, label: str = "") -> Iterator[None]:
        """Tells what is being done, by its label, and keeps how long it takes."""
        if label:
            self.show(Progress(self.step, min(1.0, self._share()), self.seconds, {}, label))
        started = time.monotonic()
        yield
        self.took[name] = time.monotonic() - started

    def _validate(self, curves: Curves) -> None:
        averaged = self.average.module
        averaged.eval()
        with self._stage("validation", "validation"), torch.no_grad():
            found = self.task.validate(averaged)
        self.validated = self.step
        self.score = found["score"]
        curves.add("validation", self.step, self.seconds, found)
        self._export(found)

    def _export(self, found: Mapping[str, float]) -> None:
        """The averaged weights. found: their validation, where there was one."""
        about = {"recipe": self.config.recipe, "steps": self.step, "hours": self.seconds / 3600, "held_back": found}
        with self._stage("export", "export"):
            self.task.export(self.average.module, self.out, about)

    # --- state ---

    def _start(self, batches: Sequence[Batch]) -> None:
        """A new training: measure, and tell the other processes."""
        if self.first:
            self.task.prepare(batches)
        if self.fabric.world_size > 1:
            state = self.fabric.broadcast({k: v.cpu() for k, v in self.task.nets.state_dict().items()})
            self.task.nets.load_state_dict(state)
        self.average.module.load_state_dict(self.task.nets.state_dict())

    def save(self) -> None:
        """Write a checkpoint. Raises OutputError."""
        state = {f"net.{k}": v for k, v in self.task.nets.state_dict().items()}
        state |= {f"average.{k}": v for k, v in self.average.state_dict().items()}
        state |= {f"optimiser.{k}": v for k, v in optimiser_tensors(self.raw).items()}
        with self._stage("checkpoint"):
            self.checkpoints.save(Checkpoint(self.step, self.seconds, self.score, self.means, state))
        self.saved = self.step

    def _resume(self) -> bool:
        """Take over the last checkpoint, whose number the first process decides."""
        step = self.fabric.broadcast(self.checkpoints.last())
        if step is None:
            return False
        found = self.checkpoints.load(step)
        self.step, self.seconds, self.running = found.step, found.seconds, Means(found.means)
        self.shown = self.exported = self.seconds
        self.task.nets.load_state_dict(part(found.tensors, "net."))
        self.average.load_state_dict(part(found.tensors, "average."))
        restore_optimiser(self.raw, part(found.tensors, "optimiser."))
        return True

    @torch.no_grad()
    def _average(self, averages: Sequence[Tensor], currents: Sequence[Tensor], count: Tensor | int) -> None:
        """An exponential moving average that forgets its first values faster: the decay grows to ``ema``."""
        decay = min(self.config.optimiser.ema, (1.0 + float(count)) / (10.0 + float(count)))
        pairs = list(zip(averages, currents, strict=True))
        floats = [(a, c.to(a.dtype)) for a, c in pairs if a.is_floating_point()]
        if floats:
            torch._foreach_lerp_([a for a, _ in floats], [c for _, c in floats], 1.0 - decay)
        for average, current in pairs:
            if not average.is_floating_point():
                average.copy_(current)

    def _profiler(self) -> AbstractContextManager[Any]:
        """With --profile: where the time of a few steps went, in ``profile.txt``."""
        if not (self.config.profile and self.first):
            return nullcontext()
        skipped, recorded = PROFILED
        return torch.profiler.profile(
            schedule=torch.profiler.schedule(wait=skipped - 1, warmup=1, active=recorded, repeat=1),
            on_trace_ready=lambda p: write_text_atomic(
                self.out / "profile.txt", p.key_averages().table(sort_by="self_cpu_time_total", row_limit=40)
            ),
        )


def loader(stream: IterableDataset[Batch], workers: int, on_gpu: bool = False) -> Iterator[Batch]:
    """A stream's batches, made in ``workers`` processes (0: in this one) while the network trains.

    on_gpu: the batches are pinned, and the workers start from a fresh process, since one that is forked after CUDA has
    begun may hang in the driver; otherwise they share what is loaded already. Raises TrainingError where the workers
    make no batch for some minutes.
    """
    context = ("forkserver" if on_gpu else "fork") if workers else None
    wait = (120 if on_gpu else 600) if workers else 0
    batches = DataLoader(
        stream,
        batch_size=None,
        num_workers=workers,
        multiprocessing_context=context,
        prefetch_factor=(2 if on_gpu else 6) if workers else None,
        pin_memory=on_gpu,
        timeout=wait,
    )
    try:
        yield from batches
    except RuntimeError as error:
        if "timed out" not in str(error):
            raise
        raise TrainingError(
            f"the {workers} processes that render and augment made no batch within {wait} seconds. See whether "
            "`posekit doctor` can draw here, and pass fewer --workers."
        ) from error

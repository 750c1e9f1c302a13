"""How fast the lite recipe trains, and where the time goes.

    python benchmarks/train.py [--steps 60] [--batch 32] [--threads 2] [--workers 1]

Prints samples a second, the share of the CPU time that rendering and augmentation take, and the training's multiply-
adds a second beside the machine's float32 matrix-multiply rate, both measured in the same run: absolute figures of a
machine that others use too say little.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import tempfile
import time
from pathlib import Path

import torch
from torch.utils.flop_counter import FlopCounterMode

from posekit.train.config import MachineConfig, TrainConfig
from posekit.train.loop import Trainer, loader, make_fabric
from posekit.train.pose import make_task
from posekit.train.sources import Sources

WARM = 3  # steps before the clock starts; many more must be timed than the loader keeps ready


def matmul_rate(seconds: float = 2.0, size: int = 2048) -> float:
    """float32 multiply-adds a second of this process's threads."""
    a, b = torch.rand(size, size), torch.rand(size, size)
    a @ b
    count, started = 0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        a @ b
        count += 1
    return count * size**3 / (time.perf_counter() - started)


def cpu_seconds(pid: int) -> float:
    """What a process has used of all cores so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def children() -> list[int]:
    here = Path(f"/proc/{os.getpid()}/task")
    return [int(pid) for task in here.iterdir() for pid in (task / "children").read_text().split()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--workers", type=int, default=1)
    args = parser.parse_args()
    config = TrainConfig(machine=MachineConfig("cpu", threads=args.threads, workers=args.workers))
    config = dataclasses.replace(config, stream=dataclasses.replace(config.stream, batch=args.batch))
    fabric = make_fabric(config)
    task = make_task(config, Sources([], [], [], None))
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(config, task, fabric, Path(folder))
        batches = loader(task.stream(0, 0), args.workers)
        with FlopCounterMode(display=False) as counter:
            trainer.train_step(next(batches), 0.0)
        work = counter.get_total_flops() / 2  # multiply-adds of a step, forward and backward
        for _ in range(WARM):
            trainer.train_step(next(batches), 0.0)
        before = matmul_rate()
        workers, own = children(), time.process_time()
        theirs, started = sum(map(cpu_seconds, workers)), time.perf_counter()
        for _ in range(args.steps):
            trainer.train_step(next(batches), 0.0)
        seconds = time.perf_counter() - started
        own, theirs = time.process_time() - own, sum(map(cpu_seconds, workers)) - theirs
        rate = 0.5 * (before + matmul_rate())
    done = work * args.steps / seconds
    print(f"samples a second: {args.steps * args.batch / seconds:.1f} ({seconds / args.steps:.2f} s a step)")
    print(
        f"CPU time of rendering and augmentation: {theirs / (own + theirs):.0%} ({theirs:.1f} of {own + theirs:.1f} s)"
    )
    print(f"multiply-adds a second: {done / 1e9:.1f} G; float32 matmul: {rate / 1e9:.1f} G; ratio {done / rate:.2f}")


if __name__ == "__main__":
    main()

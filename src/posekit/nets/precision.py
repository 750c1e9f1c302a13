"""What the hardware offers: bfloat16, cores."""

from __future__ import annotations

import os
import sys
from typing import Any

from posekit.errors import ConfigError

DEVICES = ("auto", "cpu", "cuda")


def choose_device(name: str) -> str:
    """torch's name of the device that networks run on: "auto" takes a GPU where there is one.

    Raises ConfigError for another name, or where a GPU is asked for and torch finds none.
    """
    if name not in DEVICES:
        raise ConfigError(f"the device is one of {', '.join(DEVICES)}, not {name!r}.")
    found = name != "cpu" and may_have_gpu() and _torch_finds_gpu()
    if name == "cuda" and not found:
        raise ConfigError(
            "the device cuda was asked for, but torch finds no GPU here: install a CUDA build of torch, or choose cpu."
        )
    return "cuda" if found else "cpu"


def may_have_gpu() -> bool:
    """Whether it is worth to ask PyTorch for a GPU, which takes a second: on Linux without a device file it is not."""
    return not sys.platform.startswith("linux") or any(map(os.path.exists, ("/dev/nvidiactl", "/dev/dxg", "/dev/kfd")))


def _torch_finds_gpu() -> bool:
    import torch

    return torch.cuda.is_available()


_threads: int | None = None


def use_threads(count: int | None) -> None:
    """Let networks on the processor use so many threads from now on in this process; None leaves it to them."""
    global _threads
    _threads = count
    if count is not None and "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(count)


def threads() -> int | None:
    """What `use_threads` was told last."""
    return _threads


def has_fast_bfloat16(device: str) -> bool:
    """Whether the hardware multiplies in bfloat16: GPUs of the last years, CPUs with AMX or AVX-512's instructions for
    it. On other CPUs it would be several times slower than float32."""
    import torch

    if device == "cuda":
        return torch.cuda.is_bf16_supported()
    ask: Any = getattr(torch.cpu, "get_capabilities", dict)  # older versions of torch do not have it
    return any(ask().get(name) for name in ("amx_bf16", "avx512_bf16"))


def usable_cores() -> int:
    """Of the processor, by this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

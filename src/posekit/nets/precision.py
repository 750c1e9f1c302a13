"""What the hardware offers: bfloat16, cores."""

from __future__ import annotations

import os
from typing import Any

import torch

from posekit.errors import ConfigError

DEVICES = ("auto", "cpu", "cuda")


def choose_device(name: str) -> str:
    """torch's name of the device that networks run on: "auto" takes a GPU where there is one.

    Raises ConfigError for another name, or where a GPU is asked for and torch finds none.
    """
    if name not in DEVICES:
        raise ConfigError(f"the device is one of {', '.join(DEVICES)}, not {name!r}.")
    found = torch.cuda.is_available()
    if name == "cuda" and not found:
        raise ConfigError(
            "the device cuda was asked for, but torch finds no GPU here: install a CUDA build of torch, or choose cpu."
        )
    return "cuda" if found and name != "cpu" else "cpu"


def has_fast_bfloat16(device: str) -> bool:
    """Whether the hardware multiplies in bfloat16: GPUs of the last years, CPUs with AMX. On other CPUs it would be
    several times slower than float32."""
    if device == "cuda":
        return torch.cuda.is_bf16_supported()
    ask: Any = getattr(torch.cpu, "get_capabilities", dict)  # older versions of torch do not have it
    return bool(ask().get("amx_bf16"))


def usable_cores() -> int:
    """Of the processor, by this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

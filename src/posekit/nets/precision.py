"""What the hardware offers: bfloat16, cores. Layer 2."""

from __future__ import annotations

import os
from typing import Any

import torch


def has_fast_bfloat16(device: str) -> bool:
    """Whether the hardware multiplies in bfloat16: GPUs of the last years, CPUs with AMX. On other CPUs it would be
    several times slower than float32."""
    if device == "cuda":
        return torch.cuda.is_bf16_supported()
    ask: Any = getattr(torch.cpu, "get_capabilities", dict)  # older versions of torch do not tell
    return bool(ask().get("amx_bf16"))


def usable_cores() -> int:
    """Of the processor, by this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

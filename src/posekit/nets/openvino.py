"""SV-Net of the lite preset through OpenVINO: the same answers as PyTorch's, faster on a CPU.

The converted network is kept in the user's cache (XDG_CACHE_HOME), by the weights' digest: converting takes seconds.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import warnings
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import openvino
import torch
from torch import Tensor, nn

from posekit._version import __version__
from posekit.errors import ConfigError
from posekit.nets.inputs import relief, to_input
from posekit.nets.lite import LiteSVNet
from posekit.nets.precision import has_fast_bfloat16
from posekit.nets.predictor import PairPrediction, answers, unpack
from posekit.nets.weights import Networks
from posekit.view import View


class OpenVinoPredictor:
    """As NetworkPredictor, one pair after the other: for a tracker, which has one at a time.

    bfloat16: whether to compute in it; None = where the processor does so faster. threads: None = OpenVINO's choice.
    Not thread-safe. Raises ConfigError for networks of another preset than lite.
    """

    def __init__(self, networks: Networks, bfloat16: bool | None = None, threads: int | None = None) -> None:
        if not isinstance(networks.svnet, LiteSVNet):
            raise ConfigError(
                f"OpenVINO runs the networks of preset lite, not {networks.preset}: leave --runtime torch."
            )
        self.networks = networks
        self.bfloat16 = has_fast_bfloat16("cpu") if bfloat16 is None else bfloat16
        self.size, self.dense = networks.size, networks.dense
        options: dict[str, Any] = {
            "INFERENCE_PRECISION_HINT": "bf16" if self.bfloat16 else "f32",
            "PERFORMANCE_HINT": "LATENCY",
        }
        if threads is not None:
            options["INFERENCE_NUM_THREADS"] = threads
        self._run = openvino.Core().compile_model(_converted(networks), "CPU", options)

    def predict(self, observed: Sequence[View], rendered: Sequence[View]) -> list[PairPrediction]:
        return [self._one(o, r) for o, r in zip(observed, rendered, strict=True)]

    def _one(self, observed: View, rendered: View) -> PairPrediction:
        first, second = to_input(observed.image, None)[None, :3], to_input(rendered.image, rendered.mask)[None]
        focal = np.array([rendered.camera.fx / rendered.camera.width], np.float32)
        return unpack(list(self._run([first, second, relief(rendered)[None], focal]).values()), 0, rendered)


class _Answers(nn.Module):
    """The network with its answers in the order that `unpack` takes them."""

    def __init__(self, svnet: LiteSVNet) -> None:
        super().__init__()
        self.svnet = svnet

    def forward(self, observed: Tensor, rendered: Tensor, relief: Tensor, focal: Tensor) -> tuple[Tensor, ...]:
        return answers(self.svnet(observed, rendered, relief, focal))  # type: ignore[return-value]


def _converted(networks: Networks) -> Any:
    """From the cache, else from PyTorch's module; what has no digest (untrained networks) is not kept."""
    kept = (
        _cache() / f"{networks.digest}-{__version__}-{openvino.__version__.split('-')[0]}" if networks.digest else None
    )
    if kept is not None and kept.is_dir():
        return openvino.Core().read_model(kept / "svnet.xml")
    assert isinstance(networks.svnet, LiteSVNet)
    model = _convert(networks.svnet)
    if kept is not None:
        with suppress(OSError):  # a cache that cannot be written costs time only
            _keep(model, kept)
    return model


def _convert(svnet: LiteSVNet) -> Any:
    width, height = svnet.config.size
    rendered = torch.zeros(1, 4, height, width)
    rendered[:, 3, height // 4 : -height // 4, width // 4 : -width // 4] = 1.0
    example = (rendered[:, :3], rendered, torch.zeros(1, height, width), torch.ones(1))
    with torch.inference_mode(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of sizes that become constants: a crop's size is one
        traced = torch.jit.trace(_Answers(svnet).eval(), example, check_trace=False)
    return openvino.convert_model(traced, example_input=example, input=[list(x.shape) for x in example])


def _keep(model: Any, folder: Path) -> None:
    """As a whole or not at all."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(dir=folder.parent))
    try:
        openvino.save_model(model, part / "svnet.xml", compress_to_fp16=False)
        part.rename(folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _cache() -> Path:
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "posekit" / "openvino"

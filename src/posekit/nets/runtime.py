"""What runs the networks: OpenVINO on a processor, PyTorch on a GPU, one copy for all meshes."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from posekit.errors import ConfigError
from posekit.nets.config import LiteConfig, WeightsFile
from posekit.nets.precision import choose_device, threads, usable_cores
from posekit.nets.predictor import Predictor
from posekit.nets.telemetry import without_telemetry

if TYPE_CHECKING:
    from torch import nn

    from posekit.nets.weights import Networks

log = logging.getLogger("posekit")

RUNTIMES = ("auto", "openvino", "torch")
STREAMS = 4  # pairs that are compared at the same time, at most


class Runtime:
    """The networks of one weights file and what runs them, each loaded when it is first used.

    networks: such as are loaded already; then preset and weights do not count, and PyTorch runs them unless OpenVINO is
    asked for. device: "auto" (a GPU where there is one), "cpu" or "cuda". runtime: "openvino", "torch", or "auto":
    OpenVINO for preset lite on a processor, where it is installed.
    Raises WeightsError where there are no such weights, ConfigError where there is no such device or runtime.
    """

    def __init__(
        self,
        preset: str = "lite",
        weights: Path | None = None,
        *,
        device: str = "auto",
        runtime: str = "auto",
        networks: Networks | None = None,
    ) -> None:
        if runtime not in RUNTIMES:
            raise ConfigError(f"the runtime is one of {', '.join(RUNTIMES)}, not {runtime!r}.")
        self._given, self._asked = networks, (preset, weights)
        about = WeightsFile.read(preset, weights) if networks is None else networks
        self.preset, self.config, self.digest = about.preset, about.config, about.digest
        self.about: Mapping[str, Any] = about.about
        self.device = choose_device(device) if networks is None else networks.device.type
        if runtime == "auto":
            usable = networks is None and self.preset == "lite" and self.device == "cpu" and _has_openvino()
            runtime = "openvino" if usable else "torch"
        elif runtime == "openvino" and (self.preset != "lite" or self.device != "cpu"):
            raise ConfigError("OpenVINO runs the networks of preset lite, on the processor: leave --runtime torch.")
        self.runtime = runtime

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of SV-Net's crops, pixels."""
        return self.config.size

    @property
    def dense(self) -> bool:
        """Whether SV-Net predicts correspondences."""
        return isinstance(self.config, LiteConfig)

    @cached_property
    def networks(self) -> Networks:
        """PyTorch's networks, on the device. Raises WeightsError where the file is damaged."""
        if self._given is not None:
            return self._given
        from posekit.nets.weights import load_networks

        count = threads()
        if count is not None:
            import torch

            torch.set_num_threads(count)
        return load_networks(*self._asked).moved(self.device)

    @cached_property
    def predictor(self) -> Predictor:
        """SV-Net for batches of pairs."""
        streams = min(STREAMS, threads() or usable_cores())
        return self.predictor_for(streams, streams)  # a thread for each: sums do not depend on the number of threads

    def predictor_for(self, streams: int, count: int | None) -> Predictor:
        """SV-Net with so many pairs at the same time and threads in all (None: those of the process). PyTorch has no
        such choice."""
        if self.runtime == "torch":
            from posekit.nets.pytorch import NetworkPredictor

            return NetworkPredictor(self.networks)
        from posekit.nets.openvino import OpenVinoPredictor, has_bfloat16

        def svnet() -> Any:
            return self.networks.svnet

        return OpenVinoPredictor(svnet, self.digest, self.size, bfloat16=has_bfloat16(), threads=count, streams=streams)

    @cached_property
    def features(self) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
        """ImageNet's early features of a pair of crops of SV-Net's size: (2, 3, H, W) in [0, 1] -> (2, C, H / 8,
        W / 8), each cell's of unit length. Raises WeightsError where ImageNet's weights are missing."""
        if self.runtime == "torch":
            from posekit.nets.pytorch import torch_features

            return torch_features(self.device)
        from posekit.nets.openvino import OpenVinoFeatures

        return OpenVinoFeatures(_early_features, self.size, threads())


def _early_features() -> nn.Module:
    from posekit.nets.lite0 import EarlyFeatures

    return EarlyFeatures()


def _has_openvino() -> bool:
    try:
        with without_telemetry():
            import openvino  # noqa: F401
    except (ImportError, OSError) as error:
        log.warning("OpenVINO cannot be used (%s): PyTorch runs the networks, at half the speed.", error)
        return False
    return True

"""The networks, made and loaded with PyTorch: see `posekit.nets.config` for their files."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomli_w
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from posekit.errors import ConfigError, WeightsError
from posekit.io.files import write_bytes_atomic, write_text_atomic
from posekit.nets.config import PRESETS, LiteConfig, PaperConfig, WeightsFile
from posekit.nets.lite import LiteSVNet
from posekit.nets.mvnet import MatchingMVNet
from posekit.nets.paper import Branch, PaperMVNet, PaperSVNet

SHARED = ("branch.", "tower.")  # what MV-Net has from SV-Net


@dataclass(frozen=True, eq=False)
class Networks:
    """The networks of one preset, with shared weights. mvnet: None where the weights hold no trained one."""

    preset: str
    config: LiteConfig | PaperConfig
    svnet: LiteSVNet | PaperSVNet
    mvnet: MatchingMVNet | PaperMVNet | None
    digest: str = "untrained"
    about: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the crops that the networks take, pixels."""
        return self.config.size

    @property
    def device(self) -> torch.device:
        """Where the networks are."""
        return next(self.svnet.parameters()).device

    def moved(self, device: str) -> Networks:
        """The same networks, moved to a device by torch's name of it."""
        self.svnet.to(device)
        if self.mvnet is not None:
            self.mvnet.to(device)
        return self

    @property
    def dense(self) -> bool:
        """Whether SV-Net predicts correspondences."""
        return isinstance(self.svnet, LiteSVNet)


def build(preset: str, config: LiteConfig | PaperConfig | None = None) -> Networks:
    """Untrained networks of a preset. Raises WeightsError for an unknown one."""
    if preset == "lite":
        lite = config if isinstance(config, LiteConfig) else LiteConfig()
        svnet = LiteSVNet(lite)
        return Networks(preset, lite, svnet, MatchingMVNet(svnet.tower, lite))
    if preset == "paper":
        paper = config if isinstance(config, PaperConfig) else PaperConfig()
        branch = Branch(paper.size, paper.width)
        return Networks(preset, paper, PaperSVNet(branch), PaperMVNet(branch, paper.views))
    raise WeightsError(f"unknown preset {preset!r}; there are {' and '.join(PRESETS)}.")


def save_networks(path: Path, networks: Networks, about: Mapping[str, Any]) -> str:
    """Write ``path``.safetensors in fp16 and ``path``.toml; returns the weights' hash."""
    state = {f"svnet.{k}": _half(v) for k, v in networks.svnet.state_dict().items()}
    if networks.mvnet is not None:
        own = networks.mvnet.state_dict()
        state |= {f"mvnet.{k}": _half(v) for k, v in own.items() if not k.startswith(SHARED)}
    data = save(state)
    digest = hashlib.sha256(data).hexdigest()[:16]
    config = {k: list(v) if isinstance(v, tuple) else v for k, v in dataclasses.asdict(networks.config).items()}
    write_bytes_atomic(path.with_suffix(".safetensors"), data)
    head = {"preset": networks.preset, "sha256_16": digest, "config": config, "about": dict(about)}
    write_text_atomic(path.with_suffix(".toml"), tomli_w.dumps(head))
    return digest


def _half(value: Tensor) -> Tensor:
    return value.detach().half().contiguous() if value.is_floating_point() else value.detach().contiguous()


def load_networks(preset: str, path: Path | None = None) -> Networks:
    """Read weights strictly. Raises WeightsError where a file is missing, damaged or of another preset."""
    about = WeightsFile.read(preset, path)
    file = about.path
    try:
        state = load_file(file)
    except (OSError, ValueError, SafetensorError) as error:
        raise WeightsError(f"the weights {file} are damaged: {error}. Fetch or train them anew.") from error
    networks = _built(preset, about.config, state, file)
    has_mvnet = any(k.startswith("mvnet.") for k in state)
    _load_strictly(networks.svnet, {k[6:]: v for k, v in state.items() if k.startswith("svnet.")}, file)
    if networks.mvnet is not None and has_mvnet:
        own = {k[6:]: v for k, v in state.items() if k.startswith("mvnet.")}
        own |= {k: v for k, v in networks.svnet.state_dict().items() if k.startswith(SHARED)}
        _load_strictly(networks.mvnet, own, file)
    networks.svnet.eval()
    mvnet = networks.mvnet if has_mvnet else None
    if mvnet is not None:
        mvnet.eval()
    return dataclasses.replace(networks, mvnet=mvnet, digest=about.digest, about=about.about)


class _WithoutNormals(TorchFunctionMode):
    """Leaves out normally distributed first values: for meta tensors torch imports its compiler to make them."""

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        named = kwargs or {}
        if getattr(func, "__name__", "").endswith("normal_"):  # normal_, kaiming_normal_: of the tensor or of nn.init
            return args[0] if args else named["tensor"]
        return func(*args, **named)


def _built(preset: str, config: LiteConfig | PaperConfig, state: Mapping[str, Tensor], file: Path) -> Networks:
    """The networks of a configuration, without memory for their parameters, which the file's take the place of.

    Raises WeightsError where a configuration makes none, or networks with other parameters than the file holds.
    """
    try:
        with torch.device("meta"), _WithoutNormals():
            networks = build(preset, config)
        parameters = sum(v.numel() for v in networks.svnet.state_dict().values())
        stored = sum(v.numel() for k, v in state.items() if k.startswith("svnet."))
        if parameters != stored:
            raise ValueError(f"its networks have {parameters} numbers, the file {stored}")
        return networks
    except (
        ConfigError, TypeError, ValueError, IndexError, AttributeError, OverflowError, ZeroDivisionError, RuntimeError
    ) as error:  # fmt: skip
        first = str(error).partition("\n")[0]
        raise WeightsError(f"the configuration of the weights {file} makes no networks ({first}).") from error


def _load_strictly(module: nn.Module, state: dict[str, Tensor], file: Path) -> None:
    state = {k: v.float() if v.is_floating_point() else v for k, v in state.items()}
    if not all(torch.isfinite(v).all() for v in state.values() if v.is_floating_point()):
        raise WeightsError(f"the weights {file} hold numbers that are not finite.")
    try:
        module.load_state_dict(state, strict=True, assign=True)
    except RuntimeError as error:
        raise WeightsError(f"the weights {file} do not fit the network: {error}") from error

"""Weights on disk: ``NAME.safetensors`` (fp16) beside ``NAME.toml`` (preset, training, measured figures). No pickle."""

from __future__ import annotations

import dataclasses
import hashlib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomli_w
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor, nn

from posekit.errors import ConfigError, WeightsError
from posekit.io.files import other_content, write_bytes_atomic, write_text_atomic
from posekit.nets.lite import LiteConfig, LiteSVNet
from posekit.nets.mvnet import MatchingMVNet
from posekit.nets.paper import Branch, PaperMVNet, PaperSVNet

PRESETS = ("lite", "paper")
SHARED = ("branch.", "tower.")  # what MV-Net has from SV-Net
_LONGEST_SIDE, _WIDEST = 4096, 16
SHIPPED = Path(__file__).resolve().parent.parent / "weights"


@dataclass(frozen=True)
class PaperConfig:
    """The size of the paper's networks."""

    size: tuple[int, int] = (640, 480)  # (width, height) of the crop;
    width: float = 1.0  # share of FlowNetS's channels;
    views: int = 6  # MV-Net's

    def __post_init__(self) -> None:
        """Raises ConfigError where no network can be made of it."""
        numbers = (*self.size, self.views)
        if len(self.size) != 2 or any(type(n) is not int or not 1 <= n <= _LONGEST_SIDE for n in numbers):
            raise ConfigError(f"paper: size and views are whole numbers from 1 to {_LONGEST_SIDE}, not {self}.")
        if isinstance(self.width, bool) or not 0 < self.width <= _WIDEST:
            raise ConfigError(f"paper: width is above 0 and at most {_WIDEST}, not {self.width}.")


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


def find_weights(preset: str, path: Path | None = None) -> Path:
    """The ``.safetensors`` file: ``path`` (the file, its stem or its folder), else the one shipped for the preset.

    Raises WeightsError where there is none.
    """
    if path is None:
        found = SHIPPED / f"{preset}.safetensors"
        if not found.is_file():
            raise WeightsError(
                f"posekit ships no trained weights for preset {preset!r}. Pass --weights FILE, or use --preset lite."
            )
        return found
    candidates = [path, path.with_suffix(".safetensors"), path / f"{preset}.safetensors"]
    for candidate in candidates:
        if candidate.is_file():
            return candidate.with_suffix(".safetensors")
    raise WeightsError(f"no weights at {path}: expected a .safetensors file with its .toml beside it.")


def load_networks(preset: str, path: Path | None = None) -> Networks:
    """Read weights strictly. Raises WeightsError where a file is missing, damaged or of another preset."""
    file = find_weights(preset, path)
    about_file = file.with_suffix(".toml")
    try:
        head = tomllib.loads(about_file.read_text())
        data = file.read_bytes()
        state = load_file(file)
    except FileNotFoundError as error:
        raise WeightsError(f"{file.name} needs {about_file.name} beside it: {error}") from error
    except (OSError, ValueError, RecursionError, SafetensorError) as error:
        if file.is_file() and (content := other_content(file.read_bytes())) is not None:
            raise WeightsError(f"{file} {content}.") from error
        raise WeightsError(f"the weights {file} are damaged: {error}. Fetch or train them anew.") from error
    if head.get("preset") != preset:
        raise WeightsError(f"{file} holds weights of preset {head.get('preset')!r}, not {preset!r}.")
    digest = hashlib.sha256(data).hexdigest()[:16]
    if digest != head.get("sha256_16"):
        raise WeightsError(f"{file} and {about_file.name} do not belong together (hash {digest}). Fetch them anew.")
    networks = _built(preset, head.get("config", {}), state, file)
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
    return dataclasses.replace(networks, mvnet=mvnet, digest=digest, about=head.get("about", {}))


def _built(preset: str, values: Any, state: Mapping[str, Tensor], file: Path) -> Networks:
    """The networks of a configuration, without memory for their parameters, which the file's take the place of.

    Raises WeightsError where a configuration makes none, or networks with other parameters than the file holds.
    """
    try:
        with torch.device("meta"):
            networks = build(preset, _config(preset, values))
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


def _config(preset: str, values: Mapping[str, Any]) -> LiteConfig | PaperConfig:
    kind: type[LiteConfig | PaperConfig] = LiteConfig if preset == "lite" else PaperConfig
    known = {f.name for f in dataclasses.fields(kind)}
    unknown = set(values) - known
    if unknown:
        raise WeightsError(f"the weights' configuration has unknown keys {sorted(unknown)}; known: {sorted(known)}.")
    chosen: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    return kind(**chosen)


def _load_strictly(module: nn.Module, state: dict[str, Tensor], file: Path) -> None:
    state = {k: v.float() if v.is_floating_point() else v for k, v in state.items()}
    if not all(torch.isfinite(v).all() for v in state.values() if v.is_floating_point()):
        raise WeightsError(f"the weights {file} hold numbers that are not finite.")
    try:
        module.load_state_dict(state, strict=True, assign=True)
    except RuntimeError as error:
        raise WeightsError(f"the weights {file} do not fit the network: {error}") from error

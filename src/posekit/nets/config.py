"""What a weights file says of itself: preset, configuration, hash. Nothing here needs PyTorch.

Weights are ``NAME.safetensors`` (fp16) beside ``NAME.toml`` (preset, training, measured figures). No pickle.
"""

from __future__ import annotations

import dataclasses
import hashlib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from posekit.errors import ConfigError, WeightsError
from posekit.io.files import other_content

PRESETS = ("lite", "paper")
SHIPPED = Path(__file__).resolve().parent.parent / "weights"
CELL = 8  # pixels of a crop that are one cell of the lite network
_MOST_CHANNELS, _MOST_BLOCKS = 4096, 64  # of the lite preset
_LONGEST_SIDE, _WIDEST = 4096, 16  # of the paper's


@dataclass(frozen=True)
class LiteConfig:
    """The size of the lite network."""

    size: tuple[int, int] = (128, 96)  # (width, height) of the crop in pixels, multiples of 8
    widths: tuple[int, int] = (64, 192)  # channels at 1/4 and 1/8
    heads: int = 1  # of the attention across
    blocks: int = 6  # exchanges
    bottleneck: int = 96  # channels of their 3x3 convolutions
    fine: int = 48  # channels of the dense head

    def __post_init__(self) -> None:
        """Raises ConfigError where no network can be made of it."""
        numbers = (*self.size, *self.widths, self.heads, self.blocks, self.bottleneck, self.fine)
        if len(self.size) != 2 or len(self.widths) != 2 or any(type(n) is not int for n in numbers):
            raise ConfigError(f"lite: size and widths are pairs of whole numbers, the rest whole numbers, not {self}.")
        if min(numbers) < 1 or max(numbers) > _MOST_CHANNELS or self.blocks > _MOST_BLOCKS:
            raise ConfigError(
                f"lite: its numbers are from 1 to {_MOST_CHANNELS}, blocks at most {_MOST_BLOCKS}, not {self}."
            )
        if any(side % CELL for side in self.size) or self.widths[1] % self.heads:
            raise ConfigError(
                f"lite: size {self.size} is in multiples of {CELL} pixels, and heads {self.heads} divide the "
                f"{self.widths[1]} channels at 1/8."
            )

    @property
    def cells(self) -> tuple[int, int]:
        """(rows, columns) at 1/8."""
        return self.size[1] // CELL, self.size[0] // CELL


@dataclass(frozen=True)
class PaperConfig:
    """The size of the paper's networks."""

    size: tuple[int, int] = (640, 480)  # (width, height) of the crop
    width: float = 1.0  # share of FlowNetS's channels
    views: int = 6  # MV-Net's

    def __post_init__(self) -> None:
        """Raises ConfigError where no network can be made of it."""
        numbers = (*self.size, self.views)
        if len(self.size) != 2 or any(type(n) is not int or not 1 <= n <= _LONGEST_SIDE for n in numbers):
            raise ConfigError(f"paper: size and views are whole numbers from 1 to {_LONGEST_SIDE}, not {self}.")
        if isinstance(self.width, bool) or not 0 < self.width <= _WIDEST:
            raise ConfigError(f"paper: width is above 0 and at most {_WIDEST}, not {self.width}.")


@dataclass(frozen=True, eq=False)
class WeightsFile:
    """A weights file, checked against its TOML but not loaded. digest: 16 hex digits of the file's SHA-256."""

    path: Path
    preset: str
    config: LiteConfig | PaperConfig
    digest: str
    about: Mapping[str, Any]

    @classmethod
    def read(cls, preset: str, path: Path | None = None) -> WeightsFile:
        """The file that `find_weights` finds. Raises WeightsError where it is missing, damaged or of another preset."""
        file = find_weights(preset, path)
        about_file = file.with_suffix(".toml")
        try:
            head = tomllib.loads(about_file.read_text())
            data = file.read_bytes()
        except FileNotFoundError as error:
            raise WeightsError(f"{file.name} needs {about_file.name} beside it: {error}") from error
        except (OSError, ValueError, RecursionError) as error:
            raise WeightsError(f"the weights {file} are damaged: {error}. Fetch or train them anew.") from error
        if (content := other_content(data)) is not None:
            raise WeightsError(f"{file} {content}.")
        digest = hashlib.sha256(data).hexdigest()[:16]
        if head.get("preset") != preset:
            raise WeightsError(f"{file} holds weights of preset {head.get('preset')!r}, not {preset!r}.")
        if digest != head.get("sha256_16"):
            raise WeightsError(
                f"{file} is damaged, or not the one of {about_file.name} (hash {digest}). Fetch both anew."
            )
        try:
            config = _config(preset, head.get("config", {}))
        except (ConfigError, TypeError, ValueError, AttributeError) as error:
            raise WeightsError(f"the configuration of the weights {file} makes no networks ({error}).") from error
        return cls(file, preset, config, digest, head.get("about", {}))


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


def _config(preset: str, values: Mapping[str, Any]) -> LiteConfig | PaperConfig:
    kind: type[LiteConfig | PaperConfig] = LiteConfig if preset == "lite" else PaperConfig
    known = {f.name for f in dataclasses.fields(kind)}
    unknown = set(values) - known
    if unknown:
        raise WeightsError(f"the weights' configuration has unknown keys {sorted(unknown)}; known: {sorted(known)}.")
    chosen: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    return kind(**chosen)

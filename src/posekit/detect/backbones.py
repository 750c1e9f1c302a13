"""The networks below Mask R-CNN, by name: ``resnet50`` (the paper's) and ``lite0`` (EfficientNet-Lite0)."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

from torch import Tensor, nn

from posekit.detect.vision import torchvision
from posekit.nets.lite0 import CHANNELS, Lite0, lite0_imagenet, load_lite0

BACKBONES = ("lite0", "resnet50")


def feature_pyramid(name: str, channels: int, *, imagenet: bool) -> Any:
    """A backbone with its FPN: strides 4 to 32, and for resnet50 the paper's fifth level.

    imagenet: start from ImageNet weights, the package's or torchvision's own download.
    """
    detection = torchvision().models.detection.backbone_utils
    if name == "lite0":
        network = Lite0()
        if imagenet:
            load_lite0(network, lite0_imagenet())
        return _Pyramid(network, channels)
    weights = torchvision().models.ResNet50_Weights.IMAGENET1K_V1 if imagenet else None
    return detection.resnet_fpn_backbone(backbone_name="resnet50", weights=weights, trainable_layers=3)


class _Pyramid(nn.Module):
    def __init__(self, body: Lite0, channels: int) -> None:
        super().__init__()
        self.body, self.out_channels = body, channels
        self.fpn = torchvision().ops.FeaturePyramidNetwork(CHANNELS, channels)

    def forward(self, x: Tensor) -> OrderedDict[str, Tensor]:
        found: OrderedDict[str, Tensor] = self.fpn(self.body(x))
        return found

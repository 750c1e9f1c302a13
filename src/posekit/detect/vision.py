"""torchvision, also where its compiled part does not load.

The compiled operators of torchvision belong to one build of torch; beside another, ``import torchvision`` fails. Mask
R-CNN needs two of them, non-maximum suppression and RoIAlign: where they are missing, they are defined here in plain
PyTorch (a fallback, and a note says so). Import torchvision by this module only.
"""

from __future__ import annotations

import importlib
import importlib.util
import logging
import math
import sys
from functools import cache
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from posekit.errors import ConfigError

log = logging.getLogger("posekit")

_SCHEMAS = (
    "nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
    "qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
    "roi_align(Tensor input, Tensor rois, float spatial_scale, SymInt pooled_height, SymInt pooled_width, "
    "int sampling_ratio, bool aligned) -> Tensor",
)


@cache
def torchvision() -> Any:
    """The module torchvision, with its detection models ready. Raises ConfigError where it is not installed."""
    found = importlib.util.find_spec("torchvision")
    if found is None or not found.submodule_search_locations:
        raise ConfigError("detection needs torchvision: pip install torchvision.")
    if _compiled_part_loads(Path(found.submodule_search_locations[0])):
        module = importlib.import_module("torchvision")
    else:
        module = _with_own_operators()
    importlib.import_module("torchvision.models.detection")
    return module


def _compiled_part_loads(folder: Path) -> bool:
    libraries = [*folder.glob("_C*.so"), *folder.glob("_C*.pyd")]
    try:
        for library in libraries:
            torch.ops.load_library(library)
    except (OSError, RuntimeError):
        return False
    return bool(libraries) and hasattr(torch.ops.torchvision, "nms")


def _with_own_operators() -> Any:
    log.info("torchvision's compiled operators do not load beside torch %s: plain PyTorch's do their work, slower.",
             torch.__version__)  # fmt: skip
    define_operators()
    module = importlib.import_module("torchvision")
    for name in ("torchvision.extension", "torchvision.ops.roi_align"):  # where torchvision checks for its operators
        sys.modules[name]._has_ops = lambda: True  # type: ignore[attr-defined]
    return module


@cache
def define_operators() -> torch.library.Library:
    """torchvision's operators for this process, from the functions below."""
    library = torch.library.Library("torchvision", "FRAGMENT")
    for schema in _SCHEMAS:
        library.define(schema)
    library.impl("nms", nms, "CompositeExplicitAutograd")
    library.impl("roi_align", roi_align, "CompositeImplicitAutograd")
    return library


def nms(boxes: Tensor, scores: Tensor, iou_threshold: float) -> Tensor:
    """Greedy non-maximum suppression. boxes: (N, 4), x0, y0, x1, y1; scores: (N,).

    Returns the indices kept, by falling score: a box goes where its intersection over union with one kept before
    exceeds the threshold.
    """
    with torch.no_grad():
        order = torch.argsort(scores.float(), descending=True, stable=True)
        sorted_boxes = boxes[order].float()
        area = (sorted_boxes[:, 2:] - sorted_boxes[:, :2]).prod(1)
        low = torch.maximum(sorted_boxes[:, None, :2], sorted_boxes[None, :, :2])
        high = torch.minimum(sorted_boxes[:, None, 2:], sorted_boxes[None, :, 2:])
        both = (high - low).clamp(min=0).prod(-1)
        overlaps = (both > iou_threshold * (area[:, None] + area[None] - both)).cpu().numpy()
        kept: list[int] = []
        gone = torch.zeros(len(order), dtype=torch.bool).numpy()
        for k in range(len(order)):
            if not gone[k]:
                kept.append(k)
                gone |= overlaps[k]
        return order[torch.tensor(kept, dtype=torch.int64, device=order.device)]


def roi_align(
    features: Tensor,
    rois: Tensor,
    spatial_scale: float,
    pooled_height: int,
    pooled_width: int,
    sampling_ratio: int,
    aligned: bool,
) -> Tensor:
    """RoIAlign (Mask R-CNN, He et al. 2017, section 3). features: (B, C, H, W). rois: (K, 5), the picture's number and
    x0, y0, x1, y1. sampling_ratio: points a side in each bin; as many as it spans where that is not positive.

    Returns (K, C, pooled_height, pooled_width), differentiable by the features.
    """
    B, C, H, W = features.shape
    out = features.new_zeros((len(rois), C, pooled_height, pooled_width))
    boxes = rois[:, 1:].float() * spatial_scale - (0.5 if aligned else 0.0)
    size = boxes[:, 2:] - boxes[:, :2]
    size = size if aligned else size.clamp(min=1.0)
    for chosen, across, down in _groups(rois[:, 0].long(), size, pooled_height, pooled_width, sampling_ratio):
        x = _samples(boxes[chosen, 0], size[chosen, 0], pooled_width * across)  # (k, w)
        y = _samples(boxes[chosen, 1], size[chosen, 1], pooled_height * down)
        picture = features[int(rois[chosen[0], 0])]
        values = _bilinear(picture, x, y)  # (C, k, h, w)
        pooled = F.avg_pool2d(values.flatten(0, 1)[None], (down, across))[0]
        pooled = pooled.reshape(C, len(chosen), pooled_height, pooled_width).transpose(0, 1)
        out = out.index_copy(0, chosen, pooled.to(out.dtype))
    return out


def _groups(picture: Tensor, size: Tensor, height: int, width: int, ratio: int) -> list[tuple[Tensor, int, int]]:
    """Regions of one picture with the same number of sampling points: indices, points across and down a bin."""
    keys: dict[tuple[int, int, int], list[int]] = {}
    for k, (number, (w, h)) in enumerate(zip(picture.tolist(), size.tolist(), strict=True)):
        across = ratio if ratio > 0 else max(1, math.ceil(w / width))
        down = ratio if ratio > 0 else max(1, math.ceil(h / height))
        keys.setdefault((number, across, down), []).append(k)
    return [(torch.tensor(found, device=size.device), a, d) for (_, a, d), found in keys.items()]


def _samples(start: Tensor, length: Tensor, count: int) -> Tensor:
    """The middles of ``count`` equal parts of each stretch, (k, count)."""
    return start[:, None] + length[:, None] * (torch.arange(count, device=start.device) + 0.5) / count


def _bilinear(picture: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """picture (C, H, W) at columns x (k, w) and rows y (k, h) -> (C, k, h, w); 0 more than a pixel outside."""
    C, H, W = picture.shape
    k, w, h = len(x), x.shape[1], y.shape[1]
    inside = ((y >= -1) & (y <= H))[:, :, None] & ((x >= -1) & (x <= W))[:, None]
    scale_x, scale_y = 2 / max(W - 1, 1), 2 / max(H - 1, 1)
    grid = torch.stack(
        [(x * scale_x - 1)[:, None].expand(k, h, w), (y * scale_y - 1)[:, :, None].expand(k, h, w)], dim=-1
    )
    values = F.grid_sample(picture[None].float(), grid.reshape(1, k * h, w, 2), padding_mode="border",
                           align_corners=True)  # fmt: skip
    return values.reshape(C, k, h, w) * inside

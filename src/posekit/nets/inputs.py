"""From pictures to network inputs; the only place that does it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from posekit.view import View

if TYPE_CHECKING:
    from torch import Tensor


def to_input(image: NDArray[np.uint8], mask: NDArray[np.bool_] | None) -> NDArray[np.float32]:
    """uint8 RGB (..., H, W, 3) and bool (..., H, W) -> float32 (..., 4, H, W): RGB in [-0.5, 0.5], mask 0 or 1.

    A missing mask is a channel of zeros: the networks are trained to do without.
    """
    out = np.zeros((*image.shape[:-3], 4, *image.shape[-3:-1]), dtype=np.float32)
    out[..., :3, :, :] = np.moveaxis(image, -1, -3) * np.float32(1 / 255) - np.float32(0.5)
    if mask is not None:
        out[..., 3, :, :] = mask
    return out


def relief(rendered: View) -> NDArray[np.float32]:
    """How much farther than the object's mean depth its surface lies, in widths of the crop, (H, W); zero beside the
    object. rendered: a view with depth."""
    assert rendered.depth is not None
    depth = rendered.depth
    on = depth > 0
    if not on.any():
        return np.zeros_like(depth)
    mean = depth[on].mean()
    return np.where(on, (depth / mean - 1) * (rendered.camera.fx / rendered.camera.width), 0).astype(np.float32)


def images_to_tensor(rgbm: Tensor) -> Tensor:
    """uint8 (B, H, W, 3 or 4), alpha = mask (0 or 255) -> float32 (B, 3 or 4, H, W) as ``to_input`` gives it."""
    import torch

    x = rgbm.permute(0, 3, 1, 2).float().div(255.0)
    x[:, :3] -= 0.5
    return x.contiguous(memory_format=torch.channels_last)

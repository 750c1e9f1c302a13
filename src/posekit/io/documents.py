"""Parts of the JSON documents that posekit writes: docs/result-json.md."""

from __future__ import annotations

from typing import Any

from posekit.camera import Camera
from posekit.view import View


def camera_entry(view: View) -> dict[str, Any]:
    """``camera``: the undistorted camera that poses, boxes and masks belong to, and the one that took the picture."""
    entry, lens = _intrinsics(view.camera), view.lens
    if lens is not None:
        taken = _intrinsics(lens.camera)
        entry["undistorted_from"] = taken | {
            "model": lens.model,
            "distortion_coefficients": [float(v) for v in lens.coefficients],
        }
    return entry


def _intrinsics(camera: Camera) -> dict[str, Any]:
    return {"K": camera.K.tolist(), "width": camera.width, "height": camera.height}

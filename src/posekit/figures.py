"""What an estimate looks like: the overlay and the strip of its refinement. Layer 3."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from posekit import draw
from posekit.draw import Image
from posekit.geometry import Pose
from posekit.object_model import ObjectModel
from posekit.render import Renderer
from posekit.results import Detection, Estimate
from posekit.view import View
from posekit.zoom import zoom_to_box

_SIDES = (640, 1600)  # pixels, limits of the overlay's longer side, whatever the photograph's is
_ITERATIONS = 2  # tiles of the strip between the first and the final pose
_CONTEXT = 1.3  # a tile shows this many boxes


def overlay(renderer: Renderer, model: ObjectModel, view: View, estimates: Sequence[Estimate]) -> Image:
    """The photograph with each estimate's contour, axes and box; below it, a strip for each."""
    shown = _display_size(view)
    scale = shown.camera.width / view.camera.width
    picture = shown.image
    for estimate in estimates:
        [drawn] = renderer.render(model, [estimate.T_cam_obj], shown.camera, rgb=False, coords=False)
        assert drawn.mask is not None
        x0, y0, x1, y1 = (scale * v for v in _given_box(estimate))
        picture = draw.box(picture, (x0, y0, x1, y1))
        picture = draw.contour(picture, drawn.mask)
        picture = draw.axes(picture, shown.camera, estimate.T_cam_obj, 0.6 * float(model.extents.max()), model.center)
    width = max(_SIDES[0], picture.shape[1])
    strips = [strip(renderer, model, view, estimate, width) for estimate in estimates]
    return draw.stack([picture, *strips])


def detections_overlay(view: View, detections: Sequence[Detection]) -> Image:
    """The photograph with each detection's outline and box, and a line that names them, best first."""
    shown = _display_size(view)
    scale = shown.camera.width / view.camera.width
    picture = shown.image
    for found in detections:
        if found.mask is not None:
            picture = draw.contour(picture, draw.fit(found.mask.astype(np.uint8), shown.camera.size) > 0)
        x0, y0, x1, y1 = (scale * v for v in found.box)
        picture = draw.box(picture, (x0, y0, x1, y1))
    names = ", ".join(f"{d.label or 'object'} {d.score:.2f}" for d in detections[:8])
    return draw.caption(picture, names or "nothing found")


def strip(renderer: Renderer, model: ObjectModel, view: View, estimate: Estimate, width: int) -> Image:
    """Crop, first pose, iterations and final pose in one row of ``width`` pixels, with the predicted errors."""
    titles, poses = _chosen_steps(estimate)
    size = draw.strip_tile(1 + len(poses), width)
    zoom = zoom_to_box(view.camera, estimate.box, size, enlarge=_CONTEXT)
    crop = view.with_mask(None).zoomed(zoom)
    turned = [Pose.rotation(zoom.R_view_cam) @ pose for pose in poses]
    tiles = [crop.image]
    for drawn in renderer.render(model, turned, zoom.camera, rgb=False, coords=False):
        assert drawn.mask is not None
        tiles.append(draw.contour(crop.image, drawn.mask))
    return draw.strip(tiles, ["crop", *titles], width)


def _chosen_steps(estimate: Estimate) -> tuple[list[str], list[Pose]]:
    """Titles and poses: the first of the trace, a few evenly spread ones after it, and the final pose."""
    later = range(1, len(estimate.trace))
    chosen = later if len(later) <= _ITERATIONS else [int(k) for k in np.linspace(0, len(later), _ITERATIONS + 2)[1:-1]]
    kept = [0, *chosen] if estimate.trace else []
    titles = [f"{f'step {k}' if k else 'first'}: {np.rad2deg(estimate.trace[k].angle):.1f} deg" for k in kept]
    poses = [estimate.trace[k].T_cam_obj for k in kept]
    return [*titles, f"final: {np.rad2deg(estimate.angle):.1f} deg"], [*poses, estimate.T_cam_obj]


def _given_box(estimate: Estimate) -> tuple[float, float, float, float]:
    """Where the object was said to be, else where it was found to be."""
    return estimate.detection.box if estimate.detection is not None else estimate.box


def _display_size(view: View) -> View:
    """The view without its mask, scaled to suit a screen."""
    longer = max(view.camera.size)
    scale = float(np.clip(longer, *_SIDES)) / longer
    if scale == 1.0:
        return view.with_mask(None)
    size = (max(1, round(scale * view.camera.width)), max(1, round(scale * view.camera.height)))
    return View(draw.fit(view.image, size), view.camera.resized(*size))

"""What an estimate looks like: the overlay and the strip of its refinement."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from posekit.camera import Box, Camera
from posekit.geometry import Pose
from posekit.mesh.model import ObjectModel
from posekit.render import Renderer
from posekit.results import Detection, Estimate, angle_in_words
from posekit.view import View
from posekit.visualise import draw
from posekit.visualise.draw import Colour, Image
from posekit.zoom import zoom_to_box

_SIDES = (640, 1600)  # pixels, limits of the overlay's longer side, whatever the photograph's is
_ITERATIONS = 2  # tiles of the strip between the first and the final pose
_CONTEXT = 1.3  # a tile shows this many boxes
_FINE = 4  # silhouettes are drawn so many times as fine as the picture, for a smooth line
_TILES = (236, 480)  # pixels, sides of the enlarged crops beside the picture
_STRIP_TILE = 240  # pixels, greatest width of a tile of the strip
_AXIS = 0.6  # length of the axes, of the mesh's longest side


def overlay(
    renderer: Renderer, view: View, results: Sequence[tuple[ObjectModel, Estimate]], blend: float = 0.0
) -> Image:
    """The photograph with every estimate's contour, axes, box and name; beside it each object enlarged, with score and
    expected error; below, the way from its first pose. Red is what is not reliable, orange what was given.

    blend: how much of the rendered mesh is mixed in, 0 to 1.
    """
    shown = _display_size(view)
    scale = shown.camera.width / view.camera.width
    picture = shown.image
    if not results:
        return picture
    for model, estimate in results:
        picture = draw.box(picture, _scaled(_given_box(estimate), scale))
        picture = _object_in(renderer, picture, shown.camera, model, estimate.T_cam_obj, _colour(estimate), blend)
    for _, estimate in results:
        x0, y0, *_ = _scaled(estimate.box, scale)
        text = estimate.model if estimate.reliable else f"{estimate.model}: NOT RELIABLE"
        picture = draw.label(picture, text, (x0, y0 - 4), _colour(estimate))
    side = int(np.clip((picture.shape[0] + draw.GAP) // len(results) - draw.GAP, *_TILES))
    picture = draw.beside(picture, [_enlarged(renderer, view, *each, side, blend) for each in results])
    strips = [strip(renderer, model, view, estimate, picture.shape[1]) for model, estimate in results]
    return draw.stack([picture, *strips])


def outlined(
    renderer: Renderer, image: Image, camera: Camera, model: ObjectModel, T_cam_obj: Pose, colour: Colour = draw.GREEN
) -> Image:
    """A picture with the outline that a mesh has in this pose: the silhouette's outermost pixels."""
    points = T_cam_obj.apply(model.hull_vertices)
    points[:, 2] = np.maximum(points[:, 2], 1e-3)
    x0, y0, x1, y1 = camera.points_box(points)
    left, top = max(0, math.floor(x0) - 3), max(0, math.floor(y0) - 3)  # room for the rim
    width, height = min(camera.width, math.ceil(x1) + 3) - left, min(camera.height, math.ceil(y1) + 3) - top
    if width < 1 or height < 1:
        return image.copy()
    part = camera.cropped(left, top, width, height).resized(_FINE * width, _FINE * height)
    [drawn] = renderer.render(model, [T_cam_obj], part, rgb=False, coords=False)
    assert drawn.mask is not None
    return draw.contour(image, drawn.mask, colour, fine=_FINE, corner=(left, top))


def _object_in(
    renderer: Renderer,
    picture: Image,
    camera: Camera,
    model: ObjectModel,
    T_cam_obj: Pose,
    colour: Colour,
    blend: float,
) -> Image:
    if blend > 0:
        [drawn] = renderer.render(model, [T_cam_obj], camera, coords=False)
        assert drawn.mask is not None
        picture = draw.blend(picture, drawn.image, drawn.mask, blend)
    picture = outlined(renderer, picture, camera, model, T_cam_obj, colour)
    return draw.axes(picture, camera, T_cam_obj, _AXIS * float(model.extents.max()), model.center)


def _enlarged(renderer: Renderer, view: View, model: ObjectModel, estimate: Estimate, side: int, blend: float) -> Image:
    """The object in a square of ``side`` pixels, and what there is to know about it."""
    text = draw.lines(
        [
            f"{estimate.model}: {'reliable' if estimate.reliable else 'NOT RELIABLE'}",
            f"rotation error {angle_in_words(estimate.angle_deg)}",
            f"score {estimate.score:.2f} of 1, distance {estimate.T_cam_obj.t[2]:.2f} m",
        ],
        side,
        _colour(estimate),
    )
    zoom = zoom_to_box(view.camera, estimate.box, (side, side - len(text)), enlarge=_CONTEXT)
    crop = view.with_mask(None).zoomed(zoom)
    pose = Pose.rotation(zoom.R_view_cam) @ estimate.T_cam_obj
    picture = _object_in(renderer, crop.image, zoom.camera, model, pose, _colour(estimate), blend)
    return draw.stack([text, picture], gap=0)


def _colour(estimate: Estimate) -> Colour:
    return draw.GREEN if estimate.reliable else draw.RED


def _scaled(box: Box, scale: float) -> Box:
    x0, y0, x1, y1 = (scale * v for v in box)
    return x0, y0, x1, y1


def detections_overlay(view: View, detections: Sequence[Detection]) -> Image:
    """The photograph with each detection's outline and box, and a line that names them, best first."""
    shown = _display_size(view)
    scale = shown.camera.width / view.camera.width
    picture = shown.image
    for found in detections:
        if found.mask is not None:
            picture = draw.contour(picture, draw.fit(found.mask.astype(np.uint8), shown.camera.size) > 0)
        picture = draw.box(picture, _scaled(found.box, scale))
    names = ", ".join(f"{d.label or 'object'} {d.score:.2f}" for d in detections[:8])
    return draw.caption(picture, names or "nothing found")


def strip(renderer: Renderer, model: ObjectModel, view: View, estimate: Estimate, width: int) -> Image:
    """Crop, first pose, iterations and final pose in one row, ``width`` pixels at most, with the predicted errors."""
    titles, poses = _chosen_steps(estimate)
    width = min(width, _STRIP_TILE * (1 + len(poses)))
    size = draw.strip_tile(1 + len(poses), width)
    zoom = zoom_to_box(view.camera, estimate.box, size, enlarge=_CONTEXT)
    crop = view.with_mask(None).zoomed(zoom)
    turned = [Pose.rotation(zoom.R_view_cam) @ pose for pose in poses]
    colour = _colour(estimate)
    tiles = [outlined(renderer, crop.image, zoom.camera, model, pose, colour) for pose in turned]
    return draw.strip([crop.image, *tiles], [estimate.model, *titles], width)


def _chosen_steps(estimate: Estimate) -> tuple[list[str], list[Pose]]:
    """Titles and poses: the first of the trace, a few evenly spread ones after it, and the final pose."""
    later = range(1, len(estimate.trace))
    chosen = later if len(later) <= _ITERATIONS else [int(k) for k in np.linspace(0, len(later), _ITERATIONS + 2)[1:-1]]
    kept = [0, *chosen] if estimate.trace else []
    titles = [f"{f'step {k}' if k else 'first'}: {estimate.trace[k].angle_deg:.1f} degrees" for k in kept]
    poses = [estimate.trace[k].T_cam_obj for k in kept]
    return [*titles, f"final: {estimate.angle_deg:.1f} degrees"], [*poses, estimate.T_cam_obj]


def _given_box(estimate: Estimate) -> Box:
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

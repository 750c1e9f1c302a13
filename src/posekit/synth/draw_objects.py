"""Objects drawn together: colours, depth, and each one's whole and visible mask."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera, mask_box
from posekit.datasets.bop_writer import Annotation
from posekit.geometry import Pose
from posekit.mesh.model import ObjectModel
from posekit.render import Light, Renderer
from posekit.synth.canvas import Canvas, overlap, tile

TILES = (64, 128, 256, 512, 1024)  # sides of the pictures in which single objects are drawn, pixels

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Placed:
    """An object before the camera. obj_id: None for what is not annotated."""

    obj_id: int | None
    model: ObjectModel
    T_cam_obj: Pose


@dataclass(frozen=True, eq=False)
class Drawn:
    """image: uint8 (H, W, 3), what was given behind the objects. depth: float32 (H, W), 0 = none of them.
    annotations: of the objects with an obj_id whose silhouette meets the picture."""

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    annotations: list[Annotation]


@dataclass(frozen=True, eq=False)
class _Layer:
    """One object alone. left, top: of its tile in the picture."""

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    mask: Mask
    left: int
    top: int


def draw_objects(
    renderer: Renderer, objects: Sequence[Placed], camera: Camera, light: Light, backdrop: NDArray[np.uint8],
    behind: NDArray[np.float32] | None = None,
) -> Drawn:  # fmt: skip
    """Draw objects before a backdrop (H, W, 3), the nearest in front. behind: the backdrop's depth, 0 = far away."""
    canvas = Canvas(backdrop.copy(), behind)
    layers = [_layer(renderer, o, camera, light) for o in objects]
    for k, layer in enumerate(layers, 1):
        canvas.paste(layer.image, layer.mask, layer.depth, k, layer.left, layer.top)
    canvas.smooth_edges()
    found = []
    for k, (placed, layer) in enumerate(zip(objects, layers, strict=True), 1):
        if placed.obj_id is not None:
            annotation = _annotation(placed.obj_id, placed.T_cam_obj, layer, canvas.labels == k)
            found += [annotation] if annotation.mask.any() else []
    return Drawn(canvas.image, canvas.depth, found)


def _layer(renderer: Renderer, placed: Placed, camera: Camera, light: Light) -> _Layer:
    """Its whole silhouette, outside the picture too, where the largest tile can hold it."""
    points = placed.T_cam_obj.apply(placed.model.hull_vertices)
    found = tile(camera, points, TILES) if points[:, 2].min() > 1e-3 else None
    part, left, top = found or (camera, 0, 0)
    [view] = renderer.render(placed.model, [placed.T_cam_obj], part, light=light)
    assert view.depth is not None and view.mask is not None
    return _Layer(view.image, view.depth, view.mask, left, top)


def annotate(renderer: Renderer, placed: Placed, camera: Camera, visible: Mask) -> Annotation:
    """An object whose visible mask (H, W) is known: its whole silhouette is drawn."""
    assert placed.obj_id is not None
    return _annotation(placed.obj_id, placed.T_cam_obj, _layer(renderer, placed, camera, Light.flat()), visible)


def _annotation(obj_id: int, pose: Pose, layer: _Layer, visible: Mask) -> Annotation:
    H, W = visible.shape
    here, there = overlap((W, H), layer.left, layer.top, (layer.mask.shape[1], layer.mask.shape[0]))
    mask = np.zeros((H, W), bool)
    mask[here] = layer.mask[there]
    box = mask_box(layer.mask)
    if box is not None:
        box = (box[0] + layer.left, box[1] + layer.top, box[2] + layer.left, box[3] + layer.top)
    return Annotation(obj_id, pose, mask, visible, pixels=int(layer.mask.sum()), box=box)

"""Objects drawn together: colours, depth, and each one's whole and visible mask."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera, mask_box
from posekit.datasets.bop_writer import Annotation
from posekit.geometry import Pose
from posekit.mesh.model import ObjectModel
from posekit.render import Light, Renderer

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
    image, H, W = backdrop.copy(), camera.height, camera.width
    depth = np.full((H, W), np.inf, np.float32) if behind is None else np.where(behind > 0, behind, np.inf)
    owner = np.full((H, W), -1, np.int32)
    layers = [_layer(renderer, o, camera, light) for o in objects]
    for k, layer in enumerate(layers):
        here, there = _overlap(layer, W, H)
        nearer = layer.mask[there] & (layer.depth[there] < depth[here])
        image[here][nearer] = layer.image[there][nearer]
        depth[here][nearer] = layer.depth[there][nearer]
        owner[here][nearer] = k
    _soften(image, owner)
    found = []
    for k, (placed, layer) in enumerate(zip(objects, layers, strict=True)):
        if placed.obj_id is not None:
            annotation = _annotation(placed.obj_id, placed.T_cam_obj, layer, owner == k)
            found += [annotation] if annotation.mask.any() else []
    return Drawn(image, np.where(np.isfinite(depth), depth, 0).astype(np.float32), found)


def _layer(renderer: Renderer, placed: Placed, camera: Camera, light: Light) -> _Layer:
    """Its whole silhouette, outside the picture too, where the largest tile can hold it."""
    points = placed.T_cam_obj.apply(placed.model.hull_vertices)
    left = top = 0
    tile = camera
    if points[:, 2].min() > 1e-3:
        x0, y0, x1, y1 = camera.points_box(points)
        side = next((s for s in TILES if s >= max(x1 - x0, y1 - y0) + 2), None)
        if side is not None:
            left, top = (int(np.floor(0.5 * (low + high - side))) for low, high in ((x0, x1), (y0, y1)))
            tile = camera.cropped(left, top, side, side)
    [view] = renderer.render(placed.model, [placed.T_cam_obj], tile, light=light)
    assert view.depth is not None and view.mask is not None
    return _Layer(view.image, view.depth, view.mask, left, top)


def annotate(renderer: Renderer, placed: Placed, camera: Camera, visible: Mask) -> Annotation:
    """An object whose visible mask (H, W) is known: its whole silhouette is drawn."""
    assert placed.obj_id is not None
    return _annotation(placed.obj_id, placed.T_cam_obj, _layer(renderer, placed, camera, Light.flat()), visible)


def _overlap(layer: _Layer, W: int, H: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """The part of the picture that a layer covers, and the same part of the layer."""
    h, w = layer.mask.shape
    x0, x1 = (min(max(v, 0), W) for v in (layer.left, layer.left + w))
    y0, y1 = (min(max(v, 0), H) for v in (layer.top, layer.top + h))
    there = slice(y0 - layer.top, y1 - layer.top), slice(x0 - layer.left, x1 - layer.left)
    if x0 >= x1 or y0 >= y1:
        return (slice(0, 0), slice(0, 0)), (slice(0, 0), slice(0, 0))
    return (slice(y0, y1), slice(x0, x1)), there


def _annotation(obj_id: int, pose: Pose, layer: _Layer, visible: Mask) -> Annotation:
    H, W = visible.shape
    here, there = _overlap(layer, W, H)
    mask = np.zeros((H, W), bool)
    mask[here] = layer.mask[there]
    box = mask_box(layer.mask)
    if box is not None:
        box = (box[0] + layer.left, box[1] + layer.top, box[2] + layer.left, box[3] + layer.top)
    return Annotation(obj_id, pose, mask, visible, pixels=int(layer.mask.sum()), box=box)


def _soften(image: NDArray[np.uint8], owner: NDArray[np.int32]) -> None:
    """Mix colours across outlines as a lens does, in place."""
    edge = np.zeros(owner.shape, bool)
    across, down = owner[:, 1:] != owner[:, :-1], owner[1:] != owner[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    image[edge] = cv2.GaussianBlur(image, (3, 3), 0.7)[edge]

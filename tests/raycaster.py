"""The renderer's slow and exact twin: one ray through each pixel's centre against every triangle, in NumPy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.geometry import Pose
from posekit.mesh.model import ObjectModel

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Cast:
    """mask bool (H, W); depth (H, W) metres; coords (H, W, 3) metres, obj; colors (H, W, 3) in 0..255, unlit."""

    mask: NDArray[np.bool_]
    depth: Array
    coords: Array
    colors: Array


def cast(model: ObjectModel, T_view_obj: Pose, camera: Camera) -> Cast:
    """What ``Renderer.render`` must draw of a model with vertex colours."""
    vertices = model.vertices.astype(np.float64)
    rays = camera.backproject(camera.pixel_grid()).reshape(-1, 3) @ T_view_obj.R  # into obj; z along the view is 1
    eye = T_view_obj.inverse().t
    depth = np.full(len(rays), np.inf)
    coords, colors = np.zeros((len(rays), 3)), np.zeros((len(rays), 3))
    for face in model.faces:
        t, weights = _intersect(eye, rays, vertices[face])
        nearer = t < depth
        depth[nearer] = t[nearer]
        coords[nearer] = eye + t[nearer, None] * rays[nearer]
        if model.colors is not None:
            colors[nearer] = weights[nearer] @ model.colors[face, :3].astype(np.float64)
    size = camera.height, camera.width
    mask = np.isfinite(depth).reshape(size)
    return Cast(mask, np.where(mask, depth.reshape(size), 0), coords.reshape(*size, 3), colors.reshape(*size, 3))


def _intersect(eye: Array, rays: Array, triangle: Array) -> tuple[Array, Array]:
    """Moeller and Trumbore: distances (N,) along rays (N, 3), inf for a miss, and barycentric weights (N, 3)."""
    a, ab, ac = triangle[0], triangle[1] - triangle[0], triangle[2] - triangle[0]
    p = np.cross(rays, ac)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / (p @ ab)
        u = p @ (eye - a) * scale
        q = np.cross(eye - a, ab)
        v = rays @ q * scale
        t = ac @ q * scale
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    return np.where(hit, t, np.inf), np.stack([1 - u - v, u, v], axis=1)

"""Meshes and a camera that many tests use."""

from __future__ import annotations

import numpy as np

from posekit.camera import Camera
from posekit.mesh.model import ObjectModel

CAMERA = Camera(572.4, 573.6, 325.3, 242.0, 640, 480)  # off its axis, fx != fy


def cuboid(low: tuple[float, float, float], high: tuple[float, float, float], cells: int = 1):  # type: ignore[no-untyped-def]
    """Vertices (V, 3) and faces (F, 3) of a box, each side of cells x cells quadrilaterals with their own vertices."""
    t = np.linspace(0, 1, cells + 1)
    u, v = (g.ravel() for g in np.meshgrid(t, t, indexing="ij"))
    index = np.arange(len(u)).reshape(cells + 1, cells + 1)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    side_faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    vertices, faces = [], []
    for axis in range(3):
        for end in (0.0, 1.0):
            side = np.insert(np.stack([u, v], 1), axis, end, axis=1)
            vertices.append(side)
            faces.append(side_faces + len(u) * (len(vertices) - 1))
    return np.asarray(low) + np.concatenate(vertices) * (np.asarray(high) - low), np.concatenate(faces)


def bracket(offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> ObjectModel:
    """An asymmetric bracket of three coloured arms, about 0.12 m, its origin wherever ``offset`` puts it."""
    arms = [
        ((0.0, 0.0, 0.0), (0.10, 0.02, 0.02), (220, 40, 40)),
        ((-0.004, -0.003, -0.002), (0.024, 0.07, 0.03), (40, 200, 60)),
        ((-0.002, -0.005, -0.004), (0.03, 0.017, 0.055), (50, 80, 230)),
        ((0.082, -0.002, -0.003), (0.104, 0.045, 0.015), (230, 210, 40)),
    ]
    vertices, faces, colours, count = [], [], [], 0
    for low, high, colour in arms:
        v, f = cuboid(low, high, cells=6)
        shade = 0.6 + 0.4 * ((np.round(v / 0.01).sum(1) % 2) == 0)
        vertices.append(v)
        faces.append(f + count)
        colours.append(shade[:, None] * colour)
        count += len(v)
    return ObjectModel.from_arrays(
        (np.concatenate(vertices) + offset).astype(np.float32),
        np.concatenate(faces).astype(np.int32),
        name="bracket",
        colors=np.concatenate(colours).astype(np.uint8),
    )

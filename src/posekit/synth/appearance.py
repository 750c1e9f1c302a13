"""Meshes whose appearance differs from the real object's: CAD files have no colours, scans have few, paint and labels
differ.

A refiner must not trust the mesh's appearance, so in a part of the training pairs the rendered and the observed side
show two variants of one mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from posekit.mesh.model import ObjectModel
from posekit.mesh.processing import coincident, smooth_normals, subdivided
from posekit.synth.procedural import random_colour, random_texture

Image = NDArray[np.uint8]
Rng = np.random.Generator

WASHED_OUT = ("plain", "one colour", "washed out", "vertex colours")  # what `washed_out` makes
KINDS = (*WASHED_OUT, "other paint")
SHARES = (0.4, 0.12, 0.12, 0.16, 0.2)
SCAN_EDGE, SCAN_FACES = 1 / 20, 12_000  # `scanned`: longest mean edge in diameters, most faces after subdivision


def variants(
    model: ObjectModel, photos: Sequence[Image], share: float, deformed: float, rng: Rng, scans: float = 0.0
) -> tuple[ObjectModel, ObjectModel]:
    """The mesh that is rendered and the one that is observed; in ``1 - share`` of the cases they look the same.

    The rendered one is plain grey, of one colour, washed out or has the texture's colours at its vertices only, or the
    observed one has another paint; in a tenth of these cases the two are exchanged. deformed: the share of rendered
    meshes whose surface is deformed smoothly by up to 0.5 % of the diameter. scans: the share of rendered meshes that
    are a scan of the observed one, see `scanned`. photos: to cut textures from.
    """
    rendered = observed = model
    if rng.random() < share:
        kind = KINDS[int(rng.choice(len(KINDS), p=SHARES))]
        if kind == "other paint":
            observed = painted(model, photos, rng)
            if rng.random() < 0.5:
                rendered = replace(model, texture=None, uvs=None, colors=None)
        else:
            rendered = washed_out(model, kind, rng)
            if model.texture is None and model.colors is None:
                observed = painted(model, photos, rng)
        if rng.random() < 0.1:
            rendered, observed = observed, rendered
    drawn = rng.random()
    if drawn < deformed:
        rendered = deformed_mesh(rendered, rng)
    elif drawn < deformed + scans:
        rendered = scanned(rendered, rng)
    return rendered, observed


def vertex_colours(model: ObjectModel) -> Image:
    """uint8 (V, 3): the mesh's colours at its vertices, from its texture where it has one; grey where it has none."""
    if model.texture is not None and model.uvs is not None:
        h, w = model.texture.shape[:2]
        column = np.floor(model.uvs[:, 0] % 1.0 * w).astype(int).clip(0, w - 1)
        row = np.floor((1 - model.uvs[:, 1] % 1.0) * h).astype(int).clip(0, h - 1)
        return np.asarray(model.texture[row, column, :3], np.uint8)
    if model.colors is not None:
        return model.colors
    return np.full((len(model.vertices), 3), 153, np.uint8)


def washed_out(model: ObjectModel, kind: str, rng: Rng) -> ObjectModel:
    """The mesh with less colour than it has. kind: "plain", "one colour", "washed out" or "vertex colours"."""
    if kind == "plain":
        return replace(model, texture=None, uvs=None, colors=None)
    colours = vertex_colours(model).astype(np.float32)
    if kind == "one colour":
        chosen = colours.mean(0) if rng.random() < 0.5 else random_colour(rng)
        colours = np.broadcast_to(chosen, colours.shape)
    elif kind == "washed out":
        grey = colours.mean(1, keepdims=True)
        colours = grey + (colours - grey) * np.float32(rng.uniform(0.0, 0.6))
        colours = 128 + (colours - 128) * np.float32(rng.uniform(0.3, 0.9)) + np.float32(rng.normal() * 25)
    return replace(model, texture=None, uvs=None, colors=np.clip(colours, 0, 255).astype(np.uint8))


def painted(model: ObjectModel, photos: Sequence[Image], rng: Rng) -> ObjectModel:
    """The mesh with a new texture, laid on by its own texture coordinates or along an axis through it."""
    uvs = model.uvs
    if uvs is None:
        points = (model.vertices - model.vertices.min(0)) / max(float(np.ptp(model.vertices, axis=0).max()), 1e-9)
        R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        uvs = ((points @ R)[:, :2] * rng.uniform(0.5, 2.0)).astype(np.float32)
    return replace(model, colors=None, uvs=uvs, texture=random_texture(rng, photos))


def deformed_mesh(model: ObjectModel, rng: Rng) -> ObjectModel:
    """The mesh with its vertices moved by smooth waves of up to 0.5 % of the diameter."""
    points = model.vertices.astype(np.float64) / model.diameter
    waves = np.sin(points @ (rng.normal(size=(3, 3)) * 8.0) + rng.uniform(0, 6, size=3))
    return replace(model, vertices=(model.vertices + 0.005 * model.diameter * waves).astype(np.float32))


def scanned(model: ObjectModel, rng: Rng) -> ObjectModel:
    """The mesh as a scan with a depth camera shows it.

    Edges are rounded, the surface is wavy by up to about 1 % of the diameter, the size is up to 1 % wrong, the colours
    are those of vertices, blurred and with the light of the scan in them; and what lay below may be flat or missing.
    """
    points, faces, colours = _fine(model)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    for _ in range(int(rng.integers(0, 4))):
        points = _averaged(points, edges)
    for frequency in (8.0, 25.0):
        waves = np.sin(points / model.diameter @ (rng.normal(size=(3, 3)) * frequency) + rng.uniform(0, 6, size=3))
        points = points + model.diameter * np.exp(rng.uniform(np.log(0.0005), np.log(0.006))) * waves
    points = model.center + (points - model.center) * (1 + rng.uniform(-0.01, 0.01))
    if rng.random() < 0.35:
        points, faces = _without_bottom(points, faces, rng)
    sources, faces, normals = smooth_normals(points, faces)
    paint = None
    if colours is not None:
        for _ in range(int(rng.integers(0, 3))):
            colours = _averaged(colours, edges)
        colours = colours[sources]
        toward = rng.normal(size=3)
        light = np.clip(normals @ (toward / np.linalg.norm(toward)), 0, 1)
        colours = colours * (1 + rng.uniform(0, 0.5) * (light[:, None] - 0.5)) * rng.uniform(0.7, 1.15)
        paint = np.clip(colours, 0, 255).astype(np.uint8)
    return replace(
        model, vertices=points[sources].astype(np.float32), faces=faces.astype(np.int32),
        normals=normals.astype(np.float32), colors=paint, uvs=None, texture=None,
    )  # fmt: skip


def _fine(model: ObjectModel) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64] | None]:
    """Vertices (V, 3), faces (F, 3) and colours (V, 3), or None, of the mesh with each place once and short edges."""
    painted = model.texture is not None or model.colors is not None
    attributes = {"uv": model.uvs} if model.uvs is not None else {}
    if model.colors is not None:
        attributes["colour"] = model.colors.astype(np.float32)
    vertices, faces = model.vertices, model.faces
    while len(faces) * 4 <= SCAN_FACES and _mean_edge(vertices, faces) > SCAN_EDGE * model.diameter:
        vertices, faces, attributes = subdivided(vertices, faces, attributes)
    split = replace(
        model, vertices=vertices, faces=faces, uvs=attributes.get("uv"),
        colors=attributes["colour"].astype(np.uint8) if "colour" in attributes else None,
    )  # fmt: skip
    places = coincident(vertices.astype(np.float64))
    _, first, place = np.unique(places, return_index=True, return_inverse=True)
    colours = vertex_colours(split)[first].astype(np.float64) if painted else None
    joined = place[faces].astype(np.int64)
    whole = (joined[:, 0] != joined[:, 1]) & (joined[:, 1] != joined[:, 2]) & (joined[:, 2] != joined[:, 0])
    return vertices[first].astype(np.float64), joined[whole], colours


def _mean_edge(vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> float:
    return float(np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1).mean())


def _averaged(values: NDArray[np.float64], edges: NDArray[np.int64]) -> NDArray[np.float64]:
    """Each vertex's values (V, C) halfway to the mean of its neighbours'."""
    count = np.bincount(edges.ravel(), minlength=len(values))[:, None]
    total = np.zeros_like(values)
    for a, b in (edges.T, edges.T[::-1]):
        for c in range(values.shape[1]):
            total[:, c] += np.bincount(a, weights=values[b, c], minlength=len(values))
    return np.where(count > 0, 0.5 * values + 0.5 * total / np.maximum(count, 1), values)


def _without_bottom(
    points: NDArray[np.float64], faces: NDArray[np.int64], rng: Rng
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """What lies beyond a plane near one end is laid flat onto it, or left out."""
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    height = points @ axis
    level = height.min() + rng.uniform(0.01, 0.08) * np.ptp(height)
    if rng.random() < 0.5:
        return points + np.maximum(level - height, 0)[:, None] * axis, faces
    kept = (height[faces] >= level).any(1)
    return (points, faces[kept]) if kept.any() else (points, faces)

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
from posekit.synth.procedural import random_colour, random_texture

Image = NDArray[np.uint8]
Rng = np.random.Generator

WASHED_OUT = ("plain", "one colour", "washed out", "vertex colours")  # what `washed_out` makes
KINDS = (*WASHED_OUT, "other paint")
SHARES = (0.4, 0.12, 0.12, 0.16, 0.2)


def variants(
    model: ObjectModel, photos: Sequence[Image], share: float, deformed: float, rng: Rng
) -> tuple[ObjectModel, ObjectModel]:
    """The mesh that is rendered and the one that is observed; in ``1 - share`` of the cases they look the same.

    The rendered one is plain grey, of one colour, washed out or has the texture's colours at its vertices only, or the
    observed one has another paint; in a tenth of these cases the two are exchanged. deformed: the share of rendered
    meshes whose surface is deformed smoothly by up to 0.5 % of the diameter. photos: to cut textures from.
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
    if rng.random() < deformed:
        rendered = deformed_mesh(rendered, rng)
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

"""The parts of a mesh file made one mesh with one texture."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from posekit.errors import MeshError

log = logging.getLogger("posekit")

PLAIN = (153, 153, 153)  # the renderer's colour where a mesh has none
_TEXTURE_LIMIT = 8192  # pixels, the longer side that any OpenGL takes

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Part:
    """A mesh of one material, in the scene's place. Fields as ObjectModel's, in the file's units."""

    vertices: Floats
    faces: NDArray[np.int64]
    normals: Floats | None = None
    colors: NDArray[np.uint8] | None = None
    uvs: Floats | None = None
    texture: NDArray[np.uint8] | None = None


def merge(parts: list[Part], label: str) -> Part:
    """One mesh out of a file's parts."""
    if any(part.texture is not None for part in parts):
        parts = _on_one_texture(parts, label)
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    colors = None
    if any(part.colors is not None for part in parts):
        plain = np.asarray(PLAIN, dtype=np.uint8)
        colors = np.concatenate([np.tile(plain, (len(p.vertices), 1)) if p.colors is None else p.colors for p in parts])
    normals = [part.normals for part in parts if part.normals is not None]
    uvs = [part.uvs for part in parts if part.uvs is not None]
    return Part(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)]),
        np.concatenate(normals) if len(normals) == len(parts) else None,
        colors if parts[0].texture is None else None,
        np.concatenate(uvs) if len(uvs) == len(parts) else None,
        parts[0].texture,
    )


def _on_one_texture(parts: list[Part], label: str) -> list[Part]:
    """Parts that share one texture: the one they have, or an atlas of their textures and plain colours."""
    pictures: dict[tuple[Any, ...], NDArray[np.uint8]] = {}
    keys = []
    for part in parts:
        tile = part.texture if part.texture is not None else _plain_tile(part, label)
        reach = _reach(part, label)
        keys.append((tile.shape, tile.tobytes(), *reach))
        pictures[keys[-1]] = tile
    if len({key[:2] for key in keys}) == 1 and all(part.uvs is not None for part in parts):
        return [replace(part, texture=_limited(pictures[keys[0]], label)) for part in parts]
    repeated = {key: _tiled(tile, key[4] - key[2], key[5] - key[3]) for key, tile in pictures.items()}
    places, atlas = _atlas(repeated, label)
    placed = []
    for part, key in zip(parts, keys, strict=True):
        x0, y0, x1, y1 = places[key]
        low, high = np.array(key[2:4]), np.array(key[4:6])
        uvs = np.full((len(part.vertices), 2), 0.5) if part.uvs is None else (part.uvs - low) / (high - low)
        corner, size = np.array([x0, 1 - y1]), np.array([x1 - x0, y1 - y0])  # v points up, rows down
        placed.append(replace(part, uvs=corner + uvs * size, texture=atlas, colors=None))
    return placed


def _plain_tile(part: Part, label: str) -> NDArray[np.uint8]:
    colors = np.array([PLAIN], dtype=np.uint8) if part.colors is None else np.unique(part.colors, axis=0)
    if len(colors) > 1:
        raise MeshError(
            f"{label} has parts with a texture and parts with vertex colours: bake them into one texture, "
            "or give all of them vertex colours."
        )
    return np.tile(colors[0], (8, 8, 1))


def _reach(part: Part, label: str) -> tuple[int, int, int, int]:
    """The whole repeats of its texture that a part covers: lower u, v and upper u, v."""
    if part.uvs is None:
        return 0, 0, 1, 1
    if not np.isfinite(part.uvs).all():
        raise MeshError(f"{label} has texture coordinates that are NaN or infinite: export it again.")
    low = np.floor(part.uvs.min(axis=0) + 1e-4).astype(int)
    high = np.maximum(np.ceil(part.uvs.max(axis=0) - 1e-4).astype(int), low + 1)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _tiled(tile: NDArray[np.uint8], across: int, up: int) -> NDArray[np.uint8]:
    """A texture repeated; shrunk first where the repeats would need too many pixels."""
    height, width = tile.shape[:2]
    shrink = min(1.0, 4096 / (across * width), 4096 / (up * height))
    if shrink < 1:
        tile = _resized(tile, shrink)
    return np.tile(tile, (min(up, 4096), min(across, 4096), 1))


def _atlas(
    tiles: dict[tuple[Any, ...], NDArray[np.uint8]], label: str
) -> tuple[dict[tuple[Any, ...], tuple[float, float, float, float]], NDArray[np.uint8]]:
    """Pictures on one, in rows, each with a rim of its own edge's colours against bleeding.

    Returns the edges of each, (x0, y0, x1, y1) in fractions of the atlas, rows down, and the atlas (H, W, 3).
    """
    rim = 8
    ordered = sorted(tiles.items(), key=lambda item: -item[1].shape[0])
    area = sum((t.shape[0] + 2 * rim) * (t.shape[1] + 2 * rim) for t in tiles.values())
    width = max(int(np.sqrt(area)), *(t.shape[1] + 2 * rim for t in tiles.values()))
    corners, x, y, row = {}, 0, 0, 0
    for key, tile in ordered:
        if x + tile.shape[1] + 2 * rim > width:
            x, y, row = 0, y + row, 0
        corners[key] = (x + rim, y + rim)
        x, row = x + tile.shape[1] + 2 * rim, max(row, tile.shape[0] + 2 * rim)
    height = y + row
    atlas = np.zeros((height, width, 3), dtype=np.uint8)
    places = {}
    for key, tile in ordered:
        (left, top), (h, w) = corners[key], tile.shape[:2]
        padded = np.pad(tile, ((rim, rim), (rim, rim), (0, 0)), "edge")
        atlas[top - rim : top + h + rim, left - rim : left + w + rim] = padded
        places[key] = (left / width, top / height, (left + w) / width, (top + h) / height)
    log.info("%s: %d materials are laid on one texture of %dx%d pixels.", label, len(tiles), width, height)
    return places, _limited(atlas, label)


def _limited(texture: NDArray[np.uint8], label: str) -> NDArray[np.uint8]:
    """A texture that OpenGL takes."""
    side = max(texture.shape[:2])
    if side <= _TEXTURE_LIMIT:
        return texture
    log.info("%s: its texture of %d pixels is shrunk to %d.", label, side, _TEXTURE_LIMIT)
    return _resized(texture, _TEXTURE_LIMIT / side)


def _resized(picture: NDArray[np.uint8], scale: float) -> NDArray[np.uint8]:
    height, width = (max(1, round(scale * n)) for n in picture.shape[:2])
    return np.asarray(Image.fromarray(picture).resize((width, height), Image.Resampling.BOX), dtype=np.uint8)

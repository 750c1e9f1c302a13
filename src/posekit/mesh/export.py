"""Meshes as GLB, for other programs to draw. Layer 2, and with object_model the door to trimesh."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image

from posekit.mesh.model import ObjectModel

GREY = (153, 153, 153)  # of a mesh without colours
TEXTURE_SIDE = 1024  # pixels, the longer side of a texture that is drawn on a page


def to_glb(model: ObjectModel, opacity: float = 1.0, texture_side: int = TEXTURE_SIDE) -> bytes:
    """A mesh with its colours or its texture as a GLB file, in metres and in ``obj``.

    opacity: 0 to 1, of the whole mesh. texture_side: pixels; a texture whose longer side is longer is scaled down.
    """
    visuals: Any = trimesh.visual  # without types
    material = visuals.material.PBRMaterial(
        baseColorFactor=np.array([1.0, 1.0, 1.0, opacity]),
        metallicFactor=0.0,
        roughnessFactor=1.0,
        alphaMode="OPAQUE" if opacity >= 1 else "BLEND",
        doubleSided=True,  # as the renderer draws: nobody vouches for the order of a face's corners
    )
    if model.texture is not None and model.uvs is not None:
        material.baseColorTexture = Image.fromarray(_limited(model.texture, texture_side))
        visual = visuals.TextureVisuals(uv=model.uvs, material=material)
    else:
        srgb = np.tile(np.array(GREY, np.uint8), (len(model.vertices), 1)) if model.colors is None else model.colors
        visual = visuals.TextureVisuals(material=material)
        visual.vertex_attributes["color"] = _linear(srgb)
    mesh = trimesh.Trimesh(
        model.vertices, model.faces, vertex_normals=model.normals, visual=visual, process=False, validate=False
    )
    data = mesh.export(file_type="glb", include_normals=True)
    assert isinstance(data, bytes)
    return data


def _linear(srgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Colours (V, 3) as glTF wants those of vertices: linear, with an alpha of 255; (V, 4)."""
    value = srgb / 255.0
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    alpha = np.full((len(srgb), 1), 255.0)
    return np.concatenate([np.rint(255 * linear), alpha], axis=1).astype(np.uint8)


def _limited(texture: NDArray[np.uint8], side: int) -> NDArray[np.uint8]:
    height, width = texture.shape[:2]
    scale = side / max(height, width)
    if scale >= 1:
        return texture
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(texture, size, interpolation=cv2.INTER_AREA), np.uint8)

"""Mesh files as trimesh reads them, with what it leaves out; the only module that imports trimesh."""

from __future__ import annotations

import io
import logging
import urllib.parse
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image

from posekit.errors import MeshError
from posekit.io.files import other_content
from posekit.io.limits import limit
from posekit.io.pixels import deep_colour, eight_bit
from posekit.mesh.atlas import Part
from posekit.mesh.formats import colours_8bit, corrected, ply_colours, ply_faces
from posekit.mesh.processing import checked_mesh

log = logging.getLogger("posekit")
logging.getLogger("trimesh").addHandler(logging.NullHandler())  # what is wrong is said by errors and notes here

FORMATS = (".ply", ".obj", ".glb", ".gltf", ".stl")

Floats = NDArray[np.float64]


class _Assets(trimesh.resolvers.FilePathResolver):
    """The files that a mesh names: materials, textures, buffers. trimesh goes on without one that it cannot have;
    this remembers what was wrong, so that `read_parts` can refuse."""

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self.folder = path.parent
        self.problem: str | None = None

    def get(self, name: str) -> bytes:
        name = str(name).strip().strip('"').replace("\\", "/")
        found = next((path for path in map(self._inside, _spellings(name)) if path is not None), None)
        if found is None:
            wanted = Path(_spellings(name)[-1]).name
            self.problem = self.problem or (
                f"names the file {name!r}, which is not there: put it at {self.folder / wanted}, "
                "or export the mesh without materials"
            )
            raise FileNotFoundError(name)
        _check_bytes(found)
        data = found.read_bytes()
        if found.suffix.lower() in (".mtl", ".bin"):
            return data
        try:
            with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(data)) as image:  # of the size
                if (large := _too_many_pixels(image)) is not None:
                    self.problem = self.problem or large
                    raise FileNotFoundError(name)
                image.load()
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
            self.problem = self.problem or f"has the texture {found}, which is not a readable picture ({error})"
            raise
        deep = deep_colour(data)
        if deep is None:
            return data
        file = io.BytesIO()
        Image.fromarray(eight_bit(deep, found.name)).save(file, "png")
        return file.getvalue()

    def _inside(self, name: str) -> Path | None:
        """The file of a name in the mesh's folder or below it, also spelled with other capitals; None without one."""
        folder, path = self.folder.resolve(), self.folder / name
        try:
            if path.is_file() and path.resolve().is_relative_to(folder):
                return path
            parent = path.parent
            if not parent.is_dir() or not parent.resolve().is_relative_to(folder):
                return None
            same = [other for other in parent.iterdir() if other.name.lower() == path.name.lower() and other.is_file()]
        except (OSError, ValueError):
            return None  # a name that no file can have
        return same[0] if len(same) == 1 and same[0].resolve().is_relative_to(folder) else None

    def namespaced(self, namespace: str) -> _Assets:
        return _Assets(self.folder / namespace / "mesh")


def _spellings(name: str) -> list[str]:
    """What a file may be called that a mesh names: as it stands, without an MTL's options before it, %20 decoded, and
    its base name alone, of paths on other machines."""
    plain = [name, name.split()[-1]] if name.startswith("-") and name.split() else [name]
    plain += [each.split(" #")[0].rstrip() for each in plain if " #" in each]  # a comment
    decoded = [urllib.parse.unquote(each) for each in plain]
    return list(dict.fromkeys([*plain, *decoded, *(each.rsplit("/", 1)[-1] for each in decoded)]))


def read_parts(path: Path) -> list[Part]:
    """The parts of a mesh file. Raises MeshError where it cannot be read, or names what is not there."""
    if not path.exists():
        raise MeshError(f"there is no mesh {path}: check the path.")
    kind = path.suffix.lower()
    if kind not in FORMATS:
        given = f"the extension {kind}" if kind else "no extension"
        raise MeshError(f"{path.name} has {given}: posekit reads {', '.join(FORMATS)}. Convert it to one of these.")
    try:
        _check_bytes(path)
        data = path.read_bytes()
    except OSError as error:
        raise MeshError(f"the mesh {path} cannot be read: {error.strerror}.") from error
    if not data.strip():
        raise MeshError(f"{path.name} is an empty file: export the mesh again.")
    if (content := other_content(data)) is not None:
        raise MeshError(f"{path.name} {content}.")
    assets = _Assets(path)
    try:
        loaded = trimesh.load(
            io.BytesIO(corrected(kind, data, path.name, assets.get)),
            file_type=kind[1:],
            resolver=assets,
            process=False,
            **_reading_options(path, data),
        )
        scene = loaded if isinstance(loaded, trimesh.Scene) else trimesh.Scene(loaded)
        problem = assets.problem
        parts = [] if problem else _parts(scene, path.name)
    except MeshError:
        raise
    except Exception as error:  # trimesh's parsers raise many kinds of errors
        problem = assets.problem or f"cannot be read as {kind[1:].upper()} ({type(error).__name__}: {error})"
        raise MeshError(f"{path.name} {problem}. Export it again.") from error
    if problem:
        raise MeshError(f"{path.name} {problem}.")
    return parts


def _check_bytes(path: Path) -> None:
    """Raises MeshError where a file is too large to be read."""
    most, size = limit("POSEKIT_MOST_MESH_BYTES"), path.stat().st_size
    if size > most:
        raise MeshError(
            f"{path.name} has {size / 1e6:.0f} MB, at most {most / 1e6:.0f} MB are read: simplify the mesh, or set "
            "POSEKIT_MOST_MESH_BYTES."
        )


def _too_many_pixels(image: Image.Image) -> str | None:
    """What is wrong with a texture that is too large to be read."""
    most = limit("POSEKIT_MOST_PIXELS")
    if image.width * image.height <= most:
        return None
    return (
        f"has a texture of {image.width}x{image.height} pixels, at most {most / 1e6:g} megapixels are read: scale it "
        "down, or set POSEKIT_MOST_PIXELS"
    )


def _reading_options(path: Path, data: bytes) -> dict[str, Any]:
    """Options for trimesh that depend on a file's contents."""
    kind = path.suffix.lower()
    if kind == ".ply":
        # texture coordinates at a face's corners need vertices split; at vertices they must stay as they are
        return {"fix_texture": b" texcoord" in data[: data.find(b"end_header")]}
    return {}


def _parts(scene: trimesh.Scene, label: str) -> list[Part]:
    parts, points = [], 0
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        geometry = scene.geometry[name]
        if isinstance(geometry, trimesh.Trimesh):
            parts.append(_placed(_part(geometry, label), np.asarray(transform, dtype=np.float64)))
        else:
            points += len(getattr(geometry, "vertices", ()))
    parts = [part for part in parts if len(part.vertices)]
    most, faces = limit("POSEKIT_MOST_FACES"), sum(len(part.faces) for part in parts)
    if faces > most:
        raise MeshError(
            f"{label} has {faces} faces, at most {most} are read: simplify the mesh, or set POSEKIT_MOST_FACES."
        )
    if not parts and points:
        raise MeshError(
            f"{label} has {points} points and no faces: posekit renders surfaces, so it needs a triangle mesh."
        )
    if not parts:
        raise MeshError(f"{label} is an empty mesh: it has no vertices. Export it again, as a triangle mesh.")
    return parts


def _part(mesh: Any, label: str) -> Part:
    vertices, faces = checked_mesh(label, np.asarray(mesh.vertices), np.asarray(mesh.faces))
    # trimesh computes normals on demand, but from split seams; only the file's own are wanted
    has_normals = "vertex_normals" in mesh._cache.cache
    normals = np.asarray(mesh.vertex_normals, dtype=np.float64) if has_normals else None
    elements = mesh.metadata.get("_ply_raw")
    sources = np.arange(len(faces))
    if elements is not None and (cut := ply_faces(elements, vertices, label)) is not None:
        faces, sources = cut
    part = Part(vertices, faces, normals)
    visual = mesh.visual
    if elements is not None and visual.kind != "texture":
        colors = ply_colours(elements.get("vertex"), len(vertices), label)
        if colors is not None:
            return replace(part, colors=colors)
        colors = ply_colours(elements.get("face"), elements["face"]["length"], label)
        return part if colors is None else _faceted(part, colors[sources])
    if visual.kind == "texture":
        return _with_material(part, mesh, label)
    if visual.kind == "vertex":
        return replace(part, colors=np.asarray(visual.vertex_colors)[:, :3].astype(np.uint8))
    if visual.kind == "face":
        return _faceted(part, np.asarray(visual.face_colors)[:, :3].astype(np.uint8))
    return part


def _faceted(part: Part, colors: NDArray[np.uint8]) -> Part:
    """The part with a colour for each face (F, 3): no two faces share a vertex."""
    corners = part.faces.ravel()
    return Part(
        part.vertices[corners],
        np.arange(len(corners)).reshape(-1, 3),
        None if part.normals is None else part.normals[corners],
        np.repeat(colors, 3, axis=0),
    )


def _with_material(part: Part, mesh: Any, label: str) -> Part:
    """The part with its texture, or its colours, or its material's one colour."""
    material, count = mesh.visual.material, len(part.vertices)
    image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    if image is not None and image.format is None and image.size == (2, 2):
        image = None  # trimesh's placeholder where nothing names a texture
    uvs = mesh.visual.uv
    factor = getattr(material, "baseColorFactor", None)  # glTF
    if factor is None and "kd" in getattr(material, "kwargs", {}):  # MTL
        scaled = colours_8bit(np.asarray([material.kwargs["kd"]], dtype=np.float64), label)
        factor = None if scaled is None else scaled[0]
    if image is not None and uvs is not None and len(uvs) == count:
        if (large := _too_many_pixels(image)) is not None:
            raise MeshError(f"{label} {large}.")
        deep = image.mode.startswith("I")  # 16 bits of grey
        grey = eight_bit(np.asarray(image).astype(np.int64), label) if deep else None
        texture = np.asarray((image if grey is None else Image.fromarray(grey)).convert("RGB"), dtype=np.uint8)
        if factor is not None and not hasattr(material, "image"):  # in MTL files Kd beside a texture is mostly noise
            texture = _scaled(texture, np.asarray(factor, dtype=np.float64)[:3] / 255.0)
        places = np.asarray(uvs, dtype=np.float64)
        if places.ndim != 2 or places.shape[1] < 2:
            raise MeshError(f"{label} has texture coordinates that are no pairs of numbers: export it again.")
        return replace(part, uvs=places[:, :2], texture=texture)
    if image is not None:
        log.warning("%s: a part has a texture but no texture coordinates; it gets its material's one colour.", label)
    colors = mesh.visual.vertex_attributes.get("color")
    if colors is None and "_ply_raw" in mesh.metadata:
        colors = ply_colours(mesh.metadata["_ply_raw"].get("vertex"), count, label)
    if colors is not None and len(colors) == count:
        return replace(part, colors=np.asarray(trimesh.visual.color.to_rgba(colors))[:, :3].astype(np.uint8))
    if factor is None:
        log.warning("%s: a part has texture coordinates but no texture and no colour; it is drawn grey.", label)
        return part
    return replace(part, colors=np.tile(np.asarray(factor)[:3].astype(np.uint8), (count, 1)))


def _scaled(texture: NDArray[np.uint8], factor: Floats) -> NDArray[np.uint8]:
    """A texture (H, W, 3) times a colour (3,) in [0, 1]."""
    if (factor == 1).all():
        return texture
    tables = np.rint(np.arange(256)[:, None] * factor).astype(np.uint8)
    return np.stack([tables[:, k][texture[..., k]] for k in range(3)], axis=-1)


def _placed(part: Part, transform: Floats) -> Part:
    """A part moved by its node's affine transform (4, 4)."""
    if np.array_equal(transform, np.eye(4)):
        return part
    A = transform[:3, :3]
    faces = part.faces[:, ::-1] if np.linalg.det(A) < 0 else part.faces  # a mirror turns faces inside out
    normals = None if part.normals is None else part.normals @ np.linalg.pinv(A) * np.sign(np.linalg.det(A))
    return replace(part, vertices=part.vertices @ A.T + transform[:3, 3], faces=faces, normals=normals)

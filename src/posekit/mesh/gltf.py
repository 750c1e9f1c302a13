"""glTF and GLB files, rewritten where trimesh would read them wrongly or not."""

from __future__ import annotations

import base64
import io
import json
import logging
import struct
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from posekit.errors import MeshError
from posekit.io.limits import limit
from posekit.io.pixels import deep_colour, eight_bit

log = logging.getLogger("posekit")

_COMPRESSED = {
    "KHR_draco_mesh_compression": "Draco",
    "EXT_meshopt_compression": "meshopt",
    "KHR_meshopt_compression": "meshopt",
}
_TRANSFORM, _GLOSSINESS = "KHR_texture_transform", "KHR_materials_pbrSpecularGlossiness"
_UNDERSTOOD = {
    _TRANSFORM, _GLOSSINESS, "KHR_mesh_quantization", "KHR_materials_unlit", "EXT_texture_webp", "KHR_texture_basisu",
}  # fmt: skip
_WRONG = (ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError, struct.error)


def corrected_gltf(kind: str, data: bytes, label: str, fetch: Callable[[str], bytes]) -> bytes:
    """A file's bytes with texture transforms (KHR_texture_transform) and the chosen set of texture coordinates applied,
    the colours of KHR_materials_pbrSpecularGlossiness where trimesh finds them, and embedded textures of 16 bits made
    8. Transparent parts are told: they are drawn solid.

    kind: ".glb" or ".gltf". fetch: gives the bytes of a file that it names. Raises MeshError where the geometry is
    compressed, has too many corners, or where a transform cannot be applied.
    """
    try:
        document = _Document(kind, data, fetch)
        used = {*document.root.get("extensionsUsed", ()), *document.root.get("extensionsRequired", ())}
        counts = [int(accessor.get("count", 0)) for accessor in document.root.get("accessors", ())]
    except _WRONG:
        return data  # trimesh says what is wrong
    for extension, name in _COMPRESSED.items():
        if extension in used:
            raise MeshError(
                f"{label} is compressed with {name}, which posekit does not read: export it without compression "
                f"(in Blender leave out Compression; or gltf-transform copy {label} plain.glb), or as PLY."
            )
    if "KHR_texture_basisu" in used:
        log.warning("%s: its textures are compressed with Basis Universal, which posekit does not read.", label)
    if strange := sorted({*document.root.get("extensionsRequired", ())} - _UNDERSTOOD):
        log.warning(
            "%s needs %s, which posekit does not know: look at it with posekit render-views.", label, ", ".join(strange)
        )
    most = 3 * limit("POSEKIT_MOST_FACES")
    if max(counts, default=0) > most:
        raise MeshError(
            f"{label} says that it has {max(counts)} numbers in a row, at most {most} are read: simplify the mesh, or "
            "set POSEKIT_MOST_FACES."
        )
    changed = False
    with suppress(*_WRONG):  # trimesh says what is wrong
        changed = _plain_materials(document)
    try:
        changed |= _move_coordinates(document)
    except (*_WRONG, FileNotFoundError) as error:
        if _TRANSFORM not in used:
            return document.data() if changed else data
        raise MeshError(
            f"{label}: its texture transform cannot be applied ({type(error).__name__}: {error}): export it without, "
            "or as OBJ."
        ) from error
    with suppress(*_WRONG):  # a texture that is no picture: trimesh says so
        changed |= _shallow_textures(document, label)
    with suppress(Exception):  # Pillow raises what it stumbles over, and who reads the texture says so
        _tell_transparent(document, label)
    return document.data() if changed else data


class _Document:
    """The JSON of a file and its buffers."""

    def __init__(self, kind: str, data: bytes, fetch: Callable[[str], bytes]) -> None:
        self.binary: bytes | None = None
        self._fetch = fetch
        if kind == ".glb":
            length = struct.unpack_from("<I", data, 12)[0]
            if data[:4] != b"glTF" or data[16:20] != b"JSON":
                raise ValueError("it is no GLB")
            self.binary = b""
            if len(data) >= 28 + length:
                size = struct.unpack_from("<I", data, 20 + length)[0]
                self.binary = data[28 + length : 28 + length + size]
            data = data[20 : 20 + length]
        self.root: dict[str, Any] = json.loads(data)

    def view(self, number: int) -> tuple[bytes, int | None]:
        """A buffer view's bytes and its stride."""
        view = self.root["bufferViews"][number]
        start = int(view.get("byteOffset", 0))
        content = self._buffer(int(view["buffer"]))[start : start + int(view["byteLength"])]
        return content, view.get("byteStride")

    def _buffer(self, number: int) -> bytes:
        uri = self.root["buffers"][number].get("uri")
        if uri is None:
            if self.binary is None or number:
                raise ValueError(f"buffer {number} is nowhere")
            return self.binary
        return self._named(uri)

    def file(self, image: dict[str, Any]) -> bytes:
        """The bytes of a texture's file, wherever it is."""
        if "bufferView" in image:
            return self.view(image["bufferView"])[0]
        return self._named(image["uri"])

    def _named(self, uri: str) -> bytes:
        return base64.b64decode(uri.partition(",")[2]) if uri.startswith("data:") else self._fetch(uri)

    def add(self, content: bytes) -> int:
        """A new buffer view with these bytes; its number."""
        content += bytes(-len(content) % 4)
        buffers = self.root.setdefault("buffers", [])
        if self.binary is not None:
            start = len(self.binary) + -len(self.binary) % 4
            self.binary = self.binary.ljust(start, b"\0") + content
            buffer = 0
            buffers[:1] = [{"byteLength": len(self.binary)}]
        else:
            start, buffer = 0, len(buffers)
            uri = "data:application/octet-stream;base64," + base64.b64encode(content).decode()
            buffers.append({"byteLength": len(content), "uri": uri})
        views = self.root.setdefault("bufferViews", [])
        views.append({"buffer": buffer, "byteOffset": start, "byteLength": len(content)})
        return len(views) - 1

    def coordinates(self, number: int) -> NDArray[np.float64]:
        """An accessor of texture coordinates (N, 2)."""
        accessor = self.root["accessors"][number]
        kind, most = {5126: ("<f4", 1), 5121: ("u1", 255), 5123: ("<u2", 65535)}[accessor["componentType"]]
        if accessor["type"] != "VEC2" or "sparse" in accessor:
            raise ValueError("texture coordinates are sparse, or no pairs")
        content, stride = self.view(accessor["bufferView"])
        dtype, count = np.dtype(kind), int(accessor["count"])
        step = int(stride or 2 * dtype.itemsize)
        start = int(accessor.get("byteOffset", 0))
        found = np.ndarray((count, 2), dtype, content, start, (step, dtype.itemsize))
        return found.astype(np.float64) / most

    def data(self) -> bytes:
        text = json.dumps(self.root).encode()
        if self.binary is None:
            return text
        text += b" " * (-len(text) % 4)
        binary = self.binary + bytes(-len(self.binary) % 4)
        head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary))
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
        return head + chunks


def _move_coordinates(document: _Document) -> bool:
    """Give each part whose colour texture has a transform, or other coordinates than the first, its own. Whether
    anything was changed."""
    materials = [_colour_texture(material) for material in document.root.get("materials", ())]
    changed = False
    for mesh in document.root.get("meshes", ()):
        for part in mesh["primitives"]:
            texture = materials[part["material"]] if "material" in part else {}
            moved = texture.get("extensions", {}).get(_TRANSFORM, {})
            chosen = int(moved.get("texCoord", texture.get("texCoord", 0)))
            attributes = part["attributes"]
            if not (moved or chosen) or f"TEXCOORD_{chosen}" not in attributes:
                continue
            uvs = document.coordinates(attributes[f"TEXCOORD_{chosen}"]) @ _turn(moved).T + moved.get("offset", (0, 0))
            view = document.add(uvs.astype("<f4").tobytes())
            accessors = document.root["accessors"]
            accessors.append({"bufferView": view, "componentType": 5126, "count": len(uvs), "type": "VEC2"})
            attributes["TEXCOORD_0"] = len(accessors) - 1
            changed = True
    return changed


def _plain_materials(document: _Document) -> bool:
    """Diffuse colour and texture of KHR_materials_pbrSpecularGlossiness as the base colour; trimesh would make them
    white where the specular colour is not given. Whether there was one."""
    changed = False
    for material in document.root.get("materials", ()):
        old = material.get("extensions", {}).pop(_GLOSSINESS, None)
        if old is None:
            continue
        plain = material.setdefault("pbrMetallicRoughness", {})
        if "diffuseTexture" in old or "baseColorTexture" not in plain:
            for key in ("baseColorTexture", "baseColorFactor"):
                plain.pop(key, None)
            if "diffuseTexture" in old:
                plain["baseColorTexture"] = old["diffuseTexture"]
            plain["baseColorFactor"] = old.get("diffuseFactor", [1, 1, 1, 1])
        changed = True
    return changed


def _colour_texture(material: dict[str, Any]) -> dict[str, Any]:
    return dict(material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {}))


def _tell_transparent(document: _Document, label: str) -> None:
    """Warn of materials that are transparent in part or in whole."""
    for number, material in enumerate(document.root.get("materials", ())):
        if material.get("alphaMode", "OPAQUE") == "OPAQUE":
            continue
        least = float(material.get("pbrMetallicRoughness", {}).get("baseColorFactor", (1, 1, 1, 1))[3])
        if texture := _colour_texture(material):
            image = document.root["images"][document.root["textures"][texture["index"]]["source"]]
            least *= _least_alpha(document.file(image))
        if least < float(material.get("alphaCutoff", 0.5)):
            name = material.get("name") or f"number {number}"
            log.warning("%s: parts of the material %s are transparent; they are drawn solid.", label, name)


def _turn(moved: dict[str, Any]) -> NDArray[np.float64]:
    """Rotation times scale (2, 2) as the extension defines them: v points down, so the signs are those of a turn to
    the left in the picture."""
    angle = float(moved.get("rotation", 0.0))
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, sine], [-sine, cosine]]) * np.asarray(moved.get("scale", (1.0, 1.0)), dtype=np.float64)


def _least_alpha(content: bytes) -> float:
    """The least opacity of a texture, 0 to 1."""
    with Image.open(io.BytesIO(content)) as picture:
        small = picture.width * picture.height <= limit("POSEKIT_MOST_PIXELS")
        if not (small and picture.has_transparency_data):
            return 1.0
        return float(np.asarray(picture.convert("RGBA"))[..., 3].min()) / 255.0


def _shallow_textures(document: _Document, label: str) -> bool:
    """Embedded coloured PNGs of 16 bits as 8. Whether there was one."""
    changed = False
    for image in document.root.get("images", ()):
        if "bufferView" not in image and not str(image.get("uri", "")).startswith("data:"):
            continue  # a file of its own, read by who reads files
        deep = deep_colour(document.file(image))
        if deep is None:
            continue
        file = io.BytesIO()
        Image.fromarray(eight_bit(deep, f"{label}: a texture")).save(file, "png")
        image.pop("uri", None)
        image.update(bufferView=document.add(file.getvalue()), mimeType="image/png")
        changed = True
    return changed

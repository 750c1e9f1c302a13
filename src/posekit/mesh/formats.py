"""What mesh files hold that trimesh reads wrongly or not, corrected or reported before it does."""

from __future__ import annotations

import logging
import re
import struct
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from posekit.errors import MeshError
from posekit.mesh.gltf import corrected_gltf
from posekit.mesh.ply import triangles_alone
from posekit.mesh.polygons import triangulated

log = logging.getLogger("posekit")

_CHANNELS = (
    ("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"),
    ("ambient_red", "ambient_green", "ambient_blue"),
)  # fmt: skip


def corrected(kind: str, data: bytes, label: str, fetch: Callable[[str], bytes]) -> bytes:
    """A file's bytes as trimesh reads them rightly. kind: its suffix with the dot. fetch: gives the bytes of a file
    that it names. Raises MeshError."""
    if kind == ".obj":
        return _obj(data, label)
    if kind == ".stl":
        return _stl(data, label)
    if kind == ".ply":
        return triangles_alone(data, label)
    if kind in (".glb", ".gltf"):
        return corrected_gltf(kind, data, label, fetch)
    return data


# --- OBJ --------------------------------------------------------------------------------------------------------


def _obj(data: bytes, label: str) -> bytes:
    """Polygons cut into triangles, and colours of 0 to 255 brought to 0 to 1."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        data = data.decode("utf-16", "replace").encode()
    data = re.sub(rb"\\\r?\n", b" ", data.removeprefix(b"\xef\xbb\xbf"))
    if re.search(rb"^#MRGB ", data, re.MULTILINE):
        log.warning("%s: its colours (ZBrush's #MRGB) are not read: export it as PLY with colours.", label)
    lines = data.splitlines()
    if re.search(rb"^\s*f[^\n]*[\s/]-\d", data, re.MULTILINE):
        _count_from_start(lines, label)
    vertices = [k for k, line in enumerate(lines) if line.lstrip()[:2] in (b"v ", b"v\t")]
    polygons: dict[int, list[int]] = {}
    for k, line in enumerate(lines):
        if line.lstrip()[:2] in (b"f ", b"f\t"):
            corners = len(line.split(b"#")[0].split()) - 1
            if corners > 3:
                polygons.setdefault(corners, []).append(k)
    if polygons:
        try:
            places = np.array([[float(v) for v in lines[k].split()[1:4]] for k in vertices], dtype=np.float64)
            for chosen in polygons.values():
                _cut_lines(lines, chosen, places.reshape(-1, 3), label)
        except (ValueError, IndexError) as error:
            raise MeshError(f"{label} has a vertex or a face that is no OBJ ({error}): export it again.") from error
    _scale_colours(lines, vertices, label)
    return b"\n".join(lines) + b"\n"


def _count_from_start(lines: list[bytes], label: str) -> None:
    """Negative numbers count from the last vertex (texture coordinate, normal) before the face: made positive."""
    seen = {b"v": 0, b"vt": 0, b"vn": 0}
    for k, line in enumerate(lines):
        kind, *tokens = line.split(b"#")[0].split() or [b""]
        if kind in seen:
            seen[kind] += 1
        elif kind == b"f":
            try:
                lines[k] = b"f " + b" ".join(
                    b"/".join(
                        part if not part or int(part) > 0 else b"%d" % (int(part) + total + 1)
                        for part, total in zip(token.split(b"/"), seen.values(), strict=False)
                    )
                    for token in tokens
                )
            except ValueError as error:
                raise MeshError(f"{label} has a face that is no OBJ ({error}): export it again.") from error


def _cut_lines(lines: list[bytes], chosen: list[int], places: NDArray[np.float64], label: str) -> None:
    """Replace lines of faces, all with the same number of corners, by lines of triangles."""
    tokens = [lines[k].split(b"#")[0].split()[1:] for k in chosen]
    numbers = np.array([[int(token.split(b"/")[0]) for token in face] for face in tokens])
    if numbers.size and (numbers.min() < 1 or numbers.max() > len(places)):
        wrong = int(numbers.max() if numbers.max() > len(places) else numbers.min())
        raise MeshError(
            f"{label} has a face that names vertex {wrong}, but its vertices are 1 to {len(places)}: the file is "
            "damaged; export it again."
        )
    for k, face, triples in zip(chosen, tokens, triangulated(places[numbers - 1], label), strict=True):
        lines[k] = b"\n".join(b"f " + b" ".join(face[corner] for corner in triple) for triple in triples.tolist())


def _scale_colours(lines: list[bytes], vertices: list[int], label: str) -> None:
    """Colours behind a vertex's place are 0 to 1 in most programs, 0 to 255 in some."""
    rows = [lines[k].split(b"#")[0].split() for k in vertices]
    coloured = [(k, row) for k, row in zip(vertices, rows, strict=True) if len(row) in (7, 8)]
    if not coloured:
        return
    try:
        colours = np.array([[float(v) for v in row[-3:]] for _, row in coloured])
    except ValueError as error:
        raise MeshError(f"{label} has a vertex colour that is no number ({error}): export it again.") from error
    scaled = colours_8bit(colours, label)
    if scaled is None:
        for k, row in coloured:
            lines[k] = b" ".join(row[:4])
        return
    if colours.max(initial=0) <= 1:
        return
    for (k, row), colour in zip(coloured, scaled / 255.0, strict=True):
        lines[k] = b" ".join(row[:-3]) + (" {:.6f} {:.6f} {:.6f}".format(*colour)).encode()


# --- STL --------------------------------------------------------------------------------------------------------


def _stl(data: bytes, label: str) -> bytes:
    """A binary file whose count of triangles is wrong is read by its size."""
    if len(data) < 84 or _is_ascii_stl(data):
        return data
    [told] = struct.unpack_from("<I", data, 80)
    there, rest = divmod(len(data) - 84, 50)
    if there and np.frombuffer(data, np.uint8, there * 50, 84).reshape(there, 50)[:, 48:].any():
        log.warning("%s: the colours of STL files have no common meaning and are not read; it is drawn grey.", label)
    if told == there and not rest:
        return data
    if there and told <= there and rest:
        log.warning("%s: %d bytes follow its %d triangles and are not read.", label, len(data) - 84 - 50 * told, told)
        return data[: 84 + 50 * told]
    if told > there and rest > 2:  # it ends within a triangle
        raise MeshError(
            f"{label} says that it has {told} triangles, and ends within number {there + 1}: it is cut off; copy or "
            "export it again."
        )
    log.warning("%s: it says that it has %d triangles, its size that it has %d: these are read.", label, told, there)
    return data[:80] + struct.pack("<I", there) + data[84 : 84 + 50 * there]


def _is_ascii_stl(data: bytes) -> bool:
    head = data[:1024].lstrip().lower()
    return head.startswith(b"solid") and (b"facet" in head or b"endsolid" in data.lower()[-200:])


# --- PLY --------------------------------------------------------------------------------------------------------


def ply_faces(
    elements: Mapping[str, Any], vertices: NDArray[np.float64], label: str
) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
    """Triangles (F, 3) of a PLY that has polygons of more corners, and the polygon of each (F,); None where it has
    triangles alone, or polygons that name no vertex.

    elements: as trimesh keeps them. Raises MeshError where such polygons have texture coordinates of their own.
    """
    element = elements.get("face")
    polygons = None if element is None else _polygons(element.get("data"))
    lengths = np.array([] if polygons is None else [len(polygon) for polygon in polygons], dtype=np.int64)
    if polygons is None or element is None or not (lengths > 3).any():
        return None
    if "texcoord" in element.get("properties", ()):
        raise MeshError(
            f"{label} has polygons of more than three corners with texture coordinates of their own: triangulate the "
            "mesh in the program that made it, or export it as OBJ or GLB."
        )
    faces, sources = [], []
    for count in np.unique(lengths[lengths > 2]):
        chosen = np.flatnonzero(lengths == count)
        corners = np.stack([np.asarray(polygons[k], dtype=np.int64) for k in chosen])
        if corners.min() < 0 or corners.max() >= len(vertices):
            return None  # reported where faces are checked
        triples = triangulated(vertices[corners], label)
        faces += [face[cut] for face, cut in zip(corners, triples, strict=True)]
        sources.append(np.repeat(chosen, [len(cut) for cut in triples]))
    return np.concatenate(faces), np.concatenate(sources)


def _polygons(data: Any) -> Any:
    names = ("vertex_index", "vertex_indices")
    if isinstance(data, Mapping):
        return next((data[name] for name in names if name in data), None)
    if isinstance(data, np.ndarray) and data.dtype.names:
        name = next((name for name in names if name in data.dtype.names), data.dtype.names[0])
        return data[name]["f1"] if data[name].dtype.names else data[name]
    return data if isinstance(data, np.ndarray) and data.ndim == 2 else None


def ply_colours(element: Mapping[str, Any] | None, count: int, label: str) -> NDArray[np.uint8] | None:
    """The colours (count, 3) of a PLY's vertices or faces, in whatever numbers; None without any. What is not
    understood is logged."""
    data, properties = (None, ()) if element is None else (element.get("data"), tuple(element.get("properties", ())))
    spelled = {name.lower(): name for name in properties}
    for names in _CHANNELS:
        if data is None or not set(names) <= set(spelled):
            continue
        columns = np.column_stack([np.ravel(data[spelled[name]]) for name in names])
        return colours_8bit(columns, label) if len(columns) == count else None
    odd = [name for name in properties if re.search(r"red|green|blue|colou?r|rgb|intensity|gr[ae]y", name.lower())]
    if odd:
        log.warning("%s: its colours (%s) are not understood; it is drawn grey.", label, ", ".join(odd))
    return None


def colours_8bit(colours: NDArray[Any], label: str) -> NDArray[np.uint8] | None:
    """Colours (N, 3) as 0 to 255: fractions up to 1, numbers up to 255, or 16 bits; None, and logged, for others."""
    if colours.dtype == np.uint8:
        return np.asarray(colours)
    values = colours.astype(np.float64)
    low, high = float(values.min(initial=0)), float(values.max(initial=0))
    if not np.isfinite(values).all() or low < 0 or high > 65535:
        log.warning("%s: its colours are from %g to %g, which is not understood; it is drawn grey.", label, low, high)
        return None
    whole = colours.dtype.kind in "iu"
    most = 1.0 if high <= 1 and not whole else 255.0 if high <= 255 else 65535.0
    return np.asarray(np.rint(values * (255.0 / most)), dtype=np.uint8)

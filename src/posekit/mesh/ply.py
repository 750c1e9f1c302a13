"""Binary PLY files whose polygons have different numbers of corners, as triangles."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from posekit.mesh.polygons import triangulated

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_CORNERS = ("vertex_indices", "vertex_index")


@dataclass
class _Element:
    """properties: (name, type, type of a list's count or None). Types as NumPy names them, with their byte order."""

    name: str
    count: int
    properties: list[tuple[str, str, str | None]] = field(default_factory=list)

    @property
    def row(self) -> np.dtype[np.void] | None:
        """A row; None where it has a list."""
        if any(counted for *_, counted in self.properties):
            return None
        return np.dtype([(name, kind) for name, kind, _ in self.properties])


def triangles_alone(data: bytes, label: str) -> bytes:
    """A binary PLY's bytes with its polygons cut into triangles where they have different numbers of corners, which
    trimesh does not read; any other file's as they are, damaged ones too.

    Faces with lists beside their corners are left as they are. Raises MeshError where a polygon cannot be cut.
    """
    end = re.search(rb"end_header *\r?\n", data[:65536])
    if end is None or not data.startswith(b"ply"):
        return data
    try:
        elements = _header(data[: end.start()].decode("latin-1"))
        return _cut(data, end.end(), elements, label)
    except (ValueError, KeyError, IndexError, OverflowError):
        return data  # trimesh says what is wrong


def _header(text: str) -> list[_Element]:
    """Raises ValueError where the file is no binary one, KeyError for an unknown type."""
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}
    found = re.search(r"^format +(\w+)", text, re.MULTILINE)
    if found is None or found[1] not in order:
        raise ValueError("no binary PLY")
    elements: list[_Element] = []
    for line in text.splitlines():
        words = line.split()
        if words[:1] == ["element"]:
            elements.append(_Element(words[1], int(words[2])))
        elif words[:2] == ["property", "list"]:
            counted, kind = (order[found[1]] + _TYPES[word] for word in words[2:4])
            elements[-1].properties.append((words[4], kind, counted))
        elif words[:1] == ["property"]:
            elements[-1].properties.append((words[2], order[found[1]] + _TYPES[words[1]], None))
    return elements


def _cut(data: bytes, start: int, elements: list[_Element], label: str) -> bytes:
    places, at = None, start
    for element in elements:
        row = element.row
        if element.name == "face":
            break
        if row is None:
            return data
        if element.name == "vertex":
            rows = np.frombuffer(data, row, element.count, at)
            places = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)
        at += element.count * row.itemsize
    else:
        return data
    lists = [k for k, (*_, counted) in enumerate(element.properties) if counted]
    if places is None or not lists or element.properties[lists[0]][0] not in _CORNERS:
        return data
    name, kind, counted = element.properties[lists[0]]
    assert counted is not None
    before, after = (_scalars(part) for part in (element.properties[: lists[0]], element.properties[lists[0] + 1 :]))
    if len(lists) > 1:
        return data
    if _all_alike(data, at, element.count, before, np.dtype(counted), np.dtype(kind), after):
        return data
    heads, counts, after_rows = _walk(data, at, element.count, (before.itemsize, counted, kind, after.itemsize))
    if len(set(counts.tolist())) < 2:
        return data
    bytes_ = np.frombuffer(data, np.uint8)
    made: list[NDArray[np.void]] = []
    for corners in np.unique(counts[counts > 2]):
        rows_at = heads[counts == corners]
        polygons = _gathered(
            bytes_, rows_at + before.itemsize + np.dtype(counted).itemsize, np.dtype((kind, int(corners)))
        )
        if polygons.min() < 0 or polygons.max() >= len(places):
            return data
        triples = triangulated(places[polygons], label)
        sources = np.repeat(np.arange(len(rows_at)), [len(cut) for cut in triples])
        rows = np.zeros(len(sources), [("before", before), ("count", "u1"), (name, kind, (3,)), ("after", after)])
        rows["count"] = 3
        rows[name] = np.concatenate([polygon[cut] for polygon, cut in zip(polygons, triples, strict=True)])
        _copy(rows["before"], bytes_, rows_at[sources])
        _copy(rows["after"], bytes_, after_rows[counts == corners][sources])
        made.append(rows)  # not joined as arrays, which would change the order of bytes
    head = data[:start].decode("latin-1")
    head = re.sub(r"(?m)^(element +face) +\d+", rf"\1 {sum(map(len, made))}", head)
    head = re.sub(rf"(?m)^property +list +\w+ +(\w+) +{name}", rf"property list uchar \1 {name}", head)
    rest = int(after_rows[-1]) + after.itemsize
    return head.encode("latin-1") + data[start:at] + b"".join(rows.tobytes() for rows in made) + data[rest:]


def _scalars(properties: list[tuple[str, str, str | None]]) -> np.dtype[np.void]:
    return np.dtype([(f"{k}", kind) for k, (_, kind, _) in enumerate(properties)])


def _all_alike(
    data: bytes,
    at: int,
    count: int,
    before: np.dtype[np.void],
    counted: np.dtype[Any],
    kind: np.dtype[Any],
    after: np.dtype[np.void],
) -> bool:
    """Whether all faces have as many corners as the first, so that none needs cutting: their rows then follow each
    other at equal distances."""
    place = at + before.itemsize
    if not count or place + counted.itemsize > len(data):
        return False
    corners = int(np.frombuffer(data, counted, 1, place)[0])
    row = before.itemsize + counted.itemsize + corners * kind.itemsize + after.itemsize
    if corners < 0 or at + count * row > len(data):
        return False
    rows = np.frombuffer(data, np.uint8, count * row, at).reshape(count, row)
    counts = rows[:, before.itemsize : before.itemsize + counted.itemsize]
    return bool((counts == counts[0]).all())


def _walk(
    data: bytes, at: int, count: int, sizes: tuple[int, str, str, int]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Where each face begins, how many corners it has, and where what follows them begins. Raises IndexError where the
    file ends before."""
    before, counted, kind, after = sizes
    width, each = np.dtype(counted).itemsize, np.dtype(kind).itemsize
    order, signed = ("little" if counted[0] == "<" else "big"), counted[1] == "i"
    if count > len(data):
        raise IndexError("the file ends before its faces do")
    heads, counts, tails = [], [], []
    for _ in range(count):
        corners = int.from_bytes(data[at + before : at + before + width], order, signed=signed)  # type: ignore[arg-type]
        tail = at + before + width + corners * each
        if corners < 0 or tail + after > len(data):
            raise IndexError("the file ends before its faces do")
        heads.append(at)
        counts.append(corners)
        tails.append(tail)
        at = tail + after
    return np.array(heads, np.int64), np.array(counts, np.int64), np.array(tails, np.int64)


def _gathered(data: NDArray[np.uint8], places: NDArray[np.int64], kind: np.dtype[np.generic]) -> NDArray[np.int64]:
    """The numbers (N, C) that begin at these places."""
    taken = data[places[:, None] + np.arange(kind.itemsize)]
    return np.ascontiguousarray(taken).view(kind.base).astype(np.int64)


def _copy(into: NDArray[np.void], data: NDArray[np.uint8], places: NDArray[np.int64]) -> None:
    """Fill rows with the bytes that begin at these places."""
    size = into.dtype.itemsize
    if size:
        taken = np.ascontiguousarray(data[places[:, None] + np.arange(size)])
        into[:] = taken.view(into.dtype)[:, 0]

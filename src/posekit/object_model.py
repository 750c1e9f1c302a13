"""ObjectModel: a mesh in metres, with its symmetries. Layer 1, and the only door to trimesh."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import re
import urllib.parse
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import fast_simplification
import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from scipy.spatial import ConvexHull, KDTree
from scipy.spatial.distance import pdist

from posekit.errors import MeshError
from posekit.files import other_content, read_text
from posekit.geometry import Pose, fibonacci_sphere, hat, rotation_angle, so3_exp
from posekit.limits import limit
from posekit.mesh_files import colours_8bit, ply_colours, ply_faces, put_right
from posekit.pixels import deep_colour, eight_bit

log = logging.getLogger("posekit")
logging.getLogger("trimesh").addHandler(logging.NullHandler())  # what is wrong is said by errors and notes here

FORMATS = (".ply", ".obj", ".glb", ".gltf", ".stl")
UNITS = {"mm": 0.001, "cm": 0.01, "m": 1.0, "in": 0.0254}

_METRES_BELOW, _MM_ABOVE = 3.0, 20.0  # diameters in a file's own units; between them nobody can tell
_SMALLEST, _LARGEST = 0.001, 10.0  # diameters in metres that are an object's
_FARTHEST = 1e12  # of a vertex from the origin, in a file's own units
_CREASE = np.cos(np.deg2rad(40.0))  # faces that meet more sharply are not smoothed together
_PLAIN = (153, 153, 153)  # the renderer's colour where a mesh has none
_TEXTURE_LIMIT = 8192  # pixels, the longer side that any OpenGL takes
_MOST_SYMMETRIES = 720

Floats = NDArray[np.float64]


# --- symmetries -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Continuous:
    """Any turn about a line. axis: (3,) unit vector in ``obj``; offset: (3,) metres, a point of the line."""

    axis: Floats
    offset: Floats

    def __post_init__(self) -> None:
        axis, offset = (np.array(v, dtype=np.float64).reshape(3) for v in (self.axis, self.offset))
        length = np.linalg.norm(axis)
        if not np.isfinite([*axis, *offset]).all() or length < 1e-9:
            raise ValueError(f"a symmetry needs an axis that is not zero and a finite offset, not {axis}, {offset}")
        object.__setattr__(self, "axis", axis / length)
        object.__setattr__(self, "offset", offset)

    def turn(self, angle: float) -> Pose:
        """T_obj_obj of a turn by ``angle``, radians."""
        return _turn_about(so3_exp(self.axis * angle), self.offset)


@dataclass(frozen=True, eq=False)
class Symmetries:
    """The transforms ``T_obj_obj`` after which the object looks the same.

    discrete: without the identity, metres. continuous: axes about which it may be turned by any angle.
    """

    discrete: tuple[Pose, ...] = ()
    continuous: tuple[Continuous, ...] = ()

    @classmethod
    def none(cls) -> Symmetries:
        return cls()

    @classmethod
    def parse(cls, text: str, center: ArrayLike) -> Symmetries:
        """Symmetries from a text such as ``z:2`` or ``x:2,y:inf``; center: (3,) metres, a point of every axis.

        ``AXIS:ORDER``, several separated by commas. AXIS is x, y or z (the mesh's own axes); ORDER is a whole
        number n from 2 on (looks the same after 1/n of a turn) or ``inf`` (after any turn). Products of the given
        turns are added: ``x:2,y:2`` has ``z:2`` too. ``none`` says that the object has no symmetry.
        Raises MeshError where the text is something else.
        """
        middle = np.asarray(center, dtype=np.float64)
        if text.strip().lower() == "none":
            return cls.none()
        turns: list[Floats] = []
        continuous: list[Continuous] = []
        for item in text.split(","):
            match = re.fullmatch(r"\s*([xyz])\s*:\s*(\d{1,3}|inf)\s*", item, re.IGNORECASE)
            order = 0 if match is None or match[2].lower() == "inf" else int(match[2])
            if match is None or (order < 2 and match[2].lower() != "inf"):
                raise MeshError(
                    f"symmetry {text!r}: {item.strip()!r} is not AXIS:ORDER. Give x, y or z, a colon, and 2, 3, ... "
                    'or inf, several separated by commas, as in "z:2", "z:inf" or "x:2,y:2"; or "none".'
                )
            axis = np.eye(3)["xyz".index(match[1].lower())]
            if order:
                turns.append(so3_exp(axis * (2 * np.pi / order)))
            else:
                continuous.append(Continuous(axis, middle))
        return cls(tuple(_turn_about(R, middle) for R in _group(turns, text)), tuple(continuous))

    @classmethod
    def from_bop(cls, info: Mapping[str, Any]) -> Symmetries:
        """From an object's entry in BOP's ``models_info.json`` (mm). Raises ValueError, TypeError,
        KeyError or OverflowError where it is malformed."""
        discrete = []
        for numbers in info.get("symmetries_discrete", ()):
            matrix = np.asarray(numbers, dtype=np.float64).reshape(4, 4).copy()
            matrix[:3, 3] *= UNITS["mm"]
            discrete.append(Pose.from_matrix(matrix))
        continuous = [
            Continuous(np.asarray(entry["axis"]), np.asarray(entry.get("offset", (0, 0, 0))) * UNITS["mm"])
            for entry in info.get("symmetries_continuous", ())
        ]
        return cls(tuple(discrete), tuple(continuous))

    def transforms(self, max_steps: int = 64) -> list[Pose]:
        """All symmetry transforms, the identity first: BOP's way.

        Continuous ones become ``max_steps`` turns each, every one combined with every discrete one. (BOP itself
        takes 315 steps.)
        """
        discrete = [Pose.identity(), *self.discrete]
        angles = np.arange(1, max_steps) * (2 * np.pi / max_steps)
        turns = [Pose.identity(), *(c.turn(a) for c in self.continuous for a in angles)]
        return [turn @ still for turn in turns for still in discrete]

    def __bool__(self) -> bool:
        """Whether there is one."""
        return bool(self.discrete or self.continuous)

    def nearest(self, T_a_obj: Pose, reference: Pose) -> Pose:
        """Of the poses in which the object looks as in ``T_a_obj``, the one with the rotation nearest to the
        reference's. About continuous axes it is exact where there is one of them, else as fine as `transforms`."""
        if not self:
            return T_a_obj
        exact = len(self.continuous) == 1
        turns = self.discrete if exact else self.transforms()[1:]
        candidates = [T_a_obj, *(T_a_obj @ S for S in turns)]
        if exact:
            candidates = [pose @ self.continuous[0].turn(_turn_towards(pose, reference, self.continuous[0].axis))
                          for pose in candidates]  # fmt: skip
        return max(candidates, key=lambda pose: float(np.trace(reference.R.T @ pose.R)))

    def angles(self, R: Floats, others: Floats) -> Floats:
        """Angle (N,), radians, from R_a_obj (3, 3) to each of others (N, 3, 3), to the nearest of the equivalent ones;
        continuous axes in steps of 10 degrees."""
        equivalent = np.stack([R @ S.R for S in self.transforms(36)])
        return np.asarray(rotation_angle(np.swapaxes(others, -1, -2)[:, None] @ equivalent).min(axis=1))


def _turn_towards(pose: Pose, reference: Pose, axis: Floats) -> float:
    """The angle of the turn about an axis in ``obj`` that brings a pose's rotation nearest to the reference's."""
    # trace(M exp(a hat(axis))) = axis' M axis + cos(a) (trace M - axis' M axis) + sin(a) trace(M hat(axis))
    M = reference.R.T @ pose.R
    return float(np.arctan2(np.trace(M @ hat(axis)), np.trace(M) - axis @ M @ axis))


def _turn_about(R: Floats, point: Floats) -> Pose:
    return Pose(R, point - R @ point)


def _group(turns: Sequence[Floats], text: str) -> list[Floats]:
    """All products of rotations (3, 3), without the identity."""
    found = [np.eye(3)]
    for known in found:  # grows while it is walked through
        for turn in turns:
            product = turn @ known
            if np.abs(np.stack(found) - product).max(axis=(1, 2)).min() > 1e-6:
                found.append(product)
        if len(found) > _MOST_SYMMETRIES:
            raise MeshError(
                f"symmetry {text!r}: these turns together give more than {_MOST_SYMMETRIES} symmetries, which no "
                "object has but a body of revolution: use inf for its axis."
            )
    return found[1:]


# --- the model --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """A mesh in metres with its own axes and origin. Make one with `load` or `from_arrays`, which check it.

    vertices: float32 (V, 3). faces: int32 (F, 3). normals: float32 (V, 3), unit.
    colors: uint8 (V, 3) or None. uvs: float32 (V, 2) or None, v up as in OpenGL and OBJ.
    texture: uint8 RGB (H, W, 3) or None; where it is set, uvs is too and colors is None.
    units: those of the file it came from, "mm", "cm", "m" or "in".
    """

    name: str
    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    normals: NDArray[np.float32]
    colors: NDArray[np.uint8] | None = None
    uvs: NDArray[np.float32] | None = None
    texture: NDArray[np.uint8] | None = None
    symmetries: Symmetries = field(default_factory=Symmetries.none)
    units: str = "m"

    @cached_property
    def digest(self) -> str:
        """16 hex digits of the shape (vertices to 0.01 mm and faces): what weights name the meshes by that they saw."""
        shape = hashlib.sha256(np.rint(self.vertices * 1e5).astype("<i4").tobytes())
        shape.update(self.faces.astype("<i4").tobytes())
        return shape.hexdigest()[:16]

    @classmethod
    def load(cls, path: str | Path, units: str = "auto", symmetry: str | Symmetries | None = None) -> ObjectModel:
        """Read a PLY, OBJ (with MTL and textures), GLB, glTF or STL file.

        units: "mm", "cm", "m", "in" (inches), or "auto": metres where the diameter is below 3, millimetres where it is
        above 20; what is taken is said, with the object's length.
        symmetry: a text for `Symmetries.parse`, a JSON file's name, or symmetries; otherwise they are read from a
        ``models_info.json`` beside the mesh (``obj_000009.ply`` by its number, other names by their stem).

        The parts of a GLB or OBJ become one mesh, in the scene's places; several textures become one. Normals are
        the file's, else `smooth_normals`. A GLB's colours are taken as sRGB.
        Raises MeshError where the file is no usable mesh, lacks a texture, or has an implausible size.
        """
        path = Path(path)
        if units not in ("auto", *UNITS):
            raise MeshError(f"units are auto, {', '.join(UNITS)}, not {units!r}.")
        merged = _merge(_read(path), path.name)
        model = cls.from_arrays(
            merged.vertices,
            merged.faces,
            name=path.stem,
            colors=merged.colors,
            uvs=merged.uvs,
            texture=merged.texture,
            normals=merged.normals,
            label=path.name,
        )
        units = _chosen_units(path.name, model.diameter, units)
        scaled = (model.vertices * np.float64(UNITS[units])).astype(np.float32)
        model = replace(model, vertices=scaled, units=units)
        return replace(model, symmetries=_symmetries(symmetry, path, model))

    @classmethod
    def from_arrays(
        cls,
        vertices: ArrayLike,
        faces: ArrayLike,
        *,
        name: str = "object",
        colors: ArrayLike | None = None,
        uvs: ArrayLike | None = None,
        texture: NDArray[np.uint8] | None = None,
        normals: ArrayLike | None = None,
        symmetries: Symmetries | None = None,
        label: str | None = None,
    ) -> ObjectModel:
        """A model from vertices (V, 3) in metres and faces (F, 3).

        colors: (V, 3) uint8; uvs: (V, 2) with texture: uint8 (H, W, 3); normals: (V, 3), `smooth_normals` where
        not given. Faces without area and vertices without faces are dropped. label: the mesh's name in messages.
        Raises MeshError where it is not a usable mesh.
        """
        label = label or name
        v, f = _checked(label, np.asarray(vertices), np.asarray(faces))
        f = f[_areas(v, f) > 1e-14 * float(np.ptp(v, axis=0).max()) ** 2]
        if len(f) < 2:
            raise MeshError(
                f"{label} has {len(f) or 'no'} face{'s' if len(f) != 1 else ''} with an area: an object needs at "
                "least two. Export it as a triangle mesh."
            )
        if (texture is None) != (uvs is None):
            texture = uvs = None  # either is useless without the other
        if normals is None:
            source, f, unit = smooth_normals(v, f)
        else:
            source, f = _used(f, len(v))
            unit = _repaired(np.asarray(normals, dtype=np.float64)[source], v[source], f)
        rgb = None if colors is None or texture is not None else _rows(label, "colors", colors, len(v))[source, :3]
        uv = None if uvs is None else _rows(label, "uvs", uvs, len(v))[source, :2]
        return cls(
            name=name,
            vertices=v[source].astype(np.float32),
            faces=f.astype(np.int32),
            normals=unit.astype(np.float32),
            colors=None if rgb is None else rgb.astype(np.uint8),
            uvs=None if uv is None else uv.astype(np.float32),
            texture=None if texture is None else np.ascontiguousarray(texture, dtype=np.uint8),
            symmetries=symmetries or Symmetries.none(),
        )

    @cached_property
    def bounds(self) -> Floats:
        """(2, 3), the bounding box's lower and upper corner in ``obj``."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)]).astype(np.float64)

    @cached_property
    def center(self) -> Floats:
        """(3,), the bounding box's centre in ``obj``."""
        return np.asarray(self.bounds.mean(axis=0))

    @cached_property
    def extents(self) -> Floats:
        """(3,), the bounding box's sides."""
        return np.asarray(self.bounds[1] - self.bounds[0])

    @cached_property
    def outline(self) -> Floats:
        """(N, 3), the corners of the convex hull in ``obj``: all that decides which box the object fills."""
        return _hull(self.vertices.astype(np.float64))

    @cached_property
    def diameter(self) -> float:
        """The largest distance of two vertices; within 0.1 % of it where the hull has thousands of corners."""
        points = self.outline
        if len(points) > 4000:
            points = points[np.unique((points @ fibonacci_sphere(4000).T).argmax(axis=0))]
        return float(pdist(points).max())

    @cached_property
    def T_obj_ctr(self) -> Pose:
        return Pose.translation(self.center)

    def simplified(self, faces: int) -> ObjectModel:
        """The same object with about so many faces, to be drawn small and often; itself where it has no more.

        Its shape errs least for its number of faces (quadric error metrics: Garland and Heckbert, 1997). Colours are
        means of those near by; a face's place in the texture is that of the face that lay at its middle.
        """
        if len(self.faces) <= faces:
            return self
        places = _same_places(self.vertices.astype(np.float64))
        _, first, welded = np.unique(places, return_index=True, return_inverse=True)
        vertices, kept = fast_simplification.simplify(
            self.vertices[first], welded[self.faces].astype(np.int32), target_count=faces
        )
        colors = uvs = None
        if self.colors is not None:
            colors = _mean_colors(vertices, self.vertices, self.colors)
        if self.uvs is not None:
            source, kept, uvs = _carried_uvs(vertices, kept, self.vertices[self.faces], self.uvs[self.faces])
            vertices = vertices[source]
        model = ObjectModel.from_arrays(
            vertices, kept, name=self.name, colors=colors, uvs=uvs, texture=self.texture, symmetries=self.symmetries
        )
        return replace(model, units=self.units)

    def sample_points(self, n: int, seed: int = 0) -> Floats:
        """(n, 3) points spread evenly over the surface, in ``obj``. The same seed gives the same points."""
        rng = np.random.default_rng(seed)
        corners = self.vertices.astype(np.float64)[self.faces]
        share = np.cumsum(_areas(self.vertices.astype(np.float64), self.faces))
        chosen = corners[np.searchsorted(share, rng.random(n) * share[-1]).clip(max=len(share) - 1)]
        a, b = rng.random((2, n, 1))
        root = np.sqrt(a)
        return np.asarray((1 - root) * chosen[:, 0] + root * (1 - b) * chosen[:, 1] + root * b * chosen[:, 2])


# --- geometry ---------------------------------------------------------------------------------------------------


def smooth_normals(vertices: Floats, faces: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    """Normals weighted by the faces' angles, smooth across texture seams, sharp at edges of more than 40 degrees.

    vertices: (V, 3); faces: (F, 3) with areas. A vertex on a sharp edge is split. Returns the source vertex of each
    new one (V',), the new faces (F, 3) and the unit normals (V', 3).
    """
    flat, angles = _face_normals(vertices, faces)
    place = _same_places(vertices)[faces.ravel()]
    order = np.argsort(place, kind="stable")
    normal = np.repeat(flat, 3, axis=0)[order]  # of each corner's face; corners of one place lie side by side
    weighted = normal * angles.ravel()[order, None]
    ends = np.searchsorted(place[order], place[order], side="right")
    total, left, step = weighted.copy(), np.arange(len(order)), 1
    while left.size:  # each corner meets the one that lies `step` further on at the same place
        left = left[left + step < ends[left]]
        alike = left[np.einsum("ij,ij->i", normal[left], normal[left + step]) > _CREASE]
        total[alike] += weighted[alike + step]
        total[alike + step] += weighted[alike]
        step += 1
    unit = np.empty_like(total)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    unit[order] = np.where(length > 1e-9, total, normal) / np.where(length > 1e-9, length, 1.0)
    keys = np.column_stack([faces.ravel(), np.rint(unit * 1e4).astype(np.int64)])
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return faces.ravel()[first], inverse.reshape(-1, 3), unit[first]


def _face_normals(vertices: Floats, faces: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Unit normals (F, 3) and the angles (F, 3) at the corners."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    edges = np.roll(corners, -1, axis=1) - corners
    edges /= np.maximum(np.linalg.norm(edges, axis=2, keepdims=True), 1e-300)
    cosines = -np.einsum("fij,fij->fi", edges, np.roll(edges, 1, axis=1))
    return normals, np.arccos(cosines.clip(-1, 1))


def _same_places(vertices: Floats) -> NDArray[np.int64]:
    """A number (V,) for each vertex, equal where the vertices coincide (to a millionth of the mesh's size)."""
    grid = np.rint((vertices - vertices.min(axis=0)) / (1e-6 * np.ptp(vertices, axis=0).max())).astype(np.int64)
    order = np.lexsort(grid.T)
    changes = (np.diff(grid[order], axis=0) != 0).any(axis=1)
    numbers = np.empty(len(grid), dtype=np.int64)
    numbers[order] = np.concatenate([[0], np.cumsum(changes)])
    return numbers


def _areas(vertices: Floats, faces: NDArray[Any]) -> Floats:
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(0.5 * np.linalg.norm(cross, axis=1))


def _mean_colors(
    fewer: NDArray[np.float32], vertices: NDArray[np.float32], colors: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Of the vertices that each of fewer ones (V, 3) is nearest to; where there are none, of the nearest."""
    _, owner = KDTree(fewer).query(vertices)
    count = np.bincount(owner, minlength=len(fewer))
    sums = np.stack([np.bincount(owner, channel, minlength=len(fewer)) for channel in colors.T], axis=1)
    _, nearest = KDTree(vertices).query(fewer)
    means = np.where(count[:, None] > 0, sums / np.maximum(count, 1)[:, None], colors[nearest])
    return np.asarray(np.rint(means), np.uint8)


def _carried_uvs(
    vertices: NDArray[np.float32], faces: NDArray[Any], corners: NDArray[np.float32], corner_uvs: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    """Texture coordinates for a simplified mesh: those of the plane of the old face nearest to a new face's middle.

    corners: (F, 3, 3), corner_uvs: (F, 3, 2), the old faces'. A vertex on a seam is split. Returns the source vertex of
    each new one (V',), the new faces and the coordinates (V', 2).
    """
    new = vertices[faces].astype(np.float64)
    _, under = KDTree(corners.mean(axis=1)).query(new.mean(axis=1))
    origin, first, second = np.moveaxis(corners[under].astype(np.float64), 1, 0)
    sides = np.stack([first - origin, second - origin], axis=2)  # (F', 3, 2)
    shares = np.einsum("fij,fkj->fki", np.linalg.pinv(sides), new - origin[:, None]).clip(-4, 4)  # a sliver's explode
    start = corner_uvs[under, 0].astype(np.float64)
    across = corner_uvs[under, 1:].astype(np.float64) - start[:, None]
    uvs = (start[:, None] + shares @ across).reshape(-1, 2)
    spans = np.linalg.norm(np.diff(uvs.reshape(-1, 3, 2), axis=1), axis=2)
    near = 2 * float(np.percentile(spans, 95))  # what lies further apart is another place of the texture
    vertex, left = faces.ravel(), np.arange(faces.size)
    source: list[NDArray[np.int64]] = []
    means: list[Floats] = []
    index, count = np.zeros(faces.size, np.int64), 0
    while left.size:  # corners of a vertex that agree become one, then those that did not agree with them
        owners, head, owner = np.unique(vertex[left], return_index=True, return_inverse=True)
        agree = np.linalg.norm(uvs[left] - uvs[left[head]][owner], axis=1) <= near
        number = np.bincount(owner[agree], minlength=len(owners))[:, None]
        sums = [np.bincount(owner[agree], uvs[left[agree], k], minlength=len(owners)) for k in (0, 1)]
        means.append(np.stack(sums, axis=1) / number)
        source.append(owners.astype(np.int64))
        index[left[agree]] = count + owner[agree]
        left, count = left[~agree], count + len(owners)
    return np.concatenate(source), index.reshape(-1, 3), np.concatenate(means)


def _hull(points: Floats) -> Floats:
    """The corners (N, 3) of the convex hull of points (V, 3), flat ones too."""
    middle = points.mean(axis=0)
    _, spread, axes = np.linalg.svd((points - middle).T @ (points - middle))
    rank = 3 if spread[2] > 1e-12 * spread[0] else 2
    return np.asarray(points[np.sort(ConvexHull((points - middle) @ axes[:rank].T).vertices)])


def _used(faces: NDArray[np.int64], count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The vertices that faces use (V',), and the faces counted in these."""
    used = np.zeros(count, dtype=bool)
    used[faces] = True
    return np.flatnonzero(used), (np.cumsum(used) - 1)[faces]


def _repaired(normals: Floats, vertices: Floats, faces: NDArray[np.int64]) -> Floats:
    """Unit normals (V, 3), those without a direction replaced by the faces' mean."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    bad = ~np.isfinite(length[:, 0]) | (length[:, 0] < 1e-12)
    if bad.any():
        flat, angles = _face_normals(vertices, faces)
        mean = np.zeros_like(normals)
        np.add.at(mean, faces.ravel(), (flat[:, None] * angles[..., None]).reshape(-1, 3))
        normals = np.where(bad[:, None], np.where(np.abs(mean).max(axis=1, keepdims=True) > 1e-12, mean, 1.0), normals)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(normals / length)


def _checked(label: str, vertices: NDArray[Any], faces: NDArray[Any]) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices (V, 3) and faces (F, 3) that can be worked with. Raises MeshError."""
    if vertices.size == 0:
        raise MeshError(f"{label} is an empty mesh: it has no vertices. Export it again, as a triangle mesh.")
    if faces.size == 0:
        raise MeshError(
            f"{label} has {len(vertices)} vertices and no faces: posekit renders surfaces, so it needs a triangle mesh."
        )
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise MeshError(f"{label}: vertices are (V, 3) and faces (F, 3), not {vertices.shape} and {faces.shape}.")
    v, f = vertices.astype(np.float64), faces.astype(np.int64)
    bad = ~(np.abs(v) < _FARTHEST).all(axis=1)
    if bad.any():
        raise MeshError(
            f"{label} has {bad.sum()} vertices that are NaN, infinite or beyond {_FARTHEST:g} (the first is number "
            f"{bad.argmax()}): "
            "repair it, or export it again."
        )
    if f.min() < 0 or f.max() >= len(v):
        wrong = int(f.max() if f.max() >= len(v) else f.min())
        raise MeshError(
            f"{label} has a face that names vertex {wrong}, but its vertices are 0 to {len(v) - 1}: the file is "
            "damaged; export it again."
        )
    return v, f


def _rows(label: str, name: str, values: ArrayLike, count: int) -> NDArray[Any]:
    """An array with a row of numbers for each vertex. Raises MeshError."""
    array = np.asarray(values)
    if array.ndim != 2 or len(array) != count or not np.isfinite(array).all():
        raise MeshError(
            f"{label}: {name} must be finite numbers in {count} rows, one for each vertex, not {array.shape}."
        )
    return array


# --- files ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Part:
    """A mesh of one material, in the scene's place. Fields as ObjectModel's, in the file's units."""

    vertices: Floats
    faces: NDArray[np.int64]
    normals: Floats | None = None
    colors: NDArray[np.uint8] | None = None
    uvs: Floats | None = None
    texture: NDArray[np.uint8] | None = None


class _Assets(trimesh.resolvers.FilePathResolver):
    """The files that a mesh names: materials, textures, buffers. trimesh goes on without one that it cannot have;
    this remembers what was wrong, so that `_read` can refuse."""

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


def _read(path: Path) -> list[_Part]:
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
            io.BytesIO(put_right(kind, data, path.name, assets.get)),
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
    except Exception as error:  # trimesh raises whatever its parsers stumble over
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
    """What trimesh has to be told about a file's contents."""
    kind = path.suffix.lower()
    if kind == ".ply":
        # texture coordinates at a face's corners need vertices split; at vertices they must stay as they are
        return {"fix_texture": b" texcoord" in data[: data.find(b"end_header")]}
    return {}


def _parts(scene: trimesh.Scene, label: str) -> list[_Part]:
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


def _part(mesh: Any, label: str) -> _Part:
    vertices, faces = _checked(label, np.asarray(mesh.vertices), np.asarray(mesh.faces))
    # trimesh computes normals on demand, but from split seams; only the file's own are wanted
    has_normals = "vertex_normals" in mesh._cache.cache
    normals = np.asarray(mesh.vertex_normals, dtype=np.float64) if has_normals else None
    elements = mesh.metadata.get("_ply_raw")
    sources = np.arange(len(faces))
    if elements is not None and (cut := ply_faces(elements, vertices, label)) is not None:
        faces, sources = cut
    part = _Part(vertices, faces, normals)
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


def _faceted(part: _Part, colors: NDArray[np.uint8]) -> _Part:
    """The part with a colour for each face (F, 3): no two faces share a vertex."""
    corners = part.faces.ravel()
    return _Part(
        part.vertices[corners],
        np.arange(len(corners)).reshape(-1, 3),
        None if part.normals is None else part.normals[corners],
        np.repeat(colors, 3, axis=0),
    )


def _with_material(part: _Part, mesh: Any, label: str) -> _Part:
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


def _placed(part: _Part, transform: Floats) -> _Part:
    """A part moved by its node's affine transform (4, 4)."""
    if np.array_equal(transform, np.eye(4)):
        return part
    A = transform[:3, :3]
    faces = part.faces[:, ::-1] if np.linalg.det(A) < 0 else part.faces  # a mirror turns faces inside out
    normals = None if part.normals is None else part.normals @ np.linalg.pinv(A) * np.sign(np.linalg.det(A))
    return replace(part, vertices=part.vertices @ A.T + transform[:3, 3], faces=faces, normals=normals)


def _merge(parts: list[_Part], label: str) -> _Part:
    """One mesh out of a file's parts."""
    if any(part.texture is not None for part in parts):
        parts = _on_one_texture(parts, label)
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    colors = None
    if any(part.colors is not None for part in parts):
        plain = np.asarray(_PLAIN, dtype=np.uint8)
        colors = np.concatenate([np.tile(plain, (len(p.vertices), 1)) if p.colors is None else p.colors for p in parts])
    normals = [part.normals for part in parts if part.normals is not None]
    uvs = [part.uvs for part in parts if part.uvs is not None]
    return _Part(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)]),
        np.concatenate(normals) if len(normals) == len(parts) else None,
        colors if parts[0].texture is None else None,
        np.concatenate(uvs) if len(uvs) == len(parts) else None,
        parts[0].texture,
    )


def _on_one_texture(parts: list[_Part], label: str) -> list[_Part]:
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


def _plain_tile(part: _Part, label: str) -> NDArray[np.uint8]:
    colors = np.array([_PLAIN], dtype=np.uint8) if part.colors is None else np.unique(part.colors, axis=0)
    if len(colors) > 1:
        raise MeshError(
            f"{label} has parts with a texture and parts with vertex colours: bake them into one texture, "
            "or give all of them vertex colours."
        )
    return np.tile(colors[0], (8, 8, 1))


def _reach(part: _Part, label: str) -> tuple[int, int, int, int]:
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


# --- units and symmetries of a file -----------------------------------------------------------------------------


def _chosen_units(label: str, diameter: float, units: str) -> str:
    """One of UNITS. Raises MeshError where nobody can tell, or where the size is no object's."""
    if units == "auto":
        if _METRES_BELOW <= diameter <= _MM_ABOVE:
            could_be = "; ".join(f"{unit}: {_plain_length(diameter * UNITS[unit])} long" for unit in UNITS)
            raise MeshError(
                f"{label} has a diameter of {diameter:.3g} in its own units, which could be metres or millimetres: "
                f"{_give_units('m', 'mm')}, or another ({could_be})."
            )
        chosen = "m" if diameter < _METRES_BELOW else "mm"
    else:
        chosen = units
    if not _plausible(diameter, chosen):
        fitting = [unit for unit in ("m", "mm", "cm", "in") if unit != chosen and _plausible(diameter, unit)]
        if fitting:
            advice = f"posekit works in metres: {_give_units(*fitting)}."
        else:
            advice = "posekit works with objects from 1 mm to 10 m: scale the mesh."
        raise MeshError(f"{label} has a diameter of {diameter:.3g} {chosen}; {advice}")
    if units == "auto":
        name = {"mm": "millimetres", "m": "metres"}[chosen]
        others = [unit for unit in UNITS if unit != chosen and _plausible(diameter, unit)]
        log.info(
            "%s: a diameter of %.4g, so its units are taken for %s: the object is %s long (%s to say so%s).",
            label, diameter, name, _plain_length(diameter * UNITS[chosen]), _give_units(chosen),
            "".join(f"; in {unit} it is {_plain_length(diameter * UNITS[unit])} long" for unit in others),
        )  # fmt: skip
    return chosen


def _give_units(*units: str) -> str:
    """What to do to have one of these units, for both kinds of users."""
    options, values = (" or ".join(form.format(u) for u in units) for form in ("--units {}", "units={!r}"))
    return f"give {options} ({values} in Python)"


def _plain_length(metres: float) -> str:
    """A length as people say it: 27 mm, 12.5 cm, 1.8 m."""
    if metres < 0.1:
        return f"{metres * 1000:.3g} mm"
    return f"{metres * 100:.3g} cm" if metres < 1 else f"{metres:.3g} m"


def _plausible(diameter: float, units: str) -> bool:
    return _SMALLEST <= diameter * UNITS[units] <= _LARGEST


def _symmetries(given: str | Symmetries | None, path: Path, model: ObjectModel) -> Symmetries:
    if isinstance(given, Symmetries):
        return given
    if given is None:
        info = path.parent / "models_info.json"
        return _symmetries_from_file(info, path) if info.is_file() else Symmetries.none()
    if given.lower().endswith(".json"):
        if not Path(given).is_file():
            raise MeshError(f"there is no symmetry file {given}: check the path, or pass a text such as z:2.")
        return _symmetries_from_file(Path(given), path)
    return Symmetries.parse(given, model.center)


def _symmetries_from_file(file: Path, mesh: Path) -> Symmetries:
    """The entry for a mesh in a file of models_info.json's form, or of an entry's own form (mm)."""
    try:
        data = json.loads(read_text(file))
        if not isinstance(data, dict):
            raise ValueError("its outermost part is not {...}")
        number = re.fullmatch(r"obj_(\d+)", mesh.stem)
        keys = [mesh.stem, *([str(int(number[1]))] if number else [])]
        own = data if any(key.startswith("symmetries_") for key in data) else {}
        return Symmetries.from_bop(next((data[key] for key in keys if key in data), own))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise MeshError(
            f"the symmetries in {file} cannot be used ({error}): give symmetries_discrete as lists of 16 numbers and "
            "symmetries_continuous as {axis, offset}, in mm, as BOP's models_info.json does."
        ) from error

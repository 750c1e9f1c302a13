"""ObjectModel: a mesh in metres, with its symmetries."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from posekit.errors import MeshError
from posekit.geometry import Pose, fibonacci_sphere
from posekit.mesh.atlas import merge
from posekit.mesh.kept import keep, kept_file, read_kept
from posekit.mesh.processing import (
    carried_uvs,
    checked_mesh,
    coincident,
    convex_hull,
    face_areas,
    mean_colors,
    repaired_normals,
    smooth_normals,
    used_vertices,
    vertex_rows,
)
from posekit.mesh.symmetries import Symmetries, symmetries_of
from posekit.mesh.units import UNITS, chosen_units

Floats = NDArray[np.float64]


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
        above 20; what is taken is logged, with the object's length.
        symmetry: a text for `Symmetries.parse`, a JSON file's name, or symmetries; otherwise they are read from a
        ``models_info.json`` beside the mesh (``obj_000009.ply`` by its number, other names by their stem).

        The parts of a GLB or OBJ become one mesh, in the scene's places; several textures become one. Normals are
        the file's, else `smooth_normals`. A GLB's colours are taken as sRGB.
        Raises MeshError where the file is no usable mesh, lacks a texture, or has an implausible size.
        """
        path = Path(path)
        if units not in ("auto", *UNITS):
            raise MeshError(f"units are auto, {', '.join(UNITS)}, not {units!r}.")
        file = kept_file(path, units)
        model = (file and cls._kept(file, path, units)) or cls._read(path, units, file)
        return model._with_measures(replace(model, symmetries=symmetries_of(symmetry, path, model.center)))

    @classmethod
    def _read(cls, path: Path, units: str, file: Path | None) -> ObjectModel:
        """From a mesh file; a mesh that `kept` allows is kept in ``file`` for the next time."""
        from posekit.mesh.reading import read_parts  # with trimesh, which takes long to import

        merged = merge(read_parts(path), path.name)
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
        size = model.diameter
        units = chosen_units(path.name, size, units)
        scaled = (model.vertices * np.float64(UNITS[units])).astype(np.float32)
        model = replace(model, vertices=scaled, units=units)
        if file is not None and model.texture is None:
            arrays = {name: getattr(model, name) for name in ("vertices", "faces", "normals", "colors")}
            measured = {"hull": model.hull_vertices, "diameter": np.array(model.diameter), "size": np.array(size)}
            keep(file, path, arrays | measured)
        return model

    @classmethod
    def _kept(cls, file: Path, path: Path, units: str) -> ObjectModel | None:
        """As `_read` kept it; None where it did not."""
        arrays = read_kept(file)
        if arrays is None:
            return None
        units = chosen_units(path.name, float(arrays["size"]), units)
        model = cls(
            path.stem, arrays["vertices"], arrays["faces"], arrays["normals"], arrays.get("colors"), units=units
        )
        vars(model).update(hull_vertices=arrays["hull"], diameter=float(arrays["diameter"]))
        return model

    def _with_measures(self, other: ObjectModel) -> ObjectModel:
        """Another model of the same vertices, with what is known of this one's."""
        measures = ("hull_vertices", "diameter", "bounds", "center")
        vars(other).update({name: vars(self)[name] for name in measures if name in vars(self)})
        return other

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
        v, f = checked_mesh(label, np.asarray(vertices), np.asarray(faces))
        f = f[face_areas(v, f) > 1e-14 * float(np.ptp(v, axis=0).max()) ** 2]
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
            source, f = used_vertices(f, len(v))
            unit = repaired_normals(np.asarray(normals, dtype=np.float64)[source], v[source], f)
        rgb = (
            None if colors is None or texture is not None else vertex_rows(label, "colors", colors, len(v))[source, :3]
        )
        uv = None if uvs is None else vertex_rows(label, "uvs", uvs, len(v))[source, :2]
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

    @property
    def coloured(self) -> bool:
        """Whether it has a texture or colours of its own."""
        return self.colors is not None or self.texture is not None

    @cached_property
    def bounds(self) -> Floats:
        """(2, 3), the bounding box's lower and upper corner in ``obj``."""
        limits = [(axis.min(), axis.max()) for axis in self.vertices.T]  # ten times as fast as along the first axis
        return np.array(limits, dtype=np.float64).T.copy()

    @cached_property
    def center(self) -> Floats:
        """(3,), the bounding box's centre in ``obj``."""
        return np.asarray(self.bounds.mean(axis=0))

    @cached_property
    def extents(self) -> Floats:
        """(3,), the bounding box's sides."""
        return np.asarray(self.bounds[1] - self.bounds[0])

    @cached_property
    def hull_vertices(self) -> Floats:
        """(N, 3), the corners of the convex hull in ``obj``: all that decides which box the object fills."""
        return convex_hull(self.vertices.astype(np.float64))

    @cached_property
    def diameter(self) -> float:
        """The largest distance of two vertices; within 0.1 % of it where the hull has thousands of corners."""
        points = self.hull_vertices
        if len(points) > 4000:
            parts = np.array_split(fibonacci_sphere(4000), 16)  # one matrix for all would take much memory
            points = points[np.unique(np.concatenate([(part @ points.T).argmax(axis=1) for part in parts]))]
        from scipy.spatial.distance import pdist  # not where the diameter is kept: SciPy takes long to import

        return float(pdist(points).max())

    @cached_property
    def hull_ctr(self) -> Floats:
        """(N, 3), `hull_vertices` in ``ctr``."""
        return self.hull_vertices - self.center

    @cached_property
    def T_obj_ctr(self) -> Pose:
        """From ``ctr`` (the mesh's axes, the origin at `center`) to ``obj``."""
        return Pose.translation(self.center)

    @cached_property
    def T_ctr_obj(self) -> Pose:
        """From ``obj`` to ``ctr``."""
        return self.T_obj_ctr.inverse()

    def simplified(self, faces: int) -> ObjectModel:
        """The same object with about so many faces, to be drawn small and often; itself where it has no more.

        Its shape errs least for its number of faces (quadric error metrics: Garland and Heckbert, 1997). Colours are
        means of those near by; a face's place in the texture is that of the face that lay at its middle.
        """
        if len(self.faces) <= faces:
            return self
        import fast_simplification

        welded = coincident(self.vertices.astype(np.float64))
        first = np.empty(int(welded.max()) + 1, dtype=np.int64)
        first[welded[::-1]] = np.arange(len(welded))[::-1]
        vertices, kept = fast_simplification.simplify(
            self.vertices[first], welded[self.faces].astype(np.int32), target_count=faces
        )
        colors = uvs = None
        if self.colors is not None:
            colors = mean_colors(vertices, self.vertices, self.colors)
        if self.uvs is not None:
            source, kept, uvs = carried_uvs(vertices, kept, self.vertices[self.faces], self.uvs[self.faces])
            vertices = vertices[source]
        model = ObjectModel.from_arrays(
            vertices, kept, name=self.name, colors=colors, uvs=uvs, texture=self.texture, symmetries=self.symmetries
        )
        return replace(model, units=self.units)

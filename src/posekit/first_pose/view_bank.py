"""Pictures of a mesh from all sides, with the points that they show.

Lengths are in diameters of the object, points in its centred frame. A view shows the object at `DISTANCE` from one
direction, scaled so that it fills the picture; a template is a view turned by a multiple of 90 degrees in the picture:
template ``TURNS * view + turn``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.geometry import Pose, fibonacci_sphere, view_rotation
from posekit.mesh.model import ObjectModel
from posekit.nets.mvnet import VIEW
from posekit.render import Light, Renderer

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

VIEWS = 42
DISTANCE = 4.0  # of the views' camera, in diameters
FILL = 0.9  # of a view's side that the object takes
TURNS = 4
HEADLIGHT = Light(ambient=0.5, direction=(0.0, 0.0, -1.0), diffuse=0.5, specular=0.0)
_QUARTER = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # what np.rot90 does to a picture's frame


@dataclass(frozen=True, eq=False)
class ViewBank:
    """A mesh from M directions. pictures: uint8 (M, 64, 64, 4), RGB and mask. coords: float16 (M, 64, 64, 3), the
    points seen. rotations: (M, 3, 3), R_view_ctr. intrinsics: (M, 3), focal length and principal point, pixels."""

    pictures: Image
    coords: NDArray[np.float16]
    rotations: Array
    intrinsics: Array

    @classmethod
    def of(
        cls,
        model: ObjectModel,
        renderer: Renderer,
        directions: Array | None = None,
        coloured: ObjectModel | None = None,
    ) -> ViewBank:
        """directions: (M, 3), where the camera stands; `VIEWS` even ones where not given. coloured: the mesh in other
        colours, where it is to be drawn so."""
        rotations = np.stack(
            [view_rotation(d) for d in (fibonacci_sphere(VIEWS) if directions is None else directions)]
        )
        outline = (model.hull_ctr) / model.diameter
        inside = np.stack([_fitted(R, outline) for R in rotations])
        cameras = [Camera(f, f, cx, cy, VIEW, VIEW) for f, cx, cy in inside]
        place = np.array([0.0, 0.0, DISTANCE * model.diameter])
        poses = [Pose(R, place) @ model.T_ctr_obj for R in rotations]
        drawn = renderer.render(model if coloured is None else coloured, poses, cameras, light=HEADLIGHT)
        masks = np.stack([np.asarray(v.mask) for v in drawn])
        coords = (np.stack([np.asarray(v.coords) for v in drawn]) - model.center) / model.diameter
        pictures = np.concatenate([np.stack([v.image for v in drawn]), masks[..., None] * np.uint8(255)], axis=3)
        return cls(pictures, (coords * masks[..., None]).astype(np.float16), rotations, inside)

    @property
    def template_rotations(self) -> Array:
        """(M * TURNS, 3, 3)."""
        turns = np.stack([np.linalg.matrix_power(_QUARTER, k) for k in range(TURNS)])
        return (turns[None] @ self.rotations[:, None]).reshape(-1, 3, 3)

    def templates(self, index: NDArray[np.int64] | None = None) -> Image:
        """Pictures uint8 (K, 64, 64, 4) of templates ``index`` (K,); of all where not given."""
        every = np.arange(len(self.pictures) * TURNS) if index is None else index
        return np.stack([np.rot90(self.pictures[i // TURNS], i % TURNS) for i in every])

    def template_coords(self, index: int) -> NDArray[np.float32]:
        """(64, 64, 3), the points seen in a template; zero where there is none."""
        return np.rot90(self.coords[index // TURNS], index % TURNS).astype(np.float32)

    def template_camera(self, index: int) -> Camera:
        """The camera that template ``index`` was rendered with, turned with its picture; square, pixels."""
        f, cx, cy = self.intrinsics[index // TURNS]
        for _ in range(index % TURNS):
            cx, cy = cy, VIEW - 1 - cx
        return Camera(f, f, cx, cy, VIEW, VIEW)

    def locate(self, points: Array, index: NDArray[np.int64], tolerance: float) -> tuple[Array, NDArray[np.bool_]]:
        """Where points (N, 3) lie in templates ``index`` (k,), pixels (k, N, 2), and whether they are seen there,
        (k, N): whether the surface there is nearer to them than ``tolerance``."""
        view, turn = index // TURNS, index % TURNS
        seen_from = points @ self.rotations[view].transpose(0, 2, 1) + [0.0, 0.0, DISTANCE]
        f, c = self.intrinsics[view, None, :1], self.intrinsics[view, None, 1:]
        pixels = seen_from[..., :2] / seen_from[..., 2:] * f + c
        near = np.rint(pixels).astype(int)
        inside = ((near >= 0) & (near < VIEW)).all(2)
        u, v = near[..., 0].clip(0, VIEW - 1), near[..., 1].clip(0, VIEW - 1)
        on = self.pictures[view[:, None], v, u, 3] > 0
        away = self.coords[view[:, None], v, u].astype(np.float64) - points
        seen = inside & on & ((away * away).sum(2) < tolerance * tolerance)
        for k in range(1, TURNS):
            rows = turn >= k  # a quarter more for these
            pixels[rows] = np.stack([pixels[rows, :, 1], VIEW - 1 - pixels[rows, :, 0]], axis=2)
        return pixels, seen


def _fitted(R: Array, outline: Array) -> Array:
    """Focal length and principal point (3,) with which the points fill a view's picture."""
    points = outline @ R.T + [0.0, 0.0, DISTANCE]
    uv = points[:, :2] / points[:, 2:]
    low, high = uv.min(0), uv.max(0)
    f = FILL * VIEW / max(float((high - low).max()), 0.25 / DISTANCE)
    return np.array([f, *(0.5 * (VIEW - 1) - f * 0.5 * (low + high))])

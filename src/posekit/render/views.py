"""Pictures of a model alone, from all sides: the paper's six views, templates, contact sheets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.geometry import Pose, cube_views, fibonacci_sphere, view_rotation
from posekit.mesh.model import ObjectModel
from posekit.render.light import DEFAULT_LIGHT, Light
from posekit.render.renderer import Renderer
from posekit.view import View

SIX_VIEWS = 6
DEFAULT_FOV = float(np.deg2rad(40.0))
_MARGIN = 1.05


def view_rotations(n: int) -> list[NDArray[np.float64]]:
    """R_view_obj (3, 3) of n views: the paper's for six, else spread evenly over the sphere.

    Raises ValueError where n is not positive.
    """
    if n < 1:
        raise ValueError(f"view_rotations: {n} views; at least 1 is needed")
    if n == SIX_VIEWS:
        return cube_views()
    return [view_rotation(direction) for direction in fibonacci_sphere(n)]


def fit_distance(model: ObjectModel, camera: Camera) -> float:
    """How far (metres) the model's centre must be on the optical axis for its bounding sphere to fit the picture."""
    radius = float(np.linalg.norm(model.vertices.astype(np.float64) - model.center, axis=1).max())
    corners = camera.box_corner_rays((0, 0, *camera.size))
    narrowest = float(np.abs(corners[:, :2]).min())  # tangent of the angle to the nearest side
    return _MARGIN * radius / float(np.sin(np.arctan(narrowest)))


def centred_poses(model: ObjectModel, rotations: Sequence[NDArray[np.float64]], camera: Camera) -> list[Pose]:
    """T_view_obj with the model's centre on the optical axis, as near as fits; rotations: R_view_obj (3, 3)."""
    centre_view = np.array([0.0, 0.0, fit_distance(model, camera)])
    return [Pose(R, centre_view - np.asarray(R) @ model.center) for R in rotations]


def render_views(
    renderer: Renderer,
    model: ObjectModel,
    rotations: Sequence[NDArray[np.float64]],
    size: tuple[int, int],
    *,
    fov: float = DEFAULT_FOV,
    light: Light | Sequence[Light] | None = DEFAULT_LIGHT,
    rgb: bool = True,
    coords: bool = True,
) -> list[View]:
    """A View of the whole model for each R_view_obj (3, 3).

    size: (width, height) in pixels; fov: of the longer side, radians. See ``Renderer.render`` for the rest.
    """
    camera = Camera.from_fov(fov, *size)
    poses = centred_poses(model, rotations, camera)
    return renderer.render(model, poses, camera, light=light, rgb=rgb, coords=coords)

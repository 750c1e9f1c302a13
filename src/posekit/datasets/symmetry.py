"""Symmetries found by comparing renderings: does a mesh look the same after a turn about one of its axes?"""

from __future__ import annotations

import numpy as np

from posekit.camera import Camera
from posekit.geometry import Pose, fibonacci_sphere, so3_exp, view_rotation
from posekit.mesh.model import ObjectModel
from posekit.mesh.symmetries import Symmetries
from posekit.render import Renderer
from posekit.render.views import DEFAULT_FOV, fit_distance
from posekit.view import View

VIEWS, SIDE = 8, 96  # pictures that are compared, their sides in pixels
DEPTH = 0.02  # of the diameter: deeper differences count
PIXELS, COLOUR = 0.03, 12.0  # largest share of pixels that differ, and largest mean difference of colour
ORDERS = (12, 8, 6, 5, 4, 3, 2)
ARBITRARY_TURNS = (0.31, 1.0, 2.43)  # turns (radians) after which only a body of revolution looks the same


def detect_symmetries(renderer: Renderer, model: ObjectModel) -> Symmetries:
    """Turns about lines along the mesh's x, y and z through its box's centre that change neither the rendered shape nor
    the colours.

    Other axes and mirrors are not looked for: give such symmetries in a models_info.json.
    """
    camera = Camera.from_fov(DEFAULT_FOV, SIDE, SIDE)
    away = np.array([0.0, 0.0, fit_distance(model, camera)])
    poses = [Pose(view_rotation(d), away) for d in fibonacci_sphere(VIEWS)]
    before = _seen(renderer, model, poses, camera)
    items = []
    for axis, name in zip(np.eye(3), "xyz", strict=True):

        def holds(angle: float, axis: np.ndarray = axis) -> bool:
            turned = [pose @ Pose.rotation(so3_exp(axis * angle)) for pose in poses]
            return _same_appearance(before, _seen(renderer, model, turned, camera), DEPTH * model.diameter)

        if all(holds(angle) for angle in ARBITRARY_TURNS):
            items.append(f"{name}:inf")
        else:
            items += [f"{name}:{n}" for n in ORDERS if holds(2 * np.pi / n)][:1]
    return Symmetries.parse(",".join(items) or "none", model.center)


def _seen(renderer: Renderer, model: ObjectModel, poses: list[Pose], camera: Camera) -> list[View]:
    """poses: T_cam_ctr."""
    return renderer.render(model, [pose @ model.T_ctr_obj for pose in poses], camera, light=None)


def _same_appearance(before: list[View], after: list[View], depth: float) -> bool:
    differing = total = 0
    colours: list[float] = []
    for a, b in zip(before, after, strict=True):
        assert a.mask is not None and b.mask is not None and a.depth is not None and b.depth is not None
        both = a.mask & b.mask
        differing += int((a.mask ^ b.mask).sum()) + int((np.abs(a.depth - b.depth)[both] > depth).sum())
        total += int((a.mask | b.mask).sum())
        colours.append(float(np.abs(a.image[both].astype(float) - b.image[both]).mean()) if both.any() else 255.0)
    return differing <= PIXELS * total and max(colours) <= COLOUR

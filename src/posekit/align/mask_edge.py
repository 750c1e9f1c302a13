"""The last fraction of a degree: the rendered outline laid onto an exact mask's.

A network compares crops of 160x120 pixels. A mask that is exact to the pixel says more than these can show: each point
of the rendered outline should lie on the mask's, and how far it is off, along the outline's normal, is linear in a
small motion of the object. Gauss-Newton on these distances, as edge trackers do (Drummond and Cipolla, 2002), starting
from the network's pose and held near it, where the outline says nothing. A mask may be too large or too small all
round; by how much is found together with the pose. Whether it is exact otherwise shows in the result: a rough mask, or
one of something else, cannot be matched to within a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.align.pnp import projection_jacobian
from posekit.camera import Camera
from posekit.geometry import Pose, nearest_rotation, so3_exp, so3_log
from posekit.mesh.model import ObjectModel
from posekit.render import Renderer
from posekit.view import View
from posekit.zoom import zoom_to_pose

Array = NDArray[np.float64]

LEAST_COVERED, LEAST_SHARE = 0.5, 0.9
STILL = 1e-4  # a step in radians, or in distances of the object, that ends the loop


@dataclass(frozen=True)
class ContourConfig:
    """size: (width, height) of the crop. steps: of Gauss-Newton, each with a rendering. knee: distance in pixels of
    the photograph at which a point loses three quarters of its weight (Geman and McClure). sigma: standard deviation
    of a distance. together: so many neighbouring pixels of the outline err alike. turn, shift, depth: how far the
    given pose may be off, standard deviations in radians, crop pixels, and share of the distance. grown: by how many
    pixels of the photograph the mask may be too large or too small all round, standard deviation. near: distance
    beyond which the mask ends for another reason, such as something in front."""

    size: tuple[int, int] = (320, 240)
    steps: int = 10
    knee: float = 1.0
    sigma: float = 0.3
    together: float = 4.0
    turn: float = float(np.deg2rad(8.0))
    shift: float = 6.0
    depth: float = 0.02
    grown: float = 1.0
    near: float = 4.0


@dataclass(frozen=True, eq=False)
class ContourFit:
    """covered: how much of the rendered outline has the mask's near it, 0 to 1. share: how much of that lies within a
    pixel of it. turn_std: standard deviation of the rotation, radians, as far as outline and given pose tell."""

    T_cam_obj: Pose
    covered: float
    share: float
    turn_std: float

    @property
    def exact(self) -> bool:
        """Whether the mask is as exact as the fit takes it to be (docs/decisions/0012)."""
        return self.covered > LEAST_COVERED and self.share > LEAST_SHARE


def fit_contour(
    view: View, model: ObjectModel, T_cam_obj: Pose, renderer: Renderer, config: ContourConfig = ContourConfig()
) -> ContourFit | None:
    """Move a pose until the object's outline lies on that of ``view.mask``. None where one of them has no outline, or
    the pose leaves the picture. Raises ValueError without a mask."""
    if view.mask is None:
        raise ValueError("a contour can only be fitted to a view that has a mask")
    start, pose, grown = T_cam_obj, T_cam_obj, 0.0
    for _ in range(config.steps):
        look = _look(view, model, pose, renderer, config)
        if look is None:
            return None
        normal, right = _equations(look, look.turned(start), grown, config)
        turn, shift, more = np.split(np.linalg.solve(normal, right), [3, 6])
        moved = Pose(nearest_rotation(so3_exp(turn) @ look.pose.R), look.pose.t + shift)
        if not np.isfinite(moved.matrix).all() or moved.t[2] < 0.6 * model.diameter:
            return None
        pose, grown = look.photograph(moved), grown + float(more[0])
        if np.abs(turn).max() < STILL and np.abs(shift).max() < STILL * moved.t[2]:
            break
    look = _look(view, model, pose, renderer, config)
    if look is None:
        return None
    normal, _ = _equations(look, look.turned(start), grown, config)
    off = np.abs(look.distance - grown)
    near = off < config.near
    share = float((off < 1.0).sum() / max(1, near.sum()))
    return ContourFit(pose, float(near.mean()), share, float(np.sqrt(np.trace(np.linalg.inv(normal)[:3, :3]))))


@dataclass(frozen=True, eq=False)
class _Look:
    """A crop round a pose. pose: its ``T_view_ctr``. points: (N, 3), the rendered outline in ``ctr``. distance: (N,),
    from each to the mask's outline, pixels of the photograph (of the crop, where that is coarser), positive inside.
    direction: (N, 2), its change for one crop pixel. clear: (N,), whether one part of the mask's outline is the
    nearest. pixel: of the distance, in crop pixels."""

    camera: Camera
    R_view_cam: Array
    T_obj_ctr: Pose
    pose: Pose
    points: Array
    distance: Array
    direction: Array
    clear: NDArray[np.bool_]
    pixel: float

    def turned(self, T_cam_obj: Pose) -> Pose:
        """A pose in the photograph, as this crop's ``T_view_ctr``."""
        return Pose.rotation(self.R_view_cam) @ T_cam_obj @ self.T_obj_ctr

    def photograph(self, T_view_ctr: Pose) -> Pose:
        return Pose.rotation(self.R_view_cam.T) @ T_view_ctr @ self.T_obj_ctr.inverse()


def _look(view: View, model: ObjectModel, pose: Pose, renderer: Renderer, config: ContourConfig) -> _Look | None:
    zoom = zoom_to_pose(view.camera, pose @ model.T_obj_ctr, model.outline - model.center, config.size)
    turn = Pose.rotation(zoom.R_view_cam)
    [drawn] = renderer.render(model, [turn @ pose], [zoom.camera], rgb=False, coords=True)
    observed = view.zoomed(zoom).mask
    assert observed is not None and drawn.mask is not None and drawn.coords is not None
    rows, columns = np.nonzero(_outline(drawn.mask))
    if len(rows) < 12 or not observed.any() or observed.all():
        return None
    # a pixel of the outline lies half a pixel inside it
    distance = cv2.GaussianBlur(_signed_distance(observed), (0, 0), 1.0) - 0.5
    down, right = (d[rows, columns] for d in np.gradient(distance))
    pixel = max(1.0, zoom.camera.fx / view.camera.fx)
    return _Look(
        zoom.camera,
        zoom.R_view_cam,
        model.T_obj_ctr,
        turn @ pose @ model.T_obj_ctr,
        drawn.coords[rows, columns].astype(np.float64) - model.center,
        distance[rows, columns].astype(np.float64) / pixel,
        np.stack([right, down], axis=1).astype(np.float64) / pixel,
        np.hypot(right, down) > 0.5,
        pixel,
    )


def _equations(look: _Look, start: Pose, grown: float, config: ContourConfig) -> tuple[Array, Array]:
    """Normal matrix (7, 7) and right side (7,) of a small turn and shift and of what the mask has grown: the outline's
    distances, robustly weighted, and the start as a prior."""
    arm = look.points @ look.pose.R.T
    moves = np.einsum("ni,nij->nj", look.direction, projection_jacobian(arm, arm + look.pose.t, look.camera))
    along = np.column_stack([moves, np.full(len(moves), -1.0)])
    residual = look.distance - grown
    knee = max(config.knee, 1.5 * float(np.median(np.abs(residual))))
    weight = look.clear / (1 + (residual / knee) ** 2) ** 2 / config.sigma**2 / (config.together * look.pixel)
    weighted = along * weight[:, None]
    depth = look.pose.t[2]
    shift = config.shift / look.camera.fx * depth
    prior = np.array([config.turn] * 3 + [shift, shift, config.depth * depth, config.grown]) ** -2.0
    back = np.concatenate([so3_log(start.R @ look.pose.R.T), start.t - look.pose.t, [-grown]])
    return weighted.T @ along + np.diag(prior), prior * back - weighted.T @ residual


def _outline(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask's outermost pixels (H, W), but for those at the picture's edge."""
    worn = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    outline = mask & ~worn
    outline[[0, -1]] = outline[:, [0, -1]] = False
    return outline


def _signed_distance(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Pixels to the mask's outline (H, W), positive inside; a pixel beside the outline is half a pixel away."""
    inside = mask.astype(np.uint8)
    distance = cv2.distanceTransform(inside, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)
    return np.asarray(distance - 0.5 * np.sign(distance), np.float32)

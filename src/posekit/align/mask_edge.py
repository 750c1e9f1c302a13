"""A pose fitted to the edge of an exact mask: the last fraction of a degree.

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

from posekit.align.gauss_newton import Equations, geman_mcclure, normal_equations, projection_jacobian, solve
from posekit.camera import Camera
from posekit.geometry import Pose, so3_log
from posekit.mesh.model import ObjectModel
from posekit.render import Renderer
from posekit.view import View
from posekit.zoom import zoom_to_pose

Array = NDArray[np.float64]

LEAST_COVERED, LEAST_SHARE = 0.5, 0.9
STILL = 1e-4  # a step in radians, or in distances of the object, that ends the loop


@dataclass(frozen=True)
class MaskEdgeConfig:
    """How `fit_mask_edge` works. Standard deviations: sigma, turn, shift, depth, grown."""

    size: tuple[int, int] = (320, 240)  # (width, height) of the crop
    steps: int = 10  # of Gauss-Newton, each with a rendering
    knee: float = 1.0  # pixels of the photograph at which a point loses three quarters of its weight
    sigma: float = 0.3  # pixels, of a distance
    correlated: float = 4.0  # number of neighbouring pixels of the outline whose errors are correlated
    turn: float = float(np.deg2rad(8.0))  # radians that the given pose may be off
    shift: float = 6.0  # likewise, crop pixels
    depth: float = 0.02  # likewise, share of the distance
    grown: float = 1.0  # pixels of the photograph by which the mask may be too large or too small all round
    near: float = 4.0  # pixels beyond which the mask ends for another reason, such as something in front


@dataclass(frozen=True, eq=False)
class MaskEdgeFit:
    """covered: how much of the rendered outline has the mask's near it, 0 to 1. share: how much of that lies within a
    pixel of it. turn_std: standard deviation of the rotation, radians, from the outline and the given pose."""

    T_cam_obj: Pose
    covered: float
    share: float
    turn_std: float

    @property
    def exact(self) -> bool:
        """Whether the mask is as exact as the fit takes it to be (docs/decisions/0012)."""
        return self.covered > LEAST_COVERED and self.share > LEAST_SHARE


def fit_mask_edge(
    view: View, model: ObjectModel, T_cam_obj: Pose, renderer: Renderer, config: MaskEdgeConfig = MaskEdgeConfig()
) -> MaskEdgeFit | None:
    """Move a pose until the object's outline lies on that of ``view.mask``. None where one of them has no outline, or
    the pose leaves the picture. Raises ValueError without a mask."""
    if view.mask is None:
        raise ValueError("a mask's edge can only be fitted in a view that has a mask")
    start = T_cam_obj @ model.T_obj_ctr

    def equations(T_cam_ctr: Pose, grown: Array) -> Equations | None:
        crop = _crop(view, model, T_cam_ctr, renderer, config)
        return None if crop is None else _equations(crop, start, float(grown[0]), config)

    nearest = 0.6 * model.diameter
    found = solve(start, equations, steps=config.steps, still=STILL, extra=1, nearest=nearest)
    crop = None if found is None else _crop(view, model, found.pose, renderer, config)
    if found is None or crop is None:
        return None
    grown = float(found.extra[0])
    normal, _ = _equations(crop, start, grown, config)
    off = np.abs(crop.distance - grown)
    near = off < config.near
    share = float((off < 1.0).sum() / max(1, near.sum()))
    turn_std = float(np.sqrt(np.trace(np.linalg.inv(normal)[:3, :3])))
    return MaskEdgeFit(found.pose @ model.T_ctr_obj, float(near.mean()), share, turn_std)


@dataclass(frozen=True, eq=False)
class _Crop:
    """A crop round a pose. pose: its ``T_view_ctr``. points: (N, 3), the rendered outline in ``ctr``. distance: (N,),
    from each to the mask's outline, pixels of the photograph (of the crop, where that is coarser), positive inside.
    direction: (N, 2), its change for one crop pixel. clear: (N,), whether one part of the mask's outline is the
    nearest. pixel: of the distance, in crop pixels."""

    camera: Camera
    R_view_cam: Array
    pose: Pose
    points: Array
    distance: Array
    direction: Array
    clear: NDArray[np.bool_]
    pixel: float


def _crop(view: View, model: ObjectModel, T_cam_ctr: Pose, renderer: Renderer, config: MaskEdgeConfig) -> _Crop | None:
    zoom = zoom_to_pose(view.camera, T_cam_ctr, model.hull_ctr, config.size)
    T_view_ctr = Pose.rotation(zoom.R_view_cam) @ T_cam_ctr
    [drawn] = renderer.render(model, [T_view_ctr @ model.T_ctr_obj], [zoom.camera], rgb=False, coords=True)
    observed = view.zoomed(zoom).mask
    assert observed is not None and drawn.mask is not None and drawn.coords is not None
    rows, columns = np.nonzero(_outline(drawn.mask))
    if len(rows) < 12 or not observed.any() or observed.all():
        return None
    # a pixel of the outline lies half a pixel inside it
    distance = cv2.GaussianBlur(_signed_distance(observed), (0, 0), 1.0) - 0.5
    down, right = (d[rows, columns] for d in np.gradient(distance))
    pixel = max(1.0, zoom.camera.fx / view.camera.fx)
    return _Crop(
        zoom.camera,
        zoom.R_view_cam,
        T_view_ctr,
        drawn.coords[rows, columns].astype(np.float64) - model.center,
        distance[rows, columns].astype(np.float64) / pixel,
        np.stack([right, down], axis=1).astype(np.float64) / pixel,
        np.hypot(right, down) > 0.5,
        pixel,
    )


def _equations(crop: _Crop, start: Pose, grown: float, config: MaskEdgeConfig) -> Equations:
    """Normal matrix (7, 7) and right side (7,) of a small turn and shift, in the photograph's axes, and of what the
    mask has grown: the outline's distances, robustly weighted, and the start ``T_cam_ctr`` as a prior."""
    arm = crop.points @ crop.pose.R.T
    moves = np.einsum("ni,nij->nj", crop.direction, projection_jacobian(arm, arm + crop.pose.t, crop.camera))
    along = np.column_stack([moves, np.full(len(moves), -1.0)])
    residual = crop.distance - grown
    weight = crop.clear * geman_mcclure(np.abs(residual), config.knee)
    weight /= config.sigma**2 * config.correlated * crop.pixel
    normal, right = normal_equations(along[:, None], residual[:, None], weight)
    there = Pose.rotation(crop.R_view_cam) @ start
    depth = crop.pose.t[2]
    shift = config.shift / crop.camera.fx * depth
    prior = np.array([config.turn] * 3 + [shift, shift, config.depth * depth, config.grown]) ** -2.0
    back = np.concatenate([so3_log(there.R @ crop.pose.R.T), there.t - crop.pose.t, [-grown]])
    normal, right = normal + np.diag(prior), right + prior * back
    axes = np.eye(7)
    axes[:3, :3] = axes[3:6, 3:6] = crop.R_view_cam
    return axes.T @ normal @ axes, axes.T @ right


def _outline(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask's outermost pixels (H, W), but for those at the picture's edge."""
    eroded = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    outline = mask & ~eroded
    outline[[0, -1]] = outline[:, [0, -1]] = False
    return outline


def _signed_distance(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Pixels to the mask's outline (H, W), positive inside; a pixel beside the outline is half a pixel away."""
    inside = mask.astype(np.uint8)
    distance = cv2.distanceTransform(inside, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)
    return np.asarray(distance - 0.5 * np.sign(distance), np.float32)

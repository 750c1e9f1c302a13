"""The loop: zoom, render, predict, update; it keeps a trace.

Paper, section 3.3: the pose is updated until SV-Net's own predicted angle falls below 2 degrees; where that does not
happen within 50 iterations, the iterate with the lowest predicted angle wins. A loop whose pose no longer moves, or
whose predicted angle has not fallen for some time, ends earlier, which changes almost nothing (docs/decisions/0005).
DeepIM's fixed number of iterations is the other policy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.align.colour_edge import learn, outline_lines
from posekit.align.gauss_newton import Points, fuse
from posekit.align.pnp import solve_pnp
from posekit.errors import ConfigError
from posekit.geometry import Pose, rotation_angle
from posekit.mesh.model import ObjectModel
from posekit.nets.pose_delta import apply_delta
from posekit.nets.predictor import Correspondences, PairPrediction, Predictor
from posekit.render import Renderer
from posekit.results import Step
from posekit.view import View
from posekit.zoom import zoom_to_pose

UPDATES = ("regression", "correspondence")
STOPS = ("angle", "fixed")
STILL = float(np.deg2rad(0.25))  # of turns, and as a share of the distance: a pose that moves less is converged
NEAR = float(np.deg2rad(12.0))  # corrections below which the outline is looked for: further off it is out of reach
LEAST_SCALE, KNEE = 0.5, 2.5  # pixels, no correspondence is more exact; standard deviations
# number of correspondences whose errors are correlated: they count as one against the outline's lines
CORRELATED = 12.0


@dataclass(frozen=True)
class RefineOptions:
    """The refinement loop."""

    update: str = "correspondence"  # what moves the pose, the regressed delta or the correspondences through PnP
    stop: str = "angle"  # ``angle`` (the paper's policy) or ``fixed`` (DeepIM's)
    iterations: int = 50  # at most, or exactly
    stop_angle: float = float(np.deg2rad(2.0))  # radians
    last_update: bool = True  # also apply the update predicted for the pose that ended the loop
    patience: int = 8  # with ``angle``, how many iterations may pass without a new lowest predicted angle
    # whether the place of the outline that the photograph's colours show is weighed against the correspondences, once
    # these ask for small turns only (see `with_colour_edge`)
    colour_edge: bool = True

    def __post_init__(self) -> None:
        if self.update not in UPDATES or self.stop not in STOPS:
            raise ConfigError(
                f"update is one of {UPDATES} and stop one of {STOPS}, not {self.update!r}, {self.stop!r}."
            )
        if min(self.iterations, self.patience) < 1 or not 0 < self.stop_angle <= np.pi:
            raise ConfigError(
                f"iterations and patience must be at least 1 and the stop angle between 0 and 180 degrees, not "
                f"{self.iterations}, {self.patience} and {np.rad2deg(self.stop_angle):g}."
            )


@dataclass(frozen=True, eq=False)
class Refinement:
    """Where one starting pose led. angle: the predicted rotation error that the choice rests on, radians."""

    T_cam_obj: Pose
    angle: float
    iterations: int
    converged: bool
    trace: tuple[Step, ...]

    def then(self, later: Refinement, stop: str) -> Refinement:
        """This one and what followed when it went on from its pose. With the policy ``angle`` the lowest predicted
        angle of both wins, unless the later one converged; with ``fixed`` the later one does."""
        earlier = stop == "angle" and not later.converged and self.angle < later.angle
        best = self if earlier else later
        return replace(best, iterations=self.iterations + later.iterations, trace=self.trace + later.trace)


def refine(
    view: View,
    model: ObjectModel,
    starts: Sequence[Pose],
    predictor: Predictor,
    renderer: Renderer,
    options: RefineOptions = RefineOptions(),
) -> list[Refinement]:
    """Refine every starting ``T_cam_obj`` against the same photograph, in one batch per iteration.

    view: the photograph with its camera and, where known, the object's mask.
    Raises ConfigError where the update needs correspondences and the predictor gives none.
    """
    if options.update == "correspondence" and not predictor.dense:
        raise ConfigError("this preset predicts no correspondences: the update is regression (--update regression).")
    hull = model.hull_ctr
    loops = [_Loop(start) for start in starts]
    for _ in range(options.iterations):
        active = [loop for loop in loops if not loop.done]
        if not active:
            break
        poses = [loop.pose for loop in active]
        predictions, observed, rendered = compare(view, model, hull, poses, predictor, renderer)
        for loop, prediction, seen, drawn in zip(active, predictions, observed, rendered, strict=True):
            updated = update_pose(loop.pose, model, prediction, seen, drawn, options.update, options.colour_edge)
            loop.advance(predicted_angle(loop.pose, prediction, updated, options.update), updated, options)
    return [loop.finish(options) for loop in loops]


def compare(
    view: View,
    model: ObjectModel,
    hull: NDArray[np.float64],
    poses: Sequence[Pose],
    predictor: Predictor,
    renderer: Renderer,
) -> tuple[list[PairPrediction], list[View], list[View]]:
    """Zoom to each pose, draw the object there, and let the predictor compare. poses: ``T_cam_obj``."""
    observed, rendered = crops(view, model, hull, poses, predictor.size, renderer, coords=predictor.dense)
    return predictor.predict(observed, rendered), observed, rendered


def crops(
    view: View,
    model: ObjectModel,
    hull: NDArray[np.float64],
    poses: Sequence[Pose],
    size: tuple[int, int],
    renderer: Renderer,
    *,
    rgb: bool = True,
    coords: bool = True,
) -> tuple[list[View], list[View]]:
    """The photograph zoomed to each ``T_cam_obj``, and the object drawn there. size: (width, height). rgb, coords: as
    `Renderer.render` has them."""
    zooms = [zoom_to_pose(view.camera, T @ model.T_obj_ctr, hull, size) for T in poses]
    observed = [view.zoomed(zoom) for zoom in zooms]
    turned = [Pose.rotation(zoom.R_view_cam) @ T for zoom, T in zip(zooms, poses, strict=True)]
    return observed, renderer.render(model, turned, [z.camera for z in zooms], rgb=rgb, coords=coords)


def update_pose(
    T_cam_obj: Pose,
    model: ObjectModel,
    prediction: PairPrediction,
    observed: View,
    rendered: View,
    update: str,
    colour_edge: bool = False,
) -> Pose | None:
    """The pose after one prediction; None where it gives none (too few correspondences, behind the camera).

    colour_edge: whether small corrections by correspondences are weighed against the outline, see `with_colour_edge`.
    """
    T_view_cam = Pose.rotation(observed.R_view_cam)
    source = T_view_cam @ T_cam_obj @ model.T_obj_ctr
    if update == "regression":
        target: Pose | None = apply_delta(source, prediction.delta, rendered.camera.fx)
    else:
        found = prediction.correspondences
        assert found is not None and rendered.coords is not None
        points = rendered.coords[found.source[:, 1], found.source[:, 0]] - model.center
        target = solve_pnp(points, found.target, found.weight, found.scale_px, rendered.camera, source)
        if colour_edge and target is not None and prediction.silhouettes is not None:
            turn = max(prediction.angle, float(rotation_angle(target.R @ source.R.T)))
            if turn < NEAR:
                target = with_colour_edge(target, points, found, prediction, observed, rendered, model.center)
    if target is None or not np.isfinite(target.matrix).all() or target.t[2] < 0.6 * model.diameter:
        return None
    return T_view_cam.inverse() @ target @ model.T_ctr_obj


def with_colour_edge(
    target: Pose,
    points: NDArray[np.float64],
    found: Correspondences,
    prediction: PairPrediction,
    observed: View,
    rendered: View,
    center: NDArray[np.float64],
) -> Pose:
    """The ``T_view_ctr`` on which correspondences and the photograph's outline agree best; ``target`` where the colours
    do not show one.

    target: by the correspondences alone. points: (N, 3) metres in ``ctr``, of ``found``. The colours of the object and
    of what is round it are learned from the silhouette that the network sees in the crop, not from the pose's; where
    it sees something in front, the outline is not used. center: (3,), the model's.
    """
    assert prediction.silhouettes is not None
    visible, whole = (cv2.resize(s, rendered.camera.size, interpolation=cv2.INTER_LINEAR) > 0.5
                      for s in prediction.silhouettes)  # fmt: skip
    if not visible.any():
        return target
    colours = learn(observed, visible, np.ones_like(visible))
    lines = outline_lines(observed, rendered, colours, ~(whole & ~visible), center)
    if lines is None:
        return target
    scale = np.maximum(found.scale_px, LEAST_SCALE)
    matched = Points(points, found.target, found.weight, scale, KNEE, CORRELATED)
    both = fuse(target, [matched, lines], rendered.camera)
    return target if both is None else both.pose


def predicted_angle(T_cam_obj: Pose, prediction: PairPrediction, updated: Pose | None, update: str) -> float:
    """The rotation error (radians) that the network sees in a pose.

    The angle head's output; where correspondences move the pose, at least the turn that they ask for: a small angle
    beside a large correction is no convergence.
    """
    if update == "regression" or updated is None:
        return prediction.angle
    return max(prediction.angle, float(rotation_angle(updated.R @ T_cam_obj.R.T)))


class _Loop:
    """One hypothesis during refinement."""

    def __init__(self, start: Pose) -> None:
        self.pose = start
        self.steps: list[Step] = []
        self.after: list[Pose] = []  # the pose that each step's prediction leads to
        self.done = self.converged = False

    def advance(self, angle: float, updated: Pose | None, options: RefineOptions) -> None:
        self.steps.append(Step(self.pose, angle))
        self.after.append(updated or self.pose)
        if updated is None:
            self.done = True
            return
        if options.stop == "angle" and angle < options.stop_angle:
            self.done = self.converged = True
            return
        if options.stop == "angle" and (self._is_still(updated) or len(self.steps) - self._lowest() > options.patience):
            self.done = True
            return
        self.pose = updated

    def _is_still(self, updated: Pose) -> bool:
        """Whether an update moves the pose by less than its accuracy: all further ones would, too."""
        turn, shift = pose_change(self.pose, updated)
        return turn < STILL and shift < STILL * float(np.linalg.norm(updated.t))

    def _lowest(self) -> int:
        """The step with the lowest predicted angle."""
        return int(np.argmin([step.angle for step in self.steps]))

    def finish(self, options: RefineOptions) -> Refinement:
        if options.stop == "fixed":
            best = len(self.steps) - 1
            self.converged = self.steps[best].angle < options.stop_angle
        elif self.converged:
            best = len(self.steps) - 1
        else:
            best = self._lowest()
        pose = self.after[best] if options.last_update else self.steps[best].T_cam_obj
        return Refinement(pose, self.steps[best].angle, len(self.steps), self.converged, tuple(self.steps))


def pose_change(a: Pose, b: Pose) -> tuple[float, float]:
    """Rotation in radians and translation in metres between two ``T_cam_obj``."""
    return float(rotation_angle(a.R.T @ b.R)), float(np.linalg.norm(a.t - b.t))

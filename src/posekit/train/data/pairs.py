"""Training pairs: an object rendered at its true pose and at a disturbed one, in the same zoomed view.

A zoomed view's camera is turned so that the source pose's centre lies on its axis (see ``zoom``), therefore
the photograph's camera need not be simulated: wherever in a photograph the object was, the pair is the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.geometry import Pose, PoseNoise, random_rotation, rotation_angle, rotation_between, so3_exp, so3_log
from posekit.mesh.model import ObjectModel
from posekit.nets.inputs import relief
from posekit.nets.pose_delta import delta_between
from posekit.render import Renderer
from posekit.synth.appearance import variants
from posekit.synth.light import random_light
from posekit.zoom import zoom_to_pose

ANCHOR = 4  # as in nets.lite: every 4th pixel, from (2, 2) on
DEPTH_TOLERANCE = 0.02  # of the diameter: nearer than that counts as the same surface


@dataclass(frozen=True)
class PairConfig:
    """How pairs are drawn. The noise is DeepIM's, scaled by the drawn magnitude and the object's diameter."""

    size: tuple[int, int] = (128, 96)  # (width, height) of the crop
    distance: tuple[float, float] = (3.0, 14.0)  # range of the distance in diameters
    noise: PoseNoise = PoseNoise()
    # small, wide, lost: shares of pairs with less noise than DeepIM's (late iterations), with more (bad first poses,
    # up to ``widest`` times as much), and in another basin altogether (only angle, score and silhouettes learn from
    # them)
    small: float = 0.35
    wide: float = 0.22
    widest: float = 1.8
    lost: float = 0.12
    flipped: float = 0.5  # of the lost ones, those turned by about half a turn, whose outline is often right
    enlarge: tuple[float, float] = (1.25, 1.6)
    # unlike, deformed, scans: see `appearance.variants`
    unlike: float = 0.35
    deformed: float = 0.15
    scans: float = 0.3


@dataclass(frozen=True, eq=False)
class Pair:
    """One pair before augmentation; H x W the crop, h x w the anchors.

    target, source: uint8 (H, W, 4), RGB and alpha = mask. flow: float32 (h, w, 2), crop pixels from the source's
    anchor to the target's place. valid: bool (h, w), the anchor lies on the source. seen: bool (h, w), the
    anchor's surface point is not hidden by the object itself in the target. relief: float16 (H, W), the
    source's, see ``nets.inputs.relief``. focal: the crop's focal length in its widths. quat_wxyz: (4,). v: (3,).
    angle: radians. lost: True where the source is in another basin.
    """

    target: NDArray[np.uint8]
    source: NDArray[np.uint8]
    flow: NDArray[np.float32]
    valid: NDArray[np.bool_]
    seen: NDArray[np.bool_]
    relief: NDArray[np.float16]
    focal: float
    quat_wxyz: NDArray[np.float32]
    v: NDArray[np.float32]
    angle: float
    lost: bool


def _draw_poses(diameter: float, config: PairConfig, rng: np.random.Generator) -> tuple[Pose, Pose, bool]:
    """A source and a target ``T_view_ctr``, the source's centre on the axis, and whether the source is lost."""
    distance = diameter * np.exp(rng.uniform(*np.log(config.distance)))
    target = Pose(random_rotation(rng), np.array([0.0, 0.0, distance]))
    kind = rng.random()
    lost = kind < config.lost
    magnitude = 1.0
    if config.lost <= kind < config.lost + config.small:
        magnitude = float(np.exp(rng.uniform(np.log(0.04), 0.0)))
    elif config.lost + config.small <= kind < config.lost + config.small + config.wide:
        magnitude = float(rng.uniform(1.0, config.widest))
    dR, dt = config.noise.sample(rng)
    w = so3_log(dR) * magnitude
    # DeepIM's centimetres are for objects of about 0.15 m at 0.9 m: keep their effect on the crop
    dt = dt * magnitude * np.array([diameter / 0.15, diameter / 0.15, distance / 0.9])
    dR = _lost_turn(config, rng) if lost else so3_exp(w)
    t = target.t + dt
    t[2] = max(t[2], 1.2 * diameter)
    source = Pose(dR @ target.R, t)
    turn = Pose.rotation(rotation_between(source.t, [0.0, 0.0, 1.0]))
    return turn @ source, turn @ target, lost


def _lost_turn(config: PairConfig, rng: np.random.Generator) -> NDArray[np.float64]:
    """Any turn above 25 degrees; or about half a turn about an axis in the picture or along the view."""
    if rng.random() < config.flipped:
        along = rng.uniform(0, 2 * np.pi)
        axis = np.array([0.0, 0.0, 1.0] if rng.random() < 0.4 else [np.cos(along), np.sin(along), 0.0])
        return so3_exp(np.pi * axis) @ so3_exp(rng.normal(size=3) * np.deg2rad(8.0))
    while rotation_angle(dR := random_rotation(rng)) < np.deg2rad(25):
        pass
    return dR


def render_pairs(
    renderer: Renderer,
    model: ObjectModel,
    count: int,
    config: PairConfig,
    rng: np.random.Generator,
    photos: Sequence[NDArray[np.uint8]] = (),
) -> list[Pair]:
    """``count`` pairs of one object, drawn in two batches. photos: to cut other paint from."""
    rendered, observed = variants(model, photos, config.unlike, config.deformed, rng, config.scans)
    outline = model.hull_ctr
    T_ctr_obj = model.T_ctr_obj
    sources, targets, cameras, lost = [], [], [], []
    whole = Camera.from_fov(1.0, *config.size)
    for _ in range(count):
        source, target, is_lost = _draw_poses(model.diameter, config, rng)
        zoom = zoom_to_pose(whole, source, outline, config.size, enlarge=float(rng.uniform(*config.enlarge)))
        sources.append(source)
        targets.append(target)
        cameras.append(zoom.camera)
        lost.append(is_lost)
    drawn_sources = renderer.render(rendered, [s @ T_ctr_obj for s in sources], cameras)
    lights = [random_light(rng) for _ in range(count)]
    drawn_targets = renderer.render(observed, [t @ T_ctr_obj for t in targets], cameras, light=lights)
    pairs = []
    for source, target, camera, is_lost, s, t in zip(
        sources, targets, cameras, lost, drawn_sources, drawn_targets, strict=True
    ):
        assert s.coords is not None and s.mask is not None and t.depth is not None and t.mask is not None
        coords = s.coords[2::ANCHOR, 2::ANCHOR]
        valid = s.mask[2::ANCHOR, 2::ANCHOR]
        flow, seen = true_flow(coords, valid, target @ T_ctr_obj, camera, t.depth, DEPTH_TOLERANCE * model.diameter)
        delta = delta_between(source, target, camera.fx)
        quat = Pose.rotation(delta.R).quat_wxyz
        pairs.append(
            Pair(
                target=_rgba(t.image, t.mask),
                source=_rgba(s.image, s.mask),
                flow=flow,
                valid=valid,
                seen=seen,
                relief=relief(s).astype(np.float16),
                focal=camera.fx / camera.width,
                quat_wxyz=quat.astype(np.float32),
                v=delta.v.astype(np.float32),
                angle=delta.angle,
                lost=is_lost,
            )
        )
    return pairs


def true_flow(
    coords: NDArray[np.float32],
    valid: NDArray[np.bool_],
    T_view_obj: Pose,
    camera: Camera,
    depth: NDArray[np.float32],
    tolerance: float,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Where the anchors' surface points (h, w, 3) lie in the target: flow (h, w, 2) in pixels, and whether each
    is the nearest surface there (depth (H, W) of the target, to within ``tolerance`` metres)."""
    h, w = valid.shape
    points = T_view_obj.apply(coords)
    points[..., 2] = np.maximum(points[..., 2], 1e-3)
    place = camera.project(points)
    anchors = np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1) * ANCHOR + 2
    column = np.clip(np.rint(place[..., 0]), 0, camera.width - 1).astype(int)
    row = np.clip(np.rint(place[..., 1]), 0, camera.height - 1).astype(int)
    inside = (np.abs(place[..., 0] - column) <= 0.5) & (np.abs(place[..., 1] - row) <= 0.5)
    found = depth[row, column]
    seen = valid & inside & (found > 0) & (np.abs(found - points[..., 2]) < tolerance)
    return (place - anchors).astype(np.float32), seen


def _rgba(image: NDArray[np.uint8], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    return np.dstack([image, mask.astype(np.uint8) * 255])

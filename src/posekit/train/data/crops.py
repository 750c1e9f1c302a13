"""Scenes: an object seen with its surroundings, for training that crops as an estimate does.

A pair (see ``pairs``) is a crop round a disturbed pose, made once. MV-Net is given a crop round a detection's box, and
the paper's training crops anew at every refinement iteration: both start from a scene, which is wider than a crop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from posekit.camera import Box, Camera, mask_box
from posekit.datasets.bop import BopDataset, Instance
from posekit.geometry import Pose, PoseNoise, cube_views, random_rotation
from posekit.mesh.model import ObjectModel
from posekit.nets.pose_delta import PoseDelta, delta_between
from posekit.render import Renderer
from posekit.synth.light import random_light
from posekit.view import View
from posekit.zoom import frontal_camera, frontal_pose, zoom_to_box, zoom_to_pose

Image = NDArray[np.uint8]
Rng = np.random.Generator


@dataclass(frozen=True)
class SceneConfig:
    """How scenes of one object before a photograph are drawn."""

    crop: tuple[int, int] = (160, 120)  # (width, height) of the networks' crops
    oversize: float = 1.5  # how much larger a scene's picture is
    margin: tuple[float, float] = (1.5, 2.2)  # width of its view in widths of the object
    distance: tuple[float, float] = (3.0, 14.0)  # range in diameters
    shift: float = 0.3  # how far from the middle the object may lie, in its own half widths
    # box_shift, box_scale: standard deviations of a detection box's error, in its own size
    box_shift: float = 0.04
    box_scale: float = 0.06
    visible: float = 0.3  # least visible share of a photographed object

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of a scene."""
        return round(self.crop[0] * self.oversize), round(self.crop[1] * self.oversize)


@dataclass(frozen=True, eq=False)
class Scene:
    """One object before augmentation. rgba: uint8 (H, W, 4), alpha its visible mask; a photograph shows its
    surroundings, a rendering is black there. T_view_ctr: its true pose. box: round its mask, edges in pixels."""

    rgba: Image
    camera: Camera
    T_view_ctr: Pose
    box: Box
    photo: bool = False


@dataclass(frozen=True, eq=False)
class Frontal:
    """MV-Net's side of a mesh. views: uint8 (6, H, W, 4), RGB and mask, as `frontal_camera` shows the six sides."""

    views: Image
    camera: Camera
    distance: float

    @classmethod
    def of(cls, model: ObjectModel, renderer: Renderer, crop: tuple[int, int]) -> Frontal:
        """crop: (width, height)."""
        camera, distance = frontal_camera(model, crop)
        poses = [Pose(R, np.array([0, 0, distance])) @ model.T_ctr_obj for R in cube_views()]
        drawn = renderer.render(model, poses, camera, coords=False)
        return cls(np.stack([rgba_of(v) for v in drawn]), camera, distance)


@dataclass(frozen=True, eq=False)
class BoxSample:
    """MV-Net's input and its target. observed: uint8 (H, W, 4), the crop round a detection's box. camera:
    the crop's. R_crop_view: (3, 3), from the scene's frame into the crop's. delta: from the frontal view to the
    truth."""

    observed: Image
    camera: Camera
    R_crop_view: NDArray[np.float64]
    delta: PoseDelta


def render_scenes(renderer: Renderer, model: ObjectModel, count: int, config: SceneConfig, rng: Rng) -> list[Scene]:
    """At most ``count`` scenes of one object from all sides; a pose from which nothing is seen is left out."""
    outline = model.hull_ctr
    whole = Camera.from_fov(1.0, *config.size)
    poses, cameras = [], []
    for _ in range(count):
        distance = model.diameter * np.exp(rng.uniform(*np.log(config.distance)))
        pose = Pose(random_rotation(rng), np.array([0.0, 0.0, distance]))
        zoom = zoom_to_pose(whole, pose, outline, config.size, enlarge=float(rng.uniform(*config.margin)))
        side = 0.5 * model.diameter * rng.uniform(-config.shift, config.shift, size=2)
        poses.append(Pose(pose.R, pose.t + [*side, 0.0]))
        cameras.append(zoom.camera)
    T_ctr_obj = model.T_ctr_obj
    lights = [random_light(rng) for _ in range(count)]
    drawn = renderer.render(model, [p @ T_ctr_obj for p in poses], cameras, light=lights, coords=False)
    return [Scene(rgba_of(view), view.camera, pose, box)
            for view, pose in zip(drawn, poses, strict=True) if (box := _box(view)) is not None]  # fmt: skip


def photo_scene(dataset: BopDataset, instance: Instance, config: SceneConfig, rng: Rng) -> Scene | None:
    """The surroundings of an annotated object in a photograph; None where no visible pixel is left in them.

    Raises InputError where the photograph or the mask is missing.
    """
    box = instance.box_visib
    view = dataset.view(instance.scene, instance.image).with_mask(instance.mask())
    if box is None:
        assert view.mask is not None
        box = mask_box(view.mask)
    if box is None:
        return None
    zoom = zoom_to_box(view.camera, box, config.size, enlarge=float(rng.uniform(*config.margin)))
    seen = view.zoomed(zoom)
    found = _box(seen)
    if found is None:
        return None
    T_cam_ctr = instance.T_cam_obj @ dataset.model(instance.obj_id).T_obj_ctr
    return Scene(rgba_of(seen), seen.camera, Pose.rotation(zoom.R_view_cam) @ T_cam_ctr, found, photo=True)


def box_sample(observed: Image, scene: Scene, frontal: Frontal, config: SceneConfig, rng: Rng) -> BoxSample:
    """Crop a scene as a detector's box would have it. observed: the scene's picture after augmentation."""
    box = disturbed_box(scene.box, config, rng)
    zoom = zoom_to_box(scene.camera, box, config.crop)
    crop = view_of(observed, scene.camera).zoomed(zoom)
    target = Pose.rotation(zoom.R_view_cam) @ scene.T_view_ctr
    source = frontal_pose(frontal.camera, frontal.distance, zoom.camera)
    return BoxSample(rgba_of(crop), zoom.camera, zoom.R_view_cam, delta_between(source, target, zoom.camera.fx))


def disturbed_box(box: Box, config: SceneConfig, rng: Rng) -> Box:
    """A box (edges) moved and scaled as a detector's are."""
    x0, y0, x1, y1 = box
    size = np.array([x1 - x0, y1 - y0])
    centre = np.array([x0 + x1, y0 + y1]) / 2 + rng.normal(size=2) * config.box_shift * size
    half = 0.5 * size * np.exp(rng.normal(size=2) * config.box_scale)
    low, high = centre - half, centre + half
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def disturbed_pose(T_cam_ctr: Pose, diameter: float, rng: Rng) -> Pose:
    """DeepIM's disturbance; its centimetres, meant for objects of about 0.15 m at 0.9 m, keep their effect."""
    R, t = PoseNoise().sample(rng)
    moved = T_cam_ctr.t + t * np.array([diameter / 0.15, diameter / 0.15, T_cam_ctr.t[2] / 0.9])
    moved[2] = max(moved[2], 1.2 * diameter)
    return Pose(R @ T_cam_ctr.R, moved)


def view_of(rgba: Image, camera: Camera) -> View:
    """RGB and mask (H, W, 4) as a View."""
    return View(np.ascontiguousarray(rgba[..., :3]), camera, rgba[..., 3] > 0)


def rgba_of(view: View) -> Image:
    """A View with a mask as uint8 (H, W, 4)."""
    assert view.mask is not None
    return np.dstack([view.image, view.mask.astype(np.uint8) * 255])


def usable_instances(dataset: BopDataset, config: SceneConfig) -> Sequence[Instance]:
    """The annotated objects of a data set that are visible enough."""
    found = (i for scene, image in dataset.images() for i in dataset.instances(scene, image))
    return [i for i in found if not i.visib_fract < config.visible]


def _box(view: View) -> Box | None:
    assert view.mask is not None
    box = mask_box(view.mask)
    return box if box is not None and min(box[2] - box[0], box[3] - box[1]) >= 4 else None

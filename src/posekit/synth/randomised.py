"""Domain randomisation as in the paper's section 4.1: a random pose before a random background."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.datasets.bop_writer import Picture
from posekit.geometry import Pose, random_rotation
from posekit.mesh.model import ObjectModel
from posekit.render import Renderer
from posekit.synth.backdrops import Backdrops, photograph
from posekit.synth.draw_objects import Placed, draw_objects
from posekit.synth.light import random_light
from posekit.synth.plan import SynthConfig
from posekit.synth.procedural import random_object

FOV_DEG = (35.0, 70.0)  # of the longer side
DISTANCE = (2.5, 12.0)  # in diameters
DILATION = 40  # largest side of the square kernel, pixels (the paper's)
OCCLUDED, CLUTTER = 0.5, 16  # share with other things around the object; how many there are to choose from

Rng = np.random.Generator


class Randomised:
    """Image n shows object n modulo their number. Its dilated mask lies in ``mask_dilated/``."""

    def __init__(self, config: SynthConfig, models: Mapping[int, ObjectModel], renderer: Renderer) -> None:
        self.config, self.models, self.renderer = config, sorted(models.items()), renderer
        self.backdrops = Backdrops(config.backgrounds, config.seed)
        self.clutter = Clutter(config.seed)

    def block(self, number: int, places: Sequence[int]) -> Iterator[tuple[int, Picture]]:
        """(place, picture) for each place, from block ``number``'s own random numbers."""
        for place in places:
            yield place, self._picture(number, np.random.default_rng([self.config.seed, 0, number]))

    def _picture(self, number: int, rng: Rng) -> Picture:
        obj_id, model = self.models[number % len(self.models)]
        camera = random_camera(self.config.size, rng)
        pose = random_pose(model, camera, rng)
        objects = [Placed(obj_id, model, pose)]
        if rng.random() < OCCLUDED:
            objects += [self.clutter.beside(pose, model, rng) for _ in range(int(rng.integers(1, 4)))]
        drawn = draw_objects(
            self.renderer, objects, camera, random_light(rng), self.backdrops.draw(rng, self.config.size)
        )
        dilated = [dilate(a.mask_visib, int(rng.integers(0, DILATION + 1))) for a in drawn.annotations]
        return Picture(photograph(drawn.image, rng), camera, drawn.annotations, drawn.depth,
                       masks={"mask_dilated": dilated})  # fmt: skip


class Clutter:
    """Procedural things that hide and surround objects, each made once in every size that is wanted."""

    def __init__(self, seed: int) -> None:
        self.seed, self._made = seed, dict[tuple[int, int], ObjectModel]()

    def draw(self, rng: Rng, diameter: float) -> ObjectModel:
        """One of them, of about this diameter (within a factor of 1.2), metres."""
        k, step = int(rng.integers(CLUTTER)), round(2 * np.log2(diameter))
        if (k, step) not in self._made:
            self._made[k, step] = random_object(np.random.default_rng([self.seed, 2, k]), diameter=2 ** (step / 2))
        return self._made[k, step]

    def beside(self, T_cam_obj: Pose, model: ObjectModel, rng: Rng) -> Placed:
        """Something around an object, smaller than it, that may hide a part of it."""
        thing = self.draw(rng, rng.uniform(0.25, 0.7) * model.diameter)
        centre = T_cam_obj.apply(model.center)
        depth = centre[2] + model.diameter * rng.uniform(-0.9, 0.6)
        side = rng.normal(size=2)
        side *= rng.uniform(0.4, 1.2) * model.diameter / np.linalg.norm(side)
        t = np.array([*((centre[:2] + side) * depth / centre[2]), depth])
        return Placed(None, thing, Pose(random_rotation(rng), t))


def random_camera(size: tuple[int, int], rng: Rng) -> Camera:
    """A camera with its principal point near the middle."""
    middle = Camera.from_fov(float(np.deg2rad(rng.uniform(*FOV_DEG))), *size)
    shift = rng.normal(size=2) * 0.01 * size[0]
    return Camera(middle.fx, middle.fy, middle.cx + shift[0], middle.cy + shift[1], *size)


def random_pose(model: ObjectModel, camera: Camera, rng: Rng) -> Pose:
    """``T_cam_obj``: any rotation, the centre inside the picture by DeepIM's 16 pixels of 640 at least."""
    distance = model.diameter * np.exp(rng.uniform(*np.log(DISTANCE)))
    margin = camera.width / 40
    pixel = rng.uniform([margin, margin], [camera.width - margin, camera.height - margin])
    R = random_rotation(rng)
    return Pose(R, camera.backproject(pixel, distance) - R @ model.center)


def dilate(mask: NDArray[np.bool_], side: int) -> NDArray[np.bool_]:
    """Grown by a square kernel; side 0: as it is."""
    if side < 2:
        return mask
    return cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)).astype(np.bool_)

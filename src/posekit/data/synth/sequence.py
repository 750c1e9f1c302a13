"""Sequences: objects and a camera that move smoothly, for tracking. Layer 3."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.data.bop_writer import Picture
from posekit.data.pairs import random_light
from posekit.data.synth.backdrops import Backdrops, add_noise
from posekit.data.synth.draw_objects import Placed, draw_objects
from posekit.data.synth.plan import SynthConfig
from posekit.data.synth.randomised import Clutter, random_camera, random_pose
from posekit.geometry import Pose, random_rotation, so3_exp
from posekit.object_model import ObjectModel
from posekit.render import Renderer

RATE = 30.0  # frames a second
WIDER = 2.0  # how much wider than the picture the backdrop is

Rng = np.random.Generator


@dataclass(frozen=True, eq=False)
class Sway:
    """A smooth motion: a sum of sines in six directions, zero in the mean. amplitude, frequency, phase: (K, 6),
    the first three of rotation vectors (radians), the others metres; frequencies in turns a second."""

    amplitude: NDArray[np.float64]
    frequency: NDArray[np.float64]
    phase: NDArray[np.float64]

    @classmethod
    def random(cls, rng: Rng, turn: float, shift: float) -> Sway:
        """turn: radians, shift: metres, standard deviations of the largest displacement."""
        scale = np.array([turn] * 3 + [shift] * 3) / np.arange(1, 4)[:, None]
        return cls(rng.normal(size=(3, 6)) * scale, rng.uniform(0.05, 0.35, size=(3, 6)) * np.arange(1, 4)[:, None],
                   rng.uniform(0, 2 * np.pi, size=(3, 6)))  # fmt: skip

    def at(self, seconds: float) -> Pose:
        w = (self.amplitude * np.sin(2 * np.pi * self.frequency * seconds + self.phase)).sum(axis=0)
        return Pose(so3_exp(w[:3]), w[3:])


class Sequences:
    """Each block is a sequence with one to three of the objects, and others that pass. The backdrop is far away: it
    follows the camera's turns and not its steps."""

    def __init__(self, config: SynthConfig, models: Mapping[int, ObjectModel], renderer: Renderer) -> None:
        self.config, self.models, self.renderer = config, sorted(models.items()), renderer
        self.backdrops = Backdrops(config.backgrounds, config.seed)
        self.clutter = Clutter(config.seed)

    def block(self, number: int, places: Sequence[int]) -> Iterator[tuple[int, Picture]]:
        rng = np.random.default_rng([self.config.seed, 0, number])
        camera, light = random_camera(self.config.size, rng), random_light(rng)
        count = min(len(self.models), int(rng.integers(1, 4)))
        chosen = [self.models[int(k)] for k in rng.choice(len(self.models), size=count, replace=False)]
        unit = float(np.median([model.diameter for _, model in chosen]))
        things: list[tuple[int | None, ObjectModel, Pose, Sway]] = [
            (obj_id, model, self._start(model, camera, rng), Sway.random(rng, 0.9, 0.5 * model.diameter))
            for obj_id, model in chosen
        ]
        for _ in range(int(rng.integers(0, 3))):
            passing = self.clutter.beside(things[0][2], things[0][1], rng)
            things.append((None, passing.model, passing.T_cam_obj, Sway.random(rng, 0.6, 0.9 * unit)))
        moving = Sway.random(rng, 0.06, 0.4 * unit)
        wide = self.backdrops.draw(rng, (round(WIDER * camera.width), round(WIDER * camera.height)))
        for place in places:
            T_cam_world = moving.at(place / RATE)
            objects = [Placed(obj_id, model, T_cam_world @ _moved(start, sway.at(place / RATE), model))
                       for obj_id, model, start, sway in things]  # fmt: skip
            drawn = draw_objects(self.renderer, objects, camera, light, _seen(wide, camera, T_cam_world))
            noise = np.random.default_rng([self.config.seed, 1, number, place])
            image = add_noise(drawn.image, 3.0, noise)
            yield place, Picture(image, camera, drawn.annotations, drawn.depth, T_cam_world)

    @staticmethod
    def _start(model: ObjectModel, camera: Camera, rng: Rng) -> Pose:
        """In the middle part of the picture, so that most of it stays there."""
        pose = random_pose(model, camera, rng)
        centre = pose.apply(model.center)
        distance = model.diameter * rng.uniform(3.0, 7.0)
        middle = np.array([*(0.5 * centre[:2] / centre[2] * distance), distance])
        R = random_rotation(rng)
        return Pose(R, middle - R @ model.center)


def _moved(start: Pose, sway: Pose, model: ObjectModel) -> Pose:
    """``T_world_obj`` turned about the object's centre and shifted."""
    centre = start.apply(model.center)
    R = sway.R @ start.R
    return Pose(R, centre + sway.t - R @ model.center)


def _seen(wide: NDArray[np.uint8], camera: Camera, T_cam_world: Pose) -> NDArray[np.uint8]:
    """The part of a wide picture, infinitely far away, that the turned camera sees."""
    height, width = wide.shape[:2]
    far = Camera(camera.fx, camera.fy, (width - 1) / 2, (height - 1) / 2, width, height)
    H = camera.K @ T_cam_world.R @ np.linalg.inv(far.K)
    return np.asarray(cv2.warpPerspective(wide, H, camera.size, borderMode=cv2.BORDER_REFLECT_101))

"""Sequences: objects and a camera that move, are hidden, leave and come back, for tracking."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.datasets.bop_writer import Picture
from posekit.geometry import Pose, random_rotation
from posekit.mesh.model import ObjectModel
from posekit.render import Light, Renderer
from posekit.synth.backdrops import Backdrops, add_noise
from posekit.synth.draw_objects import Drawn, Placed, draw_objects
from posekit.synth.light import random_light
from posekit.synth.motion import MOTIONS, RATE, Motion, Path, away_and_back, motion_of, moved, passing, random_motion
from posekit.synth.plan import SynthConfig
from posekit.synth.randomised import Clutter, random_camera

WIDER = 2.0  # how much wider than the picture the backdrop is
DISTANCE = (4.0, 7.0)  # of the objects at the start, in diameters
SHUTTER = 0.5 / RATE  # seconds that it is open for a frame
STEP, MOMENTS = 3.0, 9  # pixels between the moments that make up a blurred frame; the most of them, odd

Rng = np.random.Generator


@dataclass(frozen=True, eq=False)
class MovingObject:
    """obj_id: None for what is not annotated. T_world_obj: by the seconds."""

    obj_id: int | None
    model: ObjectModel
    T_world_obj: Path


@dataclass(frozen=True, eq=False)
class SequencePlan:
    """What a sequence shows, before it is drawn. wide: the backdrop. noise: of the sensor, grey levels."""

    camera: Camera
    light: Light
    objects: list[MovingObject]
    T_cam_world: Path
    wide: NDArray[np.uint8]
    noise: float


class Sequences:
    """Each block is a sequence with one to three of the objects, and others that pass. The backdrop is far away: it
    follows the camera's turns and not its steps. Poses, masks and depth are those of the middle of the exposure."""

    def __init__(self, config: SynthConfig, models: Mapping[int, ObjectModel], renderer: Renderer) -> None:
        self.config, self.models, self.renderer = config, sorted(models.items()), renderer
        self.backdrops = Backdrops(config.backgrounds, config.seed)
        self.clutter = Clutter(config.seed)

    def block(self, number: int, places: Sequence[int]) -> Iterator[tuple[int, Picture]]:
        """(place, picture) for each place: frames of sequence ``number``."""
        plan = self._plan(MOTIONS[motion_of(self.config.motion, number)],
                          np.random.default_rng([self.config.seed, 0, number]))  # fmt: skip
        for place in places:
            drawn = self._frame(plan, place / RATE)
            noise = np.random.default_rng([self.config.seed, 1, number, place])
            image = add_noise(drawn.image, plan.noise, noise)
            yield place, Picture(image, plan.camera, drawn.annotations, drawn.depth, plan.T_cam_world(place / RATE))

    # --- motion ---

    def _plan(self, motion: Motion, rng: Rng) -> SequencePlan:
        camera, light = random_camera(self.config.size, rng), random_light(rng)
        count = min(len(self.models), int(rng.integers(1, 4)))
        chosen = [self.models[int(k)] for k in rng.choice(len(self.models), size=count, replace=False)]
        starts = [_start(model, camera, rng) for _, model in chosen]
        objects = [MovingObject(obj_id, model, self._path(motion, start, model, camera, rng))
                  for (obj_id, model), start in zip(chosen, starts, strict=True)]  # fmt: skip
        first = chosen[0][1]
        for _ in range(int(rng.integers(0, 3))):
            beside = self.clutter.beside(starts[0], first, rng)
            by = random_motion(motion, rng, 0.4, 0.4 * first.diameter, beside.model.diameter)
            objects.append(MovingObject(None, beside.model, moved(beside.T_cam_obj, beside.model, by)))
        if motion.hidden:
            objects.append(self._passing_object(starts[0], first, rng))
        wide = self.backdrops.draw(rng, (round(WIDER * camera.width), round(WIDER * camera.height)))
        T_cam_world = random_motion(motion, rng, 0.04, 0.2 * first.diameter, first.diameter)
        return SequencePlan(camera, light, objects, T_cam_world, wide, float(rng.uniform(1.0, 5.0)))

    def _path(self, motion: Motion, start: Pose, model: ObjectModel, camera: Camera, rng: Rng) -> Path:
        path = moved(start, model, random_motion(motion, rng, 0.5, 0.3 * model.diameter, model.diameter))
        if not motion.leaves:
            return path
        return away_and_back(path, model, _outside(start, model, camera, rng), self.config.frames / RATE)

    def _passing_object(self, start: Pose, model: ObjectModel, rng: Rng) -> MovingObject:
        """Something about as large as the object, nearer, that passes in front of it."""
        shape = self.clutter.draw(rng, model.diameter)
        angle = rng.uniform(0, 2 * np.pi)
        reach = 2.0 * model.diameter * np.array([np.cos(angle), np.sin(angle), 0.0])
        R = random_rotation(rng)
        middle = Pose(R, 0.6 * start.apply(model.center) - R @ shape.center)
        return MovingObject(None, shape, passing(middle, reach, self.config.frames / RATE))

    # --- drawing ---

    def _frame(self, plan: SequencePlan, seconds: float) -> Drawn:
        """Sharp where little moves while the shutter is open, else the mean of several moments."""
        drawn = self._moment(plan, seconds)
        count = _moments(plan, seconds)
        if count == 1:
            return drawn
        offsets = np.linspace(-0.5, 0.5, count) * SHUTTER
        images = [drawn.image if k == count // 2 else self._moment(plan, seconds + float(offset)).image
                  for k, offset in enumerate(offsets)]  # fmt: skip
        light = np.mean([np.square(image, dtype=np.float32) for image in images], axis=0)  # about linear in light
        return dataclasses.replace(drawn, image=np.sqrt(light).round().astype(np.uint8))

    def _moment(self, plan: SequencePlan, seconds: float) -> Drawn:
        T_cam_world = plan.T_cam_world(seconds)
        objects = [
            Placed(shape.obj_id, shape.model, T_cam_world @ shape.T_world_obj(seconds)) for shape in plan.objects
        ]
        return draw_objects(self.renderer, objects, plan.camera, plan.light, _seen(plan.wide, plan.camera, T_cam_world))


def sequences(config: SynthConfig) -> dict[str, Any]:
    """What ``sequences.json`` says of each scene."""
    scenes = range(-(-config.images // config.frames))
    return {str(1 + n): {"motion": motion_of(config.motion, n), "frames_per_second": RATE} for n in scenes}


def _start(model: ObjectModel, camera: Camera, rng: Rng) -> Pose:
    """``T_cam_obj``: any rotation, the centre in the middle part of the picture, so that most of it stays there."""
    distance = model.diameter * rng.uniform(*DISTANCE)
    pixel = np.array(camera.size) * rng.uniform(0.3, 0.7, size=2)
    R = random_rotation(rng)
    return Pose(R, camera.backproject(pixel, distance) - R @ model.center)


def _outside(start: Pose, model: ObjectModel, camera: Camera, rng: Rng) -> NDArray[np.float64]:
    """A place for the object's centre so far left, right, above or below that nothing of it is in the picture."""
    x, y, distance = start.apply(model.center)
    side = int(rng.integers(4))
    size, focal = (camera.width, camera.fx) if side < 2 else (camera.height, camera.fy)
    far = distance * size / focal + 1.2 * model.diameter  # the whole picture's width from its middle
    sign = 1 if side % 2 else -1
    return np.array([sign * far, y, distance] if side < 2 else [x, sign * far, distance])


def _moments(plan: SequencePlan, seconds: float) -> int:
    """How many moments a frame needs, odd, by the longest way that a point of an object makes in the picture."""
    ends = [seconds - SHUTTER / 2, seconds + SHUTTER / 2]
    longest = 0.0
    for shape in plan.objects:
        few = shape.model.hull_vertices[:: max(1, len(shape.model.hull_vertices) // 64)]
        points = [(plan.T_cam_world(s) @ shape.T_world_obj(s)).apply(few) for s in ends]
        if min(p[:, 2].min() for p in points) > 1e-3:
            way = plan.camera.project(points[1]) - plan.camera.project(points[0])
            longest = max(longest, float(np.linalg.norm(way, axis=1).max()))
    return int(min(MOMENTS, 1 + 2 * round(longest / STEP / 2)))


def _seen(wide: NDArray[np.uint8], camera: Camera, T_cam_world: Pose) -> NDArray[np.uint8]:
    """The part of a wide picture, infinitely far away, that the turned camera sees."""
    height, width = wide.shape[:2]
    far = Camera(camera.fx, camera.fy, (width - 1) / 2, (height - 1) / 2, width, height)
    H = camera.K @ T_cam_world.R @ np.linalg.inv(far.K)
    return np.asarray(cv2.warpPerspective(wide, H, camera.size, borderMode=cv2.BORDER_REFLECT_101))

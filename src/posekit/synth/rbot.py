"""Sequences in RBOT's manner: one object that turns and moves quickly before a moving photograph, in four variants.

All four variants of a sequence show the same motion of the same object before the same photograph:

- regular: the light stands still with the camera, and nothing is added;
- light: the light goes round the object, and its highlights and shades with it;
- noise: the moving light, and Gaussian noise on every pixel;
- occlusion: the moving light, and a second object of the data set that swings before the first and hides parts of it.

As in RBOT's renderings there is no motion blur. The photograph is on a wall behind, seen by a camera in somebody's
hand. Poses are relative to the camera, and the second object is annotated too.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.datasets.bop_writer import Picture
from posekit.errors import ConfigError
from posekit.geometry import Pose, random_rotation, rotation_angle, so3_exp
from posekit.mesh.model import ObjectModel
from posekit.render import Light, Renderer
from posekit.synth.backdrops import Backdrops, add_noise
from posekit.synth.draw_objects import Placed, draw_objects
from posekit.synth.motion import RATE, Path, SineMotion
from posekit.synth.plan import ALL, RBOT_VARIANTS, SynthConfig

TURN_STEP, SHIFT_STEP = math.radians(6.0), 0.08  # from frame to frame, in the mean; the latter in diameters
TURN = 1.5  # radians, of the path's sines: the object is seen from all sides in the course of time
DISTANCE, MIDDLE = (3.0, 6.0), (0.3, 0.7)  # diameters; of the picture, where the object's centre stays
NOISE = 12.0  # grey levels, standard deviation
LIGHT_PERIOD, OCCLUDER_PERIOD = (2.0, 4.0), (2.0, 3.5)  # seconds for a turn, and for a swing there and back
SWING = np.array([0.5, 0.25])  # of the second object, across and aside, in sums of both diameters
WIDER = 1.6  # how much larger than the picture the photograph is
HAND_TURN, HAND_SHIFT = 0.1, 0.08  # of the camera before the wall: radians, and shares of the wall's distance
HAND_HERTZ = (0.1, 0.4)
REFERENCE = 400  # moments by which a path's speed is measured

Rng = np.random.Generator


@dataclass(frozen=True, eq=False)
class RbotPlan:
    """A sequence before it is drawn. objects: number, mesh and ``T_cam_obj`` by the seconds, the followed one first.
    light: by the seconds. wide: the photograph. hand: of the camera before it. noise: grey levels."""

    camera: Camera
    objects: list[tuple[int, ObjectModel, Path]]
    light: Light
    light_turn: NDArray[np.float64] | None  # axis times radians a second
    wide: NDArray[np.uint8]
    hand: Path
    noise: float

    def light_at(self, seconds: float) -> Light:
        """The light that shines then."""
        if self.light_turn is None:
            return self.light
        direction = so3_exp(self.light_turn * seconds) @ np.array(self.light.direction)
        x, y, z = (float(v) for v in direction)
        return replace(self.light, direction=(x, y, z))


class RbotSequences:
    """Each block is a sequence. Block n shows variant n modulo their number, of an object in its turn."""

    def __init__(self, config: SynthConfig, models: Mapping[int, ObjectModel], renderer: Renderer) -> None:
        check_meshes(config, list(models))
        self.config, self.models, self.renderer = config, models, renderer
        self.backdrops = Backdrops(config.backgrounds, config.seed)

    def block(self, number: int, places: Sequence[int]) -> Iterator[tuple[int, Picture]]:
        """(place, picture) for each place: frames of sequence ``number``."""
        plan = self._plan(number)
        for place in places:
            seconds = place / RATE
            objects = [Placed(obj_id, model, path(seconds)) for obj_id, model, path in plan.objects]
            backdrop = behind(plan.wide, plan.camera, plan.hand(seconds))
            drawn = draw_objects(self.renderer, objects, plan.camera, plan.light_at(seconds), backdrop)
            image = drawn.image
            if plan.noise:
                image = add_noise(image, plan.noise, np.random.default_rng([self.config.seed, 4, number, place]))
            yield place, Picture(image, plan.camera, drawn.annotations, drawn.depth)

    def _plan(self, number: int) -> RbotPlan:
        variant, turn, obj_id = shown(self.config, number, list(self.models))
        rng = np.random.default_rng([self.config.seed, 3, turn])  # the same for all variants
        model, camera = self.models[obj_id], _camera(self.config.size)
        path = quick_path(model, camera, rng)
        wide = self.backdrops.draw(rng, (round(WIDER * camera.width), round(WIDER * camera.height)))
        hand = SineMotion.random(rng, HAND_TURN, HAND_SHIFT, HAND_HERTZ)
        objects = [(obj_id, model, path)]
        about, seconds = rng.normal(size=3), rng.uniform(*LIGHT_PERIOD)
        circling = about / np.linalg.norm(about) * 2 * np.pi / seconds
        if variant == "occlusion":
            other = self._second(obj_id, rng)
            objects.append((other, self.models[other], passing_path(model, path, self.models[other], rng)))
        light = Light(ambient=0.45, diffuse=0.65, specular=0.25)
        moving, noise = variant != "regular", NOISE if variant == "noise" else 0.0
        return RbotPlan(camera, objects, light, circling if moving else None, wide, hand, noise)

    def _second(self, obj_id: int, rng: Rng) -> int:
        """One of the other objects that is not larger than the first, else the smallest of them."""
        others = sorted((m.diameter, o) for o, m in self.models.items() if o != obj_id)
        fitting = [o for diameter, o in others if diameter <= self.models[obj_id].diameter]
        return int(fitting[int(rng.integers(len(fitting)))]) if fitting else others[0][1]


def shown(config: SynthConfig, number: int, obj_ids: Sequence[int]) -> tuple[str, int, int]:
    """A sequence's variant, the number of its motion, and its object."""
    variants = RBOT_VARIANTS if config.rbot == ALL else (config.rbot,)
    turn = number // len(variants)
    return variants[number % len(variants)], turn, sorted(obj_ids)[turn % len(obj_ids)]


def check_meshes(config: SynthConfig, obj_ids: Sequence[int]) -> None:
    """Raises ConfigError where there is no second object that could pass before the first."""
    if config.rbot in (ALL, "occlusion") and len(obj_ids) < 2:
        raise ConfigError(
            "RBOT's occlusion needs a second mesh that passes before the first: pass another one with --models, or "
            "another variant than occlusion or all."
        )


def rbot_sequences(config: SynthConfig, obj_ids: Sequence[int]) -> dict[str, Any]:
    """What ``sequences.json`` says of each scene. object: the followed one."""
    entries = {}
    for number in range(-(-config.images // config.frames)):
        variant, turn, obj_id = shown(config, number, obj_ids)
        entries[str(1 + number)] = {
            "motion": "rbot", "frames_per_second": RATE, "variant": variant, "object": obj_id, "path": turn,
        }  # fmt: skip
    return entries


# --- motion ---


def quick_path(model: ObjectModel, camera: Camera, rng: Rng) -> Path:
    """``T_cam_obj``: turns and shifts by `TURN_STEP` and `SHIFT_STEP` a frame in the mean; the centre stays in the
    middle part of the picture."""
    start, turns = random_rotation(rng), SineMotion.random(rng, TURN, 0.0)
    waves = SineMotion.random(rng, 0.0, 1.0)
    low, high = (np.array(camera.size) * share for share in MIDDLE)
    near, far = (model.diameter * d for d in DISTANCE)

    def centre(seconds: float) -> NDArray[np.float64]:
        u, v, depth = 0.5 + 0.5 * np.tanh(waves(seconds).t)  # all from 0 to 1
        return camera.backproject(low + np.array([u, v]) * (high - low), near + depth * (far - near))

    moments = np.arange(REFERENCE) / RATE
    rotations = np.array([turns(s).R for s in moments])
    turn = float(rotation_angle(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:]).mean())
    shift = float(np.linalg.norm(np.diff([centre(s) for s in moments], axis=0), axis=1).mean())
    faster, further = TURN_STEP / turn, SHIFT_STEP * model.diameter / shift

    def path(seconds: float) -> Pose:
        R = turns(faster * seconds).R @ start
        return Pose(R, centre(further * seconds) - R @ model.center)

    return path


def passing_path(first: ObjectModel, path: Path, second: ObjectModel, rng: Rng) -> Path:
    """``T_cam_obj`` of a second object that swings before the first, from side to side, and passes it twice in a
    period."""
    both = first.diameter + second.diameter  # half of it keeps them from touching
    tilt, phase, period = rng.uniform(0, np.pi), rng.uniform(0, 2 * np.pi, size=2), rng.uniform(*OCCLUDER_PERIOD)
    across = np.array([np.cos(tilt), np.sin(tilt), 0.0])
    beside = np.array([-np.sin(tilt), np.cos(tilt), 0.0])
    start, turns = random_rotation(rng), SineMotion.random(rng, 1.0, 0.0)

    def passing(seconds: float) -> Pose:
        angle = 2 * np.pi * seconds / period
        wide, small = SWING * np.sin(np.array([1.0, 0.7]) * angle + phase)
        off = both * (wide * across + small * beside - np.array([0.0, 0.0, 0.55]))
        R = turns(seconds).R @ start
        return Pose(R, path(seconds).apply(first.center) + off - R @ second.center)

    return passing


def behind(wide: NDArray[np.uint8], camera: Camera, T_cam_wall: Pose) -> NDArray[np.uint8]:
    """What the camera sees of a photograph on a wall. T_cam_wall: its shift in shares of the wall's distance."""
    height, width = wide.shape[:2]
    wall = Camera(camera.fx, camera.fy, (width - 1) / 2, (height - 1) / 2, width, height)
    H = camera.K @ (T_cam_wall.R + np.outer(T_cam_wall.t, [0.0, 0.0, 1.0])) @ np.linalg.inv(wall.K)
    return np.asarray(cv2.warpPerspective(wide, H, camera.size, borderMode=cv2.BORDER_REFLECT_101))


def _camera(size: tuple[int, int]) -> Camera:
    """One camera for all: RBOT's focal length is about the picture's width."""
    width, height = size
    return Camera(1.015 * width, 1.015 * width, (width - 1) / 2, (height - 1) / 2, width, height)

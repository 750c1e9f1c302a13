"""How things move in a sequence: smooth and jerky paths, passing by, leaving and coming back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from posekit.geometry import Pose, so3_exp
from posekit.mesh.model import ObjectModel

RATE = 30.0  # frames a second
MIXED = "mixed"
BEAT, REST = 0.5, 0.7  # of jerky motion: seconds from rest to rest, the share of them at rest
JITTER_RAD, JITTER = 0.02, 0.01  # of jerky motion: standard deviations, the latter in diameters

Rng = np.random.Generator
Path = Callable[[float], Pose]


@dataclass(frozen=True)
class Motion:
    """speed: of the path, 0 = still. jerky: in bursts, with jitter. hidden: something passes in front. leaves: out
    of the picture and back."""

    speed: float = 1.0
    jerky: bool = False
    hidden: bool = False
    leaves: bool = False


MOTIONS = {
    "still": Motion(speed=0.0),
    "slow": Motion(speed=0.4),
    "smooth": Motion(),
    "fast": Motion(speed=2.5),
    "jerky": Motion(jerky=True),
    "hidden": Motion(hidden=True),
    "leaving": Motion(leaves=True),
}


def motion_of(chosen: str, number: int) -> str:
    """The name of sequence ``number``'s motion: the chosen one, or, of mixed ones, each in its turn."""
    return list(MOTIONS)[number % len(MOTIONS)] if chosen == MIXED else chosen


@dataclass(frozen=True, eq=False)
class SineMotion:
    """A smooth motion: a sum of K sines in six directions, zero in the mean. amplitude, frequency, phase: (K, 6),
    the first three of rotation vectors (radians), the others metres; frequencies in turns a second."""

    amplitude: NDArray[np.float64]
    frequency: NDArray[np.float64]
    phase: NDArray[np.float64]

    @classmethod
    def random(cls, rng: Rng, turn: float, shift: float, hertz: tuple[float, float] = (0.05, 0.35)) -> SineMotion:
        """turn: radians, shift: metres, standard deviations of the largest displacement. hertz: of the slowest sines;
        the others are twice and three times as fast."""
        scale = np.array([turn] * 3 + [shift] * 3) / np.arange(1, 4)[:, None]
        return cls(rng.normal(size=(3, 6)) * scale, rng.uniform(*hertz, size=(3, 6)) * np.arange(1, 4)[:, None],
                   rng.uniform(0, 2 * np.pi, size=(3, 6)))  # fmt: skip

    def __call__(self, seconds: float) -> Pose:
        w = (self.amplitude * np.sin(2 * np.pi * self.frequency * seconds + self.phase)).sum(axis=0)
        return Pose(so3_exp(w[:3]), w[3:])


def random_motion(motion: Motion, rng: Rng, turn: float, shift: float, diameter: float = 0.0) -> Path:
    """A path about the identity. diameter: metres, of the object that jitters where the motion is jerky."""
    smooth, jitter = (
        SineMotion.random(rng, turn, shift),
        SineMotion.random(rng, JITTER_RAD, JITTER * diameter, (3.0, 4.0)),
    )
    if not motion.jerky:
        return lambda seconds: smooth(motion.speed * seconds)

    def path(seconds: float) -> Pose:
        small = jitter(seconds)
        large = smooth(motion.speed * burst(seconds))
        return Pose(small.R @ large.R, small.t + large.t)

    return path


def burst(seconds: float) -> float:
    """Time that stands still for most of each beat and then catches up."""
    beat, part = divmod(seconds / BEAT, 1.0)
    return float(BEAT * (beat + smoothstep((part - REST) / (1 - REST))))


def moved(start: Pose, model: ObjectModel, by: Path) -> Path:
    """``T_world_obj`` turned about the object's centre and shifted."""
    centre = start.apply(model.center)

    def path(seconds: float) -> Pose:
        step = by(seconds)
        R = step.R @ start.R
        return Pose(R, centre + step.t - R @ model.center)

    return path


def away_and_back(path: Path, model: ObjectModel, away: NDArray[np.float64], duration: float) -> Path:
    """The same path, but for the time from 0.4 to 0.6 of the duration (seconds) with the object's centre at ``away``,
    metres."""

    def left(seconds: float) -> Pose:
        pose, part = path(seconds), seconds / duration
        gone = smoothstep((part - 0.2) / 0.2) * smoothstep((0.8 - part) / 0.2)
        return Pose(pose.R, pose.t + gone * (away - pose.apply(model.center)))

    return left


def passing(pose: Pose, reach: NDArray[np.float64], duration: float) -> Path:
    """Evenly from ``-reach`` to ``+reach`` (metres) about a pose, which is met in the middle of the duration."""
    return lambda seconds: Pose(pose.R, pose.t + (2 * seconds / duration - 1) * reach)


def smoothstep(x: ArrayLike) -> float:
    """From 0 to 1 as x does, without corners."""
    t = np.clip(np.asarray(x, dtype=np.float64), 0.0, 1.0)
    return float(t * t * (3 - 2 * t))

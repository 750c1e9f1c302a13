"""The transforms after which an object looks the same."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from posekit.errors import MeshError
from posekit.geometry import Pose, hat, rotation_angle, so3_exp
from posekit.io.files import read_text
from posekit.mesh.units import UNITS

_MOST_SYMMETRIES = 720

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Continuous:
    """Any turn about a line. axis: (3,) unit vector in ``obj``; offset: (3,) metres, a point of the line."""

    axis: Floats
    offset: Floats

    def __post_init__(self) -> None:
        axis, offset = (np.array(v, dtype=np.float64).reshape(3) for v in (self.axis, self.offset))
        length = np.linalg.norm(axis)
        if not np.isfinite([*axis, *offset]).all() or length < 1e-9:
            raise ValueError(f"a symmetry needs an axis that is not zero and a finite offset, not {axis}, {offset}")
        object.__setattr__(self, "axis", axis / length)
        object.__setattr__(self, "offset", offset)

    def turn(self, angle: float) -> Pose:
        """T_obj_obj of a turn by ``angle``, radians."""
        return _turn_about(so3_exp(self.axis * angle), self.offset)


@dataclass(frozen=True, eq=False)
class Symmetries:
    """The transforms ``T_obj_obj`` after which the object looks the same.

    discrete: without the identity, metres. continuous: axes about which it may be turned by any angle.
    """

    discrete: tuple[Pose, ...] = ()
    continuous: tuple[Continuous, ...] = ()

    @classmethod
    def none(cls) -> Symmetries:
        """Of an object that has no symmetry."""
        return cls()

    @classmethod
    def parse(cls, text: str, center: ArrayLike) -> Symmetries:
        """Symmetries from a text such as ``z:2`` or ``x:2,y:inf``; center: (3,) metres, a point of every axis.

        ``AXIS:ORDER``, several separated by commas. AXIS is x, y or z (the mesh's own axes); ORDER is a whole
        number n from 2 on (looks the same after 1/n of a turn) or ``inf`` (after any turn). Products of the given
        turns are added: ``x:2,y:2`` has ``z:2`` too. ``none`` says that the object has no symmetry.
        Raises MeshError where the text is something else.
        """
        middle = np.asarray(center, dtype=np.float64)
        if text.strip().lower() == "none":
            return cls.none()
        turns: list[Floats] = []
        continuous: list[Continuous] = []
        for item in text.split(","):
            match = re.fullmatch(r"\s*([xyz])\s*:\s*(\d{1,3}|inf)\s*", item, re.IGNORECASE)
            order = 0 if match is None or match[2].lower() == "inf" else int(match[2])
            if match is None or (order < 2 and match[2].lower() != "inf"):
                raise MeshError(
                    f"symmetry {text!r}: {item.strip()!r} is not AXIS:ORDER. Give x, y or z, a colon, and 2, 3, ... "
                    'or inf, several separated by commas, as in "z:2", "z:inf" or "x:2,y:2"; or "none".'
                )
            axis = np.eye(3)["xyz".index(match[1].lower())]
            if order:
                turns.append(so3_exp(axis * (2 * np.pi / order)))
            else:
                continuous.append(Continuous(axis, middle))
        return cls(tuple(_turn_about(R, middle) for R in _group(turns, text)), tuple(continuous))

    @classmethod
    def from_bop(cls, info: Mapping[str, Any]) -> Symmetries:
        """From an object's entry in BOP's ``models_info.json`` (mm). Raises ValueError, TypeError,
        KeyError or OverflowError where it is malformed."""
        discrete = []
        for numbers in info.get("symmetries_discrete", ()):
            matrix = np.asarray(numbers, dtype=np.float64).reshape(4, 4).copy()
            matrix[:3, 3] *= UNITS["mm"]
            discrete.append(Pose.from_matrix(matrix))
        continuous = [
            Continuous(np.asarray(entry["axis"]), np.asarray(entry.get("offset", (0, 0, 0))) * UNITS["mm"])
            for entry in info.get("symmetries_continuous", ())
        ]
        return cls(tuple(discrete), tuple(continuous))

    def transforms(self, max_steps: int = 64) -> list[Pose]:
        """All symmetry transforms, the identity first: BOP's way.

        Continuous ones become ``max_steps`` turns each, every one combined with every discrete one. (BOP itself
        takes 315 steps.)
        """
        discrete = [Pose.identity(), *self.discrete]
        angles = np.arange(1, max_steps) * (2 * np.pi / max_steps)
        turns = [Pose.identity(), *(c.turn(a) for c in self.continuous for a in angles)]
        return [turn @ still for turn in turns for still in discrete]

    def __bool__(self) -> bool:
        """Whether there is one."""
        return bool(self.discrete or self.continuous)

    def nearest(self, T_a_obj: Pose, reference: Pose) -> Pose:
        """Of the poses in which the object looks as in ``T_a_obj``, the one with the rotation nearest to the
        reference's. About continuous axes it is exact where there is one of them, else as fine as `transforms`."""
        if not self:
            return T_a_obj
        exact = len(self.continuous) == 1
        turns = self.discrete if exact else self.transforms()[1:]
        candidates = [T_a_obj, *(T_a_obj @ S for S in turns)]
        if exact:
            candidates = [pose @ self.continuous[0].turn(_turn_towards(pose, reference, self.continuous[0].axis))
                          for pose in candidates]  # fmt: skip
        return max(candidates, key=lambda pose: float(np.trace(reference.R.T @ pose.R)))

    def angles(self, R: Floats, others: Floats) -> Floats:
        """Angle (N,), radians, from R_a_obj (3, 3) to each of others (N, 3, 3), to the nearest of the equivalent ones;
        continuous axes in steps of 10 degrees."""
        equivalent = np.stack([R @ S.R for S in self.transforms(36)])
        return np.asarray(rotation_angle(np.swapaxes(others, -1, -2)[:, None] @ equivalent).min(axis=1))


def _turn_towards(pose: Pose, reference: Pose, axis: Floats) -> float:
    """The angle of the turn about an axis in ``obj`` that brings a pose's rotation nearest to the reference's."""
    # trace(M exp(a hat(axis))) = axis' M axis + cos(a) (trace M - axis' M axis) + sin(a) trace(M hat(axis))
    M = reference.R.T @ pose.R
    return float(np.arctan2(np.trace(M @ hat(axis)), np.trace(M) - axis @ M @ axis))


def _turn_about(R: Floats, point: Floats) -> Pose:
    return Pose(R, point - R @ point)


def _group(turns: Sequence[Floats], text: str) -> list[Floats]:
    """All products of rotations (3, 3), without the identity."""
    found = [np.eye(3)]
    for known in found:  # grows during the loop
        for turn in turns:
            product = turn @ known
            if np.abs(np.stack(found) - product).max(axis=(1, 2)).min() > 1e-6:
                found.append(product)
        if len(found) > _MOST_SYMMETRIES:
            raise MeshError(
                f"symmetry {text!r}: these turns together give more than {_MOST_SYMMETRIES} symmetries, which no "
                "object has but a body of revolution: use inf for its axis."
            )
    return found[1:]


def symmetries_of(given: str | Symmetries | None, path: Path, center: Floats) -> Symmetries:
    """What `ObjectModel.load` takes for the symmetries of the mesh at path; center: (3,) metres. Raises MeshError."""
    if isinstance(given, Symmetries):
        return given
    if given is None:
        info = path.parent / "models_info.json"
        return _symmetries_from_file(info, path) if info.is_file() else Symmetries.none()
    if given.lower().endswith(".json"):
        if not Path(given).is_file():
            raise MeshError(f"there is no symmetry file {given}: check the path, or pass a text such as z:2.")
        return _symmetries_from_file(Path(given), path)
    return Symmetries.parse(given, center)


def _symmetries_from_file(file: Path, mesh: Path) -> Symmetries:
    """The entry for a mesh in a file of models_info.json's form, or of an entry's own form (mm)."""
    try:
        data = json.loads(read_text(file))
        if not isinstance(data, dict):
            raise ValueError("its outermost part is not {...}")
        number = re.fullmatch(r"obj_(\d+)", mesh.stem)
        keys = [mesh.stem, *([str(int(number[1]))] if number else [])]
        own = data if any(key.startswith("symmetries_") for key in data) else {}
        return Symmetries.from_bop(next((data[key] for key in keys if key in data), own))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise MeshError(
            f"the symmetries in {file} cannot be used ({error}): give symmetries_discrete as lists of 16 numbers and "
            "symmetries_continuous as {axis, offset}, in mm, as BOP's models_info.json does."
        ) from error

"""RBOT and BCOT, the sequences that 3D object trackers are compared on, as they lie on the disk. Millimetres become
metres here.

RBOT (Tjaden et al., 2018), as SRT3D's and RBGT's evaluation (DLR-RM/3DObjectTracking) and DeepAC read it::

    camera_calibration.txt           a header line, then fx fy cx cy
    poses_first.txt                  a header line, then a line for each frame: nine numbers of the rotation, row by
                                     row, and three of the translation, mm
    poses_second.txt                 the same for the second object in d_occlusion
    squirrel_small.obj               that second object, mm
    ape/ape.obj                      an object, mm
    ape/frames/a_regular0000.png     its frames, 640 x 512; also b_dynamiclight, c_noisy and d_occlusion

All objects and variants share the two files of poses. Frames are numbered from 0 as the poses are: 1,001 of them.

BCOT (Li et al., 2022), as DeepAC reads it::

    models/Cat.obj                             an object, mm
    easy_static_handheld/K.txt                 nine numbers of the camera's matrix, row by row
    easy_static_handheld/Cat/pose.txt          a line for each frame, the same twelve numbers, without a header
    easy_static_handheld/Cat/0000.png          the frames

Its ``box.txt`` is not needed. Both are data sets with what a `BopDataset` has; each sequence is a scene.
"""

from __future__ import annotations

import json
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.datasets.bop import BopDataset, Instance, MeasuredModel
from posekit.datasets.linemod import DeepimDataset
from posekit.errors import CameraError, ConfigError, InputError, MeshError
from posekit.geometry import Pose
from posekit.io.files import read_text
from posekit.io.load import load_image, picture_size, pose_from_bop
from posekit.mesh.model import ObjectModel
from posekit.view import View

VARIANTS = {"a_regular": "regular", "b_dynamiclight": "light", "c_noisy": "noise", "d_occlusion": "occlusion"}
SEQUENCES = "sequences.json"  # of synthetic data sets: what their scenes show
SECOND = "squirrel_small"  # RBOT's second object in d_occlusion
_CALIBRATION, _FIRST, _SECOND_POSES = "camera_calibration.txt", "poses_first.txt", "poses_second.txt"


@dataclass(frozen=True, eq=False)
class Sequence3D:
    """A sequence of one object. name: of the variant (RBOT) or the scene (BCOT). frames: files by their numbers.
    K: (3, 3). poses: ``T_cam_obj`` by frame. second: the object that passes before it and its poses, where there is
    one."""

    name: str
    obj_id: int
    frames: dict[int, Path]
    K: NDArray[np.float64]
    poses: Sequence[Pose]
    second: tuple[int, Sequence[Pose]] | None = None


class SequenceDataset(ABC):
    """Sequences with one object each. meshes: files by number. units: of the meshes; auto is mm.

    A scene's number is a hundred times that of its variant or place, from 1 on, plus that of its object.
    """

    targets = None

    def __init__(self, root: Path, name: str, split: str | None, meshes: dict[int, Path], units: str) -> None:
        self.root, self.name, self.split = root, name, split or "all"
        self._meshes, self._units = meshes, "mm" if units == "auto" else units
        self._loaded: dict[int, ObjectModel] = {}

    @cached_property
    @abstractmethod
    def sequences(self) -> dict[int, Sequence3D]:
        """The sequences by the numbers of their scenes. Raises InputError."""

    def sequence(self, scene: int) -> Sequence3D:
        """A scene's sequence. Raises InputError where there is none of this number."""
        if scene not in self.sequences:
            raise InputError(f"{self.root} has no sequence {scene}; there are {self.scenes()}.")
        return self.sequences[scene]

    def scenes(self) -> list[int]:
        """Numbers of the sequences."""
        return sorted(self.sequences)

    def images(self, scene: int | None = None) -> list[tuple[int, int]]:
        """(scene, image) of all frames, or of one scene's, in order."""
        scenes = self.scenes() if scene is None else [scene]
        return [(s, image) for s in scenes for image in self.sequence(s).frames]

    def model_ids(self) -> list[int]:
        """The objects' numbers."""
        return sorted(self._meshes)

    def model(self, obj_id: int) -> ObjectModel:
        """An object's mesh in metres; loaded once. Raises MeshError."""
        if obj_id not in self._loaded:
            if obj_id not in self._meshes:
                raise MeshError(f"{self.root} has no object {obj_id}; there are {self.model_ids()}.")
            self._loaded[obj_id] = ObjectModel.load(self._meshes[obj_id], units=self._units)
        return self._loaded[obj_id]

    def measured_model(self, obj_id: int) -> MeasuredModel:
        """The object with its mesh's own diameter, metres. Raises MeshError."""
        model = self.model(obj_id)
        return MeasuredModel(model, model.diameter)

    def object_names(self) -> dict[int, str]:
        """Names by number, as the meshes' files have them."""
        return {obj_id: path.stem for obj_id, path in self._meshes.items()}

    def view(self, scene: int, image: int) -> View:
        """A frame with its camera. Raises ImageError where it is damaged."""
        pixels = load_image(self.image_path(scene, image))
        return View(pixels, self.camera(scene, image, (pixels.shape[1], pixels.shape[0])))

    def image_path(self, scene: int, image: int) -> Path:
        """The file of a frame. Raises InputError where it is missing."""
        path = self.sequence(scene).frames.get(image)
        if path is None:
            raise InputError(f"sequence {scene} of {self.root} has no frame {image}: this copy is not complete.")
        return path

    def picture_size(self, scene: int, image: int) -> tuple[int, int]:
        """A frame's (width, height), from its header. Raises ImageError where it is damaged."""
        return picture_size(self.image_path(scene, image))

    def camera(self, scene: int, _image: int, size: tuple[int, int]) -> Camera:
        """The sequence's camera; size: (width, height) in pixels."""
        return Camera.from_K(self.sequence(scene).K, *size)

    def depth(self, _scene: int, _image: int) -> NDArray[np.float32] | None:
        """None: there is no depth."""
        return None

    def instances(self, scene: int, image: int, every: bool = False) -> list[Instance]:
        """The followed object, ``T_cam_obj`` in metres; with ``every`` also the second one. Boxes, masks and visible
        shares are not in the data."""
        here = self.sequence(scene)
        self.image_path(scene, image)
        found = [self._instance(scene, image, 0, here.obj_id, here.poses)]
        if every and here.second is not None:
            found.append(self._instance(scene, image, 1, *here.second))
        return found

    def _instance(self, scene: int, image: int, index: int, obj_id: int, poses: Sequence[Pose]) -> Instance:
        nowhere = self.root / "mask_visib" / f"{scene}_{image}_{index}.png"
        return Instance(scene, image, index, obj_id, poses[image], None, None, math.nan, nowhere)


class RbotDataset(SequenceDataset):
    """RBOT. split: a variant, as a_regular or regular; all of them where it is None. Raises ConfigError for another
    name, InputError where a file is missing or damaged."""

    def __init__(self, root: str | Path, split: str | None = None, units: str = "auto") -> None:
        root = Path(root)
        names = {**{full: full for full in VARIANTS}, **{short: full for full, short in VARIANTS.items()}}
        if split is not None and split not in names:
            raise ConfigError(
                f"RBOT has no variant {split!r}: --split is one of {', '.join(VARIANTS)}, or left out for all of them."
            )
        self._variants = list(VARIANTS) if split is None else [names[split]]
        folders = sorted(p for p in root.iterdir() if (p / "frames").is_dir() and (p / f"{p.name}.obj").is_file())
        if not folders:
            raise InputError(f"{root} has no objects such as ape/ape.obj with ape/frames/: this copy is not complete.")
        self._folders = dict(enumerate(folders, 1))
        meshes = {k: p / f"{p.name}.obj" for k, p in self._folders.items()}
        self._second = 1 + len(folders) if (root / f"{SECOND}.obj").is_file() else None
        if self._second is not None:
            meshes[self._second] = root / f"{SECOND}.obj"
        super().__init__(root, "rbot", None if split is None else VARIANTS[names[split]], meshes, units)

    @cached_property
    def sequences(self) -> dict[int, Sequence3D]:
        """The sequences by the numbers of their scenes: 101 is the first object's regular one."""
        K, first = _four(self.root / _CALIBRATION), _poses(self.root / _FIRST)
        second = self.root / _SECOND_POSES
        other = (self._second, _poses(second)) if self._second is not None and second.is_file() else None
        found = {}
        for obj_id, folder in self._folders.items():
            for variant in self._variants:
                frames = _numbered(folder / "frames", rf"{variant}(\d+)\.png")
                if frames:
                    _check(frames, first, self.root / _FIRST)
                    scene = 100 * (1 + list(VARIANTS).index(variant)) + obj_id
                    passing = other if variant == "d_occlusion" else None
                    if passing is not None:
                        _check(frames, passing[1], second)
                    found[scene] = Sequence3D(VARIANTS[variant], obj_id, frames, K, first, passing)
        if not found:
            raise InputError(f"{self.root} has no frames such as ape/frames/a_regular0000.png: check the variant.")
        return found


class BcotDataset(SequenceDataset):
    """BCOT. split: a scene such as easy_static_handheld; all of them where it is None. Raises ConfigError for another
    name, InputError where a file is missing or damaged."""

    def __init__(self, root: str | Path, split: str | None = None, units: str = "auto") -> None:
        root = Path(root)
        every = sorted(path.parent.name for path in root.glob("*/K.txt"))
        if split is not None and split not in every:
            raise ConfigError(f"{root} has no scene {split!r}; --split is one of {', '.join(every)}, or left out.")
        self._places = {name: k for k, name in enumerate(every, 1) if split in (None, name)}
        meshes = dict(enumerate(sorted((root / "models").glob("*.obj")), 1))
        super().__init__(root, "bcot", split, meshes, units)

    @cached_property
    def sequences(self) -> dict[int, Sequence3D]:
        """The sequences by the numbers of their scenes: 101 is the first place's of the first object."""
        found = {}
        for place, number in self._places.items():
            K = _matrix(self.root / place / "K.txt")
            for obj_id, mesh in self._meshes.items():
                file = self.root / place / mesh.stem / "pose.txt"
                if file.is_file():
                    poses, frames = _poses(file, header=False), _numbered(file.parent, r"(\d+)\.png")
                    _check(frames, poses, file)
                    found[100 * number + obj_id] = Sequence3D(place, obj_id, frames, K, poses)
        if not found:
            raise InputError(f"{self.root} has no sequences such as {next(iter(self._places))}/Cat/pose.txt.")
        return found


@dataclass(frozen=True)
class Followed:
    """What a tracker follows in a scene. variant: of the sequence, such as "regular". obj_id: None for all objects."""

    variant: str
    obj_id: int | None = None


def followed(data: SequenceDataset | BopDataset | DeepimDataset, scene: int) -> Followed:
    """What a scene's tracker follows: in BOP's layout as `posekit synth` writes it into ``sequences.json``; all
    objects where nothing is said. Raises InputError."""
    if isinstance(data, SequenceDataset):
        return Followed(data.sequence(scene).name, data.sequence(scene).obj_id)
    path = data.root / SEQUENCES
    if not path.is_file():
        return Followed(data.split)
    try:
        entry = json.loads(read_text(path)).get(str(scene), {})
        obj_id = entry.get("object")
        return Followed(
            str(entry.get("variant", entry.get("motion", data.split))), None if obj_id is None else int(obj_id)
        )
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise InputError(f"{path} cannot be read ({error}): it says of each scene what it shows.") from error


def is_rbot(root: Path) -> bool:
    """Whether a folder has RBOT's layout."""
    return (root / _FIRST).is_file() and (root / _CALIBRATION).is_file()


def is_bcot(root: Path) -> bool:
    """Whether a folder has BCOT's layout."""
    return any((root / "models").glob("*.obj")) and any(root.glob("*/*/pose.txt")) and any(root.glob("*/K.txt"))


def _numbered(folder: Path, pattern: str) -> dict[int, Path]:
    """Files by the number in their names, in its order."""
    matches = ((re.fullmatch(pattern, path.name), path) for path in folder.iterdir())
    return dict(sorted((int(match[1]), path) for match, path in matches if match is not None))


def _check(frames: Iterable[int], poses: Sequence[Pose], file: Path) -> None:
    last = max(frames, default=0)
    if last >= len(poses):
        raise InputError(f"{file} has {len(poses)} poses, and there is a frame {last}: they belong together.")


def _rows(path: Path, count: int, header: bool) -> list[list[float]]:
    """Lines of ``count`` numbers each. header: whether the first line may be something else."""
    try:
        lines = [line.split() for line in read_text(path).splitlines()]
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read ({error}): this copy of the data set is not complete.") from error
    rows: list[list[float]] = []
    for number, parts in enumerate(lines, 1):
        if not parts:
            continue
        try:
            row = [float(part) for part in parts]
        except ValueError:
            row = []
        if len(row) == count and np.isfinite(row).all():
            rows.append(row)
        elif number > 1 or not header:
            raise InputError(f"{path}, line {number}: {' '.join(parts)[:60]!r} is not {count} numbers.")
    if not rows:
        raise InputError(f"{path} has no line of {count} numbers.")
    return rows


def _poses(path: Path, header: bool = True) -> list[Pose]:
    poses = []
    for number, row in enumerate(_rows(path, 12, header)):
        try:
            poses.append(pose_from_bop(row[:9], row[9:]))
        except ValueError as error:
            raise InputError(f"{path}, pose {number}: its first nine numbers are no rotation.") from error
    return poses


def _four(path: Path) -> NDArray[np.float64]:
    """K (3, 3) of fx fy cx cy."""
    fx, fy, cx, cy = _rows(path, 4, header=True)[0]
    return _focal(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), path)


def _matrix(path: Path) -> NDArray[np.float64]:
    """K (3, 3) of nine numbers in one line or three."""
    try:
        numbers = [float(part) for part in read_text(path).split()]
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read ({error}): it holds a camera's matrix, nine numbers.") from error
    if len(numbers) != 9:
        raise InputError(f"{path} holds {len(numbers)} numbers: a camera's matrix has nine.")
    return _focal(np.reshape(numbers, (3, 3)), path)


def _focal(K: NDArray[np.float64], path: Path) -> NDArray[np.float64]:
    if not np.isfinite(K).all() or min(K[0, 0], K[1, 1]) <= 0:
        raise CameraError(f"{path}: the focal lengths are positive numbers of pixels, not {K[0, 0]:g} and {K[1, 1]:g}.")
    return K

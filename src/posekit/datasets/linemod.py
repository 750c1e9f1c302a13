"""LINEMOD as BB8 and DeepIM measured on it: 13 objects, a training share of about 15 %, the rest is the test.

The split is read from ``{cls}_train.txt`` or ``{cls}_test.txt`` where there are such lists (in the data set's folder,
``image_set/``, ``image_set/observed/`` or ``splits/``). Elsewhere it is made anew: frames are taken greedily in their
order, each at least 15 degrees from all taken before; they would be the training share. Such a split is called
"regenerated", and ``split_hash`` names either.
"""

from __future__ import annotations

import hashlib
import re
from abc import ABC, abstractmethod
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.datasets.bop import BopDataset, Instance, MeasuredModel
from posekit.errors import ImageError, InputError, MeshError
from posekit.geometry import Pose, rotation_angle
from posekit.io.load import load_image
from posekit.mesh.model import ObjectModel
from posekit.view import View

CLASSES = {1: "ape", 2: "benchvise", 4: "cam", 5: "can", 6: "cat", 8: "driller", 9: "duck", 10: "eggbox", 11: "glue",
           12: "holepuncher", 13: "iron", 14: "lamp", 15: "phone"}  # fmt: skip
ALSO_CALLED = {4: ("cam", "camera")}
LEAST_APART_DEG = 15.0
_LISTS = (".", "image_set", "image_set/observed", "splits")
_LINEMOD_K = np.array([[572.4114, 0, 325.2611], [0, 573.57043, 242.04899], [0, 0, 1]])  # of all its photographs


def spread_rotations(rotations: NDArray[np.float64], least_deg: float = LEAST_APART_DEG) -> list[int]:
    """Indices of rotations (N, 3, 3) taken greedily, each at least ``least_deg`` from all taken before."""
    taken: list[int] = []
    least = np.deg2rad(least_deg)
    for k, R in enumerate(rotations):
        if not taken or rotation_angle(np.swapaxes(rotations[taken], -1, -2) @ R).min() >= least:
            taken.append(k)
    return taken


class _Split:
    """Which frames of each object are the test."""

    def __init__(self, root: Path, frames: dict[int, list[int]], rotations: dict[int, NDArray[np.float64]]) -> None:
        self.test: dict[int, list[int]] = {}
        self.regenerated: list[int] = []
        for obj_id, here in frames.items():
            self.test[obj_id] = self._chosen(root, obj_id, here, rotations[obj_id])

    def _chosen(self, root: Path, obj_id: int, frames: list[int], rotations: NDArray[np.float64]) -> list[int]:
        for kind in ("test", "train"):
            path = _list_file(root, obj_id, kind)
            if path is not None:
                listed = _listed(path)
                unknown = sorted(listed - set(frames))
                if kind == "test" and unknown and not set(frames) & listed:
                    raise InputError(f"{path} lists frames such as {unknown[0]}, none of which is in this copy.")
                return [f for f in frames if (f in listed) == (kind == "test")]
        self.regenerated.append(obj_id)
        training = {frames[k] for k in spread_rotations(rotations)}
        return [f for f in frames if f not in training]

    @property
    def label(self) -> str:
        if not self.regenerated:
            return "lists of the data set"
        if len(self.regenerated) == len(self.test):
            return "regenerated (greedy, 15 degrees apart)"
        return f"lists, and regenerated for objects {', '.join(map(str, self.regenerated))}"

    @property
    def digest(self) -> str:
        text = "\n".join(f"{o}/{f}" for o, frames in sorted(self.test.items()) for f in frames)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def _list_file(root: Path, obj_id: int, kind: str) -> Path | None:
    names = [f"{name}_{kind}.txt" for name in ALSO_CALLED.get(obj_id, (CLASSES[obj_id],))]
    places = [root / folder / name for folder in _LISTS for name in names]
    return next((place for place in places if place.is_file()), None)


def _listed(path: Path) -> set[int]:
    """The frames' numbers: the last whole number in each line, as in ``01/000005`` or ``cat/000005-color.png``."""
    frames = set()
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        found = re.findall(r"\d+", line.split()[0]) if line.strip() else None
        if found == []:
            raise InputError(f"{path}, line {number}: {line.strip()!r} names no frame; give lines such as 01/000005.")
        if found:
            frames.add(int(found[-1]))
    return frames


class _TestShare(ABC):
    """What both readers have in common: 13 objects with a sequence each, of which the frames of the split's test share
    are shown."""

    _kept: list[int]  # numbers of the scenes, each that of its object

    @property
    @abstractmethod
    def frames(self) -> _Split:
        """Which frames of each object are the test."""

    @property
    def split_label(self) -> str:
        """Where the split comes from, for a person."""
        return self.frames.label

    @property
    def split_hash(self) -> str:
        """16 hexadecimal digits that name the split."""
        return self.frames.digest

    def scenes(self) -> list[int]:
        """Numbers of the scenes, each that of its object."""
        return self._kept

    def images(self, scene: int | None = None) -> list[tuple[int, int]]:
        """(scene, image) of the test's frames, of one scene or of all."""
        scenes = self._kept if scene is None else [scene]
        return [(s, image) for s in scenes for image in self.frames.test[s]]


class LinemodDataset(_TestShare, BopDataset):
    """LINEMOD in BOP layout (``lm``), 13 objects, the frames of the split's test share.

    A scene holds one object's sequence and has its number; other objects annotated in it are left out.
    """

    def __init__(self, root: str | Path, split: str = "test") -> None:
        super().__init__(root, split, targets=None)
        self._kept = [s for s in BopDataset.scenes(self) if s in CLASSES]
        if not self._kept:
            raise InputError(
                f"{self.root / split} has none of LINEMOD's 13 sequences (000001 is the ape's, and so on)."
            )

    @cached_property
    def frames(self) -> _Split:
        """Which frames of each object are the test; where no list says so, the annotated rotations do."""
        frames, rotations = {}, {}
        for scene in self._kept:
            poses = {}
            for _, image in BopDataset.images(self, scene):
                found = [i for i in super().instances(scene, image, every=True) if i.obj_id == scene]
                if found:
                    poses[image] = found[0].T_cam_obj.R
            frames[scene] = list(poses)
            rotations[scene] = np.array(list(poses.values()))
        return _Split(self.root, frames, rotations)

    def instances(self, scene: int, image: int, every: bool = False) -> list[Instance]:
        """The scene's own object in a picture; every: all that are annotated. Poses ``T_cam_obj`` in metres."""
        found = super().instances(scene, image, every)
        return found if every else [i for i in found if i.obj_id == scene]


def is_deepim(root: Path) -> bool:
    """Whether a folder has DeepIM's converted layout (``LM6d_refine``)."""
    return (root / "data" / "observed").is_dir()


class DeepimDataset(_TestShare):
    """LINEMOD as DeepIM's scripts convert it: ``data/observed/06/000001-color.png`` (and -depth, -label),
    ``data/gt_observed/cat/000001-pose.txt`` (or beside the photograph), ``models/cat/textured.obj`` in metres.

    It has what a `BopDataset` has; a scene is an object's sequence.
    """

    split = "observed"
    targets = None

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root)
        self.name = "linemod"
        self._observed = self.root / "data" / "observed"
        self._loaded: dict[int, ObjectModel] = {}
        self._kept = [o for o in CLASSES if (self._observed / f"{o:02d}").is_dir()]
        if not self._kept:
            raise InputError(f"{self._observed} has none of LINEMOD's sequences (01 is the ape's, and so on).")

    @cached_property
    def frames(self) -> _Split:
        """Which frames of each object are the test; where no list says so, the annotated rotations do."""
        numbers = {
            o: sorted(int(p.name.split("-")[0]) for p in (self._observed / f"{o:02d}").glob("*-color.png"))
            for o in self._kept
        }
        rotations = {o: np.array([self._pose(o, f).R for f in frames]) for o, frames in numbers.items()}
        return _Split(self.root, numbers, rotations)

    def model_ids(self) -> list[int]:
        """Numbers of the objects that this copy has."""
        return self._kept

    def model(self, obj_id: int) -> ObjectModel:
        """An object's mesh in metres; loaded once. Its symmetries are BOP's where models_info.json is there, else the
        half turns of eggbox and glue."""
        if obj_id not in self._loaded:
            names = ALSO_CALLED.get(obj_id, (CLASSES[obj_id],))
            found = [self.root / "models" / n / f for n in names for f in ("textured.obj", f"{n}.obj", f"{n}.ply")]
            path = next((p for p in found if p.is_file()), None)
            if path is None:
                raise MeshError(f"there is no mesh {found[0]} for object {obj_id}: get DeepIM's models.")
            half_turn = "z:2" if obj_id in (10, 11) else None
            self._loaded[obj_id] = ObjectModel.load(path, symmetry=half_turn)
        return self._loaded[obj_id]

    def measured_model(self, obj_id: int) -> MeasuredModel:
        """The object with its mesh's own diameter, metres. Raises MeshError where there is no mesh."""
        model = self.model(obj_id)
        return MeasuredModel(model, model.diameter)

    def view(self, scene: int, image: int) -> View:
        """A frame with LINEMOD's camera. Raises ImageError where the picture is missing or damaged."""
        pixels = load_image(self.image_path(scene, image))
        return View(pixels, self.camera(scene, image, (pixels.shape[1], pixels.shape[0])))

    def image_path(self, scene: int, image: int) -> Path:
        """The file of a frame's colours."""
        return self._observed / f"{scene:02d}" / f"{image:06d}-color.png"

    def picture_size(self, scene: int, image: int) -> tuple[int, int]:
        """(width, height) in pixels. Raises ImageError where the picture is missing or damaged."""
        pixels = load_image(self.image_path(scene, image))
        return pixels.shape[1], pixels.shape[0]

    def camera(self, _scene: int, _image: int, size: tuple[int, int]) -> Camera:
        """LINEMOD's camera, the same for all frames; size: (width, height) in pixels."""
        return Camera.from_K(_LINEMOD_K, *size)

    def depth(self, scene: int, image: int) -> NDArray[np.float32] | None:
        """float32 (H, W), metres, 0 where it was not measured; None where the copy has none. Raises ImageError."""
        path = self._observed / f"{scene:02d}" / f"{image:06d}-depth.png"
        if not path.is_file():
            return None
        raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if raw is None or raw.ndim != 2:
            raise ImageError(f"the depth image {path} is damaged or has several channels: copy it again.")
        return np.asarray(raw, dtype=np.float32) / np.float32(1000.0)

    def instances(self, scene: int, image: int, every: bool = False) -> list[Instance]:  # noqa: ARG002
        """The one object of a frame, ``T_cam_obj`` in metres; ``every`` changes nothing. Raises InputError."""
        mask_path = self._observed / f"{scene:02d}" / f"{image:06d}-label.png"
        return [DeepimInstance(scene, image, 0, scene, self._pose(scene, image), None, None, np.nan, mask_path)]

    def _pose(self, obj_id: int, frame: int) -> Pose:
        names = ALSO_CALLED.get(obj_id, (CLASSES[obj_id],))
        beside = self._observed / f"{obj_id:02d}" / f"{frame:06d}-pose.txt"
        places = [self.root / "data" / "gt_observed" / n / f"{frame:06d}-pose.txt" for n in names]
        path = next((p for p in [*places, beside] if p.is_file()), None)
        if path is None:
            raise InputError(f"there is no pose {places[0]} for frame {frame}: this copy is not complete.")
        try:
            rows = np.loadtxt(path, skiprows=1).reshape(3, 4)
            return Pose.from_matrix(np.vstack([rows, [0, 0, 0, 1]]))
        except ValueError as error:
            raise InputError(f"{path} is no pose (a line, then 3 x 4 numbers): {error}.") from error


class DeepimInstance(Instance):
    """An instance whose mask is a label picture: the object's pixels hold its number."""

    def mask(self) -> NDArray[np.bool_]:
        """Its visible pixels, bool (H, W). Raises ImageError where the file is missing or damaged."""
        raw = cv2.imread(str(self.mask_path), cv2.IMREAD_UNCHANGED)
        if raw is None:
            raise ImageError(f"the label picture {self.mask_path} is missing or damaged: copy it again.")
        labels = raw if raw.ndim == 2 else raw[..., 0]
        return np.asarray(labels == self.obj_id)

"""Data sets in BOP layout, read as they lie on the disk. Millimetres become metres here."""

from __future__ import annotations

import json
import logging
import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Box, Camera
from posekit.errors import CameraError, ImageError, InputError, MeshError
from posekit.geometry import Pose
from posekit.io.calibration import calibration_of_entry
from posekit.io.files import read_text
from posekit.io.load import load_image, load_mask, picture_size, pose_from_bop
from posekit.mesh.model import ObjectModel
from posekit.mesh.units import UNITS
from posekit.view import View

_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
_MESHES = (".ply", ".obj", ".glb", ".gltf", ".stl")
_JSON_KINDS: dict[type, str] = {dict: "map", list: "list"}
_UNIT_NAMES = {"m": "metres", "cm": "centimetres", "in": "inches"}
_NEAREST_MM = 10.0  # of a scene's farthest object
_DOUBTFUL_MM = 3.0  # a diameter that is more likely one in metres

log = logging.getLogger("posekit")


@dataclass(frozen=True, eq=False)
class Instance:
    """An annotated object in a photograph.

    index: its number in the image's annotations. T_cam_obj: metres. box_obj: round the whole object, box_visib: round
    what is seen of it; edges in pixels, None where it is outside the picture. visib_fract: in [0, 1].
    mask_path: PNG of its visible pixels; the file may be missing.
    Where the data set has no scene_gt_info.json, the boxes are None and visib_fract is NaN.
    """

    scene: int
    image: int
    index: int
    obj_id: int
    T_cam_obj: Pose
    box_obj: Box | None
    box_visib: Box | None
    visib_fract: float
    mask_path: Path

    def mask(self) -> NDArray[np.bool_]:
        """Its visible pixels, bool (H, W), all False where nothing is visible. Raises PromptError where the file is
        missing or damaged."""
        return load_mask(self.mask_path, allow_empty=True)


@dataclass(frozen=True, eq=False)
class MeasuredModel:
    """An object as errors are measured with it. diameter: metres, as models_info.json has it, where it does."""

    model: ObjectModel
    diameter: float


@dataclass(frozen=True, eq=False)
class Target:
    """What a test asks for: ``count`` instances of an object in an image."""

    scene: int
    image: int
    obj_id: int
    count: int


class BopDataset:
    """A folder in BOP layout: ``models/``, ``SPLIT/SCENE/{rgb, scene_camera.json, ...}``.

    split: the folder with scenes; ``test:photoneo`` where a scene has the pictures of several sensors
    (``scene_camera_photoneo.json``, ``rgb_photoneo/``); the only sensor needs no name. targets: a test's list of
    images and objects, by default the first ``SPLIT_targets_*.json`` (bop19 before others) in the folder; where there
    is one, `images` and `instances` keep to it. Pass ``targets=None`` to see everything. units: of the meshes; auto is
    BOP's mm, or what fits the stated diameter. Raises InputError where the layout is not there.
    """

    def __init__(
        self,
        root: str | Path,
        split: str = "test",
        targets: str | None = "auto",
        models: str = "models",
        units: str = "auto",
    ) -> None:
        split, _, sensor = split.partition(":")
        self.root, self.split, self.name = Path(root), split, Path(root).resolve().name
        self.sensor = sensor or None
        if not (self.root / split).is_dir():
            raise InputError(
                f"{self.root} has no folder {split!r}: a data set in BOP layout has models/ and {split}/000001/ and so "
                "on. Check the path and the split."
            )
        self._models, self._units = self.root / models, units
        self._targets_file = self._find_targets(targets)
        self._loaded: dict[int, ObjectModel] = {}
        self._measured: dict[int, MeasuredModel] = {}
        self._scenes: dict[int, _Scene] = {}

    # --- what there is ---

    def model_ids(self) -> list[int]:
        """The objects' numbers. Raises MeshError where there are no models."""
        found = sorted(_meshes(self._models))
        if not found:
            raise MeshError(f"there are no meshes {self._models}/obj_000001.ply and so on: get the data set's models.")
        return found

    def model(self, obj_id: int) -> ObjectModel:
        """An object's mesh in metres; loaded once."""
        if obj_id not in self._loaded:
            path = _meshes(self._models).get(obj_id)
            if path is None:
                wanted = self._models / f"obj_{obj_id:06d}.ply"
                raise MeshError(f"there is no mesh {wanted} for object {obj_id}; there are {self.model_ids()}.")
            self._loaded[obj_id] = self._mesh(path, obj_id)
        return self._loaded[obj_id]

    def measured_model(self, obj_id: int) -> MeasuredModel:
        """What an object's errors are measured with: the mesh in models_eval/ where there is one, as BOP does."""
        if obj_id not in self._measured:
            fine = _meshes(self.root / "models_eval").get(obj_id)
            info = (self._models if fine is None else fine.parent) / "models_info.json"
            model = self.model(obj_id) if fine is None else self._mesh(fine, obj_id)
            self._measured[obj_id] = MeasuredModel(model, _diameter(info, obj_id, model))
        return self._measured[obj_id]

    def _mesh(self, path: Path, obj_id: int) -> ObjectModel:
        if self._units != "auto":
            return ObjectModel.load(path, units=self._units)
        return _mesh(path, _stated(path.parent / "models_info.json", obj_id))

    def scenes(self) -> list[int]:
        """The scenes' numbers."""
        folders = (self.root / self.split).iterdir()
        return sorted(int(path.name) for path in folders if path.is_dir() and path.name.isdigit())

    def images(self, scene: int | None = None) -> list[tuple[int, int]]:
        """(scene, image) of all photographs, or of one scene's, in order: the targets', where there are targets."""
        scenes = self.scenes() if scene is None else [scene]
        if self.targets is not None:
            return sorted({(t.scene, t.image) for t in self.targets if t.scene in scenes})
        return [(s, image) for s in scenes for image in sorted(self._scene(s).cameras)]

    @cached_property
    def targets(self) -> list[Target] | None:
        """The targets file's entries; None without one."""
        if self._targets_file is None:
            return None
        try:
            entries = _json(self._targets_file)
            if entries and not any("obj_id" in entry for entry in entries):
                return self._all_of(entries)
            return [Target(*(int(e[k]) for k in ("scene_id", "im_id", "obj_id", "inst_count"))) for e in entries]
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise InputError(
                f"{self._targets_file} is no list of targets with scene_id, im_id, obj_id and inst_count: {error!r}."
            ) from error

    def _all_of(self, entries: list[Any]) -> list[Target]:
        """The targets of BOP'24's lists, which name pictures alone: all annotated objects in them."""
        targets = []
        for scene, image in sorted({(int(e["scene_id"]), int(e["im_id"])) for e in entries}):
            counts = Counter(int(truth["obj_id"]) for truth in self._scene(scene).truths.get(image, ()))
            targets += [Target(scene, image, obj_id, count) for obj_id, count in sorted(counts.items())]
        return targets

    # --- what is in a photograph ---

    def view(self, scene: int, image: int) -> View:
        """A photograph with its own camera."""
        pixels = load_image(self.image_path(scene, image))
        return View(pixels, self.camera(scene, image, (pixels.shape[1], pixels.shape[0])))

    def image_path(self, scene: int, image: int) -> Path:
        """Where a photograph lies. Raises InputError where it is missing."""
        folder, ending = self._scene(scene).folder, self._scene(scene).ending
        names = list(dict.fromkeys((f"{image:06d}", str(image), f"{image:04d}", f"{image:05d}")))
        candidates = [folder / (kind + ending) / (n + s) for n in names for kind in ("rgb", "gray") for s in _SUFFIXES]
        found = next((path for path in candidates if path.is_file()), None)
        if found is None:
            raise InputError(
                f"there is no photograph {candidates[0]}: image {image} of scene {scene} is not in this copy."
            )
        return found

    def picture_size(self, scene: int, image: int) -> tuple[int, int]:
        """A photograph's (width, height), from its header."""
        return picture_size(self.image_path(scene, image))

    def depth(self, scene: int, image: int) -> NDArray[np.float32] | None:
        """The sensor's depth (H, W), metres, 0 where it saw nothing; None where the data set has none."""
        here = self._scene(scene)
        candidates = [here.folder / f"depth{here.ending}" / f"{image:06d}{suffix}" for suffix in (".png", ".tif")]
        path = next((candidate for candidate in candidates if candidate.is_file()), None)
        if path is None:
            return None
        raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if raw is None or raw.ndim != 2:
            raise ImageError(f"the depth image {path} is damaged or has several channels: copy it again.")
        try:
            scale = float(here.cameras.get(image, {}).get("depth_scale", 1.0))
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(f"{here.file('scene_camera')}, image {image}: its depth_scale is no number.") from error
        return np.asarray(raw, dtype=np.float32) * np.float32(scale / 1000.0)

    def camera(self, scene: int, image: int, size: tuple[int, int]) -> Camera:
        """A photograph's camera; size: (width, height). Raises CameraError."""
        here = self._scene(scene)
        if image not in here.cameras:
            raise CameraError(f"{here.file('scene_camera')} has no camera for image {image}.")
        label = f"{here.file('scene_camera')}, image {image}"
        found = calibration_of_entry(here.cameras[image], size, label)
        if found.lens is not None:
            raise CameraError(
                f"{label}: its picture has lens distortion, while a data set's masks, boxes and measures are those of "
                "a pinhole camera: undistort the pictures and masks, and leave the distortion out."
            )
        return found.camera

    def instances(self, scene: int, image: int, every: bool = False) -> list[Instance]:
        """The annotated objects in a photograph, in the file's order.

        Where there are targets, only the objects that they name, as many of each as they ask for, the most visible
        ones; with ``every`` all of them.
        """
        here = self._scene(scene)
        if image not in here.truths:
            raise InputError(f"{here.file('scene_gt')} has no annotations for image {image}.")
        truths = here.truths[image]
        if not truths:
            return []
        infos = here.infos.get(image, []) if here.infos is not None else [None] * len(truths)
        if len(infos) != len(truths):
            raise InputError(
                f"{here.file('scene_gt_info')} has {len(infos)} entries for image {image}, scene_gt.json "
                f"{len(truths)}: they belong together. Get both from the same copy of the data set."
            )
        found = [_instance(here, scene, image, k, truths[k], infos[k]) for k in range(len(truths))]
        return found if every or self.targets is None else self._wanted(found)

    def _wanted(self, found: list[Instance]) -> list[Instance]:
        kept: set[int] = set()
        for target in self.targets or ():
            same = [i for i in found if (i.scene, i.image, i.obj_id) == (target.scene, target.image, target.obj_id)]
            same.sort(key=lambda i: -i.visib_fract)
            kept.update(i.index for i in same[: target.count])
        return [i for i in found if i.index in kept]

    def _scene(self, scene: int) -> _Scene:
        if scene not in self._scenes:
            split = self.root / self.split
            folder = next((p for p in sorted(split.iterdir()) if _number(p.name) == scene and p.is_dir()), None)
            if folder is None:
                raise InputError(f"there is no scene {split / f'{scene:06d}'}; there are {self.scenes()}.")
            self._scenes[scene] = _Scene(folder, self.sensor)
        return self._scenes[scene]

    def _find_targets(self, targets: str | None) -> Path | None:
        if targets is None:
            return None
        if targets != "auto":
            path = self.root / targets
            if not path.is_file():
                raise InputError(f"there is no targets file {path}: check its name, or pass targets=None.")
            return path
        found = sorted(self.root.glob(f"{self.split}_targets_*.json"))
        return next((path for path in found if path.stem.endswith("bop19")), found[0] if found else None)


class _Scene:
    """A scene's files, each read when it is first needed. sensor: of several, whose files end in its name.

    Raises InputError where there are several and none is chosen.
    """

    def __init__(self, folder: Path, sensor: str | None = None) -> None:
        self.folder = folder
        there = sorted(path.stem[len("scene_camera_") :] for path in folder.glob("scene_camera_*.json"))
        if sensor is None and len(there) > 1 and not (folder / "scene_camera.json").is_file():
            raise InputError(
                f"{folder} has the pictures of the sensors {', '.join(there)}: choose one, as --split "
                f"{folder.parent.name}:{there[0]}."
            )
        if sensor is not None and sensor not in there:
            raise InputError(f"{folder} has no sensor {sensor!r}; there are {', '.join(there) or 'none with names'}.")
        alone = there[0] if there and not (folder / "scene_camera.json").is_file() else None
        self.ending = f"_{sensor or alone}" if sensor or alone else ""

    def file(self, name: str) -> Path:
        return self.folder / f"{name}{self.ending}.json"

    @cached_property
    def cameras(self) -> dict[int, Any]:
        return self._numbered("scene_camera", dict)

    @cached_property
    def truths(self) -> dict[int, Any]:
        found = self._numbered("scene_gt", list)
        _check_millimetres(self.file("scene_gt"), found)
        return found

    @cached_property
    def infos(self) -> dict[int, Any] | None:
        return self._numbered("scene_gt_info", list) if self.file("scene_gt_info").exists() else None

    def _numbered(self, name: str, kind: type) -> dict[int, Any]:
        path = self.file(name)
        data = _json(path)
        if not isinstance(data, dict) or not all(_number(key) is not None for key in data):
            raise InputError(f"{path} does not map image numbers to entries, as BOP's files do.")
        wrong = next((key for key, value in data.items() if not isinstance(value, kind)), None)
        if wrong is not None:
            raise InputError(f"{path}, image {wrong}: its entry is no {_JSON_KINDS[kind]}, as BOP's files have there.")
        return {int(key): value for key, value in data.items()}


def _check_millimetres(path: Path, truths: Mapping[int, Any]) -> None:
    """Raises InputError where all objects would be within a centimetre of the camera: metres were written."""
    try:
        far = [math.hypot(*map(float, truth["cam_t_m2c"])) for entries in truths.values() for truth in entries]
    except (KeyError, TypeError, ValueError, OverflowError):
        return  # reported where the entry is read
    if far and max(far) < _NEAREST_MM:
        raise InputError(
            f"{path}: cam_t_m2c is in mm, and its objects would be at most {max(far):.3g} mm from the camera: it seems "
            "to be in metres; multiply it by 1000."
        )


def _instance(
    scene: _Scene, scene_id: int, image: int, index: int, truth: Mapping[str, Any], info: Mapping[str, Any] | None
) -> Instance:
    try:
        return Instance(
            scene=scene_id,
            image=image,
            index=index,
            obj_id=int(truth["obj_id"]),
            T_cam_obj=pose_from_bop(truth["cam_R_m2c"], truth["cam_t_m2c"]),
            box_obj=None if info is None else _box(info["bbox_obj"]),
            box_visib=None if info is None else _box(info["bbox_visib"]),
            visib_fract=math.nan if info is None else float(info["visib_fract"]),
            mask_path=scene.folder / f"mask_visib{scene.ending}" / f"{image:06d}_{index:06d}.png",
        )
    except (KeyError, ValueError, TypeError, OverflowError) as error:
        raise InputError(f"annotation {index} of image {image} in {scene.folder} is not BOP's: {error!r}.") from error


def _box(xywh: Any) -> Box | None:
    """BOP's (x, y, w, h) as edges; None for its (-1, -1, -1, -1).

    Its w and h are the differences of the last and the first pixel (BOP toolkit's calc_2d_bbox): one short of a width.
    """
    x, y, w, h = (float(v) for v in xywh)
    return (x, y, x + w + 1, y + h + 1) if w >= 0 and h >= 0 else None


def _stated(info: Path, obj_id: int) -> float | None:
    """The diameter of models_info.json, in its mm; None without one. Raises InputError where it is no length."""
    every = _json(info) if info.is_file() else {}
    entry = every.get(str(obj_id), {}) if isinstance(every, dict) else None
    if not isinstance(entry, dict):
        raise InputError(f"{info} does not map the objects' numbers to entries, as BOP's models_info.json does.")
    if "diameter" not in entry:
        return None
    try:
        diameter = float(entry["diameter"])
    except (TypeError, ValueError, OverflowError):
        diameter = math.nan
    if not 0 < diameter < math.inf:
        raise InputError(f"{info} gives object {obj_id} the diameter {entry['diameter']!r}: it is a number of mm.")
    return diameter


def _diameter(info: Path, obj_id: int, model: ObjectModel) -> float:
    """Metres, as the data set states it, else measured; measured too, and logged, where it was stated in metres. Raises
    InputError where what is stated is no length."""
    stated = _stated(info, obj_id)
    if stated is not None and _same_diameter(stated, model.diameter):
        log.warning("%s: the diameter %g of object %d is in metres, not in BOP's mm; it is measured.", info, stated,
                    obj_id)  # fmt: skip
        stated = None
    return model.diameter if stated is None else stated / 1000.0


def _same_diameter(a: float, b: float) -> bool:
    """Diameters of one object, measured by two programs."""
    return 0.95 < a / b < 1.05


def _number(name: str) -> int | None:
    """A name of digits as a number, with zeros before it or not."""
    return int(name) if re.fullmatch(r"[0-9]+", name) else None


def _meshes(folder: Path) -> dict[int, Path]:
    """Meshes named obj_000001 and so on, with zeros or not, by number; PLY before the other formats."""
    found: dict[int, Path] = {}
    for suffix in _MESHES:
        for path in sorted(folder.glob(f"obj_*{suffix}")):
            number = _number(path.stem[4:])
            if number is not None:
                found.setdefault(number, path)
    return found


def _mesh(path: Path, stated: float | None) -> ObjectModel:
    """A mesh in BOP's millimetres; in another unit, which is logged, where that alone gives an object or the stated
    diameter (mm, None where nothing states it). Raises MeshError."""
    found: dict[str, ObjectModel] = {}
    for unit in ("mm", "m", "cm", "in"):
        try:
            found[unit] = ObjectModel.load(path, units=unit)
        except MeshError as error:
            if "posekit works" not in str(error):
                raise
            reason = str(error).partition("; posekit works")[0]
        if unit == "mm" and unit in found and (stated is None or _same_diameter(1000 * found[unit].diameter, stated)):
            break  # as it is meant
    fitting = [u for u, m in found.items() if stated is not None and _same_diameter(1000 * m.diameter, stated)]
    chosen = next(iter(fitting or [u for u in ("mm", "m") if u in found]), None)
    if chosen is None:
        raise MeshError(
            f"{reason}. The meshes of a data set in BOP layout are in mm: scale it, or give their units (--units of "
            "posekit eval, units= of BopDataset)."
        )
    model = found[chosen]
    inside = 1000 * model.diameter
    if chosen != "mm":
        log.warning("%s: BOP's meshes are in mm, which would make it %.3g mm long; it is taken for %s, %.4g mm long.",
                    path.name, inside / (1000 * UNITS[chosen]), _UNIT_NAMES[chosen], inside)  # fmt: skip
    elif stated is not None and not fitting and not _same_diameter(model.diameter, stated):
        log.warning("%s: it is %.4g mm long, and models_info.json says %.4g: measures use the latter.", path.name,
                    inside, stated)  # fmt: skip
    elif stated is None and inside < _DOUBTFUL_MM:
        log.warning("%s: it is %.3g mm long, as BOP's meshes are in mm; where it is in another unit, give it "
                    "(--units of posekit eval, units= of BopDataset).",
                    path.name, inside)  # fmt: skip
    return model


def _json(path: Path) -> Any:
    try:
        return json.loads(read_text(path))
    except FileNotFoundError as error:
        raise InputError(f"there is no file {path}: this copy of the data set is not complete.") from error
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} cannot be read: {error}.") from error

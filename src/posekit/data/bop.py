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
import PIL.Image
from numpy.typing import NDArray

from posekit.camera import Box, Camera
from posekit.errors import CameraError, ImageError, InputError, MeshError
from posekit.geometry import Pose
from posekit.load import load_image, load_mask, pose_from_bop
from posekit.object_model import ObjectModel
from posekit.view import View

_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
_MESHES = (".ply", ".obj", ".glb", ".gltf", ".stl")

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

    split: the folder with scenes. targets: a test's list of images and objects, by default the first
    ``SPLIT_targets_*.json`` (bop19 before others) in the folder; where there is one, `images` and `instances` keep
    to it. Pass ``targets=None`` to see everything. Raises InputError where the layout is not there.
    """

    def __init__(
        self, root: str | Path, split: str = "test", targets: str | None = "auto", models: str = "models"
    ) -> None:
        self.root, self.split, self.name = Path(root), split, Path(root).resolve().name
        if not (self.root / split).is_dir():
            raise InputError(
                f"{self.root} has no folder {split!r}: a data set in BOP layout has models/ and {split}/000001/ and so "
                "on. Check the path and the split."
            )
        self._models = self.root / models
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
            self._loaded[obj_id] = _mesh(path)
        return self._loaded[obj_id]

    def measured_model(self, obj_id: int) -> MeasuredModel:
        """What an object's errors are measured with: the mesh in models_eval/ where there is one, as BOP does."""
        if obj_id not in self._measured:
            fine = _meshes(self.root / "models_eval").get(obj_id)
            model = self.model(obj_id) if fine is None else _mesh(fine)
            folder = self._models if fine is None else fine.parent
            self._measured[obj_id] = MeasuredModel(model, _diameter(folder / "models_info.json", obj_id, model))
        return self._measured[obj_id]

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
        except (KeyError, TypeError, ValueError, AttributeError) as error:
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
        folder = self._scene(scene).folder
        names = list(dict.fromkeys((f"{image:06d}", str(image), f"{image:04d}", f"{image:05d}")))
        candidates = [folder / kind / (n + s) for n in names for kind in ("rgb", "gray") for s in _SUFFIXES]
        found = next((path for path in candidates if path.is_file()), None)
        if found is None:
            raise InputError(
                f"there is no photograph {candidates[0]}: image {image} of scene {scene} is not in this copy."
            )
        return found

    def picture_size(self, scene: int, image: int) -> tuple[int, int]:
        """A photograph's (width, height), from its header."""
        path = self.image_path(scene, image)
        try:
            with PIL.Image.open(path) as picture:
                return picture.size
        except OSError as error:
            raise ImageError(f"the picture {path} is damaged ({error}): make or copy it again.") from error

    def depth(self, scene: int, image: int) -> NDArray[np.float32] | None:
        """The sensor's depth (H, W), metres, 0 where it saw nothing; None where the data set has none."""
        here = self._scene(scene)
        candidates = [here.folder / "depth" / f"{image:06d}{suffix}" for suffix in (".png", ".tif")]
        path = next((candidate for candidate in candidates if candidate.is_file()), None)
        if path is None:
            return None
        raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if raw is None or raw.ndim != 2:
            raise ImageError(f"the depth image {path} is damaged or has several channels: copy it again.")
        scale = float(here.cameras.get(image, {}).get("depth_scale", 1.0))
        return np.asarray(raw, dtype=np.float32) * np.float32(scale / 1000.0)

    def camera(self, scene: int, image: int, size: tuple[int, int]) -> Camera:
        """A photograph's camera; size: (width, height). Raises CameraError."""
        here = self._scene(scene)
        if image not in here.cameras:
            raise CameraError(f"{here.folder}/scene_camera.json has no camera for image {image}.")
        return Camera.from_K(here.cameras[image]["cam_K"], *size)

    def instances(self, scene: int, image: int, every: bool = False) -> list[Instance]:
        """The annotated objects in a photograph, in the file's order.

        Where there are targets, only the objects that they name, as many of each as they ask for, the most visible
        ones; with ``every`` all of them.
        """
        here = self._scene(scene)
        if image not in here.truths:
            raise InputError(f"{here.folder}/scene_gt.json has no annotations for image {image}.")
        truths = here.truths[image]
        infos = here.infos.get(image, []) if here.infos is not None else [None] * len(truths)
        if len(infos) != len(truths):
            raise InputError(
                f"{here.folder}/scene_gt_info.json has {len(infos)} entries for image {image}, scene_gt.json "
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
            self._scenes[scene] = _Scene(folder)
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
    """A scene's files, each read when it is first needed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @cached_property
    def cameras(self) -> dict[int, Any]:
        return self._numbered("scene_camera.json")

    @cached_property
    def truths(self) -> dict[int, Any]:
        return self._numbered("scene_gt.json")

    @cached_property
    def infos(self) -> dict[int, Any] | None:
        name = "scene_gt_info.json"
        return self._numbered(name) if (self.folder / name).exists() else None

    def _numbered(self, name: str) -> dict[int, Any]:
        data = _json(self.folder / name)
        if not isinstance(data, dict) or not all(key.isdigit() for key in data):
            raise InputError(f"{self.folder / name} does not map image numbers to entries, as BOP's files do.")
        return {int(key): value for key, value in data.items()}


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
            mask_path=scene.folder / "mask_visib" / f"{image:06d}_{index:06d}.png",
        )
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"annotation {index} of image {image} in {scene.folder} is not BOP's: {error!r}.") from error


def _box(xywh: Any) -> Box | None:
    """BOP's (x, y, w, h) as edges; None for its (-1, -1, -1, -1).

    Its w and h are the differences of the last and the first pixel (BOP toolkit's calc_2d_bbox): one short of a width.
    """
    x, y, w, h = (float(v) for v in xywh)
    return (x, y, x + w + 1, y + h + 1) if w >= 0 and h >= 0 else None


def _diameter(info: Path, obj_id: int, model: ObjectModel) -> float:
    """As the data set states it, else measured. Raises InputError where what is stated is no length."""
    entry = _json(info).get(str(obj_id), {}) if info.is_file() else {}
    if "diameter" not in entry:
        return model.diameter
    try:
        diameter = float(entry["diameter"]) / 1000.0
    except (TypeError, ValueError):
        diameter = math.nan
    if not 0 < diameter < math.inf:
        raise InputError(f"{info} gives object {obj_id} the diameter {entry['diameter']!r}: it is a number of mm.")
    return diameter


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


def _mesh(path: Path) -> ObjectModel:
    """A mesh in BOP's millimetres; in metres where it could not be an object otherwise, which is told."""
    try:
        return ObjectModel.load(path, units="mm")
    except MeshError as error:
        model = _in_metres(path)
        if model is None:
            reason = str(error).partition("; posekit works")[0]
            raise MeshError(f"{reason}. The meshes of a data set in BOP layout are in mm: scale it.") from error
    log.warning("%s: BOP's meshes are in mm, which would make it %.3g mm long; it is taken for metres.", path.name,
                model.diameter)  # fmt: skip
    return model


def _in_metres(path: Path) -> ObjectModel | None:
    try:
        return ObjectModel.load(path, units="m")
    except MeshError:
        return None


def _json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise InputError(f"there is no file {path}: this copy of the data set is not complete.") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read: {error}.") from error

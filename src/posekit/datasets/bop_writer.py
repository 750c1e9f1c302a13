"""Data sets in BOP layout, written: the counterpart of ``bop``. Metres become millimetres here.

An image's files are written first and its record last, each whole or not at all; the records become the scenes' JSON
files in `BopWriter.finish`. So a writing that was killed goes on with the images that have no record, several
processes may write at once, and a finished data set does not tell how many there were.
"""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Box, Camera, mask_box
from posekit.errors import InputError, OutputError
from posekit.geometry import Pose
from posekit.io.files import write_bytes_atomic, write_text_atomic
from posekit.mesh.model import ObjectModel
from posekit.mesh.symmetries import Symmetries

DEPTH_SCALE = 0.1  # mm in one unit of a depth picture: 6.5 m at most
VISIBLE = 0.1  # what BOP asks for is seen at least to this part
RECORDS = ".records"

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Annotation:
    """An object in a picture.

    T_cam_obj: metres. mask, mask_visib: bool (H, W), its silhouette as if nothing stood before it, and what is seen.
    pixels, box: of the whole silhouette, outside the picture too; by default the mask's.
    """

    obj_id: int
    T_cam_obj: Pose
    mask: Mask
    mask_visib: Mask
    pixels: int | None = None
    box: Box | None = None


@dataclass(frozen=True, eq=False)
class Picture:
    """What is written of an image. image: uint8 RGB (H, W, 3). depth: float32 (H, W), metres along z, 0 = unknown.
    T_cam_world: where the world is, if there is one. masks: further masks (H, W) for each annotation, by the name of
    their folder."""

    image: NDArray[np.uint8]
    camera: Camera
    annotations: Sequence[Annotation]
    depth: NDArray[np.float32] | None = None
    T_cam_world: Pose | None = None
    masks: Mapping[str, Sequence[Mask]] = field(default_factory=dict)


class BopWriter:
    """Writes ``root/split``. quality: of JPEG pictures, in percent; None = PNG."""

    def __init__(self, root: Path, split: str = "train", quality: int | None = 95) -> None:
        self.root, self.folder, self.quality = root, root / split, quality
        self.records = root / RECORDS / split

    # --- images ---

    def write(self, scene: int, image: int, picture: Picture) -> None:
        """One image with all that belongs to it. Raises OutputError where a file cannot be written, InputError where
        arrays do not fit together."""
        _check(picture)
        folder, name = self.folder / f"{scene:06d}", f"{image:06d}"
        files = {f"rgb/{name}.{'png' if self.quality is None else 'jpg'}": _rgb(picture.image, self.quality)}
        if picture.depth is not None:
            files[f"depth/{name}.png"] = _png(_depth(picture.depth))
        for k, seen in enumerate(picture.annotations):
            files[f"mask/{name}_{k:06d}.png"] = _png(seen.mask)
            files[f"mask_visib/{name}_{k:06d}.png"] = _png(seen.mask_visib)
        for kind, masks in picture.masks.items():
            files |= {f"{kind}/{name}_{k:06d}.png": _png(mask) for k, mask in enumerate(masks)}
        for place, data in files.items():
            _write(folder / place, data)
        _write(self.records / f"{scene:06d}_{name}.json", json.dumps(_record(picture)).encode())

    def written(self) -> set[tuple[int, int]]:
        """(scene, image) of all images that are whole."""
        names = (re.fullmatch(r"(\d+)_(\d+)", path.stem) for path in self.records.glob("*.json"))
        return {(int(name[1]), int(name[2])) for name in names if name is not None}

    # --- the end ---

    def finish(self, objects: Mapping[int, str], description: str = "") -> None:
        """Write the scenes' JSON files, targets and the camera from the records. objects: names by obj_id."""
        scenes: dict[int, dict[int, Any]] = defaultdict(dict)
        for scene, image in sorted(self.written()):
            path = self.records / f"{scene:06d}_{image:06d}.json"
            scenes[scene][image] = json.loads(path.read_text(encoding="utf-8"))
        if not scenes:
            raise InputError(f"{self.folder} has no images to finish a data set with.")
        for scene, images in scenes.items():
            folder = self.folder / f"{scene:06d}"
            for name, key in (("scene_camera", "camera"), ("scene_gt", "gt"), ("scene_gt_info", "info")):
                _write_text(folder / f"{name}.json", _numbered({n: record[key] for n, record in images.items()}))
            suffix = "png" if self.quality is None else "jpg"
            _write_text(folder / "scene_gt_coco.json", json.dumps(_coco(images, objects, suffix, description)))
        first = next(iter(next(iter(scenes.values())).values()))
        _write_text(self.root / "camera.json", json.dumps(_camera_file(first)))
        _write_text(self.root / f"{self.folder.name}_targets_bop19.json", json.dumps(_targets(scenes)))

    def discard_records(self) -> None:
        """Remove what only a writing that goes on needs."""
        for path in self.records.glob("*.json"):
            path.unlink()
        for folder in (self.records, self.records.parent):
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()


def write_models(root: Path, models: Mapping[int, ObjectModel]) -> None:
    """``models/`` and ``models_eval/`` (without colours): PLY files in mm, and models_info.json."""
    info = {str(obj_id): model_info(model) for obj_id, model in sorted(models.items())}
    for folder, coloured in (("models", True), ("models_eval", False)):
        for obj_id, model in models.items():
            name = f"obj_{obj_id:06d}"
            has_texture = coloured and model.texture is not None
            _write(root / folder / f"{name}.ply", _ply(model, coloured, f"{name}.png" if has_texture else None))
            if has_texture:
                assert model.texture is not None
                _write(root / folder / f"{name}.png", _png(model.texture[..., ::-1]))
        _write_text(root / folder / "models_info.json", json.dumps(info, indent=2))


def model_info(model: ObjectModel) -> dict[str, Any]:
    """An object's entry in models_info.json: diameter, box and symmetries, mm."""
    low, size = 1000 * model.bounds[0], 1000 * model.extents
    entry: dict[str, Any] = {"diameter": 1000 * model.diameter}
    entry |= {f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)}
    entry |= {f"size_{axis}": float(value) for axis, value in zip("xyz", size, strict=True)}
    return entry | symmetries_to_bop(model.symmetries)


def symmetries_to_bop(symmetries: Symmetries) -> dict[str, Any]:
    """The inverse of `Symmetries.from_bop`: mm; nothing where there are none."""
    entry: dict[str, Any] = {}
    if symmetries.discrete:
        entry["symmetries_discrete"] = [_in_mm(pose).ravel().tolist() for pose in symmetries.discrete]
    if symmetries.continuous:
        entry["symmetries_continuous"] = [
            {"axis": c.axis.tolist(), "offset": (1000 * c.offset).tolist()} for c in symmetries.continuous
        ]
    return entry


def mask_to_rle(mask: Mask) -> dict[str, Any]:
    """COCO's run lengths, not compressed: counts down the columns, from a run of zeros on, and size [H, W]."""
    flat = np.concatenate([[False], mask.ravel(order="F"), [False]])
    changes = np.flatnonzero(flat[1:] != flat[:-1])
    counts = np.diff(np.concatenate([[0], changes, [mask.size]] if len(changes) % 2 == 0 else [[0], changes]))
    return {"counts": _trimmed(counts), "size": list(mask.shape)}


def _trimmed(counts: NDArray[np.int64]) -> list[int]:
    values = [int(n) for n in counts]
    return values[:-1] if len(values) > 1 and values[-1] == 0 else values


# --- what stands in the files -----------------------------------------------------------------------------------


def _check(picture: Picture) -> None:
    size = (picture.camera.height, picture.camera.width)
    arrays: list[NDArray[Any]] = [picture.image, *(m for a in picture.annotations for m in (a.mask, a.mask_visib))]
    arrays += [] if picture.depth is None else [picture.depth]
    if any(array.shape[:2] != size for array in arrays):
        raise InputError(f"a picture's arrays have shapes {[a.shape for a in arrays]}, its camera {size}.")
    if any(len(masks) != len(picture.annotations) for masks in picture.masks.values()):
        raise InputError("each kind of mask needs one for every annotation.")


def _record(picture: Picture) -> dict[str, Any]:
    camera: dict[str, Any] = {
        "cam_K": picture.camera.K.ravel().tolist(),
        "depth_scale": DEPTH_SCALE,
        "width": picture.camera.width,
        "height": picture.camera.height,
    }
    if picture.T_cam_world is not None:
        camera |= {"cam_R_w2c": picture.T_cam_world.R.ravel().tolist(),
                   "cam_t_w2c": (1000 * picture.T_cam_world.t).tolist()}  # fmt: skip
    return {
        "camera": camera,
        "gt": [_truth(a) for a in picture.annotations],
        "info": [_info(a, picture.depth) for a in picture.annotations],
        "rle": [mask_to_rle(a.mask_visib) for a in picture.annotations],
    }


def _truth(annotation: Annotation) -> dict[str, Any]:
    pose = annotation.T_cam_obj
    return {"cam_R_m2c": pose.R.ravel().tolist(), "cam_t_m2c": (1000 * pose.t).tolist(), "obj_id": annotation.obj_id}


def _info(annotation: Annotation, depth: NDArray[np.float32] | None) -> dict[str, Any]:
    """BOP's entry in scene_gt_info.json."""
    seen, inside = int(annotation.mask_visib.sum()), int(annotation.mask.sum())
    whole = inside if annotation.pixels is None else annotation.pixels
    return {
        "bbox_obj": _bop_box(annotation.box or mask_box(annotation.mask)),
        "bbox_visib": _bop_box(mask_box(annotation.mask_visib)),
        "px_count_all": whole,
        "px_count_valid": inside if depth is None else int((annotation.mask & (depth > 0)).sum()),
        "px_count_visib": seen,
        "visib_fract": seen / whole if whole else 0.0,
    }


def _bop_box(box: Box | None) -> list[int]:
    """Edges as BOP's (x, y, w, h), where w and h are the last pixel less the first."""
    if box is None:
        return [-1, -1, -1, -1]
    x0, y0, x1, y1 = (round(v) for v in box)
    return [x0, y0, x1 - x0 - 1, y1 - y0 - 1]


def _coco(images: Mapping[int, Any], objects: Mapping[int, str], suffix: str, description: str) -> dict[str, Any]:
    """A scene's visible masks as a COCO data set."""
    pictures: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for image, record in images.items():
        width, height = record["camera"]["width"], record["camera"]["height"]
        pictures.append({"id": image, "file_name": f"rgb/{image:06d}.{suffix}", "width": width, "height": height})
        for truth, info, rle in zip(record["gt"], record["info"], record["rle"], strict=True):
            x, y, w, h = info["bbox_visib"]
            if w >= 0:
                annotations.append({
                    "id": len(annotations) + 1, "image_id": image, "category_id": truth["obj_id"], "iscrowd": 0,
                    "area": info["px_count_visib"], "bbox": [x, y, w + 1, h + 1], "segmentation": rle,
                    "width": width, "height": height, "ignore": info["visib_fract"] < VISIBLE,
                })  # fmt: skip
    categories = [{"id": obj_id, "name": name, "supercategory": "object"} for obj_id, name in sorted(objects.items())]
    return {"info": {"description": description}, "licenses": [], "categories": categories, "images": pictures,
            "annotations": annotations}  # fmt: skip


def _targets(scenes: Mapping[int, Mapping[int, Any]]) -> list[dict[str, int]]:
    """What a test asks for: the objects that are visible enough, counted."""
    targets = []
    for scene, images in scenes.items():
        for image, record in images.items():
            visible = [truth["obj_id"] for truth, info in zip(record["gt"], record["info"], strict=True)
                       if info["visib_fract"] >= VISIBLE]  # fmt: skip
            targets += [{"im_id": image, "inst_count": visible.count(obj_id), "obj_id": obj_id, "scene_id": scene}
                        for obj_id in sorted(set(visible))]  # fmt: skip
    return targets


def _camera_file(record: Mapping[str, Any]) -> dict[str, Any]:
    fx, _, cx, _, fy, cy, *_ = record["camera"]["cam_K"]
    return {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": record["camera"]["width"],
            "height": record["camera"]["height"], "depth_scale": DEPTH_SCALE}  # fmt: skip


def _numbered(entries: Mapping[int, Any]) -> str:
    """A line for each image, as BOP's files have it."""
    lines = ",\n".join(f'  "{number}": {json.dumps(entry)}' for number, entry in entries.items())
    return f"{{\n{lines}\n}}\n"


def _in_mm(pose: Pose) -> NDArray[np.float64]:
    matrix = np.array(pose.matrix)
    matrix[:3, 3] *= 1000
    return matrix


# --- bytes ------------------------------------------------------------------------------------------------------


def _ply(model: ObjectModel, coloured: bool, texture: str | None) -> bytes:
    """A binary PLY file, mm, with normals, and with colours or texture coordinates."""
    columns: list[tuple[str, str, NDArray[Any]]] = []
    for names, values in (("x y z", 1000.0 * model.vertices.astype(np.float64)), ("nx ny nz", model.normals)):
        columns += [(name, "<f4", values[:, k]) for k, name in enumerate(names.split())]
    if texture is not None and model.uvs is not None:
        columns += [(name, "<f4", model.uvs[:, k]) for k, name in enumerate(("texture_u", "texture_v"))]
    elif coloured and model.colors is not None:
        columns += [(name, "u1", model.colors[:, k]) for k, name in enumerate(("red", "green", "blue"))]
    vertices = np.empty(len(model.vertices), dtype=[(name, kind) for name, kind, _ in columns])
    for name, _, values in columns:
        vertices[name] = values
    faces = np.empty(len(model.faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, model.faces
    head = ["ply", "format binary_little_endian 1.0"]
    head += [] if texture is None else [f"comment TextureFile {texture}"]
    head += [f"element vertex {len(vertices)}"]
    head += [f"property {'uchar' if kind == 'u1' else 'float'} {name}" for name, kind, _ in columns]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    return "\n".join(head).encode("ascii") + vertices.tobytes() + faces.tobytes()


def _rgb(image: NDArray[np.uint8], quality: int | None) -> bytes:
    pixels = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    if quality is None:
        return _png(pixels)
    done, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done, "OpenCV encodes every uint8 picture"
    return data.tobytes()


def _png(array: NDArray[Any]) -> bytes:
    """A picture (BGR), depth or mask. The lowest compression: higher ones cost more time than all the rendering."""
    pixels, options = array, [cv2.IMWRITE_PNG_COMPRESSION, 1]
    if array.dtype == np.bool_:
        pixels = array.astype(np.uint8) * np.uint8(255)
    done, data = cv2.imencode(".png", np.ascontiguousarray(pixels), options)
    assert done, "OpenCV encodes every picture of 8 or 16 bits"
    return data.tobytes()


def _depth(depth: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Metres as 16-bit numbers; 0 where unknown or farther than they can say."""
    units = np.rint(depth * (1000 / DEPTH_SCALE))
    return np.where(units < 65536, units, 0).astype(np.uint16)


def _write(path: Path, data: bytes) -> None:
    _folder(path.parent)
    write_bytes_atomic(path, data)


def _write_text(path: Path, text: str) -> None:
    _folder(path.parent)
    write_text_atomic(path, text)


def _folder(path: Path) -> None:
    if not path.is_dir():
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"the folder {path} cannot be made: {error.strerror}.") from error

"""What people hand over: photographs, masks, boxes, cameras, poses. Layer 2."""

from __future__ import annotations

import json
import logging
import math
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps, UnidentifiedImageError

from posekit.camera import Box, Camera
from posekit.errors import CameraError, ImageError, InputError, PromptError
from posekit.geometry import Pose, nearest_rotation
from posekit.view import View

log = logging.getLogger("posekit")

Size = tuple[int, int]

ASSUMED_FOV = math.radians(60.0)  # of the longer side, where nothing says what the camera was
SMALLEST_SIDE = 16
MOST_PIXELS = 100_000_000

_FULL_FRAME_DIAGONAL_MM = math.hypot(36.0, 24.0)
_MATRIX_NAMES = ("camera_matrix", "cam_K", "K", "cameraMatrix", "Camera_Matrix", "intrinsic_matrix")
_DISTORTION_NAMES = ("distortion_coefficients", "dist_coeffs", "distCoeffs", "Distortion_Coefficients", "D")
_SIZE_NAMES = (("width", "height"), ("image_width", "image_height"), ("image_Width", "image_Height"))
_CAMERA_FORMS = (
    "fx,fy,cx,cy in pixels, or a file: BOP's camera.json or scene_camera.json, OpenCV's YAML or XML, "
    "or the 3x3 numbers of K"
)


# --- photographs ------------------------------------------------------------------------------------------------


def load_view(image: str | Path, camera: str | Path | None = None) -> View:
    """A photograph and its camera.

    camera: as `load_camera` takes it; without it the EXIF data's focal length, else a field of view of 60 degrees,
    with a warning. Raises ImageError or CameraError.
    """
    pixels = load_image(image)
    size = (pixels.shape[1], pixels.shape[0])
    if camera is not None:
        return View(pixels, load_camera(camera, size, image))
    found = camera_from_exif(image, size)
    if found is not None:
        log.info("%s: focal length %.0f pixels, from its EXIF data.", Path(image).name, found.fx)
        return View(pixels, found)
    log.warning(
        "%s: its camera is not known, so a field of view of 60 degrees is assumed: distances may be wrong by tens of "
        "percent. Pass --camera fx,fy,cx,cy or a calibration file.",
        Path(image).name,
    )
    return View(pixels, Camera.from_fov(ASSUMED_FOV, *size))


def load_image(path: str | Path) -> NDArray[np.uint8]:
    """A picture as uint8 RGB (H, W, 3), turned upright as its EXIF data says.

    Grey and palette pictures become RGB, 16 bits become 8, transparent parts black.
    Raises ImageError where the file is missing, no picture, damaged, smaller than 16 pixels or over 100 megapixels.
    """
    path = Path(path)
    with _opened(path, "picture", ImageError) as image:
        width, height = image.size
        if min(width, height) < SMALLEST_SIDE:
            raise ImageError(
                f"{path.name} is {width}x{height} pixels: at least {SMALLEST_SIDE}x{SMALLEST_SIDE} are needed. "
                "Give the photograph itself."
            )
        return _rgb(ImageOps.exif_transpose(image), path.name)


def load_mask(path: str | Path, size: Size | None = None, *, allow_empty: bool = False) -> NDArray[np.bool_]:
    """A mask (H, W) from a picture: True where a pixel is not black (and not transparent).

    size: (width, height) that it must have. Raises PromptError where it has another, is no picture, or is empty and
    may not be.
    """
    path = Path(path)
    with _opened(path, "mask", PromptError) as image:
        if size is not None and image.size != size:
            raise PromptError(
                f"the mask {path.name} is {image.width}x{image.height} pixels, the picture {size[0]}x{size[1]}: "
                "a mask has the size of its picture."
            )
        mask = _covered(image)
    if not mask.any() and not allow_empty:
        raise PromptError(f"the mask {path.name} is empty: its pixels must be brighter than 0 where the object is.")
    return mask


@contextmanager
def _opened(path: Path, what: str, kind: type[InputError]) -> Iterator[Image.Image]:
    """A picture that is whole; its header was checked before anything was decoded."""
    if not path.is_file():
        state = "a folder" if path.is_dir() else "not there"
        raise kind(f"the {what} {path} is {state}: check the path.")
    try:
        if path.stat().st_size == 0:
            raise kind(f"the {what} {path} is an empty file: give a picture such as a PNG or JPEG.")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path) as probe:
                if probe.width * probe.height > MOST_PIXELS:
                    raise kind(_too_large(path, f"{probe.width}x{probe.height} pixels"))
                probe.verify()  # for PNG all checksums, which decoding alone does not need
            with Image.open(path) as image:
                image.load()
                yield image
    except UnidentifiedImageError as error:
        raise kind(
            f"the {what} {path} is not a picture that posekit reads: give a PNG, JPEG, TIFF, BMP or WebP."
        ) from error
    except Image.DecompressionBombError as error:
        raise kind(_too_large(path, "far more pixels")) from error
    except (OSError, ValueError, SyntaxError, EOFError, IndexError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise kind(f"the {what} {path} is damaged or cannot be read ({reason}): make or copy it again.") from error


def _too_large(path: Path, given: str) -> str:
    return f"{path.name} has {given}: at most {MOST_PIXELS // 1_000_000} megapixels are read. Scale it down."


def _rgb(image: Image.Image, label: str) -> NDArray[np.uint8]:
    if image.mode.startswith("I"):  # 16 bits, in whatever integers
        values = np.asarray(image).astype(np.int64)
        if values.min() < 0 or values.max() > 65535:
            raise ImageError(f"{label} has pixels of more than 16 bits: convert it to an 8-bit picture.")
        return np.repeat(np.rint(values / 257.0).astype(np.uint8)[..., None], 3, axis=2)
    if image.mode == "F":
        raise ImageError(f"{label} has floating-point pixels: convert it to an 8-bit picture.")
    if image.has_transparency_data:
        layers = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", layers.size, (0, 0, 0, 255)), layers)
    return np.array(image.convert("RGB"), dtype=np.uint8)


def _covered(image: Image.Image) -> NDArray[np.bool_]:
    if image.mode in ("1", "L", "F") or image.mode.startswith("I"):
        return np.asarray(image).astype(np.bool_)
    layers = np.asarray(image.convert("RGBA"))
    return np.asarray(layers[..., :3].any(axis=2) & (layers[..., 3] > 0))


def parse_box(text: str, size: Size | None = None) -> Box:
    """``x0,y0,x1,y1``: edges, pixels. A box that lies partly outside the picture is kept as it is.

    size: (width, height) of the picture, where it is known. Raises PromptError where the text is not four numbers,
    or the box is inside out or wholly outside the picture.
    """
    try:
        x0, y0, x1, y1 = (float(part) for part in text.split(","))
    except ValueError as error:
        raise PromptError(f"box {text!r} is not four numbers: give x0,y0,x1,y1 in pixels.") from error
    if not all(map(math.isfinite, (x0, y0, x1, y1))) or x0 >= x1 or y0 >= y1:
        raise PromptError(
            f"box {text} is inside out: give x0,y0,x1,y1 with x0 < x1 and y0 < y1, in pixels (not x,y,width,height)."
        )
    if size is not None and (x1 <= 0 or y1 <= 0 or x0 >= size[0] or y0 >= size[1]):
        raise PromptError(f"box {text} lies outside the picture, which is {size[0]}x{size[1]} pixels.")
    return x0, y0, x1, y1


# --- cameras ----------------------------------------------------------------------------------------------------


def camera_from_exif(path: str | Path, size: Size) -> Camera | None:
    """The camera of a photograph of ``size`` (width, height), upright, from its EXIF focal length; None without one.

    The principal point is the picture's middle. A photograph that was cropped after it was taken gives None.
    """
    try:
        with Image.open(path) as image:
            exif = image.getexif().get_ifd(0x8769)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
    longer, shorter = max(size), min(size)
    taken = sorted((_positive(exif.get(0xA002)), _positive(exif.get(0xA003))))
    if taken[0] and abs(taken[1] / taken[0] - longer / shorter) > 0.02 * longer / shorter:
        log.info("%s: its EXIF focal length is for another shape; it was cropped.", Path(path).name)
        return None
    focal = 0.0
    if equivalent_mm := _positive(exif.get(0xA405)):
        focal = equivalent_mm / _FULL_FRAME_DIAGONAL_MM * math.hypot(*size)  # 35 mm equivalents are of the diagonal
    elif taken[0]:
        per_mm = _positive(exif.get(0xA20E)) / {3: 10.0, 4: 1.0}.get(exif.get(0xA210, 2), 25.4)
        focal = _positive(exif.get(0x920A)) * per_mm * longer / taken[1]
    if not 0.1 * longer < focal < 100 * longer:
        return None
    return Camera(focal, focal, 0.5 * size[0] - 0.5, 0.5 * size[1] - 0.5, *size)


def _positive(value: Any) -> float:
    """A number from EXIF data, 0 where there is none."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if math.isfinite(number) and number > 0 else 0.0


def load_camera(source: str | Path, size: Size, image: str | Path | None = None) -> Camera:
    """The camera of a picture of ``size`` (width, height).

    source: ``fx,fy,cx,cy`` or a file: BOP's ``camera.json`` or ``scene_camera.json`` (the entry of the number in the
    name of ``image``), JSON with a matrix K, OpenCV's YAML or XML (``camera_matrix``, ``K`` or ``cameraMatrix``), or
    K's 3x3 numbers as text. Where a file gives another size of the same shape, the camera is scaled.
    Raises CameraError.
    """
    text = str(source)
    if "," in text and re.fullmatch(r"[-+.,\deEinfa\s]+", text):
        return _on_picture(_four_numbers(text, size), size, "--camera")
    path = Path(source)
    try:
        content = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise CameraError(f"there is no camera file {path}: give {_CAMERA_FORMS}.") from error
    except (OSError, ValueError) as error:
        raise CameraError(f"the camera file {path} cannot be read ({error}): give {_CAMERA_FORMS}.") from error
    try:
        camera = _camera_from_text(content, path, size, image)
    except CameraError as error:
        raise CameraError(f"{path.name}: {error}") from error
    except (ValueError, TypeError, KeyError, AttributeError, cv2.error, SystemError) as error:  # the last is OpenCV's
        raise CameraError(
            f"{path.name} holds no camera that posekit understands ({error}): give {_CAMERA_FORMS}."
        ) from error
    return _on_picture(camera, size, path.name)


def _four_numbers(text: str, size: Size) -> Camera:
    try:
        fx, fy, cx, cy = (float(part) for part in text.split(","))
    except ValueError as error:
        raise CameraError(f"camera {text!r} is not four numbers: give {_CAMERA_FORMS}.") from error
    return Camera(fx, fy, cx, cy, *size)


def _camera_from_text(content: str, path: Path, size: Size, image: str | Path | None) -> Camera:
    start = content.lstrip()[:1]
    if start == "{" or (start == "[" and path.suffix.lower() == ".json"):
        return _camera_from_json(json.loads(content), size, image)
    if start in ("%", "<") or path.suffix.lower() in (".yml", ".yaml", ".xml"):
        return _camera_from_opencv(content, size)
    numbers = [float(part) for part in re.split(r"[\s,;\[\]]+", content) if part]
    if len(numbers) == 4:
        fx, fy, cx, cy = numbers
        return Camera(fx, fy, cx, cy, *size)
    return _from_matrix(numbers, size)


def _camera_from_json(data: Any, size: Size, image: str | Path | None) -> Camera:
    if isinstance(data, list):
        return _from_matrix(data, size)
    if not isinstance(data, dict) or not data:
        raise ValueError("it is empty")
    if all(re.fullmatch(r"\d+", key) for key in data):
        return _camera_from_json(_entry_of_image(data, image), size, None)
    own = next(((int(data[w]), int(data[h])) for w, h in _SIZE_NAMES if data.get(w) and data.get(h)), size)
    if all(name in data for name in ("fx", "fy", "cx", "cy")):
        fx, fy, cx, cy = (float(data[name]) for name in ("fx", "fy", "cx", "cy"))
        return Camera(fx, fy, cx, cy, *own)
    name = next((name for name in _MATRIX_NAMES if name in data), None)
    if name is None:
        raise ValueError(f"it has neither fx, fy, cx, cy nor any of {', '.join(_MATRIX_NAMES)}")
    _refuse_distortion(next((data[n] for n in _DISTORTION_NAMES if n in data), []))
    return _from_matrix(_data_of(data[name]), own)


def _entry_of_image(cameras: Mapping[str, Any], image: str | Path | None) -> Any:
    """The entry of a scene_camera.json whose number is in the picture's name (``000003.png``)."""
    digits = re.findall(r"\d+", Path(image).stem) if image is not None else []
    number = int(digits[-1]) if digits else None
    for key, entry in cameras.items():
        if int(key) == number:
            return entry
    some = ", ".join(list(cameras)[:8]) + (", ..." if len(cameras) > 8 else "")
    wanted = f"image {number}" if digits else "a picture without a number in its name"
    raise CameraError(
        f"it has no camera for {wanted}; it has {some}. Name the picture by its number, or pass --camera fx,fy,cx,cy."
    )


def _camera_from_opencv(content: str, size: Size) -> Camera:
    if not content.lstrip().startswith(("%", "<")):
        content = "%YAML:1.0\n---\n" + content  # OpenCV asks for it, ROS leaves it out
    storage = cv2.FileStorage(content, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    try:
        name = next((name for name in _MATRIX_NAMES if not storage.getNode(name).empty()), None)
        if name is None:
            raise ValueError(f"it has none of {', '.join(_MATRIX_NAMES)}")
        distortion = next((storage.getNode(n) for n in _DISTORTION_NAMES if not storage.getNode(n).empty()), None)
        if distortion is not None:
            _refuse_distortion(_numbers_of(distortion))
        own = size
        for w, h in _SIZE_NAMES:
            if not storage.getNode(w).empty() and not storage.getNode(h).empty():
                own = (int(storage.getNode(w).real()), int(storage.getNode(h).real()))
        return _from_matrix(_numbers_of(storage.getNode(name)), own)
    finally:
        storage.release()


def _numbers_of(node: cv2.FileNode) -> list[float]:
    """A matrix's numbers, row by row, from OpenCV's own form or from a map with ``data``."""
    if node.isMap():
        matrix = None if node.getNode("data").empty() or node.getNode("dt").empty() else node.mat()
        if matrix is not None:
            return [float(v) for v in np.ravel(matrix)]
        node = node.getNode("data")
    if node.isSeq():
        return [value for k in range(node.size()) for value in _numbers_of(node.at(k))]
    return [float(node.real())]


def _data_of(value: Any) -> Any:
    return value["data"] if isinstance(value, dict) else value


def _refuse_distortion(coefficients: Any) -> None:
    values = np.asarray(_data_of(coefficients), dtype=np.float64).ravel()
    if np.any(values != 0):
        log.warning(
            "the camera has lens distortion (%s), which posekit does not model: undistort the picture first "
            "(cv2.undistort), or expect errors towards its border.",
            ", ".join(f"{v:g}" for v in values),
        )


def _from_matrix(numbers: Any, size: Size) -> Camera:
    """A camera from K's nine numbers, row by row or 3x3."""
    K = np.asarray(numbers, dtype=np.float64)
    if K.size != 9:
        raise CameraError(f"a camera matrix has 3x3 numbers, not {K.size}.")
    K = K.reshape(3, 3)
    camera = Camera.from_K(K, *size)
    if not np.allclose(K[2], (0, 0, 1)) or abs(K[1, 0]) > 1e-6 or abs(K[0, 1]) > 1e-3 * camera.fx:
        raise CameraError(
            f"the matrix {K.tolist()} is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]: a pinhole camera without skew is "
            "needed."
        )
    return camera


def _on_picture(camera: Camera, size: Size, label: str) -> Camera:
    """The camera for a picture of ``size``, scaled where it was given for another size of the same shape."""
    if camera.size != size:
        sx, sy = size[0] / camera.width, size[1] / camera.height
        if abs(sx / sy - 1) > 0.01:
            raise CameraError(
                f"{label} is for pictures of {camera.width}x{camera.height} pixels, this one has {size[0]}x{size[1]}, "
                "which is another shape: give the camera of this picture (a crop moves the principal point)."
            )
        log.info("%s: scaled from %dx%d to the picture's %dx%d pixels.", label, *camera.size, *size)
        camera = camera.resized(*size)
    if not (0 <= camera.cx < size[0] and 0 <= camera.cy < size[1]):
        log.warning(
            "%s: the principal point (%.0f, %.0f) lies outside the picture of %dx%d pixels; is the camera of another "
            "picture size?",
            label, camera.cx, camera.cy, *size,
        )  # fmt: skip
    return camera


# --- poses ------------------------------------------------------------------------------------------------------


def load_pose(path: str | Path) -> Pose:
    """``T_cam_obj`` (metres) from a JSON file.

    Read are ``{"T_cam_obj": 4x4}`` in metres, a posekit result (its first estimate), and BOP's ``cam_R_m2c`` with
    ``cam_t_m2c`` in mm. Raises PromptError where the file is missing or something else.
    """
    path = Path(path)
    needed = (
        'give {"T_cam_obj": 4x4 in metres}, a result.json of posekit, or BOP\'s {"cam_R_m2c": 9 numbers, '
        '"cam_t_m2c": 3 numbers in mm}.'
    )
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(data, dict) and "estimates" in data:
            if not data["estimates"]:
                raise PromptError(f"the result {path} has no estimates, so there is no pose to start from: {needed}")
            data = data["estimates"][0]
        return _pose_from_dict(data)
    except OSError as error:
        raise PromptError(f"the pose file {path} cannot be read ({error.strerror}): check the path.") from error
    except (ValueError, KeyError, TypeError) as error:
        reason = f"it has no {error.args[0]}" if isinstance(error, KeyError) else str(error)
        raise PromptError(f"{path} holds no pose ({reason}): {needed}") from error


def _pose_from_dict(data: Any) -> Pose:
    if not isinstance(data, dict):
        raise ValueError("its outermost part is not {...}")
    if "T_cam_obj" in data:
        return Pose.from_matrix(data["T_cam_obj"])
    return pose_from_bop(data["cam_R_m2c"], data["cam_t_m2c"])


def pose_from_bop(cam_R_m2c: Sequence[float], cam_t_m2c: Sequence[float]) -> Pose:
    """``T_cam_obj`` in metres from BOP's nine numbers, row by row, and three in mm. Raises ValueError.

    LM-O's rotations of the driller are too large by 0.2 %: they are brought back to the nearest rotation.
    """
    R = np.asarray(cam_R_m2c, dtype=np.float64).reshape(3, 3)
    t = np.asarray(cam_t_m2c, dtype=np.float64).reshape(3) / 1000.0
    if not np.isfinite([*R.ravel(), *t]).all() or np.abs(R @ R.T - np.eye(3)).max() > 0.02 or np.linalg.det(R) < 0:
        raise ValueError("cam_R_m2c is not a rotation, or cam_t_m2c not finite")
    return Pose(nearest_rotation(R), t)

"""Input from people: photographs, masks, boxes, cameras, poses."""

from __future__ import annotations

import io
import json
import logging
import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from posekit.camera import Box, Camera
from posekit.errors import ImageError, InputError, PromptError
from posekit.geometry import Pose, nearest_rotation
from posekit.io.calibration import Calibration, load_calibration
from posekit.io.files import other_content, read_text
from posekit.io.limits import limit
from posekit.io.pixels import deep_colour, eight_bit, upright
from posekit.io.pose_formats import pose_from_mapping, pose_from_text
from posekit.results import check_schema
from posekit.view import View

log = logging.getLogger("posekit")

Size = tuple[int, int]

ASSUMED_FOV = math.radians(60.0)  # of the longer side, where nothing says what the camera was
SMALLEST_SIDE = 16
FAR = 50.0  # metres: a given pose beyond them is probably in other units
_BLOCK = 16  # rows of pixels that a JPEG codes together, of which the last decoded ones may be a part
_MOST_LOST = 0.05  # of a JPEG's rows that may be missing at its end

_FULL_FRAME_DIAGONAL_MM = math.hypot(36.0, 24.0)


# --- photographs ------------------------------------------------------------------------------------------------


def load_view(image: str | Path, camera: str | Path | None = None) -> View:
    """A photograph and its camera.

    camera: as `load_calibration` takes it; without it the EXIF data's focal length, else a field of view of 60 degrees,
    with a warning. Where the camera has lens distortion, the view is the undistorted photograph with the undistorted
    camera, and its ``lens`` moves boxes and masks of the photograph there. Raises ImageError or CameraError.
    """
    pixels = load_image(image)
    found = calibration_of(image, (pixels.shape[1], pixels.shape[0]), camera)
    valid = None if found.lens is None else found.lens.valid
    return View(found.undistorted(pixels), found.ideal, lens=found.lens, valid=valid)


def calibration_of(image: str | Path, size: Size, camera: str | Path | None = None) -> Calibration:
    """The camera of a photograph of ``size`` (width, height), as `load_view` finds it. Raises CameraError."""
    if camera is not None:
        return load_calibration(camera, size, image)
    found = camera_from_exif(image, size)
    if found is not None:
        log.info("%s: focal length %.0f pixels, from its EXIF data.", Path(image).name, found.fx)
        return Calibration(found)
    log.warning(
        "%s: its camera is not known, so a field of view of 60 degrees is assumed: distances may be wrong by tens of "
        "percent. Give fx,fy,cx,cy or a calibration file (--camera, camera= in Python).",
        Path(image).name,
    )
    return Calibration(Camera.from_fov(ASSUMED_FOV, *size))


def load_image(path: str | Path) -> NDArray[np.uint8]:
    """A picture as uint8 RGB (H, W, 3), turned upright as its EXIF data says.

    Grey and palette pictures become RGB, transparent parts black. 16 bits become 8 by the range that is used: 10 or 12
    bits in a file of 16 are recognised by their largest value, which is logged. Damaged EXIF data do not stop a good
    picture. Raises ImageError where the file is missing, no picture, damaged, smaller than 16 pixels or over 100
    megapixels (POSEKIT_MOST_PIXELS). A JPEG that lacks a few of its last rows alone is read, which is logged.
    """
    path = Path(path)
    with _opened(path, "picture", ImageError) as image:
        width, height = image.size
        if min(width, height) < SMALLEST_SIDE:
            raise ImageError(
                f"{path.name} is {width}x{height} pixels: at least {SMALLEST_SIDE}x{SMALLEST_SIDE} are needed. "
                "Give the photograph itself."
            )
        with suppress(Exception):  # Pillow counts by reading, and stumbles over what is damaged behind the first one
            if image.format == "TIFF" and (pictures := getattr(image, "n_frames", 1)) > 1:
                log.warning(
                    "%s holds %d pictures: the first one, %dx%d pixels, is read.", path.name, pictures, width, height
                )
                image.seek(0)
        deep = deep_colour(path.read_bytes())
        if deep is not None:
            shallow = Image.fromarray(eight_bit(deep, path.name))
            shallow.getexif().update(_exif(image))
            return np.array(upright(shallow, path.name), dtype=np.uint8)
        return _rgb(upright(image, path.name), path.name)


def picture_size(path: Path) -> Size:
    """A picture's (width, height), from its header. Raises ImageError where it is damaged."""
    try:
        with Image.open(path) as picture:
            return picture.size
    except OSError as error:
        raise ImageError(f"the picture {path} is damaged ({error}): make or copy it again.") from error


def load_mask(path: str | Path, size: Size | None = None, *, allow_empty: bool = False) -> NDArray[np.bool_]:
    """A mask (H, W) from a picture: True where a pixel is brighter than half of the brightest (and not transparent).

    A pixel's brightness is its brightest channel. Values in between, as JPEG makes them, are logged; a picture of a few
    small numbers is one of labels, and refused. size: (width, height) that it must have. Raises PromptError where it
    has another, is no picture, or is empty and may not be.
    """
    path = Path(path)
    with _opened(path, "mask", PromptError) as image:
        image = upright(image, path.name)
        if size is not None and image.size != size:
            raise PromptError(
                f"the mask {path.name} is {image.width}x{image.height} pixels, the picture {size[0]}x{size[1]}: "
                "a mask has the size of its picture."
            )
        mask = _covered(_brightness(image), path.name)
        _refuse_labels(image, mask, path.name)
    if not mask.any() and not allow_empty:
        raise PromptError(f"the mask {path.name} is empty: its pixels must be brighter than 0 where the object is.")
    if mask[[0, 0, -1, -1], [0, -1, 0, -1]].all() and mask.mean() > 0.5:
        log.warning(
            "the mask %s covers %.0f %% of the picture and all its corners: is it inverted? White is the object.",
            path.name, 100 * mask.mean(),
        )  # fmt: skip
    return mask


_MOST_LABELS, _SAME_HUE = 64, 0.97
_GREY_SHARE, _COLOUR_SHARE = 0.2, 0.01  # of the mask, that an area of another value or colour has
_PHONES = " Phones save HEIC; they and most viewers export it as JPEG."
_RAW = " A camera's raw file must be developed first: export it as JPEG or PNG."
_WAY_OUT = dict.fromkeys((".heic", ".heif", ".hif"), _PHONES) | dict.fromkeys(
    (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"), _RAW
)


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
            warnings.simplefilter("ignore")  # of the size, which is checked here, and of metadata
            with Image.open(path) as probe:
                if probe.width * probe.height > limit("POSEKIT_MOST_PIXELS"):
                    raise kind(_too_large(path, f"{probe.width}x{probe.height} pixels"))
                probe.verify()  # for PNG all checksums, which decoding alone does not need
            with Image.open(path) as image:
                try:
                    image.load()
                    whole: Image.Image = image
                except OSError as error:
                    whole = _cut_short(path, image, error)
                yield whole
    except UnidentifiedImageError as error:
        if (content := other_content(path.read_bytes())) is not None:
            raise kind(f"the {what} {path} {content}.") from error
        raise kind(
            f"the {what} {path} is not a picture that posekit reads: give a PNG, JPEG, TIFF, BMP or WebP."
            f"{_WAY_OUT.get(path.suffix.lower(), '')}"
        ) from error
    except Image.DecompressionBombError as error:
        raise kind(_too_large(path, "far more pixels")) from error
    except (OSError, ValueError, SyntaxError, EOFError, IndexError, TypeError, OverflowError, KeyError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise kind(f"the {what} {path} is damaged or cannot be read ({reason}): make or copy it again.") from error


def _cut_short(path: Path, image: Image.Image, error: OSError) -> Image.Image:
    """A baseline JPEG whose file ends a little early, as OpenCV reads it, which is logged. Raises the given error
    for other pictures, and OSError where more than a few rows are missing."""
    if image.format not in ("JPEG", "MPO") or image.info.get("progressive"):
        raise error
    found = Image.open(io.BytesIO(path.read_bytes() + b"\xff\xd9"))  # the marker of its end
    found.load()
    values = np.asarray(found.convert("L"), dtype=np.int16)
    filled: NDArray[np.bool_] = np.abs(np.diff(values, axis=1)).max(axis=1) <= 1  # rows of one grey
    lost = int(np.argmin(filled[::-1])) if not filled.all() else len(filled)
    if lost + _BLOCK > _MOST_LOST * len(filled):
        raise OSError(f"it is cut off: of {len(filled)} rows the last {lost + _BLOCK} or so are missing")
    log.warning("%s: the file is cut off at its end: its last rows of pixels may be grey. Copy it again.", path.name)
    return found


def _too_large(path: Path, given: str) -> str:
    most = limit("POSEKIT_MOST_PIXELS") / 1e6
    return f"{path.name} has {given}: at most {most:g} megapixels are read. Scale it down, or set POSEKIT_MOST_PIXELS."


def _exif(image: Image.Image) -> dict[int, Any]:
    try:
        with warnings.catch_warnings(action="ignore"):
            return dict(image.getexif())
    except Exception:  # Pillow's parsers raise many kinds of errors
        return {}


def _rgb(image: Image.Image, label: str) -> NDArray[np.uint8]:
    if image.mode.startswith("I"):  # 16 bits, in whatever integers
        try:
            return np.repeat(eight_bit(np.asarray(image).astype(np.int64), label)[..., None], 3, axis=2)
        except ValueError as error:
            raise ImageError(str(error)) from error
    if image.mode == "F":
        raise ImageError(f"{label} has floating-point pixels: convert it to an 8-bit picture.")
    if image.has_transparency_data:
        layers = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", layers.size, (0, 0, 0, 255)), layers)
    return np.array(image.convert("RGB"), dtype=np.uint8)


def _brightness(image: Image.Image) -> NDArray[np.float64]:
    """The brightest channel (H, W) of a mask, 0 where it is transparent."""
    if image.mode in ("1", "L", "F") or image.mode.startswith("I"):
        return np.asarray(image).astype(np.float64)
    layers = np.asarray(image.convert("RGBA"))
    return np.where(layers[..., 3] > 127, layers[..., :3].max(axis=2), 0).astype(np.float64)


def _covered(brightness: NDArray[np.float64], label: str) -> NDArray[np.bool_]:
    """Above half of the brightest. Raises PromptError for labels."""
    most = float(brightness.max(initial=0))
    if not math.isfinite(most) or most <= 0:
        return np.zeros(brightness.shape, dtype=np.bool_)
    between = (brightness > 0) & (brightness < most)
    if between.any():
        levels = np.unique(brightness[between | (brightness == most)])
        if most <= 50 and np.array_equal(levels, np.rint(levels)):
            raise PromptError(
                f"the mask {label} has the values {', '.join(f'{v:g}' for v in levels[:6])}, as a picture of labels "
                "does: write a mask that is 255 where the one object is, and 0 elsewhere."
            )
        log.warning(
            "the mask %s has values between 0 and %g in %.1f %% of its pixels (JPEG, or smoothed): the object is taken "
            "to be where it is brighter than half. Masks are best saved as PNG with 0 and 255.",
            label, most, 100 * between.mean(),
        )  # fmt: skip
    return np.asarray(brightness > 0.5 * most)


def _refuse_labels(image: Image.Image, mask: NDArray[np.bool_], label: str) -> None:
    """Raises PromptError where what is bright enough has areas of several values or colours: labels of objects."""
    grey = image.mode in ("1", "L", "F") or image.mode.startswith("I")
    values = np.asarray(image if grey else image.convert("RGB"))[mask].reshape(-1, 1 if grey else 3)
    kinds, counts = np.unique(values, axis=0, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    large = kinds[order[counts[order] > (_GREY_SHARE if grey else _COLOUR_SHARE) * len(values)]].astype(float)
    if len(kinds) > _MOST_LABELS or len(large) < 2:
        return
    first = large[0]
    for other in large[1:]:
        if not grey and first @ other > _SAME_HUE * np.linalg.norm(first) * np.linalg.norm(other):
            continue  # a soft edge
        shown = [f"{each[0]:g}" if grey else "#{:02x}{:02x}{:02x}".format(*each.astype(int)) for each in (first, other)]
        raise PromptError(
            f"the mask {label} has areas of {shown[0]} and {shown[1]}, as a picture of labels does: write a mask that "
            "is 255 where the one object is, and 0 elsewhere."
        )


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
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            exif = image.getexif().get_ifd(0x8769)
    except Exception:  # Pillow's parsers raise many kinds of errors, and metadata never stop a good picture
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


# --- poses ------------------------------------------------------------------------------------------------------


def load_pose(path: str | Path) -> Pose:
    """``T_cam_obj`` (metres) from a JSON or text file.

    JSON: ``{"T_cam_obj": 4x4}`` or the 4x4 numbers alone in metres, a posekit result (its first estimate), what
    `posekit.io.pose_formats.pose_from_mapping` reads, and BOP's ``cam_R_m2c`` with ``cam_t_m2c`` in mm. Text: what
    `posekit.io.pose_formats.pose_from_text` reads, a 4x4 matrix or x y z qx qy qz qw, metres. Raises PromptError where
    the file is missing or something else.
    """
    path = Path(path)
    needed = (
        'give {"T_cam_obj": 4x4 in metres}, a result.json of posekit, BOP\'s {"cam_R_m2c": 9 numbers, '
        '"cam_t_m2c": 3 numbers in mm}, or a text file with a 4x4 matrix or x y z qx qy qz qw, in metres.'
    )
    try:
        text = read_text(path)
        pose = _pose_from_json(json.loads(text), path, needed) if "{" in text else pose_from_text(text)
    except OSError as error:
        raise PromptError(f"the pose file {path} cannot be read ({error.strerror}): check the path.") from error
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        reason = f"it has no {error.args[0]}" if isinstance(error, KeyError) else str(error)
        raise PromptError(f"{path} holds no pose ({reason}): {needed}") from error
    if float(np.linalg.norm(pose.t)) > FAR:
        log.warning("%s puts the object %.0f m away: positions are in metres.", path.name, np.linalg.norm(pose.t))
    return pose


def _pose_from_json(data: Any, path: Path, needed: str) -> Pose:
    check_schema(data, str(path))
    if isinstance(data, dict) and "estimates" in data:
        if not data["estimates"]:
            raise PromptError(f"the result {path} has no estimates, so there is no pose to start from: {needed}")
        data = data["estimates"][0]
    if not isinstance(data, dict):
        raise ValueError("its outermost part is not {...}")
    if "T_cam_obj" in data:
        return Pose.from_matrix(data["T_cam_obj"])
    if {"quat_wxyz", "position", "translation", "pose", "transform"} & set(data):
        return pose_from_mapping(data)
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

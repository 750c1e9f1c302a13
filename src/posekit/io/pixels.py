"""Pictures of more than 8 bits as 8, upright."""

from __future__ import annotations

import io
import logging
import struct
import warnings

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps

log = logging.getLogger("posekit")

_FEW = 1e-4  # of the pixels
_JPEG_2000 = (b"\0\0\0\x0cjP  \r\n\x87\n", b"\xff\x4f\xff\x51")
_TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}


def eight_bit(values: NDArray[np.integer], label: str) -> NDArray[np.uint8]:
    """Whole numbers up to 65535 as 8 bits, by the range that is used: 8, 10, 12, 14 or 16 bits; what is taken is
    logged.

    Raises ValueError where a value is negative or larger.
    """
    low, high = int(values.min(initial=0)), int(values.max(initial=0))
    if low < 0 or high > 65535:
        raise ValueError(f"{label} has pixels of more than 16 bits: convert it to an 8-bit picture.")
    used = int(np.quantile(values, 1 - _FEW, method="lower")) if high > 255 else high  # without a few hot pixels
    bits, all_bits = (next(bits for bits in (8, 10, 12, 14, 16) if most < 1 << bits) for most in (used, high))
    if bits < all_bits:
        log.warning(
            "%s: all but a few of its 16-bit pixels go up to %d only, so they are taken for %d bits; if it is really "
            "that dark, convert it to 8 bits yourself.",
            label, used, bits,
        )  # fmt: skip
        values = np.minimum(values, (1 << bits) - 1)
    elif bits < 16:
        log.warning(
            "%s: its 16-bit pixels go up to %d only, so they are taken for %d bits; if it is really that dark, "
            "convert it to 8 bits yourself.",
            label, high, bits,
        )  # fmt: skip
    return np.asarray(np.rint(values * (255.0 / ((1 << bits) - 1))), dtype=np.uint8)


def deep_colour(data: bytes) -> NDArray[np.uint16] | None:
    """A coloured PNG, TIFF or JPEG 2000 of 16 bits a channel as RGB (H, W, 3), not turned, transparent parts black;
    None where the file is something else. Pillow keeps the upper 8 bits alone, which are all black in a picture of 8.
    """
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        deep = len(data) > 26 and data[24] == 16 and data[25] in (2, 4, 6)
    elif data.startswith(_JPEG_2000):
        deep = True  # seen when it is decoded
    else:
        deep = data[:4] in (b"II*\0", b"MM\0*") and 16 in _tiff_depths(data)
    if not deep:
        return None
    flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    values = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if values is None or values.dtype != np.uint16 or values.ndim != 3 or values.shape[2] not in (3, 4):
        return None
    rgb = values[..., 2::-1]
    if values.shape[2] == 4:
        rgb = np.rint(rgb * (values[..., 3:] / 65535.0)).astype(np.uint16)
    return np.ascontiguousarray(rgb)


def _tiff_depths(data: bytes) -> tuple[int, ...]:
    """A TIFF's BitsPerSample where it has several samples; empty where that cannot be read."""
    try:
        with Image.open(io.BytesIO(data)) as image:
            found = getattr(image, "tag_v2", {}).get(258, ())
    except Exception:  # Pillow knows no colours of 16 bits in some TIFFs
        order = "<" if data[:2] == b"II" else ">"
        found = _tiff_tag(data, order, 258)
    return tuple(found) if isinstance(found, tuple) and len(found) >= 3 else ()


def _tiff_tag(data: bytes, order: str, wanted: int) -> tuple[int, ...]:
    try:
        [start] = struct.unpack_from(f"{order}I", data, 4)
        [count] = struct.unpack_from(f"{order}H", data, start)
        for k in range(count):
            tag, kind, number, place = struct.unpack_from(f"{order}HHII", data, start + 2 + 12 * k)
            if tag == wanted and kind == 3 and 3 <= number <= 4:
                return struct.unpack_from(f"{order}{number}H", data, place)
    except struct.error:
        pass
    return ()


def upright(image: Image.Image, label: str) -> Image.Image:
    """A picture turned as its EXIF data says; where they are damaged but say the orientation, by that alone.

    EXIF data behind a second header are no EXIF data: viewers, browsers and OpenCV see none there, Pillow does.
    """
    data = image.info.get("exif")
    if isinstance(data, bytes) and data.startswith(b"Exif\0\0" * 2) and orientation(image) != 1:
        log.warning("%s: its EXIF data are damaged (a second header); the picture is read as it is stored.", label)
        return image
    try:
        with warnings.catch_warnings(action="ignore"):
            return ImageOps.exif_transpose(image)
    except Exception as error:  # Pillow's parsers and writers raise many kinds of errors
        turn = _TURNS.get(orientation(image))
        log.warning(
            "%s: its EXIF data are damaged (%s); the picture is read %s.",
            label, error, "and turned upright" if turn is not None else "as it is stored",
        )  # fmt: skip
        return image if turn is None else image.transpose(turn)


def orientation(image: Image.Image) -> int:
    """EXIF's orientation, 1 to 8; 1 where there is none that can be read."""
    try:
        with warnings.catch_warnings(action="ignore"):
            found = image.getexif().get(ExifTags.Base.Orientation, 1)
    except Exception:  # Pillow's parsers raise many kinds of errors, and metadata never stop a good picture
        return 1
    return found if isinstance(found, int) and 1 <= found <= 8 else 1

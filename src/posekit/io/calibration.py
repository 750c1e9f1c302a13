"""Cameras from files, in the spellings that programs write: K, size, distortion."""

from __future__ import annotations

import json
import logging
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.errors import CameraError
from posekit.lens import Lens

log = logging.getLogger("posekit")

Size = tuple[int, int]

FORMS = (
    "fx,fy,cx,cy in pixels, or a file: BOP's camera.json or scene_camera.json, OpenCV's YAML or XML, "
    "or the 3x3 numbers of K"
)
MOST_BYTES = 20_000_000  # a scene_camera.json of 100 000 pictures is smaller
_MOST_NUMBERS = 1000
_MOST_YAML, _DEEPEST = 300_000, 50  # letters and brackets: its parser takes seconds for more
_SHORTEST = 0.02  # of a side: a focal length for a field of view of 175 degrees
_FAR = 0.12  # of a side, from the middle to the principal point

# Keys are compared in lower case, without anything but letters and digits.
_MATRICES = ("cameramatrix", "camk", "k", "intrinsicmatrix", "intrinsics", "intrinsic", "cameraintrinsics", "mtx",
             "kmatrix", "matrix", "cameraintrinsic", "colork", "rgbk")  # fmt: skip
_FOCAL = (("fx", "flx", "focalx", "focallengthx", "fu"), ("fy", "fly", "focaly", "focallengthy", "fv"))
_POINT = (("cx", "ppx", "principalx", "principalpointx", "u0", "cu"),
          ("cy", "ppy", "principaly", "principalpointy", "v0", "cv"))  # fmt: skip
_PAIRS = (("focallength", "focallengths", "focal", "fc"), ("principalpoint", "opticalcenter", "cc"))  # MATLAB
_WHAT = "(image|img|im|frame|color|colour|rgb|photo|picture|video|capture|camera|cam|stream)"
_WIDTHS = re.compile(
    rf"{_WHAT}?(w|width)(px|pixels|inpixels)?|(res|size|resolution|imagesize|n)(x|w|width|cols)|xres|xresolution|cols|columns"
)
_HEIGHTS = re.compile(
    rf"{_WHAT}?(h|height)(px|pixels|inpixels)?|(res|size|resolution|imagesize|n)(y|h|height|rows)|yres|yresolution|rows"
)
_SIZES = ("resolution", "imagesize", "imgsize", "size", "imagesizes", "imageresolution", "imageshape", "imgshape",
          "shape", "dims", "imagedims", "imagedimensions", "sensorresolution", "calibrationimagesize", "wh", "hw",
          "imagewh", "imagehw", "imgwh", "imghw", "imwh", "imhw", "widthheight", "framesize", "videosize", "imsize",
          "picturesize", "photosize", "capturesize", "colorresolution", "rgbresolution", "cameraresolution", "res",
          "imgresolution", "imres", "sizewh", "sizehw", "dimensions", "imgshape", "imshape")  # fmt: skip
_MODELS = ("distortionmodel", "cameramodel", "model", "distortiontype", "cameratype", "lensmodel", "projection",
           "cammodel")  # fmt: skip
_PINHOLE = ("pinhole", "perspective", "opencv", "fullopencv", "plumbbob", "radtan", "radialtangential", "radtan5",
            "rationalpolynomial", "rational", "brownconrady", "brown", "simplepinhole", "none", "pinholeradtan",
            "frame", "thinprism", "linear", "standard", "")  # fmt: skip
_FISHEYE = ("fisheye", "equidistant", "equi", "kannalabrandt", "kannalabrandt4", "kb4", "opencvfisheye", "kb",
            "kannalabrandt8", "pinholeequi", "pinholeequidistant", "fisheyeopencv")  # fmt: skip
_COEFFICIENT = re.compile(r"(k[1-6]|p[12]|s[1-4]|tau[xy])")
_ONE_BY_ONE = r"([fc][xy]|k[1-6]|p[12]|width|height)"
_PARTS = tuple(
    re.compile(rf"{kind}(distortions?|dist|coef|coefs|coeffs?|coefficients?)?") for kind in ("radial", "tangential")
)
_OTHER_LENSES = {"xi": "the omnidirectional or double-sphere model", "kappa": "the division model"}
_DISTORTION = re.compile(r"d|.*(distort|dist(?!an)|coef|lens).*")


@dataclass(frozen=True)
class Calibration:
    """camera: of a photograph, as it was taken. lens: its distortion, None where there is none."""

    camera: Camera
    lens: Lens | None = None

    @property
    def ideal(self) -> Camera:
        """The camera of the picture without distortion."""
        return self.camera if self.lens is None else self.lens.ideal

    def undistorted(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The photograph (H, W, 3) as `ideal` sees it."""
        return image if self.lens is None else self.lens.undistorted(image)


def load_calibration(source: str | Path, size: Size, image: str | Path | None = None) -> Calibration:
    """The camera and the lens of a picture of ``size`` (width, height).

    source: ``fx,fy,cx,cy`` or a file: BOP's ``camera.json`` or ``scene_camera.json`` (the entry of the number in the
    name of ``image``), JSON, YAML or XML with a matrix K or fx, fy, cx, cy, or K's 3x3 numbers as text. Where a file
    gives another size of the same shape, the camera is scaled. Distortion is OpenCV's, with 4, 5, 8, 12 or 14
    coefficients, or 4 of its fisheye model. Raises CameraError, also where distortion or a size is there and cannot be
    read.
    """
    text = str(source)
    if "," in text and re.fullmatch(r"[-+.,\deEinfa\s]+", text):
        return _on_picture(_four_numbers(text, size), (), "pinhole", size, "the camera fx,fy,cx,cy")
    path = Path(source)
    content = _text(path)
    try:
        data = _parsed(content, path)
        if isinstance(data, Mapping) and _numbered(data):
            data = _entry_of_image(data, image)
        camera, coefficients, model = _understood(data, size)
        return _on_picture(camera, coefficients, model, size, path.name)
    except CameraError as error:
        raise CameraError(str(error) if str(error).startswith(path.name) else f"{path.name}: {error}") from error
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise CameraError(f"{path.name} holds no camera that posekit understands ({reason}): give {FORMS}.") from error


def calibration_of_entry(entry: Any, size: Size, label: str) -> Calibration:
    """The camera and the lens of a picture of ``size`` (width, height) from its entry in a BOP scene_camera.json.

    label: what errors call it. Raises CameraError, also where distortion is there and cannot be read.
    """
    try:
        return _on_picture(*_understood(entry, size), size, label)
    except CameraError as error:
        raise CameraError(f"{label}: {error}") from error
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise CameraError(f"{label} holds no camera ({' '.join(str(error).split())[:200]}).") from error


def depends_on_picture(source: str | Path) -> bool:
    """Whether a camera file has an entry for each picture, as BOP's scene_camera.json does. Raises CameraError."""
    path = Path(source)
    if path.suffix.lower() != ".json" or not path.is_file():
        return False
    try:
        data = json.loads(_text(path))
    except ValueError:
        return False
    return isinstance(data, dict) and _numbered(data)


# --- from text to numbers ---------------------------------------------------------------------------------------


def _text(path: Path) -> str:
    try:
        if path.is_file() and path.stat().st_size > MOST_BYTES:
            raise CameraError(f"the camera file {path} has over {MOST_BYTES // 1_000_000} MB: give {FORMS}.")
        data = path.read_bytes()
        wide = data.startswith((b"\xff\xfe", b"\xfe\xff"))
        return data.decode("utf-16" if wide else "utf-8-sig")
    except FileNotFoundError as error:
        raise CameraError(f"there is no camera file {path}: give {FORMS}.") from error
    except (OSError, ValueError) as error:
        raise CameraError(f"the camera file {path} cannot be read ({error}): give {FORMS}.") from error


_Yaml: Any = type("_Yaml", (yaml.SafeLoader,), {})  # with OpenCV's tags read as what they hold


def _untagged(loader: Any, _: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return loader.construct_scalar(node)


_Yaml.add_multi_constructor("tag:yaml.org,2002:opencv", _untagged)


def _parsed(content: str, path: Path) -> Any:
    """The file as maps, lists and numbers."""
    start, suffix = content.lstrip()[:1], path.suffix.lower()
    if start == "<":
        try:
            return _xml(ElementTree.fromstring(content))
        except ElementTree.ParseError as error:
            raise ValueError(f"it is no XML: {error}") from error
    if start == "{" or (start == "[" and suffix == ".json"):
        return json.loads(content)
    if start == "%" or suffix in (".yml", ".yaml"):
        if len(content) > _MOST_YAML or _depth(content) > _DEEPEST:
            raise ValueError(f"as YAML it is longer than {_MOST_YAML} letters or deeper than {_DEEPEST} brackets")
        content = re.sub(r"\A\s*%YAML.*\n", "", content)  # OpenCV's own form of this line is none of YAML's
        try:
            return yaml.load(content, Loader=_Yaml)
        except yaml.YAMLError as error:
            raise ValueError(f"it is no YAML: {error}") from error
    return [float(part) for part in re.split(r"[\s,;\[\]]+", content) if part]


def _depth(text: str) -> int:
    """How many brackets are open at once, at most."""
    return max(accumulate((letter in "[{") - (letter in "]}") for letter in text if letter in "[]{}"), default=0)


def _xml(element: ElementTree.Element) -> Any:
    children = list(element)
    if children and all(child.tag == "_" for child in children):
        return [_xml(child) for child in children]
    if children:
        return {child.tag: _xml(child) for child in children}
    parts = (element.text or "").split()
    return parts[0] if len(parts) == 1 else parts


def _numbered(data: Mapping[Any, Any]) -> bool:
    return bool(data) and all(re.fullmatch(r"\d+", str(key)) for key in data)


def _entry_of_image(cameras: Mapping[Any, Any], image: str | Path | None) -> Any:
    """The entry of a scene_camera.json whose number is in the picture's name (``000003.png``)."""
    digits = re.findall(r"\d+", Path(image).stem) if image is not None else []
    number = int(digits[-1]) if digits else None
    for key, entry in cameras.items():
        if int(key) == number:
            return entry
    some = ", ".join(map(str, list(cameras)[:8])) + (", ..." if len(cameras) > 8 else "")
    wanted = f"image {number}" if digits else "a picture without a number in its name"
    raise CameraError(
        f"it has no camera for {wanted}; it has {some}. Name the picture by its number, or give its camera as "
        "fx,fy,cx,cy."
    )


# --- what the numbers mean --------------------------------------------------------------------------------------


def _understood(data: Any, size: Size) -> tuple[Camera, tuple[float, ...], str]:
    """The camera in the size that the file gives, else ``size``; distortion coefficients; the lens model."""
    if isinstance(data, list):
        numbers = _numbers(data)
        if len(numbers) == 4:
            return _camera(numbers, size), (), "pinhole"
        return _from_matrix(data, size), (), "pinhole"
    if not isinstance(data, Mapping) or not data:
        raise ValueError("it is empty")
    flat = _flat(data)
    camera = _pinhole(flat, size)
    own = _size(flat, camera)
    if own is not None:
        camera = Camera(camera.fx, camera.fy, camera.cx, camera.cy, *own)
    return camera, *_distortion(flat)


def _key(name: Any) -> str:
    return re.sub(r"[^a-z0-9]", "", str(name).lower())


def _flat(data: Mapping[Any, Any]) -> dict[str, Any]:
    """Maps inside maps made one, by simplified key; matrices with ``data`` become their numbers. Two cameras in a file
    are refused."""
    found: dict[str, Any] = {}
    for key, value in _items(data):
        if key in found and found[key] != value and key in (*_MATRICES, *_FOCAL[0], *_POINT[0]):
            raise CameraError(f"it has several cameras ({key} twice): keep the one of this picture.")
        found.setdefault(key, value)
    return found


def _items(data: Mapping[Any, Any], depth: int = 0) -> Iterator[tuple[str, Any]]:
    for name, value in data.items():
        key = re.sub(rf"^(camera|cam)\d?(?={_ONE_BY_ONE}$)", "", _key(name))  # ORB-SLAM's Camera.fx
        if not isinstance(value, Mapping):
            yield key, value
        elif any(_key(inner) == "data" for inner in value):
            yield key, next(content for inner, content in value.items() if _key(inner) == "data")
        elif depth < 4:
            yield from _items(value, depth + 1)


def _numbers(value: Any) -> list[float]:
    """All numbers in a list of lists, row by row; strings are split. Raises ValueError."""
    found: list[float] = []

    def take(item: Any) -> None:
        if len(found) > _MOST_NUMBERS:
            raise ValueError("it has far too many numbers")
        if isinstance(item, list | tuple):
            for inner in item:
                take(inner)
        elif isinstance(item, str):
            found.extend(float(part) for part in re.split(r"[\s,;\[\]()]+|(?<=\d)x(?=\d)", item) if part)
        else:
            found.append(float(item))

    take(value)
    return found


def _camera(numbers: list[float], size: Size) -> Camera:
    fx, fy, cx, cy = numbers
    return Camera(fx, fy, cx, cy, *size)


def _pinhole(flat: Mapping[str, Any], size: Size) -> Camera:
    spelled = [next((flat[name] for name in names if name in flat), None) for names in (*_FOCAL, *_POINT)]
    if all(value is not None for value in spelled):
        return _camera([float(value) for value in spelled if value is not None], size)
    pairs = [next((flat[name] for name in names if name in flat), None) for names in _PAIRS]
    if all(isinstance(pair, list) and len(pair) == 2 for pair in pairs):
        return _camera([float(value) for pair in pairs if pair is not None for value in pair], size)
    for name in _MATRICES:
        if name in flat:
            if len(numbers := _numbers(flat[name])) == 4 and name != "k":
                return _camera(numbers, size)  # Kalibr's intrinsics
            return _from_matrix(flat[name], size)
    raise ValueError("it has neither fx, fy, cx, cy nor any of camera_matrix, cam_K, K, cameraMatrix, intrinsic_matrix")


def _from_matrix(numbers: Any, size: Size) -> Camera:
    """A camera from K's nine numbers, row by row or column by column (Open3D, MATLAB); 3x4 as ROS's P."""
    values = _numbers(numbers)
    if len(values) == 12 and values[3] == values[7] == values[11] == 0:
        values = [*values[:3], *values[4:7], *values[8:11]]
    if len(values) != 9:
        raise CameraError(f"a camera matrix has 3x3 numbers, not {len(values)}.")
    K = np.array(values).reshape(3, 3)
    if np.allclose(K[:, 2], (0, 0, 1)) and not np.allclose(K[2], (0, 0, 1)):
        K = K.T
    camera = Camera.from_K(K, *size)
    if not np.allclose(K[2], (0, 0, 1)) or abs(K[1, 0]) > 1e-6 or abs(K[0, 1]) > 1e-3 * camera.fx:
        raise CameraError(
            f"the matrix {K.tolist()} is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]: a pinhole camera without skew is "
            "needed."
        )
    return camera


def _size(flat: Mapping[str, Any], camera: Camera) -> Size | None:
    """The picture size that the file is for, (width, height); None where it gives none."""
    width, height = (
        next((flat[name] for name in flat if names.fullmatch(name) and flat[name]), None)
        for names in (_WIDTHS, _HEIGHTS)
    )
    if width is not None and height is not None:
        pair = [float(width), float(height)]
        return _whole(pair, "width and height")
    if width is not None or height is not None:
        raise CameraError("it gives a width or a height of the picture, not both: add the other one.")
    others = [name for name in flat if re.fullmatch(r".*(resolution|imagesize|imgsize|imageshape)", name)]
    for name in dict.fromkeys((*_SIZES, *others)):
        if flat.get(name) is None:
            continue
        values = _numbers(flat[name])
        if len(values) == 1:
            continue  # a scale, or dots per inch
        if len(values) == 3 and values[2] in (1, 3, 4):
            values = values[:2]  # the shape of an array
        w, h = _whole(values, name)
        # programs write [width, height] and [height, width]: the one with the principal point nearer to its middle
        straight = abs(camera.cx / w - 0.5) + abs(camera.cy / h - 0.5)
        turned = abs(camera.cx / h - 0.5) + abs(camera.cy / w - 0.5)
        return (w, h) if straight <= turned else (h, w)
    return None


def _whole(values: list[float], name: str) -> Size:
    if len(values) != 2 or not all(math.isfinite(v) and v >= 1 and v == round(v) for v in values):
        raise CameraError(f"its picture size ({name}: {values}) is not two whole numbers of pixels.")
    return int(values[0]), int(values[1])


def _distortion(flat: Mapping[str, Any]) -> tuple[tuple[float, ...], str]:
    """Coefficients in OpenCV's order, none where all are 0, and "pinhole" or "fisheye". Raises CameraError."""
    for name, model in _OTHER_LENSES.items():
        if flat.get(name) not in (None, 0, "0") and not {"omega", "phi"} <= set(flat):  # kappa beside them is an angle
            raise CameraError(
                f"its lens is of {model} ({name}: {flat[name]!r}), which posekit does not have: calibrate with "
                "OpenCV's pinhole or fisheye model, or undistort the picture yourself and leave the distortion out."
            )
    shapes = (_DISTORTION, *_PARTS)
    named = [name for name in flat if any(shape.fullmatch(name) for shape in shapes) and name not in _MODELS]
    lists: dict[str, list[float]] = {}
    for name in named:
        if flat[name] is None or isinstance(flat[name], bool):
            continue
        try:
            lists[name] = _numbers(flat[name])
        except (TypeError, ValueError) as error:
            if isinstance(flat[name], str) and _key(flat[name]) in (*_PINHOLE, *_FISHEYE):
                continue
            raise CameraError(f"its lens distortion ({name}: {flat[name]!r}) cannot be read: give numbers.") from error
    single = {name: float(flat[name]) for name in flat if _COEFFICIENT.fullmatch(name) and flat[name] is not None}
    lists = {name: values for name, values in lists.items() if any(v != 0 for v in values)}
    fisheye = _is_fisheye(flat, bool(lists) or any(single.values()))
    radial, tangential = ([lists.pop(name) for name in list(lists) if part.fullmatch(name)] for part in _PARTS)
    if radial or tangential:  # as MATLAB has them
        lists["radial and tangential"] = _together(radial, tangential)
    if any(single.values()):
        lists["k1"] = _in_order(single, fisheye)
    kinds = list(lists.values())
    if any(values != kinds[0] for values in kinds[1:]):
        raise CameraError(f"it gives lens distortion twice, differently ({', '.join(lists)}): keep one.")
    return (tuple(kinds[0]) if kinds else ()), ("fisheye" if fisheye else "pinhole")


def _together(radial: list[list[float]], tangential: list[list[float]]) -> list[float]:
    """Coefficients in lists of radial and of tangential ones as OpenCV lists them. Raises CameraError."""
    ks, ps = (found[0] if found else [] for found in (radial, tangential))
    if len(radial) > 1 or len(tangential) > 1 or len(ks) not in (0, 1, 2, 3, 6) or len(ps) not in (0, 2):
        raise CameraError(
            f"its lens distortion is radial {radial} and tangential {tangential}: 3 or 6 numbers and 2 are read."
        )
    ks, ps = ([*ks, 0.0, 0.0, 0.0][: max(3, len(ks))], ps or [0.0, 0.0])
    return [*ks[:2], *ps, *ks[2:]]


def _in_order(single: Mapping[str, float], fisheye: bool) -> list[float]:
    """Coefficients with names of their own as OpenCV lists them."""
    order = ["k1", "k2", "k3", "k4"] if fisheye else ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3",
                                                     "s4", "taux", "tauy"]  # fmt: skip
    unknown = [name for name, value in single.items() if value and name not in order]
    if unknown:
        raise CameraError(f"a fisheye lens has coefficients k1 to k4, not {', '.join(unknown)}.")
    values = [single.get(name, 0.0) for name in order]
    last = max(k for k, value in enumerate(values) if value)
    return values[: next(count for count in (4, 5, 8, 12, 14) if last < count)]


def _is_fisheye(flat: Mapping[str, Any], distorted: bool) -> bool:
    """Whether the file speaks of OpenCV's fisheye. Raises CameraError for models that posekit does not have."""
    flags = ("isfisheye", "fisheye", "fisheyemodel", "usefisheye")  # OpenCV's sample writes fisheye_model
    found = any(str(flat.get(flag)).lower() in ("true", "1", "1.0") for flag in flags)
    for name in _MODELS:
        if not isinstance(flat.get(name), str):
            continue
        model = _key(re.sub(r"^distortion\.", "", flat[name].strip(), flags=re.IGNORECASE))
        found |= model in _FISHEYE
        if model not in (*_PINHOLE, *_FISHEYE) and (distorted or name in ("distortionmodel", "cameramodel")):
            raise CameraError(
                f"its {name} is {flat[name]!r}, which posekit does not have: calibrate with OpenCV's pinhole or "
                "fisheye model, or undistort the picture yourself and leave the distortion out."
            )
    return found


# --- on the picture ---------------------------------------------------------------------------------------------


def _four_numbers(text: str, size: Size) -> Camera:
    try:
        fx, fy, cx, cy = (float(part) for part in text.split(","))
    except ValueError as error:
        raise CameraError(f"camera {text!r} is not four numbers: give {FORMS}.") from error
    return Camera(fx, fy, cx, cy, *size)


def _on_picture(camera: Camera, coefficients: tuple[float, ...], model: str, size: Size, label: str) -> Calibration:
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
    if camera.fx < _SHORTEST * size[0] or camera.fy < _SHORTEST * size[1]:
        raise CameraError(
            f"{label}: the focal length ({camera.fx:g}, {camera.fy:g}) is no number of pixels for a picture of "
            f"{size[0]}x{size[1]}: give fx, fy, cx, cy in pixels, not as shares of the picture or in mm."
        )
    off = max(abs(camera.cx / size[0] - 0.5), abs(camera.cy / size[1] - 0.5))
    if off > _FAR:
        inside = 0 <= camera.cx < size[0] and 0 <= camera.cy < size[1]
        log.warning(
            "%s: the principal point (%.0f, %.0f) lies %s the picture of %dx%d pixels; is the camera of another "
            "picture size? If so, give that size too (width, height), or scale fx, fy, cx, cy.",
            label, camera.cx, camera.cy, "far from the middle of" if inside else "outside", *size,
        )  # fmt: skip
    if not coefficients:
        return Calibration(camera)
    lens = Lens(camera, coefficients, model)
    log.info(
        "%s: the picture is undistorted (%s, %s); poses, overlays and masks belong to the undistorted camera, "
        "fx,fy,cx,cy = %.2f,%.2f,%.2f,%.2f of %dx%d pixels.",
        label, model, ", ".join(f"{v:g}" for v in coefficients), lens.ideal.fx, lens.ideal.fy, lens.ideal.cx,
        lens.ideal.cy, *lens.ideal.size,
    )  # fmt: skip
    return Calibration(camera, lens)

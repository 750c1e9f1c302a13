"""Frames in and out: videos, folders of pictures, BOP scenes, cameras. The only module that imports PyAV."""

from __future__ import annotations

import glob
import json
import logging
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from queue import Empty, Full, Queue
from threading import Event, Thread
from types import TracebackType
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.errors import ImageError, InputError, OutputError
from posekit.io.calibration import Calibration, calibration_of_entry, depends_on_picture, load_calibration
from posekit.io.files import read_text
from posekit.io.load import ASSUMED_FOV, camera_from_exif, load_image

log = logging.getLogger("posekit")

Image = NDArray[np.uint8]
PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
RATE = 30.0  # frames a second, where nothing says how many
AHEAD = 4  # frames
MOST_FAILURES = 100  # frames of a camera or video that may fail one after the other


@dataclass(frozen=True, eq=False)
class Frame:
    """number: in the source, from 0, or the picture's own in a BOP scene. image: uint8 RGB (H, W, 3), None where it
    could not be decoded, and ``problem`` says why. camera: of this frame, where it is known; where it has lens
    distortion, image and camera are the undistorted ones. valid: (H, W), which pixels the frame shows; None = all.
    seconds: since the start, where known. scene: of a BOP scene, else 0. file: the picture's name, where it is one."""

    number: int
    image: Image | None
    camera: Camera | None = None
    valid: NDArray[np.bool_] | None = None
    seconds: float | None = None
    problem: str = ""
    scene: int = 0
    file: str = ""


class Frames(Protocol):
    """Frames one after the other. count: how many there are, where that is known before. rate: frames a second."""

    @property
    def count(self) -> int | None:
        """How many frames there are; None where that is not known before."""

    @property
    def rate(self) -> float:
        """Frames a second."""

    def __iter__(self) -> Iterator[Frame]: ...


def open_frames(source: str, camera: str | Path | None = None) -> Frames:
    """A source of frames by its name.

    source: a video file, a folder of pictures, a glob of them, a BOP scene (a folder with scene_camera.json, or of
    several sensors the file scene_camera_SENSOR.json), or the number of a camera. camera: as `load_calibration` takes
    it; else a BOP scene's own, else a picture's EXIF data, else a field of view of 60 degrees. Pictures come in the
    order of the numbers in their names.
    Raises InputError where there is no such thing or nothing in it, ImageError where a video cannot be opened.
    """
    if source.isdigit() and not Path(source).exists():
        return CameraFrames(int(source), camera)
    path = Path(source)
    if path.is_dir():
        if cameras := sorted(path.glob("scene_camera*.json")):
            return SceneFrames(_only(cameras))
        return PictureFrames(pictures_in(path.iterdir(), source), camera)
    if path.is_file() and re.fullmatch(r"scene_camera(_.+)?\.json", path.name):
        return SceneFrames(path)
    if path.is_file():
        return PictureFrames([path], camera) if path.suffix.lower() in PICTURES else VideoFrames(path, camera)
    if glob.has_magic(source):
        return PictureFrames(pictures_in(map(Path, glob.glob(source)), source), camera)  # noqa: PTH207 - absolute globs
    raise InputError(
        f"there is no {source}: give a video, a folder or glob of pictures, a BOP scene, or a camera's number."
    )


def open_uncalibrated(source: str) -> PictureFrames | VideoFrames:
    """A video file, a picture, a folder of pictures or a glob of them as they were taken: frames have no camera.

    Raises InputError where there is no such thing or nothing in it, ImageError where a video cannot be opened.
    """
    path = Path(source)
    if path.is_file() and path.suffix.lower() not in PICTURES:
        return VideoFrames(path, NO_CAMERA)
    if path.is_file():
        return PictureFrames([path], NO_CAMERA)
    if path.is_dir():
        return PictureFrames(pictures_in(path.iterdir(), source), NO_CAMERA)
    if glob.has_magic(source):
        return PictureFrames(pictures_in(map(Path, glob.glob(source)), source), NO_CAMERA)  # noqa: PTH207
    raise InputError(f"there is no {source}: give pictures, a folder or glob of them, or a video.")


def _only(cameras: list[Path]) -> Path:
    """The file of a scene's cameras. Raises InputError where it is one sensor's of several."""
    plain = [path for path in cameras if path.stem == "scene_camera"]
    if not plain and len(cameras) > 1:
        raise InputError(
            f"{cameras[0].parent} has the pictures of several sensors: give the file of one, {cameras[0]} or "
            f"{', '.join(path.name for path in cameras[1:])}."
        )
    return (plain or cameras)[0]


def pictures_in(paths: Iterable[Path], source: str) -> list[Path]:
    """The pictures among paths, by their suffix, hidden ones left out, in the order of the numbers in their names.
    Raises InputError where there is none. source: what has them, for the message."""
    shown = (path for path in paths if path.suffix.lower() in PICTURES and not path.name.startswith("."))
    found = sorted(shown, key=_natural)
    if not found:
        raise InputError(f"{source} holds no pictures ({', '.join(PICTURES)}).")
    return found


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Numbers in a name count as numbers: frame_2 comes before frame_10."""
    parts = re.split(r"([0-9]+)", path.name.lower())
    return [(int(part), len(part), "") if k % 2 else (-1, 0, part) for k, part in enumerate(parts)]


class _Intrinsics:
    """The camera of each frame: by its size where it is given, of pictures by their EXIF data else; logged once."""

    def __init__(self, camera: str | Path | None) -> None:
        self.given, self.known = camera, dict[tuple[Any, ...], Calibration]()
        self.each = camera is not None and depends_on_picture(camera)
        self.told = False

    def seen(self, image: Image, path: Path | None = None) -> tuple[Image, Camera, NDArray[np.bool_] | None]:
        """The undistorted picture, its camera, and which pixels it shows (None = all).

        Raises CameraError where the given camera does not fit."""
        found = self._of((image.shape[1], image.shape[0]), path)
        return found.undistorted(image), found.ideal, None if found.lens is None else found.lens.valid

    def _of(self, size: tuple[int, int], path: Path | None) -> Calibration:
        if self.given is not None:
            key = (size, path if self.each else None)
            if key not in self.known:
                self.known[key] = load_calibration(self.given, size, path)
            return self.known[key]
        exif = camera_from_exif(path, size) if path is not None else None
        if exif is not None and path is not None:
            if not self.told:
                log.info("%s: focal length %.0f pixels, from its EXIF data.", path.name, exif.fx)
            self.told = True
            return Calibration(exif)
        if (size,) not in self.known:
            self.known[(size,)] = Calibration(Camera.from_fov(ASSUMED_FOV, *size))
            log.warning(
                "the camera is not known, so a field of view of 60 degrees is assumed: distances may be wrong by "
                "tens of percent. Give fx,fy,cx,cy or a calibration file (--camera, camera= in Python)."
            )
        return self.known[(size,)]


class _NoCamera:
    """Frames as they were taken, to calibrate their camera."""

    def seen(self, image: Image, path: Path | None = None) -> tuple[Image, None, None]:  # noqa: ARG002
        return image, None, None


NO_CAMERA = _NoCamera()


def _cameras_of(camera: str | Path | _NoCamera | None) -> _Intrinsics | _NoCamera:
    return camera if isinstance(camera, _NoCamera) else _Intrinsics(camera)


class PictureFrames:
    """Pictures in the order of the numbers in their names."""

    rate = RATE

    def __init__(self, paths: list[Path], camera: str | Path | _NoCamera | None) -> None:
        self.paths, self.count, self._cameras = paths, len(paths), _cameras_of(camera)

    def __iter__(self) -> Iterator[Frame]:
        for number, path in enumerate(self.paths):
            try:
                image, camera, valid = self._cameras.seen(load_image(path), path)
                yield Frame(number, image, camera, valid, number / self.rate, file=path.name)
            except InputError as error:
                yield Frame(number, None, problem=str(error), file=path.name)


class SceneFrames:
    """A BOP scene, with the camera of every picture; frames have the pictures' numbers."""

    rate = RATE

    def __init__(self, file: Path) -> None:
        """file: scene_camera.json, or a sensor's."""
        try:
            cameras = json.loads(read_text(file))
            self.cameras: Mapping[int, Any] = {int(k): v for k, v in sorted(cameras.items(), key=lambda kv: int(kv[0]))}
        except (OSError, ValueError, AttributeError, RecursionError) as error:
            raise InputError(f"{file} cannot be read: {error}.") from error
        self.file, self.folder, self.count = file, file.parent, len(self.cameras)
        self.scene = int(self.folder.name) if re.fullmatch(r"[0-9]+", self.folder.name) else 0
        if not self.count:
            raise InputError(f"{file} names no pictures.")

    def __iter__(self) -> Iterator[Frame]:
        for place, (number, entry) in enumerate(self.cameras.items()):
            try:
                path = self._path(number)
                image = load_image(path)
                label = f"{self.file.name}, image {number}"
                found = calibration_of_entry(entry, (image.shape[1], image.shape[0]), label)
                valid = None if found.lens is None else found.lens.valid
                yield Frame(number, found.undistorted(image), found.ideal, valid, place / self.rate, scene=self.scene,
                            file=path.name)  # fmt: skip
            except InputError as error:
                yield Frame(number, None, problem=str(error), scene=self.scene)

    def _path(self, number: int) -> Path:
        names = dict.fromkeys((f"{number:06d}", str(number)))
        ending = self.file.stem.removeprefix("scene_camera")
        for path in (self.folder / (k + ending) / (n + s) for n in names for k in ("rgb", "gray") for s in PICTURES):
            with suppress(OSError):  # a name that no file can have
                if path.is_file():
                    return path
        raise ImageError(f"the scene {self.folder} has no picture {number:06d} in rgb{ending}.")


class VideoFrames:
    """A video file, by PyAV. What cannot be decoded is reported frame by frame; a truncated file ends early."""

    def __init__(self, path: Path, camera: str | Path | _NoCamera | None) -> None:
        self.path, self._cameras = path, _cameras_of(camera)
        with _opened(path) as container:
            stream = container.streams.video[0]
            self.rate = float(stream.average_rate or RATE)
            self.count: int | None = stream.frames or None

    def __iter__(self) -> Iterator[Frame]:
        import av

        number, failures, start = 0, 0, None
        with _opened(self.path) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            packets = container.demux(stream)
            while failures < MOST_FAILURES:
                try:
                    packet = next(packets)
                    decoded = packet.decode()
                except StopIteration:
                    return
                except (av.FFmpegError, OSError) as error:
                    failures += 1
                    yield Frame(number, None, problem=f"frame {number} of {self.path.name} cannot be decoded: {error}")
                    number += 1
                    continue
                for found in decoded:
                    failures = 0
                    image = _turned(found.to_ndarray(format="rgb24"), found)
                    start = found.time if start is None else start
                    seconds = None if found.time is None or start is None else found.time - start
                    yield self._frame(number, image, seconds)
                    number += 1

    def _frame(self, number: int, image: Image, seconds: float | None) -> Frame:
        try:
            seen, camera, valid = self._cameras.seen(image)
            return Frame(number, seen, camera, valid, seconds)
        except InputError as error:  # the size changed to another shape
            return Frame(number, None, seconds=seconds, problem=f"frame {number}: {error}")


def _turned(image: Image, frame: Any) -> Image:
    """The image as a player shows it, by the display matrix that phones write: turned, mirrored.

    Raises ImageError where it is no quarter turn: no player shows such a video unframed.
    """
    data = next((bytes(d) for d in getattr(frame, "side_data", ()) if d.type.name == "DISPLAYMATRIX"), b"")
    if len(data) < 36:
        return image
    a, b, _, c, d, *_ = np.frombuffer(data, np.int32, 9).astype(np.float64)  # x' = a x + c y, y' = b x + d y
    swapped = abs(b) + abs(c) > abs(a) + abs(d)
    across, down = (c, b) if swapped else (a, d)
    if not 0 < max(abs(a), abs(d), abs(b), abs(c)) * 0.98 <= min(abs(across), abs(down)):
        raise ImageError(
            f"its frames are to be turned by {frame.rotation:g} degrees: write it anew, upright, with ffmpeg."
        )
    shown = image.swapaxes(0, 1) if swapped else image
    return np.ascontiguousarray(shown[:: 1 if down > 0 else -1, :: 1 if across > 0 else -1])


def _opened(path: Path) -> Any:
    """Raises ImageError where a file is no video, or has no frames."""
    try:
        import av
    except ImportError as error:
        raise ImageError("reading videos needs PyAV: pip install av.") from error
    try:
        container = av.open(str(path), metadata_errors="replace")  # a title that is no UTF-8 stops no video
    except (av.FFmpegError, OSError) as error:
        raise ImageError(f"{path} is no video that can be read ({error}): give a video such as an MP4.") from error
    if not container.streams.video:
        container.close()
        raise ImageError(f"{path} has no video in it.")
    return container


class CameraFrames:
    """A camera of this machine, live: reading waits for the next frame and older ones are dropped by the driver."""

    count: int | None = None

    def __init__(self, index: int, camera: str | Path | None) -> None:
        self._cameras, self.label = _Intrinsics(camera), f"camera {index}"
        self.capture = cv2.VideoCapture(index)
        if not self.capture.isOpened():
            raise InputError(f"there is no {self.label}, or another program has it: give a video's path otherwise.")
        self.capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        self.rate = self.capture.get(cv2.CAP_PROP_FPS) or RATE

    def __iter__(self) -> Iterator[Frame]:
        number = failures = 0
        try:
            while failures < MOST_FAILURES:
                ok, bgr = self.capture.read()
                failures = 0 if ok else failures + 1
                if ok:
                    image = np.asarray(bgr[..., ::-1].copy(), np.uint8)
                    yield Frame(number, *self._cameras.seen(image))
                else:
                    yield Frame(number, None, problem=f"{self.label} gave no frame")
                number += 1
        finally:
            self.capture.release()


class ReadAhead:
    """Frames of a source that is read in a thread of its own, a few ahead.

    latest: always the newest one; what comes while another is worked on is dropped. Whoever reads is then at most one
    frame behind a camera, however slow. For cameras; of a file almost all is dropped.
    """

    def __init__(self, source: Frames, latest: bool = False) -> None:
        self.source, self.rate, self.latest = source, source.rate, latest
        self.count = None if latest else source.count

    def __iter__(self) -> Iterator[Frame]:
        waiting: Queue[Frame | BaseException | None] = Queue(1 if self.latest else AHEAD)
        ended = Event()
        arguments = self.source, waiting, ended, self.latest
        Thread(target=_read, args=arguments, name="posekit-frames", daemon=True).start()
        try:
            while (frame := waiting.get()) is not None:
                if isinstance(frame, BaseException):
                    raise frame
                yield frame
        finally:
            ended.set()


def _read(source: Frames, waiting: Queue[Frame | BaseException | None], ended: Event, latest: bool) -> None:
    last: BaseException | None = None
    try:
        for frame in source:
            if latest:
                with suppress(Empty):
                    waiting.get_nowait()
            if not _handed_on(frame, waiting, ended):
                return
    except BaseException as error:  # raised where the frames are read
        last = error
    _handed_on(last, waiting, ended)


def _handed_on(frame: Frame | BaseException | None, waiting: Queue[Frame | BaseException | None], ended: Event) -> bool:
    """False when nobody reads any more."""
    while not ended.is_set():
        with suppress(Full):
            waiting.put(frame, timeout=0.1)
            return True
    return False


class VideoWriter:
    """An MP4 (H.264, 4:2:0) that browsers play, written beside its name and renamed when it is closed.

    Frames of another size than the first are fitted into it. quality: x264's constant rate factor, lower is better.
    Raises OutputError where it cannot be written.
    """

    def __init__(self, path: Path, rate: float, quality: int = 23) -> None:
        try:
            import av
        except ImportError as error:
            raise OutputError("writing a video needs PyAV: pip install av.") from error
        self.path, self.part, self.rate = path, path.with_name(f".{path.stem}.part{path.suffix}"), rate
        self.quality = quality
        self._av = av
        self._container: Any = None
        self._stream: Any = None

    def __enter__(self) -> VideoWriter:
        return self

    def write(self, image: Image) -> None:
        """uint8 RGB (H, W, 3)."""
        if self._stream is None:
            self._begin(image)
        stream, container = self._stream, self._container
        if image.shape[:2] != (stream.height, stream.width):
            image = cv2.resize(image, (stream.width, stream.height), interpolation=cv2.INTER_AREA)
        frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        container.mux(stream.encode(frame))

    def _begin(self, image: Image) -> None:
        height, width = (side - side % 2 for side in image.shape[:2])  # 4:2:0 has even sides
        try:
            self._container = self._av.open(str(self.part), "w", format="mp4", options={"movflags": "+faststart"})
        except OSError as error:
            raise OutputError(f"{self.path} cannot be written: {error}.") from error
        rate = Fraction(self.rate).limit_denominator(1001)
        self._stream = self._container.add_stream("libx264", rate=rate)
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"
        self._stream.options = {"preset": "veryfast", "crf": str(self.quality)}

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if self._container is None:
            return
        self._container.mux(self._stream.encode())
        self._container.close()
        self.part.replace(self.path)  # what was tracked before an interruption is kept

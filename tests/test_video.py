"""Frames in and out: what can be read is, and the rest is told.

Accepted: videos that FFmpeg decodes, turned and mirrored as players do, with titles in any letters; folders and globs
of pictures, in the order of the numbers in their names; a BOP scene or a sensor's scene_camera_SENSOR.json; a camera's
number; a camera for each picture, EXIF data, lens distortion. Told frame by frame: what cannot be decoded, a damaged
picture, a size of another shape; a truncated video ends early. Warned of: a camera that is not known. Refused: what is
not there or is no video, a video without pictures in it, a folder without pictures, several sensors, frames to be
turned by no quarter.
"""

from __future__ import annotations

import json
import struct
import threading
import time
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import PIL.Image
import pytest

from posekit.errors import ImageError, InputError
from posekit.io.video import Frame, ReadAhead, VideoFrames, VideoWriter, open_frames

SIZE = (96, 64)


def picture(k: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Grey level 10 k + 20 on the left half, a fixed colour on the right."""
    image = np.full((size[1], size[0], 3), 10 * k + 20, np.uint8)
    image[:, size[0] // 2 :] = (200, 60, 30)
    return image


def video(path: Path, count: int = 12, rate: float = 30.0) -> Path:
    with VideoWriter(path, rate) as writer:
        for k in range(count):
            writer.write(picture(k))
    return path


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    frames = open_frames(str(video(tmp_path / "a.mp4", rate=25.0)), "100,100,48,32")
    assert isinstance(frames, VideoFrames) and frames.count == 12 and frames.rate == 25.0
    read = list(frames)
    assert [f.number for f in read] == list(range(12))
    for k, frame in enumerate(read):
        assert frame.image is not None and frame.camera is not None and frame.camera.size == SIZE
        assert frame.seconds == pytest.approx(k / 25.0)
        assert abs(int(frame.image[32, 10, 0]) - (10 * k + 20)) < 8 and frame.image[32, 80, 0] > 150
    assert not list(tmp_path.glob(".*"))


def test_a_browser_plays_it(tmp_path: Path) -> None:
    """H.264 in 4:2:0 with the index in front."""
    path = tmp_path / "a.mp4"
    with VideoWriter(path, 30.0) as writer:
        for k in range(3):
            writer.write(picture(k, (97, 65)))  # odd sides
        writer.write(picture(3, (50, 40)))  # another size
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert (stream.width, stream.height, len(list(container.decode(stream)))) == (96, 64, 4)
    data = path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")


def test_a_writer_that_is_interrupted_keeps_its_frames(tmp_path: Path) -> None:
    def write() -> None:
        with VideoWriter(tmp_path / "a.mp4", 30.0) as writer:
            writer.write(picture(0))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write()
    assert len(list(VideoFrames(tmp_path / "a.mp4", None))) == 1


def test_a_truncated_video_gives_what_it_has(tmp_path: Path) -> None:
    whole = tmp_path / "a.ts"
    with av.open(str(whole), "w", format="mpegts") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        for k in range(40):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(k % 20), format="rgb24")))
        container.mux(stream.encode())
    data = whole.read_bytes()
    cut = tmp_path / "cut.ts"
    cut.write_bytes(data[: len(data) // 2])
    read = [f for f in VideoFrames(cut, None) if f.image is not None]
    assert 1 <= len(read) < 40


def test_a_title_that_is_no_text_stops_no_video(tmp_path: Path) -> None:
    path = tmp_path / "a.mkv"
    with av.open(str(path), "w") as container:
        container.metadata["title"] = "TITLE"
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        for k in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(k), format="rgb24")))
        container.mux(stream.encode())
    data = path.read_bytes()
    assert b"TITLE" in data
    path.write_bytes(data.replace(b"TITLE", b"T\x96TLE"))
    assert len([frame for frame in open_frames(str(path), "100,100,48,32") if not frame.problem]) == 3


def test_damaged_frames_do_not_end_a_video(tmp_path: Path) -> None:
    """MJPEG, whose frames stand alone; the fourth is overwritten."""
    path = tmp_path / "a.avi"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg", rate=30)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuvj420p"
        for k in range(8):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(k), format="rgb24")))
        container.mux(stream.encode())
    data = bytearray(path.read_bytes())
    starts = [k for k in range(len(data) - 2) if data[k : k + 3] == b"\xff\xd8\xff"]
    data[starts[3] : starts[4] - 40] = bytes(starts[4] - 40 - starts[3])
    path.write_bytes(bytes(data))
    read = list(VideoFrames(path, None))
    assert sum(f.image is not None for f in read) == 7
    assert [f.number for f in read] == list(range(len(read)))
    assert all("cannot be decoded" in f.problem for f in read if f.image is None)


def test_variable_frame_rate_keeps_its_times(tmp_path: Path) -> None:
    path, times = tmp_path / "a.mp4", [0, 1, 5, 6, 20]
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 30)
        for k, at in enumerate(times):
            frame = av.VideoFrame.from_ndarray(picture(k), format="rgb24")
            frame.pts, frame.time_base = at, Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    assert [f.seconds for f in VideoFrames(path, None)] == pytest.approx([t / 30 for t in times], abs=1e-3)


def test_folders_and_globs_in_the_order_of_names(tmp_path: Path) -> None:
    for k in (2, 0, 1):
        cv2.imwrite(str(tmp_path / f"{k}.png"), picture(k))
    (tmp_path / "notes.txt").write_text("no picture")
    (tmp_path / "._1.png").write_bytes(b"\0\5\x16\7")  # as macOS leaves on other disks
    (tmp_path / "1b.png").write_bytes(b"damaged")
    for source in (str(tmp_path), str(tmp_path / "*.png")):
        read = list(open_frames(source))
        assert [None if f.image is None else int(f.image[0, 0, 0]) for f in read] == [20, 30, None, 40]
        assert "1b.png" in read[2].problem


TURNS = {0: (1, 0, 0, 1), 90: (0, 1, -1, 0), 180: (-1, 0, 0, -1), 270: (0, -1, 1, 0)}


def matrix_written(path: Path, matrix: tuple[int, int, int, int]) -> Path:
    """The video's display matrix, as phones write it."""
    a, b, c, d = matrix
    data = bytearray(path.read_bytes())
    start = data.find(b"tkhd") + 4 + 4 + 4 * 5 + 8 + 8
    values = [a << 16, b << 16, 0, c << 16, d << 16, 0, 0, 0, 0x40000000]
    data[start : start + 36] = struct.pack(">9i", *values)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
def test_frames_are_turned_as_players_do(degrees: int, tmp_path: Path) -> None:
    upright = picture(3)
    upright[:20, :20] = 0
    with VideoWriter(tmp_path / "a.mp4", 30.0) as writer:
        for _ in range(4):
            writer.write(np.ascontiguousarray(np.rot90(upright, degrees // 90)))  # turned back clockwise
    frames = list(open_frames(str(matrix_written(tmp_path / "a.mp4", TURNS[degrees])), "100,100,48,32"))
    assert len(frames) == 4
    for frame in frames:
        assert frame.image is not None, frame.problem
        assert np.abs(frame.image.astype(int) - upright).mean() < 4


@pytest.mark.parametrize(
    ("matrix", "stored"),
    [
        ((-1, 0, 0, 1), lambda image: image[:, ::-1]),
        ((1, 0, 0, -1), lambda image: image[::-1]),
        ((0, 1, 1, 0), lambda image: image.swapaxes(0, 1)),
        ((0, -1, -1, 0), lambda image: image[::-1, ::-1].swapaxes(0, 1)),
    ],
)
def test_mirrored_frames_are_shown_as_players_do(
    matrix: tuple[int, int, int, int], stored: Callable[[np.ndarray], np.ndarray], tmp_path: Path
) -> None:
    upright = picture(3)
    upright[:20, :20] = 0
    with VideoWriter(tmp_path / "a.mp4", 30.0) as writer:
        for _ in range(2):
            writer.write(np.ascontiguousarray(stored(upright)))
    [frame, _] = open_frames(str(matrix_written(tmp_path / "a.mp4", matrix)), "100,100,48,32")
    assert frame.image is not None and np.abs(frame.image.astype(int) - upright).mean() < 4


def test_numbers_in_names_count_as_numbers(tmp_path: Path) -> None:
    names = ["frame_1.png", "frame_2.png", "frame_10.png", "frame_100.png", "take 2_3.png", "take 10_1.png"]
    for k, name in enumerate(sorted(names)):
        cv2.imwrite(str(tmp_path / name), picture(k))
    for source in (str(tmp_path), str(tmp_path / "*.png")):
        assert [frame.file for frame in open_frames(source, "100,100,48,32")] == names


def test_pictures_of_a_folder_have_their_own_camera(tmp_path: Path) -> None:
    """EXIF's, or the entry of a file with one for each."""
    for k, millimetres in enumerate((36, 72)):
        exif = PIL.Image.Exif()
        exif.get_ifd(0x8769).update({0xA405: millimetres})
        PIL.Image.fromarray(picture(k, (600, 400))).save(tmp_path / f"{k}.jpg", exif=exif)
    fx = [frame.camera.fx for frame in open_frames(str(tmp_path)) if frame.camera is not None]
    assert fx == pytest.approx([600, 1200])
    entries = {str(k): {"cam_K": [500 + k, 0, 300, 0, 500, 200, 0, 0, 1]} for k in range(2)}
    (tmp_path / "cameras.json").write_text(json.dumps(entries))
    fx = [f.camera.fx for f in open_frames(str(tmp_path), tmp_path / "cameras.json") if f.camera is not None]
    assert fx == [500, 501]


def test_frames_are_undistorted(tmp_path: Path) -> None:
    lens = {"fx": 100, "fy": 100, "cx": 48, "cy": 32, "distortion_coefficients": [-0.3, 0.1, 0, 0]}
    (tmp_path / "lens.json").write_text(json.dumps(lens))
    for frame in open_frames(str(video(tmp_path / "a.mp4", 2)), tmp_path / "lens.json"):
        assert frame.image is not None and frame.camera is not None
        assert frame.camera.width > SIZE[0] and frame.image.shape[:2] == frame.camera.size[::-1]


def test_a_scene_has_a_camera_for_each_picture(tmp_path: Path) -> None:
    scene = tmp_path / "000007"
    (scene / "rgb").mkdir(parents=True)
    cameras = {}
    for k, f in ((3, 90.0), (10, 120.0)):
        cv2.imwrite(str(scene / "rgb" / f"{k:06d}.png"), picture(k % 5))
        cameras[str(k)] = {"cam_K": [f, 0, 48, 0, f, 32, 0, 0, 1]}
    cameras["11"] = cameras["10"]
    cameras["9" * 300] = cameras["10"]  # longer than any file's name
    (scene / "scene_camera.json").write_text(json.dumps(cameras))
    read = list(open_frames(str(scene)))
    assert [(f.number, f.scene) for f in read[:3]] == [(3, 7), (10, 7), (11, 7)]
    assert [f.camera and f.camera.fx for f in read] == [90.0, 120.0, None, None]
    assert "no picture 000011" in read[2].problem and "no picture 9999" in read[3].problem


def test_what_is_no_source_is_said(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ImageError, match="no video that can be read"):
        open_frames(str(tmp_path / "a.mp4"))
    with pytest.raises(InputError, match="holds no pictures"):
        open_frames(str(tmp_path / "empty"))
    with pytest.raises(InputError, match="there is no"):
        open_frames(str(tmp_path / "nothing.mp4"))
    with pytest.raises(InputError, match="camera 97"):
        open_frames("97")


class Ticking:
    """A camera that gives a frame every 5 ms, whoever reads."""

    count, rate = None, 200.0

    def __iter__(self):  # type: ignore[no-untyped-def]
        for k in range(60):
            time.sleep(0.005)
            yield Frame(k, None)


def test_latest_frames_are_dropped_and_never_late() -> None:
    read = []
    for frame in ReadAhead(Ticking(), latest=True):
        read.append(frame.number)
        time.sleep(0.03)
    assert 2 <= len(read) < 40 and read == sorted(read)


def test_frames_that_are_read_ahead_all_come() -> None:
    frames = ReadAhead(Ticking())
    assert [frame.number for frame in frames] == list(range(60)) and frames.rate == 200.0
    for frame in frames:  # whoever stops reading stops the reading
        if frame.number == 3:
            break
    for _ in range(100):
        if not any(thread.name == "posekit-frames" for thread in threading.enumerate()):
            break
        time.sleep(0.05)
    else:
        raise AssertionError("the thread reads on")


@pytest.mark.parametrize("latest", [True, False])
def test_a_failing_camera_is_told_to_the_reader(latest: bool) -> None:
    class Failing(Ticking):
        def __iter__(self):  # type: ignore[no-untyped-def]
            yield Frame(0, None)
            raise InputError("unplugged")

    with pytest.raises(InputError, match="unplugged"):
        list(ReadAhead(Failing(), latest=latest))

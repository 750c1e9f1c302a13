"""Cameras from boards that are drawn with a known camera and lens; the board's page; every error's text."""

from __future__ import annotations

import json
import re
import struct
from dataclasses import replace
from functools import lru_cache
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from typer.testing import CliRunner, Result

from posekit.camera import Camera
from posekit.cli.app import app
from posekit.errors import CameraError, ConfigError, InputError
from posekit.io.board import Board
from posekit.io.calibrate import BoardView, CalibrationConfig, calibrate, calibrate_views
from posekit.io.calibration import load_calibration
from posekit.io.video import VideoWriter
from posekit.lens import Lens

CAMERA = Camera(610.0, 604.0, 312.0, 247.0, 640, 480)
PINHOLE = Lens(CAMERA, (-0.18, 0.06, 0.001, -0.0008))
FISHEYE = Lens(Camera(330.0, 328.0, 322.0, 236.0, 640, 480), (0.03, -0.01, 0.002, -0.0005), "fisheye")
BOARD = Board()
_SIDE, _FINER = 40, 2  # pixels of a square in the board's picture; how much finer a photograph is drawn

Photo = NDArray[np.uint8]


def poses(count: int, spread: float = 1.0, tilt: float = 0.6) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """T_cam_board as turns and shifts: the board's middle over the whole picture, tilted to all sides by ``tilt``."""
    found = []
    for k in range(count):
        turn = 2 * np.pi * k / count
        R = cv2.Rodrigues(np.array([tilt * np.cos(turn), tilt * np.sin(turn), 0.4 * np.sin(3 * turn)]))[0]
        place = spread * np.array([0.13 * np.cos(2.4 * k), 0.1 * np.sin(2.4 * k), 0.0])
        middle = np.array([0.1225, 0.0875, 0.0])
        found.append((R, place + (0.0, 0.0, 0.42 + 0.08 * (k % 3)) - R @ middle))
    return found


@lru_cache(maxsize=2)
def _rays(lens: Lens) -> NDArray[np.float64]:
    """Of a picture _FINER times as fine, (N, 3) with z = 1."""
    camera = lens.camera
    v, u = np.mgrid[: camera.height * _FINER, : camera.width * _FINER]
    pixels = (np.stack([u, v], axis=-1).reshape(-1, 1, 2) + 0.5) / _FINER - 0.5
    rays = cv2.undistortPoints(pixels, camera.K, np.array(lens.coefficients)).reshape(-1, 2)
    return np.column_stack([rays, np.ones(len(rays))])


def photograph(lens: Lens, R: NDArray[np.float64], t: NDArray[np.float64], board: Board = BOARD) -> Photo:
    """The board on a grey table, seen through a lens: each ray is followed to the board's plane."""
    rays, n = _rays(lens), R[:, 2]
    points = (rays * ((n @ t) / (rays @ n))[:, None] - t) @ R
    place = ((points[:, :2] / (board.square_mm / 1000) + 1) * _SIDE - 0.5).astype(np.float32)
    sheet = np.pad(board.picture(_SIDE), _SIDE, constant_values=255)
    camera = lens.camera
    shape = (camera.height * _FINER, camera.width * _FINER, 2)
    fine = cv2.remap(
        sheet, place.reshape(shape), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=120
    )
    small = cv2.resize(fine, camera.size, interpolation=cv2.INTER_AREA)
    return np.repeat(np.clip(20 + 0.8 * small, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def save(folder: Path, photos: list[Photo]) -> Path:
    folder.mkdir(exist_ok=True)
    for k, photo in enumerate(photos):
        Image.fromarray(photo).save(folder / f"photo_{k}.png")
    return folder


def exact(lens: Lens, placed: list[tuple[NDArray[np.float64], NDArray[np.float64]]], noise: float) -> list[BoardView]:
    """Corners without any picture, with noise in pixels."""
    random, found = np.random.default_rng(0), []
    for k, (R, t) in enumerate(placed):
        pixels = lens.project(BOARD.corners @ R.T + t)
        pixels = pixels + noise * random.standard_normal(pixels.shape)
        found.append(BoardView(f"view {k}", lens.camera.size, np.arange(len(pixels)), pixels))
    return found


@pytest.fixture(scope="module")
def photos() -> list[Photo]:
    return [photograph(PINHOLE, R, t) for R, t in poses(10)]


@pytest.fixture(scope="module")
def folder(photos: list[Photo], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save(tmp_path_factory.mktemp("calibrate") / "photos", photos)


def run(*args: object) -> Result:
    return CliRunner().invoke(app, ["calibrate", *map(str, args)])


def assert_same_camera(camera: Camera, truth: Camera, share: float = 0.01) -> None:
    assert camera.size == truth.size
    assert abs(camera.fx / truth.fx - 1) < share and abs(camera.fy / truth.fy - 1) < share
    assert abs(camera.cx - truth.cx) < share * truth.fx and abs(camera.cy - truth.cy) < share * truth.fx


def assert_same_rays(lens: Lens, truth: Lens, most_px: float) -> None:
    """Points in front of the camera lie at the same pixels, over the picture's middle 90 percent."""
    u, v = np.meshgrid(np.linspace(-0.45, 0.45, 9), np.linspace(-0.45, 0.45, 9))
    points = np.stack([u * truth.camera.width / truth.camera.fx, v * truth.camera.height / truth.camera.fy, 1 + 0 * u])
    points = points.reshape(3, -1).T
    assert np.linalg.norm(lens.project(points) - truth.project(points), axis=1).max() < most_px


# --- the camera -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pattern", ["charuco", "chessboard"])
def test_known_camera_is_found_from_pictures(pattern: str, folder: Path, tmp_path: Path) -> None:
    board = Board.chosen(pattern)  # type: ignore[arg-type]
    if pattern == "chessboard":
        folder = save(tmp_path / "photos", [photograph(PINHOLE, R, t, board) for R, t in poses(10, spread=0.5)])
    found = calibrate([folder], CalibrationConfig(board))
    assert_same_camera(found.camera, CAMERA)
    assert found.rms_px < 0.15 and len(found.errors_px) >= 8
    assert_same_rays(Lens(found.camera, found.coefficients), PINHOLE, 1.5)
    assert found.std_px is not None and abs(found.camera.fx - CAMERA.fx) < 6 * found.std_px[0]


def test_the_camera_file_is_what_every_command_reads(folder: Path, tmp_path: Path) -> None:
    found = calibrate([folder])
    file = tmp_path / "camera.json"
    file.write_text(found.to_json())
    read = load_calibration(file, CAMERA.size)
    assert read.lens == Lens(found.camera, found.coefficients, found.model)
    assert read.camera == found.camera
    half = load_calibration(file, (320, 240)).camera
    assert abs(half.fx - found.camera.fx / 2) < 1e-9
    assert set(json.loads(file.read_text())["calibration"]) == {"rms_px", "used", "board", "covered", "std_px"}


def test_undistorted_with_it_the_board_is_straight(folder: Path, photos: list[Photo], tmp_path: Path) -> None:
    (tmp_path / "camera.json").write_text(calibrate([folder]).to_json())
    calibration = load_calibration(tmp_path / "camera.json", CAMERA.size)
    bent = max(_bend(photo) for photo in photos)
    straight = max(_bend(calibration.undistorted(photo)) for photo in photos)
    assert bent > 0.8 and straight < 0.35


def _bend(image: Photo) -> float:
    """How far the board's corners lie from those of a plane seen without distortion, pixels."""
    found = BOARD.found(image)
    assert not isinstance(found, str)
    corners, pixels = found
    H, _ = cv2.findHomography(BOARD.corners[corners, :2], pixels)
    placed = cv2.perspectiveTransform(BOARD.corners[corners, None, :2], H)[:, 0]
    return float(np.linalg.norm(placed - pixels, axis=1).max())


def test_corners_are_where_the_camera_says() -> None:
    R, t = poses(10)[4]
    found = BOARD.found(photograph(PINHOLE, R, t))
    assert not isinstance(found, str)
    corners, pixels = found
    errors = pixels - PINHOLE.project(BOARD.corners[corners] @ R.T + t)
    assert len(corners) == 24
    assert np.abs(errors.mean(axis=0)).max() < 0.05, "no offset by half a pixel"


def test_corners_of_a_large_chessboard_are_where_they_are() -> None:
    board, side = Board.chosen("chessboard"), 60
    H = np.array([[3.1, 0.4, 150.0], [-0.3, 3.3, 420.0], [1e-4, 2e-4, 1.0]])
    sheet = np.pad(board.picture(side), side, constant_values=255)
    shown = cv2.warpPerspective(sheet, H, (2200, 1700), flags=cv2.INTER_LINEAR, borderValue=120)
    found = board.found(np.repeat(cv2.GaussianBlur(shown, (0, 0), 1.2)[..., None], 3, axis=2))
    assert not isinstance(found, str)
    place = (board.corners[:, :2] / 0.025 + 1) * side - 0.5
    wanted = cv2.perspectiveTransform(place[:, None], H)[:, 0]
    errors = min((found[1] - wanted, found[1][::-1] - wanted), key=lambda off: np.abs(off).max())
    assert np.abs(errors).max() < 0.15 and np.abs(errors.mean(axis=0)).max() < 0.03


def test_fisheye() -> None:
    found = calibrate_views(exact(FISHEYE, _near(poses(24, spread=1.6), 0.15), 0.05), CalibrationConfig(fisheye=True))
    assert found.model == "fisheye" and found.std_px is None
    assert_same_camera(found.camera, FISHEYE.camera)
    assert_same_rays(Lens(found.camera, found.coefficients, "fisheye"), FISHEYE, 1.0)
    assert json.loads(found.to_json())["distortion_model"] == "fisheye"


def _near(
    placed: list[tuple[NDArray[np.float64], NDArray[np.float64]]], metres: float
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    return [(R, t - (0.0, 0.0, metres)) for R, t in placed]


def test_a_third_radial_coefficient_only_where_it_is_known() -> None:
    strong = replace(PINHOLE, coefficients=(-0.3, 0.15, 0.0, 0.0, -0.1))
    assert len(calibrate_views(exact(strong, poses(14, spread=1.5), 0.002)).coefficients) == 5
    assert len(calibrate_views(exact(PINHOLE, poses(10), 0.1)).coefficients) == 4


def test_a_bad_view_is_left_out_with_its_error() -> None:
    views = exact(PINHOLE, poses(12), 0.05)
    views[4] = replace(views[4], pixels=views[4].pixels + np.random.default_rng(1).normal(0, 4, (24, 2)))
    found = calibrate_views(views)
    assert "view 4" not in found.errors_px and len(found.errors_px) == 11
    assert re.match(r"its error is \d\.\d pixels, of most 0\.\d: is it blurred", found.left_out["view 4"])
    assert_same_camera(found.camera, CAMERA)


def test_old_boards_of_even_rows_are_known() -> None:
    board = replace(BOARD, rows=4)
    sheet = board._charuco_board(legacy=True).generateImage((700, 400), marginSize=40)
    for picture in (sheet, np.pad(board.picture(90), 40, constant_values=255)):
        found = board.found(np.repeat(picture[..., None], 3, axis=2))
        assert not isinstance(found, str) and len(found[0]) == 18


# --- a video ----------------------------------------------------------------------------------------------------


def test_of_a_video_sharp_and_different_frames_are_taken(photos: list[Photo], tmp_path: Path) -> None:
    blank = np.full_like(photos[0], 90)
    with VideoWriter(tmp_path / "clip.mp4", 8, quality=10) as writer:
        for photo in [*photos, photos[-1], photos[-1], blank, blank]:
            writer.write(cv2.GaussianBlur(photo, (0, 0), 3))
            writer.write(photo)
    found = calibrate([tmp_path / "clip.mp4"])
    numbers = [int(label.rpartition(" ")[2]) for label in found.errors_px]
    assert all(number % 2 for number in numbers), "the sharp ones are the odd ones"
    assert len(numbers) <= 10 and found.unneeded == 2
    assert found.left_out["clip.mp4"].startswith("2 of 14 frames, most since no marker of the dictionary 5X5_50")
    assert_same_camera(found.camera, CAMERA)


def test_at_most_so_many_views(folder: Path) -> None:
    found = calibrate([folder], CalibrationConfig(most_views=6))
    assert len(found.errors_px) == 6 and found.unneeded == 4
    assert "only 6 pictures are used" in found.warnings[0]


# --- what is told -----------------------------------------------------------------------------------------------


def test_parallel_boards_are_told() -> None:
    found = calibrate_views(exact(PINHOLE, poses(10, tilt=0.12), 0.01))
    assert any("all boards are nearly parallel (within 1" in text for text in found.warnings)


def test_a_focal_length_that_is_not_determined_is_refused() -> None:
    flat = [(np.eye(3), t) for _, t in poses(10, tilt=0.0)]
    with pytest.raises(CameraError, match=r"all boards face the camera \(turned by [0-3] degrees .* the board tilted"):
        calibrate_views(exact(PINHOLE, flat, 0.3))
    with pytest.raises(CameraError, match=r"focal length \(\d+ pixels, give or take \d\d %\): take at least 8"):
        calibrate_views(exact(PINHOLE, flat, 1.0))


def test_little_coverage_is_told() -> None:
    found = calibrate_views(exact(PINHOLE, [(R, t + (0.0, 0.0, 0.6)) for R, t in poses(10, spread=0.2)], 0.02))
    text = next(text for text in found.warnings if "% of the picture" in text)
    assert "none of its corners in the top left" in text and "and bottom right: distortion is a guess" in text


def test_a_large_error_is_told() -> None:
    found = calibrate_views(exact(PINHOLE, poses(16), 1.0))
    assert any("is large: pictures are blurred" in text and "--fisheye" in text for text in found.warnings)


def test_good_views_are_not_warned_of() -> None:
    placed = [(R, t + s) for R, t in poses(8, spread=1.6) for s in ((0.0, 0.0, 0.0), (0.0, 0.05, 0.0))]
    assert calibrate_views(exact(PINHOLE, placed, 0.1)).warnings == ()


def test_the_command(folder: Path, tmp_path: Path) -> None:
    extra = tmp_path / "blank.png"
    Image.new("RGB", (640, 480), (90, 90, 90)).save(extra)
    turned = tmp_path / "turned.png"
    Image.open(folder / "photo_1.png").rotate(90, expand=True).save(turned)
    out = tmp_path / "camera.json"
    result = run(*sorted(folder.iterdir()), extra, turned, "--out", out)
    assert result.exit_code == 0, result.output
    assert re.search(
        r"reprojection error 0\.\d\d pixels \(RMS\), of the worst picture 0\.\d\d \(photo_\d\.png\)", result.output
    )
    assert "10 pictures used\n2 left out:\n    blank.png: no marker of the dictionary 5X5_50 is seen\n" in result.output
    assert (
        "turned.png: it has 480x640 pixels, most have 640x480. Hold the camera the same way for all." in result.output
    )
    assert load_calibration(out, CAMERA.size).lens is not None
    again = run(folder, "--out", out)
    assert again.exit_code == 1 and "is there already: pass --force to replace it" in again.output


# --- errors -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ((), "nothing to calibrate from: give pictures, a folder or a video"),
        (("nowhere",), "there is no nowhere: give pictures, a folder or glob of them, or a video"),
        (("FOLDER", "--board-pdf", "b.pdf"), "--board-pdf writes the board and nothing else"),
        (("FOLDER", "--out", "camera.yml"), "--out camera.yml: name a file that ends in .json"),
        (("FOLDER", "--out", "none/camera.json"), "there is no folder none. Make it first"),
        (("FOLDER", "--squares", "seven"), "squares 'seven': give COLUMNSxROWS, as 7x5"),
        (("FOLDER", "--squares", "2x5"), "a charuco board of 2x5 squares: give from 3 to 100 each way"),
        (("FOLDER", "--pattern", "chessboard", "--squares", "3x9"), "a chessboard board of 3x9 squares: give from 4"),
        (("FOLDER", "--square-mm", "-3"), "squares of -3 mm: give the measured side"),
        (("FOLDER", "--marker-mm", "40"), "markers of 40 mm in squares of 35 mm: a marker is smaller"),
        (("FOLDER", "--dictionary", "9X9_1"), "there is no dictionary 9X9_1: OpenCV has 4X4_50"),
        (("FOLDER", "--squares", "20x20"), "has 200 markers, the dictionary 5X5_50 only 50"),
        (("FOLDER", "--pattern", "chessboard", "--marker-mm", "3"), "a chessboard has no markers"),
        (("FOLDER", "--dictionary", "DICT_4X4_50"), "Some show markers of the dictionary 5X5_50: pass --dict"),
        (("FOLDER/photo_0.png",), "is seen in 1 usable picture, at least 3 are needed. Check --pattern"),
        (("--board-pdf", "board.png"), "--board-pdf board.png: name a file that ends in .pdf"),
        (("--board-pdf", "b.pdf", "--square-mm", "60"), "do not fit on A4 paper: squares of 36.5 mm do"),
    ],
)  # fmt: skip
def test_errors(
    options: tuple[str, ...], text: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run(*(option.replace("FOLDER", str(folder)) for option in options))
    assert result.exit_code == 1
    assert text in result.output
    assert "Traceback" not in result.output and not list(tmp_path.iterdir())


def test_reasons_are_in_the_error(tmp_path: Path) -> None:
    far = photograph(PINHOLE, np.eye(3), np.array([-0.1, -0.1, 6.0]))
    cut = photograph(PINHOLE, np.eye(3), np.array([0.12, 0.06, 0.4]))
    with pytest.raises(InputError, match=r"photo_0.png: no marker .*; photo_1.png: only \d corners .* 8 are needed"):
        calibrate([save(tmp_path / "photos", [far, cut])])
    with pytest.raises(InputError, match=r"photo_0.png: no whole chessboard of 10x7 squares is seen"):
        calibrate([tmp_path / "photos"], CalibrationConfig(Board.chosen("chessboard")))
    with pytest.raises(InputError, match=r"markers are seen, but no corner of a board of 3x9 squares"):
        calibrate([save(tmp_path / "photos", [photograph(PINHOLE, *poses(4)[1])] * 2)],
                  CalibrationConfig(Board(columns=3, rows=9)))  # fmt: skip


def test_a_damaged_picture_is_left_out(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "bad.png").write_bytes(b"no picture")
    found = calibrate([folder, tmp_path / "bad.png"])
    assert "is not a picture that posekit reads" in found.left_out["bad.png"]


# --- the board's page -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("paper", "size_mm"), [("a4", (297.0, 210.0)), ("letter", (279.4, 215.9))])
@pytest.mark.parametrize("pattern", ["charuco", "chessboard"])
def test_the_page_is_true_to_scale(pattern: str, paper: str, size_mm: tuple[float, float], tmp_path: Path) -> None:
    file = tmp_path / "board.pdf"
    result = run("--board-pdf", file, "--paper", paper, "--pattern", pattern)
    assert result.exit_code == 0 and "print it at 100 %" in result.output
    page, page_mm = read_page(file.read_bytes())
    assert np.abs(np.subtract(page_mm, size_mm)).max() < 0.1
    board = Board.chosen(pattern)  # type: ignore[arg-type]
    shrink = 4
    found = board.found(np.asarray(page.convert("RGB").reduce(shrink)))
    assert not isinstance(found, str) and len(found[0]) == len(board.corners)
    corners_mm = (found[1] + 0.5) * shrink * page_mm[0] / page.width
    wanted_mm = 1000 * board.corners[found[0], :2]
    if np.dot(corners_mm[-1] - corners_mm[0], wanted_mm[-1] - wanted_mm[0]) < 0:
        wanted_mm = wanted_mm[::-1]  # half a turn leaves a chessboard as it is
    off = corners_mm - corners_mm.mean(axis=0) - wanted_mm + wanted_mm.mean(axis=0)
    assert np.abs(off).max() < 0.06, "millimetres"
    margin_mm = np.array([corners_mm.min(axis=0), size_mm - corners_mm.max(axis=0)]) - board.square_mm
    assert margin_mm.min() > 5


def test_a_tall_board_lies_on_a_tall_page() -> None:
    _, page_mm = read_page(replace(BOARD, columns=5, rows=7, square_mm=20.0, marker_mm=15.0).page())
    assert page_mm[0] < page_mm[1]


def read_page(pdf: bytes) -> tuple[Image.Image, tuple[float, float]]:
    """The one picture of a PDF, its strip in a TIFF's header, and the page's size in millimetres."""
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", pdf)
    assert box is not None and b"/CCITTFaxDecode" in pdf and b"/BlackIs1 true" in pdf
    drawn = re.search(rb"q ([\d.]+) 0 0 ([\d.]+) 0 0 cm /image Do", pdf)
    assert drawn is not None and np.allclose([float(v) for v in drawn.groups()], [float(v) for v in box.groups()])
    size = [int(re.search(rb"/%b (\d+)" % key, pdf).group(1)) for key in (b"Width", b"Height")]  # type: ignore[union-attr]
    start = pdf.index(b"stream\n", pdf.index(b"/CCITTFaxDecode")) + 7
    data = pdf[start : pdf.index(b"endstream", start)]
    entries = [
        (256, size[0]),
        (257, size[1]),
        (258, 1),
        (259, 4),
        (262, 1),
        (273, 134),
        (278, size[1]),
        (279, len(data)),
    ]
    fields = [struct.pack("<HHII", tag, 4 if value > 65535 else 3, 1, value) for tag, value in entries]
    head = b"II*\0" + struct.pack("<IH", 8, len(entries)) + b"".join(fields)
    page = Image.open(BytesIO(head.ljust(134, b"\0") + data))
    page.load()
    return page, tuple(float(v) / 72 * 25.4 for v in box.groups())  # type: ignore[return-value]


# --- the docs ---------------------------------------------------------------------------------------------------


def test_what_the_docs_say_can_be_run(
    folder: Path, photos: list[Photo], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (Path(__file__).parent.parent / "docs/calibration.md").read_text()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").symlink_to(folder)
    save(tmp_path / "chess", [photograph(PINHOLE, *pose, Board.chosen("chessboard")) for pose in poses(4, spread=0.4)])
    with VideoWriter(tmp_path / "clip.mp4", 4, quality=10) as writer:
        for photo in photos:
            writer.write(photo)
    lines = re.findall(r"^    posekit calibrate (.+)$", text, re.MULTILINE)
    assert len(lines) == 6
    for line in lines:
        assert (result := run(*line.split())).exit_code == 0, result.output
    names = ("board.pdf", "board-letter.pdf", "chessboard.pdf", "camera.json", "phone.json", "chess.json")
    assert all((tmp_path / name).stat().st_size for name in names)
    block = re.search(r"```python\n(.+?)```", text, re.DOTALL)
    assert block is not None
    (tmp_path / "camera.json").unlink()
    exec(block.group(1), {})
    assert load_calibration("camera.json", CAMERA.size).lens is not None


def test_config_errors_are_of_their_kind() -> None:
    with pytest.raises(ConfigError):
        Board.chosen(squares="0x0")

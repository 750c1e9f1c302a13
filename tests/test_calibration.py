"""Cameras in every spelling that is read, lens distortion, and what is refused rather than dropped.

Accepted: fx,fy,cx,cy; BOP's camera.json and scene_camera.json; JSON, YAML (OpenCV's, ROS's, PyYAML's, ORB-SLAM's), XML,
plain numbers; K by rows or columns, numbers as text, focal length and principal point as pairs; the size as width and
height or as a pair in either order; OpenCV's 4, 5, 8, 12, 14 and fisheye coefficients as a list, a matrix, one by one,
or radial and tangential ones apart; byte order marks, UTF-16. Told: a camera that is scaled, lens distortion, a
principal point far from the middle. Refused: skew, another shape of the picture, two cameras in a file, other lens
models (omnidirectional, division), distortion that cannot be read or undone, focal lengths that are no pixels, files
over 20 MB, YAML over 300 000 letters or 50 brackets deep.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from objects import bracket
from posekit.batch.prompts import prompt_for
from posekit.camera import Camera
from posekit.errors import CameraError
from posekit.io.calibration import load_calibration
from posekit.io.load import load_view
from posekit.lens import Lens
from posekit.view import View

FX, FY, CX, CY = 572.4, 573.5, 325.2, 242.0
ROWS = [[FX, 0.0, CX], [0.0, FY, CY], [0.0, 0.0, 1.0]]
BENT = [-0.3, 0.1, 0.001, -0.002, 0.01]
VGA = (640, 480)
NUMBERS = {"fx": FX, "fy": FY, "cx": CX, "cy": CY}


def given(folder: Path, content: Any, name: str = "c.json") -> Path:
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def block(rows: list[list[float]]) -> str:
    return "".join("- " + "\n  ".join(f"- {value}" for value in row) + "\n" for row in rows)


def opencv_file(folder: Path, suffix: str, D: np.ndarray) -> Path:
    path = folder / f"c.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("Camera_Matrix", np.array(ROWS))
    storage.write("Distortion_Coefficients", D)
    storage.release()
    return path


SPELLINGS: dict[str, Callable[[Path], Path]] = {
    "beside fx": lambda d: given(d, NUMBERS | {"distortion_coefficients": BENT}),
    "dist": lambda d: given(d, {"K": ROWS, "dist": [BENT]}),
    "distortion": lambda d: given(d, {"K": ROWS, "distortion": BENT}),
    "coeffs": lambda d: given(d, {"fx": FX, "fy": FY, "ppx": CX, "ppy": CY, "model": "distortion.brown_conrady",
                                  "coeffs": BENT}),
    "one by one": lambda d: given(d, {"fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "w": 640, "h": 480, "k1": -0.3,
                                      "k2": 0.1, "p1": 0.001, "p2": -0.002, "k3": 0.01}),
    "one by one inside": lambda d: given(d, {"intrinsics": NUMBERS, "distortion": dict(zip(("k1", "k2", "p1", "p2",
                                                                                           "k3"), BENT, strict=True))}),
    "MATLAB": lambda d: given(d, {"IntrinsicMatrix": np.transpose(ROWS).tolist(), "ImageSize": [480, 640],
                                  "RadialDistortion": [-0.3, 0.1, 0.01], "TangentialDistortion": [0.001, -0.002]}),
    "ROS": lambda d: given(d, "image_width: 640\nimage_height: 480\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: "
                              f"{np.ravel(ROWS).tolist()}\ndistortion_model: plumb_bob\ndistortion_coefficients:\n"
                              f"  rows: 1\n  cols: 5\n  data: {BENT}\n", "c.yaml"),
    "ROS message": lambda d: given(d, {"height": 480, "width": 640, "distortion_model": "plumb_bob", "D": BENT,
                                       "K": np.ravel(ROWS).tolist(), "R": np.eye(3).ravel().tolist()}),
    "blocks": lambda d: given(d, "camera_matrix:\n" + block(ROWS) + "dist_coeff:\n" + block([BENT]), "c.yaml"),
    "flow": lambda d: given(d, f"camera_matrix: {ROWS}\ndist_coeff: [{BENT}]\n", "c.yaml"),
    "a mark of the byte order": lambda d: given(d, "\ufeff" + json.dumps({"K": ROWS, "D": BENT})),
    "OpenCV's YAML": lambda d: opencv_file(d, "yml", np.array(BENT)),
    "OpenCV's XML": lambda d: opencv_file(d, "xml", np.array([BENT]).T),
    "OpenCV's JSON": lambda d: opencv_file(d, "json", np.array(BENT)),
    "in a camera": lambda d: given(d, {"camera": NUMBERS | {"width": 640, "height": 480, "dist_coeffs": BENT}}),
}  # fmt: skip


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_distortion_in_every_spelling(spelling: str, tmp_path: Path) -> None:
    found = load_calibration(SPELLINGS[spelling](tmp_path), VGA)
    np.testing.assert_allclose(found.camera.K, ROWS)
    assert found.lens is not None and found.lens.model == "pinhole"
    assert found.lens.coefficients == pytest.approx(BENT)


@pytest.mark.parametrize("name", ["distortion_coefficients", "dist", "D", "coeffs", "lens_distortion", "camera_dist"])
def test_distortion_that_cannot_be_read_is_refused(name: str, tmp_path: Path) -> None:
    for value in ("strong", [0.1, "x"], [0.1, 0.2, 0.3], [0.1] * 7, [float("nan")] * 4):
        with pytest.raises(CameraError, match=r"c.json.*(lens distortion|distortion coefficients)"):
            load_calibration(given(tmp_path, NUMBERS | {name: value}), VGA)


def test_other_models_and_contradictions_are_refused(tmp_path: Path) -> None:
    for extra in (
        {"model": "inverse_brown_conrady", "coeffs": [0.1, 0, 0, 0, 0]},
        {"camera_model": "omni"},
        {"distortion_model": "ftheta", "D": [0.1, 0, 0, 0]},
    ):
        with pytest.raises(CameraError, match="which posekit does not have: calibrate with OpenCV's"):
            load_calibration(given(tmp_path, NUMBERS | extra), VGA)
    with pytest.raises(CameraError, match="gives lens distortion twice"):
        load_calibration(given(tmp_path, NUMBERS | {"D": [0.1, 0, 0, 0], "dist": [0.2, 0, 0, 0]}), VGA)
    with pytest.raises(CameraError, match="cannot be undone over a picture of 640x480"):
        load_calibration(given(tmp_path, NUMBERS | {"D": [-3.0, 0, 0, 0]}), VGA)


@pytest.mark.parametrize("extra", [{"D": [0, 0, 0, 0, 0]}, {"distortion": None}, {"distortion_model": "plumb_bob"},
                                   {"dist_coeffs": []}, {"model": "inverse_brown_conrady", "coeffs": [0] * 5},
                                   {"distance": 3, "depth_scale": 0.1, "k1": 0}])  # fmt: skip
def test_no_distortion_is_none(extra: dict[str, Any], tmp_path: Path) -> None:
    assert load_calibration(given(tmp_path, NUMBERS | extra), VGA).lens is None


@pytest.mark.parametrize("model", ["equidistant", "fisheye", "KANNALA_BRANDT4", "OPENCV_FISHEYE"])
def test_fisheye(model: str, tmp_path: Path) -> None:
    found = load_calibration(given(tmp_path, NUMBERS | {"distortion_model": model, "D": [0.05, 0.01, 0, 0]}), VGA)
    assert found.lens is not None and found.lens.model == "fisheye"
    kalibr = f"cam0:\n  camera_model: pinhole\n  distortion_model: equidistant\n  intrinsics: {[FX, FY, CX, CY]}\n"
    kalibr += "  distortion_coeffs: [0.05, 0.01, 0.0, 0.0]\n  resolution: [640, 480]\n"
    same = load_calibration(given(tmp_path, kalibr, "k.yaml"), VGA)
    assert same.lens == found.lens


@pytest.mark.parametrize(
    "size",
    [
        {"width": 320, "height": 240}, {"w": 320, "h": 240}, {"resolution": [240, 320]}, {"resolution": [320, 240]},
        {"image_size": [320, 240]}, {"ImageSize": [240, 320]}, {"img_size": "320x240"}, {"imageWidth": 320,
        "imageHeight": 240}, {"image_shape": [240, 320, 3]}, {"size": {"width": 320, "height": 240}},
        {"image": {"width": "320", "height": "240"}}, {"im_width": 320, "im_height": 240},
    ],
    ids=str,
)  # fmt: skip
def test_cameras_of_half_the_size_are_scaled(size: dict[str, Any], tmp_path: Path) -> None:
    half = {"K": [[286.0, 0, 162.0], [0, 287.0, 120.5], [0, 0, 1]]} | size
    camera = load_calibration(given(tmp_path, half), VGA).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((572, 574, 324.5, 241.5))
    with pytest.raises(CameraError, match="which is another shape"):
        load_calibration(tmp_path / "c.json", (640, 400))


@pytest.mark.parametrize("size", [{"width": 320}, {"resolution": [1, 2, 3, 4]}, {"size": [0.5, 0.5]}])
def test_sizes_that_cannot_be_read_are_refused(size: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(CameraError, match=r"size|width or a height"):
        load_calibration(given(tmp_path, NUMBERS | size), VGA)


@pytest.mark.parametrize("share", [0.5, 1.25, 2.0])
def test_a_principal_point_far_from_the_middle_is_told(share: float, caplog: pytest.LogCaptureFixture) -> None:
    load_calibration(f"{FX * share},{FY * share},{320 * share},{240 * share}", VGA)
    assert "is the camera of another picture size?" in caplog.text


def test_columns_first(tmp_path: Path) -> None:
    by_columns = np.transpose(ROWS).ravel().tolist()
    np.testing.assert_allclose(load_calibration(given(tmp_path, {"intrinsic_matrix": by_columns}), VGA).camera.K, ROWS)


def test_two_cameras_in_a_file(tmp_path: Path) -> None:
    two = {"left": NUMBERS, "right": NUMBERS | {"fx": 600}}
    with pytest.raises(CameraError, match="several cameras"):
        load_calibration(given(tmp_path, two), VGA)


# --- lenses ---

LENSES = [
    Lens(Camera(FX, FY, CX, CY, *VGA), tuple(BENT)),
    Lens(Camera(FX, FY, CX, CY, *VGA), (0.25, -0.05, 0.0, 0.0)),
    Lens(Camera(FX, FY, CX, CY, *VGA), (-0.1, 0.02, 0.001, 0.0, 0.003, 0.05, 0.01, 0.002)),
    Lens(Camera(400.0, 401.0, CX, CY, *VGA), (0.05, 0.01, -0.002, 0.0), "fisheye"),
]


def seen_through(lens: Lens, points: np.ndarray) -> np.ndarray:
    """A photograph with a bright dot at each point (N, 3) of the camera's frame, dot by dot."""
    image = np.zeros((lens.camera.height, lens.camera.width, 3), np.uint8)
    for u, v in lens.project(points):
        cv2.circle(image, (round(u), round(v)), 3, (255, 255, 255), -1)
    return image


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: f"{lens.model} {len(lens.coefficients)}")
def test_an_undistorted_picture_is_its_cameras(lens: Lens) -> None:
    for x, y in ((-0.35, -0.25), (0.4, 0.3), (0.0, 0.0), (0.42, -0.3)):
        point = np.array([[x, y, 1.0]])
        picture = lens.undistorted(seen_through(lens, point))
        assert picture.shape[:2] == lens.ideal.size[::-1]
        rows, columns = np.nonzero(picture[..., 0] > 127)
        np.testing.assert_allclose((columns.mean(), rows.mean()), lens.ideal.project(point)[0], atol=0.8)
        [[u, v]] = lens.project(point)
        box = lens.undistorted_box((u - 9.5, v - 9.5, u + 10.5, v + 10.5))
        np.testing.assert_allclose((0.5 * (box[0] + box[2]) - 0.5, 0.5 * (box[1] + box[3]) - 0.5),
                                   lens.ideal.project(point)[0], atol=1.0)  # fmt: skip


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: f"{lens.model} {len(lens.coefficients)}")
def test_nothing_of_the_photograph_is_lost_and_nothing_comes_twice(lens: Lens) -> None:
    photo = np.full((480, 640), True)
    whole = lens.undistorted_mask(photo)
    corner = np.zeros_like(photo)
    corner[:20, :20] = True
    assert lens.undistorted_mask(corner).any()
    assert cv2.connectedComponents(whole.astype(np.uint8))[0] == 2
    assert cv2.connectedComponents(lens.undistorted_mask(corner).astype(np.uint8))[0] == 2


def test_a_polynomial_that_turns_back_shows_nothing_twice() -> None:
    lens = Lens(Camera(500.0, 500.0, 319.5, 239.5, *VGA), (-0.3, 0.0, 0.0, 0.0))
    corner = np.zeros((480, 640), bool)
    corner[:40, :40] = True
    rows, columns = np.nonzero(lens.undistorted_mask(corner))
    assert (rows < lens.ideal.cy).all() and (columns < lens.ideal.cx).all()


def test_a_view_is_undistorted_and_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, logger="posekit")
    lens = LENSES[0]
    point = np.array([[0.4, 0.3, 1.0]])
    cv2.imwrite(str(tmp_path / "a.png"), seen_through(lens, point))
    view = load_view(tmp_path / "a.png", given(tmp_path, NUMBERS | {"dist_coeffs": BENT}))
    assert view.lens == lens and view.camera == lens.ideal
    rows, columns = np.nonzero(view.image[..., 0] > 127)
    np.testing.assert_allclose((columns.mean(), rows.mean()), view.camera.project(point)[0], atol=0.8)
    assert "the picture is undistorted (pinhole, -0.3, 0.1" in caplog.text


def test_boxes_and_masks_of_the_photograph_are_moved(tmp_path: Path) -> None:
    """What a person gives is of the photograph as it was taken."""
    lens = LENSES[0]
    [[u, v]] = lens.project([[0.4, 0.3, 1.0]])
    [[x, y]] = lens.ideal.project([[0.4, 0.3, 1.0]])
    view = View(np.zeros((lens.ideal.height, lens.ideal.width, 3), np.uint8), lens.ideal, lens=lens)
    box = f"{u - 19.5},{v - 19.5},{u + 20.5},{v + 20.5}"
    mask = np.zeros((480, 640), np.uint8)
    mask[round(v) - 20 : round(v) + 21, round(u) - 20 : round(u) + 21] = 255
    cv2.imwrite(str(tmp_path / "m.png"), mask)
    entry = {"image_id": 1, "category_id": 1, "bbox": [u - 19.5, v - 19.5, 40, 40]}
    (tmp_path / "d.json").write_text(json.dumps([entry]))
    for prompt in (
        prompt_for(box, None, "filled", lens=lens),
        prompt_for(None, tmp_path / "m.png", "filled", lens=lens),
        prompt_for(None, None, "filled", tmp_path / "d.json", tmp_path / "1.png", lens),
    ):
        assert prompt is not None
        [found] = prompt.detect(view, [bracket()])
        middle = 0.5 * (found.box[0] + found.box[2]) - 0.5, 0.5 * (found.box[1] + found.box[3]) - 0.5
        np.testing.assert_allclose(middle, (x, y), atol=2)
        assert found.mask is None or found.mask.shape == view.image.shape[:2]


@pytest.mark.parametrize("text", ["[" * 3000, "a: " + "[" * 60 + "]" * 60, "# " + "x" * 400_000])
def test_yaml_that_takes_its_parser_long_is_refused_at_once(text: str, tmp_path: Path) -> None:
    (tmp_path / "c.yml").write_text(text)
    with pytest.raises(CameraError, match="longer than 300000 letters or deeper than 50 brackets"):
        load_calibration(tmp_path / "c.yml", (640, 480))


def test_a_number_too_large_for_a_float(tmp_path: Path) -> None:
    (tmp_path / "c.json").write_text('{"K": [%s, 0, 1, 0, 1, 1, 0, 0, 1]}' % (10**400))
    with pytest.raises(CameraError, match="holds no camera that posekit understands"):
        load_calibration(tmp_path / "c.json", (640, 480))


# --- more spellings -----------------------------------------------------------------------------------------------

OWN = [[572.4, 0.0, 325.2], [0.0, 573.5, 242.0], [0.0, 0.0, 1.0]]
DOUBLE = [[1144.8, 0.0, 650.4], [0.0, 1147.0, 484.0], [0.0, 0.0, 1.0]]


def written(folder: Path, data: object, name: str = "c.json") -> Path:
    (folder / name).write_text(json.dumps(data))
    return folder / name


@pytest.mark.parametrize(
    "size",
    [
        {"img_w": 1280, "img_h": 960}, {"image_w": 1280, "image_h": 960}, {"width_px": 1280, "height_px": 960},
        {"cam_width": 1280, "cam_height": 960}, {"resolution_x": 1280, "resolution_y": 960}, {"wh": [1280, 960]},
        {"ncols": 1280, "nrows": 960}, {"frame_size": [960, 1280]}, {"res": "1280x960"},
        {"calibration_resolution": [1280, 960]}, {"Camera.width": 1280, "Camera.height": 960},
    ],
    ids=str,
)  # fmt: skip
def test_more_spellings_of_the_size(size: dict[str, object], tmp_path: Path) -> None:
    camera = load_calibration(written(tmp_path, {"K": DOUBLE} | size), (640, 480)).camera
    assert (camera.fx, camera.size) == (pytest.approx(572.4), (640, 480))


@pytest.mark.parametrize(
    ("extra", "coefficients"),
    [
        ({"radial": [-0.3, 0.1], "tangential": [0.01, 0.02]}, (-0.3, 0.1, 0.01, 0.02, 0.0)),
        ({"radial": [-0.3, 0.1, 0.05]}, (-0.3, 0.1, 0.0, 0.0, 0.05)),
        (
            {"radial_coeffs": [0.1, 0.02, 0.03, 0.04, 0.05, 0.06], "tangential_coeffs": [0.001, 0.002]},
            (0.1, 0.02, 0.001, 0.002, 0.03, 0.04, 0.05, 0.06),
        ),
        ({"Camera.k1": -0.3, "Camera.k2": 0.1, "Camera.p1": 0.0, "Camera.p2": 0.0}, (-0.3, 0.1, 0.0, 0.0)),
    ],
    ids=str,
)
def test_more_spellings_of_distortion(
    extra: dict[str, object], coefficients: tuple[float, ...], tmp_path: Path
) -> None:
    lens = load_calibration(written(tmp_path, {"intrinsics": {"K": OWN}} | extra), (640, 480)).lens
    assert lens is not None and lens.model == "pinhole"
    assert tuple(lens.coefficients) == pytest.approx(coefficients)


@pytest.mark.parametrize("flag", [{"fisheye_model": 1}, {"fisheye": True}, {"camera_model": "KannalaBrandt8"}], ids=str)
def test_more_ways_to_say_fisheye(flag: dict[str, object], tmp_path: Path) -> None:
    lens = load_calibration(written(tmp_path, {"K": OWN, "D": [0.1, 0.01, 0.0, 0.0]} | flag), (640, 480)).lens
    assert lens is not None and lens.model == "fisheye"


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ({"kappa": -500.0}, "division model"),
        ({"xi": 1.2, "D": [-0.3, 0.1, 0.0, 0.0]}, "omnidirectional or double-sphere"),
        ({"radial": [1, 2, 3, 4]}, "3 or 6 numbers and 2 are read"),
        ({"radial": "x"}, "cannot be read"),
    ],
    ids=str,
)
def test_lenses_that_are_not_known_are_not_dropped(extra: dict[str, object], message: str, tmp_path: Path) -> None:
    with pytest.raises(CameraError, match=message):
        load_calibration(written(tmp_path, {"K": OWN} | extra), (640, 480))
    angles = {"omega": 0.1, "phi": 0.2, "kappa": 0.3}  # of where the camera is
    assert load_calibration(written(tmp_path, {"K": OWN} | angles), (640, 480)).lens is None


def test_focal_lengths_as_shares_or_in_mm_are_refused(tmp_path: Path) -> None:
    for numbers in ((0.9, 1.2, 0.5, 0.5), (4.2, 4.2, 320.0, 240.0)):
        with pytest.raises(CameraError, match="is no number of pixels for a picture of 640x480"):
            load_calibration(written(tmp_path, dict(zip(("fx", "fy", "cx", "cy"), numbers, strict=True))), (640, 480))


def test_focal_length_and_principal_point_as_pairs(tmp_path: Path) -> None:
    data = {"FocalLength": [572.4, 573.5], "PrincipalPoint": [325.2, 242.0], "RadialDistortion": [-0.3, 0.1]}
    found = load_calibration(written(tmp_path, data), (640, 480))
    assert (found.camera.fx, found.camera.cy) == (572.4, 242.0) and found.lens is not None

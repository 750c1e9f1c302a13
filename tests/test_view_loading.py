"""Photographs, masks, boxes and poses from files, and every way in which they are refused.

Photographs. Accepted: PNG, JPEG, TIFF, BMP, WebP, GIF's first picture, grey, palette, CMYK, transparent, 8 and 16 bits,
turned by EXIF. Warned about: 10 and 12 bits in a file of 16 (a few hot pixels aside), a TIFF of several pictures,
damaged EXIF data or a second header of them (not turned), a baseline JPEG that lacks a few of its last rows, a camera
that nobody knows. Refused: what is missing, empty, no picture (HEIC, raw files, pointers of Git LFS and web pages are
named), damaged, cut off further up, of floating-point numbers, under 16 pixels a side or over POSEKIT_MOST_PIXELS.
Masks. Accepted: any picture, white where the object is, brighter than half. Warned about: values in between, what looks
inverted. Refused: labels (small numbers, or areas of several values or colours), another size than the photograph's,
nothing in it.
Poses. Accepted: T_cam_obj in metres or its 4x4 numbers alone, a result.json, BOP's pair in mm. Refused: all else.
"""

from __future__ import annotations

import json
import logging
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from posekit.errors import CameraError, ConfigError, ImageError, PromptError
from posekit.io.calibration import load_calibration
from posekit.io.load import camera_from_exif, load_image, load_mask, load_pose, load_view, parse_box

PIXELS = np.random.default_rng(0).integers(0, 256, size=(48, 64, 3), dtype=np.uint8)
SIZE = (64, 48)


def png(path: Path, pixels: np.ndarray = PIXELS) -> Path:
    Image.fromarray(pixels).save(path)
    return path


def png_header(path: Path, width: int, height: int) -> Path:
    """A PNG of any size whose pixels would never fit: the header must suffice."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")
    )
    return path


# --- photographs ---


def test_rgb_as_it_is(tmp_path: Path) -> None:
    image = load_image(png(tmp_path / "a.png"))
    np.testing.assert_array_equal(image, PIXELS)
    assert image.dtype == np.uint8
    assert image.flags.writeable


def test_other_kinds_of_pixels(tmp_path: Path) -> None:
    grey = PIXELS[..., 0]
    np.testing.assert_array_equal(load_image(png(tmp_path / "grey.png", grey)), np.repeat(grey[..., None], 3, axis=2))
    deep = grey.astype(np.uint16) * 257
    np.testing.assert_array_equal(load_image(png(tmp_path / "deep.png", deep))[..., 1], grey)
    Image.fromarray(PIXELS).quantize(16).save(tmp_path / "palette.png")
    quantized = np.asarray(Image.fromarray(PIXELS).quantize(16).convert("RGB"))
    np.testing.assert_array_equal(load_image(tmp_path / "palette.png"), quantized)
    alpha = np.dstack([PIXELS, np.full(PIXELS.shape[:2], 255, np.uint8)])
    alpha[:10, :10, 3] = 0
    image = load_image(png(tmp_path / "alpha.png", alpha))
    assert not image[:10, :10].any()
    np.testing.assert_array_equal(image[10:], PIXELS[10:])
    Image.fromarray(PIXELS).convert("CMYK").save(tmp_path / "print.tif")
    assert load_image(tmp_path / "print.tif").shape == (48, 64, 3)
    Image.fromarray(grey > 99).save(tmp_path / "bits.png")
    assert set(np.unique(load_image(tmp_path / "bits.png"))) == {0, 255}


def test_exif_orientation_is_applied(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned by 90 degrees clockwise
    Image.fromarray(PIXELS).save(tmp_path / "a.png", exif=exif)
    np.testing.assert_array_equal(load_image(tmp_path / "a.png"), np.rot90(PIXELS, -1))


def test_a_missing_picture(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match=r"the picture .*a.png is not there: check the path"):
        load_image(tmp_path / "a.png")
    with pytest.raises(ImageError, match="is a folder"):
        load_image(tmp_path)


def test_an_empty_file(tmp_path: Path) -> None:
    (tmp_path / "a.png").touch()
    with pytest.raises(ImageError, match="is an empty file"):
        load_image(tmp_path / "a.png")


def test_not_an_image(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text("a text")
    with pytest.raises(ImageError, match="is not a picture that posekit reads: give a PNG"):
        load_image(tmp_path / "a.png")


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp", "tif", "webp"])
@pytest.mark.parametrize("share", [0.02, 0.5, 0.8])
def test_truncated_pictures_are_not_half_decoded(tmp_path: Path, suffix: str, share: float) -> None:
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(PIXELS).save(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ImageError, match=r"is damaged or cannot be read|is not a picture"):
        load_image(path)


def test_a_png_cut_at_its_very_end_or_with_a_flipped_bit(tmp_path: Path) -> None:
    path = png(tmp_path / "a.png")
    data = path.read_bytes()
    path.write_bytes(data[:-16])
    with pytest.raises(ImageError, match="is damaged or cannot be read"):
        load_image(path)
    path.write_bytes(data[:3000] + bytes([data[3000] ^ 1]) + data[3001:])
    with pytest.raises(ImageError, match="is damaged or cannot be read"):
        load_image(path)


@pytest.mark.parametrize("size", [(1, 1), (640, 15), (15, 480)])
def test_tiny_pictures(tmp_path: Path, size: tuple[int, int]) -> None:
    with pytest.raises(ImageError, match=rf"is {size[0]}x{size[1]} pixels: at least 16x16 are needed"):
        load_image(png(tmp_path / "a.png", np.zeros((size[1], size[0], 3), np.uint8)))


def test_a_picture_of_no_size(tmp_path: Path) -> None:
    with pytest.raises(ImageError):
        load_image(png_header(tmp_path / "a.png", 0, 0))


@pytest.mark.parametrize("size", [(20000, 20000), (12000, 9000), (10001, 10000)])
def test_huge_pictures_are_refused_by_their_header(tmp_path: Path, size: tuple[int, int]) -> None:
    with pytest.raises(ImageError, match=r"at most 100 megapixels are read\. Scale it down"):
        load_image(png_header(tmp_path / "a.png", *size))


def test_floating_point_and_32_bit_pictures(tmp_path: Path) -> None:
    Image.fromarray(PIXELS[..., 0].astype(np.float32)).save(tmp_path / "f.tif")
    with pytest.raises(ImageError, match="floating-point"):
        load_image(tmp_path / "f.tif")
    Image.fromarray(PIXELS[..., 0].astype(np.int32) * 1000).save(tmp_path / "i.tif")
    with pytest.raises(ImageError, match="more than 16 bits"):
        load_image(tmp_path / "i.tif")


# --- masks and boxes ---


@pytest.mark.parametrize("kind", ["bits", "grey", "deep", "rgb", "rgba", "palette"])
def test_masks_are_what_is_not_black(tmp_path: Path, kind: str) -> None:
    mask = np.zeros((48, 64), bool)
    mask[10:20, 5:30] = True
    grey = mask.astype(np.uint8)  # 1, not 255
    image = {
        "bits": Image.fromarray(mask),
        "grey": Image.fromarray(grey),
        "deep": Image.fromarray(grey.astype(np.uint16)),
        "rgb": Image.fromarray(np.dstack([grey, 0 * grey, 0 * grey])),
        "rgba": Image.fromarray(np.dstack([grey, grey, grey, 0 * grey + 255])),
        "palette": Image.fromarray(grey * 255).quantize(2),
    }[kind]
    image.save(tmp_path / "m.png")
    np.testing.assert_array_equal(load_mask(tmp_path / "m.png", SIZE), mask)
    assert load_mask(tmp_path / "m.png").dtype == np.bool_


def disc(soft: float = 0.0) -> np.ndarray:
    """A disc of 255 on 0, (480, 640), its rim smoothed over so many pixels."""
    x, y = np.meshgrid(np.arange(640), np.arange(480))
    distance = 150 - np.hypot(x - 300, y - 250)
    return (np.clip(distance / max(soft, 1e-9) + 0.5, 0, 1) * 255).astype(np.uint8)


def test_masks_of_jpeg_are_cut_at_half(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    Image.fromarray(disc()).save(tmp_path / "m.jpg", quality=60)
    mask = load_mask(tmp_path / "m.jpg")
    assert abs(int(mask.sum()) - int((disc() > 0).sum())) < 0.005 * mask.sum()
    assert "the mask m.jpg has values between 0 and 255" in caplog.text


@pytest.mark.parametrize("most", [255, 200, 65535, 4095])
def test_soft_masks_are_cut_at_half_of_their_brightest(tmp_path: Path, most: int) -> None:
    soft = disc(20.0).astype(np.float64) / 255 * most
    png(tmp_path / "m.png", soft.astype(np.uint8 if most < 256 else np.uint16))
    assert abs(int(load_mask(tmp_path / "m.png").sum()) - int((disc() > 0).sum())) < 0.01 * (disc() > 0).sum()


def test_labels_are_no_mask(tmp_path: Path) -> None:
    labels = np.zeros((48, 64), np.uint8)
    labels[3:20, 3:20], labels[30:40, 30:40] = 1, 2
    with pytest.raises(PromptError, match=r"the mask m.png has the values 1, 2, as a picture of labels does"):
        load_mask(png(tmp_path / "m.png", labels))


def test_an_inverted_mask_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    load_mask(png(tmp_path / "m.png", 255 - disc()))
    assert "is it inverted" in caplog.text


# --- bits, and metadata that are damaged ---


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("colours", [False, True])
def test_bits_in_16_are_scaled_by_what_is_used(
    tmp_path: Path, bits: int, colours: bool, caplog: pytest.LogCaptureFixture
) -> None:
    wide = np.rint(PIXELS / 255.0 * ((1 << bits) - 1)).astype(np.uint16)
    wide[0, 0] = (1 << bits) - 1
    for suffix in ("png", "tiff"):
        path = tmp_path / f"a.{suffix}"
        cv2.imwrite(str(path), wide[..., ::-1] if colours else wide[..., 0])
        caplog.clear()
        expected = PIXELS if colours else np.repeat(PIXELS[..., :1], 3, axis=2)
        found = load_image(path)
        assert np.abs(found[1:].astype(int) - expected[1:].astype(int)).max() <= 1
        assert (f"taken for {bits} bits" in caplog.text) == (bits < 16)


def jpeg(path: Path, exif: bytes) -> Path:
    Image.new("RGB", (64, 48), (90, 120, 30)).save(path, exif=b"Exif\0\0" + exif)
    return path


ORIENTATION = struct.pack("<HHII", 0x0112, 3, 1, 6)
BEYOND = 8 + 2 + 12 * 2 + 4


@pytest.mark.parametrize(
    ("entries", "tail", "turned"),
    [
        ([ORIENTATION, struct.pack("<HHII", 0x011A, 10, 1, BEYOND)], struct.pack("<ii", -1, 0), True),
        ([ORIENTATION, struct.pack("<HHII", 0x011A, 10, 1, BEYOND)], struct.pack("<ii", -72, 1), True),
        ([ORIENTATION, struct.pack("<HHII", 0x011A, 5, 2, BEYOND)], struct.pack("<IIII", 72, 1, 72, 1), True),
        ([ORIENTATION, struct.pack("<HHII", 0x8769, 4, 1, 0xFFFFFF)], b"", True),
        ([struct.pack("<HHII", 0x0112, 2, 4, 0x41414141)] * 2, b"", False),
        ([struct.pack("<HHII", 0x0112, 3, 1, 99)] * 2, b"", False),
    ],
)
def test_damaged_exif_does_not_stop_a_picture(tmp_path: Path, entries: list[bytes], tail: bytes, turned: bool) -> None:
    exif = b"II*\0\x08\0\0\0" + struct.pack("<H", len(entries)) + b"".join(entries) + b"\0\0\0\0" + tail
    assert load_image(jpeg(tmp_path / "a.jpg", exif)).shape == ((64, 48, 3) if turned else (48, 64, 3))
    assert load_view(tmp_path / "a.jpg").camera.size == ((48, 64) if turned else (64, 48))


def test_a_few_hot_pixels_do_not_make_a_picture_dark(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    values = np.full((200, 200, 3), (1000, 2000, 4095), np.uint16)  # OpenCV's order, 12 bits
    values[5, 5] = 65535
    cv2.imwrite(str(tmp_path / "a.png"), values)
    found = load_image(tmp_path / "a.png")
    assert found[0, 0].tolist() == [255, 125, 62] and found[5, 5].tolist() == [255, 255, 255]
    assert "all but a few of its 16-bit pixels go up to 4095 only, so they are taken for 12 bits" in caplog.text


def test_twelve_bits_in_jpeg_2000(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    if not cv2.imwrite(str(tmp_path / "a.jp2"), np.full((64, 64, 3), (1000, 2000, 4080), np.uint16)):
        pytest.skip("OpenCV is built without JPEG 2000")
    assert np.abs(load_image(tmp_path / "a.jp2")[9, 9].astype(int) - (254, 125, 62)).max() <= 2
    assert "taken for 12 bits" in caplog.text


def test_a_tiff_of_several_pictures_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    small = Image.new("RGB", (20, 16), (9, 8, 7))
    small.save(tmp_path / "a.tif", save_all=True, append_images=[Image.new("RGB", (64, 48))])
    assert load_image(tmp_path / "a.tif")[0, 0].tolist() == [9, 8, 7]
    assert "a.tif holds 2 pictures: the first one, 20x16 pixels, is read" in caplog.text


def test_masks_of_several_objects_are_refused(tmp_path: Path) -> None:
    two = np.zeros((48, 64, 3), np.uint8)
    two[5:20, 5:20], two[25:40, 25:40] = (200, 0, 0), (0, 180, 0)
    Image.fromarray(two).save(tmp_path / "a.png")
    with pytest.raises(PromptError, match=r"areas of #00b400 and #c80000, as a picture of labels"):
        load_mask(tmp_path / "a.png")
    Image.fromarray(two.max(axis=2)).save(tmp_path / "a.png")
    with pytest.raises(PromptError, match="areas of 180 and 200, as a picture of labels"):
        load_mask(tmp_path / "a.png")
    two[25:40, 25:40] = 0
    Image.fromarray(two).save(tmp_path / "a.png")
    assert load_mask(tmp_path / "a.png").sum() == 225  # one colour is one object
    noise = np.random.default_rng(0).integers(0, 40, (48, 64))
    Image.fromarray((two.max(axis=2) // 200 * 160 + noise).astype(np.uint8)).save(tmp_path / "a.png")
    assert load_mask(tmp_path / "a.png").sum() == 225


def test_an_orientation_behind_a_second_header_is_none(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0" + ORIENTATION + b"\0\0\0\0"
    assert load_image(jpeg(tmp_path / "a.jpg", exif)).shape == (48, 64, 3)  # as viewers and OpenCV show it
    assert "a second header" in caplog.text


def test_a_picture_that_is_a_pointer_of_git_lfs(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n")
    with pytest.raises(ImageError, match=r"the picture .*a.png holds a pointer of Git LFS .* git lfs pull"):
        load_image(tmp_path / "a.png")


def test_a_pose_in_utf16_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(json.dumps({"T_cam_obj": np.eye(4).tolist()}).encode("utf-16"))
    assert load_pose(tmp_path / "a.json").t.tolist() == [0, 0, 0]


@pytest.mark.parametrize(("name", "way_out"), [("a.HEIC", "export it as JPEG"), ("a.dng", "developed first")])
def test_files_of_phones_and_cameras_that_are_not_read(tmp_path: Path, name: str, way_out: str) -> None:
    (tmp_path / name).write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(400))
    with pytest.raises(ImageError, match=way_out):
        load_image(tmp_path / name)


@pytest.mark.parametrize(
    "exif", [b"", b"II*\0", b"II*\0\x08\0\0\0\x30\0" + ORIENTATION[:9], b"Exif\0\0MM\0*", b"x" * 30]
)
def test_exif_that_is_none(tmp_path: Path, exif: bytes) -> None:
    assert load_image(jpeg(tmp_path / "a.jpg", exif)).shape == (48, 64, 3)
    assert load_view(tmp_path / "a.jpg").camera.size == (64, 48)


def test_masks_that_do_not_fit(tmp_path: Path) -> None:
    png(tmp_path / "m.png", np.zeros((48, 64), np.uint8))
    with pytest.raises(PromptError, match=r"the mask m.png is 64x48 pixels, the picture 640x480: a mask has the size"):
        load_mask(tmp_path / "m.png", (640, 480))
    with pytest.raises(PromptError, match=r"m.png is empty: its pixels must be brighter than 0"):
        load_mask(tmp_path / "m.png")
    assert not load_mask(tmp_path / "m.png", allow_empty=True).any()
    with pytest.raises(PromptError, match=r"the mask .* is not there"):
        load_mask(tmp_path / "n.png")
    (tmp_path / "t.png").write_text("x")
    with pytest.raises(PromptError, match="is not a picture"):
        load_mask(tmp_path / "t.png")


def test_boxes() -> None:
    assert parse_box("1,2,30.5,40", SIZE) == (1, 2, 30.5, 40)
    assert parse_box(" -5, -6, 30, 400 ", SIZE) == (-5, -6, 30, 400)  # partly outside: kept
    assert parse_box("1,2,3000,4000") == (1, 2, 3000, 4000)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("1,2,3", "is not four numbers: give x0,y0,x1,y1"),
        ("1,2,3,4,5", "is not four numbers"),
        ("a,b,c,d", "is not four numbers"),
        ("", "is not four numbers"),
        ("30,2,10,40", "is inside out"),
        ("3,40,10,40", "is inside out"),
        ("nan,2,10,40", "is inside out"),
        ("1,2,inf,40", "is inside out"),
        ("64,0,90,40", "lies outside the picture, which is 64x48 pixels"),
        ("-9,0,0,40", "lies outside the picture"),
        ("0,48,9,60", "lies outside the picture"),
        ("0,-9,9,-1", "lies outside the picture"),
    ],
)
def test_bad_boxes(text: str, why: str) -> None:
    with pytest.raises(PromptError, match=why):
        parse_box(text, SIZE)


# --- cameras ---

K = np.array([[572.4, 0, 325.2], [0, 573.5, 242.0], [0, 0, 1.0]])
VGA = (640, 480)


def is_k(camera: object) -> None:
    np.testing.assert_allclose(camera.K, K)  # type: ignore[attr-defined]
    assert camera.size == VGA  # type: ignore[attr-defined]


def test_four_numbers() -> None:
    is_k(load_calibration("572.4, 573.5, 325.2, 242", VGA).camera)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("camera.json", json.dumps({"fx": 572.4, "fy": 573.5, "cx": 325.2, "cy": 242.0, "width": 640, "height": 480,
                                    "depth_scale": 1.0})),
        ("k.json", json.dumps(K.tolist())),
        ("k.json", json.dumps({"K": K.ravel().tolist()})),
        ("k.json", json.dumps({"cam_K": K.ravel().tolist(), "depth_scale": 1.0})),
        ("k.json", json.dumps({"camera_matrix": {"rows": 3, "cols": 3, "data": K.ravel().tolist()}, "image_width": 640,
                               "image_height": 480})),
        ("K.txt", "572.4 0 325.2\n0 573.5 242.0\n0 0 1\n"),
        ("K.txt", "[[572.4, 0, 325.2],\n [0, 573.5, 242.0],\n [0, 0, 1]]"),
        ("K.txt", "572.4 573.5 325.2 242.0"),
        ("ros.yaml", "image_width: 640\nimage_height: 480\ncamera_name: x\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
                     "  data: [572.4, 0., 325.2, 0., 573.5, 242.0, 0., 0., 1.]\n"),
    ],
)  # fmt: skip
def test_camera_files(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    is_k(load_calibration(tmp_path / name, VGA).camera)
    is_k(load_calibration(str(tmp_path / name), VGA).camera)


@pytest.mark.parametrize("suffix", ["yml", "yaml", "xml"])
@pytest.mark.parametrize("key", ["camera_matrix", "K", "cameraMatrix"])
def test_opencv_files(tmp_path: Path, suffix: str, key: str) -> None:
    path = tmp_path / f"calibration.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write(key, K)
    storage.write("distortion_coefficients", np.zeros(5))
    storage.release()
    is_k(load_calibration(path, VGA).camera)


def test_scene_camera_by_the_pictures_number(tmp_path: Path) -> None:
    path = tmp_path / "scene_camera.json"
    other = (K * [[2], [2], [1]]).ravel().tolist()
    path.write_text(json.dumps({"3": {"cam_K": K.ravel().tolist(), "depth_scale": 1.0}, "17": {"cam_K": other}}))
    is_k(load_calibration(path, VGA, "rgb/000003.png").camera)
    assert load_calibration(path, VGA, "rgb/000017.png").camera.fx == pytest.approx(2 * 572.4)
    with pytest.raises(CameraError, match=r"scene_camera.json: it has no camera for image 4; it has 3, 17\. Name"):
        load_calibration(path, VGA, "rgb/000004.png")
    with pytest.raises(CameraError, match="no camera for a picture without a number in its name"):
        load_calibration(path, VGA, "duck.png")
    with pytest.raises(CameraError, match="no camera for a picture without a number"):
        load_calibration(path, VGA)


def camera_json(path: Path, width: int, height: int) -> Path:
    path.write_text(json.dumps({"fx": 500, "fy": 500, "cx": 319.5, "cy": 239.5, "width": width, "height": height}))
    return path


def test_a_camera_for_another_size(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, logger="posekit")
    camera = load_calibration(camera_json(tmp_path / "c.json", 640, 480), (320, 240)).camera
    assert (camera.fx, camera.cx, camera.cy, camera.size) == (250, 159.5, 119.5, (320, 240))
    assert "scaled from 640x480 to the picture's 320x240" in caplog.text
    with pytest.raises(CameraError, match=r"is for pictures of 640x480 pixels, this one has 640x400, which is another"):
        load_calibration(tmp_path / "c.json", (640, 400))


def test_a_principal_point_outside_is_told(caplog: pytest.LogCaptureFixture) -> None:
    load_calibration("500,500,960,540", VGA)
    assert "the principal point (960, 540) lies outside the picture of 640x480" in caplog.text


@pytest.mark.parametrize(
    ("name", "text", "why"),
    [
        ("c.json", "{", "holds no camera that posekit understands"),
        ("c.json", "{}", "it is empty"),
        ("c.json", '{"a": 1}', "neither fx, fy, cx, cy nor any of camera_matrix, cam_K, K"),
        ("c.json", '{"K": [1, 2]}', "3x3 numbers, not 2"),
        ("c.json", '{"K": "x"}', "holds no camera"),
        ("c.json", '{"fx": 0, "fy": 500, "cx": 1, "cy": 1}', "must be positive numbers of pixels"),
        ("c.json", json.dumps(np.zeros((3, 3)).tolist()), "must be positive"),
        ("c.json", json.dumps([[500, 0, 320], [0, 500, 240], [0, 0, 5]]), "a pinhole camera without skew"),
        ("c.json", json.dumps([[500, 30, 320], [0, 500, 240], [0, 0, 1]]), "a pinhole camera without skew"),
        ("k.txt", "1 2 3", "3x3 numbers, not 3"),
        ("k.txt", "focal length: long", "holds no camera"),
        ("k.txt", "", "3x3 numbers, not 0"),
        ("c.yml", "%YAML:1.0\n---\nother: 3\n", "nor any of camera_matrix"),
        ("c.yml", "%YAML:1.0\n---\n\t: : :", "holds no camera"),
    ],
)
def test_bad_camera_files(tmp_path: Path, name: str, text: str, why: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(CameraError, match=why) as caught:
        load_calibration(tmp_path / name, VGA)
    assert name in str(caught.value)


@pytest.mark.parametrize("text", ["1,2,3", "0,0,0,0", "500,500,nan,240", "1,2,3,4,5", "-500,500,320,240"])
def test_bad_numbers(text: str) -> None:
    with pytest.raises(CameraError, match=r"give fx,fy,cx,cy|Give fx,fy,cx,cy"):
        load_calibration(text, VGA)


def test_a_missing_camera_file(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match=r"there is no camera file .*c.json: give fx,fy,cx,cy in pixels, or a file"):
        load_calibration(tmp_path / "c.json", VGA)
    with pytest.raises(CameraError, match="cannot be read"):
        load_calibration(tmp_path, VGA)
    (tmp_path / "c.txt").write_bytes(bytes(range(128, 256)))
    with pytest.raises(CameraError, match="cannot be read"):
        load_calibration(tmp_path / "c.txt", VGA)


# --- EXIF ---


def photograph(path: Path, tags: dict[int, object], size: tuple[int, int] = (600, 400)) -> Path:
    exif = Image.Exif()
    exif.get_ifd(0x8769).update(tags)
    Image.new("RGB", size).save(path, exif=exif)
    return path


def test_focal_length_in_35_mm_film(tmp_path: Path) -> None:
    path = photograph(tmp_path / "a.jpg", {0xA405: 36})
    camera = camera_from_exif(path, (600, 400))
    assert camera is not None
    assert camera.fx == pytest.approx(600)  # on a 36x24 mm frame of the same shape
    assert (camera.cx, camera.cy) == (299.5, 199.5)
    upright = camera_from_exif(path, (400, 600))
    assert upright is not None
    assert (upright.fx, upright.size) == (pytest.approx(600), (400, 600))


def test_focal_length_with_the_sensors_resolution(tmp_path: Path) -> None:
    tags = {0x920A: 5.0, 0xA20E: 1000.0, 0xA210: 3, 0xA002: 1200, 0xA003: 800}  # 100 pixels per mm, then halved
    camera = camera_from_exif(photograph(tmp_path / "a.jpg", tags), (600, 400))
    assert camera is not None
    assert camera.fx == pytest.approx(250)
    tags |= {0xA210: 2, 0xA20E: 5080.0}  # 200 per mm, given per inch
    camera = camera_from_exif(photograph(tmp_path / "a.jpg", tags), (600, 400))
    assert camera is not None
    assert camera.fx == pytest.approx(500)


@pytest.mark.parametrize(
    "tags",
    [{}, {0xA405: 0}, {0x920A: 5.0}, {0xA405: 2}, {0xA405: 50, 0xA002: 600, 0xA003: 600}],
    ids=["nothing", "zero", "no sensor", "absurd", "cropped"],
)
def test_exif_that_does_not_say(tmp_path: Path, tags: dict[int, object]) -> None:
    assert camera_from_exif(photograph(tmp_path / "a.jpg", tags), (600, 400)) is None


# --- views ---


def test_the_camera_given_comes_before_exif_and_the_guess(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, logger="posekit")
    path = photograph(tmp_path / "a.jpg", {0xA405: 36})
    assert load_view(path, "500,500,300,200").camera.fx == 500
    assert load_view(path).camera.fx == pytest.approx(600)
    assert "from its EXIF data" in caplog.text
    caplog.clear()
    view = load_view(png(tmp_path / "b.png"))
    assert view.camera.fx == pytest.approx(32 / np.tan(np.deg2rad(30)))
    assert "a field of view of 60 degrees is assumed" in caplog.text
    assert caplog.records[0].levelno == logging.WARNING
    np.testing.assert_array_equal(view.image, PIXELS)


def test_a_jpeg_cut_short_at_its_very_end_is_read_and_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (400, 300, 3), np.uint8)
    path = tmp_path / "a.jpg"
    Image.fromarray(pixels).save(path, quality=95)
    whole, data = load_image(path), path.read_bytes()
    path.write_bytes(data[:-60])
    found = load_image(path)
    assert np.array_equal(found[:380], whole[:380])
    assert "the file is cut off at its end" in caplog.text
    path.write_bytes(data[: len(data) * 8 // 10])
    with pytest.raises(ImageError, match="it is cut off: of 400 rows the last"):
        load_image(path)


def test_the_limit_of_pixels_can_be_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = png(tmp_path / "a.png")
    monkeypatch.setenv("POSEKIT_MOST_PIXELS", "100")
    with pytest.raises(ImageError, match="or set POSEKIT_MOST_PIXELS"):
        load_image(path)
    monkeypatch.setenv("POSEKIT_MOST_PIXELS", "many")
    with pytest.raises(ConfigError, match="POSEKIT_MOST_PIXELS=many: give a whole number"):
        load_image(path)


def test_a_pose_as_a_bare_matrix(tmp_path: Path) -> None:
    matrix = np.eye(4)
    matrix[:3, 3] = (0.1, 0.2, 0.9)
    (tmp_path / "p.json").write_text(json.dumps(matrix.tolist()))
    np.testing.assert_allclose(load_pose(tmp_path / "p.json").matrix, matrix)
    (tmp_path / "p.json").write_text("[[1, 2], [3]]")
    with pytest.raises(PromptError, match="holds no pose"):
        load_pose(tmp_path / "p.json")


@pytest.mark.parametrize(
    "text",
    [
        json.dumps({"T_cam_obj": [[10**400, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]]}),
        json.dumps({"cam_R_m2c": [1, 0, 0, 0, 1, 0, 0, 0, 1], "cam_t_m2c": [0, 0, 10**400]}),
        "[" * 100_000,
    ],
    ids=["matrix", "bop", "deep"],
)
def test_poses_of_numbers_or_depths_that_python_cannot_have(text: str, tmp_path: Path) -> None:
    (tmp_path / "p.json").write_text(text)
    with pytest.raises(PromptError, match="holds no pose"):
        load_pose(tmp_path / "p.json")


def test_a_mask_whose_pixels_are_damaged_though_its_checksums_are_right(tmp_path: Path) -> None:
    data = bytearray(png(tmp_path / "m.png").read_bytes())
    start = data.index(b"IDAT")
    length = int.from_bytes(data[start - 4 : start], "big")
    for k in range(start + 20, start + 60):
        data[k] ^= 0xFF
    data[start + 4 + length : start + 8 + length] = zlib.crc32(data[start : start + 4 + length]).to_bytes(4, "big")
    (tmp_path / "m.png").write_bytes(data)
    with pytest.raises(PromptError, match="is damaged or cannot be read"):
        load_mask(tmp_path / "m.png")

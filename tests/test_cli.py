"""The command line: exit codes, texts, what is written and what is not."""

from __future__ import annotations

import json
import os
import signal
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from typer.main import get_command
from typer.testing import CliRunner, Result

from posekit import __version__, results
from posekit.camera import Camera
from posekit.cli import doctor
from posekit.cli.app import app
from posekit.cli.output import limits
from posekit.geometry import Pose, rotation_angle
from posekit.io.load import load_pose
from posekit.render import Renderer
from posekit.synth.example import Example, ply

Invoke = Callable[..., Result]


# --- light ------------------------------------------------------------------------------------------------------


def python(*args: str, **kwargs: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *args], capture_output=True, text=True, timeout=120, check=False, **kwargs)  # type: ignore[call-overload, no-any-return]


HEAVY = "[m for m in ('torch', 'moderngl', 'cv2', 'trimesh', 'openvino', 'scipy') if m in sys.modules]"


def test_import_is_light() -> None:
    result = python("-c", f"import sys, posekit; print({HEAVY}, posekit.__version__)")
    assert result.stdout.split() == ["[]", __version__]


def test_public_names_all_exist() -> None:
    names = "Camera Pose View ObjectModel Detection Estimate PoseEstimator Renderer PosekitError __version__"
    code = (
        f"import posekit; [getattr(posekit, n) for n in '{names}'.split()]; [getattr(posekit, n) for n in dir(posekit)]"
    )
    result = python("-c", code)
    assert result.returncode == 0, result.stderr


def test_unknown_name_is_an_attribute_error() -> None:
    import posekit

    with pytest.raises(AttributeError, match="'posekit' has no attribute 'Poze'"):
        _ = posekit.Poze  # type: ignore[attr-defined]


def test_help_loads_nothing_heavy() -> None:
    code = f"import sys; from posekit.cli.app import app; app(['--help'], standalone_mode=False); print({HEAVY})"
    result = python("-c", code)
    assert result.stdout.split()[-1] == "[]", result.stdout + result.stderr


def test_help_is_asked_of_every_command() -> None:
    names = "cache calibrate demo detect doctor download estimate eval export refine render-views synth track train"
    assert sorted(get_command(app).commands) == [*names.split(), "view"]  # type: ignore[attr-defined]


@pytest.mark.parametrize("command", sorted(get_command(app).commands))  # type: ignore[attr-defined]
def test_every_command_has_help(command: str) -> None:
    result = CliRunner().invoke(app, [command, "--help"])
    assert result.exit_code == 0
    assert "Usage" in result.stdout


@pytest.mark.parametrize("command", [*sorted(get_command(app).commands), "train pose"])  # type: ignore[attr-defined]
def test_every_command_shows_how_much_it_says(command: str) -> None:
    shown = CliRunner().invoke(app, [*command.split(), "--help"]).stdout
    assert all(word in shown for word in ("--quiet", "-q", "--verbose", "-v", "--debug"))
    assert "<bool>" not in shown, "flags take no value"


@pytest.mark.parametrize("flag", ["--version", "-V"])
def test_version(flag: str) -> None:
    assert CliRunner().invoke(app, [flag]).stdout == f"posekit {__version__}\n"


# --- success ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(example_folder: Path) -> Path:
    """The example's files and a mask."""
    mask = np.zeros((480, 640), np.uint8)
    mask[150:290, 260:450] = 255
    cv2.imwrite(str(example_folder / "mask.png"), mask)
    return example_folder


CAMERA = "610,610,322,236"


@pytest.fixture
def invoke(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Invoke:
    """Runs posekit in an empty folder; options that are given replace those that make the call a good one."""
    monkeypatch.chdir(tmp_path)

    def run(command: str, image: object = None, *flags: str, **options: object) -> Result:
        chosen: dict[str, object] = {"model": folder / "toy.ply"}
        arguments = [command]
        if command in ("estimate", "refine"):
            arguments.append(str(image or folder / "photo.png"))
            chosen |= {"camera": CAMERA, "weights": folder / "untrained", "iterations": 2, "threads": 1}
            chosen |= {"box": "251,139,456,294"} if command == "estimate" else {"pose": folder / "pose.json"}
        for name, value in (chosen | options).items():
            arguments += [] if value is None else [f"--{name.replace('_', '-')}", str(value)]
        return CliRunner().invoke(app, [*arguments, *flags])

    return run


def assert_result(text: str) -> None:
    [estimate] = json.loads(text)["estimates"]
    assert np.asarray(estimate["T_cam_obj"]).shape == (4, 4)
    assert len(estimate["quat_wxyz"]) == 4
    assert {"t_m", "angle_deg", "iterations", "converged", "score", "box"} <= set(estimate)


def test_estimate_writes_a_result_and_an_overlay(invoke: Invoke, tmp_path: Path) -> None:
    result = invoke("estimate")
    assert result.exit_code == 0, result.output
    assert "T_cam_obj" in result.stdout
    out = tmp_path / "posekit-out" / "photo"
    assert sorted(path.name for path in out.iterdir()) == ["overlay.png", "result.json"]
    assert_result((out / "result.json").read_text())
    overlay = cv2.imread(str(out / "overlay.png"))
    assert overlay.shape[1] > 640 and overlay.shape[0] > 480


@pytest.mark.parametrize("command", ["estimate", "refine"])
@pytest.mark.parametrize("min_score", [0.0, 2.0])
def test_what_is_not_reliable_says_so_first(
    invoke: Invoke, monkeypatch: pytest.MonkeyPatch, command: str, min_score: float
) -> None:
    monkeypatch.setattr(results, "RELIABLE_SCORE", min_score)
    monkeypatch.setattr(results, "RELIABLE_ANGLE_DEG", 180.0)
    found = invoke(command, None, "--require-reliable", json="-")
    reliable = min_score == 0.0
    assert found.exit_code == (0 if reliable else 3), found.output
    assert json.loads(found.stdout)["estimates"][0]["reliable"] is reliable, "written all the same"
    first = next(line for line in found.stderr.splitlines() if line.startswith("toy: "))
    assert first.startswith("toy: reliable:" if reliable else "toy: NOT RELIABLE:")
    assert "converged" not in found.stderr
    assert invoke(command, json="-").exit_code == 0, "it has to be asked for"


def test_quiet_and_verbose(invoke: Invoke, monkeypatch: pytest.MonkeyPatch) -> None:
    usual, quiet = (invoke("refine", None, *flags, camera=None, units="auto") for flags in ((), ("-q",)))
    assert "note: toy.ply" in usual.stderr and "debug:" not in usual.stderr
    assert "T_cam_obj" in quiet.stdout and "note:" not in quiet.stderr
    assert "warning: photo.png: its camera is not known" in quiet.stderr
    told = invoke("estimate", None, "--verbose", "--min-score", "0").stderr
    for words in ("debug: loading the networks: ", "debug: toy: 5 first poses in ", "debug: toy: pose 1 of 5: rank "):
        assert words in told, told
    front = CliRunner().invoke(app, ["-q", "estimate", "a.png", "--model", "b.ply", "--least", "0"])
    assert front.exit_code == 1 and front.stderr.startswith("error:"), "before the command too; the notice is a note"
    both = CliRunner().invoke(app, ["doctor", "-q", "-v"])
    assert both.exit_code == 2 and "--quiet and --verbose" in both.stderr


def test_json_on_standard_output_is_alone_there(invoke: Invoke, tmp_path: Path) -> None:
    result = invoke("estimate", json="-")
    assert result.exit_code == 0, result.output
    assert_result(result.stdout)
    assert "T_cam_obj" in result.stderr
    assert not list(tmp_path.iterdir())


def test_json_into_a_file(invoke: Invoke, tmp_path: Path) -> None:
    assert invoke("estimate", json=tmp_path / "pose.json", out=tmp_path / "out").exit_code == 0
    assert_result((tmp_path / "pose.json").read_text())
    assert (tmp_path / "out" / "overlay.png").exists()


def test_an_occupied_folder_is_not_touched_unasked(invoke: Invoke, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "notes.txt").write_text("mine")
    result = invoke("estimate", out="out")
    assert_fails(result, "holds files", "--force")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["notes.txt"]
    assert invoke("estimate", None, "--force", out="out").exit_code == 0
    assert (tmp_path / "out" / "notes.txt").read_text() == "mine"
    assert (tmp_path / "out" / "result.json").exists()


def test_estimate_from_a_mask(invoke: Invoke, folder: Path) -> None:
    result = invoke("estimate", box=None, mask=folder / "mask.png", json="-")
    assert json.loads(result.stdout)["estimates"][0]["detection"]["source"] == "mask"


@pytest.mark.parametrize(
    ("mask_from", "source"), [("none", "box"), ("grabcut", "box+grabcut"), ("filled", "box+filled")]
)
def test_estimate_says_where_the_mask_is_from(invoke: Invoke, mask_from: str, source: str) -> None:
    result = invoke("estimate", mask_from=mask_from, json="-")
    assert json.loads(result.stdout)["estimates"][0]["detection"]["source"] == source


@pytest.mark.parametrize("command", ["estimate", "refine"])
def test_the_same_input_gives_the_same_pose(command: str, folder: Path, invoke: Invoke, tmp_path: Path) -> None:
    """In another process too, and whatever was drawn at random before."""
    call = [command, str(folder / "photo.png"), "--model", str(folder / "toy.ply"), "--camera", CAMERA]
    call += ["--weights", str(folder / "untrained"), "--iterations", "2", "--threads", "1", "--json", "-"]
    call += ["--box", "251,139,456,294"] if command == "estimate" else ["--pose", str(folder / "pose.json")]
    alone = python("-m", "posekit", *call)
    assert alone.returncode == 0, alone.stderr
    np.random.seed(7)  # noqa: NPY002 - the global one
    torch.manual_seed(7)
    here = CliRunner().invoke(app, call)
    first, second = (json.loads(r.stdout)["estimates"][0] for r in (alone, here))
    assert first["T_cam_obj"] == second["T_cam_obj"] and first["score"] == second["score"]


def test_an_unknown_camera_is_warned_of(invoke: Invoke) -> None:
    result = invoke("estimate", camera=None)
    assert result.exit_code == 0
    assert "warning: photo.png: its camera is not known" in result.stderr


def test_refine_takes_what_estimate_wrote(invoke: Invoke, tmp_path: Path) -> None:
    assert invoke("refine", json="-", stop="fixed", iterations=1).exit_code == 0
    assert invoke("estimate", out="first").exit_code == 0
    result = invoke("refine", pose="first/result.json")
    assert result.exit_code == 0, result.output
    assert_result((tmp_path / "posekit-out" / "photo-refined" / "result.json").read_text())


def test_what_the_mesh_and_the_picture_do_not_allow_is_said_once(example: Example) -> None:
    plain = replace(example.model, colors=None)
    near = results.Estimate(example.T_cam_obj, 0.1, 1, True, 0.9, (10.0, 10.0, 50.0, 30.0), "toy")
    far = replace(near, box=(10.0, 10.0, 33.0, 49.0))
    assert limits(example.model, [near]) == []
    assert limits(plain, []) == [], "nothing was found, so nothing is uncertain"
    [colours] = limits(plain, [near, near])
    assert "has no colours" in colours
    [size] = limits(example.model, [near, far, far])
    assert "only 39 pixels large 2 of 3 times" in size


def test_a_symmetry_that_nobody_told_is_noted(invoke: Invoke, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    square = trimesh.creation.box((0.06, 0.06, 0.1))
    square.export(tmp_path / "post.ply")
    options = {"model": tmp_path / "post.ply", "units": "m", "json": "-"}
    told = invoke("refine", **options)
    assert "post looks the same after half a turn about its x axis, half a turn" in " ".join(told.stderr.split()), (
        told.stderr
    )
    assert told.stderr.count("pass --symmetry x:2,y:2,z:4 to") == 1
    [kept] = (tmp_path / "cache" / "posekit" / "symmetries").iterdir()
    assert kept.read_text() == "x:2,y:2,z:4\n"
    for stated in ("none", "z:4", "detect"):
        again = invoke("refine", symmetry=stated, **options)
        assert again.exit_code == 0 and "pass --symmetry" not in again.stderr
        assert (json.loads(again.stdout)["estimates"][0]["branch"] is None) == (stated == "none")
    assert "note: post.ply: looks the same after half a turn about its x axis" in again.stderr
    (tmp_path / "models_info.json").write_text(json.dumps({"post": {}}))
    assert "looks the same" not in invoke("refine", **options).stderr, "the data set knows"


def test_a_mesh_without_colours_is_told_of(invoke: Invoke, example: Example, tmp_path: Path) -> None:
    (tmp_path / "grey.ply").write_text(ply(replace(example.model, colors=np.zeros_like(example.model.vertices, "u1"))))
    lines = [
        line
        for line in (tmp_path / "grey.ply").read_text().splitlines()
        if not line.startswith(("property uchar red", "property uchar green", "property uchar blue"))
    ]
    (tmp_path / "grey.ply").write_text("\n".join(line.removesuffix(" 0 0 0") for line in lines) + "\n")
    found = invoke("refine", model=tmp_path / "grey.ply", units="m", json="-")
    assert found.exit_code == 0, found.output
    assert found.stderr.count("has no colours") == 1
    assert "has no colours" not in invoke("refine", json="-").stderr


def test_top_keeps_other_poses(invoke: Invoke) -> None:
    found = invoke("estimate", top=3, json="-")
    assert found.exit_code == 0, found.output
    [entry] = json.loads(found.stdout)["estimates"]
    assert len(entry["alternatives"]) == 2
    poses = [Pose.from_matrix(e["T_cam_obj"]) for e in (entry, *entry["alternatives"])]
    for k, pose in enumerate(poses):
        assert all(rotation_angle(pose.R.T @ other.R) > np.deg2rad(9) for other in poses[:k])
    assert "alternative 3: turned by" in found.stderr
    assert_fails(invoke("estimate", top=9), "top 9", "--hypotheses")
    assert json.loads(invoke("estimate", json="-").stdout)["estimates"][0]["alternatives"] == []


def test_running_a_line_again_writes_beside_the_first_result(invoke: Invoke, tmp_path: Path) -> None:
    for number in ("", "-2", "-3"):
        found = invoke("render-views", None, views=1, size="16x16", units="m")
        assert found.exit_code == 0, found.output
        assert str(Path(f"posekit-out{number}/toy-views/contact_sheet.png")) in found.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["posekit-out", "posekit-out-2", "posekit-out-3"]
    assert invoke("render-views", None, "--force", views=1, size="16x16", units="m").exit_code == 0
    assert len(list(tmp_path.iterdir())) == 3, "--force writes into the first"


def test_formats_for_other_programs(invoke: Invoke, folder: Path, tmp_path: Path) -> None:
    flags = [word for name in ("csv", "ros", "blender", "unity", "tum", "json") for word in ("--format", name)]
    found = invoke("refine", None, *flags, out="out")
    assert found.exit_code == 0, found.output
    names = {"objects.csv", "ros.yaml", "blender.json", "unity.json", "toy.tum", "result.json", "overlay.png"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names
    matrix = json.loads((tmp_path / "out/result.json").read_text())["estimates"][0]["T_cam_obj"]
    np.testing.assert_allclose(load_pose(tmp_path / "out/toy.tum").matrix, matrix, atol=1e-9)
    assert invoke("refine", pose=tmp_path / "out/toy.tum", json="-").exit_code == 0
    assert_fails(invoke("refine", None, "--format", "csv", json="-"), "--format csv", "--out")
    assert_fails(invoke("refine", None, "--format", "xml"), "--format xml", "blender")


def test_a_recording_for_rerun(invoke: Invoke, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = invoke("estimate", None, "--rerun", top=2, out="out")
    assert found.exit_code == 0 and "recording: out/estimate.rrd" in found.stdout, found.output
    recorded = (tmp_path / "out" / "estimate.rrd").read_bytes()
    assert recorded[:3] == b"RRF"
    for entity in (b"objects/0-toy", b"camera/image", b"alternatives/0-toy/2", b"refinement/0-toy", b"iteration"):
        assert entity in recorded
    assert not list((tmp_path / "out").glob(".*"))
    assert_fails(invoke("refine", None, "--rerun", json="-"), "--rerun with --json", "--out")
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert_fails(invoke("refine", "missing.png", "--rerun"), "posekit[rerun]")


def test_an_estimate_can_be_made_twice(invoke: Invoke, tmp_path: Path) -> None:
    assert [invoke("estimate").exit_code for _ in range(2)] == [0, 0]
    first, second = (tmp_path / name / "photo" / "result.json" for name in ("posekit-out", "posekit-out-2"))
    assert_result(first.read_text())
    assert_result(second.read_text())


def test_render_views(invoke: Invoke, example: Example, tmp_path: Path) -> None:
    result = invoke("render-views", None, views=6, size="64x48", out="views", units="m")
    assert result.exit_code == 0, result.output
    names = sorted(path.name for path in (tmp_path / "views").iterdir())
    assert names == sorted(
        [f"{k:04d}{end}.png" for k in range(6) for end in ("", "_mask")] + ["contact_sheet.png", "views.json"]
    )
    mask = cv2.imread(str(tmp_path / "views/0000_mask.png"), cv2.IMREAD_UNCHANGED)
    assert mask.shape == (48, 64)
    assert 0.05 < (mask > 0).mean() < 0.8
    about = json.loads((tmp_path / "views" / "views.json").read_text())
    (fx, _, cx), (_, fy, cy), _ = about["camera"]["K"]
    camera = Camera(fx, fy, cx, cy, about["camera"]["width"], about["camera"]["height"])
    pose = Pose.from_matrix(about["views"][0]["T_cam_obj"])
    [drawn] = Renderer().render(example.model, [pose], camera)
    assert about["views"][0]["mask"] == "0000_mask.png"
    np.testing.assert_array_equal(drawn.mask, mask > 0)


def test_render_views_and_doctor_as_json(invoke: Invoke, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = invoke("render-views", None, views=2, size="16x16", out="views", units="m", json="-")
    assert json.loads(found.stdout) == json.loads((tmp_path / "views" / "views.json").read_text())
    assert "contact_sheet.png" in found.stderr
    monkeypatch.setattr(doctor, "examine", lambda: [doctor.Finding("OpenGL", "none", "problem", "install it")])
    report = CliRunner().invoke(app, ["doctor", "--json", "-"])
    entry = {"topic": "OpenGL", "text": "none", "state": "problem", "todo": "install it"}
    assert json.loads(report.stdout)["findings"] == [entry] and json.loads(report.stdout)["problems"] == 1
    assert report.exit_code == 1 and "-> install it" in report.stderr


def test_demo(invoke: Invoke, folder: Path, tmp_path: Path) -> None:
    arguments = ["demo", "--weights", str(folder / "untrained")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "true error" in result.stdout
    assert "T_cam_obj" in result.stdout
    assert str(Path("posekit-out/demo/overlay.png")) in result.stdout
    assert (tmp_path / "posekit-out/demo/overlay.png").stat().st_size > 10_000
    assert_fails(CliRunner().invoke(app, [*arguments, "--out", "posekit-out/demo"]), "--force")


def test_doctor_reports_every_part(monkeypatch: pytest.MonkeyPatch) -> None:
    result = CliRunner().invoke(app, ["doctor"])
    for topic in ("OpenGL", "torch", "OpenVINO", "weights lite"):
        assert topic in result.stdout
    assert (result.exit_code == 1) == ("problem" in result.stdout)


def test_doctor_fails_where_something_essential_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_opengl", lambda: [doctor.Finding("OpenGL", "none", "problem", "apt-get install it")])
    result = CliRunner().invoke(app, ["doctor"])
    assert result.exit_code == 1
    assert "-> apt-get install it" in result.stdout


def test_doctor_says_where_torchs_cuda_build_is_of_no_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.version, "cuda", "12.8")
    [finding] = doctor._torch()
    assert finding.state == "note" and "--index-url https://download.pytorch.org/whl/cpu" in finding.todo
    monkeypatch.setattr(torch.version, "cuda", None)
    [finding] = doctor._torch()
    assert finding.state == "ok"


def test_doctor_names_opengl_that_does_not_work() -> None:
    result = python("-m", "posekit", "doctor", env={**os.environ, "POSEKIT_GL": "nonsense"})
    assert result.returncode == 1
    assert "nonsense" in result.stdout


# --- failure ----------------------------------------------------------------------------------------------------


def assert_fails(result: Result, *texts: str) -> None:
    """Exit code 1, nothing on standard output, and one line that names the trouble."""
    assert result.exit_code == 1, result.output
    assert result.stdout == ""
    lines = [line for line in result.stderr.splitlines() if line.startswith("error:")]
    assert len(lines) == 1
    assert "Traceback" not in result.stderr
    for text in texts:
        assert text in lines[0], lines[0]


def picture(path: Path, width: int, height: int) -> Path:
    cv2.imwrite(str(path), np.full((height, width, 3), 128, np.uint8))
    return path


def png_header(path: Path, width: int, height: int) -> Path:
    """A PNG that claims a size, its checksums sound, with no pixels in it."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b""))
    return path


def cut(path: Path, source: Path) -> Path:
    path.write_bytes(source.read_bytes()[:5000])
    return path


def text(path: Path, content: str) -> Path:
    path.write_text(content)
    return path


def ascii_ply(vertices: list[str], faces: list[str]) -> str:
    head = (
        f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
    )
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    return head + "\n".join([*vertices, *faces]) + "\n"


CORNERS = ["0 0 0", "0.1 0 0", "0 0.1 0", "0 0 0.1"]
FACES = ["3 0 1 2", "3 0 1 3", "3 0 2 3", "3 1 2 3"]

# What is wrong, the option (or the image), how to make its value in a folder (with the good inputs at hand), and words
# of the message.
BAD_INPUT: list[tuple[str, str, Callable[[Path, Path], object], tuple[str, ...]]] = [
    ("no image", "image", lambda d, _: d / "nowhere.png", ("nowhere.png", "check the path")),
    ("a folder", "image", lambda d, _: d, ("holds no pictures",)),
    ("no picture", "image", lambda d, _: text(d / "notes.png", "hello"), ("notes.png", "not a picture")),
    ("truncated", "image", lambda d, good: cut(d / "cut.png", good / "photo.png"), ("cut.png", "damaged")),
    ("0x0 pixels", "image", lambda d, _: png_header(d / "none.png", 0, 0), ("none.png",)),
    ("1x1 pixel", "image", lambda d, _: picture(d / "dot.png", 1, 1), ("1x1", "at least")),
    ("20000x20000 pixels", "image", lambda d, _: png_header(d / "huge.png", 20_000, 20_000), ("huge.png", "at most")),
    ("no mesh", "model", lambda d, _: d / "nowhere.ply", ("nowhere.ply",)),
    ("an empty file", "model", lambda d, _: text(d / "empty.ply", ""), ("empty.ply", "empty")),
    ("an empty mesh", "model", lambda d, _: text(d / "void.ply", ascii_ply([], [])), ("void.ply",)),
    ("NaN", "model", lambda d, _: text(d / "nan.ply", ascii_ply([*CORNERS[:3], "nan 0 0"], FACES)), ("nan.ply", "NaN")),
    ("no faces", "model", lambda d, _: text(d / "points.ply", ascii_ply(CORNERS, [])), ("points.ply", "no faces")),
    ("one face", "model", lambda d, _: text(d / "one.ply", ascii_ply(CORNERS, FACES[:1])), ("one.ply", "face")),
    ("a missing texture", "model", lambda d, _: untextured_obj(d), ("cube.obj", "paint.png")),
    ("other units", "units", lambda *_: "mm", ("toy.ply", "--units m")),
    ("a box beside", "box", lambda *_: "700,10,720,30", ("box 700,10,720,30", "outside", "640x480")),
    ("a box inside out", "box", lambda *_: "300,200,100,100", ("box 300,200,100,100", "inside out")),
    ("no box", "box", lambda *_: "here", ("'here'", "x0,y0,x1,y1")),
    ("box and mask", "mask", lambda _, good: good / "mask.png", ("--box and --mask",)),
    ("a camera of zeros", "camera", lambda *_: "0,0,0,0", ("focal length", "positive")),
    ("K of zeros", "camera", lambda d, _: text(d / "K.json", str([[0, 0, 0]] * 3)), ("K.json", "focal length")),
    ("no camera", "camera", lambda *_: "nowhere.json", ("nowhere.json",)),
    ("no weights", "weights", lambda d, _: d / "nowhere", ("no weights",)),
    ("another preset", "preset", lambda *_: "giant", ("giant",)),
    ("no hypotheses", "hypotheses", lambda *_: 0, ("hypothesis",)),
    ("no iterations", "iterations", lambda *_: 0, ("iterations",)),
    ("no symmetry", "symmetry", lambda *_: "round", ("'round'", "z:2")),
    ("a file as folder", "out", lambda d, _: text(d / "taken", ""), ("taken", "file")),
    ("a folder as JSON", "json", lambda d, _: d, ("folder",)),
    ("JSON into nowhere", "json", lambda d, _: d / "nowhere" / "pose.json", ("nowhere", "folder")),
]


def untextured_obj(folder: Path) -> Path:
    text(folder / "cube.mtl", "newmtl paint\nmap_Kd paint.png\n")
    corners = "".join(f"v {c}\n" for c in CORNERS) + "vt 0 0\nvt 1 0\nvt 0 1\n"
    faces = "f 1/1 2/2 3/3\nf 1/1 2/2 4/3\nf 1/1 3/2 4/3\nf 2/1 3/2 4/3\n"
    return text(folder / "cube.obj", f"mtllib cube.mtl\n{corners}usemtl paint\n{faces}")


@pytest.mark.parametrize(
    ("option", "make", "words"), [case[1:] for case in BAD_INPUT], ids=[case[0] for case in BAD_INPUT]
)
def test_bad_input(
    option: str,
    make: Callable[[Path, Path], object],
    words: tuple[str, ...],
    invoke: Invoke,
    folder: Path,
    tmp_path: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    value = make(tmp_path_factory.mktemp("bad"), folder)
    result = invoke("estimate", value) if option == "image" else invoke("estimate", None, **{option: value})
    assert_fails(result, *words)
    assert not list(tmp_path.iterdir()), "something was written"


def test_a_mask_of_another_size(invoke: Invoke, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    mask = picture(tmp_path_factory.mktemp("bad") / "small.png", 64, 48)
    assert_fails(invoke("estimate", box=None, mask=mask), "64x48", "640x480")
    assert not list(tmp_path.iterdir())


def test_an_empty_mask(invoke: Invoke, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("bad") / "black.png"
    cv2.imwrite(str(path), np.zeros((480, 640), np.uint8))
    assert_fails(invoke("estimate", box=None, mask=path), "empty")


@pytest.mark.parametrize("content", ["", "{}", '{"T_cam_obj": [[1, 2], [3, 4]]}', '{"estimates": []}'])
def test_refine_without_a_pose(
    content: str, invoke: Invoke, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    pose = text(tmp_path_factory.mktemp("bad") / "no-pose.json", content)
    assert_fails(invoke("refine", pose=pose), "no-pose.json", "T_cam_obj")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("size", ["640", "0x480", "640x", "99999x10", "axb"])
def test_render_views_of_no_size(size: str, invoke: Invoke, tmp_path: Path) -> None:
    assert_fails(invoke("render-views", size=size), f"--size {size}", "640x480")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("views", [0, -1, 10_000_000])
def test_render_views_of_no_number(views: int, invoke: Invoke) -> None:
    assert_fails(invoke("render-views", views=views), "--views")


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write everywhere")
def test_an_unwritable_folder(invoke: Invoke, tmp_path: Path) -> None:
    (tmp_path / "closed").mkdir(mode=0o500)
    result = invoke("estimate", out="closed/out")
    assert result.exit_code == 1
    assert "error: the output folder closed/out cannot be written" in result.stderr


@pytest.mark.skipif(hasattr(os, "geteuid") and os.geteuid() == 0, reason="root may write everywhere")
@pytest.mark.parametrize("option", ["out", "json"])
def test_the_output_is_checked_before_anything_is_read(option: str, invoke: Invoke, tmp_path: Path) -> None:
    (tmp_path / "closed").mkdir(mode=0o500)
    result = invoke("estimate", "nowhere.png", **{option: "closed/new"})
    assert_fails(result, "cannot be written", "Permission denied")


@pytest.mark.parametrize(
    "command",
    [
        ("eval", "--root", "nowhere", "--out"),
        ("train", "pose", "--model", "nowhere.ply", "--out"),
        ("train", "detector", "--model", "nowhere.ply", "--out"),
        ("synth", "--models", "nowhere", "--out"),
        ("download", "lmo", "--root"),
    ],
    ids=lambda command: " ".join(command[:2]),
)
def test_every_command_checks_its_output_first(
    command: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before meshes and data sets, which are not there, and before anything is fetched."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    (tmp_path / "taken").touch()
    result = CliRunner().invoke(app, [*command, "taken/out"])
    said = " ".join(result.output.split())
    assert result.exit_code == 1 and "cannot be written" in said and "taken is a file" in said, said
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_an_output_folder_below_a_file(invoke: Invoke, tmp_path: Path) -> None:
    (tmp_path / "taken").touch()
    assert_fails(invoke("estimate", "nowhere.png", out="taken/out"), "cannot be written", "taken is a file")
    assert not list(tmp_path.glob("taken/*"))


@pytest.mark.parametrize(
    "error", [ZeroDivisionError("division by zero"), MemoryError(), KeyError("a"), OSError(5, "x")]
)
def test_what_nobody_foresaw_has_one_exit(error: Exception, invoke: Invoke, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("posekit.io.load.load_image", fail)
    assert_fails(invoke("estimate"), "something unexpected", type(error).__name__, "please report it", "--debug")


def test_errors_are_printed_as_they_are(invoke: Invoke) -> None:
    assert_fails(invoke("estimate", "[red]a[/red].png"), "[red]a[/red].png")


def test_debug_shows_the_traceback(folder: Path) -> None:
    arguments = ["estimate", "nowhere.png", "--model", str(folder / "toy.ply"), "--box", "1,2,3,4"]
    result = python("-m", "posekit", "--debug", *arguments)
    assert result.returncode == 1
    assert "Traceback" in result.stderr
    assert "ImageError" in result.stderr
    result = python("-m", "posekit", *arguments)
    assert (result.returncode, result.stdout) == (1, "")
    assert result.stderr.count("\n") == 1


def test_wrong_usage_is_exit_code_2() -> None:
    assert CliRunner().invoke(app, ["estimate"]).exit_code == 2
    assert CliRunner().invoke(app, ["estimate", "a.png", "--model", "b.ply", "--init", "guess"]).exit_code == 2


def listen_to_interrupts() -> None:
    """A shell's background jobs, and what they start, ignore SIGINT; what Ctrl-C reaches does not."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_interrupt_is_exit_code_130(folder: Path, tmp_path: Path) -> None:
    """Ctrl-C in the middle of an endless refinement."""
    command = [sys.executable, "-m", "posekit", "refine", str(folder / "photo.png"), "--model", str(folder / "toy.ply")]
    command += ["--pose", str(folder / "pose.json"), "--camera", CAMERA, "--weights", str(folder / "untrained")]
    command += ["--update", "regression", "--stop", "fixed", "--iterations", "100000000"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path,
                               preexec_fn=listen_to_interrupts)  # fmt: skip
    assert process.stderr is not None
    assert process.stderr.readline().startswith("note: toy.ply")  # the command runs
    time.sleep(3)
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=30)
    # ended by the signal itself, where it came while a library was being imported: shells show 130 for both
    assert process.returncode in (130, -signal.SIGINT) and stdout == ""
    assert "Traceback" not in stderr or process.returncode < 0
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("old", "new"), [(["--least", "0.3"], "--min-score"), (["--no-contour"], "--no-mask-edge")])
def test_an_options_former_name_works_with_a_notice(invoke: Invoke, old: list[str], new: str) -> None:
    result = invoke("estimate", "missing.png", "--model", "missing.ply", *old)
    assert f"{old[0]} is now called {new}" in result.stderr
    assert result.exit_code == 1 and "missing.png" in result.stderr  # the option was taken

"""The documented form of what is written as JSON, held against what the commands write."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycocotools.mask
import pytest
from jsonschema import Draft202012Validator, ValidationError
from typer.testing import CliRunner

from posekit.cli.app import app
from posekit.detect.external import DetectionsFile
from posekit.errors import PromptError
from posekit.io.load import load_pose, load_view
from posekit.mesh.model import ObjectModel
from posekit.nets.weights import build, save_networks
from posekit.render import Renderer
from posekit.results import SCHEMA_VERSION, Detection, Source, check_schema, document_to_json, estimates_from_json
from posekit.synth.example import Example, make_example, ply
from posekit.view import View

SCHEMA = json.loads(files("posekit").joinpath("schema/result.schema.json").read_text(encoding="utf-8"))
DOCS = Path(__file__).parent.parent / "docs" / "result-json.md"
CAMERA = "610,610,322,236"
MASKED = (260.0, 140.0, 450.0, 290.0)


@pytest.fixture(scope="module")
def example() -> Example:
    return make_example(Renderer())


@pytest.fixture(scope="module")
def folder(example: Example, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("schema")
    (folder / "frames").mkdir()
    for name in ("photo.png", "frames/000001.png", "frames/000002.png"):
        cv2.imwrite(str(folder / name), example.view.image[..., ::-1])
    (folder / "frames" / "000003.png").write_bytes(b"no picture")
    (folder / "toy.ply").write_text(ply(example.model))
    (folder / "pose.json").write_text(json.dumps({"T_cam_obj": example.T_cam_obj.matrix.tolist()}))
    (folder / "lens.json").write_text(json.dumps(
        {"K": [[610, 0, 322], [0, 610, 236], [0, 0, 1]], "dist_coeffs": [0.1, 0, 0, 0], "width": 640, "height": 480}
    ))  # fmt: skip
    save_networks(folder / "untrained", build("lite"), {"trained on": "nothing"})
    return folder


def run(folder: Path, command: str, source: str, *flags: object, camera: object = CAMERA) -> str:
    """What a command writes on standard output."""
    arguments = [command, folder / source, "--model", folder / "toy.ply", "--camera", camera, *flags]
    arguments += ["--weights", folder / "untrained", "--threads", 1] if command != "detect" else []
    done = CliRunner().invoke(app, [str(word) for word in arguments])
    assert done.exit_code == 0, done.output
    return done.stdout


def properties(schema: Any) -> Iterator[tuple[str, Any]]:
    """Every entry that the schema names, with its own schema."""
    for key, value in schema.items() if isinstance(schema, dict) else enumerate(schema):
        if key == "properties" and "if" not in schema:
            yield from value.items()
        if isinstance(value, (dict, list)):
            yield from properties(value)


def check(document: Any) -> None:
    """The schema holds, and every entry that is written is named by it."""
    Draft202012Validator(SCHEMA).validate(document)
    assert list(document)[:2] == ["schema", "schema_version"], "the form comes first"
    known = {name for name, _ in properties(SCHEMA)}

    def names(value: Any) -> Iterator[str]:
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            if isinstance(value, dict):
                yield key
            if isinstance(item, (dict, list)) and key not in ("timings_s", "versions"):
                yield from names(item)

    assert set(names(document)) <= known


def test_the_schema_is_one() -> None:
    Draft202012Validator.check_schema(SCHEMA)
    described = [(name, bool({"description", "$ref"} & set(s))) for name, s in properties({**SCHEMA, "allOf": []})]
    assert len(described) > 40 and all(ok for _, ok in described), "every entry says what it is"


def test_the_page_names_every_entry() -> None:
    page = DOCS.read_text(encoding="utf-8")
    assert not [name for name, _ in properties(SCHEMA) if f"`{name}`" not in page]


def test_estimate_and_refine_write_what_the_schema_says(folder: Path) -> None:
    box = ("--box", "251,139,456,294", "--hypotheses", 2, "--top", 2, "--iterations", 1, "--json", "-")
    found = json.loads(run(folder, "estimate", "photo.png", *box))
    check(found)
    assert found["schema"] == "posekit-result" and found["estimates"][0]["alternatives"]
    pose = ("--pose", folder / "pose.json", "--symmetry", "z:2", "--iterations", 1, "--json", "-")
    found = json.loads(run(folder, "refine", "photo.png", *pose, camera=folder / "lens.json"))
    check(found)
    assert found["estimates"][0]["branch"] == "given" and "undistorted_from" in found["camera"]


def test_track_writes_what_the_schema_says(folder: Path, tmp_path: Path) -> None:
    flags = ("--pose", folder / "pose.json", "--runtime", "torch", "--out", tmp_path / "out", "--no-overlay")
    run(folder, "track", "frames", *flags)
    lines = [json.loads(line) for line in (tmp_path / "out" / "poses.jsonl").read_text().splitlines()]
    assert len(lines) == 3 and "problem" in lines[2] and lines[0]["T_cam_obj"] is not None
    for line in lines:
        check(line)
        assert line["schema"] == "posekit-frame"


def test_frames_of_the_first_version_are_still_of_the_form() -> None:
    frame = {"frame": 0, "model": "toy", "state": "restarted", "reliable": True, "T_cam_obj": None, "angle_deg": None,
             "score": None}  # fmt: skip
    old = {"schema": "posekit-frame", "schema_version": 1, **frame}
    check(old)
    check_schema(old)
    newest = json.loads(document_to_json("posekit-frame", frame))
    assert newest["schema_version"] == 2
    check_schema(newest)
    with pytest.raises(PromptError, match="versions up to 2"):
        check_schema({**newest, "schema_version": 3})


class Finder:
    """Stands for a detector."""

    def detect(self, view: View, models: Sequence[ObjectModel]) -> list[Detection]:
        mask = np.zeros(view.image.shape[:2], np.bool_)
        mask[140:290, 260:450] = True
        return [
            Detection((1.0, 2.0, 30.0, 40.0), None, 0.3, "toy"),
            Detection(MASKED, mask, 0.9, "toy", Source.TRAINED),
        ]


def test_detect_writes_what_the_schema_says(folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("posekit.detect.novel.make_detector", lambda *_, **__: (Finder(), ["toy"]))
    found = json.loads(run(folder, "detect", "photo.png", "--json", "-"))
    check(found)
    first, second = found["detections"]
    assert (first["box"], first["score"], first["label"], first["source"]) == ([*MASKED], 0.9, "toy", "mask-rcnn")
    assert pycocotools.mask.decode(first["mask"]).sum() == 150 * 190 and second["mask"] is None
    assert not list(tmp_path.iterdir()), "no folder unless --out asks for one"
    assert "toy: score 0.90" in run(folder, "detect", "photo.png", "--json", "detections.json", "--out", "out")
    assert json.loads((tmp_path / "detections.json").read_text())["detections"] == found["detections"]
    assert (tmp_path / "out" / "coco.json").exists()

    for camera in (CAMERA, str(folder / "lens.json")):  # read back, they are of the undistorted picture already
        view, model = load_view(folder / "photo.png", camera), ObjectModel.load(folder / "toy.ply", units="m")
        written = run(folder, "detect", "photo.png", "--json", "-", camera=camera)
        (tmp_path / "detections.json").write_text(written)
        best, other = DetectionsFile.read(tmp_path / "detections.json", folder / "photo.png").detect(view, [model])
        assert (best.box, best.score, best.source, other.mask) == (MASKED, 0.9, Source.FILE, None)
        assert best.mask is not None and best.mask.sum() == 150 * 190
    (tmp_path / "newer.json").write_text(json.dumps({**json.loads(written), "schema_version": 2}))
    with pytest.raises(PromptError, match=r"newer\.json has schema_version 2"):
        DetectionsFile.read(tmp_path / "newer.json", folder / "photo.png")


def test_track_on_standard_output(folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    flags = ("--pose", folder / "pose.json", "--runtime", "torch", "--frames", 2, "--json")
    lines = [json.loads(line) for line in run(folder, "track", "frames", *flags, "-").splitlines()]
    assert [line["frame"] for line in lines] == [0, 1] and not list(tmp_path.iterdir())
    written = run(folder, "track", "frames", *flags, "poses.jsonl")
    assert "wrote: poses.jsonl" in written and [path.name for path in tmp_path.iterdir()] == ["poses.jsonl"]
    assert len((tmp_path / "poses.jsonl").read_text().splitlines()) == 2
    arguments = ["track", "frames", "--model", "toy.ply", "--json", "-", "--rerun"]
    refused = CliRunner().invoke(app, arguments)
    assert refused.exit_code == 1 and "--rerun with --json" in refused.stderr and "--out" in refused.stderr


def test_other_documents_are_refused(folder: Path) -> None:
    for wrong in ({}, {"schema": "posekit-result", "schema_version": 1}, {"schema": "other", "schema_version": 1}):
        with pytest.raises(ValidationError):
            Draft202012Validator(SCHEMA).validate(wrong)


@pytest.fixture
def result(folder: Path) -> dict[str, Any]:
    flags = ("--pose", folder / "pose.json", "--iterations", 1, "--json", "-")
    return dict(json.loads(run(folder, "refine", "photo.png", *flags)))


def test_versions_that_are_read(result: dict[str, Any], tmp_path: Path) -> None:
    newer = json.dumps({**result, "schema_version": SCHEMA_VERSION + 1})
    with pytest.raises(PromptError, match=r"schema_version 2, and posekit .* up to 1: a newer posekit wrote it"):
        estimates_from_json(newer)
    (tmp_path / "newer.json").write_text(newer)
    with pytest.raises(PromptError, match=r"newer\.json has schema_version 2"):
        load_pose(tmp_path / "newer.json")

    old = {key: value for key, value in result.items() if not key.startswith("schema")}  # as 0.1 wrote it
    [entry] = old["estimates"]
    del entry["mask_edge_std_deg"]
    entry["contour_std_deg"] = 0.5
    [back] = estimates_from_json(json.dumps(old))
    assert back.mask_edge_std == pytest.approx(np.deg2rad(0.5))
    (tmp_path / "old.json").write_text(json.dumps(old))
    np.testing.assert_allclose(load_pose(tmp_path / "old.json").matrix, back.T_cam_obj.matrix)

"""Many pictures: lines in order, runs that go on, a bad picture among good ones, workers, poses by picture."""

from __future__ import annotations

import json
import operator
import os
import shutil
from importlib.resources import files
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from jsonschema import Draft202012Validator
from typer.testing import CliRunner, Result

from posekit.batch.pictures import pictures_of, several
from posekit.batch.start_poses import StartPoses
from posekit.cli.app import app
from posekit.detect.external import Detections
from posekit.errors import ConfigError, InputError, OutputError, PromptError
from posekit.geometry import Pose
from posekit.machines import Machines, in_order
from posekit.results import Detection, Source

SCHEMA = Draft202012Validator(
    json.loads(files("posekit").joinpath("schema/result.schema.json").read_text(encoding="utf-8"))
)


@pytest.fixture
def folder(example_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder: the example's files, and two pictures in ``photos`` with a broken one between them."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(example_folder, tmp_path, dirs_exist_ok=True)
    (tmp_path / "photos").mkdir()
    photo = cv2.imread("photo.png")
    for k in (1, 10):
        cv2.imwrite(f"photos/a{k}.png", cv2.resize(photo, (320, 240)) if k == 10 else photo)
    Path("photos/a2.png").write_bytes(b"no picture")
    return tmp_path


def invoke(command: str, *words: object) -> Result:
    return CliRunner().invoke(app, [command, *map(str, words)])


QUICK = ("--model", "toy.ply", "--weights", "untrained", "--threads", 1, "--iterations", 1)
BOX = ("--box", "120,60,230,150", "--hypotheses", 1)


def estimate(*words: object) -> Result:
    return invoke("estimate", *words, *QUICK, *BOX)


def lines_of(path: str = "out/results.jsonl") -> list[dict[str, Any]]:
    found = [json.loads(line) for line in Path(path).read_text().splitlines()]
    for line in found:
        SCHEMA.validate(line)
    return found


def without_times(document: Any) -> Any:
    if isinstance(document, dict):
        return {k: without_times(v) for k, v in document.items() if k not in ("timings_s", "seconds")}
    return [without_times(v) for v in document] if isinstance(document, list) else document


# --- lines ---


def test_a_bad_picture_is_a_line_and_the_others_go_on(folder: Path) -> None:
    result = estimate("photos", "--out", "out")
    assert result.exit_code == 1 and "error: 1 of 3 pictures could not be used" in result.stderr
    lines = lines_of()
    assert [line["image"] for line in lines] == ["photos/a1.png", "photos/a2.png", "photos/a10.png"]
    assert [len(line["estimates"]) for line in lines] == [1, 0, 1]
    assert "not a picture that posekit reads" in lines[1]["problem"] and "problem" not in lines[0]
    assert sorted(p.parent.name for p in Path("out").glob("*/overlay.png")) == ["a1", "a10"]
    assert [line.split(":")[0] for line in result.stdout.splitlines()] == [
        *(line["image"] for line in lines),
        "results",
    ]
    assert result.stderr.count("a field of view of 60 degrees") == 1, "a note is told once"

    alone = estimate("photos/a1.png", "--json", "-")
    assert without_times(json.loads(alone.stdout)) == without_times(lines[0]), "as of one picture alone"


def test_a_run_that_was_ended_goes_on(folder: Path) -> None:
    assert estimate("photos", "--out", "whole", "--no-overlay").exit_code == 1
    assert sorted(p.name for p in Path("whole").iterdir()) == ["results.jsonl", "settings.json"]
    shutil.copytree("whole", "out")
    text = Path("out/results.jsonl").read_text()
    Path("out/results.jsonl").write_text(text[: text.rindex('{"schema"') + 300])
    result = estimate("photos", "--out", "out", "--no-overlay", "--json", "-", "--workers", 1)
    assert result.exit_code == 1 and "2 of 3 pictures are done already" in result.stderr and "1 of 3" in result.stderr
    assert without_times(lines_of()) == without_times(lines_of("whole/results.jsonl"))
    assert [json.loads(line) for line in result.stdout.splitlines()] == lines_of(), "all lines"
    before = Path("out/results.jsonl").read_text()
    assert estimate("photos", "--out", "out", "--no-overlay").exit_code == 1
    assert Path("out/results.jsonl").read_text() == before, "nothing was left to do"

    for photos, words, told in (
        (
            ("photos",),
            ("--top", 2, "--hypotheses", 2),
            "hypotheses was 1, now 2; overlay was false, now true; top was 1",
        ),
        (("photos/a10.png", "photos/a1.png"), ("--no-overlay",), "line 1 of out/results.jsonl is about photos/a1.png"),
    ):
        refused = invoke("estimate", *photos, "--out", "out", *QUICK, *BOX, *words)
        assert refused.exit_code == 1 and told in refused.stderr, refused.stderr
    Path("toy.ply").write_text(Path("toy.ply").read_text() + "\n")
    assert "paths was" in estimate("photos", "--out", "out", "--no-overlay").stderr, "another mesh of that name"
    Path("other").mkdir()
    Path("other/file").touch()
    assert "no settings.json" in estimate("photos", "--out", "other").stderr
    again = estimate("photos/a1.png", "photos/a10.png", "--out", "out", "--force", "--json", "all.jsonl")
    assert again.exit_code == 0 and lines_of("all.jsonl") == lines_of() and len(lines_of()) == 2


def test_what_is_loaded_is_loaded_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from posekit.batch import jobs

    made: list[str] = []
    for name in ("Estimators", "load_meshes"):
        real = getattr(jobs, name)
        monkeypatch.setattr(jobs, name, lambda *a, _real=real, _name=name, **k: made.append(_name) or _real(*a, **k))
    assert estimate("photos/a1.png", "photos/a10.png", "photos/a1.png", "--json", "-").exit_code == 0
    assert sorted(made) == ["Estimators", "load_meshes"]
    assert not Path("posekit-out").exists(), "no folder where --json alone is given"


def test_what_concerns_all_pictures_ends_the_run(folder: Path) -> None:
    Path("toy.ply").write_text("no mesh")
    result = estimate("photos", "--out", "out")
    assert result.exit_code == 1 and "toy.ply" in result.stderr and "pictures could not" not in result.stderr
    assert not Path("out/results.jsonl").exists()
    assert "were both given" in estimate("photos", "--mask", "photo.png").stderr
    Path("empty").mkdir()
    assert "empty holds no pictures" in estimate("empty").stderr
    assert "--format and --rerun" in estimate("photos", "--json", "-", "--format", "csv").stderr


def test_require_reliable(folder: Path) -> None:
    assert estimate("photos/a1.png", "photos/a10.png", "--json", "-", "--require-reliable").exit_code == 3


def test_pictures(folder: Path) -> None:
    Path("more").mkdir()
    shutil.copy("photo.png", "more/a1.png")
    found = pictures_of([Path("photos"), Path("more/*.png"), Path("photo.png")])
    assert [p.name for p in found] == ["a1", "a2", "a10", "a1-2", "photo"]
    assert several([Path("photos")]) and several([Path("*.png")]) and several([Path("a"), Path("b")])
    assert not several([Path("photo.png")]) and not several([Path("missing.png")])
    Path("[1].png").touch()
    assert not several([Path("[1].png")]), "a file whose name looks like a glob"
    with pytest.raises(InputError, match=r"x\*\.png holds no pictures"):
        pictures_of([Path("x*.png")])


# --- workers ---


@pytest.mark.parametrize("machines", [Machines(), Machines(2), Machines(2, "local")], ids=["one", "two", "ray"])
def test_results_come_in_order(machines: Machines) -> None:
    """Ray takes some seconds to start."""
    assert list(in_order(machines, operator.neg, iter(range(30)), "again")) == [-k for k in range(30)]


def test_a_killed_worker_is_told() -> None:
    with pytest.raises(OutputError, match=r"worker process was killed .*: give it again, with fewer workers"):
        list(in_order(Machines(2), os._exit, [1], "give it again"))
    with pytest.raises(ConfigError, match="0 workers"):
        Machines(0)


def test_two_workers_do_as_one(folder: Path) -> None:
    """Their start takes some seconds: each loads the networks."""
    assert estimate("photos", "--out", "one").exit_code == 1
    result = estimate("photos", "--out", "two", "--workers", 2)
    assert result.exit_code == 1 and "1 of 3 pictures" in result.stderr
    assert without_times(lines_of("two/results.jsonl")) == without_times(lines_of("one/results.jsonl"))
    assert len(list(Path("two").glob("*/overlay.png"))) == 2


# --- refine ---


def test_refine_takes_each_pictures_poses(folder: Path) -> None:
    good = ("photos/a1.png", "photos/a10.png")
    assert estimate(*good, "--out", "out").exit_code == 0
    for pose in ("out/results.jsonl", "out"):
        found = invoke("refine", *good, "--pose", pose, "--json", "-", "--no-perturb", *QUICK)
        assert found.exit_code == 0, found.output
        for line, start in zip(map(json.loads, found.stdout.splitlines()), lines_of(), strict=True):
            SCHEMA.validate(line)
            np.testing.assert_allclose(
                line["estimates"][0]["trace"][0]["T_cam_obj"], start["estimates"][0]["T_cam_obj"], atol=1e-9
            )
    result = invoke("refine", "photos", "--pose", "out", "--out", "refined", *QUICK)
    assert result.exit_code == 1
    assert ["problem" in line for line in lines_of("refined/results.jsonl")] == [False, True, False]
    assert invoke("refine", "photos/a1.png", "--pose", "out", "--json", "-", *QUICK).exit_code == 0, "one picture too"


def test_start_poses(folder: Path) -> None:
    poses = Path("poses")
    (poses / "a1").mkdir(parents=True)
    one = {"T_cam_obj": np.eye(4).tolist()}
    (poses / "a10.json").write_text(json.dumps(one))
    np.savetxt(poses / "a3.txt", np.eye(4))
    found = StartPoses(poses)
    for name in ("a10.png", "a3.png"):
        [pose] = found.of(Path("photos") / name, "toy")
        assert isinstance(pose, Pose) and np.allclose(pose.matrix, np.eye(4))
    with pytest.raises(PromptError, match=r"poses has no pose for a1\.png: neither results\.jsonl nor a1/result\.json"):
        found.of(Path("photos/a1.png"), "toy")
    assert len(StartPoses(Path("pose.json")).of(Path("any.png"), "toy")) == 1
    lines = [{"schema": "posekit-result", "schema_version": 1, "image": f"{k}/a.png", "estimates": []} for k in "xy"]
    Path("lines.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert StartPoses(Path("lines.jsonl")).of(Path("x/a.png"), "toy") == []
    with pytest.raises(PromptError, match=r"has 2 lines about z/a\.png"):
        StartPoses(Path("lines.jsonl")).of(Path("z/a.png"), "toy")
    with pytest.raises(PromptError, match=r"no pose of toy in a\.png"):
        StartPoses(Path("lines.jsonl")).first(Path("x/a.png"), "toy")
    Path("lines.jsonl").write_text("{}\n")
    with pytest.raises(PromptError, match=r"lines\.jsonl cannot be read \(line 1 is no posekit-result"):
        StartPoses(Path("lines.jsonl"))


# --- detect ---


class Finder:
    """Stands for a detector."""

    def detect(self, view: Any, models: Any) -> list[Detection]:
        width, height = view.camera.size
        return [Detection((0.3 * width, 0.2 * height, 0.7 * width, 0.7 * height), None, 0.9, "toy", Source.TRAINED)]


def test_detections_of_many_pictures_feed_estimate(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("posekit.detect.novel.make_detector", lambda *_, **__: (Finder(), ["toy"]))
    result = invoke("detect", "photos", "--model", "toy.ply", "--out", "found")
    assert result.exit_code == 1 and "photos/a1.png: toy 0.90" in result.stdout, result.output
    lines = lines_of("found/results.jsonl")
    assert [len(line["detections"]) for line in lines] == [1, 0, 1] and "problem" in lines[1]
    assert len(list(Path("found").glob("*/overlay.png"))) == 2
    words = ("photos/a1.png", "photos/a10.png", "--detections", "found/results.jsonl", "--hypotheses", 1)
    estimated = invoke("estimate", *words, "--json", "-", *QUICK)
    assert estimated.exit_code == 0, estimated.output
    for line, k in zip(map(json.loads, estimated.stdout.splitlines()), (0, 2), strict=True):
        [found] = line["estimates"]
        assert found["detection"]["box"] == pytest.approx(lines[k]["detections"][0]["box"])


def test_a_file_of_detections_is_read_once_for_all_pictures(tmp_path: Path) -> None:
    entries = [
        {"scene_id": s, "image_id": k, "category_id": 1, "score": 0.5, "bbox": [10 * k + s, 0, 20, 20]}
        for s in (1, 2)
        for k in (0, 1)
    ]
    (tmp_path / "found.json").write_text(json.dumps(entries))
    read = Detections.read(tmp_path / "found.json")
    for entry in entries:
        image = tmp_path / f"{entry['scene_id']:06d}/rgb/{entry['image_id']:06d}.png"
        assert [e["bbox"] for e in read.of(image).entries] == [entry["bbox"]]
    with pytest.raises(PromptError, match="about the images 0, 1"):
        read.of(tmp_path / "000001/rgb/000007.png")
    with pytest.raises(PromptError, match="the picture is of scene 3"):
        read.of(tmp_path / "000003/rgb/000001.png")

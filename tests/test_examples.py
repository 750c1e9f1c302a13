"""Everything in examples/ runs as it is told there, with less work than usual."""

from __future__ import annotations

import json
import re
import runpy
import sys
from pathlib import Path

import cv2
import pytest
import torch

from posekit.io.video import open_frames

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = ROOT / "examples"


def run(monkeypatch: pytest.MonkeyPatch, name: str, *arguments: object) -> None:
    """An example as a program, in this process: Python, torch and the networks' compilation are paid for once."""
    monkeypatch.setattr(sys, "argv", [f"{name}.py", *map(str, arguments)])
    threads = torch.get_num_threads()
    try:
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    finally:
        torch.set_num_threads(threads)


def test_every_example_is_tested_and_short() -> None:
    text = Path(__file__).read_text()
    for file in sorted(EXAMPLES.iterdir()):
        assert f'"{file.stem}"' in text or file.suffix == ".ipynb", f"{file.name} has no test"
        assert file.suffix == ".ipynb" or len(file.read_text().splitlines()) < 60, f"{file.name} is too long"


def test_one_picture(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(monkeypatch, "one_picture", tmp_path)
    assert capsys.readouterr().out.startswith("reliable: expected rotation error")
    assert len(json.loads((tmp_path / "result.json").read_text())["estimates"]) == 1
    assert cv2.imread(str(tmp_path / "overlay.png")).shape[1] > 640


def test_several_objects(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(monkeypatch, "several_objects", tmp_path)
    assert capsys.readouterr().out.count("rotation error") == 3
    assert (tmp_path / "overlay.png").is_file()


def test_render_views(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(monkeypatch, "render_views", tmp_path)
    shown = cv2.imread(str(tmp_path / "mask.png"), cv2.IMREAD_GRAYSCALE) > 0
    assert capsys.readouterr().out.startswith(f"{shown.sum()} pixels show the object")
    assert cv2.imread(str(tmp_path / "sheet.png")).shape[1] > 960


def test_track_video(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    run(monkeypatch, "track_video", tmp_path, 5)
    lines = [json.loads(line) for line in (tmp_path / "poses.jsonl").read_text().splitlines()]
    assert [line["frame"] for line in lines] == [0, 1, 2, 3, 4]
    assert {line["state"] for line in lines} == {"tracked"}
    assert sum(frame.image is not None for frame in open_frames(str(tmp_path / "tracked.mp4"), "610,610,322,236")) == 5


def test_robot_loop(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    run(monkeypatch, "robot_loop", 5)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 5
    assert "in the robot's frame" in lines[0]
    assert "the robot waits" in lines[2]  # the hidden frame


def test_train_on_your_cad(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(monkeypatch, "train_on_your_cad", tmp_path, 1)
    assert {"lite.safetensors", "lite.toml"} <= {file.name for file in (tmp_path / "weights").iterdir()}
    assert "step 1: rotation error" in capsys.readouterr().out


def test_evaluate_bop(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(monkeypatch, "evaluate_bop", tmp_path, 2)
    assert (tmp_path / "refine/results.json").is_file()
    assert "report.html" in capsys.readouterr().out


def test_notebook(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notebook = json.loads((EXAMPLES / "quickstart.ipynb").read_text())
    assert notebook["nbformat"] == 4
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for number, cell in enumerate(cell for cell in notebook["cells"] if cell["cell_type"] == "code"):
        assert cell["outputs"] == [], "the notebook is kept without its outputs"
        exec(compile("".join(cell["source"]), f"quickstart.ipynb, code cell {number}", "exec"), names)
    assert (tmp_path / "posekit-out/quickstart/result.json").is_file()


def test_troubleshooting_quotes_messages_that_exist() -> None:
    source = "\n".join(file.read_text() for file in sorted((ROOT / "src/posekit").rglob("*.py")))
    joined = re.sub(r"""["']\s*\n\s*f?["']""", "", source)  # texts that go on in the next line
    quoted = re.findall(r"^\*\*`(.+)`\*\*$", (ROOT / "docs/troubleshooting.md").read_text(), re.MULTILINE)
    assert len(quoted) > 10
    for message in quoted:
        for part in message.split("..."):
            assert part.strip(" :") in joined, f"no message has {part!r} (of {message!r})"


@pytest.mark.parametrize(
    "page",
    ["README.md", *(f"docs/{n}.md" for n in ("quickstart", "your-object", "calibration", "troubleshooting", "view"))],
)
def test_links_and_pictures_exist(page: str) -> None:
    links = re.findall(r"\]\(([^)#]+)\)", (ROOT / page).read_text())
    assert links
    for link in links:
        assert (ROOT / page).parent.joinpath(link).exists(), f"{page} links to {link}, which does not exist"


def test_pictures_are_small() -> None:
    pictures = list((ROOT / "docs/pictures").iterdir())
    assert pictures and all(file.stat().st_size <= 200_000 for file in pictures)

"""What README and docs show: Python blocks run, commands run or at least exist, configurations are read, and the site
is built from them without a warning.

A shell block after ``<!-- not run by the tests: REASON -->`` needs data or hours; its commands are only parsed.
"""

from __future__ import annotations

import logging
import re
import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import click
import cv2
import numpy as np
import pytest
import torch
import trimesh
import yaml
from typer.main import get_command
from typer.testing import CliRunner

from posekit import __version__
from posekit.cli.app import RENAMED, app
from posekit.io.video import VideoWriter
from posekit.render import Renderer
from posekit.synth.example import Example, make_example, make_film, ply
from posekit.train.config import read_config

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
ELSEWHERE = {"calibration.md": "test_calibrate.py"}  # pages whose blocks another test runs
UNMARKED = {"calibration.md", "log.md"}  # pages whose commands are run elsewhere, or are history
# what makes a command short: of an option given twice the last one counts
SHORTER = {
    "estimate": ["--hypotheses", "1", "--iterations", "1"],
    "refine": ["--iterations", "1"],
    "detect": ["--no-verify"],
    "track": ["--pose", "pose.txt", "--runtime", "torch"],
}


class Block(NamedTuple):
    page: str
    language: str  # "shell" for indented blocks too
    code: str
    run: bool

    @property
    def commands(self) -> list[str]:
        lines = [line.split(" | ")[0] for line in self.code.splitlines()]
        return [line for line in lines if line.startswith("posekit ")] if self.language == "shell" else []


def blocks(page: Path) -> Iterator[Block]:
    text = page.read_text(encoding="utf-8")
    mark = r"^(?P<mark><!-- not run by the tests: .+ -->\n\n?)?"
    for found in re.finditer(mark + r"```(?P<language>\w*)\n(?P<code>.*?)^```$", text, re.MULTILINE | re.DOTALL):
        yield Block(page.name, found["language"] or "shell", found["code"], not found["mark"])
    outside = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    for found in re.finditer(mark + r"(?P<code>(?:^    \S.*\n?)+)", outside, re.MULTILINE):
        yield Block(page.name, "shell", re.sub(r"^    ", "", found["code"], flags=re.MULTILINE), not found["mark"])


BLOCKS = [block for page in PAGES for block in blocks(page)]
PYTHON = sorted({block.page for block in BLOCKS if block.language == "python"} - set(ELSEWHERE))
COMMANDS = sorted({command for block in BLOCKS for command in block.commands if block.page not in UNMARKED})
RUN = list(dict.fromkeys(c for b in BLOCKS if b.run and b.page not in UNMARKED for c in b.commands))


@pytest.fixture(scope="module")
def example() -> Example:
    return make_example(Renderer())


@pytest.fixture(scope="module")
def folder(example: Example, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the pages' commands and programs are given: the synthetic example under the names they use."""
    folder = tmp_path_factory.mktemp("docs")
    renderer = Renderer()
    cv2.imwrite(str(folder / "photo.jpg"), example.view.image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 97])
    [drawn] = renderer.render(example.model, [example.T_cam_obj], example.view.camera)
    assert drawn.mask is not None
    cv2.imwrite(str(folder / "mask.png"), drawn.mask.astype("uint8") * 255)
    for name in ("part.ply", "mug.ply"):
        (folder / name).write_text(ply(example.model))
    np.savetxt(folder / "pose.txt", next(make_film(renderer, 1)).T_cam_obj.matrix)
    trimesh.Trimesh(example.model.vertices, example.model.faces).export(folder / "part.glb")
    vertices = "".join("v {:.6f} {:.6f} {:.6f}\n".format(*vertex) for vertex in example.model.vertices)
    faces = "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in example.model.faces)
    (folder / "part.obj").write_text(vertices + faces)
    with VideoWriter(folder / "video.mp4", 30, quality=10) as writer:
        for shown in make_film(renderer, 2):
            writer.write(shown.view.image)
    return folder


@pytest.mark.parametrize("page", PYTHON)
def test_python_blocks_run(
    page: str, folder: Path, example: Example, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(shutil.copytree(folder, tmp_path / "docs"))
    names: dict[str, Any] = {
        "model": example.model,
        "image": example.view.image,
        "camera": example.view.camera,
        "first_pose": example.T_cam_obj,
        "T_cam_obj": example.T_cam_obj,
        "network": lambda file: [file],
    }
    # what another detector would give, in the shape of supervision's detections
    found = SimpleNamespace(
        xyxy=np.array([example.box]), confidence=np.array([0.9]), mask=None, class_id=None, data={"class_name": ["mug"]}
    )
    stand_in: Any = ModuleType("supervision")
    stand_in.Detections = SimpleNamespace(from_ultralytics=lambda result: found)
    monkeypatch.setitem(sys.modules, "supervision", stand_in)
    for block in BLOCKS:
        if block.page == page and block.language == "python":
            exec(compile(block.code, page, "exec"), names)


def test_blocks_that_run_elsewhere_do() -> None:
    for page, test in ELSEWHERE.items():
        assert f"docs/{page}" in (ROOT / "tests" / test).read_text()


def test_commands_run(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the pages' order, one after the other in one folder: refine takes what estimate wrote. Some 20 seconds."""
    monkeypatch.chdir(shutil.copytree(folder, tmp_path / "docs"))
    threads = torch.get_num_threads()
    for command in RUN:
        args = shlex.split(command, comments=True)[1:]
        result = CliRunner().invoke(app, [*args, *SHORTER.get(args[0], [])])
        assert result.exit_code == 0, f"{command}\n{result.output}"
    torch.set_num_threads(threads)


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_have_the_options_that_are_shown(command: str) -> None:
    words = shlex.split(command, comments=True)[1:]
    group: Any = get_command(app)
    while hasattr(group, "commands") and not words[0].startswith("-"):
        assert words[0] in group.commands, f"there is no command {words[0]!r} in: {command}"
        group, words = group.commands[words[0]], words[1:]
    known = {name for parameter in group.params for name in (*parameter.opts, *parameter.secondary_opts)}
    assert {word.partition("=")[0] for word in words if word.startswith("--")} <= known


def test_options_named_in_texts_exist() -> None:
    def options(command: Any) -> Iterator[str]:
        for parameter in command.params:
            yield from (*parameter.opts, *parameter.secondary_opts)
        for each in getattr(command, "commands", {}).values():
            yield from options(each)

    known = {*options(get_command(app)), "--help"}
    for file in (ROOT / "benchmarks").glob("*.py"):
        known |= set(re.findall(r'"(--[a-z][a-z-]*)"', file.read_text()))
    for page in PAGES:
        if page.name in ("log.md", "results.md", "releasing.md"):
            continue
        for span in re.findall(r"`([^`\n]*--[^`\n]*)`", page.read_text()):
            if span.startswith(("pip ", "python ", "apt-get ", "mkdocs ", "git ")):
                continue
            for name in re.findall(r"(?<!\S)--[a-z][a-z-]*", span):
                assert name in known, f"{page.name} names {name}, which no command has (now {RENAMED.get(name)})"


@pytest.mark.parametrize("block", [b for b in BLOCKS if b.language == "toml"], ids=lambda block: block.page)
def test_configurations_are_read(block: Block, tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text(block.code)
    read_config(tmp_path / "config.toml")


def test_site_is_built_without_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_MKDOCS_2_WARNING", "1")
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    config = load_config(str(ROOT / "mkdocs.yml"), site_dir=str(tmp_path / "site"))
    try:
        build(config)  # strict: a warning ends it
    except click.ClickException as error:
        pytest.fail(error.format_message())
    finally:
        logging.getLogger("mkdocs").handlers.clear()
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > len(PAGES)
    for page in pages:
        loaded = re.findall(r"<(?:script|img|link)[^>]*(?:src|href)=\"?(https?:[^\s\">]+)", page.read_text())
        assert not loaded, f"{page.name} loads {loaded}"
    assert "posekit estimate" in (tmp_path / "site/commands.html").read_text()
    assert "PoseEstimator" in (tmp_path / "site/python.html").read_text()


def test_version_is_the_same_everywhere() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == __version__
    assert len(citation["preferred-citation"]["authors"]) == 5
    assert f"## [{__version__}]" in (ROOT / "CHANGELOG.md").read_text()

"""What docs/command-line.md says holds: exit codes, NO_COLOR, completion."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.main import get_command
from typer.testing import CliRunner

from posekit.cli.app import INTERRUPTED, app
from posekit.cli.options import NOT_RELIABLE

PAGE = (Path(__file__).parent.parent / "docs" / "command-line.md").read_text(encoding="utf-8")


def test_exit_codes() -> None:
    told = {int(code): text for code, text in re.findall(r"^\| (\d+) \| (.*) \|$", PAGE, re.MULTILINE)}
    assert sorted(told) == [0, 1, 2, NOT_RELIABLE, INTERRUPTED]
    assert "--require-reliable" in told[NOT_RELIABLE] and "interrupted" in told[INTERRUPTED]
    assert CliRunner().invoke(app, ["--version"]).exit_code == 0
    assert CliRunner().invoke(app, ["estimate", "none.png", "--model", "none.ply"]).exit_code == 1
    assert CliRunner().invoke(app, ["estimate"]).exit_code == 2
    # 3 and 130: tests/test_cli.py


def test_shared_options_are_those_of_the_commands() -> None:
    shared = set(re.findall(r"`(--?[\w-]+)`", PAGE[: PAGE.index("`--json FILE`")])) - {"--out"}
    options = {name for option in get_command(app).params for name in option.opts}
    assert shared == options - {"--install-completion", "--show-completion", "--help", "-h"}
    assert {"--install-completion", "--show-completion"} <= options


@pytest.mark.parametrize(("value", "coloured"), [(None, True), ("", True), ("1", False), ("0", False)])
def test_no_color(value: str | None, coloured: bool) -> None:
    shown = CliRunner(env={"NO_COLOR": value}).invoke(app, ["estimate", "none.png", "--model", "none.ply"], color=True)
    assert (typer.style("error:", fg="red", bold=True) in shown.stderr) == coloured
    assert ("\x1b[" in shown.stderr) == coloured


@pytest.mark.parametrize(("words", "found"), [("posekit est", "estimate"), ("posekit refine --qui", "--quiet")])
def test_completion(words: str, found: str) -> None:
    asked = {"_POSEKIT_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    done = subprocess.run(
        [sys.executable, "-m", "posekit"], capture_output=True, text=True, env={**os.environ, **asked}, check=True
    )
    assert done.stdout.split() == [found]

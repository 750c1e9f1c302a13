"""The commands' progress: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time

import pytest
import rich.console

from posekit.cli import plain_lines
from posekit.cli.messages import messages, working
from posekit.cli.plain_lines import PlainLines
from posekit.cli.progress import progress_bar


def test_what_is_short_is_not_told(capsys: pytest.CaptureFixture[str]) -> None:
    with messages(quiet=False, verbose=False):
        with progress_bar("count", "text", "elapsed", "remaining", total=3) as update:
            update(advance=1, description="one")
            update(completed=3, total=3)
        with working("detecting"):
            pass
    assert capsys.readouterr() == ("", "")


def test_a_terminal_shows_text_and_counts_on_standard_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "posekit")  # as the commands have it without --quiet
    monkeypatch.setenv("TERM", "xterm")  # rich shows no bar on a dumb terminal
    monkeypatch.setattr(rich.console.Console, "is_terminal", True)
    with messages(quiet=False, verbose=False), progress_bar("count", "text") as update:
        update(completed=2, total=7, description="frames")
        print("a result")
    shown = capsys.readouterr()
    assert "2/7" in shown.err and "frames" in shown.err and shown.out == "a result\n", "what is piped stays apart"


@pytest.mark.parametrize("quiet", [False, True])
def test_elsewhere_what_takes_long_is_told_in_lines(
    quiet: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(plain_lines, "LONG", 0.02)
    monkeypatch.setattr(plain_lines, "APART", 0.02)
    monkeypatch.setattr(plain_lines, "LOOK", 0.01)
    with messages(quiet, verbose=False):
        with working("estimating") as tell:
            time.sleep(0.1)
            tell("refining duck: 5 hypotheses")
            time.sleep(0.1)
        with progress_bar("count", total=9, stage="pictures") as update:
            update(advance=2, description="a.png")
            time.sleep(0.1)
    lines = ["estimating ...", "refining duck: 5 hypotheses ...", "pictures: 2 of 9, a.png"]
    assert capsys.readouterr() == ("", "" if quiet else "".join(f"{line}\n" for line in lines))


def test_lines_are_few() -> None:
    """A stage after two seconds, then every ten if there is something new; never two lines within two seconds."""
    now = 0.0
    lines = PlainLines(lambda: now)
    told = []
    for step in range(400):
        now = step / 10
        lines.update("detecting" if now < 1 else "refining", f"{now:.0f} of 40")
        if (line := lines.due()) is not None:
            told.append((now, line))
    assert [round(at, 1) for at, _ in told] == [3.0, 13.0, 23.0, 33.0]
    assert told[1][1] == "refining: 13 of 40"
    now = 100.0
    assert lines.due() is not None
    now = 200.0
    assert lines.due() is None, "nothing new"

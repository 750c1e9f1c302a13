"""The commands' progress bar."""

from __future__ import annotations

import pytest
import rich.console

from posekit.cli.progress import progress_bar


def test_nothing_is_shown_where_there_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_bar("count", "text", "elapsed", "remaining", total=3) as update:
        update(advance=1, description="one")
        update(completed=3, total=3)
    assert capsys.readouterr() == ("", "")


def test_a_terminal_shows_text_and_counts_on_standard_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "posekit")  # as the commands have it without --quiet
    monkeypatch.setattr(rich.console.Console, "is_terminal", True)
    with progress_bar("count", "text") as update:
        update(completed=2, total=7, description="frames")
    shown = capsys.readouterr()
    assert "2/7" in shown.err and "frames" in shown.err and not shown.out

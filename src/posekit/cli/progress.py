"""What is being done and how far it is: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, Literal

from posekit.cli.messages import progress_console, wanted
from posekit.cli.plain_lines import plain_lines

Column = Literal["count", "text", "elapsed", "remaining"]


class _Counted:
    """The bar's numbers as a text."""

    def __init__(self, total: float | None) -> None:
        self.completed, self.total = 0.0, total

    def update(self, completed: float | None = None, advance: float = 0, total: float | None = None, **_: Any) -> None:
        self.completed = (self.completed if completed is None else completed) + advance
        self.total = self.total if total is None else total

    def __str__(self) -> str:
        if self.total is None:
            return f"{self.completed:.0f}"
        return f"{self.completed:.0f} of {self.total:.0f}" if self.total > 1 else f"{100 * self.completed:.0f} %"


@contextmanager
def progress_bar(
    *columns: Column, total: float | None = None, text: str = "", stage: str = "working"
) -> Iterator[Callable[..., None]]:
    """Progress on standard error while the block runs: a bar on a terminal, else plain lines; nothing with --quiet.

    columns: what stands behind the bar, in this order. total: steps in all, None where that is not known yet. stage:
    what is being done, for the lines. Gives a function that takes what rich's ``Progress.update`` takes: completed,
    advance, total, description (the text); and ``stage``, where that changes.
    """
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    made: dict[Column, Callable[[], ProgressColumn]] = {
        "count": MofNCompleteColumn,
        "text": lambda: TextColumn("{task.description}"),
        "elapsed": TimeElapsedColumn,
        "remaining": TimeRemainingColumn,
    }
    console = progress_console()
    shown = (BarColumn(), *(made[name]() for name in columns))
    counted = _Counted(total)
    with (
        Progress(
            *shown,
            console=console,
            transient=True,
            disable=console.quiet,
            redirect_stdout=sys.stdout.isatty(),  # what is piped must not go where the bar is
        ) as bar,
        plain_lines(wanted() and not console.is_terminal) as lines,
    ):
        show = partial(bar.update, bar.add_task(text, total=total))

        def update(stage: str = stage, **changes: Any) -> None:
            show(**changes)
            counted.update(**changes)
            told = changes.get("description", "")
            lines.update(stage, f"{counted}, {told}" if told and told != stage else str(counted))

        yield update

"""The progress bar of all commands."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Literal

from posekit.cli.messages import progress_console

Column = Literal["count", "text", "elapsed", "remaining"]


@contextmanager
def progress_bar(*columns: Column, total: float | None = None, text: str = "") -> Iterator[Callable[..., None]]:
    """A bar on standard error while the block runs; nothing where that is no terminal, or with --quiet.

    columns: what stands behind the bar, in this order. total: steps in all, None where that is not known yet. Gives
    a function that takes what rich's ``Progress.update`` takes: completed, advance, total, description (the text).
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
    with Progress(*shown, console=console, transient=True, disable=console.quiet) as bar:
        yield partial(bar.update, bar.add_task(text, total=total))

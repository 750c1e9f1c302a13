"""What is being done, in lines, where standard error is no terminal."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Lock, Thread

import typer

LONG = 2.0  # seconds after which a stage is told
APART = 2.0  # seconds between two lines at least
AGAIN = 10.0  # seconds after which a stage that goes on is told again, where its text has changed
LOOK = 0.5  # seconds between two looks at the clock


class PlainLines:
    """Chooses which of many texts become lines. A text is what is being done, and with ``detail`` how far it is."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._lock = clock, Lock()
        self._stage, self._detail = "", ""
        self._since = clock()
        self._last = -AGAIN  # when a line was told, and which
        self._told = ("", "")

    def update(self, stage: str, detail: str = "") -> None:
        """What is being done now."""
        with self._lock:
            if stage != self._stage:
                self._stage, self._since = stage, self._clock()
            self._detail = detail

    def due(self) -> str | None:
        """The line that is to be told now, None for none."""
        with self._lock:
            now, text = self._clock(), (self._stage, self._detail)
            if not self._stage or text == self._told or now - self._last < APART:
                return None
            new = self._stage != self._told[0]
            if (now - self._since < LONG) if new else (now - self._last < AGAIN):
                return None
            self._last, self._told = now, text
            return f"{self._stage}: {self._detail}" if self._detail else f"{self._stage} ..."


@contextmanager
def plain_lines(shown: bool) -> Iterator[PlainLines]:
    """Lines on standard error while the block runs, where they are to be shown."""
    lines, ended = PlainLines(), Event()
    if not shown:
        yield lines
        return

    def tell() -> None:
        while not ended.wait(LOOK):
            if (line := lines.due()) is not None:
                typer.echo(line, err=True)

    thread = Thread(target=tell, daemon=True)
    thread.start()
    try:
        yield lines
    finally:
        ended.set()
        thread.join()

"""What commands tell a person on standard error: notes, warnings, errors, progress; and the options that choose it."""

from __future__ import annotations

import copy
import logging
import os
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer
from typer.core import TyperCommand, TyperGroup

from posekit.cli.plain_lines import plain_lines

if TYPE_CHECKING:
    from rich.console import Console

MESSAGES = "Messages"  # the panel of these options in every command's help
EVERYWHERE = ("quiet", "verbose", "debug")
FLAGS = {"-q": "--quiet", "--quiet": "--quiet", "-v": "--verbose", "--verbose": "--verbose", "--debug": "--debug"}

log = logging.getLogger("posekit")


def hoisted(args: list[str]) -> list[str]:
    """Arguments with the options that all commands share first, where the group of all commands takes them."""
    end = args.index("--") if "--" in args else len(args)
    flags = [FLAGS[arg] for arg in args[:end] if arg in FLAGS]
    return flags + [arg for arg in args[:end] if arg not in FLAGS] + args[end:]


def tell(kind: str, text: str, colour: str) -> None:
    """A line on standard error."""
    line = " ".join(text.splitlines())
    typer.echo(f"{typer.style(f'{kind}:', fg=colour, bold=True)} {line}", err=True)


@contextmanager
def messages(quiet: bool, verbose: bool) -> Iterator[None]:
    """The library's log and Python's warnings as lines on standard error. quiet: no notes; verbose: all stages."""
    handler, level = _LogLines(), log.level
    log.addHandler(handler)
    log.setLevel(logging.WARNING if quiet else logging.DEBUG if verbose else logging.INFO)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            yield
    finally:
        log.removeHandler(handler)
        log.setLevel(level)


class _LogLines(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno >= logging.WARNING:
            tell("warning", record.getMessage(), typer.colors.YELLOW)
        elif record.levelno >= logging.INFO:
            tell("note", record.getMessage(), typer.colors.BLUE)
        else:
            tell("debug", record.getMessage(), typer.colors.CYAN)


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    tell("warning", str(message), typer.colors.YELLOW)


def wanted() -> bool:
    """Whether notes and progress are: not with --quiet."""
    return log.isEnabledFor(logging.INFO)


def progress_console() -> Console:
    """Where progress is shown: standard error. It prints nothing where that is no terminal, or with --quiet."""
    from rich.console import Console

    console = Console(stderr=True)
    console.quiet = not console.is_terminal or not wanted()
    return console


Tell = Callable[[str], None]


@contextmanager
def working(what: str) -> Iterator[Tell]:
    """Show what is being done, and log how long it took: a status line on a terminal, else plain lines of what takes
    its time. Gives a function that takes a more exact text."""
    started, console = time.perf_counter(), progress_console()
    with console.status(f"{what} ...") as status, plain_lines(wanted() and not console.is_terminal) as lines:

        def tell(text: str) -> None:
            status.update(f"{text} ...")
            lines.update(text)

        tell(what)
        yield tell
    log.debug("%s: %.2f s", what, time.perf_counter() - started)


def obey_no_color(ctx: Any) -> None:
    """No colours where NO_COLOR is set to anything (https://no-color.org)."""
    if os.environ.get("NO_COLOR"):
        ctx.color = False


class Flags:
    """A command whose help shows flags without a type: they take no value."""

    def get_params(self, ctx: Any) -> list[Any]:
        """The options, flags without a metavar."""
        params: list[Any] = super().get_params(ctx)  # type: ignore[misc]
        for option in params:
            if getattr(option, "is_flag", False) and option.metavar is None:
                option.metavar = ""
        return params


class _WithMessages(Flags):
    """A command whose help and shell completion show the options that all commands share. The group of all commands
    has taken them before."""

    def get_params(self, ctx: Any) -> list[Any]:
        shared = [copy.copy(p) for p in ctx.find_root().command.params if p.name in EVERYWHERE]
        for option in shared:
            option.expose_value = False
        return [*super().get_params(ctx), *shared]


class Command(_WithMessages, TyperCommand):
    """A command."""


class Group(_WithMessages, TyperGroup):
    """A command with commands of its own."""

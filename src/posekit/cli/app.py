"""``posekit``: the commands, and how all of them fail.

Commands import what they need when they run, so that ``posekit --help`` loads neither torch nor OpenGL.
"""

from __future__ import annotations

import logging
import shlex
import sys
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from posekit._version import __version__
from posekit.cli import (
    cache,
    calibrate,
    demo,
    detect,
    doctor,
    download,
    estimate,
    eval,
    refine,
    render_views,
    synth,
    track,
    train,
    view,
)
from posekit.errors import PosekitError

INTERRUPTED = 130  # as shells count it: 128 + SIGINT
RENAMED = {
    "--least": "--min-score",
    "--most": "--max-detections",
    "--beside": "--perturb",
    "--alone": "--no-perturb",
    "--contour": "--mask-edge",
    "--no-contour": "--no-mask-edge",
    "--outline": "--colour-edge",
    "--no-outline": "--no-colour-edge",
}  # options that had other names in 0.1


class Commands(TyperGroup):
    """Turns a PosekitError into one line on standard error and exit code 1, Ctrl-C into exit code 130."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        return list(super().parse_args(ctx, [_renamed(arg) for arg in args]))

    def invoke(self, ctx: Any) -> Any:
        try:
            with _messages():
                return super().invoke(ctx)
        except PosekitError as error:
            if ctx.params.get("debug"):
                raise
            _tell("error", str(error), typer.colors.RED)
            raise typer.Exit(1) from error
        except KeyboardInterrupt as error:
            _tell("interrupted", "nothing more is written", typer.colors.RED)
            raise typer.Exit(INTERRUPTED) from error
        except Exception as error:  # a fault of posekit or of a library: said like any other, with what to report
            framework = type(error).__module__.partition(".")[0] in ("typer", "click")  # wrong usage, an exit
            if framework or ctx.params.get("debug") or isinstance(error, BrokenPipeError):
                raise
            _tell("error", _unexpected(error), typer.colors.RED)
            raise typer.Exit(1) from error


def _renamed(arg: str) -> str:
    """An argument with today's name of its option."""
    name, equals, value = arg.partition("=")
    if name not in RENAMED:
        return arg
    _tell("note", f"{name} is now called {RENAMED[name]}; the old name goes with the next release.", typer.colors.BLUE)
    return RENAMED[name] + equals + value


def _unexpected(error: Exception) -> str:
    """What nobody foresaw: where it happened, with what, and how to report it."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "posekit" in Path(frame.filename).parts]
    place = f" in {Path(own[-1].filename).name}, line {own[-1].lineno}" if own else ""
    reason = " ".join(str(error).split())[:300]
    return (
        f"something unexpected{place} ({type(error).__name__}: {reason}) while working on: posekit "
        f"{' '.join(map(shlex.quote, sys.argv[1:]))}. This is a fault of posekit {__version__}: please report it with "
        "this line, the files if they may be shared, and what posekit --debug prints."
    )


@contextmanager
def _messages() -> Iterator[None]:
    """The library's log and Python's warnings as lines on standard error."""
    log, handler = logging.getLogger("posekit"), _LogLines()
    level = log.level
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            yield
    finally:
        log.removeHandler(handler)
        log.setLevel(level)


class _LogLines(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        loud = record.levelno >= logging.WARNING
        _tell("warning" if loud else "note", record.getMessage(), typer.colors.YELLOW if loud else typer.colors.BLUE)


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    _tell("warning", str(message), typer.colors.YELLOW)


def _tell(kind: str, text: str, colour: str) -> None:
    line = " ".join(text.splitlines())
    typer.echo(f"{typer.style(f'{kind}:', fg=colour, bold=True)} {line}", err=True)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"posekit {__version__}")
        raise typer.Exit


app = typer.Typer(
    cls=Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback()
def _options(
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """From a photograph and a CAD file to the object's 6D pose."""


app.command("estimate")(estimate.estimate)
app.command("detect")(detect.detect)
app.command("refine")(refine.refine)
app.command("track")(track.track)
app.command("view")(view.view)
app.command("render-views")(render_views.render_views)
app.command("synth")(synth.synth)
app.add_typer(train.train, name="train")
app.command("eval")(eval.evaluate)
app.command("download")(download.download)
app.command("calibrate")(calibrate.calibrate)
app.command("cache")(cache.cache)
app.command("doctor")(doctor.doctor)
app.command("demo")(demo.demo)


def main() -> None:
    try:
        app(prog_name="posekit")
    except KeyboardInterrupt:  # before typer watches for it, or after
        raise SystemExit(130) from None

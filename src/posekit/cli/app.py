"""``posekit``: the commands, and how all of them fail.

Commands import what they need when they run, so that ``posekit --help`` loads neither torch nor OpenGL.
"""

from __future__ import annotations

import logging
import shlex
import sys
import traceback
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
    export,
    refine,
    render_views,
    synth,
    track,
    train,
    view,
)
from posekit.cli.messages import MESSAGES, Command, Flags, hoisted, messages, obey_no_color, tell
from posekit.errors import PosekitError

log = logging.getLogger("posekit")

RENAMED_HERE = "posekit.renamed"  # in a context: former names that were given
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


class Commands(Flags, TyperGroup):
    """Turns a PosekitError into one line on standard error and exit code 1, Ctrl-C into exit code 130."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """The arguments with the options of all commands first, and today\'s names of those that were renamed."""
        obey_no_color(ctx)
        ctx.meta[RENAMED_HERE] = [name for arg in args if (name := arg.partition("=")[0]) in RENAMED]
        return list(super().parse_args(ctx, hoisted([_renamed(arg) for arg in args])))

    def invoke(self, ctx: Any) -> Any:
        """Run the command; see the class for how errors end it."""
        quiet, verbose = bool(ctx.params.get("quiet")), bool(ctx.params.get("verbose"))
        if quiet and verbose:
            ctx.fail("--quiet and --verbose were both given: give one of them.")
        try:
            with messages(quiet, verbose):
                for name in ctx.meta[RENAMED_HERE]:
                    log.info("%s is now called %s; the old name goes with the next release.", name, RENAMED[name])
                return super().invoke(ctx)
        except PosekitError as error:
            if ctx.params.get("debug"):
                raise
            tell("error", str(error), typer.colors.RED)
            raise typer.Exit(1) from error
        except KeyboardInterrupt as error:
            tell("interrupted", "nothing more is written", typer.colors.RED)
            raise typer.Exit(INTERRUPTED) from error
        except Exception as error:  # a fault of posekit or of a library: said like any other, with what to report
            framework = type(error).__module__.partition(".")[0] in ("typer", "click")  # wrong usage, an exit
            if framework or ctx.params.get("debug") or isinstance(error, BrokenPipeError):
                raise
            tell("error", _unexpected(error), typer.colors.RED)
            raise typer.Exit(1) from error


def _renamed(arg: str) -> str:
    """An argument with today's name of its option."""
    name, equals, value = arg.partition("=")
    return RENAMED.get(name, name) + equals + value


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
    quiet: Annotated[
        bool,
        typer.Option(
            "--quiet",
            "-q",
            help="Print results, warnings and errors only: no notes, no progress.",
            rich_help_panel=MESSAGES,
        ),
    ] = False,
    verbose: Annotated[
        bool,
        typer.Option(
            "--verbose",
            "-v",
            help="Also print what is done: stages with their seconds, first poses, the choice.",
            rich_help_panel=MESSAGES,
        ),
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of an error.", rich_help_panel=MESSAGES)
    ] = False,
    version: Annotated[
        bool,
        typer.Option("--version", "-V", callback=_show_version, is_eager=True, help="Print the version and exit."),
    ] = False,
) -> None:
    """From a photograph and a CAD file to the object's 6D pose."""


app.command("estimate", cls=Command)(estimate.estimate)
app.command("detect", cls=Command)(detect.detect)
app.command("refine", cls=Command)(refine.refine)
app.command("track", cls=Command)(track.track)
app.command("view", cls=Command)(view.view)
app.command("render-views", cls=Command)(render_views.render_views)
app.command("synth", cls=Command)(synth.synth)
app.add_typer(train.train, name="train")
app.command("eval", cls=Command)(eval.evaluate)
app.command("download", cls=Command)(download.download)
app.command("calibrate", cls=Command)(calibrate.calibrate)
app.command("export", cls=Command)(export.export)
app.command("cache", cls=Command)(cache.cache)
app.command("doctor", cls=Command)(doctor.doctor)
app.command("demo", cls=Command)(demo.demo)


def main() -> None:
    """The entry point of the command line."""
    try:
        app(prog_name="posekit")
    except KeyboardInterrupt:  # before typer watches for it, or after
        raise SystemExit(130) from None

"""Several pictures: `posekit.batch` for the command line."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import typer

from posekit.cli.options import NOT_RELIABLE
from posekit.cli.output import OutputFolder, check_json
from posekit.cli.progress import progress_bar
from posekit.errors import ImageError, OutputError

if TYPE_CHECKING:
    from posekit.batch.jobs import DetectJob, EstimateJob, RefineJob
    from posekit.batch.results_file import ResultsFile
    from posekit.batch.run import Done
    from posekit.machines import Machines

log = logging.getLogger("posekit")

T = TypeVar("T", "EstimateJob", "DetectJob", "RefineJob")


@dataclass(frozen=True)
class Wanted:
    """Where lines and files of several pictures go, and who works on them; as the options of the same names."""

    out: Path | None
    force: bool
    json: str | None
    machines: Machines
    threads: int | None
    require_reliable: bool = False


def work_through(job: T, images: Sequence[Path], wanted: Wanted) -> None:
    """Every picture of the arguments. Ends with exit code 1 where pictures could not be used, and with 3 where
    ``require_reliable`` is not met."""
    from posekit.batch.jobs import settings_of
    from posekit.batch.pictures import folder_name, pictures_of
    from posekit.batch.results_file import ResultsFile
    from posekit.batch.run import run

    check_json(wanted.json)
    pictures = pictures_of(images)
    lines: ResultsFile | None = None
    begun: list[dict[str, Any]] = []
    if wanted.out is not None or wanted.json is None:
        folder = wanted.out or OutputFolder.chosen(None, Path("posekit-out") / folder_name(images), wanted.force).path
        job = replace(job, files=replace(job.files, folder=folder))
        lines = ResultsFile(folder, settings_of(job), wanted.force)
        begun = lines.begun(pictures)
    elif job.files.formats or job.files.recording:
        raise OutputError("--format and --rerun with --json write into a folder: pass --out DIR too.")
    tally = _Tally(len(pictures))
    for each in begun:
        tally.add(bool(each["problem"]), bool(each["reliable"]))
    if begun and lines is not None:
        log.info("%d of %d pictures are done already in %s: going on.", len(begun), len(pictures), lines.folder)
    with (
        _json(wanted.json, lines) as write,
        progress_bar("count", "text", "elapsed", "remaining", total=len(pictures), stage="pictures") as update,
    ):
        update(completed=len(begun), description="loading")
        known: set[str] = set()
        for done in run(job, pictures[len(begun) :], wanted.machines, wanted.threads):
            _pass_on(done, known)
            if lines is not None:
                lines.add(done.answer.line)
            write(done.answer.line)
            tally.add(bool(done.problem), done.answer.reliable)
            kind = typer.style("not used: ", fg=typer.colors.RED) if done.problem else ""
            typer.echo(f"{done.picture.path}: {kind}{done.answer.told}", err=wanted.json == "-")
            update(advance=1, description=done.picture.path.name)
    if lines is not None:
        typer.echo(f"results: {lines.path}", err=wanted.json == "-")
    tally.end(wanted.require_reliable)


class _Tally:
    """What is counted over all pictures, also those of an earlier run."""

    def __init__(self, total: int) -> None:
        self.total, self.failed, self.unsure = total, 0, 0

    def add(self, failed: bool, reliable: bool) -> None:
        self.failed += failed
        self.unsure += not reliable

    def end(self, require_reliable: bool) -> None:
        """Raises ImageError where a picture could not be used, else typer's Exit where it is to end so."""
        if self.failed:
            raise ImageError(
                f"{self.failed} of {self.total} pictures could not be used: their lines say why (problem)."
            )
        if require_reliable and self.unsure:
            raise typer.Exit(NOT_RELIABLE)


def _pass_on(done: Done, known: set[str]) -> None:
    """Tell a picture's notes, of each kind the first."""
    for level, kind, text in done.notes:
        if kind not in known:
            known.add(kind)
            log.log(level, "%s", text)


def _drop(line: str) -> None:
    """Where nobody asks for the lines."""


@contextmanager
def _json(json: str | None, lines: ResultsFile | None) -> Iterator[Callable[[str], None]]:
    """Takes lines where ``--json`` asks for them; those of an earlier run come first."""
    if json is None:
        yield _drop
        return
    if json == "-":
        for line in () if lines is None else lines.read():
            typer.echo(line)
        yield typer.echo
        return
    with Path(json).open("w", encoding="utf-8") as file:
        file.writelines(f"{line}\n" for line in (() if lines is None else lines.read()))
        yield lambda line: print(line, file=file, flush=True)
    typer.echo(f"JSON: {json}")

"""Many pictures, each a line: by this process, by several or on a Ray cluster."""

from __future__ import annotations

import logging
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial

from posekit.batch.jobs import Answer, Job, Worker, problem_line
from posekit.batch.pictures import Picture
from posekit.errors import CameraError, ImageError, PosekitError, PromptError
from posekit.machines import Machines, in_order
from posekit.nets import precision

log = logging.getLogger("posekit")

Note = tuple[int, str, str]  # level, the message's form, the message


@dataclass(frozen=True)
class Done:
    """A picture that is done with. problem: why it could not be used, "" where it could. notes: what was logged."""

    picture: Picture
    answer: Answer
    problem: str = ""
    notes: tuple[Note, ...] = ()


def run(
    job: Job, pictures: Sequence[Picture], machines: Machines = Machines(), threads: int | None = None
) -> Iterator[Done]:
    """Each picture, in their order, as soon as those before it are done. What is logged once in each picture is in
    ``notes``.

    threads: of each worker's networks; by default all of this process, or an equal share of the cores for each of
    several workers. A picture that cannot be used has a ``problem``. Raises PosekitError where nothing can go on: a
    mesh, weights or a folder that cannot be used, a worker that was killed.
    """
    if threads is None and not machines.alone:
        threads = 1 if machines.ray is not None else max(1, precision.usable_cores() // machines.workers)
    try:
        yield from in_order(machines, partial(process, job, threads), pictures, "give the same command again")
    finally:
        _worker.cache_clear()


def process(job: Job, threads: int | None, picture: Picture) -> Done:
    """One picture, in whatever process: the first one there loads what all need."""
    with _kept_notes() as notes:
        assert isinstance(job, Hashable)
        worker = _worker(job, threads)
        try:
            answer, problem = worker(picture), ""
        except (ImageError, CameraError, PromptError) as error:
            problem = str(error)
        except PosekitError:
            raise
        except Exception as error:  # a picture that nobody foresaw must not end the others
            problem = f"something unexpected ({type(error).__name__}: {' '.join(str(error).split())[:300]})"
            log.debug("%s", picture.path, exc_info=True)
        if problem:
            answer = Answer(problem_line(job, picture, problem), problem)
    return Done(picture, answer, problem, tuple(notes))


@lru_cache(maxsize=1)
def _worker(job: Job, threads: int | None) -> Worker:
    """What a process needs for a job, kept as long as it works on it."""
    if threads is not None:
        precision.use_threads(threads)
    return job.worker()


@contextmanager
def _kept_notes() -> Iterator[list[Note]]:
    """posekit's notes and warnings are kept instead of shown: with many pictures each is told once, by one process."""
    notes: list[Note] = []

    class Keep(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            notes.append((record.levelno, str(record.msg), record.getMessage()))

    handlers, propagate, level = log.handlers[:], log.propagate, log.level
    log.handlers, log.propagate = [Keep()], False
    log.setLevel(level or logging.INFO)
    try:
        yield notes
    finally:
        log.handlers, log.propagate = handlers, propagate
        log.setLevel(level)

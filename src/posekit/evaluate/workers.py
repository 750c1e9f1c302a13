"""Pictures spread over processes. They are spawned, not forked: OpenGL does not survive a fork.

Each worker is asked for one picture at a time over a pipe of its own; when the parent dies, however suddenly, the
pipe ends and so does the worker.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING, Any, cast

from posekit.errors import PosekitError
from posekit.evaluate.options import EvalOptions
from posekit.evaluate.stages import ImageStage, Record, Regions, run_once
from posekit.nets import precision

if TYPE_CHECKING:
    from multiprocessing.context import SpawnProcess

Picture = tuple[int, int]


def run_pictures(options: EvalOptions, files: Regions, pictures: Sequence[Picture]) -> Iterator[tuple[Picture, Record]]:
    """Each picture's record, as soon as it is there; in any order with several workers. files: `detections_for` them.

    Raises what a stage raises, and PosekitError where a worker dies.
    """
    count = min(options.workers, len(pictures))
    if count <= 1:
        with _threads(options.threads):
            stage = ImageStage(options, files)
            for picture in pictures:
                yield picture, run_once(stage, *picture)
        return
    pool = _Pool(options, files, count)
    try:
        yield from pool.run(list(pictures))
    finally:
        pool.close()


class _Pool:
    def __init__(self, options: EvalOptions, files: Regions, count: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.processes: dict[Connection, SpawnProcess] = {}
        for _ in range(count):
            ours, theirs = context.Pipe()
            process = context.Process(target=_work, args=(theirs, options, files), daemon=True)
            process.start()
            theirs.close()
            self.processes[ours] = process

    def run(self, pictures: list[Picture]) -> Iterator[tuple[Picture, Record]]:
        left = iter(pictures)
        at: dict[Connection, Picture] = {}
        for pipe in self.processes:
            self._ask(pipe, left, at)
        while at:
            for pipe in cast("list[Connection]", wait(list(at))):
                picture = at.pop(pipe)
                record = self._answer(pipe, picture)
                self._ask(pipe, left, at)
                yield picture, record

    def _ask(self, pipe: Connection, left: Iterator[Picture], at: dict[Connection, Picture]) -> None:
        picture = next(left, None)
        if picture is not None:
            at[pipe] = picture
            with suppress(BrokenPipeError):  # a dead worker is reported where its result is awaited
                pipe.send(picture)

    def _answer(self, pipe: Connection, picture: Picture) -> Record:
        try:
            answer: Any = pipe.recv()
        except (EOFError, ConnectionResetError) as error:
            raise PosekitError(
                f"a worker died over scene {picture[0]}, image {picture[1]} (out of memory?). What was finished is "
                "kept: run the same command again, with fewer --workers."
            ) from error
        if isinstance(answer, BaseException):
            raise answer
        return dict(answer)

    def close(self) -> None:
        for pipe, process in self.processes.items():
            pipe.close()
            process.terminate()
        for process in self.processes.values():
            process.join()


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """The networks with so many threads, in this process; afterwards with as many as before."""
    import torch

    before, told = torch.get_num_threads(), precision.threads()
    precision.use_threads(count)
    try:
        yield
    finally:
        precision.use_threads(told)
        torch.set_num_threads(before)


def _work(pipe: Connection, options: EvalOptions, files: Regions) -> None:
    """A worker's life."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    stage: ImageStage | None = None
    with suppress(EOFError, BrokenPipeError, KeyboardInterrupt), _threads(options.threads):
        while True:
            picture = pipe.recv()
            try:
                stage = stage or ImageStage(options, files)
                answer: Any = run_once(stage, *picture)
            except PosekitError as error:
                answer = error
            pipe.send(answer)

"""Work spread over processes, or over the machines of a Ray cluster: one function for both, results in order."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.connection import wait
from threading import Thread
from typing import Any, TypeVar

from posekit.errors import ConfigError, OutputError, PosekitError

J = TypeVar("J")
R = TypeVar("R")

AHEAD = 4  # jobs of each worker that are given out at a time, so that none waits and few results are held
SPINNING = {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "0"}  # a thread that waits leaves its core to the others


@dataclass(frozen=True)
class Machines:
    """workers: processes. ray: a Ray cluster's address, "local" for one on this machine; None = no Ray."""

    workers: int = 1
    ray: str | None = None

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise ConfigError(f"{self.workers} workers: at least 1 is needed.")

    @property
    def alone(self) -> bool:
        """Whether everything is done by this process."""
        return self.workers == 1 and self.ray is None


def in_order(machines: Machines, function: Callable[[J], R], jobs: Iterable[J], go_on: str) -> Iterator[R]:
    """``function`` of each job, in the jobs' order; only a few results are held at a time.

    function: with several workers or Ray it is pickled, and so are jobs and results. go_on: what to do after a worker
    was killed, as the end of a sentence. Raises what the function raises, ConfigError where Ray is not installed or no
    cluster answers, OutputError where a worker was killed.
    """
    if machines.ray is not None:
        return _on_ray(machines, machines.ray, function, jobs, go_on)
    if machines.workers == 1:
        return map(function, jobs)
    return _in_processes(machines.workers, function, jobs, go_on)


def _in_processes(workers: int, function: Callable[[J], R], jobs: Iterable[J], go_on: str) -> Iterator[R]:
    """New processes, not forked: OpenGL does not outlive a fork."""
    context = multiprocessing.get_context("spawn")
    left, pending = iter(jobs), deque[Future[R]]()
    with ProcessPoolExecutor(workers, context, initializer=_begin_worker) as pool:
        try:
            while True:
                while len(pending) < AHEAD * workers and (job := next(left, None)) is not None:
                    pending.append(pool.submit(function, job))
                if not pending:
                    return
                yield pending.popleft().result()
        except BrokenProcessPool as error:
            raise OutputError(f"a worker process was killed (out of memory?): {go_on}, with fewer workers.") from error
        finally:
            pool.shutdown(cancel_futures=True)


def _begin_worker() -> None:
    """Ctrl-C is the parent's; a worker ends when the parent does, however suddenly."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _single_threaded()
    parent = multiprocessing.parent_process()
    if parent is not None:
        Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)


def _single_threaded() -> None:
    """One process of several: no threads of its own."""
    import cv2

    os.environ.update(SPINNING)
    os.environ["LP_NUM_THREADS"] = "0"
    cv2.setNumThreads(0)


def _on_ray(machines: Machines, address: str, function: Callable[[J], R], jobs: Iterable[J], go_on: str) -> Iterator[R]:
    """The same on a Ray cluster, whose machines must see the same files under the same paths."""
    try:
        import ray
    except ImportError as error:
        raise ConfigError("--ray needs the extra: pip install 'posekit[ray]'.") from error
    local = address == "local"
    try:
        options = {"num_cpus": machines.workers, "include_dashboard": False} if local else {"address": address}
        ray.init(**options, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise ConfigError(f"--ray {address}: no Ray cluster answers there: {error}") from error
    try:
        task: Any = ray.remote(num_cpus=1)(_on_node)
        resources: Any = ray.cluster_resources()  # type: ignore[no-untyped-call]
        given_out = AHEAD * max(1, int(resources.get("CPU", 1)))
        left, pending, here = iter(jobs), deque[Any](), os.getcwd()  # noqa: PTH109 - a text, for another machine
        while True:
            while len(pending) < given_out and (job := next(left, None)) is not None:
                pending.append(task.remote(here, function, job))
            if not pending:
                return
            result, refusal = ray.get(pending.popleft())
            if refusal is not None:
                raise refusal
            yield result
    except ray.exceptions.WorkerCrashedError as error:
        raise OutputError(f"a Ray worker was killed (out of memory?): {go_on}, with fewer workers.") from error
    finally:
        ray.shutdown()


def _on_node(here: str, function: Callable[[J], R], job: J) -> tuple[R | None, PosekitError | None]:
    """In the folder in which the command was given. An error comes back as a value: Ray would dress it up."""
    try:
        os.chdir(here)
    except OSError:
        return None, OutputError(
            f"there is no folder {here} on a machine of the Ray cluster: start from one that all machines share."
        )
    _single_threaded()
    try:
        return function(job), None
    except PosekitError as error:
        return None, error

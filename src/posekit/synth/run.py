"""A data set made by one process, several, or a cluster: begun, continued, finished.

Image n is a function of the configuration and n, and is written before its record: whoever makes it, in whatever
order, the data set is the same, and one that was killed goes on with the images that have no record.
"""

from __future__ import annotations

import itertools
import json
import logging
import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2

from posekit.datasets.bop_writer import BopWriter, write_models
from posekit.datasets.registry import NAMES, own_names
from posekit.errors import ConfigError, OutputError, PosekitError
from posekit.io.files import check_writable, write_text_atomic
from posekit.mesh.model import ObjectModel
from posekit.render import Renderer
from posekit.synth.plan import CONFIG, Maker, SynthConfig
from posekit.synth.report import write_report
from posekit.synth.shards import write_shards

CHUNK = 8  # images that a process is given at a time, where they are made one by one

Show = Callable[[int, int], None]


@dataclass(frozen=True)
class Machines:
    """workers: processes. ray: a Ray cluster's address, "local" for one on this machine; None = no Ray."""

    workers: int = 1
    ray: str | None = None

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise ConfigError(f"{self.workers} workers: at least 1 is needed.")


def check_new(root: Path) -> None:
    """Raises OutputError where a new data set cannot be written there."""
    if root.exists() and not root.is_dir():
        raise OutputError(f"{root} is a file: --out names a folder.")
    if root.is_dir() and any(root.iterdir()):
        raise OutputError(f"the folder {root} holds files: pass --resume to go on with its data set, or another --out.")
    check_writable(root, f"the output folder {root} cannot be written")


def begin(config: SynthConfig, root: Path, models: Mapping[int, ObjectModel]) -> None:
    """Write the models and the configuration of a new data set into an empty or new folder."""
    if not models:
        raise ConfigError("a synthetic data set needs objects: pass --models.")
    check_new(root)
    write_models(root, models)
    names = {str(obj_id): model.name for obj_id, model in sorted(models.items())}
    _write_json(root / NAMES, names)
    write_text_atomic(root / CONFIG, config.to_json())


def run(root: Path, machines: Machines, show: Show, shard: int = 0) -> int:
    """Make what is missing of the data set that was begun in ``root``, and finish it. shard: images in a WebDataset
    shard, 0 = no shards. Returns how many images were made. Raises PosekitError."""
    config = SynthConfig.read(root)
    writer = BopWriter(root, config.split, config.quality or None)
    ids = sorted(_load(root))
    complete = (root / config.split).is_dir() and not writer.records.is_dir()
    done = set() if complete else writer.written()
    missing = [] if complete else [n for n in range(config.images) if config.address(n, ids) not in done]
    made = config.images - len(missing)
    show(made, config.images)
    for count in _work(config, root, missing, machines):
        made += count
        show(made, config.images)
    if not complete:
        _remove_leftovers(root)
        writer.finish(own_names(root), f"posekit synth --kind {config.kind} --seed {config.seed}")
        if config.kind == "sequence":
            from posekit.synth.sequence import sequences

            _write_json(root / "sequences.json", sequences(config))
        write_report(root, config.split)
    if shard:
        write_shards(root, config.split, shard)
    writer.discard_records()
    return len(missing)


def _work(config: SynthConfig, root: Path, missing: Sequence[int], machines: Machines) -> Iterator[int]:
    """Make images; yields how many were made, again and again."""
    jobs = list(_jobs(config, missing))
    if machines.ray is not None:
        return _on_ray(machines, root, jobs)
    if machines.workers == 1 or len(jobs) < 2:
        return (make_images(str(root), job) for job in jobs)
    return _in_processes(machines, root, jobs)


def _jobs(config: SynthConfig, missing: Sequence[int]) -> Iterator[list[int]]:
    """Images that one process makes in one go: those of a block, or some of many."""
    if config.per_block > 1:
        for _, group in itertools.groupby(missing, key=lambda n: n // config.per_block):
            yield list(group)
        return
    for start in range(0, len(missing), CHUNK):
        yield list(missing[start : start + CHUNK])


def _in_processes(machines: Machines, root: Path, jobs: Sequence[list[int]]) -> Iterator[int]:
    """New processes, not forked: OpenGL does not outlive a fork."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(machines.workers, len(jobs)), context, initializer=_single_threaded) as pool:
        futures: set[Future[int]] = {pool.submit(make_images, str(root), job) for job in jobs}
        try:
            while futures:
                finished, futures = wait(futures, return_when=FIRST_COMPLETED)
                yield from (future.result() for future in finished)
        except BrokenProcessPool as error:
            raise OutputError("a worker process was killed (out of memory?): go on with --resume, and fewer workers."
                              ) from error  # fmt: skip
        finally:
            pool.shutdown(cancel_futures=True)


def _on_ray(machines: Machines, root: Path, jobs: Sequence[list[int]]) -> Iterator[int]:
    """The same on a Ray cluster, whose machines must see the folder under the same path."""
    try:
        import ray
    except ImportError as error:
        raise ConfigError("--ray needs the extra: pip install 'posekit[ray]'.") from error
    local = machines.ray == "local"
    try:
        options = {"num_cpus": machines.workers, "include_dashboard": False} if local else {"address": machines.ray}
        ray.init(**options, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise ConfigError(f"--ray {machines.ray}: no Ray cluster answers there: {error}") from error
    try:
        task = ray.remote(num_cpus=1)(_on_node)
        pending = [task.remote(str(root.resolve()), job) for job in jobs]
        while pending:
            finished, pending = ray.wait(pending)
            for count, problem in ray.get(finished):
                if problem:
                    raise OutputError(f"a Ray worker failed: {problem}")
                yield count
    finally:
        ray.shutdown()


def _on_node(root: str, numbers: list[int]) -> tuple[int, str]:
    _single_threaded()
    if not (Path(root) / CONFIG).is_file():
        return 0, f"there is no {root} on its machine; --out must lie on a file system that all machines share."
    try:
        return make_images(root, numbers), ""
    except PosekitError as error:
        return 0, str(error)


def _single_threaded() -> None:
    """One process of several: no threads of its own."""
    os.environ["LP_NUM_THREADS"] = "0"
    cv2.setNumThreads(0)


def make_images(root: str, numbers: Sequence[int]) -> int:
    """Make and write images of the data set that was begun in ``root``, all of one block or of several."""
    folder = Path(root)
    config, ids, maker = _maker(folder)
    writer = BopWriter(folder, config.split, config.quality or None)
    made = 0
    for block, group in itertools.groupby(numbers, key=lambda n: n // config.per_block):
        for place, picture in maker.block(block, [n % config.per_block for n in group]):
            writer.write(*config.address(block * config.per_block + place, ids), picture)
            made += 1
    return made


@lru_cache(maxsize=1)
def _maker(root: Path) -> tuple[SynthConfig, list[int], Maker]:
    """What a process needs to make images, kept as long as it works on the same data set."""
    config, models = SynthConfig.read(root), _load(root)
    return config, sorted(models), make_maker(config, models)


def make_maker(config: SynthConfig, models: Mapping[int, ObjectModel]) -> Maker:
    """The maker of a configuration's kind. Raises ConfigError where an extra is missing."""
    renderer = Renderer()
    if config.kind == "randomised":
        from posekit.synth.randomised import Randomised

        return Randomised(config, models, renderer)
    if config.kind == "sequence":
        from posekit.synth.sequence import Sequences

        return Sequences(config, models, renderer)
    if config.kind == "scenes":
        from posekit.synth.tables import Tables

        return Tables(config, models, renderer)
    from posekit.synth.photoreal import Photoreal

    return Photoreal(config, models, renderer)


def _load(root: Path) -> dict[int, ObjectModel]:
    """The data set's own copy of the models: what is drawn is what is written."""
    paths = {int(path.stem[4:]): path for path in sorted((root / "models").glob("obj_*.ply"))}
    return {obj_id: ObjectModel.load(path, units="mm") for obj_id, path in paths.items()}


def _write_json(path: Path, data: Any) -> None:
    write_text_atomic(path, json.dumps(data, indent=1) + "\n")


def _remove_leftovers(root: Path) -> None:
    """What a killed process was just writing."""
    for path in root.rglob(".*.part"):
        path.unlink(missing_ok=True)

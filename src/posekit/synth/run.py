"""A data set made by one process, several, or a cluster: begun, continued, finished.

Image n is a function of the configuration and n, and is written before its record: whoever makes it, in whatever
order, the data set is the same, and one that was killed goes on with the images that have no record.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from posekit.datasets.bop_writer import BopWriter, write_models
from posekit.datasets.registry import NAMES, own_names
from posekit.datasets.sequences import SEQUENCES
from posekit.errors import ConfigError, OutputError
from posekit.io.files import check_writable, write_text_atomic
from posekit.machines import Machines, in_order
from posekit.mesh.model import ObjectModel
from posekit.render import Renderer
from posekit.synth.plan import CONFIG, Maker, SynthConfig
from posekit.synth.report import write_report
from posekit.synth.shards import write_shards

CHUNK = 8  # images that a process is given at a time, where they are made one by one

Show = Callable[[int, int], None]


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
    if config.rbot:
        from posekit.synth.rbot import check_meshes

        check_meshes(config, list(models))
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
            from posekit.synth.rbot import rbot_sequences
            from posekit.synth.sequence import sequences

            _write_json(root / SEQUENCES, rbot_sequences(config, ids) if config.rbot else sequences(config))
        write_report(root, config.split)
    if shard:
        write_shards(root, config.split, shard)
    writer.discard_records()
    return len(missing)


def _work(config: SynthConfig, root: Path, missing: Sequence[int], machines: Machines) -> Iterator[int]:
    """Make images; yields how many were made, again and again."""
    jobs = list(_jobs(config, missing))
    if machines.ray is None and len(jobs) < 2:
        machines = Machines()
    return in_order(machines, partial(make_images, str(root.resolve())), jobs, "go on with --resume")


def _jobs(config: SynthConfig, missing: Sequence[int]) -> Iterator[list[int]]:
    """Images that one process makes in one go: those of a block, or some of many."""
    if config.per_block > 1:
        for _, group in itertools.groupby(missing, key=lambda n: n // config.per_block):
            yield list(group)
        return
    for start in range(0, len(missing), CHUNK):
        yield list(missing[start : start + CHUNK])


def make_images(root: str, numbers: Sequence[int]) -> int:
    """Make and write images of the data set that was begun in ``root``, all of one block or of several."""
    folder = Path(root)
    if not (folder / CONFIG).is_file():
        raise OutputError(f"there is no {root} on a worker's machine: --out must lie where all machines see it.")
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
    if config.rbot:
        from posekit.synth.rbot import RbotSequences

        return RbotSequences(config, models, renderer)
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

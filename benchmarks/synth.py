"""How fast synthetic data sets are made and written, kind by kind.

    python benchmarks/synth.py [--images 40] [--kinds randomised scenes sequence photoreal] [--samples 32]

Prints, for pictures of 640x480 with depth and all masks, images a second by the clock, the CPU time of an image, and
the images a second that two cores give at that CPU time: on a machine that others use too, only CPU times compare.
"""

from __future__ import annotations

import argparse
import logging
import os
import tempfile
import time
from pathlib import Path

import cv2

os.environ.setdefault("LP_NUM_THREADS", "0")  # as a worker process: no threads of its own

from posekit.datasets.bop_writer import BopWriter
from posekit.mesh.model import ObjectModel
from posekit.synth.objects import read_objects
from posekit.synth.plan import KINDS, SynthConfig
from posekit.synth.procedural import random_object
from posekit.synth.run import begin, make_maker

WARM = 4  # images before the clock starts: shaders, textures and kernels are made


def objects(folder: Path | None) -> dict[int, ObjectModel]:
    import numpy as np

    if folder is not None:
        return read_objects([folder], "auto", "none")
    return {k + 1: random_object(np.random.default_rng(k), diameter=0.15) for k in range(6)}


def measure(config: SynthConfig, models: dict[int, ObjectModel]) -> tuple[float, float, float]:
    """Seconds and CPU seconds of an image, and of the latter what goes into files."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "set"
        begin(config, root, models)
        maker, writer = make_maker(config, models), BopWriter(root, config.split, config.quality)
        addresses = [config.address(n, sorted(models)) for n in range(config.images)]
        writing, count, started, cpu = 0.0, 0, 0.0, 0.0
        for block in range(-(-config.images // config.per_block)):
            for place, picture in maker.block(block, range(config.per_block)):
                number = block * config.per_block + place
                if number == WARM:
                    started, cpu, writing, count = time.perf_counter(), time.process_time(), 0.0, 0
                if number < config.images:
                    before = time.process_time()
                    writer.write(*addresses[number], picture)
                    writing += time.process_time() - before
                    count += 1
        return tuple(v / count for v in (time.perf_counter() - started, time.process_time() - cpu, writing))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=40)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--models", type=Path)
    parser.add_argument("--backgrounds", default="")
    parser.add_argument("--samples", type=int, default=32)
    args = parser.parse_args()
    cv2.setNumThreads(0)
    logging.getLogger("posekit").setLevel(logging.ERROR)
    models = objects(args.models)
    for kind in args.kinds:
        images = min(args.images, 12) if kind == "photoreal" else args.images
        config = SynthConfig(kind, WARM + images, backgrounds=args.backgrounds, frames=WARM + images,
                             samples=args.samples)  # fmt: skip
        wall, cpu, writing = measure(config, models)
        print(f"{kind:11s} {1 / wall:6.2f} images/s by the clock, one process; CPU {1000 * cpu:7.1f} ms an image "
              f"({writing / cpu:.0%} of it encoding and writing): {2 / cpu:6.2f} images/s on two cores")  # fmt: skip


if __name__ == "__main__":
    main()

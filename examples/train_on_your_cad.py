"""Networks for your own mesh, from the mesh alone: `python examples/train_on_your_cad.py [FOLDER] [STEPS]`.

The default is some minutes on a laptop's CPU, to see that it works. For use, train for an hour: `posekit train pose`.
"""

import dataclasses
import sys
from pathlib import Path

from posekit import Renderer, estimate
from posekit.synth.example import make_example, ply
from posekit.train.config import SourceConfig, changed, default_config
from posekit.train.pose import train_pose


def main() -> None:
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "posekit-out/train_on_your_cad")
    steps = int(sys.argv[2]) if len(sys.argv) > 2 else 60
    out.mkdir(parents=True, exist_ok=True)
    example = make_example(Renderer())
    (out / "part.ply").write_text(ply(example.model))  # yours: any mesh, its --units too

    few = {
        "steps": steps,
        "cases": min(steps, 12),  # held-back renderings to measure on, before and after
        "calibrate": 0,  # 240 fits the predicted angle anew, which takes minutes
        "optimiser": {"rate": 2e-4, "warmup": 10},
        "stream": {"batch": min(steps, 16), "pool": 32, "shard": 8, "mvnet": 0},
        "machine": {"workers": 0},
    }
    config = changed(default_config("lite"), few, "this script")
    sources = SourceConfig(models=(str(out / "part.ply"),), units="m", init="shipped")  # from the shipped weights on
    rows = train_pose(dataclasses.replace(config, sources=sources), out / "weights", force=True)
    for row in (rows[0], rows[-1]):
        print(f"step {row['step']}: rotation error {float(row['rotation_deg']):.2f} degrees")

    result = estimate(example.view, example.model, box=example.box, weights=out / "weights")
    print(result.best.verdict)


if __name__ == "__main__":  # the processes that render import this file again
    main()

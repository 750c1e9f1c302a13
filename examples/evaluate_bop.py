"""How good it is on a data set in BOP layout: `python examples/evaluate_bop.py [FOLDER] [IMAGES]`.

The data set is made here (`posekit synth` does the same); LM-O or your own are folders like it.
"""

import sys
from pathlib import Path

from posekit.evaluate.options import EvalOptions
from posekit.evaluate.run import evaluate
from posekit.synth.example import locomotive
from posekit.synth.plan import SynthConfig
from posekit.synth.run import Machines, begin, run


def main() -> None:
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "posekit-out/evaluate_bop")
    images = int(sys.argv[2]) if len(sys.argv) > 2 else 8
    dataset = out / "set"
    if not dataset.exists():
        begin(SynthConfig("randomised", images, seed=7, split="test"), dataset, {1: locomotive()})
    run(dataset, Machines(), lambda done, count: print(f"\r{done} of {count} pictures", end="\n" * (done == count)))

    # "refine" starts from disturbed true poses; "estimate" from true boxes, or from detections.
    options = EvalOptions("refine", root=dataset, split="test", min_visible=0.3)
    outcome = evaluate(options, out / "refine", with_vsd=False, force=True)
    for measure, percent in outcome.results["mean"].items():  # over objects
        print(f"{measure}: {percent:.1f} %")
    print("wrote", *(str(file) for file in outcome.files))


if __name__ == "__main__":
    main()

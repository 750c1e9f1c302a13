"""First poses side by side: MV-Net, the template search, and nothing but chance, on the same crops.

    python benchmarks/first_pose.py DIR --weights WEIGHTS [--visible 0.9] [--every 1]

DIR is a data set in BOP layout. The detections are the true masks and their boxes; rotation errors are the least over
each object's symmetries. Prints the median error, the share within 25 degrees (from where SV-Net refines) and
milliseconds per search; for the template search also of the best of its first 5.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from posekit.camera import mask_box
from posekit.data.bop import BopDataset
from posekit.geometry import Pose, random_rotation
from posekit.hypotheses import Hypothesis, MVNetSearch, TemplateSearch
from posekit.metrics import pose_error
from posekit.nets.weights import load_networks
from posekit.object_model import ObjectModel
from posekit.render import Renderer
from posekit.results import Detection


def turn_deg(found: Sequence[Hypothesis], truth: Pose, model: ObjectModel) -> float:
    """The least rotation error of some first poses, degrees; 180 where there are none."""
    errors = [pose_error(h.T_cam_obj, truth, model.symmetries.transforms())[0] for h in found]
    return float(np.rad2deg(min(errors, default=np.pi)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path)
    parser.add_argument("--weights", type=Path, required=True)
    parser.add_argument("--preset", default="lite")
    parser.add_argument("--visible", type=float, default=0.9)
    parser.add_argument("--every", type=int, default=1)
    args = parser.parse_args()
    dataset, renderer, rng = BopDataset(args.root), Renderer(), np.random.default_rng(0)
    networks = load_networks(args.preset, args.weights)
    instances = [i for scene, image in dataset.images() for i in dataset.instances(scene, image, every=True)
                 if i.visib_fract > args.visible][:: args.every]  # fmt: skip
    searches: dict[int, tuple[MVNetSearch, TemplateSearch]] = {}
    turns, seconds = defaultdict(list), defaultdict(list)
    for instance in instances:
        model, mask = dataset.model(instance.obj_id), instance.mask()
        box = mask_box(mask)
        if box is None:
            continue
        if instance.obj_id not in searches:
            searches[instance.obj_id] = MVNetSearch(model, networks, renderer), TemplateSearch(model, renderer)
        view, detection = dataset.view(instance.scene, instance.image), Detection(box, mask)
        for name, search in zip(("MV-Net", "templates"), searches[instance.obj_id], strict=True):
            started = time.perf_counter()
            found = search.search(view, detection, 5)
            seconds[name].append(time.perf_counter() - started)
            turns[name].append(turn_deg(found[:1], instance.T_cam_obj, model))
            if name == "templates":
                turns["best of 5 templates"].append(turn_deg(found, instance.T_cam_obj, model))
        chance = Hypothesis(Pose(random_rotation(rng), instance.T_cam_obj.t), 0.0)
        turns["chance"].append(turn_deg([chance], instance.T_cam_obj, model))
    print(f"{len(turns['chance'])} instances, weights {networks.digest}")
    for name, values in turns.items():
        errors = np.array(values)
        took = f", {1000 * np.median(seconds[name]):.0f} ms" if name in seconds else ""
        print(f"{name}: median {np.median(errors):.1f} degrees, within 25 degrees {np.mean(errors < 25):.1%}{took}")


if __name__ == "__main__":
    main()

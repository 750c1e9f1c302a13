"""First poses from a box: the share within 25 degrees among the best 1, 3, 5 and 10.

    python benchmarks/first_pose.py [DIR] [--wrong 0.05] [--seed 0] [--visible 0.9] [--every 1] [--search box]
    python benchmarks/first_pose.py --renders 200 --photos FOLDER

DIR is a data set in BOP layout, of which instances seen more than ``--visible`` are taken; without one, scenes are
composed of procedural objects and photographs of a folder: there constants are chosen. Every edge of a true box is
moved by up to ``--wrong`` of the box's size. Rotation errors are the least over each object's symmetries.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from posekit.camera import Box, mask_box
from posekit.datasets.bop import BopDataset
from posekit.detect.prompts import BoxPrompt, clip_box
from posekit.first_pose.hypotheses import BoxSearch, TemplateSearch
from posekit.geometry import Pose
from posekit.mesh.model import ObjectModel
from posekit.metrics import pose_error
from posekit.render import Renderer
from posekit.results import Detection
from posekit.synth.procedural import random_object
from posekit.train.data.augment import AugmentConfig, observe
from posekit.train.data.crops import SceneConfig, render_scenes, view_of
from posekit.train.data.stream import load_photos
from posekit.view import View

BEST = (1, 3, 5, 10)
PER_OBJECT = 4
CROP = (320, 240)  # of a composed scene, which is 1.5 times as large


@dataclass(frozen=True, eq=False)
class Case:
    """view: the picture, without a mask. truth: T_cam_obj. box: the true one, edges."""

    view: View
    model: ObjectModel
    truth: Pose
    box: Box


def photographed(root: Path, visible: float, every: int) -> Iterator[Case]:
    dataset = BopDataset(root)
    instances = [i for scene, image in dataset.images() for i in dataset.instances(scene, image, every=True)
                 if i.visib_fract > visible][::every]  # fmt: skip
    for each in instances:
        box = mask_box(each.mask())
        if box is not None:
            yield Case(dataset.view(each.scene, each.image), dataset.model(each.obj_id), each.T_cam_obj, box)


def rendered(count: int, photos: Path, seed: int, plain: bool) -> Iterator[Case]:
    """Composed scenes of procedural objects, PER_OBJECT of each; plain: the search knows no colours of the mesh."""
    renderer, config, augment = Renderer(), SceneConfig(CROP), AugmentConfig(photo=1.0)
    backgrounds = load_photos(photos)
    for k in range(count // PER_OBJECT):
        rng = np.random.default_rng([seed, k])
        model, other = (random_object(rng, backgrounds) for _ in range(2))
        others = [scene.rgba for scene in render_scenes(renderer, other, 2, config, rng)]
        known = replace(model, colors=None, texture=None, uvs=None) if plain else model
        for scene in render_scenes(renderer, model, PER_OBJECT, config, rng):
            picture, _ = observe(scene.rgba, others, backgrounds, augment, rng)
            view = view_of(picture, scene.camera).with_mask(None)
            yield Case(view, known, scene.T_view_ctr @ model.T_ctr_obj, scene.box)


def wrong_box(box: Box, wrong: float, rng: np.random.Generator) -> Box:
    """Every edge moved by up to ``wrong`` of the box's size."""
    size = np.array([box[2] - box[0], box[3] - box[1]] * 2)
    x0, y0, x1, y1 = np.array(box) + rng.uniform(-wrong, wrong, 4) * size
    return float(x0), float(y0), float(x1), float(y1)


def detection_of(case: Case, box: Box, search: str) -> Detection:
    if search == "box":
        return Detection(box)
    return BoxPrompt(box, "grabcut").detect(case.view, [case.model])[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path, nargs="?")
    parser.add_argument("--renders", type=int, default=200)
    parser.add_argument("--photos", type=Path)
    parser.add_argument("--plain", action="store_true", help="renders: the search knows no colours of the mesh")
    parser.add_argument("--search", choices=("box", "grabcut"), default="box")
    parser.add_argument("--wrong", type=float, default=0.05)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--visible", type=float, default=0.9)
    parser.add_argument("--every", type=int, default=1)
    args = parser.parse_args()
    if args.root is None and args.photos is None:
        parser.error("pass DIR, or --photos FOLDER for composed scenes")
    cases = (
        photographed(args.root, args.visible, args.every)
        if args.root is not None
        else rendered(args.renders, args.photos, args.seed, args.plain)
    )
    renderer, rng = Renderer(), np.random.default_rng(args.seed)
    searches: dict[int, tuple[ObjectModel, BoxSearch | TemplateSearch]] = {}
    turns, seconds = [], []
    by_name = defaultdict(list)
    for case in cases:
        box = clip_box(wrong_box(case.box, args.wrong, rng), case.view.camera)
        if id(case.model) not in searches:
            if args.root is None:
                searches.clear()
            search_of = BoxSearch if args.search == "box" else TemplateSearch
            searches[id(case.model)] = case.model, search_of(case.model, renderer)
        started = time.perf_counter()
        detection = detection_of(case, box, args.search)
        found = searches[id(case.model)][1].search(case.view, detection, max(BEST))
        seconds.append(time.perf_counter() - started)
        symmetries = case.model.symmetries.transforms()
        errors = [float(np.rad2deg(pose_error(h.T_cam_obj, case.truth, symmetries)[0])) for h in found] or [180.0]
        turns.append([min(errors[:best]) for best in BEST])
        by_name[case.model.name].append(turns[-1])
    print(f"{len(turns)} instances, boxes {args.wrong:.0%} wrong, seed {args.seed}, {np.median(seconds):.2f} s each")
    print("within 25 degrees among the best " + "/".join(map(str, BEST)) + ": " + shares(turns))
    if args.root is not None:
        for name, values in sorted(by_name.items()):
            print(f"  {name} ({len(values)}): {shares(values)}")


def shares(turns: list[list[float]]) -> str:
    return " / ".join(f"{100 * share:.1f}" for share in (np.array(turns) < 25).mean(0))


if __name__ == "__main__":
    main()

"""How well textured objects are found by local features, in composed scenes with known truth.

    python benchmarks/features.py PHOTOS [MESH ...] [--units m] [--procedural 20] [--scenes 60] [--seed 22] [--box]
    python benchmarks/features.py --bop ROOT

PHOTOS is a folder of pictures that show none of the objects. A scene is a photograph scaled to 640x480 with one object
drawn into it, partly hidden in every third: 50 to 300 pixels large, lit at random, blurred, noisy, stored as JPEG.
Prints how many are found (within 5 degrees and 5 % of the distance), what else is found, what is found in as many
photographs alone, and the seconds. --box looks only within the true box, disturbed by 5 %. --bop measures a data set in
BOP layout instead: every object over half visible, and those that a picture does not show.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from posekit.camera import Box, Camera, mask_box
from posekit.datasets.bop import BopDataset
from posekit.first_pose.features import FeatureOptions, FeaturePose, FeatureSearch
from posekit.geometry import Pose, random_rotation, rotation_angle
from posekit.mesh.model import ObjectModel
from posekit.render import Light, Renderer
from posekit.synth.procedural import photo_crop, random_object
from posekit.view import View

CAMERA = Camera(600.0, 600.0, 319.5, 239.5, 640, 480)
Rng = np.random.Generator


@dataclass(frozen=True)
class Case:
    """A picture, and where (T_cam_obj, box) it shows the mesh; None where it does not."""

    view: View
    search: FeatureSearch
    truth: Pose | None
    box: Box | None


@dataclass
class Tally:
    shown: int = 0
    found: int = 0
    wrong: int = 0
    absent: int = 0
    alarms: int = 0
    seconds: float = 0.0
    pictures: int = 0

    def add(self, case: Case, results: list[FeaturePose], seconds: float) -> str:
        self.seconds, self.pictures = self.seconds + seconds, self.pictures + 1
        if case.truth is None:
            self.absent += 1
            self.alarms += bool(results)
            return "alarm" if results else "rightly nothing"
        right = [is_right(case.search.model, each.T_cam_obj, case.truth) for each in results]
        self.shown, self.found = self.shown + 1, self.found + any(right)
        self.wrong += len(right) - sum(right)
        return "found" if any(right) else "wrong" if right else "missed"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", nargs="?", type=Path)
    parser.add_argument("meshes", nargs="*", type=Path)
    parser.add_argument("--bop", type=Path)
    parser.add_argument("--units", default="auto")
    parser.add_argument("--procedural", type=int, default=20)
    parser.add_argument("--scenes", type=int, default=60)
    parser.add_argument("--seed", type=int, default=22)
    parser.add_argument("--min-matches", type=int, default=FeatureOptions().min_matches)
    parser.add_argument("--box", action="store_true")
    args = parser.parse_args()
    options, renderer = FeatureOptions(min_matches=args.min_matches), Renderer()
    if args.bop:
        cases = photographed(BopDataset(args.bop), renderer, options, args.box, args.seed)
    else:
        cases = composed(args, renderer, options)
    tallies: dict[str, Tally] = {}
    for case in cases:
        name = case.search.model.name
        _ = case.search.features  # once per mesh, and kept on disk: not a picture's time
        started = time.perf_counter()
        results = case.search.search(case.view, case.box)
        kind = tallies.setdefault("procedural" if name == "procedural" else "meshes", Tally())
        what = kind.add(case, results, time.perf_counter() - started)
        tallies.setdefault(name, kind if name == "procedural" else Tally())
        if name != "procedural":
            tallies[name].add(case, results, 0.0)
        numbers = ", ".join(f"{r.inliers} inliers {100 * r.share:.0f} %" for r in results)
        plain = " (plain)" if case.search.features.plain else ""
        print(f"{name}{plain}: {what} {numbers}", flush=True)
    for name, t in tallies.items():
        print(
            f"{name}: found {t.found} of {t.shown}, wrong poses {t.wrong}; false alarms {t.alarms} in {t.absent} "
            f"without it; {t.seconds / max(1, t.pictures):.2f} s a picture"
        )


def composed(args: argparse.Namespace, renderer: Renderer, options: FeatureOptions) -> Iterator[Case]:
    rng = np.random.default_rng(args.seed)
    photos = [cv2.cvtColor(cv2.imread(str(p)), cv2.COLOR_BGR2RGB) for p in sorted(args.photos.glob("*.jpg"))[::4]]
    searches = [FeatureSearch(ObjectModel.load(p, units=args.units), renderer, options) for p in args.meshes]
    while len(searches) < len(args.meshes) + args.procedural:
        model = random_object(rng, photos)
        if model.texture is not None:
            searches.append(FeatureSearch(model, renderer, options))
    for n in range(args.scenes):
        search = searches[n % len(searches)]
        background = backdrop(rng, photos)
        truth, view, mask = scene(rng, search.model, renderer, background, hidden=n % 3 == 2)
        box = mask_box(mask)
        if box is not None:
            yield Case(view, search, truth, disturbed(rng, box) if args.box else None)
            alone = View(worsened(rng, background), CAMERA)
            yield Case(alone, search, None, disturbed(rng, box) if args.box else None)


def backdrop(rng: Rng, photos: list[np.ndarray]) -> np.ndarray:
    return cv2.resize(photo_crop(rng, photos, CAMERA.size), CAMERA.size)


def scene(
    rng: Rng, model: ObjectModel, renderer: Renderer, background: np.ndarray, hidden: bool
) -> tuple[Pose, View, np.ndarray]:
    """The object's T_cam_obj, the picture, and the visible mask."""
    size = np.exp(rng.uniform(np.log(50), np.log(300)))
    depth = CAMERA.fx * model.diameter / size
    pixel = [rng.uniform(0.2, 0.8) * CAMERA.width, rng.uniform(0.2, 0.8) * CAMERA.height]
    truth = Pose(random_rotation(rng), CAMERA.backproject(pixel, depth)) @ model.T_ctr_obj
    light = Light(float(rng.uniform(0.3, 0.7)), tuple(rng.normal(size=3) - [0, 0, 1]), 0.6, 0.2)
    drawn = renderer.render(model, [truth], CAMERA, light=light, coords=False)[0]
    mask = drawn.mask.copy()
    box = mask_box(mask)
    if hidden and box is not None:  # from one side, up to half
        x0, y0, x1, _ = (int(v) for v in box)
        mask[:, x0 : x0 + int(rng.uniform(0.2, 0.5) * (x1 - x0))] = False
    soft = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 0.6)[..., None]
    picture = background * (1 - soft) + drawn.image * soft
    return truth, View(worsened(rng, picture), CAMERA), mask


def worsened(rng: Rng, picture: np.ndarray) -> np.ndarray:
    blurred = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), rng.uniform(0.3, 1.2))
    noisy = blurred * rng.uniform(0.7, 1.2) + rng.normal(0, rng.uniform(1, 6), picture.shape)
    code = cv2.imencode(".jpg", noisy.clip(0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
    return cv2.imdecode(code, cv2.IMREAD_COLOR)


def disturbed(rng: Rng, box: Box) -> Box:
    size = np.tile(np.subtract(box[2:], box[:2]), 2)
    x0, y0, x1, y1 = box + rng.uniform(-0.05, 0.05, 4) * size
    return float(x0), float(y0), float(x1), float(y1)


def photographed(
    data: BopDataset, renderer: Renderer, options: FeatureOptions, boxed: bool, seed: int
) -> Iterator[Case]:
    rng = np.random.default_rng(seed)
    searches = {k: FeatureSearch(data.model(k), renderer, options) for k in data.model_ids()}
    for scene_id, image in data.images():
        view = data.view(scene_id, image)
        instances = data.instances(scene_id, image, every=True)
        for number, search in searches.items():
            mine = [i for i in instances if i.obj_id == number]
            for each in mine:
                if each.visib_fract >= 0.5:
                    box = each.box_visib if boxed else None
                    yield Case(view, search, each.T_cam_obj, disturbed(rng, box) if box else None)
            if not mine:
                yield Case(view, search, None, None)


def is_right(model: ObjectModel, found: Pose, truth: Pose) -> bool:
    a, b = found @ model.T_obj_ctr, truth @ model.T_obj_ctr
    return bool(np.rad2deg(rotation_angle(a.R.T @ b.R)) < 5 and np.linalg.norm(a.t - b.t) < 0.05 * np.linalg.norm(b.t))


if __name__ == "__main__":
    main()

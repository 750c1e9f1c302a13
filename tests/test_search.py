"""One way from detections to poses: the command line, the evaluation and the tracker's search."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from bop_scene import CAMERA, brick, put, write_scene
from objects import bracket
from posekit.camera import Camera, box_iou
from posekit.cli.app import app
from posekit.datasets.bop import BopDataset
from posekit.detect.segmentation import encode, xywh
from posekit.estimate.estimator import EstimateOptions, Estimators
from posekit.estimate.instances import SearchOptions, find_instances, promising, scored_by_poses
from posekit.evaluate import EvalOptions
from posekit.evaluate.stages import ImageStage
from posekit.evaluate.truths import Truth, TruthReader
from posekit.geometry import Pose
from posekit.mesh.model import ObjectModel
from posekit.results import Detection, Estimate, Source
from posekit.tracking.tracker import LOST, TRACKED, Tracker
from posekit.view import View
from test_refine import Oracle

QUICK = EstimateOptions(stop="fixed", iterations=1, hypotheses=2)
BOXES = [(0.0, 0.0, 10.0, 10.0), (1.0, 0.0, 11.0, 10.0), (30.0, 0.0, 40.0, 10.0), (50.0, 0.0, 60.0, 10.0)]
VIEW = View(np.zeros((60, 80, 3), np.uint8), Camera.from_fov(1.0, 80, 60))


# --- the same poses from the command line and from the evaluation ----------------------------------------------------


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("data") / "small", images=1)


@pytest.fixture(scope="module")
def weights(example_folder: Path) -> Path:
    """Weights that nobody trained."""
    return example_folder / "untrained"


def truths(root: Path) -> list[Truth]:
    return TruthReader(BopDataset(root)).read(2, 0)


class Oracles:
    """Stands for the novel detector: the true masks, and a doubtful place."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def detect(self, view: View, models: Sequence[ObjectModel]) -> list[Detection]:
        found = []
        for truth in truths(self.root):
            name = f"obj_{truth.instance.obj_id:06d}"
            assert truth.box_visib is not None
            found.append(Detection(truth.box_visib, truth.read_mask(), 0.9, name, Source.NOVEL))
            away = (0.0, 0.0, 30.0, 30.0)
            found.append(Detection(away, None, 0.2, name, Source.NOVEL))
        return [d for d in found if d.label in [m.name for m in models]]


def commanded(root: Path, weights: Path, obj_id: int, *args: object) -> list[Any]:
    """What ``posekit estimate`` says of the scene's picture: poses and scores, best first."""
    call = ["estimate", root / "test/000002/rgb/000000.png", "--model", root / f"models/obj_{obj_id:06d}.ply"]
    call += ["--camera", ",".join(str(v) for v in (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)), "--json", "-"]
    call += ["--weights", weights, "--units", "mm", "--threads", 1]
    call += ["--stop", "fixed", "--iterations", 1, "--hypotheses", 2, *args]
    result = CliRunner().invoke(app, list(map(str, call)))
    assert result.exit_code == 0, result.output
    return [(e["T_cam_obj"], e["score"]) for e in json.loads(result.stdout)["estimates"]]


def measured(root: Path, weights: Path, detections: str) -> dict[int, list[Any]]:
    options = EvalOptions("estimate", root=root, detections=detections, weights=weights, estimate=QUICK)
    found: dict[int, list[Any]] = {1: [], 2: []}
    for entry in ImageStage(options).run(2, 0)["estimates"]:
        found[entry["obj_id"]].append((entry["T_cam_obj"], entry["score"]))
    return found


@pytest.fixture(scope="module")
def file(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Detections of both objects: a mask, a box beside it, a box that overlaps with another."""
    entries = []
    for truth in truths(root):
        box, mask = truth.box_visib, truth.read_mask()
        assert box is not None
        entry = {"scene_id": 2, "image_id": 0, "category_id": truth.instance.obj_id, "time": 0.1}
        entries.append(entry | {"score": 0.4, "bbox": xywh(box), "segmentation": encode(mask)})
        near = (box[0] + 1, box[1], box[2] + 1, box[3])
        entries.append(entry | {"score": 0.6, "bbox": xywh(near)})
        entries.append(entry | {"score": 0.1, "bbox": [0.0, 0.0, 30.0, 30.0]})
    path = tmp_path_factory.mktemp("found") / "found.json"
    put(path, entries)
    return path


@pytest.mark.parametrize("kind", ["gt-boxes", "gt-masks", "file", "detector"])
def test_the_command_and_the_evaluation_find_the_same_poses(
    kind: str, root: Path, weights: Path, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for place in ("posekit.detect.novel.make_detector", "posekit.evaluate.stages.make_detector"):
        monkeypatch.setattr(place, lambda *_, **__: (Oracles(root), ()))
    likely = (15.4, -1.97, -0.94, 5.0)  # poses of untrained networks would be no instances
    monkeypatch.setattr("posekit.estimate.estimator.EXISTENCE", likely)
    found = measured(root, weights, str(file) if kind == "file" else kind)
    for truth in truths(root):
        obj_id, box = truth.instance.obj_id, truth.box_visib
        assert box is not None
        mask = next((root / "test/000002/mask_visib").glob(f"000000_{truth.instance.index:06d}.png"))
        where: dict[str, list[object]] = {
            "gt-boxes": ["--box", ",".join(str(v) for v in box)],
            "gt-masks": ["--mask", mask],
            "file": ["--detections", file],
            "detector": ["--instances", 9],
        }
        assert found[obj_id], "nothing to compare"
        assert commanded(root, weights, obj_id, *where[kind]) == found[obj_id]


def test_meshes_share_one_copy_of_the_networks(weights: Path) -> None:
    estimators = Estimators(weights=weights, options=QUICK)
    first, second = bracket(), brick()
    assert estimators(first) is estimators(first) and estimators(first) is not estimators(second)
    assert estimators(first).networks is estimators(second).networks
    assert estimators(second).model is second and estimators(second).options is QUICK


# --- the policy ------------------------------------------------------------------------------------------------------


class Fixed:
    """Estimates as they are given; they name the detection that they started from."""

    def __init__(self, scores: Sequence[float], boxes: Sequence[tuple[float, float, float, float]] = BOXES) -> None:
        self.scores, self.asked = dict(zip(boxes, scores, strict=False)), []  # type: ignore[var-annotated]
        self.quick: dict[tuple[float, float, float, float], float] = {}

    def screen(self, view: View, detections: Sequence[Detection]) -> list[float]:
        return [self.quick.get(d.box, 0.0) for d in detections]

    def estimate(self, view: View, detections: Sequence[Detection], min_score: float = 0.0) -> list[Estimate]:
        self.asked.append(min_score)
        return [
            Estimate(Pose.identity(), 0.0, 1, True, self.scores[d.box], d.box, "m", d)
            for d in detections
            if d.box in self.scores
        ]


MODEL = bracket()


def kept(fixed: Fixed, source: Source, options: SearchOptions | None = None) -> list[float]:
    detections = [Detection(box, None, 0.56, MODEL.name, source) for box in BOXES]
    [found] = find_instances(lambda _: fixed, VIEW, [MODEL], detections, options)
    return [e.score for e in found.instances]


def test_instances_are_what_scores_and_does_not_overlap() -> None:
    fixed = Fixed([0.6, 0.8, 0.5, 0.1])
    assert kept(fixed, Source.BOX, SearchOptions(instances=0, min_score=0.3)) == [0.8, 0.5]
    assert kept(fixed, Source.BOX, SearchOptions(instances=1, min_score=0.3)) == [0.8]
    assert kept(fixed, Source.BOX, SearchOptions(min_score=0.9)) == []
    assert box_iou(BOXES[0], BOXES[1]) == pytest.approx(9 / 11)
    assert box_iou(BOXES[0], BOXES[2]) == 0 and box_iou(BOXES[0], (0, 20, 10, 30)) == 0


def test_what_is_kept_depends_on_who_says_where_the_object_is() -> None:
    fixed = Fixed([0.6, 0.8, 0.5, 0.1])
    for source in (Source.BOX, Source.GRABCUT, Source.FILLED, Source.MASK):
        assert kept(fixed, source) == [0.8, 0.6, 0.5, 0.1], "as a person says"
    assert kept(fixed, Source.FILE) == [0.8, 0.5, 0.1], "all that do not overlap"
    assert kept(fixed, Source.NOVEL) == kept(fixed, Source.TRAINED) == [0.8], "the best one, confirmed"
    assert SearchOptions.usual([]) == SearchOptions()
    assert SearchOptions.usual([Detection(BOXES[0]), Detection(BOXES[1], source=Source.FILE)]).overlap == 0.5
    assert SearchOptions.usual([Detection(BOXES[0]), Detection(BOXES[1], source=Source.TRAINED)]).min_score == 0.5


def test_the_search_ends_with_as_many_sure_instances_as_are_wanted() -> None:
    def asked(scores: Sequence[float], source: Source = Source.NOVEL, **options: Any) -> int:
        fixed = Fixed(scores)
        kept(fixed, source, SearchOptions(candidates=4, **{"sure": 0.95, **options}))
        return len(fixed.asked)

    assert asked([0.96, 0.97, 0.99, 0.5]) == 1
    assert asked([0.9, 0.5, 0.96, 0.5]) == 3
    assert asked([0.96, 0.97, 0.99, 0.5], instances=2) == 3, "the second lies on the first"
    assert asked([0.96, 0.97, 0.99, 0.5], instances=0) == asked([0.96] * 4, Source.BOX) == 4
    assert asked([0.96, 0.97, 0.99, 0.5], sure=0.98) == 3


def test_a_detection_belongs_to_the_model_of_its_label() -> None:
    models, fixed = [bracket(), brick()], Fixed([0.6, 0.8, 0.7])
    labels = ["brick", "bracket", None]
    detections = [Detection(box, None, 1.0, label) for box, label in zip(BOXES, labels, strict=False)]
    first, second = find_instances(lambda _: fixed, VIEW, models, detections)
    assert (first.model, second.model) == tuple(models)
    assert [[e.score for e in f.instances] for f in (first, second)] == [[0.8, 0.7], [0.7, 0.6]]


@pytest.mark.parametrize("source", [Source.NOVEL, Source.TRAINED])
def test_detections_are_judged_by_their_poses(source: Source) -> None:
    fixed = Fixed([0.2, 0.7], BOXES[1:3])
    detections = [Detection(box, None, 0.56, MODEL.name, source) for box in BOXES[:3]]
    [found] = find_instances(lambda _: fixed, VIEW, [MODEL], detections, SearchOptions())
    assert [(d.box, d.score) for d in scored_by_poses(found)] == [(BOXES[2], 0.7), (BOXES[1], 0.2), (BOXES[0], 0.0)]


@pytest.mark.parametrize(("score", "state"), [(0.45, LOST), (0.55, TRACKED)])
def test_the_tracker_asks_what_the_others_ask(score: float, state: str) -> None:
    """A pose is an instance from a score of 0.5 on, for whoever looks for it."""
    place = Pose(np.eye(3), [0.0, 0.0, 0.4])
    fixed = Fixed([score])

    class Placed(Fixed):
        model = MODEL

        def estimate(self, view: View, detections: Sequence[Detection], min_score: float = 0.0) -> list[Estimate]:
            return [dataclasses.replace(e, T_cam_obj=place) for e in fixed.estimate(view, detections, min_score)]

    from posekit.render import Renderer

    estimator = Placed([score])
    estimator.renderer = Renderer()  # type: ignore[attr-defined]

    class Detector:
        def detect(self, view: View, models: Sequence[ObjectModel]) -> list[Detection]:
            return [Detection(BOXES[0], None, 0.9, MODEL.name, Source.TRAINED)]

    image = np.full((120, 160, 3), 128, np.uint8)
    tracker = Tracker(MODEL, CAMERA, estimator=estimator, detector=Detector(), predictor=Oracle(MODEL, place))  # type: ignore[arg-type]
    assert tracker.step(image).state == state


def test_the_most_promising_of_many_proposals_are_estimated() -> None:
    """Similarity and a quick look count; detections of others keep their places."""
    boxes = [(10.0 * k, 0.0, 10.0 * k + 8.0, 8.0) for k in range(6)]
    fixed, model = Fixed([0.9] * 6, boxes), bracket()
    fixed.quick = {boxes[4]: 5.0, boxes[1]: -50.0}
    novel = [Detection(box, None, 0.9 - 0.01 * k, model.name, Source.NOVEL) for k, box in enumerate(boxes)]
    given = Detection((90.0, 0.0, 98.0, 8.0), None, 0.1, model.name, Source.FEATURES)
    view = View(np.zeros((100, 100, 3), np.uint8), Camera(100.0, 100.0, 50.0, 50.0, 100, 100))
    chosen = promising(lambda _: fixed, model, view, [given, *novel], 3)
    assert [d.box for d in chosen] == [given.box, boxes[4], boxes[0], boxes[2]]
    assert promising(lambda _: fixed, model, view, novel[:3], 3) == novel[:3], "few are not screened"

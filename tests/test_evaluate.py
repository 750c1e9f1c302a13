"""posekit eval: scores of known estimates, malformed files, workers, interruption, results and report.

Detections in files. Accepted: BOP's list, or its entries one a line; numbers as text, a byte order mark. Warned about
and skipped, with the line: an entry that cannot be used, repeats another, is of no picture or object of the data set,
or does not fit its picture. Warned about and read: boxes that only fit as x0, y0, x1, y1. Refused: other files, and
those without an entry that can be used. Results in CSV. Accepted: BOP's. Refused, with the line: all else.
"""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from bop_scene import CAMERA, put, write_scene
from posekit.cli.app import app
from posekit.datasets.bop import BopDataset
from posekit.datasets.results_csv import COLUMNS, ResultRow, csv_name, read_detections, read_results, results_csv
from posekit.errors import InputError, OutputError
from posekit.estimate.estimator import EstimateOptions
from posekit.evaluate import EvalOptions, compare, evaluate
from posekit.evaluate.stages import ImageStage, detections_for
from posekit.evaluate.table import novelty
from posekit.evaluate.truths import TruthReader
from posekit.geometry import Pose, so3_exp
from posekit.mesh.model import ObjectModel
from posekit.results import Detection
from posekit.view import View

QUICK = EstimateOptions(stop="fixed", iterations=1, hypotheses=1)
QUICK_ARGS = ["--stop", "fixed", "--iterations", "1", "--hypotheses", "1"]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("data") / "small", images=4)


@pytest.fixture(scope="module")
def deep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("data") / "deep", images=2, depth=True)


def truth_rows(root: Path, move: Pose | None = None, seconds: float = 0.5) -> list[ResultRow]:
    """The ground truth as estimates; ``move`` is applied in the camera's frame."""
    data = BopDataset(root)
    rows = []
    for scene, image in data.images():
        for i in data.instances(scene, image):
            pose = i.T_cam_obj if move is None else Pose(move.R @ i.T_cam_obj.R, i.T_cam_obj.t + move.t)
            rows.append(ResultRow(scene, image, i.obj_id, 1.0, pose.R, pose.t, seconds))
    return rows


def scored(root: Path, rows: list[ResultRow], tmp_path: Path, **more: Any) -> dict[str, Any]:
    csv = tmp_path / f"{len(list(tmp_path.iterdir()))}.csv"
    csv.write_text(results_csv(rows))
    out = tmp_path / f"out-{csv.stem}"
    return evaluate(EvalOptions("score", root=root, **more), out, csv=csv).results


def run(*args: object) -> Result:
    return CliRunner().invoke(app, ["eval", *map(str, args)])


# --- scores of known estimates ---------------------------------------------------------------------------------------


def test_the_truth_scores_exactly_100(deep: Path, tmp_path: Path) -> None:
    results = scored(deep, truth_rows(deep), tmp_path)
    assert results["counts"] == {"instances": 4, "estimates": 4, "missing": 0}
    for figures in (results["mean"], results["pooled"], *results["per_object"].values()):
        values = {k: v for k, v in figures.items() if isinstance(v, float) and not k.endswith("auc")}
        assert {"2deg_2cm", "add_01d", "vsd_ar", "mssd_ar", "mspd_ar", "ar"} <= set(values)
        assert set(values.values()) == {100.0}
        assert figures["add_auc"] == pytest.approx(100.0, abs=1e-9)
    assert results["mean"]["ap"] == 100.0


def test_a_known_shift_gives_the_expected_figures(root: Path, tmp_path: Path) -> None:
    """3 cm across the view: within (5, 5) but not (2, 2); ADD and MSSD are 3 cm; f / z times that in the picture."""
    results = scored(root, truth_rows(root, Pose.translation([0.03, 0, 0])), tmp_path)
    mean, first = results["mean"], results["per_object"]["1"]
    assert (mean["2deg_2cm"], mean["5deg_5cm"], mean["10deg_10cm"]) == (0, 100, 100)
    assert first["add_01d"] == 0
    assert first["add_auc"] == pytest.approx(70.0)
    for obj_id, entry in results["per_object"].items():
        diameter = BopDataset(root).measured_model(int(obj_id)).diameter
        assert entry["mssd_ar"] == pytest.approx(100 * (0.03 / diameter < np.linspace(0.05, 0.5, 10)).mean())
    for instance in results["instances"]:
        errors = instance["errors"]
        diameter = BopDataset(root).measured_model(instance["obj_id"]).diameter
        assert errors["translation_cm"] == pytest.approx(3.0)
        assert errors["mssd_share"] * diameter == pytest.approx(0.03, rel=1e-6)
        depth = BopDataset(root).instances(2, instance["image"])[instance["index"]].T_cam_obj.t[2]
        assert errors["proj_px"] == pytest.approx(CAMERA.fx * 0.03 / depth, rel=0.2)
        assert errors["mspd_px"] > errors["proj_px"] * 640 / 160  # the largest, in a picture 640 pixels wide


def test_a_known_turn_gives_the_expected_figures(root: Path, tmp_path: Path) -> None:
    results = scored(root, truth_rows(root, Pose.rotation(so3_exp([0, 0, np.deg2rad(4)]))), tmp_path)
    assert [results["mean"][k] for k in ("2deg_2cm", "5deg_5cm", "10deg_10cm")] == [0, 100, 100]
    assert results["instances"][0]["errors"]["rotation_deg"] == pytest.approx(4.0)


def test_a_symmetric_estimate_is_right_where_symmetries_count(root: Path, tmp_path: Path) -> None:
    half = Pose(np.diag([-1.0, -1, 1]), [0, 0, 0])
    rows = []
    for row in truth_rows(root):
        pose = Pose(row.R, row.t) @ half
        rows.append(ResultRow(row.scene, row.image, row.obj_id, 1.0, pose.R, pose.t, 0.5))
    entries = scored(root, rows, tmp_path)["per_object"]
    assert (entries["2"]["2deg_2cm"], entries["2"]["2deg_2cm_sym"], entries["2"]["mssd_ar"]) == (0, 100, 100)
    assert (entries["2"]["mspd_ar"], entries["2"]["add_01d"]) == (100, 100)
    assert (entries["1"]["2deg_2cm"], entries["1"]["2deg_2cm_sym"], entries["1"]["add_01d"]) == (0, 0, 0)


def test_a_missing_estimate_is_a_failure(root: Path, tmp_path: Path) -> None:
    rows = [r for r in truth_rows(root) if not (r.obj_id == 1 and r.image == 0)]
    results = scored(root, rows, tmp_path)
    assert results["counts"]["missing"] == 1
    assert results["per_object"]["1"]["2deg_2cm"] == 75.0
    assert results["mean"]["2deg_2cm"] == 87.5  # unweighted over two objects
    assert results["pooled"]["mssd_ar"] == pytest.approx(87.5)
    assert results["mean"]["ap"] < 100


def test_only_the_best_scored_estimates_count_and_false_ones_cost_precision(root: Path, tmp_path: Path) -> None:
    rows = truth_rows(root)
    wrong = [ResultRow(r.scene, r.image, r.obj_id, 2.0, r.R, r.t + [0, 0, 1.0], 0.5) for r in rows if r.image == 1]
    results = scored(root, rows + wrong, tmp_path)
    assert results["mean"]["mssd_ar"] == 75.0
    assert 0 < results["mean"]["ap"] < 100
    unsure = [ResultRow(r.scene, r.image, r.obj_id, 0.1, r.R, r.t, 0.5) for r in wrong]
    assert scored(root, rows + unsure, tmp_path)["mean"]["mssd_ar"] == 100.0


def test_several_instances_of_an_object(tmp_path: Path) -> None:
    root = write_scene(tmp_path / "twins", images=1)
    path = root / "test/000002/scene_gt.json"
    truth = json.loads(path.read_text())
    truth["0"][1]["obj_id"] = 1
    put(path, truth)
    rows = truth_rows(root)
    (tmp_path / "runs").mkdir()
    results = scored(root, rows[::-1], tmp_path / "runs")
    assert results["mean"]["mssd_ar"] == pytest.approx(100.0)
    assert results["mean"]["2deg_2cm"] == 100.0
    twice = [ResultRow(r.scene, r.image, 1, 1.0 - 0.1 * k, rows[0].R, rows[0].t, 0.5) for k, r in enumerate(rows)]
    results = scored(root, twice, tmp_path / "runs")
    assert results["mean"]["2deg_2cm"] == 50.0  # the second estimate of the same instance finds nothing


def test_vsd_of_a_shift_in_depth(deep: Path, tmp_path: Path) -> None:
    results = scored(deep, truth_rows(deep, Pose.translation([0, 0, 0.004])), tmp_path)
    assert 80 < results["mean"]["vsd_ar"] < 100
    without = evaluate(
        EvalOptions("score", root=deep), tmp_path / "no", csv=tmp_path / "0.csv", with_vsd=False
    ).results["mean"]
    assert "vsd_ar" not in without and "ar" not in without


# --- malformed files -------------------------------------------------------------------------------------------------


def known(root: Path) -> tuple[dict[tuple[int, int], tuple[()]], list[int]]:
    data = BopDataset(root)
    return dict.fromkeys(data.images(), ()), data.model_ids()


HEAD = ",".join(COLUMNS)
R9 = "1 0 0 0 1 0 0 0 1"
GOOD = f"2,0,1,0.5,{R9},0 0 500,0.1"


@pytest.mark.parametrize(
    ("text", "line", "reason"),
    [
        ("", None, "is empty"),
        (HEAD.replace(",score", ""), 1, "score are missing"),
        (f"{HEAD}\n{GOOD}\n2,1,1,0.5,{R9},0 0 500", 3, "6 fields where the header has 7"),
        (f"{HEAD}\n2,0,1,0.5,1 0 0 0 1 0 0 0,0 0 500,0.1", 2, "R has 8 numbers; needed: 9"),
        (f"{HEAD}\n2,0,1,0.5,{R9},0 500,0.1", 2, "t has 2 numbers; needed: 3"),
        (f"{HEAD}\n2,0,1,nan,{R9},0 0 500,0.1", 2, "not finite"),
        (f"{HEAD}\n{GOOD}\n2,1,1,0.5,{R9},0 0 inf,0.1", 3, "not finite"),
        (f"{HEAD}\n2,0,1,0.5,{R9.replace('1', 'x', 1)},0 0 500,0.1", 2, "is not made of numbers"),
        (f"{HEAD}\n2,0,1,0.5,{R9.replace('1', '2', 1)},0 0 500,0.1", 2, "R is no rotation"),
        (f"{HEAD}\n7,0,1,0.5,{R9},0 0 500,0.1", 2, "scene 7 is not in the data set, which has 2"),
        (f"{HEAD}\n2,99,1,0.5,{R9},0 0 500,0.1", 2, "scene 2 has no image 99"),
        (f"{HEAD}\n2,0,5,0.5,{R9},0 0 500,0.1", 2, "object 5 is not in the data set, which has 1, 2"),
        (f"{HEAD}\n2,0,one,0.5,{R9},0 0 500,0.1", 2, "obj_id 'one' is no whole number"),
        (f"{HEAD}\n{GOOD}\n{GOOD}", 3, "the row repeats line 2"),
        (f"{HEAD}\n{GOOD}\n2,0,2,0.5,{R9},0 0 500,0.2", 3, "time 0.2 differs from 0.1 in line 2"),
    ],
)
def test_a_malformed_csv_is_refused_with_its_line(
    root: Path, tmp_path: Path, text: str, line: int | None, reason: str
) -> None:
    path = tmp_path / "results.csv"
    path.write_text(text + "\n" if text else "")
    with pytest.raises(InputError, match=reason) as refusal:
        read_results(path, *known(root))
    if line is not None:
        assert f"line {line}:" in str(refusal.value)


def test_a_csv_comes_back_as_it_was_written(root: Path, tmp_path: Path) -> None:
    rows = truth_rows(root)
    path = tmp_path / "results.csv"
    path.write_text(results_csv(rows))
    back = read_results(path, *known(root))
    assert [(r.scene, r.image, r.obj_id, r.time) for r in back] == [(r.scene, r.image, r.obj_id, r.time) for r in rows]
    np.testing.assert_allclose([r.t for r in back], [r.t for r in rows], rtol=1e-15)
    np.testing.assert_array_equal([r.R for r in back], [r.R for r in rows])
    assert csv_name("posekit_lite", "lmo", "test") == "posekit-lite_lmo-test.csv"


ENTRY = {"scene_id": 2, "image_id": 0, "category_id": 1, "score": 0.9, "bbox": [1, 2, 30, 40], "time": 0.1}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"bbox": [1, 2, 3]}, "bbox has four numbers"),
        ({"bbox": [1, 2, 0, 4]}, "bbox has the size 0x4"),
        ({"score": float("nan")}, "finite numbers"),
        ({"category_id": 77}, "category 77 is not in the data set"),
        ({"image_id": 99}, "scene 2 has no image 99"),
        ({"image_id": "x"}, "whole numbers"),
        ({"score": 10**400}, "finite numbers"),
        ({"segmentation": {"size": [2, 2], "counts": [1, 1]}}, "counts that fill it"),
        ({"time": 0.3, "score": 0.1}, "time 0.3 differs from 0.1 in line 2"),
        ({}, "it repeats line 2"),
    ],
)
def test_a_bad_entry_of_detections_is_skipped_and_told(
    root: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, change: dict[str, object], reason: str
) -> None:
    path = tmp_path / "detections.json"
    path.write_text("[\n" + json.dumps(ENTRY) + ",\n" + json.dumps(ENTRY | change) + "\n]")
    found = read_detections(path, *known(root))
    assert [(r.line, r.obj_id, r.score) for regions in found.values() for r in regions] == [(2, 1, 0.9)]
    assert caplog.text.count("skipped") == 1
    assert reason in caplog.text and f"{path}, line 3: the entry is skipped" in caplog.text


def test_numbers_that_are_text_are_read(root: Path, tmp_path: Path) -> None:
    path = tmp_path / "detections.json"
    path.write_text("\ufeff" + json.dumps([ENTRY | {"scene_id": "2", "image_id": "0", "category_id": "1"}]))
    assert [(r.scene, r.image, r.obj_id) for r in read_detections(path, *known(root))[2, 0]] == [(2, 0, 1)]


def test_one_detection_a_line_is_read_and_an_empty_file_is_told(
    root: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "detections.json"
    path.write_text(f"{json.dumps(ENTRY)}\n\n{json.dumps(ENTRY | {'image_id': 99})}\n")
    assert [r.line for r in read_detections(path, *known(root))[2, 0]] == [1]
    assert f"{path}, line 3" in caplog.text and "has no image 99" in caplog.text
    path.write_text("[]")
    assert read_detections(path, *known(root)) == {}
    assert f"{path} holds no detections at all" in caplog.text


def test_many_bad_entries_are_counted_and_nothing_else_is_refused(
    root: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "detections.json"
    bad = [ENTRY | {"image_id": 900 + k} for k in range(50)]
    path.write_text(json.dumps([ENTRY, *bad]))
    assert sum(map(len, read_detections(path, *known(root)).values())) == 1
    assert len(caplog.records) == 11 and "50 entries in all are skipped, 1 are used" in caplog.text
    path.write_text(json.dumps(bad))
    with pytest.raises(InputError, match="has 50 entries and none that can be used; line 1: scene 2 has no image 900"):
        read_detections(path, *known(root))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('{"a": 1}', "line 1: a detections file for a data set is a JSON list"),
        ("[\n{]", "line 2"),
        ("[\n1]", "none that can be used; line 2: an entry is"),
        ('[\n{"scene_id": 1}]', "line 2: image_id, category_id, score, bbox missing"),
        ("[\n" + "[" * 100_000, "line 2"),
        ("[\n" + "9" * 5000 + "]", "line 2"),
    ],
)
def test_what_is_no_list_of_detections(root: Path, tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "detections.json"
    path.write_text(text)
    with pytest.raises(InputError, match=reason):
        read_detections(path, *known(root))


# --- stages ----------------------------------------------------------------------------------------------------------


def test_masks_that_are_missing_are_rendered(tmp_path: Path, root: Path) -> None:
    bare = write_scene(tmp_path / "bare", images=1, masks=False)
    [first, second] = TruthReader(BopDataset(bare)).read(2, 0)
    [known_first, known_second] = TruthReader(BopDataset(root)).read(2, 0)
    for made, given in ((first, known_first), (second, known_second)):
        assert (made.source, given.source) == ("rendered", "data set")
        np.testing.assert_array_equal(made.read_mask(), given.read_mask())
        assert made.visible == pytest.approx(given.visible)
        assert made.box_visib == given.box_visib and made.box_all == given.box_all


def test_objects_without_a_mesh_are_left_out_and_told(
    tmp_path: Path, root: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bare = write_scene(tmp_path / "bare", images=2, masks=False)
    rows = truth_rows(bare)
    (bare / "models" / "obj_000002.ply").unlink()
    assert [t.instance.obj_id for t in TruthReader(BopDataset(bare)).read(2, 0)] == [1]
    assert "object 2 has no mesh and is left out, here and in all other pictures; there are meshes of 1" in caplog.text
    for visible in (None, 0.1):
        results = scored(bare, [row for row in rows if row.obj_id == 1], tmp_path, min_visible=visible)
        assert results["counts"] == {"instances": 2, "estimates": 2, "missing": 0}


def test_noise_is_the_instance_s_own(root: Path) -> None:
    starts = []
    for images in (((2, 0), (2, 1)), ((2, 1),)):
        stage = ImageStage(EvalOptions("refine", root=root, images=images, estimate=QUICK))
        starts.append([e["start"] for e in stage.run(2, 1)["estimates"]])
    assert starts[0] == starts[1]
    assert starts[0][0] != starts[0][1]
    other = ImageStage(EvalOptions("refine", root=root, seed=1, estimate=EstimateOptions(stop="fixed", iterations=1)))
    assert [e["start"] for e in other.run(2, 1)["estimates"]] != starts[0]


def test_estimates_from_a_detections_file(root: Path, tmp_path: Path) -> None:
    from pycocotools import mask as coco

    mask = TruthReader(BopDataset(root)).read(2, 0)[0].read_mask()
    rle = coco.encode(np.asfortranarray(mask.astype(np.uint8)))
    rle["counts"] = rle["counts"].decode()
    box = [float(v) for v in coco.toBbox(rle)]
    entries = [ENTRY | {"bbox": box, "segmentation": rle}]
    path = tmp_path / "detections.json"
    path.write_text(json.dumps(entries))
    options = EvalOptions("estimate", root=root, images=((2, 0),), detections=str(path), estimate=QUICK)
    results = evaluate(options, tmp_path / "out").results
    assert results["counts"] == {"instances": 2, "estimates": 1, "missing": 1}
    names = ("coco_box_ap", "coco_box_ap50", "coco_mask_ap", "coco_mask_ap50")
    assert results["detection_ap"] == pytest.approx(dict.fromkeys(names, 50.0))
    [found] = [e for e in results["instances"] if e["found"]]
    assert found["detection_score"] == 0.9


def test_detections_that_do_not_fit_the_picture_are_skipped(
    root: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    box = [float(v) for v in (5, 5, 40, 40)]
    wrong = [
        {"score": 0.1, "bbox": [900.0, 5.0, 4.0, 4.0]},
        {"score": 0.2, "segmentation": {"size": [2, 3], "counts": [6]}},
        {"score": 0.3, "segmentation": {"size": [CAMERA.height, CAMERA.width], "counts": "~~~"}},
    ]
    path = tmp_path / "detections.json"
    path.write_text("[" + ",\n".join(json.dumps(ENTRY | {"bbox": box} | change) for change in ({}, *wrong)) + "]")
    options = EvalOptions("estimate", root=root, images=((2, 0),), detections=str(path), estimate=QUICK)
    record = ImageStage(options).run(2, 0)
    assert record["detections"]["1"]["scores"] == [0.9]
    for line, reason in ((2, "outside"), (3, "a mask is 3x2"), (4, "run lengths")):
        assert f"line {line} (scene 2, image 0): the entry is skipped" in caplog.text and reason in caplog.text


def test_boxes_with_corners_are_noticed(root: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """x0, y0, x1, y1 near the right lower corner cannot be x, y, width, height."""
    width, height = CAMERA.size
    corners = [width - 40.0, height - 30.0, width - 2.0, height - 1.0]
    path = tmp_path / "detections.json"
    path.write_text(json.dumps([ENTRY | {"bbox": corners}]))
    options = EvalOptions("estimate", root=root, images=((2, 0),), detections=str(path), estimate=QUICK)
    [region] = detections_for(BopDataset(root), options)[2, 0]
    assert region.box == tuple(corners) and "x0, y0, x1, y1: they are taken for the latter" in caplog.text


def test_objects_by_name(root: Path, tmp_path: Path) -> None:
    named = write_scene(tmp_path / "named", images=1)
    first, *others = BopDataset(named).model_ids()
    (named / "objects.json").write_text(json.dumps({str(first): "Left_hand bracket", "99": "elsewhere"}))
    out = tmp_path / "out"
    done = run("--stage", "refine", "--root", named, "--objects", "left hand bracket", "--out", out, *QUICK_ARGS)
    assert done.exit_code == 0, done.output
    assert f"{first} Left_hand bracket" in done.output
    assert set(json.loads((out / "results.json").read_text())["per_object"]) == {str(first)} and others
    wrong = run("--stage", "refine", "--root", named, "--objects", "elsewhere", "--out", out)
    assert wrong.exit_code == 1 and "it has" in wrong.output and "Left_hand bracket" in wrong.output
    assert run("--stage", "refine", "--root", root, "--objects", "ape").exit_code == 1
    (named / "objects.json").write_text("[]")
    broken = run("--stage", "refine", "--root", named, "--out", tmp_path / "b")
    assert broken.exit_code == 1 and "objects.json" in broken.output


def test_estimates_from_a_detector(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that knows the masks of half of the objects, and sees one where there is none."""
    data = BopDataset(root)
    truth = TruthReader(data).read(2, 0)[0]
    mask, box = truth.read_mask(), truth.box_visib
    assert box is not None
    away = np.zeros_like(mask)
    away[:40, -40:] = True
    name = data.model(truth.instance.obj_id).name
    asked: list[tuple[str, int]] = []

    class Oracle:
        def detect(self, view: View, models: Sequence[ObjectModel]) -> list[Detection]:
            assert [m.name for m in models] == [data.model(k).name for k in data.model_ids()]
            width = view.camera.width
            return [Detection(box, mask, 0.9, name), Detection((width - 40, 0, width, 40), away, 0.5, name)]

    def make(detector: str, models: Sequence[ObjectModel], **_: Any) -> tuple[Oracle, tuple[str, ...]]:
        asked.append((detector, len(models)))
        return Oracle(), ()

    monkeypatch.setattr("posekit.evaluate.stages.make_detector", make)
    options = EvalOptions(
        "estimate", root=root, images=((2, 0),), detections="detector", detector="mine", estimate=QUICK
    )
    results = evaluate(options, tmp_path / "out").results
    assert asked == [("mine", len(data.model_ids()))]
    names = ("coco_box_ap", "coco_box_ap50", "coco_mask_ap", "coco_mask_ap50")
    assert results["detection_ap"] == pytest.approx(dict.fromkeys(names, 50.0))
    assert results["counts"]["instances"] == 2 and results["counts"]["missing"] >= 1
    found = [e for e in results["instances"] if e["found"]]
    assert {e["obj_id"] for e in found} <= {truth.instance.obj_id} and all(e["detection_score"] == 0.9 for e in found)


# --- the command, workers, interruption ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def alone(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A refine run in one process."""
    out = tmp_path_factory.mktemp("runs") / "alone"
    result = run("--stage", "refine", "--root", root, "--out", out, *QUICK_ARGS)
    assert result.exit_code == 0, result.output
    assert "mean over objects" in result.output and "over all instances" in result.output
    return out


def tables(out: Path) -> Any:
    """What must not depend on how a run went."""
    results = json.loads((out / "results.json").read_text())
    for entry in results["instances"]:
        entry.pop("seconds")
    return [results[k] for k in ("counts", "mean", "pooled", "per_object", "instances")]


def test_what_a_run_leaves(alone: Path, root: Path) -> None:
    results = json.loads((alone / "results.json").read_text())
    assert results["schema"] == 1 and results["stage"] == "refine"
    assert results["weights"]["hash"] and results["commit"] and results["machine"]
    assert results["per_object"]["1"]["novelty"] == "novel"
    assert [novelty(known, "a") for known in (None, frozenset("ab"), frozenset("b"))] == ["unknown", "seen", "novel"]
    assert len(results["instances"]) == results["counts"]["instances"] == 8
    assert len(results["instances"][0]["trace"]) == 1
    assert results["seconds_per_instance"]["median"] > 0
    rows = read_results(alone / "posekit-lite-refine_small-test.csv", *known(root))
    assert len(rows) == 8 and len({r.time for r in rows}) == 4


def test_the_report_stands_alone(alone: Path) -> None:
    page = (alone / "report.html").read_text()
    assert page.startswith("<!doctype html>")
    assert "http://" not in page.replace("http://www.w3.org", "") and "https://" not in page and "<script" not in page
    for title in ("Per object", "Recall against threshold", "Errors", "Refinement", "Best cases", "Worst cases"):
        assert f"<h2>{title}</h2>" in page
    assert page.count("data:image/jpeg;base64,") == 8
    assert "What the columns mean" in page and "<td>object " in page, "a number is no name, and is said once"


def test_true_masks_are_said_where_they_are_used(alone: Path, root: Path, tmp_path: Path) -> None:
    """By the table's title and a line below it, in results.json, and in the report; standard output is JSON alone."""
    args = ("--stage", "refine", "--root", root, "--masks", "true", "--images", "2/0", "--json", "-", *QUICK_ARGS)
    done = run(*args, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    results = json.loads(done.stdout)
    assert results == json.loads((tmp_path / "out" / "results.json").read_text())
    assert results["true_masks"] and results["title"].endswith(": refine, true masks")
    assert "refine, true masks, percent" in done.stderr and "True masks: drawn from the annotated poses" in done.stderr
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("refine, true masks") == 2 and "True masks: drawn" in page
    without = json.loads((alone / "results.json").read_text())
    assert not without["true_masks"] and "rue masks" not in (alone / "report.html").read_text()
    titles = [EvalOptions("estimate", detections=d).title for d in ("gt-boxes", "gt-masks", "detector")]
    assert titles == ["estimate from true boxes", "estimate, true masks", "estimate"]
    assert EvalOptions("estimate").detections == "gt-boxes" and EvalOptions("refine").masks == "none"


def test_the_csv_of_a_run_scores_as_the_run(alone: Path, root: Path, tmp_path: Path) -> None:
    csv = alone / "posekit-lite-refine_small-test.csv"
    result = run("--stage", "score", "--root", root, "--csv", csv, "--out", tmp_path / "s")
    assert result.exit_code == 0, result.output
    again = json.loads((tmp_path / "s/results.json").read_text())
    before = json.loads((alone / "results.json").read_text())
    assert again["mean"] == pytest.approx(before["mean"])


def test_workers_change_nothing(alone: Path, root: Path, tmp_path: Path) -> None:
    done = command("--stage", "refine", "--root", root, "--out", tmp_path / "two", "--workers", "2", *QUICK_ARGS)
    assert done.wait(180) == 0, done.stderr.read() if done.stderr else ""
    assert tables(tmp_path / "two") == tables(alone)


def test_a_killed_run_goes_on_and_ends_with_the_same_table(alone: Path, root: Path, tmp_path: Path) -> None:
    out, chance = tmp_path / "killed", random.Random(5)
    args = ("--stage", "refine", "--root", root, "--out", out, *QUICK_ARGS)
    for goal in (1, 3):
        process = command(*args)
        deadline = time.monotonic() + 180
        while len(list(out.glob("pictures/*.json"))) < goal and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.002)
        time.sleep(chance.uniform(0, 0.05))
        process.kill()
        code = process.wait()
        assert goal > 1 or code == -signal.SIGKILL  # a fast machine may be done with the rest in the second round
        kept = {p: p.stat().st_mtime_ns for p in out.glob("pictures/*.json")}
        assert len(kept) >= goal
        assert all(json.loads(p.read_text())["estimates"] for p in kept)  # no half-written record
    assert command(*args).wait(180) == 0
    assert {p: p.stat().st_mtime_ns for p in kept} == kept  # what was finished was not computed again
    assert tables(out) == tables(alone)


def command(*args: object) -> subprocess.Popen[str]:
    call = [sys.executable, "-m", "posekit", "eval", *map(str, args)]
    return subprocess.Popen(call, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def test_another_run_is_not_overwritten(alone: Path, root: Path, tmp_path: Path) -> None:
    result = run("--stage", "refine", "--root", root, "--out", alone, *QUICK_ARGS, "--seed", "3")
    assert result.exit_code == 1
    assert "holds an evaluation with other seed: pass another --out, or --force" in " ".join(result.output.split())
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(OutputError, match="holds files, but no evaluation"):
        evaluate(EvalOptions("refine", root=root, estimate=QUICK), tmp_path, force=True)
    assert (tmp_path / "mine.txt").read_text() == "keep"


@pytest.mark.parametrize(
    ("args", "reason"),
    [
        ([], "which data set? Give its name (--dataset NAME"),
        (["--dataset", "lmoo"], "Did you mean lmo?"),
        (["--stage", "score", "--root", "ROOT"], "what is to be scored? Pass --csv FILE"),
        (["--root", "ROOT", "--objects", "7"], "the data set has no objects [7]; there are [1, 2]"),
        (["--root", "ROOT", "--objects", "ape"], "has no object 'ape'; it has numbers only"),
        (["--root", "ROOT", "--images", "2-3"], "give a number, or SCENE/IMAGE pairs"),
        (["--root", "ROOT", "--images", "9/9"], "no picture of small is left"),
        (["--root", "ROOT", "--noise", "1,2"], "give four numbers"),
        (["--root", "ROOT", "--min-visible", "90"], "between 0 and 1"),
        (["--root", "ROOT", "--detections", "nothing.json"], "there is no file 'nothing.json'"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(root: Path, tmp_path: Path, args: list[str], reason: str) -> None:
    given = [str(root) if a == "ROOT" else a for a in args]
    result = run(*given, "--out", tmp_path / "out")
    assert result.exit_code == 1
    assert reason in " ".join(result.output.split())
    assert "Traceback" not in result.output


def test_missing_data_names_the_command_that_fetches_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("POSEKIT_DATA", str(tmp_path))
    result = run("--dataset", "ycbv")
    assert result.exit_code == 1
    assert f"posekit download ycbv --root {tmp_path}" in " ".join(result.output.split())


# --- comparison ------------------------------------------------------------------------------------------------------


def test_a_run_compared_with_itself_and_with_a_better_one(root: Path, tmp_path: Path) -> None:
    results = {}
    for name, move in (("truth", None), ("off", Pose.translation([0.03, 0, 0]))):
        (tmp_path / name).mkdir()
        scored(root, truth_rows(root, move), tmp_path / name)
        results[name] = tmp_path / name / "out-0"
    same = compare(results["off"], results["off"])
    assert all(d.difference == d.low == d.high == 0 and not d.clear for d in same.differences)
    better = {d.measure: d for d in compare(results["off"], results["truth"]).differences}
    assert (better["2deg_2cm"].a, better["2deg_2cm"].b, better["2deg_2cm"].low) == (0, 100, 100)
    assert better["2deg_2cm"].clear and not better["5deg_5cm"].clear
    shown = CliRunner().invoke(app, ["eval", "--compare", str(results["off"]), str(results["truth"])])
    assert shown.exit_code == 0 and "+100.0 to +100.0 *" in shown.output
    told = CliRunner().invoke(app, ["eval", "--compare", str(results["off"]), str(results["truth"]), "--json", "-"])
    assert json.loads(told.stdout)["differences"][0]["b"] == 100 and "+100.0 to +100.0 *" in told.stderr


def test_the_interval_covers_a_known_difference(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    folders = []
    for k, chance in enumerate((0.5, 0.6)):
        entries = [
            {"scene": 1, "image": i, "index": 0, "obj_id": 1, "hits": {"5deg_5cm": 100.0 * (rng.random() < chance)}}
            for i in range(400)
        ]
        folder = tmp_path / str(k)
        about = {"dataset": {"name": "x", "split_hash": None}, "weights": {"hash": "a"}, "commit": "c", "options": {}}
        put(folder / "results.json", {"schema": 1, "stage": "refine", "instances": entries, **about})
        folders.append(folder)
    [found] = compare(*folders).differences
    assert found.low < found.difference < found.high
    error = 100 * np.sqrt((0.25 + 0.24) / 400)  # of a difference of two independent shares
    assert (found.high - found.low) / 2 == pytest.approx(1.96 * error, rel=0.1)
    with pytest.raises(InputError, match="cannot be read"):
        compare(folders[0], tmp_path / "none")


def test_a_tile_shows_truth_and_estimate_side_by_side() -> None:
    from posekit.evaluate.report import tile
    from posekit.render import Renderer
    from posekit.synth.example import make_example
    from posekit.visualise import draw

    renderer = Renderer()
    example = make_example(renderer)
    data = SimpleNamespace(view=lambda *_: example.view, model=lambda *_: example.model)
    case = SimpleNamespace(scene=0, image=0, obj_id=1, T_cam_obj=example.T_cam_obj)
    picture = tile(case, case, data, renderer)  # type: ignore[arg-type]
    left, right = picture[:, :240], picture[:, -240:]
    alone = tile(case, None, data, renderer)  # type: ignore[arg-type]
    for half, colour, other in ((left, draw.ORANGE, draw.GREEN), (right, draw.GREEN, draw.ORANGE)):
        assert (half == colour).all(axis=-1).sum() > 30 > 5 > (half == other).all(axis=-1).sum()
    assert (alone[:, :240] == left).all() and (alone[:, -240:] != right).any()

"""Mask R-CNN and what surrounds it: operators, weights, training, novel objects, detections in files, commands.

Detections in files. Accepted: BOP's list or its entries one a line, COCO's map, a map by picture; boxes x, y, width,
height; run lengths as text or numbers, polygons; numbers as text; names in any capitals. Warned about and skipped: an
entry that cannot be used. Warned about and read: boxes that only fit as x0, y0, x1, y1. Refused: other files, and those
without an entry for the picture, its scene or the mesh.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from objects import bracket
from posekit.camera import Camera, box_iou, mask_box
from posekit.cli.app import app
from posekit.detect import maskrcnn
from posekit.detect.coco import Overlaps, Truth, average_precision, average_precision_of_overlaps
from posekit.detect.external import DetectionsFile, categories_of, to_bop, to_coco
from posekit.detect.maskrcnn import (
    SHIPPED,
    Found,
    MaskRCNN,
    MaskRCNNConfig,
    TrainedDetector,
    build,
    find,
    load_detector,
    save_detector,
)
from posekit.detect.novel import NovelDetector, SimilarityDetector
from posekit.detect.segmentation import decode, encode
from posekit.detect.vision import nms, roi_align, torchvision
from posekit.errors import ConfigError, PromptError, WeightsError
from posekit.geometry import Pose, random_rotation, view_rotation
from posekit.mesh.model import ObjectModel
from posekit.render import Renderer
from posekit.results import Detection, Source
from posekit.synth.tabletop import TabletopConfig, procedural_objects
from posekit.train.config import MachineConfig, OptimiserConfig, SourceConfig, write_config
from posekit.train.data.tabletop_stream import TabletopStream, TabletopStreamConfig, labelled_scenes
from posekit.train.detector import DetectorConfig, DetectorModule, read_config, target, train_detector
from posekit.view import View
from posekit.visualise.draw import png

TINY = MaskRCNNConfig(size=(128, 96), use_size=(128, 96), channels=16, hidden=32, proposals=(20, 20), samples=16)
SCENES = TabletopStreamConfig(
    batch=2, pool=4, per_block=2, reuse=2, meshes=2, scenes=TabletopConfig(size=(128, 96), distractors=(1, 2))
)


@pytest.fixture(scope="module")
def untrained() -> TrainedDetector:
    torch.manual_seed(0)
    return TrainedDetector(TINY, build(TINY).eval())


# --- torchvision's operators --------------------------------------------------------------------------------------


def test_suppression_keeps_the_best_of_what_overlaps() -> None:
    # the first two overlap by 81 / 119 = 0.68, the third touches nobody, the fourth is half of the second
    boxes = torch.tensor([[0.0, 0, 10, 10], [1, 1, 11, 11], [20, 20, 30, 30], [1, 1, 11, 6]])
    scores = torch.tensor([0.5, 0.9, 0.3, 0.7])
    assert nms(boxes, scores, 0.6).tolist() == [1, 3, 2]
    assert nms(boxes, scores, 0.45).tolist() == [1, 2]
    assert nms(boxes, scores, 0.7).tolist() == [1, 3, 0, 2]
    assert nms(boxes[:0], scores[:0], 0.5).tolist() == []


def test_aligned_regions_of_a_plane_are_its_values_at_the_bins_middles() -> None:
    rows, columns = torch.meshgrid(torch.arange(12.0), torch.arange(16.0), indexing="ij")
    plane = torch.stack([columns, rows, 2 * columns + rows])[None]
    region = torch.tensor([[0.0, 4.0, 6.0, 20.0, 14.0]])  # at half scale 2..10 x 3..7
    for ratio in (0, 1, 2, 3):
        out = roi_align(plane, region, 0.5, 2, 4, ratio, aligned=True)[0]
        x, y = torch.tensor([3.0, 5, 7, 9]) - 0.5, torch.tensor([4.0, 6]) - 0.5
        torch.testing.assert_close(out[0], x.expand(2, 4))
        torch.testing.assert_close(out[1], y[:, None].expand(2, 4))
        torch.testing.assert_close(out[2], 2 * out[0] + out[1])
    without = roi_align(plane, region, 0.5, 2, 4, 2, aligned=False)[0]
    torch.testing.assert_close(without[0], torch.tensor([3.0, 5, 7, 9]).expand(2, 4))


def test_regions_reach_outside_and_belong_to_their_pictures() -> None:
    pictures = torch.stack([torch.ones(1, 8, 8), 5 * torch.ones(1, 8, 8)])
    regions = torch.tensor([[1.0, 1, 1, 5, 5], [0, 1, 1, 5, 5], [0, 20, 20, 28, 28]])
    out = roi_align(pictures, regions, 1.0, 2, 2, 2, True)
    assert out[:, 0, 0, 0].tolist() == [5.0, 1.0, 0.0]


def test_gradients_of_aligned_regions() -> None:
    features = torch.rand(1, 2, 6, 6, dtype=torch.float64, requires_grad=True)
    region = torch.tensor([[0.0, 0.7, 1.1, 4.9, 5.3]], dtype=torch.float64)
    out = roi_align(features, region, 1.0, 2, 2, 2, True)
    weights = torch.rand_like(out)
    (gradient,) = torch.autograd.grad((out * weights).sum(), features)
    torch.testing.assert_close(gradient.sum((0, 2, 3)), weights.sum((0, 2, 3)), rtol=1e-5, atol=1e-5)


def test_torchvision_uses_working_operators() -> None:
    ops = torchvision().ops
    boxes, scores = torch.tensor([[0.0, 0, 4, 4], [0, 0, 4, 4.1]]), torch.tensor([0.1, 0.2])
    assert ops.nms(boxes, scores, 0.5).tolist() == [1]
    pooled = ops.roi_align(torch.full((1, 1, 5, 5), 3.0), [torch.tensor([[0.0, 0, 4, 4]])], 2, 1.0, 2, True)
    assert pooled.unique().tolist() == [3.0]


# --- the network --------------------------------------------------------------------------------------------------


def test_weights_come_back_and_are_read_strictly(tmp_path: Path, untrained: TrainedDetector) -> None:
    digest = save_detector(tmp_path / "detector", TINY, untrained.network, {"steps": 3})
    for given in (tmp_path, tmp_path / "detector", tmp_path / "detector.safetensors"):
        again = load_detector(given)
        assert (again.digest, again.config, again.about["steps"]) == (digest, TINY, 3)
    image = np.random.default_rng(0).integers(0, 255, (96, 128, 3), dtype=np.uint8)
    a, b = find(untrained, image, min_score=0.0), find(again, image, min_score=0.0)
    assert len(a.scores) and np.abs(a.scores.max() - b.scores.max()) < 0.02
    data = (tmp_path / "detector.safetensors").read_bytes()
    (tmp_path / "detector.safetensors").write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(WeightsError, match="belong together"):
        load_detector(tmp_path)
    (tmp_path / "detector.toml").write_text('kind = "other"')
    with pytest.raises(WeightsError, match="no Mask R-CNN"):
        load_detector(tmp_path)
    with pytest.raises(WeightsError, match="no detector at"):
        load_detector(tmp_path / "nowhere")


def test_a_detector_reports_its_classes_only(untrained: TrainedDetector) -> None:
    view = View(np.zeros((96, 128, 3), np.uint8), Camera.from_fov(1.0, 128, 96))
    with pytest.raises(ConfigError, match=r"does not know bracket; it was trained for object"):
        MaskRCNN(untrained).detect(view, [bracket()])
    found = MaskRCNN(untrained, min_score=0.0).detect(view, [])
    assert found and {d.label for d in found} == {"object"}
    assert all(d.mask is not None and d.mask.shape == (96, 128) for d in found)
    with pytest.raises(ConfigError, match="backbone is one of"):
        MaskRCNNConfig(backbone="resnet5")


# --- training -----------------------------------------------------------------------------------------------------


def test_a_batch_is_a_function_of_its_number_and_its_targets_fit() -> None:
    def batches(start: int) -> list[dict[str, torch.Tensor]]:
        stream = iter(TabletopStream(SCENES, 5, [bracket()], agnostic=False, start=start))
        return [next(stream) for _ in range(2)]

    (_, second), (again, _) = batches(0), batches(1)
    assert all(torch.equal(second[k], again[k]) for k in second)
    found = target(second["labels"][0], second["classes"][0])
    assert len(found["boxes"]) and set(found["labels"].tolist()) == {1}
    for box, mask in zip(found["boxes"].int().tolist(), found["masks"], strict=True):
        x0, y0, x1, y1 = box
        assert mask[y0:y1, x0:x1].sum() == mask.sum() and mask[y0].any() and mask[y1 - 1].any()


def test_distractors_lie_about_and_belong_to_the_ground(renderer: Renderer, tmp_path: Path) -> None:
    grey, green = (
        ObjectModel.from_arrays(bracket().vertices, bracket().faces, name=name,
                                colors=np.tile(np.array(colour, np.uint8), (len(bracket().vertices), 1)))
        for name, colour in (("grey", (128, 128, 128)), ("green", (0, 255, 0)))
    )  # fmt: skip
    scenes = dataclasses.replace(SCENES.scenes, distractors=(4, 6))
    config = dataclasses.replace(SCENES, meshes=8, per_block=6, scenes=scenes)

    def greens(distractors: list[ObjectModel]) -> int:
        rng, count = np.random.default_rng(3), 0
        for scene in labelled_scenes(renderer, [grey], False, 6, config, rng, [], distractors):
            pixels = scene.image.astype(int)
            is_green = (pixels[..., 1] > 3 * pixels[..., 0]) & (pixels[..., 1] > 3 * pixels[..., 2])
            shown = [k for k in range(len(scene.classes)) if (scene.labels == k + 1).any()]
            found = [k for k in shown if is_green[scene.labels == k + 1].mean() > 0.7]
            assert all(scene.classes[k] == -1 for k in found)
            count += len(found)
        return count

    assert greens([green]) >= greens([]) + 3
    _write_ply(tmp_path / "box.ply")
    sources = SourceConfig(models=(str(tmp_path / "box.ply"),), units="m", distractors=(str(tmp_path),))
    with pytest.raises(ConfigError, match="any kind"):
        train_detector(dataclasses.replace(DetectorConfig(), agnostic=True, sources=sources), tmp_path / "out")


def test_one_batch_is_learned() -> None:
    torch.manual_seed(0)
    module = DetectorModule(build(TINY)).train()
    batch = next(iter(TabletopStream(SCENES, 1, [bracket()], agnostic=True)))
    optimiser = torch.optim.AdamW([p for p in module.parameters() if p.requires_grad], 2e-3)
    losses = []
    for _ in range(12):
        loss, parts = module(batch, 0)
        assert set(parts) == {"classifier", "box_reg", "mask", "objectness", "rpn_box_reg"}
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.75 * losses[0], losses


def test_training_writes_a_detector_that_a_config_file_describes(tmp_path: Path) -> None:
    mesh = tmp_path / "box.ply"
    _write_ply(mesh)
    config = DetectorConfig(
        epochs=0, steps=1, validate=1, save=1, log=1, scenes=2, network=TINY, stream=SCENES,
        optimiser=OptimiserConfig(), machine=MachineConfig(workers=0, threads=1),
        sources=dataclasses.replace(DetectorConfig().sources, models=(str(mesh),), units="m"),
    )  # fmt: skip
    (tmp_path / "c.toml").write_text(write_config(config))
    assert read_config(tmp_path / "c.toml") == config
    rows = train_detector(config, tmp_path / "out")
    assert rows[-1]["step"] == "1" and 0 <= float(rows[-1]["mask_ap50"]) <= 1
    trained = load_detector(tmp_path / "out")
    assert trained.config.classes == ("box",) and trained.about["trained_on"] == "composed scenes: renderings of box"
    (tmp_path / "bad.toml").write_text("epoks = 3")
    with pytest.raises(ConfigError, match="did you mean 'epochs'"):
        read_config(tmp_path / "bad.toml")
    with pytest.raises(ConfigError, match="trained for meshes"):
        train_detector(DetectorConfig(), tmp_path / "other")


def _write_ply(path: Path) -> None:
    model = bracket()
    lines = ["ply", "format ascii 1.0", f"element vertex {len(model.vertices)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"element face {len(model.faces)}", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(f"{v:.6f}" for v in row) for row in model.vertices]
    lines += ["3 " + " ".join(map(str, row)) for row in model.faces]
    path.write_text("\n".join(lines) + "\n")


# --- average precision and files ----------------------------------------------------------------------------------


def _square(x: int, y: int, side: int) -> np.ndarray:
    mask = np.zeros((60, 80), bool)
    mask[y : y + side, x : x + side] = True
    return mask


def _found(masks: list[np.ndarray], scores: list[float]) -> Found:
    boxes = [[c.min(), r.min(), c.max() + 1, r.max() + 1] for r, c in map(np.nonzero, masks)]
    return Found(np.array(boxes, float), np.zeros(len(masks), int), np.array(scores), np.stack(masks))


def test_average_precision_of_what_can_be_counted() -> None:
    truth = Truth(np.zeros(2, int), [_square(5, 5, 20), _square(40, 20, 20)])
    exact = average_precision([truth], [_found(list(truth.masks), [0.9, 0.8])])
    assert exact == pytest.approx({"box_ap": 1.0, "box_ap50": 1.0, "mask_ap": 1.0, "mask_ap50": 1.0})
    half = average_precision([truth], [_found([truth.masks[0], _square(60, 0, 10)], [0.9, 0.8])])
    assert half["mask_ap50"] == pytest.approx(51 / 101)  # recall 0 to 0.5 at precision 1, of 101 points
    nobody = dataclasses.replace(truth, ignored=(False, True))
    assert average_precision([nobody], [_found([truth.masks[0]], [0.9])])["box_ap50"] == pytest.approx(1.0)


def test_average_precision_of_known_overlaps_is_that_of_boxes() -> None:
    from contextlib import redirect_stdout
    from io import StringIO

    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    rng = np.random.default_rng(3)
    annotations, results, pictures = [], [], []
    for image in range(12):
        true = [np.r_[xy, xy + rng.uniform(10, 40, 2)] for xy in rng.uniform(0, 100, (rng.integers(0, 5), 2))]
        found = [t + rng.normal(0, 3, 4) for t in true for _ in range(rng.integers(0, 3))]
        found += [np.r_[xy, xy + 20] for xy in rng.uniform(0, 100, (2, 2))]
        scores = rng.random(len(found))
        for t in true:
            annotations.append({"id": len(annotations) + 1, "image_id": image, "category_id": 1, "iscrowd": 0,
                                "bbox": [*t[:2], *(t[2:] - t[:2])], "area": float(np.prod(t[2:] - t[:2]))})  # fmt: skip
        for f, s in zip(found, scores, strict=True):
            results.append({"image_id": image, "category_id": 1, "bbox": [*f[:2], *(f[2:] - f[:2])], "score": s})
        pictures.append((true, found, scores))
    with redirect_stdout(StringIO()):
        coco = COCO()
        coco.dataset = {"images": [{"id": k} for k in range(12)], "annotations": annotations,
                        "categories": [{"id": 1}], "info": {}}  # fmt: skip
        coco.createIndex()
        coco_eval = COCOeval(coco, coco.loadRes(results), "bbox")
        coco_eval.evaluate()
        coco_eval.accumulate()
        coco_eval.summarize()
    overlaps = [
        Overlaps(s, np.zeros(len(t), bool), box_iou(np.reshape(f, (-1, 1, 4)), np.reshape(t, (1, -1, 4))))
        for t, f, s in pictures
    ]
    assert 0.1 < coco_eval.stats[0] < 0.9
    assert average_precision_of_overlaps(overlaps) == pytest.approx(coco_eval.stats[:2], abs=1e-9)


def test_ignored_instances_are_neither_asked_for_nor_held_against_anyone() -> None:
    def ap50(iou: list[list[float]], ignored: list[bool]) -> float:
        return average_precision_of_overlaps([Overlaps(np.array([0.9, 0.8]), np.array(ignored), np.array(iou))])[1]

    assert ap50([[0.0, 1.0], [1.0, 0.0]], [False, True]) == pytest.approx(1.0)
    assert ap50([[0.0, 0.0], [1.0, 0.0]], [False, True]) == pytest.approx(0.5)
    # an ignored instance excuses one detection, the best-scored one
    assert ap50([[0.0, 1.0], [0.0, 1.0]], [False, True]) == 0.0
    assert np.isnan(ap50([[0.0], [0.0]], [True]))
    assert average_precision_of_overlaps([Overlaps(np.zeros(0), np.array([False]), np.zeros((0, 1)))]) == (0.0, 0.0)


def test_masks_and_detections_survive_their_files(tmp_path: Path) -> None:
    mask = np.random.default_rng(0).random((60, 80)) < 0.3
    np.testing.assert_array_equal(decode(json.loads(json.dumps(encode(mask))), (80, 60)), mask)
    counts = {"size": [2, 3], "counts": [1, 2, 3]}  # column by column: 0 1 | 1 0 | 0 0
    np.testing.assert_array_equal(decode(counts, (3, 2)), [[False, True, False], [True, False, False]])
    view = View(np.zeros((60, 80, 3), np.uint8), Camera.from_fov(1.0, 80, 60))
    model = bracket()
    given = [Detection((5.0, 5.0, 25.0, 25.0), _square(5, 5, 20), 0.25, "bracket"),
             Detection((40.0, 20.0, 60.0, 40.0), _square(40, 20, 20), 0.75, "bracket")]  # fmt: skip
    image = Path("000048/rgb/000007.png")
    texts = {"coco": to_coco(given, ["bracket"], image, (80, 60)), "bop": to_bop(given, ["bracket"], image, 0.5)}
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
        found = DetectionsFile.read(tmp_path / name, image).detect(view, [model])
        assert [d.score for d in found] == [0.75, 0.25] and found[0].box == given[1].box
        np.testing.assert_array_equal(found[0].mask, given[1].mask)
    assert json.loads(texts["bop"])[0]["scene_id"] == 48 and json.loads(texts["bop"])[0]["image_id"] == 7
    other = DetectionsFile.read(tmp_path / "coco", Path("other.png"))
    assert len(other.detect(view, [model])) == 2, "a file about one picture is about this one"


def test_detections_files_that_are_something_else(tmp_path: Path) -> None:
    view = View(np.zeros((60, 80, 3), np.uint8), Camera.from_fov(1.0, 80, 60))
    file = tmp_path / "d.json"
    for text in ("[1]", "{}", "no JSON", '[{"image_id": 1, "score": 1}]'):
        file.write_text(text)
        with pytest.raises(PromptError):
            DetectionsFile.read(file, Path("1.png")).detect(view, [bracket()])
    entry = {"image_id": 1, "category_id": 5, "score": 0.5, "bbox": [1, 2, 10, 20]}
    file.write_text(json.dumps([entry, entry | {"category_id": 6}, entry | {"image_id": 2, "category_id": 6}]))
    six = ObjectModel.from_arrays(bracket().vertices, bracket().faces, name="obj_000006")
    found = DetectionsFile.read(file, Path("000001.png")).detect(view, [six])
    assert [d.box for d in found] == [(1.0, 2.0, 11.0, 22.0)]
    assert categories_of(["obj_000006", "obj_000009"]) == {"obj_000006": 6, "obj_000009": 9}
    assert categories_of(["cup", "can"]) == {"cup": 1, "can": 2}


ENTRY = {"image_id": 1, "category_id": 6, "score": 0.5, "bbox": [1, 2, 10, 20]}


def found_in(folder: Path, data: object, image: str = "000001.png", name: str = "obj_000006") -> list[Detection]:
    (folder / "d.json").write_text(json.dumps(data))
    view = View(np.zeros((60, 80, 3), np.uint8), Camera.from_fov(1.0, 80, 60))
    six = ObjectModel.from_arrays(bracket().vertices, bracket().faces, name=name)
    return DetectionsFile.read(folder / "d.json", folder / image).detect(view, [six])


@pytest.mark.parametrize(
    ("extra", "why"),
    [
        ({"bbox": [5, 5, 0, 9]}, "inside out"),
        ({"bbox": [500, 5, 9, 9]}, "lies outside the picture"),
        ({"bbox": [-5, 5, 4.5, 9]}, "lies outside the picture"),
        ({"score": float("nan")}, "without a finite score"),
        ({"bbox": None}, "neither box nor mask"),
        ({"bbox": [1, 2]}, "no detection"),
        ({"segmentation": [[3, 3]]}, "at least three points"),
        ({"segmentation": [[]]}, "at least three points"),
        ({"segmentation": [[1, 2, 3, 4, 5]]}, "at least three points"),
        ({"segmentation": {"size": [9, 9], "counts": [81]}}, "a mask is 9x9, its picture 80x60"),
        ({"segmentation": {"size": [60, 80], "counts": [-4, 9]}}, "entry 2"),
        ({"segmentation": {"size": [60, 80], "counts": "ä"}}, "neither COCO's run lengths nor polygons"),
        ({"segmentation": {"size": [60, 80], "counts": [0, 10**9]}}, "fill the 80x60 pixels"),
        ({"segmentation": {"size": [60, 80], "counts": "0" * 3000}}, "fill the 80x60 pixels"),
        ({"segmentation": {"size": [60, 80], "counts": "o" * 3000}}, "neither COCO's run lengths nor polygons"),
        ({"segmentation": [[1e9, 2, 3, 1e9, 5, 6]]}, "none beyond 100000 pixels"),
        ({"bbox": [10**400, 5, 9, 9]}, "no detection"),
        ({"bbox": [10**400, 5.5, 9.5, 9]}, "no detection"),
        ({"category_id": "six"}, "entry 2 is skipped"),
        ({"image_id": None}, "entry 2 is skipped"),
    ],
    ids=str,
)
def test_a_bad_entry_is_skipped_and_told(
    extra: dict[str, object], why: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    found = found_in(tmp_path, [ENTRY, ENTRY | extra, ENTRY | {"score": 0.4}])
    assert [d.score for d in found] == [0.5, 0.4]
    assert "d.json: entry 2" in caplog.text and why in caplog.text
    with pytest.raises(PromptError, match=r"d.json.*none"):
        found_in(tmp_path, [ENTRY | extra])


def test_numbers_may_be_text_and_names_have_any_capitals(tmp_path: Path) -> None:
    text = [ENTRY | {"image_id": "000001", "category_id": "6"}, ENTRY | {"image_id": "2", "category_id": "6"}]
    assert len(found_in(tmp_path, text)) == 1
    assert len(found_in(tmp_path, {"1": [ENTRY], "2": [ENTRY | {"image_id": 2}, ENTRY | {"image_id": 2}]})) == 1
    coco = {"images": [{"id": 77, "file_name": "rgb/000001.png"}], "categories": [{"id": 1, "name": "Cup"},
            {"id": 2, "name": "can"}], "annotations": [ENTRY | {"image_id": 77, "category_id": 1},
            ENTRY | {"image_id": 77, "category_id": 2}]}  # fmt: skip
    assert len(found_in(tmp_path, coco, name="cup")) == 1


def test_boxes_of_corners_are_noticed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """In a picture of 80x60: as x, y, width, height the second one would reach to 120."""
    [a, b] = found_in(tmp_path, [{**ENTRY, "bbox": [5, 6, 30, 40]}, {**ENTRY, "score": 0.2, "bbox": [50, 10, 70, 55]}])
    assert (a.box, b.box) == ((5, 6, 30, 40), (50, 10, 70, 55))
    assert "lie within it as x0, y0, x1, y1: they are taken for the latter" in caplog.text
    caplog.clear()
    [c, d] = found_in(tmp_path, [{**ENTRY, "bbox": [5, 6, 30, 40]}, {**ENTRY, "score": 0.2, "bbox": [50, 10, 45, 55]}])
    assert (c.box, d.box) == ((5, 6, 35, 46), (50, 10, 80, 60)) and "the latter" not in caplog.text


def test_run_lengths_are_coco_s() -> None:
    """What pycocotools writes is read, sizes and shapes of all kinds."""
    rng = np.random.default_rng(0)
    for width, height in ((1, 1), (5, 3), (64, 48), (300, 200)):
        for share in (0.0, 0.02, 0.5, 1.0):
            mask = rng.random((height, width)) < share
            assert np.array_equal(decode(encode(mask), (width, height)), mask)


def test_what_a_file_has_instead_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(PromptError, match=r"nothing for 000009.png \(image 9\); it is about the images 1, 2"):
        found_in(tmp_path, [ENTRY, ENTRY | {"image_id": 2}], "000009.png")
    with pytest.raises(PromptError, match=r"nothing for obj_000006 in this picture, only for the categories 5, 9"):
        found_in(tmp_path, [ENTRY | {"category_id": 5}, ENTRY | {"category_id": 9}])
    assert found_in(tmp_path, []) == [] and "d.json holds no detections at all" in caplog.text


def test_one_detection_a_line_is_read(tmp_path: Path) -> None:
    other = ENTRY | {"image_id": 2}
    for entries in ([ENTRY], [ENTRY, other], [ENTRY, ENTRY, other]):
        (tmp_path / "d.json").write_text("".join(json.dumps(entry) + "\r\n" for entry in entries))
        found = DetectionsFile.read(tmp_path / "d.json", tmp_path / "000001.png")
        assert len(found.entries) == entries.count(ENTRY)


def test_scenes_are_respected(tmp_path: Path) -> None:
    scenes = [ENTRY | {"scene_id": 1, "score": 0.9}, ENTRY | {"scene_id": "2"}]
    (tmp_path / "000002" / "rgb").mkdir(parents=True)
    assert [d.score for d in found_in(tmp_path, scenes, "000002/rgb/000001.png")] == [0.5]
    with pytest.raises(PromptError, match=r"about the scenes 1, 2, and the picture lies in no folder"):
        found_in(tmp_path, scenes)


# --- novel objects ------------------------------------------------------------------------------------------------


def test_proposals_are_compared_with_the_mesh(renderer: Renderer, untrained: TrainedDetector) -> None:
    rng = np.random.default_rng(4)
    meshes = [bracket(), *procedural_objects(2, rng, unit=0.12)]
    camera = Camera.from_fov(0.9, 320, 240)
    image, proposals = np.full((240, 320, 3), 90, np.uint8), []
    for k, model in enumerate(meshes):
        pose = Pose(random_rotation(rng), np.array([0.16 * (k - 1), 0.0, 0.7])) @ model.T_ctr_obj
        [drawn] = renderer.render(model, [pose], camera)
        assert drawn.mask is not None
        image[drawn.mask] = drawn.image[drawn.mask]
        rows, columns = np.nonzero(drawn.mask)
        box = (float(columns.min()), float(rows.min()), float(columns.max() + 1), float(rows.max() + 1))
        proposals.append(Detection(box, drawn.mask))
    detector, view = NovelDetector(untrained, renderer), View(image, camera)
    for k, model in enumerate(meshes):
        similar = detector.similarities(view, model, proposals)
        assert int(np.argmax(similar)) == k and 0.5 < similar[k] <= 1
    with pytest.raises(ConfigError, match="not for any object"):
        NovelDetector(TrainedDetector(dataclasses.replace(TINY, classes=("cup",)), untrained.network), renderer)


def test_detections_in_two_sizes_are_joined(untrained: TrainedDetector, monkeypatch: pytest.MonkeyPatch) -> None:
    masks = np.zeros((3, 60, 80), bool)
    masks[:, 5:20, 5:20] = True
    outputs = iter(
        [
            Found(np.array([[4.0, 4, 20, 20], [40, 30, 60, 50]]), np.array([0, 0]), np.array([0.9, 0.4]), masks[:2]),
            Found(np.array([[6.0, 4, 22, 20], [4.0, 4, 20, 20]]), np.array([0, 1]), np.array([0.3, 0.2]), masks[:2]),
        ]
    )
    monkeypatch.setattr(maskrcnn, "find", lambda *_, **__: next(outputs))
    image = np.zeros((60, 80, 3), np.uint8)
    found = maskrcnn.find_augmented(untrained, image, ((1.0, False), (2.0, False)), min_score=0.15)
    assert found.scores.tolist() == pytest.approx([0.6, 0.2]) and found.labels.tolist() == [0, 0]
    np.testing.assert_allclose(found.boxes, [[4.5, 4, 20.5, 20], [40, 30, 60, 50]], atol=1e-4)
    outputs = iter([Found(np.zeros((0, 4)), np.zeros(0, np.int64), np.zeros(0), masks[:0])] * 2)
    assert not len(maskrcnn.find_augmented(untrained, image, ((1.0, False), (2.0, False)), min_score=0.15).scores)


def test_what_looks_like_the_mesh_counts_for_more(renderer: Renderer) -> None:
    """Two detections of the same score: the bracket itself, and a grey patch."""
    camera, model = Camera.from_fov(0.9, 160, 120), bracket()
    pose = Pose(view_rotation([0.5, -1.0, 0.6]), [-0.06, 0.0, 0.5]) @ model.T_ctr_obj
    [drawn] = renderer.render(model, [pose], [camera])
    assert drawn.mask is not None
    image = np.where(drawn.mask[..., None], drawn.image, 128).astype(np.uint8)
    patch = np.zeros((120, 160), bool)
    patch[30:70, 110:150] = True
    boxes = (mask_box(drawn.mask), (110.0, 30.0, 150.0, 70.0))
    masks = (drawn.mask, patch)

    class Trained:
        def detect(self, _: View, __: list) -> list[Detection]:
            return [Detection(b, m, 0.4, "bracket", Source.TRAINED) for b, m in zip(boxes, masks, strict=True)]

    view = View(image, camera)
    finder = SimilarityDetector(Trained(), renderer, 0.5)  # type: ignore[arg-type]
    [found] = finder.detect(view, [model])
    assert found.box == boxes[0] and found.score > 0.8 and found.source == "mask-rcnn"
    finder = SimilarityDetector(Trained(), renderer, 0.0)  # type: ignore[arg-type]
    assert finder.detect(view, [model])[1].score < 0.3
    plain = dataclasses.replace(model, colors=None)
    assert [d.score for d in finder.detect(view, [plain])] == [0.4, 0.4], "nothing to compare colours with"
    finder = SimilarityDetector(Trained(), renderer, 0.0, max_detections=1)  # type: ignore[arg-type]
    assert [d.box for d in finder.detect(view, [model])] == [boxes[0]]


def test_what_a_mirrored_picture_shows_is_mirrored_back(
    untrained: TrainedDetector, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What stands for the network finds the picture's bright part."""

    def bright(_: object, image: np.ndarray, **__: object) -> Found:
        mask = image[..., 0] > 100
        rows, columns = np.nonzero(mask)
        box = [[columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]]
        return Found(np.array(box, float), np.zeros(1, np.int64), np.array([0.8]), mask[None])

    monkeypatch.setattr(maskrcnn, "find", bright)
    image = np.zeros((60, 80, 3), np.uint8)
    image[10:30, 5:25] = 200
    for augmentations in (((1.0, True),), ((1.0, False), (1.5, True))):
        found = maskrcnn.find_augmented(untrained, image, augmentations, min_score=0.5)
        np.testing.assert_allclose(found.boxes, [[5, 10, 25, 30]], atol=1e-4)
        np.testing.assert_array_equal(found.masks[0], image[..., 0] > 100)
        assert found.scores.tolist() == pytest.approx([0.8]), "one instance, found in every version"


# --- commands -----------------------------------------------------------------------------------------------------


def test_nothing_can_be_verified_without_a_mesh(tmp_path: Path) -> None:
    (tmp_path / "grey.png").write_bytes(png(np.full((240, 320, 3), 128, np.uint8)))
    result = CliRunner().invoke(app, ["detect", str(tmp_path / "grey.png"), "--verify", "--out", str(tmp_path / "o")])
    assert result.exit_code == 1 and "--model MESH" in result.output and not (tmp_path / "o").exists()


def test_detect_and_estimate_where_nothing_is(tmp_path: Path) -> None:
    (tmp_path / "grey.png").write_bytes(png(np.full((240, 320, 3), 128, np.uint8)))
    _write_ply(tmp_path / "box.ply")
    common = [str(tmp_path / "grey.png"), "--model", str(tmp_path / "box.ply"), "--units", "m"]
    common += ["--camera", "300,300,160,120"]
    out = tmp_path / "found"
    result = CliRunner().invoke(app, ["detect", *common, "--out", str(out)])
    assert result.exit_code == 0, result.output
    assert "box not found" in result.output
    assert json.loads((out / "bop.json").read_text()) == []
    assert json.loads((out / "coco.json").read_text())["annotations"] == []
    result = CliRunner().invoke(app, ["estimate", *common, "--out", str(tmp_path / "poses")])
    assert result.exit_code == 0, result.output
    assert "no pose" in result.output
    assert json.loads((tmp_path / "poses" / "result.json").read_text())["estimates"] == []


def test_commands_say_what_is_wrong(tmp_path: Path) -> None:
    (tmp_path / "grey.png").write_bytes(png(np.full((60, 80, 3), 128, np.uint8)))
    command = ["detect", str(tmp_path / "grey.png"), "--camera", "80,80,40,30", "--out", str(tmp_path / "o")]
    result = CliRunner().invoke(app, [*command, "--detector", str(tmp_path / "none")])
    assert result.exit_code == 1 and "no detector at" in result.output
    result = CliRunner().invoke(app, ["train", "detector", "--out", str(tmp_path / "t")])
    assert result.exit_code == 1 and "--models" in result.output


def test_the_shipped_detector_is_class_agnostic_and_small() -> None:
    detector = load_detector(SHIPPED)
    assert detector.config.novel and detector.config.backbone == "lite0"
    assert SHIPPED.with_suffix(".safetensors").stat().st_size < 10e6


def test_what_the_config_says_of_units_holds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from posekit.train import detector

    seen = []
    monkeypatch.setattr(detector, "train_detector", lambda config, *_: seen.append(config.sources.units))
    (tmp_path / "a.toml").write_text('[sources]\nunits = "m"\nmodels = ["a.ply"]\n')
    for more in ([], ["--units", "mm"]):
        command = ["train", "detector", "--config", str(tmp_path / "a.toml"), "--out", str(tmp_path / "t"), *more]
        assert CliRunner().invoke(app, command).exit_code == 0
    assert seen == ["m", "mm"]

"""Which detector `make_detector` makes, with networks that are never run."""

from __future__ import annotations

from pathlib import Path

import pytest

from objects import bracket
from posekit.detect import novel
from posekit.detect.maskrcnn import DOUBTFUL, SHIPPED, MaskRCNN, MaskRCNNConfig, TrainedDetector
from posekit.detect.novel import NovelDetector, NovelOptions, SimilarityDetector, make_detector
from posekit.errors import ConfigError, WeightsError

OWN = MaskRCNNConfig(classes=("cup", "duck"))
COCO = MaskRCNNConfig("resnet50", classes=("person", "bicycle"))


@pytest.fixture
def loaded(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The files that are asked for, in place of networks: the shipped one is class-agnostic, another knows OWN."""
    files: list[Path] = []

    def load(path: Path) -> TrainedDetector:
        files.append(path)
        return TrainedDetector(MaskRCNNConfig() if path == SHIPPED else OWN, None)

    monkeypatch.setattr(novel, "load_detector", load)
    monkeypatch.setattr(novel, "load_coco", lambda: TrainedDetector(COCO, None))
    monkeypatch.setattr(novel, "Renderer", lambda: None)
    monkeypatch.setattr(novel, "AppearanceSimilarity", lambda _renderer, options: options)
    return files


@pytest.mark.parametrize("name", [None, "novel"])
def test_the_shipped_detector_is_taken_where_none_is_named(name: str | None, loaded: list[Path]) -> None:
    found, names = make_detector(name, [bracket()], max_detections=4)
    assert loaded == [SHIPPED] and names == ("bracket",)
    assert isinstance(found, NovelDetector)
    assert found.options == NovelOptions(max_detections=4)


def test_without_meshes_anything_is_an_object(loaded: list[Path]) -> None:
    found, names = make_detector(None, [], min_score=0.25)
    assert isinstance(found, NovelDetector)
    assert names == ("object",)
    assert found.options == NovelOptions(min_score=0.25, min_proposal_score=0.25)


def test_a_least_score_is_of_detections_and_not_of_proposals_where_there_are_meshes(loaded: list[Path]) -> None:
    found, _ = make_detector(None, [bracket()], min_score=0.02)
    assert isinstance(found, NovelDetector)
    assert found.options == NovelOptions(min_score=0.02)


@pytest.mark.parametrize(
    ("doubtful", "min_score", "expected"),
    [(False, None, (0.5, 0)), (True, None, (DOUBTFUL, 3)), (False, 0.7, (0.7, 0)), (True, 0.7, (0.7, 3))],
)
def test_coco_keeps_its_scores(
    doubtful: bool, min_score: float | None, expected: tuple[float, int], loaded: list[Path]
) -> None:
    found, names = make_detector("coco", [], min_score=min_score, doubtful=doubtful)
    assert isinstance(found, MaskRCNN)
    assert (found.min_score, found.max_detections) == expected and names == COCO.classes and not loaded


@pytest.mark.parametrize(
    ("doubtful", "min_score", "first", "expected"),
    [
        (False, None, DOUBTFUL, (0.5, 0)),
        (True, None, DOUBTFUL, (DOUBTFUL, 3)),
        (False, 0.7, DOUBTFUL, (0.7, 0)),
        (False, 0.01, 0.01, (0.01, 0)),
    ],
)
def test_a_trained_detector_is_asked_for_doubtful_detections_before_they_are_compared_with_the_mesh(
    doubtful: bool, min_score: float | None, first: float, expected: tuple[float, int], loaded: list[Path]
) -> None:
    found, names = make_detector("my/detector", [], min_score=min_score, doubtful=doubtful)
    assert loaded == [Path("my/detector")] and names == OWN.classes
    assert isinstance(found, SimilarityDetector)
    assert (found.min_score, found.max_detections) == expected
    assert (found.detector.min_score, found.detector.max_detections) == (first, 0)
    assert found.similarity == NovelOptions(objectness=0.0)


def test_meshes_name_the_detections_of_a_trained_detector(loaded: list[Path]) -> None:
    assert make_detector("my/detector", [bracket()])[1] == ("bracket",)
    assert make_detector("coco", [bracket()])[1] == ("bracket",)


def test_what_cannot_be_loaded_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="no detector at"):
        make_detector(str(tmp_path / "none"), [])
    monkeypatch.setattr(novel, "AppearanceSimilarity", lambda *_: None)
    with pytest.raises(ConfigError, match="trained for cup, duck, not for any object"):
        NovelDetector(TrainedDetector(OWN, None), None)  # type: ignore[arg-type]

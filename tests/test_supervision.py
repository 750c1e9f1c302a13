"""Detections of the supervision library: into posekit, and back."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from posekit import api
from posekit.camera import Camera
from posekit.detect import from_supervision, to_supervision
from posekit.errors import OutputError, PromptError
from posekit.lens import Lens
from posekit.results import Detection, Source
from posekit.view import View

BOXES = np.array([[10, 20, 30, 40], [1, 2, 3, 4]], np.float32)
CAMERA = Camera(80, 80, 32, 24, 64, 48)
MUG: Any = SimpleNamespace(name="Mug")


def masks() -> np.ndarray:
    found = np.zeros((2, 48, 64), bool)
    found[0, 20:40, 10:30] = True
    return found


def detections(**more: object) -> SimpleNamespace:
    """What has the fields of supervision.Detections."""
    fields = {"mask": None, "confidence": None, "class_id": None, "data": {}}
    return SimpleNamespace(**{"xyxy": BOXES, **fields, **more})


def test_boxes_alone() -> None:
    first, second = from_supervision(detections())
    assert (first.box, first.mask, first.score, first.label) == ((10.0, 20.0, 30.0, 40.0), None, 1.0, None)
    assert first.source is Source.FILE and second.box == (1.0, 2.0, 3.0, 4.0)
    assert from_supervision(detections(xyxy=np.zeros((0, 4)))) == []


def test_masks_scores_and_names() -> None:
    given = detections(mask=masks(), confidence=np.array([0.9, 0.25]), class_id=np.array([1, 0]))
    for names in (["pot", "mug"], {0: "pot", 1: "mug"}):
        first, second = from_supervision(given, names)
        assert (first.label, first.score, second.label, second.score) == ("mug", 0.9, "pot", 0.25)
        np.testing.assert_array_equal(first.mask, masks()[0])
        assert second.mask is None, "an empty mask says nothing"
    given.data = {"class_name": np.array(["cup", "jar"])}
    assert [d.label for d in from_supervision(given, ["pot", "mug"])] == ["cup", "jar"]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ([1, 2], "no detections"),
        (detections(xyxy=np.zeros((2, 5))), "no detections"),
        (detections(confidence=np.ones(3)), "confidence has 3 entries for 2 boxes"),
        (detections(mask=np.ones((2, 9), bool)), r"mask is bool \(N, H, W\)"),
        (detections(data={"class_name": ["a"]}), "1 entries for 2 boxes"),
        (detections(class_id=np.array([0, 7])), "class_id 7 has no name"),
    ],
)
def test_what_does_not_fit(given: Any, words: str) -> None:
    with pytest.raises(PromptError, match=words):
        from_supervision(given, ["pot"])


def test_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "supervision", None)
    with pytest.raises(OutputError, match=r"pip install \"posekit\[supervision\]\""):
        to_supervision([])


def test_there_and_back() -> None:
    library = pytest.importorskip("supervision")
    given = [
        Detection((10.0, 20.0, 30.0, 40.0), masks()[0], 0.75, "mug", Source.NOVEL),
        Detection((1.0, 2.0, 3.0, 4.0), np.ones((48, 64), bool), 0.5, "jar", Source.NOVEL),
    ]
    found = to_supervision(given)
    assert isinstance(found, library.Detections) and found.class_id.tolist() == [1, 0]
    for a, b in zip(given, from_supervision(found), strict=True):
        assert (a.box, a.score, a.label, Source.FILE) == (b.box, b.score, b.label, b.source)
        np.testing.assert_array_equal(a.mask, b.mask)
    assert len(to_supervision([])) == 0
    assert to_supervision([given[0], Detection((0.0, 0.0, 9.0, 9.0))]).mask is None
    assert [d.label for d in from_supervision(found[found.confidence > 0.6])] == ["mug"]


# --- in posekit.estimate ---


def view(lens: Lens | None = None) -> View:
    return View(np.zeros((48, 64, 3), np.uint8), CAMERA, lens=lens)


def test_those_of_the_mesh_are_taken() -> None:
    given = detections(mask=masks(), data={"class_name": np.array(["mug", "pot"])})
    [found] = api._of_model(view(), MUG, given)
    assert found.box == (10.0, 20.0, 30.0, 40.0) and found.label == "Mug" and found.mask is not None
    assert len(api._of_model(view(), MUG, from_supervision(detections()))) == 2, "no labels: all of them"
    one = [Detection((10.0, 20.0, 300.0, 40.0), label="cup", source=Source.FILE)]
    [found] = api._of_model(view(), MUG, one)
    assert found.box == (10.0, 20.0, 64.0, 40.0), "one class and one mesh belong together; boxes end at the picture"
    with pytest.raises(PromptError, match="are of cup, pot, none of Mug"):
        api._of_model(view(), MUG, [*one, Detection((1.0, 1.0, 9.0, 9.0), label="pot")])
    with pytest.raises(PromptError, match="a mask is 9x8, its picture 64x48"):
        api._of_model(view(), MUG, [Detection((1.0, 1.0, 9.0, 9.0), np.ones((8, 9), bool))])
    with pytest.raises(PromptError, match="list of Detection"):
        api._of_model(view(), MUG, [(1, 2, 3, 4)])
    with pytest.raises(PromptError, match="box and detections were both given"):
        api.estimate(view(), MUG, (1, 2, 3, 4), detections=one)


def test_they_move_with_the_photograph() -> None:
    lens = Lens(CAMERA, (0.2, 0.0, 0.0, 0.0))
    [found] = api._of_model(view(lens), MUG, [Detection((4.0, 4.0, 60.0, 44.0), masks()[0])])
    assert found.box == pytest.approx(lens.undistorted_box((4.0, 4.0, 60.0, 44.0)), abs=6) and found.box[0] != 4.0

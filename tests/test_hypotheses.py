"""First poses: the template search on rendered photographs, and MV-Net's frame."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from objects import CAMERA, bracket
from posekit.camera import mask_box
from posekit.errors import WeightsError
from posekit.first_pose.hypotheses import BoxOptions, BoxSearch, EvidenceScorer, TemplateSearch
from posekit.first_pose.mvnet import MVNetSearch
from posekit.geometry import Pose, random_rotation, rotation_angle, so3_exp
from posekit.nets.config import PaperConfig
from posekit.nets.heads import Prediction
from posekit.nets.pose_delta import delta_between
from posekit.nets.weights import build
from posekit.render import Light, Renderer
from posekit.results import Detection, Source
from posekit.view import View
from posekit.zoom import zoom_to_box


def seen(renderer: Renderer, truth: Pose) -> tuple[View, Detection]:
    """A photograph under another light than the templates', and its true mask."""
    view = renderer.render(bracket(), [truth], CAMERA, light=Light(direction=(0.7, -0.3, -0.5), ambient=0.35))[0]
    assert view.mask is not None
    box = mask_box(view.mask)
    assert box is not None
    return View(view.image, CAMERA), Detection(box, view.mask, 1.0, "bracket", Source.MASK)


def test_the_search_finds_the_pose_among_its_best(renderer: Renderer) -> None:
    model = bracket()
    search = TemplateSearch(model, renderer)
    rng = np.random.default_rng(1)
    near, depths, sides = [], [], []
    for _ in range(12):
        place = np.array([rng.uniform(-0.3, 0.3), rng.uniform(-0.2, 0.2), rng.uniform(0.5, 1.0)])
        truth = Pose(random_rotation(rng), place) @ model.T_ctr_obj
        view, detection = seen(renderer, truth)
        found = search.search(view, detection, 5)
        assert 1 <= len(found) <= 5
        assert [h.score for h in found] == sorted((h.score for h in found), reverse=True)
        turn = [np.rad2deg(rotation_angle(h.T_cam_obj.R.T @ truth.R)) for h in found]
        best = found[int(np.argmin(turn))].T_cam_obj @ model.T_obj_ctr
        near.append(min(turn))
        depths.append(abs(best.t[2] / place[2] - 1))
        sides.append(np.linalg.norm(best.t[:2] - place[:2]))
    assert np.mean(np.array(near) < 25) >= 0.9
    assert np.median(depths) < 0.05 and np.median(sides) < 0.01


def test_a_box_is_enough(renderer: Renderer) -> None:
    """Boxes 5 % wrong, before a ground whose colours differ from the object's; a mask is not needed."""
    model, rng = bracket(), np.random.default_rng(4)
    search, near, depths = BoxSearch(model, renderer), [], []
    for _ in range(8):
        place = np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.15, 0.15), rng.uniform(0.5, 1.0)])
        truth = Pose(random_rotation(rng), place) @ model.T_ctr_obj
        view, detection = seen(renderer, truth)
        ground = rng.integers(90, 130, size=view.image.shape).astype(np.uint8)
        view = View(np.where(detection.mask[..., None], view.image, ground), CAMERA)  # type: ignore[index]
        size = np.array([detection.box[2] - detection.box[0], detection.box[3] - detection.box[1]] * 2)
        wrong = tuple(float(v) for v in np.array(detection.box) + rng.uniform(-0.05, 0.05, 4) * size)
        found = search.search(view, Detection(wrong), 5)  # type: ignore[arg-type]
        for k, a in enumerate(found):
            assert all(rotation_angle(a.T_cam_obj.R.T @ b.T_cam_obj.R) > search.options.apart for b in found[:k])
        turn = [np.rad2deg(rotation_angle(h.T_cam_obj.R.T @ truth.R)) for h in found]
        near.append(min(turn))
        depths.append(abs((found[int(np.argmin(turn))].T_cam_obj @ model.T_obj_ctr).t[2] / place[2] - 1))
    assert np.mean(np.array(near) < 25) >= 0.85 and np.median(depths) < 0.08
    empty = dataclasses.replace(detection, mask=np.zeros((480, 640), bool))
    assert search.search(view, empty, 5) == []


def test_kept_silhouettes_are_the_same_and_damaged_ones_are_made_anew(
    renderer: Renderer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    model, options = bracket(), BoxOptions(views=12)
    first = BoxSearch(model, renderer, options)
    [file] = (tmp_path / "posekit" / "silhouettes").iterdir()
    place, calls = BoxSearch._place, []
    monkeypatch.setattr(BoxSearch, "_place", lambda *args: calls.append(0) or place(*args))
    for damage, made in ((False, 0), (True, 72), (False, 0)):
        if damage:
            file.write_bytes(file.read_bytes()[:-2000])
        calls.clear()
        again = BoxSearch(model, renderer, options)
        assert len(calls) == made
        for name in ("masks", "colours", "edges", "normals", "starts"):
            values = getattr(again.silhouettes, name), getattr(first.silhouettes, name)
            np.testing.assert_array_equal(*values, strict=True)
        assert [dataclasses.astuple(p)[:4] for p in again.placed] == [dataclasses.astuple(p)[:4] for p in first.placed]
        np.testing.assert_array_equal([p.offset for p in again.placed], [p.offset for p in first.placed])
    assert len(BoxSearch(model, renderer, BoxOptions(views=6)).placed) == 6 * 24, "other options are not mixed up"


def test_hypotheses_lie_apart_and_an_empty_mask_gives_none(renderer: Renderer) -> None:
    model = bracket()
    truth = Pose(np.eye(3), [0.0, 0.0, 0.7]) @ model.T_ctr_obj
    view, detection = seen(renderer, truth)
    search = TemplateSearch(model, renderer)
    found = search.search(view, detection, 8)
    for k, a in enumerate(found):
        assert all(rotation_angle(a.T_cam_obj.R.T @ b.T_cam_obj.R) > search.options.apart for b in found[:k])
    empty = dataclasses.replace(detection, mask=np.zeros((480, 640), bool))
    assert search.search(view, empty, 5) == []


def test_evidence_is_best_at_the_truth(renderer: Renderer) -> None:
    model = bracket()
    truth = Pose(random_rotation(np.random.default_rng(2)), [0.1, -0.05, 0.7]) @ model.T_ctr_obj
    view, detection = seen(renderer, truth)
    turned = Pose(truth.R @ so3_exp([0.3, 0.2, 0]), truth.t)
    away = Pose(truth.R, truth.t + [0.3, 0, 0])
    judged = EvidenceScorer(view, detection.box, model, renderer).scores([truth, turned, away])
    assert judged[0] > judged[1] > judged[2] == 0.0


def test_mvnet_answers_relative_to_the_frontal_view(renderer: Renderer) -> None:
    """With an MV-Net that knows the truth the first pose is the truth: its frame is what the docstring says."""
    model = bracket()
    truth = Pose(random_rotation(np.random.default_rng(3)), [0.25, -0.15, 0.8]) @ model.T_ctr_obj
    view, detection = seen(renderer, truth)
    networks = build("paper", PaperConfig((160, 120), 0.125))
    search = MVNetSearch(model, networks, renderer)
    zoom = zoom_to_box(CAMERA, detection.box, networks.size)
    target = Pose.rotation(zoom.R_view_cam) @ truth @ model.T_obj_ctr
    delta = delta_between(search.frontal(zoom.camera), target, zoom.camera.fx)
    assert abs(delta.v[2]) < 0.7, "the box gives the depth to within a factor of two"

    class Knowing(torch.nn.Module):
        def forward(self, observed: torch.Tensor, views: torch.Tensor) -> Prediction:
            assert observed.shape == (1, 4, 120, 160) and views.shape == (1, 6, 4, 120, 160)
            quat = torch.from_numpy(Pose.rotation(delta.R).quat_wxyz)[None]
            return Prediction(quat, torch.from_numpy(delta.v)[None])

    search.mvnet = Knowing()  # type: ignore[assignment]
    found = search.search(view, detection, 5)
    assert len(found) == 1
    np.testing.assert_allclose(found[0].T_cam_obj.matrix, truth.matrix, atol=1e-6)


def test_mvnet_views_are_the_six_faces(renderer: Renderer) -> None:
    networks = build("paper", PaperConfig((160, 120), 0.125))
    search = MVNetSearch(bracket(), networks, renderer)
    looking = np.stack([R[2] for R in search.rotations])  # the optical axis in the object's frame
    np.testing.assert_allclose(looking @ looking.T, np.round(looking @ looking.T), atol=1e-12)
    assert len({tuple(np.round(d).astype(int)) for d in looking}) == 6
    assert search.views.shape == (6, 4, 120, 160) and (search.views[:, 3].sum((1, 2)) > 100).all()
    found = search.search(*seen(renderer, Pose(np.eye(3), [0.0, 0.0, 0.7])), 5)
    assert len(found) <= 1, "an untrained network still answers in the right form"


def test_mvnet_without_weights_is_refused(renderer: Renderer) -> None:
    networks = dataclasses.replace(build("lite"), mvnet=None)
    with pytest.raises(WeightsError, match="--init templates"):
        MVNetSearch(bracket(), networks, renderer)

"""The data engine: what a pair says is true, augmentation does not change it, and a seed gives the same stream."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree

from objects import bracket
from posekit.geometry import quat_to_rotation, rotation_angle
from posekit.mesh.model import ObjectModel
from posekit.nets.pose_delta import apply_delta
from posekit.render import Light, Renderer
from posekit.synth.appearance import KINDS, scanned, variants, washed_out
from posekit.synth.procedural import random_object, random_texture
from posekit.train.data.augment import AugmentConfig, augment, composed, disturb_mask, observe
from posekit.train.data.crops import Frontal, SceneConfig, box_sample, render_scenes
from posekit.train.data.pairs import Pair, PairConfig, render_pairs
from posekit.train.data.stream import PairStream, StreamConfig, load_photos
from posekit.zoom import frontal_pose


@pytest.fixture(scope="module")
def pairs() -> list[Pair]:
    return render_pairs(Renderer(), bracket(), 40, PairConfig(unlike=0, deformed=0, scans=0), np.random.default_rng(0))


def test_the_flow_leads_to_the_same_paint(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the flow says that a seen anchor goes, the target shows the colour that the source shows."""
    monkeypatch.setattr(
        "posekit.train.data.pairs.random_light", lambda rng: Light(ambient=0.9, diffuse=0.1, specular=0.0)
    )
    hues = []
    for pair in render_pairs(
        Renderer(), bracket(), 30, PairConfig(unlike=0, deformed=0, scans=0), np.random.default_rng(0)
    ):
        if pair.lost:
            continue
        rows, columns = np.nonzero(pair.seen)
        place = np.rint(np.stack([columns, rows], 1) * 4 + 2 + pair.flow[rows, columns]).astype(int)
        a = pair.source[rows * 4 + 2, columns * 4 + 2, :3].astype(float)
        b = pair.target[place[:, 1], place[:, 0], :3].astype(float)
        assert (pair.target[place[:, 1], place[:, 0], 3] == 255).all()
        hues.append((a / a.sum(1, keepdims=True)) - (b / b.sum(1, keepdims=True)))
    far = np.abs(np.concatenate(hues)).max(1) > 0.12
    assert far.mean() < 0.05, "only pixels at the border of two colours may differ"


def test_pairs_are_what_their_numbers_say(pairs: list[Pair]) -> None:
    lost = [p for p in pairs if p.lost]
    assert 1 <= len(lost) <= 12
    assert all(p.angle >= np.deg2rad(25) for p in lost)
    for p in pairs:
        assert rotation_angle(quat_to_rotation(p.quat_wxyz)) == pytest.approx(p.angle, abs=1e-3)
        assert p.valid.any() and p.quat_wxyz[0] >= 0 and not (p.seen & ~p.valid).any()
        # the source's centre is the crop's: its silhouette reaches the middle's neighbourhood on both sides
        columns = np.flatnonzero((p.source[..., 3] > 0).any(0))
        assert columns[0] < 64 < columns[-1]


def test_augmentation_keeps_the_truth(pairs: list[Pair]) -> None:
    rng = np.random.default_rng(5)
    for pair in pairs[:10]:
        sample = augment(pair, pairs, [], AugmentConfig(), rng)
        assert sample.pair is pair and sample.rendered is pair.source
        assert sample.observed.shape == pair.target.shape[:2] + (3,) and sample.observed.dtype == np.uint8
        assert not (sample.visible & ~pair.seen).any(), "nothing becomes visible"


def test_without_augmentation_the_object_stays_where_it_is(pairs: list[Pair]) -> None:
    config = AugmentConfig(clutter=0, occluded=0, shrink=1, dilate=0, no_mask=0, box_mask=0, cut_mask=0)
    rng = np.random.default_rng(6)
    overlaps = []
    for pair in pairs[:10]:
        mask = observe(pair.target, [], [], config, rng)[0][..., 3] > 0
        true = pair.target[..., 3] > 0
        overlaps.append((mask & true).sum() / (mask | true).sum())
    assert np.median(overlaps) > 0.9


def test_silhouettes_are_the_targets_in_blocks(pairs: list[Pair]) -> None:
    pair = pairs[0]
    free = augment(pair, [], [], AugmentConfig(occluded=0), np.random.default_rng(0)).silhouettes
    whole = pair.target[..., 3].reshape(24, 4, 32, 4).mean((1, 3))
    np.testing.assert_allclose(free[1], whole, atol=1)
    np.testing.assert_array_equal(free[0], free[1])
    hidden = augment(pair, pairs, [], AugmentConfig(occluded=1), np.random.default_rng(1)).silhouettes
    np.testing.assert_array_equal(hidden[1], free[1])
    assert (hidden[0] <= hidden[1]).all() and (hidden[0] < hidden[1]).any()


def test_edges_are_mixed_over_a_pixel_and_the_inside_kept() -> None:
    target = np.zeros((96, 128, 4), np.uint8)
    target[30:60, 40:90] = (200, 40, 40, 255)
    plain = AugmentConfig(photo=0, clutter=0, camouflage=0, occluded=0, shrink=1, tone=0, harsh=0)
    hard, soft = (composed(target, [], [], replace(plain, soft=s), np.random.default_rng(2))[0] for s in (0.0, 1.0))
    assert hard.shape == (96, 128, 3)
    change = np.abs(hard.astype(int) - soft).sum(2)
    assert change[27:33, 60].max() > 10 and change[45, 60] <= change[27:33, 60].max()


@pytest.mark.parametrize("kind", KINDS[:-1])
def test_a_faded_mesh_has_the_shape_and_fewer_colours(kind: str) -> None:
    rng = np.random.default_rng(0)
    model = next(m for m in (random_object(rng) for _ in range(50)) if m.texture is not None)
    found = washed_out(model, kind, rng)
    np.testing.assert_array_equal(found.vertices, model.vertices)
    assert found.texture is None and (found.colors is None) == (kind == "plain")


def test_variants_look_unlike_and_stay_near_each_other() -> None:
    rng = np.random.default_rng(1)
    model = random_object(rng)
    assert variants(model, [], 0.0, 0.0, rng) == (model, model)
    unlike = [variants(model, [], 1.0, 0.0, rng) for _ in range(10)]
    assert all(a is not b for a, b in unlike)
    rendered, observed = variants(model, [], 0.0, 1.0, rng)
    assert observed is model
    moved = np.linalg.norm(rendered.vertices - model.vertices, axis=1).max() / model.diameter
    assert 0.0005 < moved < 0.01


def test_a_scan_has_the_shape_within_two_percent_and_colours_at_its_vertices() -> None:
    rng = np.random.default_rng(3)
    for model in (bracket(), *(random_object(rng) for _ in range(6))):
        for _ in range(4):
            scan = scanned(model, rng)
            assert scan.texture is None and scan.uvs is None
            assert (scan.colors is None) == (model.colors is None and model.texture is None)
            assert not np.array_equal(scan.vertices, model.vertices)
            assert np.isfinite(scan.normals).all() and len(scan.normals) == len(scan.vertices)
            apart = cKDTree(model.vertices).query(scan.vertices)[0] / model.diameter
            assert np.median(apart) < 0.04  # vertices of the subdivided faces included


def test_a_scan_of_a_fine_mesh_stays_near_its_surface() -> None:
    rng = np.random.default_rng(5)
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    ball = ObjectModel.from_arrays(sphere.vertices, sphere.faces, name="ball")
    off = [abs(np.linalg.norm(scanned(ball, rng).vertices, axis=1) - 0.05) / ball.diameter for _ in range(12)]
    assert all(0.0003 < np.median(each) < 0.02 for each in off)
    assert max(each.max() for each in off) > 0.02  # a missing or flat bottom is among them
    assert all(np.quantile(each, 0.8) < 0.03 for each in off)


@pytest.mark.parametrize(
    ("config", "check"),
    [
        (AugmentConfig(no_mask=1), lambda out, mask: not out.any()),
        (AugmentConfig(no_mask=0, box_mask=1), lambda out, mask: out.sum() == 30 * 40 and out[mask].all()),
    ],
)
def test_masks_go_wrong_as_told(config: AugmentConfig, check) -> None:  # type: ignore[no-untyped-def]
    mask = np.zeros((120, 160), bool)
    mask[40:70, 60:100] = True
    mask[50:60, 70:80] = False
    assert check(disturb_mask(mask, config, np.random.default_rng(0)), mask)


@pytest.mark.parametrize(("grown", "least", "most"), [(0.0, 0.7, 0.985), (0.5, 0.985, 1.015), (1.0, 1.015, 1.3)])
def test_masks_are_too_large_as_often_as_told(grown: float, least: float, most: float) -> None:
    mask = np.zeros((120, 160), bool)
    mask[30:90, 40:120] = True
    config, rng = AugmentConfig(grown=grown, no_mask=0, box_mask=0, cut_mask=0), np.random.default_rng(3)
    areas = [disturb_mask(mask, config, rng).sum() / mask.sum() for _ in range(200)]
    assert least < np.mean(areas) < most


def test_procedural_objects_are_valid_and_various() -> None:
    rng = np.random.default_rng(7)
    objects = [random_object(rng) for _ in range(30)]
    for o in objects:
        assert np.isfinite(o.vertices).all() and 0.03 < o.diameter < 0.32
        assert np.abs(np.linalg.norm(o.normals, axis=1) - 1).max() < 1e-3
    assert {o.texture is None for o in objects} == {True, False}
    assert len({len(o.vertices) for o in objects}) > 5
    texture = random_texture(rng)
    assert texture.shape == (256, 256, 3) and texture.dtype == np.uint8


def small(**changes: int) -> StreamConfig:
    return StreamConfig(**{"batch": 4, "pool": 32, "per_object": 4, **changes})


def test_a_seed_gives_the_same_batches() -> None:
    first, again, other = (iter(PairStream(small(), seed)) for seed in (1, 1, 2))
    for _ in range(3):
        a, b, c = next(first), next(again), next(other)
        dense = {"observed", "rendered", "flow", "relief", "valid", "visible", "silhouettes"}
        assert set(a) == dense | {"focal", "quat_wxyz", "v", "angle", "lost"}
        assert all(torch.equal(a[k], b[k]) for k in a)
        assert not torch.equal(a["observed"], c["observed"])
    assert a["observed"].shape == (4, 96, 128, 3) and a["flow"].shape == (4, 2, 24, 32)


def test_the_users_meshes_are_what_is_drawn() -> None:
    stream = PairStream(small(), 0, models=[bracket()])
    batch = next(iter(stream))
    assert batch["valid"].any(dim=(1, 2)).all()


def test_photos_are_read_and_others_left(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "b.png"), np.full((1000, 2000, 3), (255, 0, 0), np.uint8))
    (tmp_path / "a.jpg").write_bytes(b"no picture")
    (tmp_path / "c.txt").write_text("neither")
    photos = load_photos(tmp_path)
    assert [p.shape for p in photos] == [(400, 800, 3)] and tuple(photos[0][0, 0]) == (0, 0, 255)
    assert load_photos(None) == []


def test_a_stream_goes_on_where_it_stopped() -> None:
    config = small(reuse=1)
    whole = iter(PairStream(config, 1))
    batches = [next(whole) for _ in range(9)]
    later = iter(PairStream(config, 1, start=7))
    for batch in batches[7:]:
        again = next(later)
        assert set(batch) == set(again) and all(torch.equal(batch[k], again[k]) for k in batch)
    assert not torch.equal(batches[7]["observed"], batches[8]["observed"])


def test_two_processes_see_what_one_with_twice_the_batch_sees() -> None:
    both = next(iter(PairStream(small(batch=4, shard=2, pool=16), 1)))
    parts = [next(iter(PairStream(small(batch=2, shard=2, pool=8), 1, rank=rank))) for rank in range(2)]
    for key, value in both.items():
        assert torch.equal(value, torch.cat([part[key] for part in parts])), key


def test_the_numbers_of_mvnets_samples_are_true() -> None:
    """The frontal view moved by a sample's delta looks as the sample's crop does."""
    renderer, model, config = Renderer(), bracket((0.02, 0.0, 0.01)), SceneConfig()
    frontal = Frontal.of(model, renderer, config.crop)
    rng = np.random.default_rng(3)
    assert frontal.views.shape == (6, 120, 160, 4)
    for scene in render_scenes(renderer, model, 6, config, rng):
        sample = box_sample(scene.rgba, scene, frontal, config, rng)
        source = frontal_pose(frontal.camera, frontal.distance, sample.camera)
        pose = apply_delta(source, sample.delta, sample.camera.fx) @ model.T_ctr_obj
        (drawn,) = renderer.render(model, [pose], sample.camera, coords=False)
        seen = sample.observed[..., 3] > 0
        assert drawn.mask is not None
        assert (drawn.mask & seen).sum() / (drawn.mask | seen).sum() > 0.93
        rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
        assert 0.5 < max((columns[-1] - columns[0]) / 160, (rows[-1] - rows[0]) / 120) <= 1.0, "the box fills the crop"

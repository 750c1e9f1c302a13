"""The matching MV-Net: shapes, gradients, targets, one batch over-fitted, and the search with an oracle's answer."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from objects import bracket
from posekit.camera import Camera, mask_box
from posekit.first_pose.mvnet import MatchingOutput, MatchingSearch
from posekit.first_pose.view_bank import DISTANCE, ViewBank
from posekit.geometry import Pose, fibonacci_sphere, random_rotation, rotation_angle, rotation_between
from posekit.mesh.model import ObjectModel
from posekit.nets.mvnet import CELL, GRID, NONE, MatchingMVNet, MVOutput, rgb_input, view_input
from posekit.nets.mvnet_loss import MVLossConfig, mvnet_loss
from posekit.render import Renderer
from posekit.results import Detection
from posekit.synth.procedural import random_object
from posekit.train.data.view_queries import (
    QueryConfig,
    QueryGroup,
    QueryScene,
    Relation,
    collate_queries,
    draw_queries,
    match_targets,
    render_queries,
)
from posekit.view import View

QUERIES = QueryConfig(queries=2, templates=8, kept=4, views=12, absent=0.0)


@dataclass(frozen=True)
class Small:
    widths: tuple[int, int] = (16, 32)
    size: tuple[int, int] = (128, 96)


class StandIn(nn.Module):
    """A tower as SV-Net's, smaller."""

    def __init__(self, widths: tuple[int, int]) -> None:
        super().__init__()
        fine, coarse = widths
        self.fine = nn.Sequential(nn.Conv2d(3, fine, 4, 4), nn.ReLU(), nn.Conv2d(fine, fine, 3, 1, 1), nn.ReLU())
        self.coarse = nn.Sequential(nn.Conv2d(fine, coarse, 3, 2, 1), nn.BatchNorm2d(coarse), nn.ReLU())

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        fine = self.fine(x)
        return fine, self.coarse(fine)


def small_net() -> MatchingMVNet:
    torch.manual_seed(0)
    return MatchingMVNet(StandIn(Small().widths), Small(), channels=32, heads=2, blocks=2, inner=16, part=16)


@pytest.fixture(scope="module")
def made(renderer: Renderer) -> tuple[ViewBank, list[QueryScene], list[QueryScene]]:
    rng = np.random.default_rng(4)
    bank = ViewBank.of(bracket(), renderer, fibonacci_sphere(QUERIES.views))
    other = random_object(rng)
    return (bank, render_queries(renderer, bracket(), 4, QUERIES, rng),
            render_queries(renderer, other, 3, QUERIES, rng))  # fmt: skip


def group_of(made: tuple[ViewBank, list[QueryScene], list[QueryScene]], seed: int,
             config: QueryConfig = QUERIES) -> QueryGroup:  # fmt: skip
    bank, scenes, others = made
    return draw_queries(bank, scenes, [s.rgba for s in others], [], config, np.random.default_rng(seed), others)


def run(net: MatchingMVNet, batch: dict[str, Tensor]) -> MVOutput:
    return net(rgb_input(batch["mv_observed"]), view_input(batch["mv_views"]), batch["mv_object"], batch["mv_chosen"])


def test_a_batch_has_the_documented_shapes_and_repeats(made) -> None:  # type: ignore[no-untyped-def]
    batch = collate_queries([group_of(made, 1), group_of(made, 2)])
    again = collate_queries([group_of(made, 1), group_of(made, 2)])
    assert all(torch.equal(batch[name], again[name]) for name in batch)
    B, k, K, cells = 4, 4, 8, 192
    shapes = {"observed": (B, 96, 128, 3), "views": (2, K, 64, 64, 4), "object": (B,), "chosen": (B, k),
              "cell": (B, k, cells), "offset": (B, k, 2, cells), "turn": (B, k, 2), "facing": (B, k), "near": (B, k),
              "near_all": (B, K), "silhouettes": (B, 2, 24, 32), "presence": (B,)}  # fmt: skip
    assert {name: tuple(t.shape) for name, t in batch.items()} == {f"mv_{n}": s for n, s in shapes.items()}
    assert 0.02 < (batch["mv_cell"] != NONE).float().mean() < 0.5
    assert torch.equal(batch["mv_near"], batch["mv_near_all"].gather(1, batch["mv_chosen"]))
    assert not (batch["mv_silhouettes"][:, 0] & ~batch["mv_silhouettes"][:, 1]).any()


def test_absent_queries_have_no_silhouette(made) -> None:  # type: ignore[no-untyped-def]
    config = QueryConfig(queries=3, templates=8, kept=4, views=12, absent=1.0)
    batch = collate_queries([group_of(made, 3, config)])
    assert not batch["mv_presence"].any() and not batch["mv_silhouettes"].any()
    assert (batch["mv_cell"] == NONE).all()


def test_shapes_and_gradients(made) -> None:  # type: ignore[no-untyped-def]
    net, batch = small_net(), collate_queries([group_of(made, 1), group_of(made, 2)])
    statistics = net.tower.coarse[1].running_mean.clone()
    out = run(net.train(), batch)
    assert torch.equal(statistics, net.tower.coarse[1].running_mean) and net.tower.coarse[1].training
    assert out.selection.shape == (4, 8) and out.early.shape == (4, 4, 192, 64)
    m = out.matches
    assert m.cells.shape == (4, 4, 192, 65) and m.offsets.shape == (4, 4, 2, 12, 16)
    assert m.silhouettes.shape == (4, 2, 24, 32) and m.scores.shape == (4, 4)
    assert m.turns.shape == (4, 4, 2) and m.presence.shape == (4,)
    loss, parts = mvnet_loss(out, batch, MVLossConfig())
    assert not any(part.requires_grad for part in parts.values())
    loss.backward()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in net.parameters())


def test_one_batch_is_over_fitted(made) -> None:  # type: ignore[no-untyped-def]
    net, batch = small_net(), collate_queries([group_of(made, 5)])
    optimiser = torch.optim.AdamW(net.parameters(), 3e-3)
    first: dict[str, Tensor] = {}
    for step in range(150):
        loss, parts = mvnet_loss(run(net, batch), batch)
        first = first or parts
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimiser.step()
        if step % 25 == 0:
            print(step, {k: round(float(v), 3) for k, v in parts.items()})
    for name in ("match", "none", "early", "silhouette", "turn", "offset", "presence"):
        assert parts[name] < 0.6 * first[name], name


def test_targets_lie_where_the_point_is_seen(made) -> None:  # type: ignore[no-untyped-def]
    """Project each query cell's point with the template's own rotation and camera: it lies in the cell that is said."""
    bank, scenes, _ = made
    rotations = bank.template_rotations
    checked = 0
    for scene, index in itertools.product(scenes, (0, 5, 14, 27, 42)):
        cell, offset = match_targets(bank, np.array([index]), scene.coords, scene.on, QUERIES.tolerance)
        drawn = bank.template_coords(index)
        for i in np.flatnonzero(cell[0] != NONE):
            point = scene.coords.reshape(-1, 3)[i].astype(np.float64)
            u, v = bank.template_camera(index).project(rotations[index] @ point + [0, 0, DISTANCE])
            assert cell[0, i] == int((v + 0.5) // CELL) * GRID + int((u + 0.5) // CELL)
            place = (cell[0, i] % GRID + 0.5 + offset[0, 0, i], cell[0, i] // GRID + 0.5 + offset[0, 1, i])
            assert np.allclose(np.array(place) * CELL - 0.5, (u, v), atol=1e-3)
            seen = drawn[round(v), round(u)]
            assert np.linalg.norm(seen - point) < QUERIES.tolerance
            checked += 1
    assert checked > 60


def test_the_turn_is_the_one_between_pictures(made) -> None:  # type: ignore[no-untyped-def]
    """A template of the same view turned by 90 degrees differs by that turn and by nothing else."""
    bank, _, _ = made
    rotations = bank.template_rotations
    relation = Relation.of(rotations[0], rotations[:4], QUERIES)
    assert np.allclose(relation.facing, 1, atol=1e-6)
    assert np.allclose(relation.turn, [[1, 0], [0, 1], [-1, 0], [0, -1]], atol=1e-6)
    assert relation.near.argmax() == 0


def oracle(search: MatchingSearch, crop: View, T_crop_ctr: Pose, model: ObjectModel, matched: bool) -> MatchingOutput:
    """What a perfect network says of a crop whose truth is known; without ``matched`` it finds no cells."""
    camera, (h, w) = crop.camera, QUERIES.cells
    drawn = Renderer().render(model, [T_crop_ctr @ model.T_ctr_obj], camera.resized(w, h), rgb=False)[0]
    mask = Renderer().render(model, [T_crop_ctr @ model.T_ctr_obj], camera.resized(2 * w, 2 * h))[0].mask
    assert drawn.coords is not None and drawn.mask is not None and mask is not None
    R = rotation_between(T_crop_ctr.t, [0, 0, 1]) @ T_crop_ctr.R
    relation = Relation.of(R, search.rotations, QUERIES)
    best = np.argsort(-relation.near)[:8].astype(np.int64)
    coords = ((drawn.coords - model.center) / model.diameter).astype(np.float32)
    cell, offset = match_targets(search.bank, best, coords, drawn.mask, QUERIES.tolerance)
    logits = np.zeros((8, h * w, 65), np.float32)
    np.put_along_axis(logits, cell[..., None] if matched else np.full_like(cell, NONE)[..., None], 12.0, axis=2)
    silhouette = np.where(mask, 8.0, -8.0).astype(np.float32)
    return MatchingOutput(best, logits, offset.reshape(8, 2, h, w), np.stack([silhouette] * 2),
                  relation.near[best].astype(np.float32), relation.turn[best].astype(np.float32), 4.0)  # fmt: skip


@pytest.mark.parametrize("matched", [True, False])
def test_an_oracle_gives_the_true_pose(renderer: Renderer, matched: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    model, camera = bracket((0.02, 0.0, -0.01)), Camera(572.4, 573.6, 325.3, 242.0, 640, 480)
    search = MatchingSearch(model, small_net().eval(), renderer)
    rng = np.random.default_rng(2)
    turns, places, overlaps = [], [], []
    for _ in range(6):
        place = np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.15, 0.15), rng.uniform(0.5, 0.9)])
        truth = Pose(random_rotation(rng), place) @ model.T_ctr_obj
        drawn = renderer.render(model, [truth], camera)[0]
        assert drawn.mask is not None
        box = mask_box(drawn.mask)
        assert box is not None
        detection = Detection((box[0] - 6, box[1] + 4, box[2] + 3, box[3] + 8))

        def true_output(crop: View, truth: Pose = truth) -> MatchingOutput:
            T_crop_ctr = Pose.rotation(crop.R_view_cam) @ truth @ model.T_obj_ctr
            return oracle(search, crop, T_crop_ctr, model, matched)

        monkeypatch.setattr(search, "output", true_output)
        result = search.examine(View(drawn.image, camera), detection, 3)
        best = result.hypotheses[0].T_cam_obj
        turns.append(np.rad2deg(rotation_angle(best.R.T @ truth.R)))
        places.append(np.linalg.norm((best @ model.T_obj_ctr).t - place) / place[2])
        overlaps.append((result.mask & drawn.mask).sum() / (result.mask | drawn.mask).sum())
        assert result.existence_score > 0.9
    assert np.mean(overlaps) > 0.8
    if matched:
        assert max(turns) < 4.0 and max(places) < 0.02
    else:
        assert np.median(turns) < 25.0 and np.median(places) < 0.1


def test_the_search_runs_untrained(renderer: Renderer) -> None:
    search = MatchingSearch(bracket(), small_net().eval(), renderer)
    view = View(np.zeros((480, 640, 3), np.uint8), Camera(572.4, 573.6, 325.3, 242.0, 640, 480))
    found = search.examine(view, Detection((200, 150, 320, 260)), 5)
    assert found.mask.shape == (480, 640) and 0 <= found.existence_score <= 1 and len(found.hypotheses) <= 5
    assert all(np.isfinite(h.T_cam_obj.matrix).all() for h in found.hypotheses)

"""The matching MV-Net: shapes, gradients, targets, one batch over-fitted, and the search with an oracle's answer."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from objects import bracket
from posekit.data.procedural import random_object
from posekit.data.view_queries import (
    DISTANCE,
    QueryConfig,
    QueryGroup,
    QueryScene,
    Relation,
    ViewBank,
    collate_queries,
    draw_queries,
    match_targets,
    render_queries,
)
from posekit.nets.mvnet import CELL, GRID, NONE, MatchingMVNet, MVOutput, rgb_input, view_input
from posekit.nets.mvnet_loss import MVLossConfig, mvnet_loss
from posekit.render import Renderer

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
def renderer() -> Renderer:
    return Renderer()


@pytest.fixture(scope="module")
def made(renderer: Renderer) -> tuple[ViewBank, list[QueryScene], list[QueryScene]]:
    rng = np.random.default_rng(4)
    bank = ViewBank.of(bracket(), renderer, QUERIES)
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

"""The trainer: a step teaches, a checkpoint continues exactly, the export loads."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import pytest
import torch

from posekit.data.stream import PairStream, StreamConfig
from posekit.nets.lite import LiteSVNet
from posekit.nets.weights import load_networks
from posekit.train.pose import PoseTrainConfig, Trainer, measure_statistics, rate_at, train, validate

STREAM = StreamConfig(batch=2, pool=16, per_object=4)
CONFIG = PoseTrainConfig(steps=4, warmup=2, validate=2, save=2, workers=0, threads=1, stream=STREAM)


@pytest.fixture(scope="module")
def batches() -> list[dict[str, torch.Tensor]]:
    stream = iter(PairStream(STREAM, 0))
    return [next(stream) for _ in range(4)]


def test_a_checkpoint_continues_as_if_nothing_had_happened(tmp_path: Path, batches) -> None:
    torch.manual_seed(0)
    whole = Trainer(CONFIG, tmp_path)
    measure_statistics(whole.net.heads, iter(batches), count=2)
    whole.train_step(batches[0])
    whole.train_step(batches[1])
    whole.save()
    torch.manual_seed(99)
    resumed = Trainer(CONFIG, tmp_path)
    assert resumed.load() and resumed.step == 2
    for batch in batches[2:]:
        a, b = whole.train_step(batch), resumed.train_step(batch)
        assert a == b
    for p, q in zip(whole.net.parameters(), resumed.net.parameters(), strict=True):
        assert torch.equal(p, q)
    for p, q in zip(whole.average.parameters(), resumed.average.parameters(), strict=True):
        assert torch.equal(p, q)


def test_steps_teach(tmp_path: Path, batches) -> None:
    torch.manual_seed(0)
    trainer = Trainer(dataclasses.replace(CONFIG, rate=1e-3, warmup=1, steps=100), tmp_path)
    losses = [trainer.train_step(batches[0])["loss"] for _ in range(25)]
    assert losses[-1] < 0.8 * losses[0]


def test_a_loss_that_is_not_finite_stops_the_training(tmp_path: Path, batches) -> None:
    trainer = Trainer(CONFIG, tmp_path)
    trainer.save()
    with torch.no_grad():
        trainer.net.heads.translation.bias.fill_(float("nan"))
    with pytest.raises(FloatingPointError, match="intact"):
        trainer.train_step(batches[0])
    assert Trainer(CONFIG, tmp_path).load()


def test_the_export_is_what_the_estimator_loads(tmp_path: Path, batches) -> None:
    trainer = Trainer(CONFIG, tmp_path)
    trainer.train_step(batches[0])
    digest = trainer.export({"trained_on": "a test"})
    networks = load_networks("lite", tmp_path)
    assert networks.digest == digest and networks.mvnet is None and isinstance(networks.svnet, LiteSVNet)
    found = validate(networks.svnet, batches[:1], CONFIG.loss)
    assert found["epe_px"] > 0 and set(found) > {"loss", "angle", "match"}


def test_the_rate_warms_up_and_falls() -> None:
    config = dataclasses.replace(CONFIG, steps=1000, warmup=100, rate=1.0)
    rates = [rate_at(k, config) for k in range(1001)]
    assert rates[0] < 0.02 and rates[99] == pytest.approx(1.0) and rates[1000] == pytest.approx(0.02)
    assert all(a >= b for a, b in itertools.pairwise(rates))


def test_a_whole_run_leaves_weights_a_log_and_a_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("posekit.train.pose.HELD_BACK", 1)
    train(CONFIG, tmp_path / "run", None)
    assert {p.name for p in (tmp_path / "run").iterdir()} >= {"checkpoint.safetensors", "lite.safetensors", "lite.toml",
                                                             "log.csv"}  # fmt: skip
    again = Trainer(CONFIG, tmp_path / "run")
    assert again.load() and again.step == 4

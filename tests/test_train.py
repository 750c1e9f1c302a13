"""The trainer: a step teaches, a killed training ends as one that was not, two processes do as one, nothing is lost.

Configurations. Accepted: TOML of TrainConfig's shape, whatever it leaves out as the recipe has it; whole numbers for
fractions; a byte order mark. Refused: what is missing or no TOML, an unknown key (the nearest one is named) or recipe,
a value of another kind, a list of another length, numbers that are out of range, not finite or negative. There are no
warnings.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save_file
from typer.testing import CliRunner

from objects import bracket
from posekit.camera import Camera
from posekit.cli.app import app
from posekit.datasets.bop import BopDataset
from posekit.errors import ConfigError, OutputError, TrainingError, WeightsError
from posekit.geometry import Pose, random_rotation
from posekit.mesh.model import ObjectModel
from posekit.nets.config import LiteConfig
from posekit.nets.flownet import LAYERS
from posekit.nets.heads import compress_angle
from posekit.nets.lite import LiteSVNet
from posekit.nets.paper import PaperSVNet
from posekit.nets.weights import build, load_networks, save_networks
from posekit.render import Renderer
from posekit.train.calibrate import fit_median, passed_poses
from posekit.train.checkpoint import Checkpoint, Checkpoints
from posekit.train.config import (
    MachineConfig,
    OptimiserConfig,
    TrainConfig,
    changed,
    default_config,
    read_config,
    write_config,
)
from posekit.train.data.augment import AugmentConfig
from posekit.train.data.crops import SceneConfig
from posekit.train.data.stream import PairStream, StreamConfig
from posekit.train.data.view_queries import QueryConfig
from posekit.train.loop import Trainer, make_fabric, rate_at
from posekit.train.measure import CaseSource, rendered_cases
from posekit.train.paper import PaperTask
from posekit.train.pose import _calibration_cases, make_task, resume_pose, train_pose
from posekit.train.sources import Sources

SMALL = LiteConfig(widths=(16, 32), blocks=1, fine=16)
STREAM = StreamConfig(
    batch=2, shard=2, pool=16, per_object=4, mvnet=1, queries=QueryConfig(drawn=3, templates=8, kept=4, nearest=2)
)
CONFIG = TrainConfig(
    steps=4, validate=100, save=2, log=1, cases=1, calibrate=0, stream=STREAM, lite=SMALL,
    optimiser=OptimiserConfig(warmup=2), machine=MachineConfig("cpu", workers=0, threads=1, precision="32-true"),
)  # fmt: skip
NO_SOURCES = Sources([], [], [], None)


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def batches() -> list[dict[str, torch.Tensor]]:
    return list(itertools.islice(PairStream(STREAM, 0), 4))


def trainer(out: Path, config: TrainConfig = CONFIG) -> Trainer:
    torch.manual_seed(0)
    fabric = make_fabric(config)
    return Trainer(config, make_task(config, NO_SOURCES), fabric, out)


# --- the loop ---


def test_steps_teach(tmp_path: Path, batches) -> None:
    config = dataclasses.replace(CONFIG, steps=100, optimiser=OptimiserConfig(rate=2e-3, warmup=1))
    it = trainer(tmp_path, config)
    losses = [it.train_step(batches[0], 0.0)["loss"] for _ in range(30)]
    assert losses[-1] < 0.8 * losses[0]


def test_the_rate_warms_up_and_falls() -> None:
    config = OptimiserConfig(rate=1.0, warmup=100, floor=0.02)
    rates = [rate_at(k, k / 1000, config) for k in range(1001)]
    assert rates[0] < 0.02 and rates[99] == pytest.approx(1.0, abs=0.03) and rates[1000] == pytest.approx(0.02)
    assert all(a >= b for a, b in itertools.pairwise(rates[100:]))


def test_a_loss_that_is_not_finite_stops_the_training(tmp_path: Path, batches) -> None:
    it = trainer(tmp_path)
    it.save()
    with torch.no_grad():
        it.task.networks.svnet.heads.translation.bias.fill_(float("nan"))  # type: ignore[attr-defined]
    before = it.task.networks.svnet.heads.rotation.weight.clone()  # type: ignore[attr-defined]
    with pytest.raises(TrainingError, match=r"nan at step 0.*checkpoint of step 0 .* is intact.*--resume"):
        it.train_step(batches[0], 0.0)
    assert torch.equal(before, it.task.networks.svnet.heads.rotation.weight)  # type: ignore[attr-defined]
    assert Checkpoints(tmp_path / "checkpoints").load(0).step == 0


def test_a_whole_run_leaves_weights_curves_and_checkpoints(tmp_path: Path) -> None:
    out = tmp_path / "run"
    rows = train_pose(CONFIG, out)
    assert [row["step"] for row in rows] == ["0", "4"] and float(rows[-1]["start_rotation_deg"]) > 0
    assert {p.name for p in out.iterdir()} >= {"lite.safetensors", "lite.toml", "config.toml", "train.csv",
                                                "validation.csv", "checkpoints", "tensorboard"}  # fmt: skip
    assert len((out / "train.csv").read_text().splitlines()) == 5
    networks = load_networks("lite", out)
    assert isinstance(networks.svnet, LiteSVNet) and networks.mvnet is not None
    assert read_config(out / "config.toml") == CONFIG
    with pytest.raises(OutputError, match=r"holds files.*--resume"):
        train_pose(CONFIG, out)


def test_a_training_for_minutes_ends_by_the_clock(tmp_path: Path) -> None:
    config = dataclasses.replace(CONFIG, steps=10**6, minutes=1 / 60, cases=0, save=10**6)
    rows = train_pose(config, tmp_path / "run")
    assert rows[-1]["step"] != "0" and float(rows[-1]["seconds"]) < 30


class TimedModule(torch.nn.Module):
    """A line in place of a network; every part of the training takes its seconds of a clock that stands still else."""

    def __init__(self, clock: Clock, step: float) -> None:
        super().__init__()
        self.nets, self.clock, self.step = torch.nn.Linear(1, 1), clock, step

    def forward(self, batch: dict[str, torch.Tensor], seed: int) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        self.clock.now += self.step
        return self.nets(batch["x"]).square().mean(), {}


@dataclasses.dataclass
class Clock:
    now: float = 1000.0

    def monotonic(self) -> float:
        return self.now


class TimedTask:
    measured = 0

    def __init__(self, clock: Clock, step: float, validation: float, export: float) -> None:
        self.clock, self.validation, self.exporting = clock, validation, export
        self.module = TimedModule(clock, step)
        self.nets = self.module.nets
        self.exported: list[int] = []

    def stream(self, start: int, rank: int) -> Any:
        return itertools.repeat({"x": torch.ones(1, 1)})

    def prepare(self, batches: Sequence[Any]) -> None: ...

    def validate(self, nets: torch.nn.Module) -> dict[str, float]:
        self.clock.now += self.validation
        return {"score": 1.0}

    def export(self, nets: torch.nn.Module, out: Path, about: Mapping[str, Any]) -> None:
        self.clock.now += self.exporting
        self.exported.append(about["steps"])


@pytest.mark.parametrize(("validation", "after", "steps"), [(20.0, 0.0, 61), (20.0, 15.0, 46), (200.0, 0.0, 1)])
def test_minutes_include_the_last_validation_and_export(
    validation: float, after: float, steps: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two minutes, of which ten seconds went by before the loop. One step is made in any case."""
    clock = Clock()
    monkeypatch.setattr("posekit.train.loop.time", clock)
    config = dataclasses.replace(CONFIG, steps=10**6, minutes=2.0, validate=10**6, save=10**6, export_seconds=0)
    task = TimedTask(clock, 1.0, validation, 3.0)
    monkeypatch.setattr("posekit.train.loop.loader", lambda stream, *_: iter(stream))
    told: list[str] = []
    it = Trainer(config, task, make_fabric(config), tmp_path, lambda progress: told.append(progress.label))
    clock.now += 10
    rows = it.run(1000.0, lambda seconds: after)
    assert [int(row["step"]) for row in rows] == [0, steps] and task.exported == [0, steps]
    assert it.checkpoints.last() == steps
    if validation < 100:
        assert 120 - after - 6 < clock.now - 1000 <= 120 - after, "ends in time, and not much before"
    assert [label for label, _ in itertools.groupby(told)] == ["validation", "export", "", "validation", "export"]


def test_the_calibration_fits_into_the_minutes() -> None:
    config = dataclasses.replace(CONFIG, minutes=2.0, cases=24, calibrate=240)
    assert _calibration_cases(config, validation=1.6) == (240, pytest.approx(24.0)), "all, within a quarter"
    assert _calibration_cases(config, validation=4.8) == (100, pytest.approx(30.0)), "as many as a quarter allows"
    assert _calibration_cases(config, validation=48.0) == (0, 0.0), "too few to learn from"
    assert _calibration_cases(config, validation=4.8, left=60.0) == (200, pytest.approx(60.0))


# --- killed ---

SCRIPT = """
import sys
from pathlib import Path
from posekit.train.config import read_config
from posekit.train.pose import resume_pose, train_pose
out = Path(sys.argv[2])
resume_pose(out) if (out / "config.toml").exists() else train_pose(read_config(Path(sys.argv[1])), out)
"""


def start(config: TrainConfig, out: Path, *launcher: str) -> subprocess.Popen[bytes]:
    file = out.parent / f"{out.name}.toml"
    file.write_text(write_config(config))
    script = out.parent / "train.py"
    script.write_text(SCRIPT)
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        [sys.executable, *launcher, str(script), str(file), str(out)], env=environment, start_new_session=True
    )


def final(out: Path, step: int) -> dict[str, torch.Tensor]:
    return dict(Checkpoints(out / "checkpoints").load(step).tensors)


def test_a_training_killed_twice_ends_as_one_that_was_not(tmp_path: Path) -> None:
    stream = dataclasses.replace(STREAM, mvnet=0)  # the workers begin sooner
    config = dataclasses.replace(
        CONFIG, steps=14, save=1, keep=2, cases=0, machine=MachineConfig("cpu", threads=1, workers=1), stream=stream
    )
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    # a stream made in this process has one lane of data, as one worker has
    train_pose(dataclasses.replace(config, machine=MachineConfig("cpu", threads=1, workers=0)), whole)
    for step in (3, 8):
        process = start(config, killed)
        for _ in range(6000):
            if (Checkpoints(killed / "checkpoints").last() or 0) >= step:
                break
            time.sleep(0.02)
        time.sleep(0.01 * step)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        reached = Checkpoints(killed / "checkpoints").last()
        assert reached is not None and step <= reached < 14
    assert start(config, killed).wait(120) == 0
    a, b = final(whole, 14), final(killed, 14)
    assert set(a) == set(b) and all(torch.equal(a[k], b[k]) for k in a)
    assert (whole / "train.csv").read_text().count("\n") == (killed / "train.csv").read_text().count("\n") == 15


def test_resuming_needs_a_training(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no training to resume"):
        resume_pose(tmp_path)


# --- checkpoints ---


def test_the_last_ones_and_the_best_are_kept(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path / "c", keep=2)
    for step, score in enumerate([3.0, 1.0, 2.0, math.nan, math.nan]):
        checkpoints.save(Checkpoint(step, 1.5 * step, score, {"loss": 1.0}, {"w": torch.full((2, 3), float(step))}))
    assert sorted(p.name for p in (tmp_path / "c").glob("*.toml")) == [
        "00000001.toml",
        "00000003.toml",
        "00000004.toml",
    ]
    assert checkpoints.best() == 1 and checkpoints.last() == 4
    found = checkpoints.load(4)
    assert (
        found.seconds == 6.0
        and torch.equal(found.tensors["w"], torch.full((2, 3), 4.0))
        and found.means == {"loss": 1.0}
    )


def test_a_checkpoint_without_its_second_file_does_not_count(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path)
    for step in (1, 2):
        checkpoints.save(Checkpoint(step, 0.0, math.nan, {}, {"w": torch.zeros(3)}))
    (tmp_path / "00000002.toml").unlink()
    assert checkpoints.last() == 1
    (tmp_path / "00000001.safetensors").write_bytes(b"x" * 100)
    with pytest.raises(WeightsError, match="cannot be read"):
        checkpoints.load(1)


def test_a_full_disk_leaves_the_last_good_checkpoint(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path / "c")
    checkpoints.save(Checkpoint(1, 0.0, math.nan, {}, {"w": torch.zeros(100)}))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))
    try:
        with pytest.raises(OutputError, match=r"step 2 could not be written.*step 1, is intact.*--resume"):
            checkpoints.save(Checkpoint(2, 0.0, math.nan, {}, {"w": torch.zeros(10_000)}))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert checkpoints.last() == 1 and checkpoints.load(1).step == 1


# --- the predicted angle ---


def test_a_median_is_fitted_whatever_the_outliers() -> None:
    draw = torch.Generator().manual_seed(1)
    x = torch.randn(2000, 5, generator=draw) * torch.tensor([1.0, 10, 0.1, 1, 1]) + 3
    truth, bias = torch.tensor([0.5, -0.02, 2.0, 0.0, 0.3]), 1.5
    y = x @ truth + bias
    y[::10] += 50
    weight, found = fit_median(x, y)
    assert float((x @ weight + found - x @ truth - bias).abs().median()) < 0.15


def test_calibration_makes_a_sure_head_honest(tmp_path: Path) -> None:
    """A network that never turns a pose and says "no error" learns to say how large the errors are."""
    torch.manual_seed(0)
    networks = build("lite", SMALL)
    head = networks.svnet.heads.angle
    assert head is not None
    with torch.no_grad():
        head.weight.zero_()
        head.bias.zero_()
    (tmp_path / "start").mkdir()
    save_networks(tmp_path / "start" / "lite", networks, {"trained_on": "nothing"})
    arguments = ["train", "angle", "--weights", str(tmp_path / "start"), "--out", str(tmp_path / "done"),
                 "--cases", "12"]  # fmt: skip
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    fitted = load_networks("lite", tmp_path / "done")
    assert fitted.about["calibrated_on"] == 12 and fitted.about["trained_on"] == "nothing"
    cases = rendered_cases(CaseSource([], [], SceneConfig(), AugmentConfig()), Renderer(), 8, seed=5)
    passed = passed_poses(fitted, cases, Renderer(), iterations=2)
    assert passed.angle.shape == (16,) and passed.last.sum() == 8
    found = fitted.svnet.heads.angle
    assert found is not None
    with torch.no_grad():
        said = found(torch.from_numpy(passed.features))[:, 0]
        before = head(torch.from_numpy(passed.features))[:, 0]
    truth = compress_angle(torch.from_numpy(passed.angle))
    assert (said - truth).abs().mean() < 0.6 * (before - truth).abs().mean()
    moved = {
        k
        for k, v in fitted.svnet.state_dict().items()
        if not torch.equal(v, networks.svnet.state_dict()[k].half().float())
    }
    assert {k for k in moved if "num_batches" not in k} == {"heads.angle.weight", "heads.angle.bias"}
    again = CliRunner().invoke(app, arguments)
    assert again.exit_code == 1 and "holds files" in again.output


# --- the paper's recipe ---

PAPER = changed(
    default_config("paper"),
    {"epochs": 0, "steps": 60, "validate": 1000, "save": 1000, "cases": 0, "calibrate": 0, "overfit": True,
     "paper": {"size": [64, 48], "width": 0.25}, "optimiser": {"kind": "adamw", "rate": 0.0005},
     "stream": {"batch": 2, "shard": 2, "pool": 4, "per_object": 2},
     "machine": {"accelerator": "cpu", "workers": 0, "threads": 1}},
    "the test",
)  # fmt: skip


def paper_trainer(out: Path, config: TrainConfig = PAPER) -> Trainer:
    torch.manual_seed(0)
    fabric = make_fabric(config)
    return Trainer(config, make_task(config, Sources([bracket()], [], [], None)), fabric, out)


def test_the_papers_recipe_overfits_a_batch(tmp_path: Path) -> None:
    it = paper_trainer(tmp_path, changed(PAPER, {"stream": {"batch": 4, "pool": 8}}, "here"))
    batches = it._batches(0)
    it.task.prepare([next(batches) for _ in range(it.task.measured)])
    batch = next(it._batches(0))
    values = [it.train_step(batch, 0.0) for _ in range(80)]
    assert values[-1]["mv_loss"] < 0.7 * values[0]["mv_loss"]
    assert min(v["sv_loss_1"] for v in values[-10:]) < 0.7 * values[0]["sv_loss_1"]
    it.task.export(it.average.module, tmp_path, {})
    networks = load_networks("paper", tmp_path)
    assert networks.mvnet is not None and networks.size == (64, 48)


def test_photographs_feed_the_papers_recipe(tmp_path: Path) -> None:
    """A tiny data set in BOP layout, rendered on the spot; forward, backward and three inner iterations on it."""
    folder = bop_folder(tmp_path / "set")
    sources = Sources([], [], [(BopDataset(folder, "train", None), 1.0)], None)
    config = changed(PAPER, {"sources": {"renders": 0.0}, "epochs": 2, "steps": 1}, "here")
    torch.manual_seed(0)
    task = make_task(config, sources)
    assert isinstance(task, PaperTask) and task.catalogue.epoch == 4
    it = Trainer(config, task, make_fabric(config), tmp_path / "run")
    values = it.train_step(next(it._batches(0)), 0.0)
    assert math.isfinite(values["loss"]) and "sv_loss_3" in values


def test_the_papers_recipe_trains_at_full_size(tmp_path: Path) -> None:
    """640x480 and full width on photographs: forward, backward, three inner iterations, and every weight moves."""
    sources = Sources([], [], [(BopDataset(bop_folder(tmp_path / "set", 2), "train", None), 1.0)], None)
    asked = {"epochs": 1, "cases": 0, "sources": {"renders": 0.0}, "machine": {"accelerator": "cpu", "workers": 0},
             "stream": {"batch": 1, "shard": 1, "pool": 2, "reuse": 1}}  # fmt: skip
    config = changed(default_config("paper"), asked, "here")
    task = make_task(config, sources)
    assert task.networks.size == (640, 480)
    svnet = task.networks.svnet
    assert isinstance(svnet, PaperSVNet) and svnet.branch.encoder.out_channels == 1024
    before = {name: value.clone() for name, value in task.nets.named_parameters()}
    it = Trainer(config, task, make_fabric(config), tmp_path / "run")
    values = it.train_step(next(it._batches(0)), 0.0)
    assert math.isfinite(values["loss"]) and all(f"sv_loss_{k}" in values for k in (1, 2, 3))
    still = [name for name, value in task.nets.named_parameters() if torch.equal(value, before[name])]
    assert not still


def bop_folder(root: Path, count: int = 4) -> Path:
    """``count`` photographs of the bracket in train/000001."""
    model, camera = bracket(), Camera.from_fov(0.6, 320, 240)
    scene = root / "train" / "000001"
    for folder in (scene / "rgb", scene / "mask_visib", root / "models"):
        folder.mkdir(parents=True)
    vertices = "\n".join(" ".join(f"{x:.4f}" for x in v) for v in model.vertices * 1000)
    faces = "\n".join(f"3 {a} {b} {c}" for a, b, c in model.faces)
    (root / "models" / "obj_000001.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex {len(model.vertices)}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {len(model.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        f"{vertices}\n{faces}\n"
    )
    rng = np.random.default_rng(0)
    poses, boxes = [Pose(random_rotation(rng), np.array([0.0, 0.0, 0.5])) for _ in range(count)], {}
    for k, view in enumerate(Renderer().render(model, poses, camera)):
        assert view.mask is not None
        x, y, w, h = cv2.boundingRect(view.mask.astype(np.uint8))
        boxes[str(k)] = [{"bbox_obj": [x, y, w, h], "bbox_visib": [x, y, w, h], "visib_fract": 1.0}]
        cv2.imwrite(str(scene / "rgb" / f"{k:06d}.png"), view.image[..., ::-1])
        cv2.imwrite(str(scene / "mask_visib" / f"{k:06d}_000000.png"), view.mask.astype(np.uint8) * 255)
    truths = {str(k): [{"obj_id": 1, "cam_R_m2c": p.R.ravel().tolist(), "cam_t_m2c": (p.t * 1000).tolist()}]
              for k, p in enumerate(poses)}  # fmt: skip
    (scene / "scene_gt.json").write_text(json.dumps(truths))
    (scene / "scene_gt_info.json").write_text(json.dumps(boxes))
    (scene / "scene_camera.json").write_text(json.dumps({k: {"cam_K": camera.K.ravel().tolist()} for k in truths}))
    return root


def test_the_papers_recipe_takes_an_encoder_a_validation_set_and_a_profile(tmp_path: Path) -> None:
    """The command with all that the recipe can be fed with, at a size for tests."""
    folder = bop_folder(tmp_path / "set")
    (folder / "test").symlink_to(folder / "train")
    width = {"conv1": 16, "conv2": 32, "conv3": 64, "conv4": 128, "conv5": 128, "conv6": 256}
    state, last = {}, 6
    for name, kernel, _, _ in LAYERS:
        out = width[name[:5]]
        state[f"{name}.0.weight"] = torch.full((out, last, kernel, kernel), 0.01)
        state[f"{name}.0.bias"] = torch.full((out,), 0.25)
        last = out
    save_file(state, tmp_path / "flownets.safetensors")
    file, out = tmp_path / "a.toml", tmp_path / "mine"
    config = changed(PAPER, {"overfit": False, "cases": 2, "optimiser": {"rate": 1e-9}}, "here")
    file.write_text(write_config(config))
    described = folder / "train" / "000001" / "scene_gt_info.json"
    kept = described.read_text()
    described.unlink()
    arguments = ["train", "pose", "--recipe", "paper", "--config", str(file), "--steps", "13", "--profile",
                 "--bop", f"{folder}:train=1", "--flownets", str(tmp_path / "flownets.safetensors"),
                 "--validate-on", str(folder), "--out", str(out)]  # fmt: skip
    refused = CliRunner().invoke(app, arguments)
    assert refused.exit_code == 1 and "shows nothing to measure on" in refused.output
    described.write_text(kept)
    result = CliRunner().invoke(app, [*arguments, "--force"])
    assert result.exit_code == 0, result.output
    svnet = load_networks("paper", out).svnet
    assert isinstance(svnet, PaperSVNet)
    encoder = svnet.branch.encoder.state_dict()
    biases = [v for k, v in encoder.items() if k.endswith("bias")]
    assert biases and all(torch.allclose(b, torch.tensor(0.25), atol=1e-3) for b in biases)
    assert "convolution" in (out / "profile.txt").read_text()
    header = (out / "validation.csv").read_text().splitlines()[0]
    assert "bop_within_5" in header and "first_within_25deg" in header


# --- several processes ---


def test_the_command_starts_the_processes_that_it_is_asked_for(tmp_path: Path) -> None:
    file, out = tmp_path / "a.toml", tmp_path / "two"
    file.write_text(write_config(CONFIG))
    command = [
        sys.executable,
        "-m",
        "posekit",
        "train",
        "pose",
        "--config",
        str(file),
        "--devices",
        "2",
        "--out",
        str(out),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("weights:") == 1, "one process reports"
    assert load_networks("lite", out).mvnet is not None


def test_two_processes_train_as_one_with_twice_the_batch(tmp_path: Path) -> None:
    """The paper's networks have no batch statistics: the same data give the same losses."""
    config = changed(
        PAPER,
        {"overfit": False, "steps": 4, "save": 4, "optimiser": {"kind": "sgd"}, "stream": {"batch": 4, "pool": 8}},
        "here",
    )
    two = changed(config, {"stream": {"batch": 2, "pool": 4}, "machine": {"devices": 2}}, "here")
    out = tmp_path / "two"
    process = start(two, out)
    train_pose(config, tmp_path / "one")
    assert process.wait(200) == 0
    for name in ("branch.fc.weight", "heads.rotation.weight", "fc.weight"):
        key = f"net.svnet.{name}"
        a, b = final(tmp_path / "one", 4)[key], final(out, 4)[key]
        assert torch.allclose(a, b, atol=2e-4), (key, (a - b).abs().max())


# --- configuration ---


def test_a_configuration_is_what_its_file_says(tmp_path: Path) -> None:
    file = tmp_path / "a.toml"
    file.write_text('recipe = "paper"\nsteps = 7\n[optimiser]\nrate = 1\n[paper]\nsize = [128, 96]\nwidth = 0.1\n')
    config = read_config(file)
    assert config.recipe == "paper" and config.optimiser.kind == "sgd" and config.optimiser.rate == 1.0
    assert config.paper.size == (128, 96) and config.steps == 7
    file.write_text(write_config(config))
    assert read_config(file) == config


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stps = 3", "unknown key 'stps'; did you mean 'steps'"),
        ("[stream]\nbtch = 3", r"\[stream\]: unknown key 'btch'; did you mean 'batch'"),
        ("[stream.augment]\nno_mask = 'x'", "no_mask is a float, not 'x'"),
        ("steps = true", "steps is a int, not True"),
        ("stream = 3", "stream is a table"),
        ("recipe = 'papr'", "recipe is one of lite, paper, not 'papr'"),
        ("[lite]\nsize = [1]", "size is a list of 2"),
        ("steps = 0", "at least 1"),
        ("[optimiser]\nrate = -1.0", "positive"),
        ("[stream]\nshard = 8\nmvnet = 3", "multiple of the batch's 4 shards"),
        ("a = [", "no readable TOML"),
        ("[optimiser]\nrate = nan", "optimiser.rate is nan: numbers are finite"),
        ("[stream.pairs]\ndistance = [3.0, inf]", "stream.pairs.distance is .*: numbers are finite"),
        ("[stream.augment]\nclutter = -1", "stream.augment.clutter is -1: numbers are finite and not negative"),
        ("seed = -1", "seed is -1"),
        ("[lite]\nblocks = 1000000000", "lite: its numbers are from 1 to 4096, blocks at most 64"),
        ("[lite]\nsize = [100, 96]", "multiples of 8 pixels"),
        ("[lite]\nheads = 5", "heads 5 divide"),
        ("[paper]\nwidth = 0", "width is above 0"),
        ("[paper]\nviews = 0", "views are whole numbers from 1"),
    ],
)
def test_a_wrong_configuration_is_refused(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "a.toml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_config(file)


def test_a_configuration_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_bytes(b"\xef\xbb\xbfsteps = 7\r\n")
    assert read_config(tmp_path / "a.toml").steps == 7


ODD = st.one_of(
    st.integers(), st.floats(), st.booleans(), st.text(max_size=8), st.lists(st.integers(-3, 300), max_size=3),
    st.lists(st.floats(), min_size=2, max_size=2), st.dictionaries(st.text(max_size=5), st.integers(), max_size=2),
)  # fmt: skip


def places(table: Mapping[str, Any], way: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    for key, value in table.items():
        yield (*way, key)
        if isinstance(value, Mapping):
            yield from places(value, (*way, key))


@settings(max_examples=80, deadline=None)
@given(st.data())
def test_any_value_in_a_configuration_is_taken_or_refused(data: st.DataObject) -> None:
    """What is taken is written and read as it is."""
    values = tomllib.loads(write_config(default_config(data.draw(st.sampled_from(("lite", "paper"))))))
    for *way, last in data.draw(st.lists(st.sampled_from(list(places(values))), max_size=3, unique=True)):
        table: Any = values
        for key in way:
            table = table.get(key, {}) if isinstance(table, dict) else {}
        if isinstance(table, dict):
            table[data.draw(st.just(last) | st.text(max_size=5))] = data.draw(ODD)
    try:
        config = changed(default_config("lite"), values, "here")
    except ConfigError:
        return
    assert changed(default_config("lite"), tomllib.loads(write_config(config)), "here") == config


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=60), st.integers(0, 10**4), st.integers(0, 60))
def test_any_bytes_in_a_configuration_are_taken_or_refused(new: bytes, start: int, length: int) -> None:
    text = write_config(default_config("lite")).encode()
    start %= len(text)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "a.toml").write_bytes(text[:start] + new + text[start + length :])
        with suppress(ConfigError):
            read_config(Path(folder) / "a.toml")


def test_options_override_a_configuration() -> None:
    config = changed(default_config("lite"), {"stream": {"batch": 16}, "minutes": 3}, "here")
    assert config.stream.batch == 16 and config.minutes == 3.0 and config.stream.mvnet == 8


# --- the command line ---


@pytest.mark.parametrize(("asked", "mvnet"), [([], 0), (["--mvnet", "4"], 4)])
def test_given_meshes_start_from_the_shipped_weights(
    asked: list[str], mvnet: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen: list[TrainConfig] = []
    monkeypatch.setattr("posekit.train.pose.train_pose", lambda config, *_: chosen.append(config) or [])
    arguments = ["train", "pose", "--model", "mine.ply", "--minutes", "30", "--out", str(tmp_path / "mine"), *asked]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    (config,) = chosen
    assert config.sources.init == "shipped" and config.minutes == 30 and config.epochs == 0
    assert config.stream.mvnet == mvnet and config.optimiser.rate < TrainConfig().optimiser.rate


def test_the_command_trains_for_a_mesh_and_reports(tmp_path: Path) -> None:
    mesh = bop_folder(tmp_path / "set") / "models" / "obj_000001.ply"
    file = tmp_path / "a.toml"
    file.write_text(write_config(dataclasses.replace(CONFIG, steps=1)))
    out = tmp_path / "mine"
    arguments = ["train", "pose", "--config", str(file), "--model", str(mesh), "--units", "mm", "--out", str(out)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "held-back renderings: rotation" in result.output and "MV-Net's first poses" in result.output
    about = load_networks("lite", out).about
    assert about["trained_on"] == "renderings of obj_000001"
    assert about["seen"] == [ObjectModel.load(mesh, units="mm").digest]
    on = Sources([bracket()] * 5, [], [], None, (("parts", 4),)).about(0.4)
    assert on == f"renderings of {bracket().name}, 4 meshes of parts; procedural shapes (60%)"
    again = CliRunner().invoke(app, ["train", "pose", "--out", str(out)])
    assert again.exit_code == 1 and "--resume" in again.output
    wrong = CliRunner().invoke(app, ["train", "pose", "--bop", str(tmp_path), "--out", str(tmp_path / "other")])
    assert wrong.exit_code == 1

"""The network through OpenVINO answers as through PyTorch."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import weakref
from pathlib import Path

import numpy as np
import pytest
import torch

from objects import CAMERA, bracket
from posekit.errors import ConfigError
from posekit.estimate.refine import compare, update_pose
from posekit.geometry import Pose, so3_exp, view_rotation
from posekit.nets.openvino import OpenVinoPredictor
from posekit.nets.predictor import Predictor
from posekit.nets.pytorch import NetworkPredictor
from posekit.nets.rigid import solved
from posekit.nets.runtime import Runtime
from posekit.nets.weights import build, load_networks
from posekit.render import Renderer
from posekit.view import View


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's cache with the converted networks."""
    cache = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(cache))
        runtime = Runtime(runtime="openvino")
        _ = runtime.predictor, runtime.features
    return cache


def test_both_runtimes_give_the_same_features(kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(kept))
    [folder] = (kept / "posekit" / "openvino").glob("lite0-*")
    assert sorted(p.name for p in folder.iterdir()) == ["features.bin", "features.xml"]
    pair = np.random.default_rng(0).random((2, 3, 96, 128), np.float32)
    answers = [Runtime(runtime=runtime).features(pair) for runtime in ("openvino", "torch")]
    assert answers[0].shape == (2, 40, 12, 16)
    np.testing.assert_allclose(answers[0], answers[1], atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(answers[0], axis=1), 1.0, rtol=1e-5)


def test_both_runtimes_answer_alike_and_the_conversion_is_kept(kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(kept))
    networks, model, renderer = load_networks("lite"), bracket(), Renderer()
    truth = Pose(view_rotation([0.5, -1.0, 0.6]), [0.05, 0.0, 0.7]) @ model.T_ctr_obj
    start = Pose(so3_exp([0.05, 0.02, -0.04]) @ truth.R, truth.t + [0.004, 0.0, 0.01])
    [drawn] = renderer.render(model, [truth], CAMERA)
    view, outline = View(drawn.image, CAMERA, drawn.mask), model.hull_ctr
    results = []
    runtimes: list[Predictor] = [NetworkPredictor(networks, bfloat16=False)]
    for bfloat16 in (False, True):
        runtimes.append(
            OpenVinoPredictor(lambda: networks.svnet, networks.digest, networks.size, bfloat16=bfloat16, threads=1)
        )
    for predictor in runtimes:
        [answer], [seen], [rendered] = compare(view, model, outline, [start], predictor, renderer)
        results.append((answer, update_pose(start, model, answer, seen, rendered, "correspondence")))
    (torch_answer, torch_pose), *others = results
    for (answer, pose), pixels, angle in zip(others, (2e-3, 0.6), (1e-4, 0.02), strict=True):
        assert torch_answer.correspondences is not None and answer.correspondences is not None
        assert torch_pose is not None and pose is not None
        np.testing.assert_array_equal(answer.correspondences.source, torch_answer.correspondences.source)
        away = np.abs(answer.correspondences.target - torch_answer.correspondences.target)
        assert np.median(away) < pixels / 4 and np.quantile(away, 0.9) < pixels
        assert answer.angle == pytest.approx(torch_answer.angle, abs=angle)
        np.testing.assert_allclose(pose.R, torch_pose.R, atol=angle)
    [folder] = (kept / "posekit" / "openvino").glob(f"{networks.digest}-*")
    assert sorted(p.name for p in folder.iterdir()) == ["svnet.bin", "svnet.xml"]


def test_elimination_solves_as_the_library_does() -> None:
    rng = torch.Generator().manual_seed(0)
    J, g = torch.randn(5, 20, 6, generator=rng), torch.randn(5, 6, generator=rng)
    A = J.transpose(1, 2) @ J
    traced = torch.jit.trace(solved, (A, g), check_trace=False)  # type: ignore[no-untyped-call]
    torch.testing.assert_close(traced(A, g), solved(A, g), rtol=1e-4, atol=1e-5)
    assert "linalg_solve" not in str(traced.graph)


def test_the_paper_preset_is_refused() -> None:
    with pytest.raises(ConfigError, match="preset lite"):
        Runtime(networks=build("paper"), runtime="openvino")


def test_networks_of_a_training_run_in_torch() -> None:
    assert Runtime(networks=build("lite")).runtime == "torch"
    with pytest.raises(ConfigError, match="auto, openvino, torch"):
        Runtime(runtime="onnx")


def test_a_missing_openvino_is_said(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setitem(sys.modules, "openvino", None)
    assert Runtime().runtime == "torch"
    assert "OpenVINO cannot be used" in caplog.text


def test_the_command_imports_no_more_than_it_needs(kept: Path, example_folder: Path, tmp_path: Path) -> None:
    """Where the converted network is kept, a pose from a box is found without PyTorch, and at a mesh's later uses
    without what reads and measures meshes: these take long to import. Two processes, since that is what it is about."""
    code = (
        "import sys; from posekit.cli.app import app; app(sys.argv[1:], standalone_mode=False)\n"
        "print([m for m in ('torch', 'trimesh', 'networkx', 'scipy', 'av') if m in sys.modules])"
    )
    arguments = ["estimate", example_folder / "photo.png", "--model", example_folder / "toy.ply", "--symmetry", "none",
                 "--camera", "610,610,322,236", "--box", "251,139,456,294", "--out", tmp_path, "--force"]  # fmt: skip
    seen, poses = [], []
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False,
                              env={**os.environ, "XDG_CACHE_HOME": str(kept)})  # fmt: skip
        assert done.returncode == 0, done.stderr
        seen.append(done.stdout.splitlines()[-1])
        poses.append(json.loads((tmp_path / "result.json").read_text())["estimates"][0]["T_cam_obj"])
    assert "torch" not in seen[0]
    assert seen[1] == "[]"
    assert poses[0] == poses[1]


def test_a_conversion_reports_nothing_to_others(tmp_path: Path) -> None:
    """OpenVINO's telemetry leaves files in the home folder. It starts with the import: in a new process, some 5 s."""
    code = (
        "import os; from posekit.nets.config import LiteConfig; from posekit.nets.openvino import OpenVinoPredictor\n"
        "from posekit.nets.weights import build\n"
        "small = LiteConfig(size=(64, 48), widths=(16, 32), blocks=2, bottleneck=16, fine=16)\n"
        "OpenVinoPredictor(lambda: build('lite', small).svnet.eval(), 'untrained', small.size, threads=1)\n"
        "print(os.environ['CI'])"
    )
    env = {**os.environ, "HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache"), "CI": "false"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "false\n", "the environment is as before"
    assert not [p.name for p in tmp_path.iterdir() if p.name != "cache"]


def test_a_predictor_is_freed(kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(kept))
    predictor = Runtime(runtime="openvino").predictor
    left = weakref.ref(predictor)
    del predictor
    gc.collect()
    assert left() is None

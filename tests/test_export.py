"""posekit export: files that answer as PyTorch does."""

from __future__ import annotations

import builtins
from pathlib import Path
from typing import Any

import numpy as np
import openvino
import pytest
import torch
from typer.testing import CliRunner

from posekit.cli.app import app
from posekit.errors import OutputError
from posekit.nets import export
from posekit.nets.weights import load_networks


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """OpenVINO's files, once (converting and compiling take seconds), and what the command said."""
    folder = tmp_path_factory.mktemp("export") / "new"
    done = CliRunner().invoke(app, ["export", "--out", str(folder)])
    assert done.exit_code == 0, done.output
    return folder, done.stdout


def test_openvinos_file_has_named_places_and_any_number_of_pairs(exported: tuple[Path, str]) -> None:
    folder, said = exported
    assert sorted(each.name for each in folder.iterdir()) == ["svnet.bin", "svnet.xml"]
    assert "largest difference from PyTorch: " in said
    model = openvino.Core().read_model(folder / "svnet.xml")
    assert [place.any_name for place in model.inputs] == list(export.INPUTS)
    assert [place.any_name for place in model.outputs] == list(export.OUTPUTS)
    assert all(place.partial_shape[0].is_dynamic for place in (*model.inputs, *model.outputs))


def test_a_folder_that_holds_files_is_refused(exported: tuple[Path, str]) -> None:
    done = CliRunner().invoke(app, ["export", "--out", str(exported[0])])
    assert done.exit_code == 1
    assert "--force" in done.stderr


def test_other_answers_write_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    networks = load_networks("lite")

    def wrong(file: Path, batches: list[list[Any]]) -> list[list[Any]]:
        module = export._Answers(networks.svnet).eval()  # type: ignore[arg-type]
        with torch.inference_mode():
            out = [[x.numpy() for x in module(*map(torch.from_numpy, each))] for each in batches]
        out[1][2] = out[1][2] + np.float32(0.1)
        return out

    monkeypatch.setattr(export, "_write_openvino", lambda module, inputs, folder: folder / "svnet.xml")
    monkeypatch.setattr(export, "_run_openvino", wrong)
    with pytest.raises(OutputError, match=r"angle differs from PyTorch's by .*nothing was written"):
        export.export_svnet(networks, tmp_path / "out", "openvino")
    assert not (tmp_path / "out").exists()


def test_without_onnx_the_message_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def missing(name: str, *rest: Any, **more: Any) -> Any:
        if name == "onnx":
            raise ModuleNotFoundError("No module named 'onnx'")
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", missing)
    done = CliRunner().invoke(app, ["export", "--format", "onnx", "--out", str(tmp_path / "out")])
    assert done.exit_code == 1
    assert "pip install 'posekit[export]'" in done.stderr.replace("\n", " ")


def test_onnxs_file_answers_alike(tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    onnxruntime = pytest.importorskip("onnxruntime")
    done = export.export_svnet(load_networks("lite"), tmp_path, "onnx")
    session = onnxruntime.InferenceSession(str(done.file), providers=["CPUExecutionProvider"])
    assert [place.name for place in session.get_inputs()] == list(export.INPUTS)
    assert [place.name for place in session.get_outputs()] == list(export.OUTPUTS)
    assert all(place.shape[0] == "pairs" for place in session.get_inputs())

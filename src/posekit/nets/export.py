"""SV-Net of the lite preset as a file for other programs, compared with PyTorch's answers."""

from __future__ import annotations

import shutil
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from posekit.errors import ConfigError, OutputError
from posekit.io.files import check_writable
from posekit.nets.lite import LiteSVNet
from posekit.nets.pytorch import answers
from posekit.nets.weights import Networks

FORMATS = ("onnx", "openvino")
INPUTS = ("observed", "rendered", "relief", "focal")
OUTPUTS = ("quat_wxyz", "v", "angle", "flow", "log_scale", "visibility", "certainty", "silhouettes", "score")
BOUND = 3e-3  # the largest difference, of the larger of 1 and the largest value of an output
BATCHES = (1, 3)  # that are compared
_OPSET = 18
_TRACED = 2  # pairs of the batch that is traced: of one, some operations would be left out


@dataclass(frozen=True)
class Exported:
    """What was written. file: for OpenVINO the .xml, with a .bin beside it. differences: of each output, the largest
    one from PyTorch's, relative to the larger of 1 and the largest value of that output."""

    file: Path
    differences: dict[str, float]


def export_svnet(networks: Networks, folder: Path, format: str) -> Exported:
    """Write SV-Net to ``folder`` as svnet.onnx, or as svnet.xml and svnet.bin, for any number of pairs; float32.

    Inputs and outputs are named `INPUTS` and `OUTPUTS`. Nothing is written where an answer differs from PyTorch's by
    more than `BOUND`. Raises ConfigError for other networks, another format, or where a library is missing;
    OutputError where the folder cannot be written or the answers differ.
    """
    svnet = networks.svnet
    if not isinstance(svnet, LiteSVNet):
        raise ConfigError("only the networks of preset lite can be exported: give weights of that preset.")
    if format not in FORMATS:
        raise ConfigError(f"the format is one of {', '.join(FORMATS)}, not {format!r}.")
    write, run = (_write_onnx, _run_onnx) if format == "onnx" else (_write_openvino, _run_openvino)
    if format == "onnx":
        _need_onnx()
    check_writable(folder, f"the network cannot be written to {folder}")
    module = _Answers(svnet).eval()
    with tempfile.TemporaryDirectory() as made:
        file = write(module, example(svnet, _TRACED, 0), Path(made))
        differences = _differences(module, file, svnet, run)
        worst = max(differences, key=lambda name: differences[name])
        if not differences[worst] <= BOUND:
            raise OutputError(
                f"the exported network's {worst} differs from PyTorch's by {differences[worst]:.1e}, more than "
                f"{BOUND:g}: nothing was written. Try the other format, and report this with posekit doctor's output."
            )
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for each in sorted(Path(made).iterdir()):
                shutil.copyfile(each, folder / each.name)
        except OSError as error:
            raise OutputError(f"the network cannot be written to {folder}: {error.strerror}.") from error
    return Exported(folder / file.name, differences)


def example(svnet: LiteSVNet, pairs: int, seed: int) -> tuple[Tensor, ...]:
    """Made inputs in `INPUTS`' order: smooth noise as pictures, and a rendered object of relief that fills half."""
    width, height = svnet.config.size
    numbers = torch.Generator().manual_seed(seed)

    def smooth(channels: int) -> Tensor:
        coarse = torch.rand(pairs, channels, height // 8, width // 8, generator=numbers) - 0.5
        return nn.functional.interpolate(coarse, (height, width), mode="bilinear", align_corners=False)

    mask = torch.zeros(pairs, 1, height, width)
    mask[:, :, height // 4 : -height // 4, width // 4 : -width // 4] = 1.0
    rendered = torch.cat([smooth(3) * mask - 0.5 * (1 - mask), mask], dim=1)
    return smooth(3), rendered, (0.3 * smooth(1) * mask)[:, 0], torch.full((pairs,), 3.0)


class _Answers(nn.Module):
    """The network with its answers as a tuple in `OUTPUTS`' order."""

    def __init__(self, svnet: LiteSVNet) -> None:
        super().__init__()
        self.svnet = svnet

    def forward(self, observed: Tensor, rendered: Tensor, relief: Tensor, focal: Tensor) -> tuple[Tensor, ...]:
        return answers(self.svnet(observed, rendered, relief, focal))  # type: ignore[return-value]


def _differences(module: nn.Module, file: Path, svnet: LiteSVNet, run: Any) -> dict[str, float]:
    out = dict.fromkeys(OUTPUTS, 0.0)
    inputs = [example(svnet, pairs, seed) for seed, pairs in enumerate(BATCHES, start=1)]
    for given, theirs in zip(inputs, run(file, [[x.numpy() for x in each] for each in inputs]), strict=True):
        with torch.inference_mode():
            ours = module(*given)
        for name, one, other in zip(OUTPUTS, ours, theirs, strict=True):
            expected = one.numpy()
            if other.shape != expected.shape:
                out[name] = float("inf")
                continue
            difference = float(np.abs(other - expected).max()) / max(1.0, float(np.abs(expected).max()))
            out[name] = max(out[name], difference) if np.isfinite(difference) else float("inf")
    return out


def _write_openvino(module: nn.Module, inputs: tuple[Tensor, ...], folder: Path) -> Path:
    import openvino

    with torch.inference_mode(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of sizes that become constants: a crop's size is one
        traced = torch.jit.trace(module, inputs, check_trace=False)
    model = openvino.convert_model(traced, example_input=inputs, input=[[-1, *x.shape[1:]] for x in inputs])
    for places, names in ((model.inputs, INPUTS), (model.outputs, OUTPUTS)):
        for place, name in zip(places, names, strict=True):
            place.get_tensor().set_names({name})
    openvino.save_model(model, folder / "svnet.xml", compress_to_fp16=False)
    return folder / "svnet.xml"


def _run_openvino(file: Path, batches: list[list[NDArray[Any]]]) -> list[list[NDArray[Any]]]:
    import openvino

    compiled = openvino.Core().compile_model(file, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    out = []
    for inputs in batches:
        found = compiled(dict(zip(INPUTS, inputs, strict=True)))
        out.append([np.array(found[name]) for name in OUTPUTS])
    return out


def _need_onnx() -> None:
    try:
        import onnx  # noqa: F401
        import onnxruntime  # noqa: F401
    except ImportError as error:
        raise ConfigError(
            f"ONNX needs the packages onnx and onnxruntime ({error}): pip install 'posekit[export]', or choose "
            "--format openvino, which needs no more than posekit does."
        ) from error


def _write_onnx(module: nn.Module, inputs: tuple[Tensor, ...], folder: Path) -> Path:
    """By tracing; PyTorch's newer way takes several times as long on the loops that solve for a motion."""

    def expm1(graph: Any, x: Any) -> Any:  # which ONNX does not have
        kind = torch.float64 if x.type().scalarType() == "Double" else torch.float32
        return graph.op("Sub", graph.op("Exp", x), graph.op("Constant", value_t=torch.tensor(1.0, dtype=kind)))

    torch.onnx.register_custom_op_symbolic("aten::expm1", expm1, _OPSET)  # type: ignore[attr-defined]
    file = folder / "svnet.onnx"
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            module,
            inputs,
            file,
            dynamo=False,
            opset_version=_OPSET,
            input_names=list(INPUTS),
            output_names=list(OUTPUTS),
            dynamic_axes={name: {0: "pairs"} for name in (*INPUTS, *OUTPUTS)},
        )
    return file


def _run_onnx(file: Path, batches: list[list[NDArray[Any]]]) -> list[list[NDArray[Any]]]:
    import onnxruntime

    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    return [session.run(list(OUTPUTS), dict(zip(INPUTS, inputs, strict=True))) for inputs in batches]

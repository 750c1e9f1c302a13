"""Networks through OpenVINO: the same answers as PyTorch's, faster on a CPU. SV-Net of the lite preset, and ImageNet's
features.

The converted network is kept in the user's cache (XDG_CACHE_HOME), by the weights' digest: converting takes seconds and
PyTorch, running what was converted does not.
"""

from __future__ import annotations

import shutil
import tempfile
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from posekit._version import __version__
from posekit.io.cache_folder import make_room
from posekit.io.files import user_cache
from posekit.nets.inputs import relief, to_input
from posekit.nets.precision import usable_cores
from posekit.nets.predictor import PairPrediction, unpack
from posekit.nets.telemetry import without_telemetry
from posekit.view import View

with without_telemetry():
    import openvino

if TYPE_CHECKING:
    from torch import Tensor, nn

    from posekit.nets.lite import LiteSVNet

KEPT_NETWORKS = 3  # converted ones: of other weights, or other versions
KEPT_BLOBS = 8  # compiled ones: for other numbers of threads and streams too


class OpenVinoPredictor:
    """SV-Net through OpenVINO, on the processor.

    svnet: gives PyTorch's network, where it has to be converted; digest: of its weights, by which the converted one is
    kept ("untrained": it is not kept). size: (width, height) of its crops. bfloat16: whether to compute in it. threads:
    of the processor, None = all of this process. streams: pairs that are compared at the same time.
    Not thread-safe.
    """

    dense = True

    def __init__(
        self,
        svnet: Callable[[], LiteSVNet],
        digest: str,
        size: tuple[int, int],
        *,
        bfloat16: bool = False,
        threads: int | None = None,
        streams: int = 1,
    ) -> None:
        self.size, self.bfloat16 = size, bfloat16
        options: dict[str, Any] = {
            "INFERENCE_PRECISION_HINT": "bf16" if bfloat16 else "f32",
            "INFERENCE_NUM_THREADS": threads or usable_cores(),
            "NUM_STREAMS": str(streams),
        }
        if digest != "untrained":  # what is compiled for this processor is kept, too
            options["CACHE_DIR"] = str(user_cache("openvino/compiled"))
        model = _converted(lambda: _convert(svnet()), digest, "svnet.xml")
        compiled = openvino.Core().compile_model(model, "CPU", options)
        make_room(user_cache("openvino/compiled").glob("*.blob"), KEPT_BLOBS)
        self._queue = openvino.AsyncInferQueue(compiled, streams)
        answers: dict[int, list[Any]] = {}

        def done(request: Any, k: int) -> None:  # no method: the queue would hold this object, and never be freed
            answers[k] = [np.array(output.data) for output in request.output_tensors]

        self._queue.set_callback(done)
        self._answers = answers

    def predict(self, observed: Sequence[View], rendered: Sequence[View]) -> list[PairPrediction]:
        """As `Predictor.predict`."""
        for k, (o, r) in enumerate(zip(observed, rendered, strict=True)):
            focal = np.array([r.camera.fx / r.camera.width], np.float32)
            first, second = to_input(o.image, None)[None, :3], to_input(r.image, r.mask)[None]
            self._queue.start_async([first, second, relief(r)[None], focal], k)
        self._queue.wait_all()
        return [unpack(self._answers.pop(k), 0, drawn) for k, drawn in enumerate(rendered)]


def has_bfloat16() -> bool:
    """Whether OpenVINO computes in bfloat16 on this processor: with AVX-512's or AMX's instructions for it."""
    return "BF16" in openvino.Core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")


class OpenVinoFeatures:
    """ImageNet's early features of pairs of pictures (`posekit.nets.lite0.EarlyFeatures`), on the processor.

    size: (width, height) of the pictures. network: gives PyTorch's, where it has to be converted. threads: as
    `OpenVinoPredictor` has them. Not thread-safe.
    """

    def __init__(self, network: Callable[[], nn.Module], size: tuple[int, int], threads: int | None = None) -> None:
        def convert() -> Any:
            import torch

            return _traced(network(), (torch.zeros(2, 3, size[1], size[0]),))

        options: dict[str, Any] = {
            "INFERENCE_PRECISION_HINT": "f32",
            "INFERENCE_NUM_THREADS": threads or usable_cores(),
            "CACHE_DIR": str(user_cache("openvino/compiled")),
        }
        model = _converted(convert, f"lite0-{size[0]}x{size[1]}", "features.xml")
        self._compiled = openvino.Core().compile_model(model, "CPU", options)

    def __call__(self, pictures: NDArray[np.float32]) -> NDArray[np.float32]:
        """(2, 3, H, W) in [0, 1] -> (2, C, H / 8, W / 8)."""
        return np.array(self._compiled([pictures])[0], np.float32)


def _converted(convert: Callable[[], Any], digest: str, name: str) -> Any:
    """From the cache, else converted and kept there, unless the digest is that of an untrained network."""
    kept = user_cache("openvino") / f"{digest}-{__version__}-{openvino.__version__.split('-')[0]}"
    if digest == "untrained":
        return convert()
    if not (kept / name).is_file():
        model = convert()
        try:
            _keep(model, kept, name)
        except OSError:  # a cache that cannot be written costs time only
            return model
    return openvino.Core().read_model(kept / name)  # the first time too: its rounding differs a little


def _convert(svnet: LiteSVNet) -> Any:
    import torch
    from torch import nn

    from posekit.nets.pytorch import answers

    class Answers(nn.Module):
        """The network with its answers in the order that `unpack` takes them."""

        def __init__(self) -> None:
            super().__init__()
            self.svnet = svnet

        def forward(self, observed: Tensor, rendered: Tensor, depths: Tensor, focal: Tensor) -> tuple[Tensor, ...]:
            return answers(self.svnet(observed, rendered, depths, focal))  # type: ignore[return-value]

    width, height = svnet.config.size
    rendered = torch.zeros(1, 4, height, width)
    rendered[:, 3, height // 4 : -height // 4, width // 4 : -width // 4] = 1.0
    example = (rendered[:, :3], rendered, torch.zeros(1, height, width), torch.ones(1))
    return _traced(Answers(), example)


def _traced(network: nn.Module, example: tuple[Tensor, ...]) -> Any:
    """PyTorch's network for inputs of these sizes."""
    import torch

    with torch.inference_mode(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of sizes that become constants: a crop's size is one
        traced = torch.jit.trace(network.eval(), example, check_trace=False)
    with without_telemetry():
        return openvino.convert_model(traced, example_input=example, input=[list(x.shape) for x in example])


def _keep(model: Any, folder: Path, name: str) -> None:
    """As a whole or not at all."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(dir=folder.parent))
    try:
        openvino.save_model(model, part / name, compress_to_fp16=False)
        part.rename(folder)
        make_room((p for p in folder.parent.iterdir() if (p / name).is_file()), KEPT_NETWORKS)
    finally:
        shutil.rmtree(part, ignore_errors=True)

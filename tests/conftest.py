"""What several test files share."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from posekit.geometry import Pose, so3_exp
from posekit.nets.weights import build, save_networks
from posekit.render import Renderer
from posekit.synth.example import Example, make_example, ply

Array = NDArray[np.float64]

settings.register_profile("posekit", deadline=None, max_examples=60, derandomize=True)
settings.load_profile("posekit")

# of hypothesis: (N, 3), before a camera
points = st.lists(st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0.4, 3)), min_size=1, max_size=8).map(
    np.array
)


def moved(pose: Pose, step: Array) -> Pose:
    """A pose after a small turn (radians) and shift (metres), in the view's axes, as the solvers take steps."""
    return Pose(so3_exp(step[:3]) @ pose.R, pose.t + step[3:6])


def differences(function: Callable[[Array], Array], size: int, step: float = 1e-6) -> Array:
    """Central differences of a function of (size,) about zero; (..., size)."""
    columns = [(function(step * e) - function(-step * e)) / (2 * step) for e in np.eye(size)]
    return np.stack(columns, axis=-1)


@pytest.fixture(autouse=True, scope="session")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What is kept between runs of posekit goes into a folder of the tests, here and in the processes they start."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def renderer() -> Renderer:
    """One OpenGL context for all tests that draw with the usual settings."""
    return Renderer()


@pytest.fixture(scope="session")
def example(renderer: Renderer) -> Example:
    """The locomotive of posekit demo with its photograph and its true pose."""
    return make_example(renderer)


@pytest.fixture(scope="session")
def example_folder(example: Example, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example as files (photo.png, toy.ply, pose.json), and weights that nobody trained (untrained)."""
    folder = tmp_path_factory.mktemp("example")
    cv2.imwrite(str(folder / "photo.png"), example.view.image[..., ::-1])
    (folder / "toy.ply").write_text(ply(example.model))
    (folder / "pose.json").write_text(json.dumps({"T_cam_obj": example.T_cam_obj.matrix.tolist()}))
    save_networks(folder / "untrained", build("lite"), {"trained on": "nothing"})
    return folder

"""Recordings of tracks and of single pictures for the Rerun viewer. The only door to rerun, which is an extra."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.errors import OutputError
from posekit.geometry import Pose
from posekit.mesh.model import ObjectModel
from posekit.results import Estimate
from posekit.view import View

QUALITY = 85  # of the frames' JPEG


def load_rerun() -> Any:
    """The library. Raises OutputError where it is not installed."""
    try:
        import rerun
    except ImportError as error:
        raise OutputError('a recording needs rerun: pip install "posekit[rerun]".') from error
    return rerun


def record_estimates(path: Path, view: View, found: Sequence[tuple[ObjectModel, Estimate]]) -> None:
    """One picture as a recording: the photograph, every object's mesh at its pose (``objects``), the next best
    hypotheses (``alternatives``), and refinement's way on the timeline ``iteration`` (``refinement``). Raises
    OutputError."""
    with Recorder(path, [model for model, _ in found]) as recorder:
        recorder.picture(view.image, view.camera)
        for k, (_, estimate) in enumerate(found):
            recorder.estimate(k, estimate)


class Recorder:
    """Frames, meshes at their poses, predicted angles and states, as ``path`` (.rrd); open it with ``rerun FILE``.

    Everything stands in the camera's frame (x right, y down, z forward), metres. Written beside its name as it goes and
    renamed when it is closed. Raises OutputError where rerun is not installed or the file cannot be written.
    """

    def __init__(self, path: Path, models: Sequence[ObjectModel]) -> None:
        self._rr = load_rerun()
        self.path, self.part, self.models = path, path.with_name(f".{path.stem}.part.rrd"), models
        self._stream: Any = None

    def __enter__(self) -> Recorder:
        rr = self._rr
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.part.touch()
            self._stream = rr.RecordingStream("posekit")
            self._stream.save(self.part)
        except (OSError, RuntimeError) as error:
            raise OutputError(f"{self.path} cannot be written: {error}.") from error
        self._stream.log("/", rr.ViewCoordinates.RDF, static=True)
        for k, model in enumerate(self.models):
            self._stream.log(f"{self._place(k)}/mesh", self._mesh(model), static=True)
        return self

    def frame(
        self,
        number: int,
        image: NDArray[np.uint8] | None,
        camera: Camera | None,
        found: Sequence[tuple[str, Pose | None, float | None]],
    ) -> None:
        """One frame. image: uint8 RGB (H, W, 3). found: for each mesh its state, its ``T_cam_obj`` and the predicted
        angle in radians, None where it is lost."""
        rr, log = self._rr, self._stream.log
        self._stream.set_time("frame", sequence=number)
        if image is not None and camera is not None:
            self.picture(image, camera, static=False)
        for k, (state, pose, angle) in enumerate(found):
            place = self._place(k)
            log(f"{place}/state", rr.TextLog(state))
            if angle is not None:
                log(f"{place}/angle_deg", rr.Scalars(math.degrees(angle)))
            log(place, rr.Clear(recursive=False) if pose is None else self._transform(pose))

    def picture(self, image: NDArray[np.uint8], camera: Camera, static: bool = True) -> None:
        """image: uint8 RGB (H, W, 3). static: there all the time, instead of in the current frame."""
        rr, log, size = self._rr, self._stream.log, [camera.width, camera.height]
        pinhole = rr.Pinhole(image_from_camera=camera.K, resolution=size, camera_xyz=rr.ViewCoordinates.RDF)
        log("camera", pinhole, static=static)
        log("camera/image", rr.Image(image).compress(jpeg_quality=QUALITY), static=static)

    def estimate(self, k: int, estimate: Estimate) -> None:
        """The k-th mesh at its pose, at its alternatives' poses, and on its way."""
        rr, log, name = self._rr, self._stream.log, f"{k}-{self.models[k].name}"
        log(self._place(k), self._transform(estimate.T_cam_obj), static=True)
        log(
            f"{self._place(k)}/verdict", rr.TextDocument(f"{estimate.verdict}; score {estimate.score:.2f}"), static=True
        )
        mesh = self._mesh(self.models[k])
        for number, other in enumerate(estimate.alternatives, 2):
            log(f"alternatives/{name}/{number}", self._transform(other.T_cam_obj), static=True)
            log(f"alternatives/{name}/{number}/mesh", mesh, static=True)
        if estimate.trace:
            log(f"refinement/{name}/mesh", mesh, static=True)
        for number, step in enumerate(estimate.trace):
            self._stream.set_time("iteration", sequence=number)
            log(f"refinement/{name}", self._transform(step.T_cam_obj))
            if math.isfinite(step.angle):
                log(f"refinement/{name}/angle_deg", rr.Scalars(step.angle_deg))

    def _transform(self, T_cam_obj: Pose) -> Any:
        return self._rr.Transform3D(translation=T_cam_obj.t, mat3x3=T_cam_obj.R)

    def _place(self, k: int) -> str:
        return f"objects/{k}-{self.models[k].name}"

    def _mesh(self, model: ObjectModel) -> Any:
        surface: dict[str, Any] = {"vertex_colors": model.colors}
        if model.texture is not None and model.uvs is not None:
            down = np.stack([model.uvs[:, 0], 1 - model.uvs[:, 1]], axis=1)
            surface = {"vertex_texcoords": down, "albedo_texture": model.texture}
        return self._rr.Mesh3D(vertex_positions=model.vertices, triangle_indices=model.faces, **surface)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.flush()
        self._stream.disconnect()
        if self.part.exists():
            self.part.replace(self.path)

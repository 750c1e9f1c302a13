"""A recording of a track for the Rerun viewer. The only module that imports rerun, which comes as an extra."""

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

QUALITY = 85  # of the frames' JPEG


class Recorder:
    """Frames, meshes at their poses, predicted angles and states, as ``path`` (.rrd); open it with ``rerun FILE``.

    Everything stands in the camera's frame (x right, y down, z forward), metres. Written beside its name as it goes and
    renamed when it is closed. Raises OutputError where rerun is not installed or the file cannot be written.
    """

    def __init__(self, path: Path, models: Sequence[ObjectModel]) -> None:
        try:
            import rerun
        except ImportError as error:
            raise OutputError('a recording needs rerun: pip install "posekit[rerun]".') from error
        self._rr: Any = rerun
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
            size = [camera.width, camera.height]
            log("camera", rr.Pinhole(image_from_camera=camera.K, resolution=size, camera_xyz=rr.ViewCoordinates.RDF))
            log("camera/image", rr.Image(image).compress(jpeg_quality=QUALITY))
        for k, (state, pose, angle) in enumerate(found):
            place = self._place(k)
            log(f"{place}/state", rr.TextLog(state))
            if angle is not None:
                log(f"{place}/angle_deg", rr.Scalars(math.degrees(angle)))
            if pose is None:
                log(place, rr.Clear(recursive=False))
            else:
                log(place, rr.Transform3D(translation=pose.t, mat3x3=pose.R))

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

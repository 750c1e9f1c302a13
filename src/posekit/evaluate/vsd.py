"""VSD of estimates: the object's depth rendered at both poses, in the part of the picture that holds it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from posekit import metrics
from posekit.camera import Box, Camera
from posekit.datasets.registry import Dataset
from posekit.evaluate.scoring import SHARES, Case, Guess
from posekit.geometry import Pose
from posekit.mesh.model import ObjectModel
from posekit.render import Renderer

_STEP = 64  # sizes of windows are multiples of this many pixels, so that few framebuffers are needed


class VsdMeter:
    """Gives the errors of pairs of cases and guesses. delta: metres, the visibility test's tolerance."""

    def __init__(self, data: Dataset, delta: float) -> None:
        self.data, self.delta = data, delta
        self.renderer = Renderer()
        self._depth: tuple[tuple[int, int], NDArray[np.float32]] | None = None

    def errors(self, case: Case, guess: Guess) -> NDArray[np.float64]:
        """(10,), one for each tolerance in SHARES; 1 where the picture has no depth."""
        depth = self._depth_of(case.scene, case.image)
        if depth is None:
            return np.ones(len(SHARES))
        measured = self.data.measured_model(case.obj_id)
        camera = Camera.from_K(case.K, depth.shape[1], depth.shape[0])
        poses = [guess.T_cam_obj, case.T_cam_obj]
        x0, y0, width, height = window(camera, measured.model, poses)
        part = camera.cropped(x0, y0, width, height)
        est, gt = self.renderer.render(measured.model, poses, part, rgb=False)
        assert est.depth is not None and gt.depth is not None
        scene = depth[y0 : y0 + height, x0 : x0 + width]
        return metrics.vsd(est.depth, gt.depth, scene, part, measured.diameter, SHARES, self.delta)

    def _depth_of(self, scene: int, image: int) -> NDArray[np.float32] | None:
        if self._depth is None or self._depth[0] != (scene, image):
            depth = self.data.depth(scene, image)
            if depth is None:
                return None
            self._depth = ((scene, image), depth)
        return self._depth[1]


def window(camera: Camera, model: ObjectModel, poses: list[Pose]) -> tuple[int, int, int, int]:
    """(x0, y0, width, height) in the picture that holds the object at all poses; the whole picture where a pose is
    not wholly in front of the camera."""
    points = np.concatenate([pose.apply(model.hull_vertices) for pose in poses])
    if points[:, 2].min() < 0.01:
        return 0, 0, camera.width, camera.height
    box: Box = camera.points_box(points)
    x0, width = _span(box[0], box[2], camera.width)
    y0, height = _span(box[1], box[3], camera.height)
    return x0, y0, width, height


def _span(low: float, high: float, size: int) -> tuple[int, int]:
    """Start and length within [0, size), the length a multiple of the step where there is room."""
    start = int(np.clip(np.floor(low) - 1, 0, size - 1))
    end = int(np.clip(np.ceil(high) + 1, start + 1, size))
    length = min(size, -(-(end - start) // _STEP) * _STEP)
    return min(start, size - length), length

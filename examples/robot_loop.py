"""A camera loop for a robot: frames in, poses in the robot's frame out: `python examples/robot_loop.py [FRAMES]`.

What is not reliable is not passed on: the robot waits, and the object is looked for again.
"""

import sys
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from posekit import Camera, ObjectModel, PoseEstimator, Renderer, estimate
from posekit.synth.example import make_film
from posekit.tracking.tracker import Tracker

FRAMES = int(sys.argv[1]) if len(sys.argv) > 1 else 30
FILM = list(make_film(Renderer(), FRAMES))
MODEL: ObjectModel = FILM[0].model  # ObjectModel.load("part.stl", units="mm")
CAMERA: Camera = FILM[0].view.camera  # from a calibration, without lens distortion
T_BASE_CAM = np.array([[1, 0, 0, 0.4], [0, 0, 1, -0.6], [0, -1, 0, 0.3], [0, 0, 0, 1.0]])  # hand-eye calibration


def frames() -> Iterator[NDArray[np.uint8]]:
    """uint8 RGB (480, 640, 3), newest last. Yours: the camera's driver; `posekit.io.video.open_frames("0")`."""
    for k, example in enumerate(FILM):
        hidden = k == FRAMES // 2  # once something is in the way
        yield np.full_like(example.view.image, 90) if hidden else example.view.image


def first_pose(image: NDArray[np.uint8], estimator: PoseEstimator) -> Tracker | None:
    """A tracker that starts here, or None where the object is not surely there. Takes seconds: the robot stands."""
    result = estimate(image, estimator, box=FILM[0].box, camera=CAMERA)  # where the object is expected
    if not result.reliable:
        return None
    return Tracker(MODEL, CAMERA, pose=result.T_cam_obj, estimator=estimator)


def main() -> None:
    estimator, tracker = PoseEstimator(MODEL), None  # loaded once
    for number, image in enumerate(frames()):
        tracker = tracker or first_pose(image, estimator)
        found = None if tracker is None else tracker.step(image)
        if found is None:
            print(f"frame {number}: not found: the robot waits")
            continue
        if found.T_cam_obj is None or not found.reliable:
            print(f"frame {number}: {found.state}, not reliable: the robot waits")
            if found.T_cam_obj is None:
                tracker = None  # lost: begin anew
            continue
        T_base_obj = T_BASE_CAM @ found.T_cam_obj.matrix  # 4x4, metres
        print(f"frame {number}: {found.state}, object at {T_base_obj[:3, 3].round(3)} in the robot's frame")


if __name__ == "__main__":
    main()

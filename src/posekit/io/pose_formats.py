"""Poses as other programs have them: files to write, texts to read. docs/conventions.md says what each is."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.errors import ConfigError
from posekit.geometry import Pose, quat_to_rotation

FORMATS = ("json", "csv", "ros", "blender", "unity", "tum")
CSV_COLUMNS = [
    "object",
    "frame",
    "seconds",
    "x_m",
    "y_m",
    "z_m",
    "qw",
    "qx",
    "qy",
    "qz",
    "score",
    "angle_deg",
    "reliable",
]
ROS_FRAME = "camera_optical_frame"  # as REP 103 names OpenCV's axes
# From OpenCV's camera axes to those of a camera in Blender and OpenGL (x right, y up, z backwards) and in Unity (x
# right, y up, z forward: left-handed); and from a mesh's axes to those that Unity's importers give it.
BLENDER_CAMERA = OPENGL_CAMERA = np.diag([1.0, -1.0, -1.0])
UNITY_CAMERA = np.diag([1.0, -1.0, 1.0])
UNITY_MESH = np.diag([-1.0, 1.0, 1.0])


@dataclass(frozen=True, eq=False)
class NamedPose:
    """An object's pose to write. angle_deg: predicted rotation error, degrees. frame: the picture's number.
    seconds: when it was taken, None where that is not known; the frame's number stands for it where a format needs one.
    """

    name: str
    T_cam_obj: Pose
    score: float
    angle_deg: float
    reliable: bool
    frame: int = 0
    seconds: float | None = None

    @property
    def stamp(self) -> float:
        """Seconds where they are known, else the frame's number."""
        return float(self.frame) if self.seconds is None else self.seconds


def pose_files(format_: str, poses: Sequence[NamedPose]) -> dict[str, str]:
    """Names of files and their texts. "json" is posekit's own result, which is written in any case: no file more.
    Raises ConfigError for a format that is none of FORMATS."""
    check_formats([format_])
    if format_ == "json":
        return {}
    if format_ == "csv":
        return {"objects.csv": _csv(poses)}
    if format_ == "ros":
        return {"ros.yaml": "---\n".join(_transform_stamped(each) for each in poses)}
    if format_ == "blender":
        return {"blender.json": _listed([_blender(each) for each in poses])}
    if format_ == "unity":
        return {"unity.json": _listed([_unity(each) for each in poses])}
    return _tum(poses)


def check_formats(formats: Sequence[str]) -> None:
    """Raises ConfigError for a format that is none of FORMATS."""
    for each in formats:
        if each not in FORMATS:
            raise ConfigError(f"--format {each}: choose from {', '.join(FORMATS)}.")


def to_blender(T_cam_obj: Pose) -> Pose:
    """The object's pose in a Blender camera's own frame: ``object.matrix_world = camera.matrix_world @ this``."""
    return Pose(BLENDER_CAMERA @ T_cam_obj.R, BLENDER_CAMERA @ T_cam_obj.t)


def to_opengl(T_cam_obj: Pose) -> Pose:
    """The object's pose before OpenGL's usual camera (x right, y up, looking along -z): the model-view matrix."""
    return Pose(OPENGL_CAMERA @ T_cam_obj.R, OPENGL_CAMERA @ T_cam_obj.t)


def opengl_projection(camera: Camera, near: float, far: float) -> NDArray[np.float64]:
    """(4, 4), the projection matrix that goes with `to_opengl`, row by row: a viewport of the photograph's size then
    shows the object where the photograph does, the photograph's first row at the top. near, far: metres, 0 < near <
    far. Raises ConfigError."""
    if not 0 < near < far:
        raise ConfigError(f"near {near:g} and far {far:g}: metres in front of the camera, 0 < near < far.")
    flip = np.diag([1.0, -1.0, 1.0, 1.0])  # clip space with y up
    T_cam_gl = np.diag([*np.diag(OPENGL_CAMERA), 1.0])
    return np.asarray(flip @ camera.gl_projection(near, far) @ T_cam_gl, np.float64)


def to_unity(T_cam_obj: Pose) -> Pose:
    """The object's local pose below a Unity camera, for a mesh whose x Unity's importer has negated."""
    return Pose(UNITY_CAMERA @ T_cam_obj.R @ UNITY_MESH, UNITY_CAMERA @ T_cam_obj.t)


def pose_from_text(text: str) -> Pose:
    """``T_cam_obj`` (metres) from numbers, parted by spaces or commas, after # comments.

    16 or 12: a 4x4 or 3x4 matrix, row by row. 7: position and quaternion, x y z qx qy qz qw, as TUM and ROS have them;
    8: the same after a timestamp. Raises ValueError where they are something else.
    """
    content = " ".join(line.partition("#")[0] for line in text.splitlines())
    numbers = [float(part) for part in re.split(r"[\s,;\[\]]+", content) if part]
    if len(numbers) in (16, 12):
        matrix = np.reshape(numbers, (-1, 4))
        if len(matrix) == 4 and np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
            raise ValueError("the matrix' last row is not 0 0 0 1: give it row by row")
        return Pose.from_matrix(matrix)
    if len(numbers) in (7, 8):
        x, y, z, qx, qy, qz, qw = numbers[-7:]
        return pose_from_quaternion([x, y, z], [qw, qx, qy, qz])
    raise ValueError(f"it has {len(numbers)} numbers, not 16 (a matrix) or 7 (x y z qx qy qz qw)")


def pose_from_mapping(data: Mapping[str, Any]) -> Pose:
    """``T_cam_obj`` from ``t_m`` with ``quat_wxyz``, or ROS' ``position`` with ``orientation`` or ``translation`` with
    ``rotation``, each with x, y, z (and w). Raises KeyError or ValueError where it is something else."""
    for key in ("pose", "transform"):
        if isinstance(data.get(key), Mapping):
            return pose_from_mapping(data[key])
    if "quat_wxyz" in data:
        return pose_from_quaternion(data["t_m"], data["quat_wxyz"])
    place, turn = ("position", "orientation") if "position" in data else ("translation", "rotation")
    return pose_from_quaternion([data[place][k] for k in "xyz"], [data[turn][k] for k in "wxyz"])


def pose_from_quaternion(t_m: Sequence[float], quat_wxyz: Sequence[float]) -> Pose:
    """t_m: (3,) metres. quat_wxyz: (4,), of length 1 to a hundredth. Raises ValueError."""
    t, quat = (np.asarray(v, dtype=np.float64) for v in (t_m, quat_wxyz))
    if t.shape != (3,) or quat.shape != (4,) or not np.isfinite([*t, *quat]).all():
        raise ValueError("a pose is three numbers for the position and four for the quaternion, all finite")
    length = float(np.linalg.norm(quat))
    if abs(length - 1) > 0.01:
        raise ValueError(f"the quaternion's length is {length:.3g}, not 1")
    return Pose(quat_to_rotation(quat), t)


def _csv(poses: Sequence[NamedPose]) -> str:
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    for p in poses:
        seconds = "" if p.seconds is None else p.seconds
        numbers = [*_numbers(p.T_cam_obj.t), *_numbers(p.T_cam_obj.quat_wxyz)]
        angle = p.angle_deg if math.isfinite(p.angle_deg) else ""
        writer.writerow([p.name, p.frame, seconds, *numbers, p.score, angle, str(p.reliable).lower()])
    return file.getvalue()


def _transform_stamped(p: NamedPose) -> str:
    """geometry_msgs/TransformStamped as YAML."""
    (x, y, z), (qw, qx, qy, qz) = _numbers(p.T_cam_obj.t), _numbers(p.T_cam_obj.quat_wxyz)
    whole = math.floor(p.stamp)
    return (
        f"header:\n  stamp:\n    sec: {whole}\n    nanosec: {min(999_999_999, round((p.stamp - whole) * 1e9))}\n"
        f"  frame_id: {ROS_FRAME}\nchild_frame_id: {json.dumps(p.name)}\n"
        f"transform:\n  translation:\n    x: {x!r}\n    y: {y!r}\n    z: {z!r}\n"
        f"  rotation:\n    x: {qx!r}\n    y: {qy!r}\n    z: {qz!r}\n    w: {qw!r}\n"
    )


def _blender(p: NamedPose) -> dict[str, Any]:
    pose = to_blender(p.T_cam_obj)
    return {
        **_about(p),
        "matrix": pose.matrix.tolist(),
        "location": _numbers(pose.t),
        "rotation_quaternion": _numbers(pose.quat_wxyz),
    }


def _unity(p: NamedPose) -> dict[str, Any]:
    pose = to_unity(p.T_cam_obj)
    w, x, y, z = _numbers(pose.quat_wxyz)
    return {
        **_about(p),
        "localPosition": dict(zip("xyz", _numbers(pose.t), strict=True)),
        "localRotation": {"x": x, "y": y, "z": z, "w": w},
    }


def _about(p: NamedPose) -> dict[str, Any]:
    return {"name": p.name, "frame": p.frame, "seconds": p.seconds, "reliable": p.reliable}


def _listed(objects: Sequence[dict[str, Any]]) -> str:
    return json.dumps({"objects": objects}, indent=1, allow_nan=False) + "\n"


def _tum(poses: Sequence[NamedPose]) -> dict[str, str]:
    """A trajectory for each object; of several instances in one picture the first, which is the best."""
    files: dict[str, dict[int, str]] = {}
    for p in poses:
        w, x, y, z = _numbers(p.T_cam_obj.quat_wxyz)
        numbers = " ".join(repr(v) for v in (p.stamp, *_numbers(p.T_cam_obj.t), x, y, z, w))
        files.setdefault(f"{p.name}.tum", {}).setdefault(p.frame, numbers)
    return {name: "# timestamp x y z qx qy qz qw\n" + "\n".join(t.values()) + "\n" for name, t in files.items()}


def _numbers(values: NDArray[np.float64]) -> list[float]:
    return [float(v) for v in values]

"""posekit: from a photograph and a CAD file to the object's 6D pose.

The public names, each loaded when it is first used: importing posekit loads neither torch nor OpenGL.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from posekit._version import __version__
from posekit.errors import PosekitError

if TYPE_CHECKING:
    from posekit.camera import Camera
    from posekit.estimate import EstimateOptions, PoseEstimator
    from posekit.geometry import Pose
    from posekit.object_model import ObjectModel
    from posekit.render import Renderer
    from posekit.results import Detection, Estimate
    from posekit.view import View

_HOMES = {
    "Camera": "camera",
    "Detection": "results",
    "Estimate": "results",
    "EstimateOptions": "estimate",
    "ObjectModel": "object_model",
    "Pose": "geometry",
    "PoseEstimator": "estimate",
    "Renderer": "render",
    "View": "view",
}

__all__ = [
    "Camera",
    "Detection",
    "Estimate",
    "EstimateOptions",
    "ObjectModel",
    "Pose",
    "PoseEstimator",
    "PosekitError",
    "Renderer",
    "View",
    "__version__",
]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'posekit' has no attribute {name!r}")
    value: object = getattr(import_module(f"posekit.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)

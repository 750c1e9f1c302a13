"""posekit: from a photograph and a CAD file to the object's 6D pose.

The public names, each loaded when it is first used: importing posekit loads neither torch nor OpenGL.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from posekit._version import __version__
from posekit.errors import PosekitError

if TYPE_CHECKING:
    from posekit.api import Result, estimate
    from posekit.camera import Camera
    from posekit.estimate.estimator import EstimateOptions, PoseEstimator
    from posekit.geometry import Pose
    from posekit.mesh.model import ObjectModel
    from posekit.render import Renderer
    from posekit.results import Detection, Estimate
    from posekit.view import View

_HOMES = {
    "Camera": "camera",
    "Detection": "results",
    "Estimate": "results",
    "EstimateOptions": "estimate.estimator",
    "ObjectModel": "mesh.model",
    "Pose": "geometry",
    "PoseEstimator": "estimate.estimator",
    "Renderer": "render",
    "Result": "api",
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
    "Result",
    "View",
    "__version__",
    "estimate",
]


class _EstimateModule(ModuleType):
    """posekit.estimate, the package, which can be called: `posekit.api.estimate` has the same name."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return import_module("posekit.api").estimate(*args, **kwargs)


class _Package(ModuleType):
    """This package. Python sets a submodule as an attribute when it is first imported, by whatever way."""

    def __setattr__(self, name: str, value: object) -> None:
        if name == "estimate" and isinstance(value, ModuleType):
            value.__class__ = _EstimateModule
            value.__doc__ = f"{value.__doc__}\nCalled, it is posekit.api.estimate."
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> object:
    if name == "estimate":
        return import_module("posekit.estimate")
    if name not in _HOMES:
        raise AttributeError(f"module 'posekit' has no attribute {name!r}")
    value: object = getattr(import_module(f"posekit.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)

"""From a photograph to poses: refinement, choice, one function for every caller."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from posekit.estimate.estimator import EstimateOptions, Estimators, PoseEstimator

__all__ = ["EstimateOptions", "Estimators", "PoseEstimator"]


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from posekit.estimate import estimator

    value: object = getattr(estimator, name)
    return value

"""What several test files share."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from posekit.geometry import Pose, so3_exp

Array = NDArray[np.float64]


def moved(pose: Pose, step: Array) -> Pose:
    """A pose after a small turn (radians) and shift (metres), in the view's axes, as the solvers take steps."""
    return Pose(so3_exp(step[:3]) @ pose.R, pose.t + step[3:6])


def differences(function: Callable[[Array], Array], size: int, step: float = 1e-6) -> Array:
    """Central differences of a function of (size,) about zero; (..., size)."""
    columns = [(function(step * e) - function(-step * e)) / (2 * step) for e in np.eye(size)]
    return np.stack(columns, axis=-1)

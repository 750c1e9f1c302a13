"""The relative pose between a rendered (source) and an observed (target) object, DeepIM's way.

One convention: with source (R_s, t_s) and target (R_t, t_t), both ``T_view_ctr`` in the same zoomed view,

    R_delta = R_t @ R_s.T            axes parallel to the camera's, origin at the object's centre
    vx = f (x_t/z_t - x_s/z_s)       crop pixels, so that the network need not know the crop's scale
    vy = f (y_t/z_t - y_s/z_s)
    vz = ln(z_s / z_t)

(DeepIM, section 3.2; the factor f, the zoomed camera's focal length in pixels, is its "zoomed" variant.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from posekit.geometry import Pose, nearest_rotation, rotation_angle

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PoseDelta:
    """R: (3, 3). v: (3,) = vx and vy in crop pixels, vz without unit."""

    R: Array
    v: Array

    @property
    def angle(self) -> float:
        """Rotation between the two poses, radians."""
        return float(rotation_angle(self.R))


def delta_between(source: Pose, target: Pose, focal_px: float) -> PoseDelta:
    """The delta that takes ``source`` to ``target``; both ``T_view_ctr``, in front of the camera."""
    ts, tt = source.t, target.t
    v = np.array(
        [
            focal_px * (tt[0] / tt[2] - ts[0] / ts[2]),
            focal_px * (tt[1] / tt[2] - ts[1] / ts[2]),
            np.log(ts[2] / tt[2]),
        ]
    )
    return PoseDelta(target.R @ source.R.T, v)


def apply_delta(source: Pose, delta: PoseDelta, focal_px: float) -> Pose:
    """The inverse of ``delta_between``: the target's ``T_view_ctr``."""
    ts = source.t
    z = ts[2] / np.exp(delta.v[2])
    x = z * (delta.v[0] / focal_px + ts[0] / ts[2])
    y = z * (delta.v[1] / focal_px + ts[1] / ts[2])
    return Pose(nearest_rotation(delta.R @ source.R), np.array([x, y, z]))

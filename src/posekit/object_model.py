"""The former place of `posekit.mesh`, kept for one release."""

from posekit.mesh.model import ObjectModel
from posekit.mesh.symmetries import Continuous, Symmetries

__all__ = ["Continuous", "ObjectModel", "Symmetries"]

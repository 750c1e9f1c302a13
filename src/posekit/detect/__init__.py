"""Where the objects are."""

from posekit.detect.prompts import BoxPrompt, Detector, MaskPrompt
from posekit.detect.supervision import from_supervision, to_supervision

__all__ = ["BoxPrompt", "Detector", "MaskPrompt", "from_supervision", "to_supervision"]

"""Where the objects are."""

from posekit.detect.prompts import BoxPrompt, Detector, MaskPrompt

__all__ = ["BoxPrompt", "Detector", "MaskPrompt"]

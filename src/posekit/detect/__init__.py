"""Where the objects are. Layer 2."""

from posekit.detect.prompts import BoxPrompt, Detector, MaskPrompt

__all__ = ["BoxPrompt", "Detector", "MaskPrompt"]

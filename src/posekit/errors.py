"""Everything that posekit raises on purpose.

PosekitError
├── InputError        a file, an option or an array that cannot be used
│   ├── ImageError    a picture or video
│   ├── MeshError     a CAD mesh or its symmetries
│   ├── CameraError   intrinsics
│   ├── PromptError   a box, mask, pose or detections file
│   └── ConfigError   a TOML file or a combination of options
├── OutputError       a folder or file that cannot be written, or would be overwritten
├── WeightsError      weights that are missing, damaged or of another preset
├── RenderError       no usable OpenGL, or a rendering that failed
└── TrainingError     a training that cannot continue
"""


class PosekitError(Exception):
    """Base class. Its text says what was given, what is needed and what to do."""


class InputError(PosekitError):
    """A file, an option or an array that cannot be used."""


class ImageError(InputError):
    """A picture or video that cannot be used."""


class MeshError(InputError):
    """A CAD mesh or its symmetries that cannot be used."""


class CameraError(InputError):
    """Intrinsics that are missing or make no camera."""


class PromptError(InputError):
    """A box, mask, pose or detections file that cannot be used."""


class ConfigError(InputError):
    """A TOML file or a combination of options that makes no sense."""


class OutputError(PosekitError):
    """A folder or file that cannot be written, or would be overwritten."""


class WeightsError(PosekitError):
    """Weights that are missing, damaged or of another preset."""


class RenderError(PosekitError):
    """No usable OpenGL, or a rendering that failed."""


class TrainingError(PosekitError):
    """A training that cannot continue."""

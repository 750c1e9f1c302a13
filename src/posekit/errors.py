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
└── TrainingError     a training that cannot go on
"""


class PosekitError(Exception):
    """Base class. Its text says what was given, what is needed and what to do."""


class InputError(PosekitError):
    pass


class ImageError(InputError):
    pass


class MeshError(InputError):
    pass


class CameraError(InputError):
    pass


class PromptError(InputError):
    pass


class ConfigError(InputError):
    pass


class OutputError(PosekitError):
    pass


class WeightsError(PosekitError):
    pass


class RenderError(PosekitError):
    pass


class TrainingError(PosekitError):
    pass

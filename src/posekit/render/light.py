"""Light: how a rendering is lit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Light:
    """One distant light and an even one from everywhere: Blinn and Phong's model on the colours as stored.

    ambient, diffuse, specular: strengths; direction: (3,) towards the light, in the view's frame, any length (the
    default comes from above and behind the camera); shininess: the highlight's exponent; colour: RGB, 1 = white.
    Raises ValueError where a number is not finite or the direction has no length.
    """

    ambient: float = 0.5
    direction: tuple[float, float, float] = (-0.3, -0.6, -0.75)
    diffuse: float = 0.6
    specular: float = 0.1
    shininess: float = 20.0
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        numbers = (self.ambient, self.diffuse, self.specular, self.shininess, *self.direction, *self.colour)
        if not np.isfinite(numbers).all() or not np.linalg.norm(self.direction) > 0:
            raise ValueError(f"{self}: all numbers must be finite and the direction must have a length")

    @classmethod
    def flat(cls) -> Light:
        """Colours as they are in the mesh."""
        return cls(ambient=1.0, diffuse=0.0, specular=0.0)


DEFAULT_LIGHT = Light()

"""Random lights."""

from __future__ import annotations

import numpy as np

from posekit.render.light import Light


def random_light(rng: np.random.Generator) -> Light:
    """Light as a room has it: from above more often than not, soft or hard, a little coloured."""
    direction = rng.normal(size=3)
    direction[1] -= 0.7  # up is -y
    direction[2] = -abs(direction[2])  # from the camera's side
    ambient = float(rng.uniform(0.25, 0.9))
    return Light(
        ambient=ambient,
        direction=tuple(direction / np.linalg.norm(direction)),
        diffuse=float(rng.uniform(0.1, 1.1) * (1.15 - ambient)),
        specular=float(rng.choice([0.0, 0.0, rng.uniform(0, 0.6)])),
        shininess=float(rng.uniform(4, 60)),
        colour=tuple(rng.uniform(0.85, 1.0, size=3)),
    )

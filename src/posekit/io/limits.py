"""How large inputs may be, so that none takes all memory."""

from __future__ import annotations

import os

from posekit.errors import ConfigError

LIMITS = {
    "POSEKIT_MOST_PIXELS": 100_000_000,  # of a picture
    "POSEKIT_MOST_FACES": 5_000_000,  # of a mesh
    "POSEKIT_MOST_MESH_BYTES": 1_000_000_000,  # of a mesh's file, and of each file that it names
}


def limit(name: str) -> int:
    """One of LIMITS, or what the environment's variable of that name says. Raises ConfigError."""
    given = os.environ.get(name, "").strip()
    if not given:
        return LIMITS[name]
    try:
        value = int(given)
    except ValueError:
        value = 0
    if value < 1:
        raise ConfigError(f"{name}={given}: give a whole number from 1 on, or leave it out ({LIMITS[name]}).")
    return value

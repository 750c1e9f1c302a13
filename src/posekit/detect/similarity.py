"""How a similarity of looks counts in a score."""

from __future__ import annotations

import math

WEIGHT, USUAL = 20.0, 0.56  # of an object's similarity, and the one that says nothing: docs/decisions/0015


def with_similarity(chance: float, similarity: float) -> float:
    """A chance that also says how much a thing looks like the mesh: docs/decisions/0015."""
    return shifted(chance, WEIGHT * (similarity - USUAL))


def shifted(chance: float, shift: float) -> float:
    """A chance whose log odds are shifted; 0 and 1 stay."""
    return chance if not 0 < chance < 1 else 1 / (1 + (1 / chance - 1) * math.exp(-shift))

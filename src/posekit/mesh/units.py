"""The units of a mesh file, and whether a size is an object's."""

from __future__ import annotations

import logging

from posekit.errors import MeshError

log = logging.getLogger("posekit")

UNITS = {"mm": 0.001, "cm": 0.01, "m": 1.0, "in": 0.0254}

_METRES_BELOW, _MM_ABOVE = 3.0, 20.0  # diameters in a file's own units; between them it cannot be decided
_SMALLEST, _LARGEST = 0.001, 10.0  # diameters in metres that are an object's


def chosen_units(label: str, diameter: float, units: str) -> str:
    """One of UNITS. Raises MeshError where it cannot be decided, or where the size is no object's."""
    if units == "auto":
        if _METRES_BELOW <= diameter <= _MM_ABOVE:
            could_be = "; ".join(f"{unit}: {plain_length(diameter * UNITS[unit])} long" for unit in UNITS)
            raise MeshError(
                f"{label} has a diameter of {diameter:.3g} in its own units, which could be metres or millimetres: "
                f"{_give_units('m', 'mm')}, or another ({could_be})."
            )
        chosen = "m" if diameter < _METRES_BELOW else "mm"
    else:
        chosen = units
    if not _plausible(diameter, chosen):
        fitting = [unit for unit in ("m", "mm", "cm", "in") if unit != chosen and _plausible(diameter, unit)]
        if fitting:
            advice = f"posekit works in metres: {_give_units(*fitting)}."
        else:
            advice = "posekit works with objects from 1 mm to 10 m: scale the mesh."
        raise MeshError(f"{label} has a diameter of {diameter:.3g} {chosen}; {advice}")
    if units == "auto":
        name = {"mm": "millimetres", "m": "metres"}[chosen]
        others = [unit for unit in UNITS if unit != chosen and _plausible(diameter, unit)]
        log.info(
            "%s: a diameter of %.4g, so its units are taken for %s: the object is %s long (%s to say so%s).",
            label, diameter, name, plain_length(diameter * UNITS[chosen]), _give_units(chosen),
            "".join(f"; in {unit} it is {plain_length(diameter * UNITS[unit])} long" for unit in others),
        )  # fmt: skip
    return chosen


def _give_units(*units: str) -> str:
    """What to do to have one of these units, for both kinds of users."""
    options, values = (" or ".join(form.format(u) for u in units) for form in ("--units {}", "units={!r}"))
    return f"give {options} ({values} in Python)"


def plain_length(metres: float) -> str:
    """A length as people say it: 27 mm, 12.5 cm, 1.8 m."""
    if metres < 0.1:
        return f"{metres * 1000:.3g} mm"
    return f"{metres * 100:.3g} cm" if metres < 1 else f"{metres:.3g} m"


def _plausible(diameter: float, units: str) -> bool:
    return _SMALLEST <= diameter * UNITS[units] <= _LARGEST

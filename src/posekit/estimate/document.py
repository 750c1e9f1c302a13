"""Estimates as the document that commands and `posekit.api` write."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import version

from posekit.io.documents import camera_entry
from posekit.results import Estimate, estimates_to_json
from posekit.view import View


def result_json(
    view: View,
    estimates: Sequence[Estimate],
    weights_hash: str,
    about: Mapping[str, object] | None = None,
    indent: int | None = 1,
) -> str:
    """The text of result.json. about: further entries, such as the files' names. indent: None writes one line."""
    return estimates_to_json(
        estimates,
        weights_hash=weights_hash,
        versions={name: version(name) for name in ("torch", "numpy", "opencv-python-headless", "moderngl")},
        about={**(about or {}), "camera": camera_entry(view)},
        indent=indent,
    )

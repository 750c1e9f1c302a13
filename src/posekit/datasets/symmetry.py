"""Symmetries found by comparing renderings: does a mesh look the same after a turn about one of its axes?"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from posekit.camera import Camera
from posekit.errors import MeshError, OutputError
from posekit.geometry import Pose, fibonacci_sphere, so3_exp, view_rotation
from posekit.io.files import user_cache, write_text_atomic
from posekit.mesh.model import ObjectModel
from posekit.mesh.symmetries import Symmetries
from posekit.render import Renderer
from posekit.render.views import DEFAULT_FOV, fit_distance
from posekit.view import View

log = logging.getLogger("posekit")

VIEWS, SIDE = 8, 96  # pictures that are compared, their sides in pixels
DEPTH = 0.02  # of the diameter: deeper differences count
PIXELS, COLOUR = 0.03, 12.0  # largest share of pixels that differ, and largest mean difference of colour
DETECT = "detect"  # in place of a symmetry: look for them
VERSION = 1  # of what is kept: raised where the answer for a mesh may change
ORDERS = (12, 8, 6, 5, 4, 3, 2)
ARBITRARY_TURNS = (0.31, 1.0, 2.43)  # turns (radians) after which only a body of revolution looks the same


def detect_symmetries(renderer: Renderer, model: ObjectModel) -> Symmetries:
    """Turns about lines along the mesh's x, y and z through its box's centre that change neither the rendered shape nor
    the colours.

    Other axes and mirrors are not looked for: give such symmetries in a models_info.json. The answer for a mesh is kept
    in the user's cache, where that can be written.
    """
    return Symmetries.parse(detected_symmetry(renderer, model), model.center)


def detected_symmetry(renderer: Renderer, model: ObjectModel) -> str:
    """`detect_symmetries` as `Symmetries.parse` takes it: "z:2", or "none"."""
    file = user_cache("symmetries") / f"{_appearance(model)}-{VERSION}.txt"
    with suppress(OSError, UnicodeDecodeError, MeshError):
        kept = file.read_text(encoding="utf-8").strip()
        Symmetries.parse(kept, model.center)  # a damaged file counts for nothing
        return kept
    found = _look(renderer, model)
    with suppress(OSError, OutputError):
        file.parent.mkdir(parents=True, exist_ok=True)
        write_text_atomic(file, found + "\n")
    return found


def load_detecting(path: Path, units: str, renderer: Renderer) -> ObjectModel:
    """A mesh with the symmetries that ``models_info.json`` beside it tells, else those that are detected, which is
    said. Raises MeshError."""
    model = ObjectModel.load(path, units=units)
    if declared(path):
        return model
    found = detected_symmetry(renderer, model)
    log.info(
        "%s: %s.", path.name, f"looks the same after {in_words(found)}" if found != "none" else "no symmetry found"
    )
    return replace(model, symmetries=Symmetries.parse(found, model.center))


def declared(path: Path) -> bool:
    """Whether a ``models_info.json`` beside the mesh tells its symmetries."""
    return (path.parent / "models_info.json").is_file()


def in_words(symmetry: str) -> str:
    """ "z:2" as "half a turn about its z axis"."""
    turns = {"inf": "any turn", "2": "half a turn", "4": "a quarter turn"}
    items = [item.partition(":") for item in symmetry.split(",")]
    return ", ".join(f"{turns.get(order, f'1/{order} of a turn')} about its {axis} axis" for axis, _, order in items)


def _appearance(model: ObjectModel) -> str:
    """Of shape and colours, 32 hex digits."""
    digest = hashlib.sha256(model.digest.encode())
    for part in (model.colors, model.uvs, model.texture):
        digest.update(b"none" if part is None else f"{part.dtype}{part.shape}".encode() + part.tobytes())
    return digest.hexdigest()[:32]


def _look(renderer: Renderer, model: ObjectModel) -> str:
    camera = Camera.from_fov(DEFAULT_FOV, SIDE, SIDE)
    away = np.array([0.0, 0.0, fit_distance(model, camera)])
    poses = [Pose(view_rotation(d), away) for d in fibonacci_sphere(VIEWS)]
    before = _seen(renderer, model, poses, camera)
    items = []
    for axis, name in zip(np.eye(3), "xyz", strict=True):

        def holds(angle: float, axis: np.ndarray = axis) -> bool:
            turned = [pose @ Pose.rotation(so3_exp(axis * angle)) for pose in poses]
            after = (_seen(renderer, model, [pose], camera)[0] for pose in turned)
            return _alike(before, after, DEPTH * model.diameter)

        if all(holds(angle) for angle in ARBITRARY_TURNS):
            items.append(f"{name}:inf")
        else:
            items += [f"{name}:{n}" for n in ORDERS if holds(2 * np.pi / n)][:1]
    return ",".join(items) or "none"


def _seen(renderer: Renderer, model: ObjectModel, poses: list[Pose], camera: Camera) -> list[View]:
    """poses: T_cam_ctr."""
    return renderer.render(model, [pose @ model.T_ctr_obj for pose in poses], camera, light=None)


def _alike(before: Sequence[View], after: Iterable[View], depth: float) -> bool:
    """after: drawn one by one, no more of them than decide it."""
    differing = 0
    total = sum(int(a.mask.sum()) for a in before if a.mask is not None)  # and what is seen only after
    for a, b in zip(before, after, strict=True):
        assert a.mask is not None and b.mask is not None and a.depth is not None and b.depth is not None
        both = a.mask & b.mask
        differing += int((a.mask ^ b.mask).sum()) + int((np.abs(a.depth - b.depth)[both] > depth).sum())
        total += int((b.mask & ~a.mask).sum())
        colour = float(np.abs(a.image[both].astype(float) - b.image[both]).mean()) if both.any() else 255.0
        # What later pictures add to the total they add to what differs, too.
        if colour > COLOUR or differing > PIXELS * total:
            return False
    return True

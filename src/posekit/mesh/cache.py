"""Where what is made once per mesh is kept on disk: by the mesh's shape and looks."""

from __future__ import annotations

import hashlib
from pathlib import Path
from weakref import WeakKeyDictionary

import numpy as np

from posekit.io.files import user_cache
from posekit.mesh.model import ObjectModel

_LOOKS: WeakKeyDictionary[ObjectModel, str] = WeakKeyDictionary()


def cache_file(kind: str, model: ObjectModel, version: int) -> Path:
    """Where a mesh's arrays are kept: in the folder of the kind, named by shape, colours or texture, and version."""
    if model not in _LOOKS:
        look = hashlib.sha256(model.digest.encode())
        for array in (model.colors, model.uvs, model.texture):
            if array is not None:
                look.update(str(array.shape).encode() + np.ascontiguousarray(array).tobytes())
        _LOOKS[model] = look.hexdigest()[:16]
    return user_cache(kind) / f"{model.digest}-{_LOOKS[model]}-{version}.npz"

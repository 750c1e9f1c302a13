"""WebDataset shards of a data set in BOP layout: tar files with an image's files side by side.

The names are those of BOP's own shards: ``SSSSSS_IIIIII.rgb.jpg``, ``.depth.png``, ``.mask_visib.json`` and so on.
"""

from __future__ import annotations

import io
import json
import tarfile
from pathlib import Path
from typing import Any

from posekit.datasets.bop import BopDataset
from posekit.datasets.bop_writer import mask_to_rle
from posekit.io.files import write_bytes_atomic


def write_shards(root: Path, split: str, images: int) -> list[Path]:
    """``shards/SPLIT-000000.tar`` and so on with ``images`` in each but the last. Returns their paths."""
    folder = root / "shards"
    folder.mkdir(exist_ok=True)
    data = BopDataset(root, split, targets=None)
    tables = {scene: _tables(root / split / f"{scene:06d}") for scene in data.scenes()}
    numbers, paths = data.images(), []
    for k, start in enumerate(range(0, len(numbers), images)):
        buffer = io.BytesIO()
        with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as tar:
            for scene, image in numbers[start : start + images]:
                _add_image(tar, data, tables[scene], scene, image)
        paths.append(folder / f"{split}-{k:06d}.tar")
        write_bytes_atomic(paths[-1], buffer.getvalue())
    return paths


def _tables(folder: Path) -> dict[str, Any]:
    names = {"camera": "scene_camera", "gt": "scene_gt", "gt_info": "scene_gt_info"}
    return {key: json.loads((folder / f"{name}.json").read_text(encoding="utf-8")) for key, name in names.items()}


def _add_image(tar: tarfile.TarFile, data: BopDataset, tables: dict[str, Any], scene: int, image: int) -> None:
    key = f"{scene:06d}_{image:06d}"
    picture = data.image_path(scene, image)
    _add(tar, f"{key}.rgb{picture.suffix}", picture.read_bytes())
    depth = picture.parent.parent / "depth" / f"{image:06d}.png"
    if depth.is_file():
        _add(tar, f"{key}.depth.png", depth.read_bytes())
    for name, table in tables.items():
        _add(tar, f"{key}.{name}.json", json.dumps(table[str(image)]).encode())
    masks = {str(i.index): mask_to_rle(i.mask()) for i in data.instances(scene, image, every=True)}
    _add(tar, f"{key}.mask_visib.json", json.dumps(masks).encode())


def _add(tar: tarfile.TarFile, name: str, data: bytes) -> None:
    """A file without date and owner, so that the same data set gives the same shard."""
    info = tarfile.TarInfo(name)
    info.size = len(data)
    tar.addfile(info, io.BytesIO(data))

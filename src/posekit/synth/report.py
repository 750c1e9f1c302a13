"""A data set at a glance: a contact sheet and statistics."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from posekit.datasets.bop import BopDataset, Instance
from posekit.io.files import write_bytes_atomic, write_text_atomic
from posekit.visualise import draw

TILES, TILE = 24, (320, 240)  # of the contact sheet
PERCENTILES = (0, 5, 25, 50, 75, 95, 100)


def write_report(root: Path, split: str) -> None:
    """``contact_sheet.jpg`` and ``statistics.json`` in ``root``."""
    data = BopDataset(root, split, targets=None)
    write_text_atomic(root / "statistics.json", json.dumps(statistics(data), indent=1) + "\n")
    sheet = cv2.cvtColor(contact_sheet(data), cv2.COLOR_RGB2BGR)
    _, jpeg = cv2.imencode(".jpg", sheet, [cv2.IMWRITE_JPEG_QUALITY, 80])
    write_bytes_atomic(root / "contact_sheet.jpg", jpeg.tobytes())


def contact_sheet(data: BopDataset) -> draw.Image:
    """Images from the whole data set; every second one with the outlines of what is annotated."""
    numbers = data.images()
    chosen = [numbers[int(k)] for k in np.linspace(0, len(numbers) - 1, min(TILES, len(numbers)))]
    tiles = []
    for k, (scene, image) in enumerate(chosen):
        picture = data.view(scene, image).image
        for instance in data.instances(scene, image, every=True) if k % 2 else ():
            picture = draw.contour(picture, instance.mask())
        tiles.append(draw.fit(picture, TILE))
    return draw.grid(tiles, captions=[f"{scene}/{image}" for scene, image in chosen])


def statistics(data: BopDataset) -> dict[str, Any]:
    """Percentiles of distances, visibility, box sizes and viewing directions, and counts."""
    found = [i for scene, image in data.images() for i in data.instances(scene, image, every=True)]
    per_image = Counter((i.scene, i.image) for i in found)
    views = [_view_direction(i) for i in found]
    boxes = [i.box_visib for i in found if i.box_visib is not None]
    return {
        "images": len(data.images()),
        "instances": len(found),
        "instances_by_object": dict(sorted(Counter(i.obj_id for i in found).items())),
        "instances_in_an_image": dict(sorted(Counter(per_image[n] for n in data.images()).items())),
        "percentiles": list(PERCENTILES),
        "distance_m": _percentiles([float(i.T_cam_obj.t[2]) for i in found]),
        "visib_fract": _percentiles([i.visib_fract for i in found]),
        "box_width_px": _percentiles([b[2] - b[0] for b in boxes]),
        "box_height_px": _percentiles([b[3] - b[1] for b in boxes]),
        "seen_from_azimuth_deg": _histogram([a for a, _ in views], (-180, 180)),
        "seen_from_elevation_deg": _histogram([e for _, e in views], (-90, 90)),
    }


def _view_direction(instance: Instance) -> tuple[float, float]:
    """Azimuth and elevation (degrees) of the camera in the object's frame."""
    x, y, z = instance.T_cam_obj.inverse().t
    return float(np.rad2deg(np.arctan2(y, x))), float(np.rad2deg(np.arctan2(z, np.hypot(x, y))))


def _percentiles(values: Sequence[float]) -> list[float]:
    return [round(float(v), 4) for v in np.percentile(values, PERCENTILES)] if values else []


def _histogram(values: Sequence[float], limits: tuple[float, float]) -> dict[str, int]:
    """Counts in twelve equal bins, by their lower limits."""
    counts, edges = np.histogram(values, bins=12, range=limits)
    return {f"{edge:g}": int(n) for edge, n in zip(edges, counts, strict=False)}

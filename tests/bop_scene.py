"""A small data set in BOP layout, rendered on the spot: two objects, some pictures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image

from objects import bracket, cuboid
from posekit.camera import Camera
from posekit.geometry import Pose, random_rotation
from posekit.mesh.model import ObjectModel
from posekit.render import Renderer
from posekit.synth.example import ply

CAMERA = Camera(200.0, 201.0, 79.0, 61.0, 160, 120)


def brick() -> ObjectModel:
    """A box that looks the same after half a turn about z."""
    vertices, faces = cuboid((-0.03, -0.02, -0.04), (0.03, 0.02, 0.04), cells=3)
    return ObjectModel.from_arrays(vertices, faces, name="brick", colors=np.full((len(vertices), 3), 180, np.uint8))


def put(path: Path, data: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(data))


def write_scene(root: Path, images: int = 3, *, masks: bool = True, depth: bool = False, scene: int = 2) -> Path:
    """Objects 1 (bracket) and 2 (brick, half-turn symmetry) beside each other in each picture of one scene."""
    models = {1: bracket(), 2: brick()}
    (root / "models").mkdir(parents=True, exist_ok=True)
    info = {}
    for obj_id, model in models.items():
        (root / "models" / f"obj_{obj_id:06d}.ply").write_text(_millimetres(model))
        info[str(obj_id)] = {"diameter": 1000 * model.diameter}
    info["2"]["symmetries_discrete"] = [np.diag([-1.0, -1, 1, 1]).ravel().tolist()]
    put(root / "models" / "models_info.json", info)
    folder = root / "test" / f"{scene:06d}"
    for name in ("rgb", *(["mask_visib"] if masks else []), *(["depth"] if depth else [])):
        (folder / name).mkdir(parents=True)
    renderer, rng = Renderer(), np.random.default_rng(scene)
    truth, about, cameras = {}, {}, {}
    for image in range(images):
        poses = {o: Pose(random_rotation(rng), [0.09 * (-1) ** o, 0.01 * image, 0.45 + 0.05 * o]) for o in models}
        views = {o: renderer.render(models[o], [pose], CAMERA)[0] for o, pose in poses.items()}
        far = {o: np.where(v.depth > 0, v.depth, np.inf) for o, v in views.items()}  # type: ignore[operator]
        nearest = np.min(list(far.values()), axis=0)
        pixels = np.full((120, 160, 3), 90, np.uint8)
        entries = []
        for index, (o, view) in enumerate(views.items()):
            seen = np.isfinite(far[o]) & (far[o] <= nearest)
            pixels[seen] = view.image[seen]
            if masks:
                Image.fromarray(seen.astype(np.uint8) * 255).save(folder / f"mask_visib/{image:06d}_{index:06d}.png")
            entries.append(_info(np.isfinite(far[o]), seen))
        Image.fromarray(pixels).save(folder / f"rgb/{image:06d}.png")
        if depth:
            raw = np.where(np.isfinite(nearest), np.rint(nearest * 10000), 0).astype(np.uint16)
            Image.fromarray(raw).save(folder / f"depth/{image:06d}.png")
        truth[str(image)] = [bop_pose(o, pose) for o, pose in poses.items()]
        about[str(image)] = entries
        cameras[str(image)] = {"cam_K": CAMERA.K.ravel().tolist(), "depth_scale": 0.1}
    put(folder / "scene_gt.json", truth)
    put(folder / "scene_camera.json", cameras)
    if masks:
        put(folder / "scene_gt_info.json", about)
    return root


def bop_pose(obj_id: int, pose: Pose) -> dict[str, object]:
    return {"obj_id": obj_id, "cam_R_m2c": pose.R.ravel().tolist(), "cam_t_m2c": (1000 * pose.t).tolist()}


def _info(whole: np.ndarray, seen: np.ndarray) -> dict[str, object]:
    def box(mask: np.ndarray) -> list[int]:
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        if not rows.size:
            return [-1] * 4
        return [int(v) for v in (columns[0], rows[0], columns[-1] - columns[0], rows[-1] - rows[0])]

    return {"bbox_obj": box(whole), "bbox_visib": box(seen), "visib_fract": float(seen.sum() / whole.sum())}


def _millimetres(model: ObjectModel) -> str:
    scaled = ObjectModel.from_arrays(model.vertices * 1000, model.faces, name=model.name, colors=model.colors)
    return ply(scaled)

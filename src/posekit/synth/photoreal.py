"""Path-traced rooms, where the paper used Unreal Engine 4: objects dropped onto a table, with Mitsuba 3.

The world has z up and the table's top at z = 0. Masks come from posekit's own renderer, as those of every other kind;
the depth of what is not an object is Mitsuba's.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.datasets.bop_writer import Picture
from posekit.errors import ConfigError, InputError
from posekit.geometry import Pose, random_rotation, so3_exp
from posekit.mesh.model import ObjectModel
from posekit.render import Light, Renderer
from posekit.synth.backdrops import Backdrops, add_noise
from posekit.synth.draw_objects import Placed, draw_objects
from posekit.synth.plan import SynthConfig
from posekit.synth.procedural import noise_image, random_colour

OBJECTS = (3, 8)  # on a table, at most as many as there are
LIBLLVM = (20, 19, 18, 17, 16)  # versions that work; 15 does not
DEPTH_OF_PATHS = 6
MI_CAM = np.diag([-1.0, -1.0, 1.0, 1.0])  # Mitsuba's camera looks along z with x left and y up

Array = NDArray[np.float64]
Rng = np.random.Generator


# --- Mitsuba ----------------------------------------------------------------------------------------------------


def load_mitsuba(variant: str) -> Any:
    """The mitsuba module with a variant chosen. Raises ConfigError where it, or its LLVM, is missing.

    "auto": LLVM where a library for it is found, else scalar, which runs everywhere and takes about 2.5 times as long.
    """
    try:
        import mitsuba as mi
    except ImportError as error:
        raise ConfigError("--kind photoreal needs the extra: pip install 'posekit[photoreal]'.") from error
    chosen = variant
    if variant == "auto":
        chosen = "llvm_ad_rgb" if find_llvm() else "scalar_rgb"
    if chosen not in mi.variants():
        raise ConfigError(f"--variant {variant}: this Mitsuba has {', '.join(mi.variants())}.")
    if chosen.startswith("llvm"):
        library = find_llvm()
        if library is None:
            raise ConfigError(
                f"--variant {chosen} needs LLVM {LIBLLVM[-1]} or newer: on Debian apt-get install libllvm19, or name "
                "the library in DRJIT_LIBLLVM_PATH. Or pass --variant scalar_rgb, which is slower."
            )
        os.environ["DRJIT_LIBLLVM_PATH"] = library
    mi.set_variant(chosen)
    mi.set_log_level(mi.LogLevel.Error)
    if chosen.startswith("llvm"):
        import drjit as dr

        dr.set_thread_count(1)  # sums in one order, so that the same seed gives the same pixels; see --workers
    return mi


def find_llvm() -> str | None:
    """A shared library of LLVM that Dr.Jit can work with: DRJIT_LIBLLVM_PATH, else the system's."""
    given = os.environ.get("DRJIT_LIBLLVM_PATH")
    if given:
        return given
    folders = [*Path("/usr/lib").glob("*-linux-gnu"), Path("/usr/lib64"), Path("/usr/local/lib")]
    for version in LIBLLVM:
        for folder in (*folders, Path(f"/usr/lib/llvm-{version}/lib")):
            for name in (f"libLLVM.so.{version}.*", f"libLLVM-{version}.so*"):
                found = sorted(folder.glob(name))
                if found:
                    return str(found[0])
    return None


# --- what stands on the table -----------------------------------------------------------------------------------


def drop(models: Sequence[ObjectModel], rng: Rng, spread: float) -> list[Pose]:
    """``T_world_obj`` of objects that were let fall onto the plane z = 0 and have come to rest, by pybullet with their
    convex hulls. Raises ConfigError where pybullet is missing."""
    try:
        import pybullet
    except ImportError as error:
        raise ConfigError("--kind photoreal needs the extra: pip install 'posekit[photoreal]'.") from error
    world = pybullet.connect(pybullet.DIRECT)
    try:
        pybullet.setGravity(0, 0, -9.81, physicsClientId=world)
        ground = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=world)
        pybullet.createMultiBody(0, ground, physicsClientId=world)
        bodies, height = [], 0.0
        for model in models:
            height += 0.6 * model.diameter
            bodies.append(_body(pybullet, world, model, rng, spread, height))
            height += 0.3 * model.diameter
        for _ in range(960):  # four seconds
            pybullet.stepSimulation(physicsClientId=world)
        return [_rest(pybullet, world, body, model) for body, model in zip(bodies, models, strict=True)]
    finally:
        pybullet.disconnect(world)


def _body(pybullet: Any, world: int, model: ObjectModel, rng: Rng, spread: float, height: float) -> int:
    """An object in the air; its body's frame is ``ctr``."""
    hull = (model.hull_ctr).tolist()
    shape = pybullet.createCollisionShape(pybullet.GEOM_MESH, vertices=hull, physicsClientId=world)
    x, y, z, w = np.roll(Pose.rotation(random_rotation(rng)).quat_wxyz, -1)
    place = [*(rng.uniform(-1, 1, size=2) * spread), height]
    body = pybullet.createMultiBody(0.3, shape, -1, place, [x, y, z, w], physicsClientId=world)
    pybullet.changeDynamics(body, -1, lateralFriction=0.8, rollingFriction=0.002, spinningFriction=0.002,
                            linearDamping=0.05, angularDamping=0.15, physicsClientId=world)  # fmt: skip
    return int(body)


def _rest(pybullet: Any, world: int, body: int, model: ObjectModel) -> Pose:
    place, (x, y, z, w) = pybullet.getBasePositionAndOrientation(body, physicsClientId=world)
    R = np.array(pybullet.getMatrixFromQuaternion([x, y, z, w])).reshape(3, 3)
    pose = Pose.from_matrix(np.column_stack([R, place])) @ model.T_ctr_obj
    sunk = float(pose.apply(model.hull_vertices)[:, 2].min())
    return Pose(pose.R, pose.t - [0.0, 0.0, min(sunk, 0.0)])  # solvers let bodies sink in by a fraction of a mm


# --- rooms ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Room:
    """objects: (obj_id, model, T_world_obj). unit: their median diameter, metres. scene: Mitsuba's description of all
    but the camera."""

    objects: list[tuple[int, ObjectModel, Pose]]
    unit: float
    scene: dict[str, Any]


class Photoreal:
    """Each block is a room with `SynthConfig.views` views."""

    def __init__(self, config: SynthConfig, models: Mapping[int, ObjectModel], renderer: Renderer) -> None:
        self.config, self.models, self.renderer = config, sorted(models.items()), renderer
        self.mi = load_mitsuba(config.variant)
        self.backdrops = Backdrops(config.backgrounds, config.seed)
        self.environments = _environments(config.hdri)
        self.meshes = {obj_id: _mesh_data(model) for obj_id, model in self.models}

    def block(self, number: int, places: Sequence[int]) -> Iterator[tuple[int, Picture]]:
        """(place, picture) for each place: views of room ``number``, path-traced."""
        room = self._room(np.random.default_rng([self.config.seed, 0, number]))
        scene = self.mi.load_dict(room.scene)
        for place in places:
            yield place, self._view(scene, room, np.random.default_rng([self.config.seed, 1, number, place]))

    # --- a room ---

    def _room(self, rng: Rng) -> Room:
        count = min(len(self.models), int(rng.integers(OBJECTS[0], OBJECTS[1] + 1)))
        chosen = [self.models[int(k)] for k in rng.choice(len(self.models), size=count, replace=False)]
        unit = float(np.median([model.diameter for _, model in chosen]))
        poses = drop([model for _, model in chosen], rng, spread=unit * rng.uniform(0.4, 1.3))
        kept = [(obj_id, model, pose) for (obj_id, model), pose in zip(chosen, poses, strict=True)
                if np.linalg.norm(pose.t[:2]) < 6 * unit]  # fmt: skip
        scene: dict[str, Any] = {"type": "scene"}
        for k, (obj_id, _, pose) in enumerate(kept):
            scene[f"object{k}"] = self._mesh(obj_id, pose, rng)
        others = self._surfaces(unit, rng) | self._lights(unit, rng)
        scene |= {name: self.mi.load_dict(what) for name, what in others.items()}  # from one dict their order is random
        return Room(kept, unit, scene)

    def _mesh(self, obj_id: int, pose: Pose, rng: Rng) -> Any:
        """One object with its own colours on a surface between paper and varnish."""
        mi, (name, vertices, normals, faces, uvs, colours, texture) = self.mi, self.meshes[obj_id]
        colour: dict[str, Any] = {"type": "rgb", "value": [0.3, 0.3, 0.3]}
        if texture is not None:
            colour = {"type": "bitmap", "bitmap": mi.Bitmap(np.array(texture)), "raw": False}
        elif colours is not None:
            colour = {"type": "mesh_attribute", "name": "vertex_color"}
        properties = mi.Properties()
        properties["mesh_bsdf"] = mi.load_dict(_surface(colour, rng))
        mesh = mi.Mesh(name, len(vertices), len(faces), has_vertex_normals=True, has_vertex_texcoords=uvs is not None,
                       props=properties)  # fmt: skip
        if colours is not None and texture is None:
            mesh.add_attribute("vertex_color", 3, colours.ravel())
        values = mi.traverse(mesh)
        values["vertex_positions"] = pose.apply(vertices).astype(np.float32).ravel()
        values["vertex_normals"] = (normals @ pose.R.T).astype(np.float32).ravel()
        values["faces"] = faces.astype(np.uint32).ravel()
        if uvs is not None:
            values["vertex_texcoords"] = uvs.ravel()
        values.update()
        return mesh

    def _surfaces(self, unit: float, rng: Rng) -> dict[str, Any]:
        """The table's top, and three or four walls round it."""
        T = self.mi.ScalarTransform4f
        half = unit * rng.uniform(5, 9)
        surfaces = {"table": {"type": "rectangle", "to_world": T().scale([half, half, 1]),
                              "bsdf": self._material(rng)}}  # fmt: skip
        far, drop_, top = unit * rng.uniform(9, 16), unit * rng.uniform(2, 6), unit * rng.uniform(8, 16)
        surfaces["floor"] = {"type": "rectangle", "bsdf": self._material(rng),
                             "to_world": T().translate([0, 0, -drop_]).scale([far, far, 1])}  # fmt: skip
        wall = self._material(rng)
        for k in range(int(rng.integers(2, 5))):
            place = T().rotate([0, 0, 1], 90 * k).translate([far, 0, (top - drop_) / 2]).rotate([0, 1, 0], -90)
            surfaces[f"wall{k}"] = {"type": "rectangle", "bsdf": wall if rng.random() < 0.7 else self._material(rng),
                                    "to_world": place.scale([(top + drop_) / 2, far, 1])}  # fmt: skip
        return surfaces

    def _material(self, rng: Rng) -> dict[str, Any]:
        """Wood, stone, cloth or paint by chance; with photographs also one of these."""
        from_photo = bool(self.backdrops.paths) and rng.random() < 0.25
        picture = self.backdrops.draw(rng, (512, 512)) if from_photo else _grain(rng)
        repeat = float(rng.uniform(0.8, 3.0))
        bitmap = {"type": "bitmap", "bitmap": self.mi.Bitmap(np.array(picture)), "raw": False, "wrap_mode": "mirror",
                  "to_uv": self.mi.ScalarTransform3f().scale([repeat, repeat])}  # fmt: skip
        return _surface(bitmap, rng)

    def _lights(self, unit: float, rng: Rng) -> dict[str, Any]:
        """The environment, and one to three lamps above the table."""
        T = self.mi.ScalarTransform4f
        turn = T().rotate([0, 0, 1], float(rng.uniform(0, 360))).rotate([1, 0, 0], 90)  # its up is y
        if self.environments:
            path = self.environments[int(rng.integers(len(self.environments)))]
            bitmap = self.mi.Bitmap(str(path))
        else:
            bitmap = self.mi.Bitmap(sky(rng))
        lights = {"sky": {"type": "envmap", "bitmap": bitmap, "to_world": turn, "scale": float(rng.uniform(0.3, 1.2))}}
        for k in range(int(rng.integers(1, 4))):
            side = unit * np.exp(rng.uniform(np.log(0.3), np.log(2.5)))
            angle, height = rng.uniform(0, 2 * np.pi), unit * rng.uniform(5, 8)
            reach = unit * rng.uniform(0, 6)
            place = [float(v) for v in (reach * np.cos(angle), reach * np.sin(angle), height)]
            power = rng.uniform(0.4, 1.6) * (height**2 + reach**2) / side**2
            tint = np.array([1.0, rng.uniform(0.75, 1.0), rng.uniform(0.55, 1.0)])
            lights[f"lamp{k}"] = {
                "type": "rectangle",
                "to_world": T().look_at(origin=place, target=[0, 0, 0], up=[0, 1, 0.1]).scale([float(side)] * 2 + [1]),
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": (power * tint).tolist()}},
            }
        return lights

    # --- a view ---

    def _view(self, scene: Any, room: Room, rng: Rng) -> Picture:
        camera = Camera.from_fov(float(np.deg2rad(rng.uniform(32, 58))), *self.config.size)
        T_cam_world, distance = _camera_pose(room, rng)
        linear = self._trace(scene, camera, T_cam_world, distance, room.unit, rng)
        image = develop(linear, rng)
        ground = self._depth(scene, camera, T_cam_world)
        objects = [Placed(obj_id, model, T_cam_world @ pose) for obj_id, model, pose in room.objects]
        blank = np.zeros_like(image)
        drawn = draw_objects(self.renderer, objects, camera, Light.flat(), blank)
        depth = np.where(drawn.depth > 0, drawn.depth, ground).astype(np.float32)
        return Picture(image, camera, drawn.annotations, depth, T_cam_world)

    def _trace(self, scene: Any, camera: Camera, T_cam_world: Pose, focus: float, unit: float, rng: Rng) -> Array:
        """Linear colours (H, W, 3), denoised."""
        mi, aperture = self.mi, float(unit * rng.uniform(0.002, 0.03))
        sensor = self._sensor(camera, T_cam_world, {
            "type": "thinlens", "focus_distance": float(focus), "aperture_radius": aperture,
        })  # fmt: skip
        integrator = mi.load_dict({
            "type": "aov", "aovs": "albedo:albedo,normal:sh_normal",
            "image": {"type": "path", "max_depth": DEPTH_OF_PATHS},
        })  # fmt: skip
        seed = int(rng.integers(2**31))
        picture = np.asarray(mi.render(scene, sensor=sensor, integrator=integrator, spp=self.config.samples, seed=seed))
        return denoise(picture)

    def _sensor(self, camera: Camera, T_cam_world: Pose, lens: dict[str, Any]) -> Any:
        fov = float(np.rad2deg(2 * np.arctan(0.5 * camera.width / camera.fx)))
        to_world = self.mi.ScalarTransform4f(T_cam_world.inverse().matrix @ MI_CAM)
        return self.mi.load_dict({
            **lens, "fov": fov, "fov_axis": "x", "to_world": to_world, "near_clip": 1e-3, "far_clip": 1e3,
            "film": {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"},
                     "pixel_format": "rgb", "component_format": "float32"},
        })  # fmt: skip

    def _depth(self, scene: Any, camera: Camera, T_cam_world: Pose) -> NDArray[np.float32]:
        """Depth (H, W), metres, at the pixels' centres; 0 where there is only sky. (By Mitsuba's rays, not OpenGL.)"""
        mi, T_world_cam = self.mi, T_cam_world.inverse()
        rays = camera.backproject(camera.pixel_grid()).reshape(-1, 3)
        directions = (rays @ T_world_cam.R.T).astype(np.float32)
        if not mi.variant().startswith("scalar"):
            found = scene.ray_intersect(mi.Ray3f(mi.Point3f(*T_world_cam.t.tolist()), mi.Vector3f(directions.T)))
            t = np.asarray(found.t)
        else:
            origin = mi.Point3f(T_world_cam.t.tolist())
            t = np.array([scene.ray_intersect(mi.Ray3f(origin, mi.Vector3f(d.tolist()))).t for d in directions])
        return np.where(np.isfinite(t), t, 0).astype(np.float32).reshape(camera.height, camera.width)


def _mesh_data(model: ObjectModel) -> tuple[Any, ...]:
    """Arrays as Mitsuba takes them; colours linear."""
    colours = None if model.colors is None else _linear(model.colors).astype(np.float32)
    uvs = None
    if model.uvs is not None:
        uvs = (model.uvs * [1.0, -1.0] + [0.0, 1.0]).astype(np.float32)  # v down
    return model.name, model.vertices.astype(np.float64), model.normals, model.faces, uvs, colours, model.texture


def _surface(colour: dict[str, Any], rng: Rng) -> dict[str, Any]:
    return {"type": "twosided", "bsdf": {
        "type": "principled", "base_color": colour, "roughness": float(rng.uniform(0.25, 0.95)),
        "specular": float(rng.uniform(0.1, 0.6)),
        "metallic": float(rng.uniform(0.3, 0.8)) if rng.random() < 0.06 else 0.0,
    }}  # fmt: skip


def _linear(colours: NDArray[np.uint8]) -> Array:
    x = colours.astype(np.float64) / 255
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def _grain(rng: Rng, size: int = 512) -> NDArray[np.uint8]:
    """Wood, planks, tiles, stone or plain paint, uint8 (size, size, 3)."""
    base = random_colour(rng) * 0.3 + np.array([125, 115, 105]) * 0.7
    fine = noise_image(rng, (size, size), 1)[..., 0] - 0.5
    kind = rng.choice(["wood", "tiles", "stone", "paint"], p=[0.35, 0.2, 0.2, 0.25])
    u, v = np.meshgrid(np.linspace(0, 1, size), np.linspace(0, 1, size))
    if kind == "wood":
        rings = 0.5 + 0.5 * np.sin(2 * np.pi * (rng.uniform(5, 22) * u + 1.8 * fine))
        base = base * 0.4 + np.array([150, 105, 62]) * rng.uniform(0.5, 1.2) * 0.6
        boards = rng.uniform(0.8, 1.1, size=9)[(v * rng.integers(2, 8)).astype(int)]
        value = (1 + 0.3 * (rings - 0.5) + 0.2 * fine) * boards
    elif kind == "tiles":
        n = int(rng.integers(3, 9))
        joint = (np.abs(u * n % 1 - 0.5) > 0.47) | (np.abs(v * n % 1 - 0.5) > 0.47)
        shade = rng.uniform(0.75, 1.1, size=(n + 1, n + 1))[(v * n).astype(int), (u * n).astype(int)]
        value = np.where(joint, 0.55, shade) * (1 + 0.15 * fine)
    elif kind == "stone":
        value = 1 + 0.9 * fine + 0.25 * (np.abs(noise_image(rng, (size, size), 1)[..., 0] - 0.5) < 0.02)
    else:
        value = 1 + rng.uniform(0.02, 0.2) * fine
    speckle = 1 + rng.normal(size=(size, size)) * 0.025
    return np.asarray((base * (value * speckle)[..., None]).clip(0, 255).astype(np.uint8))


def sky(rng: Rng, height: int = 128) -> NDArray[np.float32]:
    """A procedural environment, linear (height, 2 * height, 3): a gradient, clouds or rooms' bright windows."""
    up = np.linspace(1, -1, height)[:, None, None]
    zenith, ground = _linear(random_colour(rng).astype(np.uint8)), _linear(random_colour(rng).astype(np.uint8))
    grey = rng.uniform(0.2, 0.8)
    zenith, ground = (0.25 * c + 0.75 * grey * s for c, s in ((zenith, 1.0), (ground, 0.5)))
    picture = ground + (zenith - ground) / (1 + np.exp(-6 * up)) + np.zeros((height, 2 * height, 3))
    picture *= 0.6 + 0.8 * noise_image(rng, (2 * height, height), 1)
    for _ in range(int(rng.integers(1, 5))):  # windows, lamps, the sun
        w, h = int(rng.integers(2, height // 3)), int(rng.integers(2, height // 3))
        x, y = int(rng.integers(0, 2 * height - w)), int(rng.integers(0, height // 2))
        tint = np.array([1.0, rng.uniform(0.85, 1), rng.uniform(0.7, 1.05)])
        picture[y : y + h, x : x + w] += rng.uniform(0.15, 0.6) * height**2 / (w * h) * 0.05 * tint
    return picture.astype(np.float32)


def _environments(folder: str) -> list[Path]:
    if not folder:
        return []
    found = sorted(p for p in Path(folder).glob("*") if p.suffix.lower() in (".exr", ".hdr"))
    if not found:
        raise InputError(f"the folder {folder} holds no .exr or .hdr environments.")
    return found


def _camera_pose(room: Room, rng: Rng) -> tuple[Pose, float]:
    """``T_cam_world`` and the distance of what is in focus: the camera looks at one of the objects, from above."""
    _, model, pose = room.objects[int(rng.integers(len(room.objects)))]
    target = pose.apply(model.center) + rng.normal(size=3) * 0.25 * room.unit
    distance = room.unit * np.exp(rng.uniform(np.log(2.8), np.log(5.5)))
    elevation, azimuth = np.deg2rad(rng.uniform(15, 75)), rng.uniform(0, 2 * np.pi)
    away = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    R = so3_exp([0, 0, rng.normal() * 0.08]) @ np.stack([right, np.cross(-away, right), -away])
    return Pose(R, np.array([0, 0, distance]) - R @ target), float(distance)


def denoise(picture: NDArray[np.float32]) -> Array:
    """Linear colours (H, W, 3) out of colours, albedo and normals (H, W, 9), by Open Image Denoise."""
    import mitsuba_oidn

    colour, albedo, normals = (np.ascontiguousarray(picture[..., k : k + 3], np.float32) for k in (0, 3, 6))
    result = mitsuba_oidn.denoise(colour, albedo=albedo.clip(0, 1), normal=normals, hdr=True)
    return np.asarray(result, dtype=np.float64)


def develop(linear: Array, rng: Rng) -> NDArray[np.uint8]:
    """Exposure, a filmic curve, sRGB, the sensor's noise, white balance: linear (H, W, 3) to uint8."""
    middle = float(np.exp(np.log(linear.mean(axis=-1) + 1e-4).mean()))
    x = linear * (rng.uniform(0.13, 0.24) / middle) * np.exp(rng.normal(size=3) * 0.04)
    x = x * (1 + x / 16) / (1 + x) * 1.25  # Reinhard's curve, white at four times the middle
    x = x.clip(0, 1)
    srgb = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-8) ** (1 / 2.4) - 0.055)
    image = (255 * srgb).astype(np.uint8)
    if rng.random() < 0.3:
        image = cv2.GaussianBlur(image, (0, 0), float(rng.uniform(0.4, 0.9)))
    return add_noise(image, float(rng.uniform(0.5, 5.0)), rng)

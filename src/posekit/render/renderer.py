"""Renderer: (model, poses, cameras) -> Views with image, mask, depth and object coordinates."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any
from weakref import WeakKeyDictionary

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.errors import RenderError
from posekit.geometry import Pose
from posekit.object_model import ObjectModel
from posekit.render import context
from posekit.view import View

SAMPLES = (0, 2, 4, 8)
_TARGETS = 4  # sizes of picture whose framebuffers are kept
_ANISOTROPY = 8.0


@dataclass(frozen=True)
class Light:
    """One distant light and an even one from everywhere: Blinn and Phong's model on the colours as stored.

    ambient, diffuse, specular: strengths; direction: (3,) towards the light, in the view's frame (the default
    comes from above and behind the camera); shininess: the highlight's exponent; colour: RGB, 1 = white.
    """

    ambient: float = 0.5
    direction: tuple[float, float, float] = (-0.3, -0.6, -0.75)
    diffuse: float = 0.6
    specular: float = 0.1
    shininess: float = 20.0
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        if not np.linalg.norm(self.direction) > 0:
            raise ValueError(f"Light: direction {self.direction} has no length")

    @classmethod
    def flat(cls) -> Light:
        """Colours as they are in the mesh."""
        return cls(ambient=1.0, diffuse=0.0, specular=0.0)


@dataclass(frozen=True)
class _Pass:
    """One drawing of a view: its values go to a framebuffer's attachments, in this order; none is the mask."""

    colour: bool = False
    coords: bool = False
    smooth: bool = False

    @property
    def only_coords(self) -> bool:
        return self.coords and not self.colour

    def defines(self) -> list[str]:
        if not (self.colour or self.coords):
            return ["MASK"]
        names = [name for name, wanted in (("COLOUR", self.colour), ("COORDS", self.coords)) if wanted]
        return [f"{name} {location}" for location, name in enumerate(names)]


class Renderer:
    """Draws batches of views of a mesh.

    samples: 0, 2, 4 or 8 colour samples a pixel (fewer where OpenGL offers fewer); they smooth the image only,
    whose edges fade to black: mask, depth and coords are always those of the pixel's centre.
    backend: "auto", "egl" or "osmesa". Threads may share a Renderer; they take turns.
    Raises RenderError where there is no usable OpenGL.
    """

    def __init__(self, samples: int = 0, backend: str = "auto") -> None:
        if samples not in SAMPLES:
            raise ValueError(f"Renderer: samples={samples}; use one of {SAMPLES}")
        self._backend = backend
        self._meshes: WeakKeyDictionary[ObjectModel, _Mesh] = WeakKeyDictionary()
        self._targets: OrderedDict[tuple[int, int], _Target] = OrderedDict()
        self._programs: dict[tuple[str, _Pass], moderngl.Program] = {}
        with context.current(backend) as current:
            self.samples = min(samples, current.gl.max_samples)
            limits = current.gl.info
            self._max_size = min(limits["GL_MAX_RENDERBUFFER_SIZE"], *limits["GL_MAX_VIEWPORT_DIMS"])

    def render(
        self,
        model: ObjectModel,
        poses: Sequence[Pose],
        cameras: Sequence[Camera] | Camera,
        *,
        light: Light | Sequence[Light] | None = Light(),
        rgb: bool = True,
        coords: bool = True,
    ) -> list[View]:
        """One View for each pose.

        poses: B times T_view_obj. cameras: B cameras of one size, or one for all. light: one for all, or B;
        None is ``Light.flat()``. Without ``rgb`` the images are black; without ``coords`` the views have
        neither coords nor depth (faster). A mesh outside the picture or behind the camera gives an empty mask.
        Raises ValueError where a pose is not finite, or where the numbers or sizes do not match;
        RenderError where the picture is larger than OpenGL can draw.
        """
        poses = list(poses)
        cameras = _repeated(cameras, len(poses), "cameras")
        lights = _repeated(Light.flat() if light is None else light, len(poses), "lights")
        if not poses:
            return []
        _check_poses(poses)
        width, height = self._check_size(cameras)
        with context.current(self._backend) as current:
            mesh = self._mesh(current.gl, model)
            target = self._target(current.gl, width, height)
            current.gl.enable_only(moderngl.DEPTH_TEST)
            return [
                self._view(current.gl, target, mesh, camera, mesh.draw(pose, camera, light_), rgb, coords)
                for pose, camera, light_ in zip(poses, cameras, lights, strict=True)
            ]

    def _view(
        self, gl: moderngl.Context, target: _Target, mesh: _Mesh, camera: Camera, draw: _Draw | None, rgb: bool,
        coords: bool,
    ) -> View:
        """Draw and read one view. Each is drawn at the framebuffer's origin: tiles of a large atlas would be

        less exact (interpolation in float32 window coordinates) and, on a CPU, slower.
        """
        smooth = rgb and self.samples > 0
        exact = _Pass(colour=rgb and not smooth, coords=coords)
        self._run(gl, target, exact, mesh, draw)
        depth = xyz = image = None
        if coords:
            geometry = target.read(exact, "f4")
            depth, xyz = geometry[..., 3].copy(), _three_channels(geometry)
        if exact.only_coords:
            mask = geometry[..., 3] > 0
        else:
            rgba = target.read(exact, "f1")
            mask, image = rgba[..., 3] > 0, _three_channels(rgba)
        if smooth:
            second = _Pass(colour=True, smooth=True)
            self._run(gl, target, second, mesh, draw)
            image = _three_channels(target.read(second, "f1"))
        if not rgb:
            image = np.zeros((camera.height, camera.width, 3), np.uint8)
        return View(image, camera, mask, depth, xyz)

    def _run(self, gl: moderngl.Context, target: _Target, pass_: _Pass, mesh: _Mesh, draw: _Draw | None) -> None:
        framebuffer = target.framebuffer(pass_)
        framebuffer.use()
        framebuffer.clear()
        if draw is None:
            return
        program = self._program(gl, mesh.surface if pass_.colour else "plain", pass_)
        for name in _Draw.__dataclass_fields__:
            if name in program.names:
                program.uniform(name).write(getattr(draw, name))
        if mesh.texture is not None:
            mesh.texture.use(0)
        mesh.vertex_array(gl, program).render()

    def _program(self, gl: moderngl.Context, surface: str, pass_: _Pass) -> moderngl.Program:
        key = surface, pass_
        if key not in self._programs:
            lines = [f"INTERPOLATION {'centroid' if pass_.smooth else ''}", *pass_.defines()]
            lines += {"texture": ["TEXTURED"], "colours": ["VERTEX_COLOURS"], "plain": []}[surface]
            head = "#version 330 core\n" + "".join(f"#define {line}\n" for line in lines)
            folder = files("posekit.render") / "shaders"
            self._programs[key] = gl.program(
                vertex_shader=head + (folder / "mesh.vert.glsl").read_text(),
                fragment_shader=head + (folder / "mesh.frag.glsl").read_text(),
            )
        return self._programs[key]

    def _mesh(self, gl: moderngl.Context, model: ObjectModel) -> _Mesh:
        mesh = self._meshes.get(model)
        if mesh is None:
            mesh = self._meshes[model] = _Mesh(gl, model)
        return mesh

    def _atlas(self, gl: moderngl.Context, width: int, height: int, tiles: int) -> _Atlas:
        """The framebuffers for that many tiles; the least recently used ones make room."""
        key = width, height, tiles
        if key not in self._atlases:
            while len(self._atlases) >= _ATLASES:
                self._atlases.popitem(last=False)
            self._atlases[key] = _Atlas(gl, width, height, tiles, self.samples)
        self._atlases.move_to_end(key)
        return self._atlases[key]

    def _check_size(self, cameras: list[Camera]) -> tuple[int, int]:
        sizes = {camera.size for camera in cameras}
        if len(sizes) > 1:
            raise ValueError(f"Renderer: the cameras of one batch have several sizes, {sorted(sizes)}; group them")
        width, height = sizes.pop()
        if max(width, height) > self._max_size:
            raise RenderError(
                f"a picture of {width}x{height} cannot be drawn: this OpenGL's limit is {self._max_size} pixels a "
                "side. Render a smaller one (Camera.resized)."
            )
        return width, height


@dataclass(frozen=True)
class _Draw:
    """One tile's shader inputs, as bytes. Their names are the shaders'."""

    clip_from_ctr: bytes
    z_row: bytes
    centre: bytes
    eye: bytes
    light_direction: bytes
    light_colour: bytes
    light_strength: bytes


class _Mesh:
    """A model's buffers and texture on the GPU, relative to its bounding-box centre."""

    def __init__(self, gl: moderngl.Context, model: ObjectModel) -> None:
        vertices = model.vertices.astype(np.float64) - model.center
        self.center = np.asarray(model.center, dtype=np.float64)
        self.radius = float(np.linalg.norm(vertices, axis=1).max())
        self._centre = _bytes(self.center)
        used, faces = _drawing_order(vertices, np.asarray(model.faces))
        self._indices = gl.buffer(faces.tobytes())
        self._attributes = {
            "position": (gl.buffer(_bytes(vertices[used])), "3f"),
            "normal": (gl.buffer(_bytes(model.normals[used])), "3f"),
        }
        self._arrays: dict[int, moderngl.VertexArray] = {}
        self.surface, self.texture = "plain", None
        if model.texture is not None and model.uvs is not None:
            self.surface, self.texture = "texture", _upload(gl, model.texture)
            self._attributes["uv"] = (gl.buffer(_bytes(model.uvs[used])), "2f")
        elif model.colors is not None:
            self.surface = "colours"
            rgbx = np.pad(np.asarray(model.colors, dtype=np.uint8)[used, :3], ((0, 0), (0, 1)))
            self._attributes["colour"] = (gl.buffer(rgbx.tobytes()), "3f1 1x1")

    def vertex_array(self, gl: moderngl.Context, program: moderngl.Program) -> moderngl.VertexArray:
        if program.glo not in self._arrays:
            content = [
                (buffer, layout, name) for name, (buffer, layout) in self._attributes.items() if name in program
            ]
            self._arrays[program.glo] = gl.vertex_array(program, content, self._indices)
        return self._arrays[program.glo]

    def draw(self, pose: Pose, camera: Camera, light: Light) -> _Draw | None:
        """The shaders' inputs; None where the whole mesh is behind the camera."""
        R, t = pose.R, pose.R @ self.center + pose.t  # T_view_ctr
        near = max(t[2] - 1.01 * self.radius, 1e-3 * self.radius)
        far = t[2] + 1.01 * self.radius
        if not far > near:
            return None
        view_from_ctr = np.eye(4)
        view_from_ctr[:3, :3], view_from_ctr[:3, 3] = R, t
        direction = np.asarray(light.direction) / np.linalg.norm(light.direction)
        return _Draw(
            clip_from_ctr=_bytes((camera.gl_projection(near, far) @ view_from_ctr).T),
            z_row=_bytes(view_from_ctr[2]),
            centre=self._centre,
            eye=_bytes(-R.T @ t),
            light_direction=_bytes([*(R.T @ direction), light.shininess]),
            light_colour=_bytes([*light.colour, light.ambient]),
            light_strength=_bytes([light.diffuse, light.specular]),
        )


class _Atlas:
    """Framebuffers for a column of equal tiles, so that each tile is one piece of what is read back."""

    def __init__(self, gl: moderngl.Context, width: int, height: int, tiles: int, samples: int) -> None:
        self.width, self.height = width, height
        self._gl = gl
        self._size = width, height * tiles
        self._samples = samples
        self._framebuffers: dict[_Pass, moderngl.Framebuffer] = {}
        self._attachments: dict[str, moderngl.Renderbuffer] = {}

    def framebuffer(self, pass_: _Pass) -> moderngl.Framebuffer:
        """The framebuffer that a pass draws into."""
        if pass_ not in self._framebuffers:
            names = [name for name, wanted in (("f1", not pass_.only_coords), ("f4", pass_.coords)) if wanted]
            samples = self._samples if pass_.smooth else 0
            attachments = [self._attachment(name, samples) for name in names]
            self._framebuffers[pass_] = self._gl.framebuffer(attachments, self._attachment("depth", samples))
        return self._framebuffers[pass_]

    def read(self, pass_: _Pass, tiles: int, dtype: str) -> NDArray[Any]:
        """What a pass has drawn: (tiles, H, W, 4), uint8 for "f1", float32 for "f4"."""
        source = self.framebuffer(pass_)
        if pass_.smooth:
            averaged = self.framebuffer(_Pass(colour=True))
            self._gl.copy_framebuffer(averaged, source)
            source = averaged
        out = np.empty((tiles, self.height, self.width, 4), np.uint8 if dtype == "f1" else np.float32)
        source.read_into(
            out,
            viewport=(0, 0, self.width, self.height * tiles),
            components=4,
            attachment=1 if dtype == "f4" and pass_.colour else 0,
            alignment=1,
            dtype=dtype,
        )
        return out

    def _attachment(self, name: str, samples: int) -> moderngl.Renderbuffer:
        key = f"{name} {samples}"
        if key not in self._attachments:
            if name == "depth":
                self._attachments[key] = self._gl.depth_renderbuffer(self._size, samples=samples)
            else:
                self._attachments[key] = self._gl.renderbuffer(self._size, 4, samples=samples, dtype=name)
        return self._attachments[key]


def _drawing_order(vertices: NDArray[np.float64], faces: NDArray[Any]) -> tuple[NDArray[np.intp], NDArray[np.int32]]:
    """Which vertices to draw, in which order, and the faces (F, 3) that index them.

    Neighbouring faces follow each other (Morton's curve through their centres), so that a vertex is shaded once
    or twice, not six times: a quarter faster on scanned meshes.
    """
    middles = vertices[faces].mean(axis=1)
    span = max(float(np.ptp(middles, axis=0).max()), 1e-12)
    cells = ((middles - middles.min(axis=0)) * (1023 / span)).astype(np.int64)
    bits = (cells[:, None, :] >> np.arange(10)[None, :, None]) & 1
    code = (bits.reshape(len(faces), 30) << np.arange(30)).sum(axis=1)
    corners = faces[np.argsort(code, kind="stable")].ravel()
    _, first = np.unique(corners, return_index=True)
    used = corners[np.sort(first)].astype(np.intp)
    index = np.zeros(len(vertices), np.int32)
    index[used] = np.arange(len(used))
    return used, index[corners].reshape(-1, 3)


def _upload(gl: moderngl.Context, texture: NDArray[np.uint8]) -> moderngl.Texture:
    """A mipmapped texture. Its rows go up as v does: the picture's last row first."""
    limit = gl.info["GL_MAX_TEXTURE_SIZE"]
    height, width = texture.shape[:2]
    if max(width, height) > limit:
        scale = limit / max(width, height)
        size = max(1, int(width * scale)), max(1, int(height * scale))
        texture = np.asarray(cv2.resize(texture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    rows = np.ascontiguousarray(texture[::-1, :, :3])
    out = gl.texture((rows.shape[1], rows.shape[0]), 3, rows.tobytes(), alignment=1)
    out.build_mipmaps()
    out.filter = moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR
    if gl.max_anisotropy > 1:
        out.anisotropy = min(_ANISOTROPY, gl.max_anisotropy)
    return out


def _views(
    cameras: list[Camera], images: NDArray[np.uint8] | None, geometry: NDArray[np.float32] | None
) -> list[View]:
    views = []
    for i, camera in enumerate(cameras):
        coords = depth = None
        if geometry is not None:
            depth = np.ascontiguousarray(geometry[i, ..., 3])
            coords = np.asarray(cv2.cvtColor(geometry[i], cv2.COLOR_RGBA2RGB), dtype=np.float32)
        if images is not None:
            mask = images[i, ..., 3] > 0
            image = np.asarray(cv2.cvtColor(images[i], cv2.COLOR_RGBA2RGB), dtype=np.uint8)
        elif depth is not None:
            mask = depth > 0
            image = np.zeros((camera.height, camera.width, 3), np.uint8)
        views.append(View(image, camera, mask, depth, coords))
    return views


def _repeated(values: Any, n: int, what: str) -> list[Any]:
    """One value n times, or n values as they are."""
    if isinstance(values, (Camera, Light)):
        return [values] * n
    values = list(values)
    if len(values) != n:
        raise ValueError(f"Renderer: {len(values)} {what} for {n} poses; give one, or one for each pose")
    return values


def _check_poses(poses: list[Pose]) -> None:
    for i, pose in enumerate(poses):
        if not (np.isfinite(pose.R).all() and np.isfinite(pose.t).all()):
            raise ValueError(f"Renderer: pose {i} of {len(poses)} is not finite:\n{pose.matrix}")


def _bytes(values: Any) -> bytes:
    return np.asarray(values, dtype=np.float32).tobytes()


def _next_power_of_two(n: int) -> int:
    return 1 << (n - 1).bit_length()

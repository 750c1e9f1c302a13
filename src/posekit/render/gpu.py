"""What lives in OpenGL: programs, meshes with their textures, and framebuffers."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import cv2
import moderngl
import numpy as np
from numpy.typing import ArrayLike, NDArray

from posekit.camera import Camera
from posekit.geometry import Pose
from posekit.mesh.model import ObjectModel
from posekit.mesh.processing import coincident
from posekit.render.light import Light

_ANISOTROPY = 8.0
_SURFACES = {"texture": "TEXTURED", "colours": "VERTEX_COLOURS", "plain": "PLAIN"}


@dataclass(frozen=True)
class Pass:
    """One drawing of a view, and so one framebuffer.

    colour: RGBA with the mask as alpha; coords: object coordinates and depth; neither: the mask alone;
    smooth: several samples a pixel.
    """

    colour: bool = False
    coords: bool = False
    smooth: bool = False

    @property
    def attachments(self) -> list[tuple[str, str]]:
        """(the shader's name, moderngl's type of number) of what is drawn, by location."""
        out = [("COLOUR", "f1")] if self.colour else []
        out += [("COORDS", "f4")] if self.coords else []
        return out or [("MASK", "f1")]


@dataclass(frozen=True)
class Draw:
    """One view's shader inputs, as bytes. Their names are the shaders'. outside: the camera sees the whole mesh from
    outside its bounding sphere, and nothing of it is cut off."""

    clip_from_ctr: bytes
    z_row: bytes
    centre: bytes
    eye: bytes
    light_direction: bytes
    light_colour: bytes
    light_strength: bytes
    outside: bool


class Program:
    """The shaders compiled for one pass and one kind of surface ("texture", "colours", "plain")."""

    def __init__(self, gl: moderngl.Context, pass_: Pass, surface: str) -> None:
        lines = [f"INTERPOLATION {'centroid' if pass_.smooth else ''}", _SURFACES[surface]]
        lines += [f"{name} {location}" for location, (name, _) in enumerate(pass_.attachments)]
        head = "#version 330 core\n" + "".join(f"#define {line}\n" for line in lines)
        folder = files("posekit.render") / "shaders"
        self.gl_program = gl.program(
            vertex_shader=head + (folder / "mesh.vert.glsl").read_text(encoding="utf-8"),
            fragment_shader=head + (folder / "mesh.frag.glsl").read_text(encoding="utf-8"),
        )
        members = {name: self.gl_program[name] for name in self.gl_program}
        self._uniforms = {name: member for name, member in members.items() if name in Draw.__dataclass_fields__}

    def write(self, draw: Draw) -> None:
        """Set the program's uniforms to a draw call's values."""
        for name, uniform in self._uniforms.items():
            uniform.write(getattr(draw, name))  # type: ignore[union-attr]


class Mesh:
    """A model's buffers and texture, relative to its bounding-box centre.

    front: which way round the faces go that can be seen from outside ("ccw" or "cw"), where the surface is closed and
    all of them go the same way round; None where it is not. culled: whether the others may be left out (a third of
    the time on a CPU); whoever sets it has looked that no picture changes. radius: of the bounding sphere.
    """

    def __init__(self, gl: moderngl.Context, model: ObjectModel) -> None:
        self._centre = np.asarray(model.center, dtype=np.float64)
        vertices = model.vertices.astype(np.float64) - self._centre
        self.radius = float(np.linalg.norm(vertices, axis=1).max())
        self.front, self.culled = _front(vertices, np.asarray(model.faces)), False
        used, faces = _drawing_order(vertices, np.asarray(model.faces))
        self.T_ctr_obj = model.T_ctr_obj
        self._indices = gl.buffer(faces.tobytes())
        self._attributes = {
            "position": (gl.buffer(_bytes(vertices[used])), "3f"),
            "normal": (gl.buffer(_bytes(model.normals[used])), "3f"),
        }
        self._arrays: dict[int, moderngl.VertexArray] = {}
        self.surface = "plain"
        self.texture: moderngl.Texture | None = None
        if model.texture is not None and model.uvs is not None:
            self.surface, self.texture = "texture", _upload(gl, model.texture)
            self._attributes["uv"] = (gl.buffer(_bytes(model.uvs[used])), "2f")
        elif model.colors is not None:
            self.surface = "colours"
            padded = np.pad(model.colors[used, :3], ((0, 0), (0, 1)))  # to 4 bytes: OpenGL wants aligned vertices
            self._attributes["colour"] = (gl.buffer(padded.tobytes()), "3f1 1x1")

    def render(self, gl: moderngl.Context, program: Program, outside: bool) -> None:
        """Draw with a program into the bound framebuffer: all faces, or where the camera is outside those in front."""
        key = program.gl_program.glo
        if key not in self._arrays:
            names = [name for name in self._attributes if name in program.gl_program]
            content = [(*self._attributes[name], name) for name in names]
            self._arrays[key] = gl.vertex_array(program.gl_program, content, self._indices)
        if self.texture is not None:
            self.texture.use(0)
        if self.culled and outside:
            gl.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
            gl.cull_face, gl.front_face = "back", "cw" if self.front == "ccw" else "ccw"  # pictures go down, OpenGL up
        else:
            gl.enable_only(moderngl.DEPTH_TEST)
        self._arrays[key].render()

    def draw(self, pose: Pose, camera: Camera, light: Light) -> Draw | None:
        """The shaders' inputs; None where the whole mesh is behind the camera."""
        R, t = pose.R, pose.R @ self._centre + pose.t  # T_view_ctr
        near = max(t[2] - 1.01 * self.radius, 1e-3 * self.radius)
        far = t[2] + 1.01 * self.radius
        if not far > near:
            return None
        view_from_ctr = Pose(R, t).matrix
        direction = R.T @ np.asarray(light.direction) / np.linalg.norm(light.direction)
        return Draw(
            clip_from_ctr=_bytes((camera.gl_projection(near, far) @ view_from_ctr).T),  # OpenGL: column by column
            z_row=_bytes(view_from_ctr[2]),
            centre=_bytes(self._centre),
            eye=_bytes(-R.T @ t),
            light_direction=_bytes([*direction, light.shininess]),
            light_colour=_bytes([*light.colour, light.ambient]),
            light_strength=_bytes([light.diffuse, light.specular]),
            outside=near > 1e-3 * self.radius,
        )


class Target:
    """The framebuffers for pictures of one size."""

    def __init__(self, gl: moderngl.Context, size: tuple[int, int], samples: int) -> None:
        self.gl = gl
        self._size = size
        self._samples = samples
        self._framebuffers: dict[Pass, moderngl.Framebuffer] = {}
        self._renderbuffers: dict[tuple[str, int], moderngl.Renderbuffer] = {}

    def begin(self, pass_: Pass) -> None:
        """Draw into this pass's framebuffer from here on, from nothing."""
        framebuffer = self._framebuffer(pass_)
        framebuffer.use()
        framebuffer.clear()

    def read(self, pass_: Pass, dtype: str) -> NDArray[Any]:
        """What a pass has drawn, (H, W, 4): uint8 RGBA or mask for "f1", float32 object coordinates for "f4"."""
        source = self._framebuffer(pass_)
        if pass_.smooth:
            averaged = self._framebuffer(Pass(colour=True))
            self.gl.copy_framebuffer(averaged, source)
            source = averaged
        attachment = [kind for _, kind in pass_.attachments].index(dtype)
        data = source.read(components=4, attachment=attachment, alignment=1, dtype=dtype)
        kind = np.uint8 if dtype == "f1" else np.float32
        return np.frombuffer(data, dtype=kind).reshape(self._size[1], self._size[0], 4)

    def _framebuffer(self, pass_: Pass) -> moderngl.Framebuffer:
        if pass_ not in self._framebuffers:
            samples = self._samples if pass_.smooth else 0
            colours = [self._renderbuffer(kind, samples) for _, kind in pass_.attachments]
            self._framebuffers[pass_] = self.gl.framebuffer(colours, self._renderbuffer("depth", samples))
        return self._framebuffers[pass_]

    def _renderbuffer(self, kind: str, samples: int) -> moderngl.Renderbuffer:
        key = kind, samples
        if key not in self._renderbuffers:
            if kind == "depth":
                self._renderbuffers[key] = self.gl.depth_renderbuffer(self._size, samples=samples)
            else:
                self._renderbuffers[key] = self.gl.renderbuffer(self._size, 4, samples=samples, dtype=kind)
        return self._renderbuffers[key]


def _front(vertices: NDArray[np.float64], faces: NDArray[Any]) -> str | None:
    """Which way round the faces of a closed surface go, seen from outside: "ccw" or "cw". None where an edge is passed
    more often in one direction than in the other: there the surface is open, or its faces go different ways round."""
    corners = coincident(vertices)[faces].astype(np.int64)
    different = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    starts, ends = corners[different].ravel(), np.roll(corners[different], -1, axis=1).ravel()
    count = len(vertices)
    if not np.array_equal(np.sort(starts * count + ends), np.sort(ends * count + starts)):
        return None
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    volume = float(np.einsum("ij,ij->", a, np.cross(b, c)))
    return "ccw" if volume > 0 else "cw"


def _drawing_order(vertices: NDArray[np.float64], faces: NDArray[Any]) -> tuple[NDArray[np.intp], NDArray[np.int32]]:
    """Which vertices to draw, in which order, and the faces (F, 3) that index them.

    Neighbouring faces follow each other (Morton's curve through their centres), so that a vertex is shaded once
    or twice, not six times: a quarter faster on scanned meshes.
    """
    middles = vertices[faces].mean(axis=1)
    span = max(float(np.ptp(middles, axis=0).max()), 1e-12)
    cells = ((middles - middles.min(axis=0)) * (1023 / span)).astype(np.int64)
    code = np.zeros(len(faces), np.int64)
    for bit in range(30):  # of the three coordinates in turn
        code |= ((cells[:, bit % 3] >> bit // 3) & 1) << bit
    corners = faces[np.argsort(code, kind="stable")].ravel()
    _, first = np.unique(corners, return_index=True)
    used = corners[np.sort(first)].astype(np.intp)
    index = np.zeros(len(vertices), np.int32)
    index[used] = np.arange(len(used))
    return used, index[corners].reshape(-1, 3)


def _upload(gl: moderngl.Context, texture: NDArray[np.uint8]) -> moderngl.Texture:
    """A mipmapped texture. Its rows go up as v does: the picture's last row first."""
    limit = int(gl.info["GL_MAX_TEXTURE_SIZE"])
    height, width = texture.shape[:2]
    if max(width, height) > limit:
        scale = limit / max(width, height)
        size = max(1, int(width * scale)), max(1, int(height * scale))
        texture = np.asarray(cv2.resize(texture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    rows = np.ascontiguousarray(texture[::-1, :, :3])
    out = gl.texture((rows.shape[1], rows.shape[0]), 3, rows.tobytes(), alignment=1)
    out.build_mipmaps()
    out.filter = moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR
    if "llvmpipe" not in gl.info["GL_RENDERER"]:  # whose anisotropic filter takes 2.5 times as long and blurs texels
        out.anisotropy = min(_ANISOTROPY, gl.max_anisotropy)  # no more than 1 where it is not offered
    return out


def _bytes(values: ArrayLike) -> bytes:
    return np.asarray(values, dtype=np.float32).tobytes()

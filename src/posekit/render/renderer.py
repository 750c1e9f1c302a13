"""Renderer: (model, poses, cameras) -> Views with image, mask, depth and object coordinates."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Any
from weakref import WeakKeyDictionary

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.errors import RenderError
from posekit.geometry import Pose, fibonacci_sphere, view_rotation
from posekit.io.array_cache import keep_arrays, read_arrays
from posekit.mesh.cache import cache_file
from posekit.mesh.light import drawn_copy
from posekit.mesh.model import ObjectModel
from posekit.render import context
from posekit.render.gpu import Draw, Mesh, Pass, Program, Target
from posekit.render.light import DEFAULT_LIGHT, Light
from posekit.view import View

SAMPLES = (0, 2, 4, 8)
_TARGETS = 4  # sizes of pictures whose framebuffers are kept
_AHEAD, _AHEAD_PIXELS = 16, 2**19  # views that are drawn before the first is read, at most so many pixels of them
_CHECK_DIRECTIONS = fibonacci_sphere(24)
_CHECK_SIDE, _CHECK_DISTANCE = 64, 5.0  # pixels, of the pictures in which culling is tried, and bounding radii
_KEPT_CHECK_FACES = 10_000  # from which its answer is kept on disk: it takes a tenth of a second for 40,000 faces
_KEPT_CHECK_VERSION = 1


class Renderer:
    """Draws batches of views of a mesh.

    samples: 0, 2, 4 or 8 colour samples a pixel (fewer where OpenGL offers fewer). They smooth the image only,
    whose edges fade to black; mask, depth and coords are always those of the pixel's centre.
    backend: "auto", "egl" or "osmesa". Threads may share a Renderer; they take turns.
    Meshes of more than 100,000 faces are drawn simplified, exactly enough for the picture (see `drawn_copy`).
    Raises ValueError for other samples, RenderError where there is no usable OpenGL.
    """

    def __init__(self, samples: int = 0, backend: str = "auto") -> None:
        if samples not in SAMPLES:
            raise ValueError(f"Renderer: samples={samples}; use one of {SAMPLES}")
        self._backend = backend
        self._meshes: WeakKeyDictionary[ObjectModel, Mesh] = WeakKeyDictionary()
        self._targets: OrderedDict[tuple[int, int], list[Target]] = OrderedDict()
        self._programs: dict[tuple[Pass, str], Program] = {}
        with context.current(backend) as current:
            self.samples = min(samples, current.gl.max_samples)
            limits = current.gl.info
            self._max_size = int(min(limits["GL_MAX_RENDERBUFFER_SIZE"], *limits["GL_MAX_VIEWPORT_DIMS"]))

    def render(
        self,
        model: ObjectModel,
        poses: Sequence[Pose],
        cameras: Sequence[Camera] | Camera,
        *,
        light: Light | Sequence[Light] | None = DEFAULT_LIGHT,
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
        all_cameras = _repeated(cameras, len(poses), "cameras")
        lights = _repeated(Light.flat() if light is None else light, len(poses), "lights")
        if not poses:
            return []
        _check_poses(poses)
        size = self._check_size(all_cameras)
        with context.current(self._backend) as current:
            mesh = self._mesh(current.gl, drawn_copy(model, max(size)))
            draws = [mesh.draw(*each) for each in zip(poses, all_cameras, lights, strict=True)]
            return self._views(current.gl, mesh, draws, all_cameras, rgb=rgb, coords=coords)

    def _views(
        self,
        gl: moderngl.Context,
        mesh: Mesh,
        draws: list[Draw | None],
        cameras: list[Camera],
        *,
        rgb: bool,
        coords: bool,
    ) -> list[View]:
        """Draw and read views.

        Several are drawn before the first is read, so that reading and drawing do not wait for each other. Each has a
        framebuffer of its own: as tiles of one, far from its corner, they would be less exact (OpenGL interpolates in
        float32 window coordinates), and slower on a CPU, where nearly all time goes into the triangles.
        """
        smooth = rgb and self.samples > 0
        exact, fine = Pass(colour=rgb and not smooth, coords=coords), Pass(colour=True, smooth=True)
        passes = [exact, fine] if smooth else [exact]
        width, height = cameras[0].size
        ahead = min(len(draws), _AHEAD, max(1, _AHEAD_PIXELS // (width * height)))
        targets = self._framebuffers(gl, (width, height), ahead)
        views = []
        for start in range(0, len(draws), ahead):
            some = list(zip(targets, draws[start : start + ahead], cameras[start : start + ahead], strict=False))
            for target, draw, _ in some:
                for pass_ in passes:
                    self._run(target, pass_, mesh, draw)
            views += [_read(target, camera, passes, rgb=rgb) for target, _, camera in some]
        return views

    def _run(self, target: Target, pass_: Pass, mesh: Mesh, draw: Draw | None) -> None:
        target.begin(pass_)
        if draw is not None:
            program = self._program(target.gl, pass_, mesh.surface if pass_.colour else "plain")
            program.write(draw)
            mesh.render(target.gl, program, draw.outside)

    def _program(self, gl: moderngl.Context, pass_: Pass, surface: str) -> Program:
        key = pass_, surface
        if key not in self._programs:
            self._programs[key] = Program(gl, pass_, surface)
        return self._programs[key]

    def _mesh(self, gl: moderngl.Context, model: ObjectModel) -> Mesh:
        mesh = self._meshes.get(model)
        if mesh is None:
            mesh = self._meshes[model] = Mesh(gl, model)
            mesh.culled = mesh.front is not None and self._may_be_culled(gl, mesh, model)
        return mesh

    def _may_be_culled(self, gl: moderngl.Context, mesh: Mesh, model: ObjectModel) -> bool:
        """`_looks_alike_culled`; of a mesh with many faces kept on disk, for this OpenGL."""
        if len(model.faces) < _KEPT_CHECK_FACES:
            return self._looks_alike_culled(gl, mesh)
        file = cache_file("culled", model, _KEPT_CHECK_VERSION)
        drawn_by = np.array(f"{gl.info['GL_RENDERER']} {gl.info['GL_VERSION']}")
        kept = read_arrays(file)
        if kept is not None and set(kept) == {"culled", "drawn_by"} and kept["drawn_by"] == drawn_by:
            return bool(kept["culled"])
        culled = self._looks_alike_culled(gl, mesh)
        keep_arrays(file, {"culled": np.array(culled), "drawn_by": drawn_by})
        return culled

    def _looks_alike_culled(self, gl: moderngl.Context, mesh: Mesh) -> bool:
        """Whether no face that turns its back is seen from outside: tried from all sides. A single pixel may differ:
        at the outline, where faces are seen edge-on, the nearer of two is a matter of rounding."""
        camera = Camera.from_fov(0.5, _CHECK_SIDE, _CHECK_SIDE)
        centre = np.array([0, 0, _CHECK_DISTANCE * mesh.radius])
        poses = [Pose(view_rotation(direction), centre) @ mesh.T_ctr_obj for direction in _CHECK_DIRECTIONS]
        draws = [mesh.draw(pose, camera, DEFAULT_LIGHT) for pose in poses]
        depths = []
        for mesh.culled in (False, True):
            views = self._views(gl, mesh, draws, [camera] * len(draws), rgb=False, coords=True)
            depths.append(np.stack([view.depth for view in views if view.depth is not None]))
        differ = np.abs(depths[0] - depths[1]) > 1e-2 * mesh.radius
        beside, below = differ[:, :, 1:] & differ[:, :, :-1], differ[:, 1:] & differ[:, :-1]
        return not (beside.any() or below.any())

    def _framebuffers(self, gl: moderngl.Context, size: tuple[int, int], count: int) -> list[Target]:
        """At least so many for this size; sizes least recently used make room."""
        if size not in self._targets:
            while len(self._targets) >= _TARGETS:
                self._targets.popitem(last=False)
            self._targets[size] = []
        self._targets.move_to_end(size)
        made = self._targets[size]
        made += [Target(gl, size, self.samples) for _ in range(count - len(made))]
        return made

    def _check_size(self, cameras: list[Camera]) -> tuple[int, int]:
        sizes = {camera.size for camera in cameras}
        if len(sizes) > 1:
            raise ValueError(f"Renderer: the cameras of one batch have several sizes, {sorted(sizes)}; group them")
        size = sizes.pop()
        if max(size) > self._max_size:
            raise RenderError(
                f"a picture of {size[0]}x{size[1]} cannot be drawn: this OpenGL's limit is {self._max_size} pixels a "
                "side. Draw a smaller one (Camera.resized)."
            )
        return size


def _read(target: Target, camera: Camera, passes: list[Pass], *, rgb: bool) -> View:
    """The view that a target's passes have drawn: the exact one, and the smooth one where there is one."""
    exact = passes[0]
    image = np.zeros((camera.height, camera.width, 3), np.uint8)
    depth = xyz = mask = None
    if exact.coords:
        geometry = target.read(exact, "f4")
        depth, xyz = geometry[..., 3].copy(), _first_three(geometry)
        mask = depth > 0
    if exact.colour or not exact.coords:
        rgba = target.read(exact, "f1")
        mask = rgba[..., 3] > 0
        image = _first_three(rgba) if rgb else image
    if len(passes) > 1:
        image = _first_three(target.read(passes[1], "f1"))
    return View(image, camera, mask, depth, xyz)


def _first_three(array: NDArray[Any]) -> NDArray[Any]:
    """(H, W, 4) -> (H, W, 3), contiguous."""
    return np.asarray(cv2.cvtColor(array, cv2.COLOR_RGBA2RGB))


def _repeated(values: Any, n: int, what: str) -> list[Any]:
    """One value n times, or n values as they are."""
    if isinstance(values, (Camera, Light)):
        return [values] * n
    out = list(values)
    if len(out) != n:
        raise ValueError(f"Renderer: {len(out)} {what} for {n} poses; give one, or one for each pose")
    return out


def _check_poses(poses: list[Pose]) -> None:
    for i, pose in enumerate(poses):
        if not (np.isfinite(pose.R).all() and np.isfinite(pose.t).all()):
            raise ValueError(f"Renderer: pose {i} of {len(poses)} is not finite:\n{pose.matrix}")

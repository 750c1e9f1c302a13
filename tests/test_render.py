"""The renderer against closed forms and against its slow twin, the ray caster."""

from __future__ import annotations

import gc
import importlib.metadata
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

import posekit
from posekit.camera import Camera, mask_box
from posekit.errors import RenderError
from posekit.geometry import Pose, random_rotation, so3_exp
from posekit.io.array_cache import keep_arrays, read_arrays
from posekit.mesh.model import ObjectModel
from posekit.render import Light, Renderer, context, info, render_views, view_rotations
from posekit.render import renderer as renderer_module
from raycaster import cast

CAMERA = Camera(fx=210.0, fy=190.0, cx=70.25, cy=66.5, width=160, height=120)  # off its axis, fx != fy
UNIT_SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float64)
SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]])
FACING = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0, 0, 1.0]))  # obj x right, y up, z towards the camera


def square(half_side: float, **kwargs) -> ObjectModel:
    return ObjectModel.from_arrays(UNIT_SQUARE * half_side, SQUARE_FACES, **kwargs)


def boxes(*corners: tuple[tuple[float, float, float], tuple[float, float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of boxes (low, high), no vertex shared between sides."""
    vertices = []
    for low, high in corners:
        limits = np.array([low, high])
        for axis in range(3):
            for side in (0, 1):
                for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)):
                    choice = np.insert([i, j], axis, side)
                    vertices.append(limits[choice, range(3)])
    first = 4 * np.arange(len(vertices) // 4)[:, None, None]
    return np.array(vertices), (first + SQUARE_FACES).reshape(-1, 3)


def bracket() -> ObjectModel:
    """An angle bracket with a peg: no symmetry, no mirror symmetry, its own colours, far from its origin."""
    vertices, faces = boxes(
        ((0, 0, 0), (0.10, 0.06, 0.015)),
        ((0, 0, 0.015), (0.015, 0.06, 0.07)),
        ((0.06, 0.01, 0.015), (0.08, 0.02, 0.04)),
    )
    colors = np.random.default_rng(3).integers(0, 256, (len(vertices), 3)).astype(np.uint8)
    return ObjectModel.from_arrays(vertices + np.array([0.3, -0.2, 0.1]), faces, colors=colors)


def bracket_poses(n: int) -> list[Pose]:
    rng = np.random.default_rng(5)
    model_centre = bracket().center
    poses = []
    for _ in range(n):
        R = random_rotation(rng)
        poses.append(Pose(R, [*rng.uniform(-0.04, 0.04, 2), rng.uniform(0.2, 0.45)] - R @ model_centre))
    return poses


@pytest.mark.parametrize(
    ("half_side", "tilt"), [(0.2, 0.9), (0.2, 1.4), (50.0, 1.2)], ids=["tilted", "grazing", "endless"]
)
@pytest.mark.parametrize("samples", [0, 4])
def test_plane_coloured_by_its_coordinates_equals_backprojection(half_side, tilt, samples) -> None:
    model = square(half_side)
    pose = Pose(so3_exp([tilt, 0.2, 0.3]), [0.01, -0.02, 0.5])
    (view,) = Renderer(samples).render(model, [pose], CAMERA)
    rays = CAMERA.backproject(CAMERA.pixel_grid())
    normal = pose.R[:, 2]
    depth = (normal @ pose.t) / (rays @ normal)
    coords = pose.inverse().apply(rays * depth[..., None])
    inside = (np.abs(coords[..., :2]).max(axis=-1) < half_side) & (depth > 0)
    assert (view.mask != inside).sum() <= 3
    both = view.mask & inside
    assert both.sum() > 500
    assert (np.abs(view.depth - depth)[both] / depth[both]).max() < 1e-5
    assert (np.abs(view.coords - coords).max(axis=-1)[both] / depth[both]).max() < 1e-5


def test_bracket_equals_ray_caster(renderer) -> None:
    model = bracket()
    poses = bracket_poses(6)
    for pose, view in zip(poses, renderer.render(model, poses, CAMERA, light=None), strict=True):
        twin = cast(model, pose, CAMERA)
        area = twin.mask.sum()
        assert area > 500
        assert (view.mask != twin.mask).sum() <= 3
        error = np.abs(view.coords - twin.coords).max(axis=-1)
        edges = (error > 1e-4) & view.mask & twin.mask  # a pixel's centre on an edge may belong to either side
        assert edges.sum() <= 0.002 * area + 2
        good = view.mask & twin.mask & ~edges
        assert error[good].max() < 2e-6
        assert np.abs(view.depth - twin.depth)[good].max() < 2e-6
        assert np.abs(view.image.astype(float) - twin.colors)[good].max() < 1.01


def test_coords_depth_and_pose_agree(renderer) -> None:
    model = bracket()
    for pose, view in zip(bracket_poses(3), renderer.render(model, bracket_poses(3), CAMERA), strict=True):
        points = pose.apply(view.coords[view.mask])
        np.testing.assert_allclose(points[:, 2], view.depth[view.mask], atol=2e-6)
        np.testing.assert_allclose(CAMERA.project(points), CAMERA.pixel_grid()[view.mask], atol=1e-2)


def test_types_shapes_and_background(renderer) -> None:
    (view,) = renderer.render(bracket(), bracket_poses(1), CAMERA)
    assert (view.image.dtype, view.image.shape) == (np.uint8, (120, 160, 3))
    assert (view.mask.dtype, view.mask.shape) == (np.bool_, (120, 160))
    assert (view.depth.dtype, view.depth.shape) == (np.float32, (120, 160))
    assert (view.coords.dtype, view.coords.shape) == (np.float32, (120, 160, 3))
    assert not view.image[~view.mask].any()
    assert not view.depth[~view.mask].any()
    assert not view.coords[~view.mask].any()
    assert view.camera == CAMERA
    assert all(array.flags.c_contiguous and array.flags.writeable for array in (view.image, view.depth, view.coords))


@pytest.mark.parametrize("samples", [0, 4])
def test_without_rgb_or_coords_the_rest_stays(samples) -> None:
    renderer = Renderer(samples)
    model, poses = bracket(), bracket_poses(2)
    for whole, bare, geometry, mask in zip(
        renderer.render(model, poses, CAMERA),
        renderer.render(model, poses, CAMERA, coords=False),
        renderer.render(model, poses, CAMERA, rgb=False),
        renderer.render(model, poses, CAMERA, rgb=False, coords=False),
        strict=True,
    ):
        assert bare.coords is None
        assert bare.depth is None
        np.testing.assert_array_equal(bare.image, whole.image)
        np.testing.assert_array_equal(geometry.coords, whole.coords)
        assert not geometry.image.any()
        for view in (bare, geometry, mask):
            np.testing.assert_array_equal(view.mask, whole.mask)


def test_batch_equals_single_renderings(renderer) -> None:
    model, poses = bracket(), bracket_poses(8)
    cameras = [CAMERA.resized(160, 120), *[Camera(180 + 5 * i, 200, 80 - i, 60, 160, 120) for i in range(7)]]
    lights = [Light(ambient=0.1 * i) for i in range(8)]
    batch = renderer.render(model, poses, cameras, light=lights)
    for i, view in enumerate(batch):
        (single,) = renderer.render(model, [poses[i]], cameras[i], light=lights[i])
        for name in ("image", "mask", "depth", "coords"):
            np.testing.assert_array_equal(getattr(view, name), getattr(single, name))
    assert renderer.render(model, [], CAMERA) == []


def test_models_and_sizes_in_turn(renderer) -> None:
    first, second = bracket(), square(0.1, colors=np.full((4, 3), [0, 255, 0], np.uint8))
    pose = bracket_poses(1)
    before = renderer.render(first, pose, CAMERA)[0]
    for size in ((640, 480), (33, 17), (1, 1), (160, 121), (64, 64)):  # more sizes than are kept
        (view,) = renderer.render(second, [FACING], CAMERA.resized(*size), light=None)
        assert view.image.shape == (size[1], size[0], 3)
        assert (view.image[view.mask] == [0, 255, 0]).all()
    after = renderer.render(first, pose, CAMERA)[0]
    np.testing.assert_array_equal(before.image, after.image)
    np.testing.assert_array_equal(before.coords, after.coords)


def test_vga_projects_where_the_camera_says(renderer) -> None:
    camera = Camera(572.4, 573.6, 325.3, 242.0, 640, 480)
    (view,) = renderer.render(square(0.1), [FACING], camera)
    box = np.array(mask_box(view.mask))
    np.testing.assert_allclose(box, camera.points_box(FACING.apply(UNIT_SQUARE * 0.1)), atol=0.51)


@pytest.mark.parametrize("samples", [0, 4])
def test_texture_orientation(samples) -> None:
    texture = np.zeros((64, 64, 3), np.uint8)
    red, green, blue, white = [255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]
    texture[:32, :32], texture[:32, 32:], texture[32:, :32], texture[32:, 32:] = red, green, blue, white
    uvs = (UNIT_SQUARE[:, :2] + 1) / 2  # u right, v up, as in OBJ files: the picture stands upright on the square
    model = square(0.2, uvs=uvs, texture=texture)
    (view,) = Renderer(samples).render(model, [FACING], Camera(100, 100, 31.5, 31.5, 64, 64), light=None)
    corners = view.image[[20, 20, 43, 43], [20, 43, 20, 43]]
    np.testing.assert_array_equal(corners, [red, green, blue, white])


def test_texture_of_odd_width_keeps_its_rows(renderer) -> None:
    texture = np.zeros((7, 5, 3), np.uint8)
    texture[..., 0] = 40 * np.arange(5)
    texture[..., 1] = 30 * np.arange(7)[:, None]
    model = square(0.25, uvs=(UNIT_SQUARE[:, :2] + 1) / 2, texture=texture)
    (view,) = renderer.render(model, [FACING], Camera(430, 434, 107, 108, 215, 217), light=None)
    texels = view.image[15::31, 21::43].astype(int)
    assert np.abs(texels - texture).max() <= 1  # the middle of each texel


def test_texture_far_away_is_its_average(renderer) -> None:
    texture = np.indices((512, 512)).sum(axis=0) % 2 * np.uint8(255)
    model = square(
        0.2, uvs=(UNIT_SQUARE[:, :2] + 1) / 2, texture=np.repeat(texture[..., None], 3, axis=2).astype(np.uint8)
    )
    pose = Pose(so3_exp([0.4, 0, 0.3]) @ FACING.R, [0, 0, 2.0])
    (view,) = renderer.render(model, [pose], CAMERA, light=None)
    assert np.abs(view.image[view.mask].astype(int) - 127).max() <= 4


def test_vertex_colours_are_interpolated(renderer) -> None:
    colors = np.array([[0, 0, 0], [200, 0, 0], [200, 100, 0], [0, 100, 0]], np.uint8)
    (view,) = renderer.render(square(0.1, colors=colors), [FACING], CAMERA, light=None)
    x, y = view.coords[view.mask][:, 0], view.coords[view.mask][:, 1]
    expected = np.stack([(x + 0.1) * 1000, (y + 0.1) * 500, 0 * x], axis=1)
    assert np.abs(view.image[view.mask] - expected).max() < 1.01


def test_bare_mesh_is_grey(renderer) -> None:
    (view,) = renderer.render(square(0.1), [FACING], CAMERA, light=None)
    colour = np.unique(view.image[view.mask])
    assert len(colour) == 1
    assert 100 < colour[0] < 200


def test_lit_brightness_is_the_models_formula(renderer) -> None:
    model = square(0.1, colors=np.full((4, 3), [100, 50, 200], np.uint8))
    light = Light(ambient=0.3, direction=(0, -3, -4), diffuse=0.5, specular=0, colour=(1, 1, 0.5))
    (view,) = renderer.render(model, [FACING], CAMERA, light=light)
    expected = np.array([100, 50, 200]) * (0.3 + 0.5 * 0.8) * (1, 1, 0.5)
    assert np.abs(view.image[view.mask] - expected).max() <= 1
    shiny = Light(ambient=0.3, direction=(0, -3, -4), diffuse=0.5, specular=0.5, shininess=5, colour=(1, 1, 0.5))
    (brighter,) = renderer.render(model, [FACING], CAMERA, light=shiny)
    assert (brighter.image[view.mask].astype(int) - view.image[view.mask])[:, 0].min() > 5
    (flat,) = renderer.render(model, [FACING], CAMERA, light=Light.flat())
    assert (flat.image[flat.mask] == [100, 50, 200]).all()


def test_light_comes_from_its_direction_in_the_view(renderer) -> None:
    direction = np.random.default_rng(0).normal(size=(3000, 3))
    vertices = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    faces = convex_faces(vertices)
    model = ObjectModel.from_arrays(0.05 * vertices, faces)
    pose = Pose(random_rotation(np.random.default_rng(1)), [0, 0, 0.4])
    (view,) = renderer.render(model, [pose], CAMERA, light=Light(0.2, (-1, 0, -0.2), 0.8, 0))
    columns = np.argwhere(view.mask)[:, 1]
    brightness = view.image[view.mask][:, 0].astype(float)
    middle = np.median(columns)
    assert brightness[columns < middle].mean() > 2 * brightness[columns > middle].mean()
    (above,) = renderer.render(model, [pose], CAMERA)
    assert above.image[:66].sum() > 1.2 * above.image[66:].sum()


def convex_faces(points: np.ndarray) -> np.ndarray:
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points)
    corners = points[hull.simplices]
    outward = np.einsum(
        "fi,fi->f", np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), corners[:, 0]
    )
    return np.where((outward > 0)[:, None], hull.simplices, hull.simplices[:, ::-1])


def test_wrong_winding_is_lit_alike(renderer) -> None:
    model = square(0.1)
    turned = ObjectModel.from_arrays(model.vertices, model.faces[:, ::-1])
    for light in (Light(), Light(specular=0.7)):
        right, wrong = (renderer.render(m, [FACING], CAMERA, light=light)[0] for m in (model, turned))
        assert right.image.any()
        np.testing.assert_array_equal(right.image, wrong.image)


def test_samples_smooth_the_silhouette_only() -> None:
    smooth = Renderer(samples=4)
    if smooth.samples < 2:
        pytest.fail("this OpenGL has no multisampling")
    model = square(0.1, colors=np.full((4, 3), 200, np.uint8))
    pose = Pose(so3_exp([0, 0, 0.3]) @ FACING.R, FACING.t)
    (fine,) = smooth.render(model, [pose], CAMERA, light=None)
    (hard,) = Renderer().render(model, [pose], CAMERA, light=None)
    assert set(np.unique(hard.image)) == {0, 200}
    assert len(np.unique(fine.image)) > 3
    np.testing.assert_array_equal(fine.mask, hard.mask)
    np.testing.assert_array_equal(fine.coords, hard.coords)
    assert np.abs(fine.image.astype(float).mean() - hard.image.mean()) < 0.3


@pytest.mark.parametrize("t", [(0, 0, -1.0), (0, 0, -0.11), (5.0, 0, 1.0), (0, 0, 1e6)], ids=str)
def test_nothing_in_the_picture_is_an_empty_mask(renderer, t) -> None:
    views = renderer.render(square(0.05), [Pose(FACING.R, t), FACING], CAMERA)
    assert not views[0].mask.any()
    assert not views[0].image.any()
    assert not views[0].depth.any()
    assert views[1].mask.any()


def test_camera_inside_the_mesh_sees_its_inner_side(renderer) -> None:
    vertices, faces = boxes(((-0.1, -0.1, -0.1), (0.1, 0.1, 0.1)))
    (view,) = renderer.render(ObjectModel.from_arrays(vertices, faces), [Pose.identity()], CAMERA)
    assert view.mask.all()
    np.testing.assert_allclose(view.depth[60, 60], 0.1, rtol=1e-5)
    assert view.image[view.mask].min() > 20


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_pose_that_is_not_finite_is_refused(renderer, bad) -> None:
    with pytest.raises(ValueError, match="pose 1 of 2 is not finite"):
        renderer.render(square(0.1), [FACING, Pose(FACING.R, [0, 0, bad])], CAMERA)


def test_misuse_is_refused(renderer) -> None:
    model = square(0.1)
    with pytest.raises(ValueError, match="2 cameras for 1 poses"):
        renderer.render(model, [FACING], [CAMERA, CAMERA])
    with pytest.raises(ValueError, match="3 lights for 1 poses"):
        renderer.render(model, [FACING], CAMERA, light=[Light()] * 3)
    with pytest.raises(ValueError, match="several sizes"):
        renderer.render(model, [FACING] * 2, [CAMERA, CAMERA.resized(80, 60)])
    with pytest.raises(RenderError, match=r"200000x200000 cannot be drawn.*Camera\.resized"):
        renderer.render(model, [FACING], CAMERA.resized(200000, 200000))
    with pytest.raises(ValueError, match="samples=3"):
        Renderer(samples=3)
    with pytest.raises(ValueError, match="direction must have a length"):
        Light(direction=(0, 0, 0))


def test_threads_take_turns(renderer) -> None:
    model, poses = bracket(), bracket_poses(12)
    expected = renderer.render(model, poses, CAMERA)
    results: dict[int, list] = {}

    def work(i: int) -> None:
        results[i] = renderer.render(model, poses[3 * i : 3 * i + 3], CAMERA)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for i, view in enumerate(view for j in range(4) for view in results[j]):
        np.testing.assert_array_equal(view.image, expected[i].image)


def test_a_forgotten_model_leaves_the_gpu(renderer) -> None:
    model = square(0.1)
    renderer.render(model, [FACING], CAMERA)
    held = len(renderer._meshes)
    del model
    gc.collect()
    assert len(renderer._meshes) < held
    with context.current() as current:
        assert not current.gl.objects  # freed on entering


def test_render_views_shows_the_whole_model(renderer) -> None:
    model = bracket()
    for n, size in ((6, (96, 72)), (14, (60, 80))):
        views = render_views(renderer, model, view_rotations(n), size)
        assert len(views) == n
        for view in views:
            x0, y0, x1, y1 = mask_box(view.mask)
            assert min(x0, y0, size[0] - x1, size[1] - y1) >= 1
    with pytest.raises(ValueError, match="at least 1"):
        view_rotations(0)


def test_six_views_show_the_six_faces(renderer) -> None:
    """A cube with faces at -y, +x, +y, -x, +z, -z in different greys: one each, the frontal one first."""
    vertices, faces = boxes(((0, 0, 0), (0.1, 0.1, 0.1)))
    greys = {"-x": 40, "+x": 80, "-y": 120, "+y": 160, "-z": 200, "+z": 240}  # the order of `boxes`
    colors = np.repeat(np.repeat(list(greys.values()), 4)[:, None], 3, axis=1).astype(np.uint8)
    model = ObjectModel.from_arrays(vertices, faces, colors=colors)
    views = render_views(renderer, model, view_rotations(6), (64, 64), light=None)
    assert [view.image[32, 32, 0] for view in views] == [greys[k] for k in ("-y", "+x", "+y", "-x", "+z", "-z")]


# --- contexts -------------------------------------------------------------------------------------------------------


def has_osmesa() -> bool:
    try:
        importlib.metadata.distribution("lavavu-osmesa")
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


BACKENDS = (["egl"] if sys.platform.startswith("linux") else []) + (["osmesa"] if has_osmesa() else [])
SOURCE = Path(posekit.__file__).parents[1]


def run_python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(SOURCE), os.environ.get("PYTHONPATH", "")]), **environment}
    return subprocess.run(
        [sys.executable, "-c", code], env=env, capture_output=True, text=True, timeout=60, check=False
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_each_backend_draws_the_same(backend, renderer, tmp_path) -> None:
    (here,) = renderer.render(square(0.1), [FACING], CAMERA)
    code = f"""
import numpy as np
from posekit.camera import Camera
from posekit.geometry import Pose
from posekit.mesh.model import ObjectModel
from posekit.render import Renderer, info
v = np.array({(UNIT_SQUARE * 0.1).tolist()})
model = ObjectModel.from_arrays(v, np.array({SQUARE_FACES.tolist()}))
(view,) = Renderer().render(model, [Pose(np.diag([1., -1, -1]), [0, 0, 1.])], {CAMERA!r})
np.savez({str(tmp_path / "view.npz")!r}, image=view.image, mask=view.mask, coords=view.coords)
print(info()["backend"])
"""
    done = run_python(code, POSEKIT_GL=backend)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == backend
    there = np.load(tmp_path / "view.npz")
    np.testing.assert_array_equal(there["mask"], here.mask)
    np.testing.assert_allclose(there["coords"], here.coords, atol=1e-6)
    assert np.abs(there["image"].astype(int) - here.image).max() <= 1


def test_info_names_the_driver() -> None:
    found = info()
    assert set(found) == {"vendor", "renderer", "version", "backend"}
    assert all(found.values())
    assert found["backend"] in ("egl", "osmesa", "standalone")


def refuse() -> None:
    raise RenderError("not on this machine")


def test_no_opengl_says_what_to_install(monkeypatch) -> None:
    monkeypatch.setattr(context, "_context", None)
    monkeypatch.setattr(context, "_create_egl", refuse)
    monkeypatch.setattr(context, "_create_standalone", refuse)
    monkeypatch.setattr(context, "_create_osmesa", refuse)
    with pytest.raises(RenderError) as caught:
        Renderer()
    text = str(caught.value)
    assert "not on this machine" in text
    assert "apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri" in text
    assert "pip install posekit[osmesa]" in text


def test_osmesa_says_that_it_is_a_fallback(monkeypatch) -> None:
    monkeypatch.setattr(context, "_create_egl", refuse)
    monkeypatch.setattr(context, "_create_standalone", refuse)
    monkeypatch.setattr(context, "_create_osmesa", lambda: "a context")
    with pytest.warns(RuntimeWarning, match=r"falls back to OSMesa.*not on this machine.*apt-get install"):
        assert context._create("auto") == ("a context", "osmesa")


def test_missing_wheel_is_named(monkeypatch) -> None:
    monkeypatch.setattr(context, "_OSMESA_PACKAGE", "no-such-wheel")
    with pytest.raises(RenderError, match="no-such-wheel is not installed"):
        context.OsMesa()


def test_old_opengl_is_refused() -> None:
    class Old:
        version_code = 210
        info = {"GL_VERSION": "2.1 Mesa"}  # noqa: RUF012

        def release(self) -> None:
            pass

    with pytest.raises(RenderError, match=r"OpenGL 2\.1 Mesa is older than 3\.3"):
        context._checked(Old())


def test_unknown_and_second_backends_are_refused(renderer, monkeypatch) -> None:
    monkeypatch.setenv("POSEKIT_GL", "vulkan")
    with pytest.raises(RenderError, match="unknown OpenGL backend 'vulkan'"):
        Renderer()
    other = "egl" if info_backend() == "osmesa" else "osmesa"
    with pytest.raises(RenderError, match="already uses"):
        Renderer(backend=other)


def info_backend() -> str:
    assert context._context is not None
    return context._context.backend


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_fork_after_the_first_rendering_is_refused_not_hung() -> None:
    code = """
import os
from posekit.errors import RenderError
from posekit.render import info
info()
if os.fork() == 0:
    try:
        info()
    except RenderError as error:
        print(error, flush=True)
    os._exit(0)
os.wait()
"""
    done = run_python(code)
    assert done.returncode == 0, done.stderr
    assert "was forked" in done.stdout
    assert "spawn" in done.stdout


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_fork_before_the_first_rendering_makes_its_own_context() -> None:
    code = """
import os
from posekit.render import info
child = os.fork()
os.write(1, (info()["renderer"] + "\\n").encode())
if child == 0:
    os._exit(0)
raise SystemExit(os.wait()[1])
"""
    done = run_python(code)
    assert done.returncode == 0, done.stderr
    first, second = done.stdout.splitlines()
    assert first == second != ""


def test_triton_is_loaded_before_opengl_starts(tmp_path, monkeypatch) -> None:
    library = tmp_path / "triton/_C/libtriton.so"
    library.parent.mkdir(parents=True)
    library.touch()
    (tmp_path / "triton/__init__.py").touch()
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "triton", raising=False)
    order: list[str] = []
    monkeypatch.setattr(context.ctypes, "CDLL", order.append)

    def refuse() -> None:
        order.append("OpenGL")
        raise RenderError("none here")

    monkeypatch.setattr(context, "_context", None)
    for way in ("_create_egl", "_create_standalone", "_create_osmesa"):
        monkeypatch.setattr(context, way, refuse)
    with pytest.raises(RenderError):
        info()
    assert order[:2] == [str(library), "OpenGL"]


def pebble(seed: int = 2) -> ObjectModel:
    """A closed, bumpy surface whose faces all go the same way round, without colours of its own."""
    theta, phi = np.meshgrid(np.linspace(0, np.pi, 25), np.linspace(0, 2 * np.pi, 48, endpoint=False), indexing="ij")
    unit = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1).reshape(-1, 3)
    waves = np.random.default_rng(seed).normal(0, 4, (3, 3))
    bumps = 0.1 * np.sin(unit @ waves).sum(axis=1)
    index = np.arange(len(unit)).reshape(25, 48)
    a, b = index[:-1], index[1:]
    c, d = np.roll(a, -1, axis=1), np.roll(b, -1, axis=1)
    faces = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)]).reshape(-1, 3)
    return ObjectModel.from_arrays(0.05 * unit * (1 + bumps)[:, None], faces)


@pytest.mark.parametrize("inside_out", [False, True])
def test_leaving_out_the_faces_behind_changes_no_picture(inside_out) -> None:
    model = pebble()
    if inside_out:
        model = ObjectModel.from_arrays(model.vertices, model.faces[:, ::-1])
    renderer, rng = Renderer(), np.random.default_rng(1)
    poses = [Pose(random_rotation(rng), [*rng.uniform(-0.02, 0.02, 2), rng.uniform(0.12, 0.4)]) for _ in range(20)]
    fewer = renderer.render(model, poses, CAMERA)
    mesh = renderer._meshes[model]
    assert mesh.culled
    mesh.culled = False
    for one, other in zip(fewer, renderer.render(model, poses, CAMERA), strict=True):
        np.testing.assert_array_equal(one.mask, other.mask)
        assert (np.abs(one.depth - other.depth) > 1e-6).sum() <= 2  # at the outline, faces seen edge-on
        assert (one.image != other.image).any(axis=-1).sum() <= 2


def test_whether_faces_may_be_left_out_is_kept_on_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And looked at anew where the file is damaged, or was made by another OpenGL."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(renderer_module, "_KEPT_CHECK_FACES", 1000)
    look, looked = Renderer._looks_alike_culled, []
    monkeypatch.setattr(Renderer, "_looks_alike_culled", lambda *args: looked.append(0) or look(*args))

    def culled() -> tuple[bool, int]:
        model, renderer = pebble(), Renderer()
        looked.clear()
        renderer.render(model, [Pose(np.eye(3), [0, 0, 0.4])], CAMERA)
        return renderer._meshes[model].culled, len(looked)

    assert culled() == (True, 1)
    assert culled() == (True, 0)
    [file] = (tmp_path / "posekit" / "culled").iterdir()
    file.write_bytes(file.read_bytes()[:-10])
    assert culled() == (True, 1)
    keep_arrays(file, {"culled": np.array(False), "drawn_by": np.array("another")})
    assert culled() == (True, 1)
    keep_arrays(file, read_arrays(file) | {"culled": np.array(False)})
    assert culled() == (False, 0)


def test_meshes_whose_faces_go_different_ways_round_are_drawn_whole(renderer) -> None:
    whole = pebble()
    lid = ObjectModel.from_arrays(whole.vertices, whole.faces[48:])  # open
    flipped = whole.faces.copy()
    flipped[100:110] = flipped[100:110, ::-1]
    shifted = whole.vertices + np.array([0.2, 0, 0], np.float32)
    faces = np.concatenate([whole.faces, whole.faces[:, ::-1] + len(whole.vertices)])  # the second one inside out
    two = ObjectModel.from_arrays(np.concatenate([whole.vertices, shifted]), faces)
    for model in (lid, ObjectModel.from_arrays(whole.vertices, flipped), two):
        renderer.render(model, [Pose(np.eye(3), [0, 0, 0.4])], CAMERA)
        assert not renderer._meshes[model].culled
    [view] = renderer.render(two, [Pose(np.eye(3), [-0.2, 0, 0.4])], CAMERA)
    [alone] = renderer.render(whole, [Pose(np.eye(3), [0, 0, 0.4])], CAMERA)
    assert alone.mask.sum() > 500
    assert (view.mask != alone.mask)[:, 35:105].sum() <= 3  # the first one stands beside
    assert np.abs(view.depth - alone.depth)[:, 35:105].max() < 0.01


def test_from_inside_a_closed_mesh_its_walls_are_seen(renderer) -> None:
    model = pebble()
    [view] = renderer.render(model, [Pose(np.eye(3), [0, 0, 0])], CAMERA)
    assert renderer._meshes[model].culled
    assert view.mask.all()


def test_more_views_than_are_drawn_ahead_equal_single_ones(renderer) -> None:
    model, rng = pebble(), np.random.default_rng(6)
    poses = [Pose(random_rotation(rng), [0, 0, rng.uniform(0.15, 0.6)]) for _ in range(37)]
    for samples in (0, 4):
        chosen = Renderer(samples)
        for pose, view in zip(poses, chosen.render(model, poses, CAMERA), strict=True):
            [single] = chosen.render(model, [pose], CAMERA)
            for name in ("image", "mask", "depth", "coords"):
                np.testing.assert_array_equal(getattr(view, name), getattr(single, name))

"""Meshes from files of every kind, their units, symmetries, normals, and what is refused.

Accepted: PLY, OBJ, STL, GLB and glTF; polygons, concave ones and different ones in a binary PLY too; OBJ in UTF-16;
colours of vertices, faces and materials in whatever numbers; textures of 8 and 16 bits in the mesh's folder, moved by
KHR_texture_transform; KHR_materials_pbrSpecularGlossiness; units mm, cm, m, in. Told: units that were guessed, colours,
textures and extensions that are not understood, transparent parts (drawn solid), an STL with a wrong count or bytes
behind its triangles. Refused: what is missing, empty, damaged, a pointer of Git LFS or a web page, without faces,
compressed, a polygon that crosses itself, vertices that are not finite or beyond 1e12, files named by it that are not
there or lie elsewhere, more than POSEKIT_MOST_FACES or POSEKIT_MOST_MESH_BYTES.
"""

from __future__ import annotations

import json
import logging
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from objects import cuboid
from posekit.camera import Camera
from posekit.errors import MeshError
from posekit.geometry import Pose, cube_views, random_rotation, rotation_angle, so3_exp
from posekit.mesh.model import ObjectModel
from posekit.mesh.processing import smooth_normals
from posekit.mesh.symmetries import Symmetries
from posekit.render import Renderer

BOX = trimesh.creation.box((0.10, 0.06, 0.04))
CORNERS = np.asarray(BOX.vertices) + (0.3, 0.0, -0.1)  # its origin is far from its centre
FACES = np.asarray(BOX.faces)
COLOURS = np.arange(24).reshape(8, 3).astype(np.uint8) * 10


def write_ply(
    path: Path, vertices: np.ndarray, faces: list | np.ndarray, colours: bool = False, head: str = ""
) -> Path:
    """An ASCII PLY; with colours, those of COLOURS."""
    names = "property float x\nproperty float y\nproperty float z\n"
    rows = [" ".join(f"{x:.7g}" for x in v) for v in vertices]
    if colours:
        names += "".join(f"property uchar {c}\n" for c in ("red", "green", "blue"))
        rows = [f"{row} {r} {g} {b}" for row, (r, g, b) in zip(rows, COLOURS, strict=True)]
    rows += [" ".join(map(str, [len(f), *f])) for f in faces]
    path.write_text(
        f"ply\nformat ascii 1.0\n{head}element vertex {len(vertices)}\n{names}element face {len(faces)}\n"
        "property list uchar int vertex_indices\nend_header\n" + "\n".join(rows) + "\n"
    )
    return path


def write_obj(path: Path, texture: str = "skin.png") -> Path:
    """A textured quadrilateral and one more triangle, with an uv seam along the middle edge."""
    path.write_text(
        f"mtllib {path.stem}.mtl\nusemtl skin\n"
        "v 0 0 0\nv 0.1 0 0\nv 0.1 0.1 0\nv 0 0.1 0\nv 0.2 0 0\n"
        "vt 0 0\nvt 0.5 0\nvt 0.5 1\nvt 0 1\nvt 1 0\nvt 0.75 0\nvt 0.75 1\n"
        "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\nf 2/6 5/5 3/7\n"
    )
    path.with_suffix(".mtl").write_text(f"newmtl skin\nKd 0 0 0\nmap_Kd {texture}\n")
    return path


def picture(path: Path) -> np.ndarray:
    """A picture whose top left quarter is red and bottom right quarter is blue."""
    pixels = np.zeros((16, 32, 3), np.uint8)
    pixels[:8, :16] = (255, 0, 0)
    pixels[8:, 16:] = (0, 0, 255)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)
    return pixels


def sample(model: ObjectModel, uv: np.ndarray) -> np.ndarray:
    """The texture's colours at uvs (N, 2), v up, as OpenGL finds them."""
    assert model.texture is not None
    height, width = model.texture.shape[:2]
    x = np.floor((uv[:, 0] % 1) * width).astype(int)
    y = np.floor((1 - uv[:, 1] % 1) * height).astype(int).clip(max=height - 1)
    return model.texture[y, x]


def face_colours(model: ObjectModel) -> np.ndarray:
    """The texture's colour in the middle of each face."""
    assert model.uvs is not None
    return sample(model, model.uvs[model.faces].mean(axis=1))


# --- formats ---


def test_ascii_ply_with_colours_keeps_its_origin(tmp_path: Path) -> None:
    model = ObjectModel.load(write_ply(tmp_path / "box.ply", CORNERS * 1000, FACES, colours=True))
    assert (model.name, model.units) == ("box", "mm")
    np.testing.assert_allclose(model.center, [0.3, 0, -0.1], atol=1e-6)
    np.testing.assert_allclose(model.extents, [0.10, 0.06, 0.04], atol=1e-6)
    assert model.diameter == pytest.approx(np.linalg.norm([0.10, 0.06, 0.04]), rel=1e-5)
    np.testing.assert_allclose(model.T_obj_ctr.t, model.center)
    assert model.colors is not None
    for point, colour in zip(model.vertices, model.colors, strict=True):  # each colour stays with its corner
        corner = np.linalg.norm(CORNERS - point, axis=1).argmin()
        np.testing.assert_array_equal(colour, COLOURS[corner])
    assert (model.vertices.dtype, model.faces.dtype, model.normals.dtype) == (np.float32, np.int32, np.float32)


@pytest.mark.parametrize("suffix", ["ply", "stl", "glb", "obj"])
def test_what_trimesh_writes_is_read(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"box.{suffix}"
    trimesh.Trimesh(CORNERS, FACES, process=False).export(path)
    model = ObjectModel.load(path)
    np.testing.assert_allclose(model.center, [0.3, 0, -0.1], atol=1e-6)
    assert len(model.faces) == 12
    assert model.units == "m"
    assert model.texture is None


def test_binary_ply_with_colours(tmp_path: Path) -> None:
    trimesh.Trimesh(CORNERS, FACES, vertex_colors=COLOURS, process=False).export(tmp_path / "box.ply")
    model = ObjectModel.load(tmp_path / "box.ply")
    assert model.colors is not None
    np.testing.assert_array_equal(np.unique(model.colors, axis=0), np.unique(COLOURS, axis=0))


def test_quadrilaterals_become_triangles(tmp_path: Path) -> None:
    quads = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5)]
    assert len(ObjectModel.load(write_ply(tmp_path / "q.ply", CORNERS, quads)).faces) == 5


def test_the_files_normals_are_kept_and_made_unit(tmp_path: Path) -> None:
    normals = (CORNERS - CORNERS.mean(axis=0)) * 50
    path = tmp_path / "n.ply"
    trimesh.Trimesh(CORNERS, FACES, vertex_normals=normals, process=False).export(path, vertex_normal=True)
    model = ObjectModel.load(path)
    assert len(model.vertices) == 8
    np.testing.assert_allclose(model.normals, normals / np.linalg.norm(normals, axis=1, keepdims=True), atol=1e-5)


def test_obj_with_a_texture_and_an_uv_seam(tmp_path: Path) -> None:
    pixels = picture(tmp_path / "maps" / "skin.png")
    model = ObjectModel.load(write_obj(tmp_path / "thing.obj", r"maps\skin.png"))
    assert model.texture is not None
    assert model.uvs is not None
    np.testing.assert_array_equal(model.texture, pixels)
    assert model.colors is None
    assert len(model.vertices) == 7  # the seam's two corners lie there twice
    top_left = model.uvs[np.linalg.norm(model.vertices - (0, 0.1, 0), axis=1).argmin()]
    np.testing.assert_allclose(top_left, [0, 1])
    np.testing.assert_array_equal(sample(model, np.array([[0.01, 0.99], [0.99, 0.01]])), [[255, 0, 0], [0, 0, 255]])
    np.testing.assert_allclose(model.normals, np.tile([0, 0, 1], (7, 1)), atol=1e-6)  # smooth across the seam


def test_mtl_options_before_the_pictures_name(tmp_path: Path) -> None:
    picture(tmp_path / "skin.png")
    assert ObjectModel.load(write_obj(tmp_path / "thing.obj", "-s 1 1 1 skin.png")).texture is not None


def test_a_material_without_a_picture_gives_one_colour(tmp_path: Path) -> None:
    path = write_obj(tmp_path / "thing.obj")
    path.with_suffix(".mtl").write_text("newmtl skin\nKd 1 0.5 0\n")
    model = ObjectModel.load(path)
    assert model.colors is not None
    np.testing.assert_allclose(model.colors, np.tile([255, 127.5, 0], (7, 1)), atol=1)


def test_textured_ply(tmp_path: Path) -> None:
    pixels = picture(tmp_path / "skin.png")
    path = tmp_path / "plate.ply"
    path.write_text(
        "ply\nformat ascii 1.0\ncomment TextureFile skin.png\nelement vertex 4\n"
        "property float x\nproperty float y\nproperty float z\nproperty float nx\nproperty float ny\n"
        "property float nz\nproperty float texture_u\nproperty float texture_v\n"
        "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        "0.1 0.1 0 0 0.6 0.8 1 1\n0 0 0 0 0 1 0 0\n0.1 0 0 0.6 0 0.8 1 0\n0 0.1 0 0 0 1 0 1\n3 1 2 0\n3 1 0 3\n"
    )
    model = ObjectModel.load(path)
    assert model.texture is not None
    assert model.uvs is not None
    np.testing.assert_array_equal(model.texture, pixels)
    np.testing.assert_allclose(model.uvs, model.vertices[:, :2] * 10, atol=1e-6)
    lower_right = np.linalg.norm(model.vertices - (0.1, 0, 0), axis=1).argmin()
    np.testing.assert_allclose(model.normals[lower_right], [0.6, 0, 0.8], atol=1e-6)  # stays with its vertex


def test_ply_with_texture_coordinates_but_no_texture_keeps_its_colours(tmp_path: Path) -> None:
    path = tmp_path / "plate.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\nproperty float s\nproperty float t\n"
        "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0 10 20 30 0 0\n0.1 0 0 10 20 30 1 0\n0.1 0.1 0 10 20 30 1 1\n0 0.1 0 10 20 30 0 1\n3 0 1 2\n3 0 2 3\n"
    )
    model = ObjectModel.load(path)
    assert model.texture is None
    np.testing.assert_array_equal(model.colors, np.tile([10, 20, 30], (4, 1)))


def quad(colour_or_image: object, shift: float = 0.0, repeats: float = 1.0) -> trimesh.Trimesh:
    vertices = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]]) + (shift, 0, 0)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * repeats
    if isinstance(colour_or_image, np.ndarray):
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(colour_or_image))
    else:
        material = trimesh.visual.material.PBRMaterial(baseColorFactor=colour_or_image)
        uv = None
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)


def plain_picture(colour: tuple[int, int, int], size: tuple[int, int] = (40, 60)) -> np.ndarray:
    return np.tile(np.array(colour, np.uint8), (*size, 1))


def test_glb_nodes_are_placed_and_their_textures_share_one(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    move = np.eye(4)
    move[:3, 3] = (0, 0, 0.5)
    half = plain_picture((0, 200, 0))
    half[:20] = (200, 200, 0)  # the upper half
    scene.add_geometry(quad(plain_picture((200, 0, 0)), 0.0), geom_name="a")
    scene.add_geometry(quad(half, 0.2), geom_name="b", transform=move)
    scene.add_geometry(quad((0, 0, 255, 255), 0.4), geom_name="c")
    scene.export(tmp_path / "scene.glb")
    model = ObjectModel.load(tmp_path / "scene.glb")
    middles = model.vertices[model.faces].mean(axis=1)
    colours = face_colours(model)
    for middle, colour in zip(middles, colours, strict=True):
        if middle[0] < 0.15:
            expected, z = (200, 0, 0), 0.0
        elif middle[0] < 0.35:
            expected, z = (200, 200, 0) if middle[1] > 0.05 else (0, 200, 0), 0.5
        else:
            expected, z = (0, 0, 255), 0.0
        np.testing.assert_allclose(colour, expected, atol=1)
        assert middle[2] == pytest.approx(z)


def test_repeated_textures_survive_the_atlas(tmp_path: Path) -> None:
    checks = plain_picture((250, 250, 250), (8, 8))
    checks[:4, :4] = checks[4:, 4:] = 0
    scene = trimesh.Scene([quad(checks, 0.0, repeats=3.0), quad(plain_picture((200, 0, 0)), 0.2)])
    scene.export(tmp_path / "scene.glb")
    model = ObjectModel.load(tmp_path / "scene.glb")
    assert model.uvs is not None
    assert model.uvs.min() >= 0
    assert model.uvs.max() <= 1
    corners = model.uvs[(model.vertices[:, 0] < 0.15)]
    low, high = corners.min(axis=0), corners.max(axis=0)
    inside = low + (high - low) * np.array([[1 / 12, 1 / 12], [3 / 12, 1 / 12], [5 / 12, 1 / 12], [11 / 12, 11 / 12]])
    np.testing.assert_array_equal(sample(model, inside)[:, 0] > 100, [True, False, True, True])


def test_a_mirrored_node_is_not_turned_inside_out(tmp_path: Path) -> None:
    mirror = np.diag([-1.0, 1, 1, 1])
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.Trimesh(CORNERS, FACES, process=False), transform=mirror)
    scene.export(tmp_path / "m.glb")
    model = ObjectModel.load(tmp_path / "m.glb")
    np.testing.assert_allclose(model.center, [-0.3, 0, -0.1], atol=1e-6)
    middles = model.vertices[model.faces].mean(axis=1) - model.center
    corners = model.vertices[model.faces]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("ij,ij->i", middles, outward) > 0).all()
    assert (np.einsum("ij,ij->i", model.vertices - model.center, model.normals) > 0).all()


def test_textured_and_vertex_coloured_parts_do_not_mix(tmp_path: Path) -> None:
    coloured = trimesh.Trimesh(CORNERS, FACES, vertex_colors=COLOURS, process=False)
    trimesh.Scene([quad(plain_picture((200, 0, 0))), coloured]).export(tmp_path / "s.glb")
    with pytest.raises(MeshError, match="bake them into one texture"):
        ObjectModel.load(tmp_path / "s.glb")


# --- geometry ---


def test_degenerate_faces_and_stray_vertices_are_dropped(tmp_path: Path) -> None:
    vertices = np.vstack([CORNERS, [[9, 9, 9]]])
    faces = np.vstack([FACES, [[0, 0, 1]]])
    model = ObjectModel.load(write_ply(tmp_path / "box.ply", vertices, faces), units="m")
    assert len(model.faces) == 12
    assert model.vertices.max() < 1


def test_edges_of_a_box_stay_sharp_and_a_sphere_is_smooth() -> None:
    box = ObjectModel.from_arrays(CORNERS, FACES)
    assert len(box.vertices) == 24
    np.testing.assert_allclose(np.abs(box.normals).max(axis=1), 1, atol=1e-6)
    sphere = trimesh.creation.icosphere(3, 0.05)
    model = ObjectModel.from_arrays(sphere.vertices, sphere.faces)
    assert len(model.vertices) == len(sphere.vertices)
    np.testing.assert_allclose(model.normals, model.vertices / 0.05, atol=0.02)


def test_normals_do_not_depend_on_how_faces_are_cut() -> None:
    """A corner of a cube has two or one triangles on a side; weighted by angles that makes no difference."""
    _, _, unit = smooth_normals(
        np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]])
    )
    np.testing.assert_allclose(unit, np.tile([0, 0, 1], (4, 1)), atol=1e-12)


def test_useless_normals_are_repaired() -> None:
    normals = np.tile([0.0, 0, 2], (4, 1))
    normals[1], normals[2] = 0, np.nan
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    model = ObjectModel.from_arrays(flat, [[0, 1, 2], [0, 2, 3]], normals=normals)
    np.testing.assert_allclose(model.normals, np.tile([0, 0, 1], (4, 1)))


def test_a_flat_object_has_a_diameter_and_an_outline() -> None:
    model = ObjectModel.from_arrays([[0, 0, 0], [0.3, 0, 0], [0.3, 0.4, 0], [0, 0.4, 0]], [[0, 1, 2], [0, 2, 3]])
    assert model.diameter == pytest.approx(0.5)
    assert len(model.hull_vertices) == 4


@settings(max_examples=20, derandomize=True, deadline=None)
@given(st.integers(0, 1000))
def test_diameter_is_the_largest_distance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(60, 3)) * rng.uniform(0.01, 1, size=3) @ random_rotation(rng)
    model = ObjectModel.from_arrays(points, rng.permuted(np.tile(np.arange(60), (40, 1)), axis=1)[:, :3])
    v = model.vertices.astype(float)
    assert model.diameter == pytest.approx(np.linalg.norm(v[:, None] - v[None], axis=-1).max(), rel=1e-6)


def test_diameter_of_a_hull_with_very_many_corners() -> None:
    directions = trimesh.creation.icosphere(5, 0.05)
    assert ObjectModel.from_arrays(directions.vertices, directions.faces).diameter == pytest.approx(0.1, rel=1e-3)


@pytest.mark.parametrize("textured", [False, True])
def test_a_simplified_mesh_looks_the_same(textured: bool) -> None:
    """Shape, colours and texture, seams included: six sides of a box lie apart in its texture."""
    vertices, faces = cuboid((-0.05, -0.04, -0.03), (0.05, 0.04, 0.03), cells=24)
    vertices = vertices + 0.004 * np.sin(60 * vertices[:, [1, 2, 0]])  # not quite flat
    colors = (120 + 100 * np.sin(40 * vertices[:, [2, 0, 1]])).astype(np.uint8)
    more = {"colors": colors}
    if textured:
        side, place = np.divmod(np.arange(len(vertices)), 25 * 25)
        u, v = np.divmod(place, 25)
        uvs = np.stack([(side % 3 + 0.1 + 0.8 * u / 24) / 3, (side // 3 + 0.1 + 0.8 * v / 24) / 2], axis=1)
        rows, columns = np.mgrid[:256, :384]
        picture = np.stack([rows, columns % 200, 40 * (rows // 128) + 60 * (columns // 128)], axis=2)
        more = {"uvs": uvs, "texture": picture.astype(np.uint8)}
    whole = ObjectModel.from_arrays(vertices, faces, symmetries=Symmetries.parse("z:2", np.zeros(3)), **more)
    fewer = whole.simplified(1500)
    assert len(whole.faces) == 6912 and len(fewer.faces) <= 1500 and whole.simplified(7000) is whole
    assert fewer.symmetries is whole.symmetries and fewer.name == whole.name
    camera, renderer = Camera.from_fov(0.4, 160, 120), Renderer()
    for view in cube_views():
        pose = Pose(so3_exp(np.array([0.5, 0.4, 0.3])) @ view, np.array([0, 0, 0.4]))
        [before], [after] = (renderer.render(model, [pose], [camera]) for model in (whole, fewer))
        both = before.mask & after.mask
        assert both.sum() > 0.985 * (before.mask | after.mask).sum()
        assert np.percentile(np.linalg.norm(before.coords - after.coords, axis=2)[both], 95) < 0.001
        assert np.abs(before.image[both].astype(float) - after.image[both]).mean() < 4


# --- units ---


def scaled(tmp_path: Path, diameter: float, units: str = "auto") -> ObjectModel:
    size = np.linalg.norm([0.10, 0.06, 0.04])
    return ObjectModel.load(write_ply(tmp_path / "duck.ply", np.asarray(BOX.vertices) * diameter / size, FACES), units)


@pytest.mark.parametrize(("given", "units", "metres"), [(102, "mm", 0.102), (0.25, "m", 0.25), (2.9, "m", 2.9)])
def test_auto_decides_by_the_diameter_and_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, given: float, units: str, metres: float
) -> None:
    caplog.set_level(logging.INFO, logger="posekit")
    model = scaled(tmp_path, given)
    assert model.units == units
    assert model.diameter == pytest.approx(metres, rel=1e-5)
    assert f"--units {units}" in caplog.text
    assert "duck.ply" in caplog.text


@pytest.mark.parametrize(
    ("given", "units", "text"),
    [
        (7.0, "auto", "could be metres or millimetres: give --units m or --units mm"),
        (
            102.0,
            "m",
            r"duck.ply has a diameter of 102 m; posekit works in metres: give --units mm or --units cm",
        ),
        (0.5, "mm", r"has a diameter of 0.5 mm; posekit works in metres: give --units m or --units cm"),
        (50_000.0, "auto", "from 1 mm to 10 m: scale the mesh"),
        (0.0004, "auto", "from 1 mm to 10 m: scale the mesh"),
        (1.0, "inch", "units are auto, mm, cm, m, in, not 'inch'"),
    ],
)
def test_implausible_sizes_are_refused(tmp_path: Path, given: float, units: str, text: str) -> None:
    with pytest.raises(MeshError, match=text):
        scaled(tmp_path, given, units)


def test_between_the_limits_units_given_by_hand_are_believed(tmp_path: Path) -> None:
    assert scaled(tmp_path, 7.0, "m").diameter == pytest.approx(7.0, rel=1e-5)
    assert scaled(tmp_path, 7.0, "mm").diameter == pytest.approx(0.007, rel=1e-5)


# --- symmetries ---


@pytest.mark.parametrize(
    ("text", "discrete", "continuous"),
    [("z:2", 1, 0), ("z:4", 3, 0), ("x:2,y:2", 3, 0), ("Z : inf", 0, 1), ("z:inf, x:2", 1, 1), ("z:4,x:2", 7, 0),
     ("x:4,y:4", 23, 0), ("none", 0, 0)],
)  # fmt: skip
def test_symmetries_by_hand(text: str, discrete: int, continuous: int) -> None:
    found = Symmetries.parse(text, [0.1, 0.2, 0.3])
    assert (len(found.discrete), len(found.continuous)) == (discrete, continuous)
    for transform in found.transforms(12):
        np.testing.assert_allclose(transform.apply([0.1, 0.2, 0.3]), [0.1, 0.2, 0.3], atol=1e-9)


@pytest.mark.parametrize("text", ["", "z", "z:1", "z:0", "w:2", "z:2;x:2", "z:2,", "z:-2", "z:half", "z:1000"])
def test_symmetries_that_make_no_sense(text: str) -> None:
    with pytest.raises(MeshError, match=r"is not AXIS:ORDER\. Give x, y or z"):
        Symmetries.parse(text, np.zeros(3))


def test_turns_that_generate_no_finite_group() -> None:
    with pytest.raises(MeshError, match="use inf"):
        Symmetries.parse("x:3,y:3", np.zeros(3))


def test_transforms_combine_as_bop_does() -> None:
    found = Symmetries.parse("z:inf,x:2", np.zeros(3)).transforms(8)
    assert len(found) == 16
    np.testing.assert_allclose(found[0].matrix, np.eye(4))
    angles = sorted({round(float(rotation_angle(a.R @ b.R.T)), 6) for a in found for b in found if a is not b})
    assert angles[0] == pytest.approx(2 * np.pi / 8, abs=1e-5)


def test_symmetries_beside_the_mesh(tmp_path: Path) -> None:
    flip = np.diag([-1.0, -1, 1, 1])
    flip[:3, 3] = (4, 2, 0)
    info = {
        "9": {"symmetries_discrete": [flip.ravel().tolist()]},
        "can": {"symmetries_continuous": [{"axis": [0, 0, 2], "offset": [10, 0, 0]}]},
    }
    (tmp_path / "models_info.json").write_text(json.dumps(info))
    for name in ("obj_000009.ply", "can.ply", "other.ply"):
        write_ply(tmp_path / name, CORNERS * 1000, FACES)
    by_number = ObjectModel.load(tmp_path / "obj_000009.ply").symmetries
    np.testing.assert_allclose(by_number.discrete[0].t, [0.004, 0.002, 0])
    by_stem = ObjectModel.load(tmp_path / "can.ply").symmetries
    np.testing.assert_allclose(by_stem.continuous[0].axis, [0, 0, 1])
    np.testing.assert_allclose(by_stem.continuous[0].offset, [0.01, 0, 0])
    moved = by_stem.continuous[0].turn(1.0)
    np.testing.assert_allclose(moved.apply([0.01, 0, 5]), [0.01, 0, 5], atol=1e-12)
    assert len(ObjectModel.load(tmp_path / "other.ply").symmetries.transforms()) == 1

    by_hand = ObjectModel.load(tmp_path / "can.ply", symmetry="z:2").symmetries
    assert not by_hand.continuous
    np.testing.assert_allclose(by_hand.discrete[0].apply([0.3, 0, -0.1]), [0.3, 0, -0.1], atol=1e-6)
    assert not ObjectModel.load(tmp_path / "can.ply", symmetry="none").symmetries.continuous
    given = Symmetries((Pose.rotation(np.diag([1.0, -1, -1])),))
    assert ObjectModel.load(tmp_path / "can.ply", symmetry=given).symmetries is given

    (tmp_path / "mine.json").write_text(json.dumps(info["9"]))
    assert len(ObjectModel.load(tmp_path / "other.ply", symmetry=str(tmp_path / "mine.json")).symmetries.discrete) == 1
    with pytest.raises(MeshError, match="there is no symmetry file"):
        ObjectModel.load(tmp_path / "other.ply", symmetry=str(tmp_path / "not.json"))


@pytest.mark.parametrize(
    "info",
    [
        "{",
        "[]",
        '{"box": {"symmetries_discrete": [[1, 2]]}}',
        '{"box": {"symmetries_discrete": [[0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1]]}}',
        '{"box": {"symmetries_discrete": [[1%s, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]}}' % ("0" * 400),
        "[" * 100_000,
        '{"box": {"symmetries_continuous": [{"offset": [0, 0, 0]}]}}',
        '{"box": {"symmetries_continuous": [{"axis": [0, 0, 0]}]}}',
    ],
)
def test_damaged_symmetry_files(tmp_path: Path, info: str) -> None:
    (tmp_path / "models_info.json").write_text(info)
    write_ply(tmp_path / "box.ply", CORNERS, FACES)
    with pytest.raises(MeshError, match=r"the symmetries in .*models_info.json cannot be used"):
        ObjectModel.load(tmp_path / "box.ply")


# --- what is refused ---


def test_missing_files_and_unknown_formats(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match=r"there is no mesh .*nothing.ply: check the path"):
        ObjectModel.load(tmp_path / "nothing.ply")
    (tmp_path / "box.step").write_text("x")
    with pytest.raises(MeshError, match=r"has the extension .step: posekit reads .ply, .obj, .glb"):
        ObjectModel.load(tmp_path / "box.step")
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(MeshError, match="cannot be read"):
        ObjectModel.load(tmp_path / "folder.ply")


@pytest.mark.parametrize("name", ["a.ply", "a.obj", "a.glb", "a.stl", "a.gltf"])
def test_empty_and_damaged_files(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(b"")
    with pytest.raises(MeshError, match=r"is an empty file: export the mesh again"):
        ObjectModel.load(path)
    path.write_bytes(b"hello, this is no mesh at all\n" * 3)
    with pytest.raises(MeshError, match=r"again"):
        ObjectModel.load(path)


def test_truncated_binary_ply(tmp_path: Path) -> None:
    path = tmp_path / "box.ply"
    trimesh.Trimesh(CORNERS, FACES, process=False).export(path)
    path.write_bytes(path.read_bytes()[:-60])
    with pytest.raises(MeshError, match=r"box.ply cannot be read as PLY"):
        ObjectModel.load(path)


def test_meshes_without_a_surface(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match=r"8 (vertices|points) and no faces"):
        ObjectModel.load(write_ply(tmp_path / "points.ply", CORNERS, []))
    with pytest.raises(MeshError, match="is an empty mesh: it has no vertices"):
        ObjectModel.load(write_ply(tmp_path / "none.ply", np.zeros((0, 3)), []))
    with pytest.raises(MeshError, match=r"has 1 face with an area: an object needs at least two"):
        ObjectModel.load(write_ply(tmp_path / "one.ply", CORNERS, FACES[:1]))
    with pytest.raises(MeshError, match=r"has no faces with an area"):
        ObjectModel.load(write_ply(tmp_path / "line.ply", np.outer(np.arange(8), [1, 1, 1]), FACES))
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    with pytest.raises(MeshError, match=r"2 points and no faces"):
        ObjectModel.load(tmp_path / "points.obj")


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_vertices_that_are_no_numbers(tmp_path: Path, bad: float) -> None:
    vertices = CORNERS.copy()
    vertices[3, 1] = bad
    with pytest.raises(
        MeshError, match=r"has 1 vertices that are NaN, infinite or beyond 1e\+12 \(the first is number 3\)"
    ):
        ObjectModel.load(write_ply(tmp_path / "box.ply", vertices, FACES))


def test_faces_that_name_no_vertex(tmp_path: Path) -> None:
    faces = FACES.copy()
    faces[2, 0] = 8
    with pytest.raises(MeshError, match="a face that names vertex 8, but its vertices are 0 to 7"):
        ObjectModel.load(write_ply(tmp_path / "box.ply", CORNERS, faces))
    (tmp_path / "box.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 2 9\n")
    with pytest.raises(MeshError, match=r"box.obj cannot be read as OBJ.*Export it again"):
        ObjectModel.load(tmp_path / "box.obj")


def test_missing_and_damaged_textures(tmp_path: Path) -> None:
    path = write_obj(tmp_path / "thing.obj")
    with pytest.raises(MeshError, match=r"thing.obj names the file 'skin.png', which is not there: put it at"):
        ObjectModel.load(path)
    picture(tmp_path / "skin.png")
    (tmp_path / "skin.png").write_bytes((tmp_path / "skin.png").read_bytes()[:70])
    with pytest.raises(MeshError, match="which is not a readable picture"):
        ObjectModel.load(path)
    path.with_suffix(".mtl").unlink()
    with pytest.raises(MeshError, match=r"names the file 'thing.mtl', which is not there"):
        ObjectModel.load(path)
    ply = write_ply(tmp_path / "box.ply", CORNERS, FACES, head="comment TextureFile gone.png\n")
    with pytest.raises(MeshError, match=r"names the file 'gone.png'"):
        ObjectModel.load(ply)


def test_arrays_that_do_not_fit() -> None:
    with pytest.raises(MeshError, match=r"vertices are \(V, 3\) and faces \(F, 3\), not \(8, 2\)"):
        ObjectModel.from_arrays(CORNERS[:, :2], FACES)
    with pytest.raises(MeshError, match=r"colors must be finite numbers in 8 rows"):
        ObjectModel.from_arrays(CORNERS, FACES, colors=COLOURS[:5])


# --- meshes as other programs write them ---
# Read: polygons of any number of corners, concave ones too; colours as fractions, 0 to 255 or 16 bits, of vertices or
# faces, also named diffuse_red; negative indices; names with %20, other capitals or another machine's folders; binary
# STL with a wrong count. Refused: polygons that cross themselves, geometry compressed with Draco or meshopt, files
# outside the mesh's folder. Warned of: colours that are not understood, a count that is wrong.

ELL = [(100, 10), (10, 10), (10, 80), (0, 80), (0, 0), (100, 0)]
YOU = [(0, 0), (60, 0), (60, 60), (45, 60), (45, 15), (15, 15), (15, 60), (0, 60)]
ARROW = [(0, 0), (50, 20), (100, 0), (50, 80)]


def plate(outline: list[tuple[int, int]], turns: int) -> tuple[np.ndarray, list[list[int]]]:
    """A plate of an outline, 12 thick: vertices, and polygons whose first corner is any of the outline's."""
    n = len(outline)
    vertices = np.array([(x, y, z) for z in (0, 12) for x, y in outline], float)
    top = [n + (k + turns) % n for k in range(n)]
    sides = [[k, (k + 1) % n, n + (k + 1) % n, n + k] for k in range(n)]
    return vertices, [top, [k - n for k in top[::-1]], *sides]


def areas_and_volume(model: ObjectModel) -> tuple[float, float]:
    corners = model.vertices.astype(float)[model.faces] * 1000
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * np.linalg.norm(cross, axis=1).sum(), np.einsum("fi,fi->", corners[:, 0], cross) / 6


@pytest.mark.parametrize("suffix", ["obj", "ply"])
@pytest.mark.parametrize("outline", [ELL, YOU, ARROW], ids=["L", "U", "arrow"])
def test_concave_polygons_keep_their_shape(suffix: str, outline: list[tuple[int, int]], tmp_path: Path) -> None:
    x, y = np.array(outline, float).T
    area = 0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))
    rim = np.hypot(np.roll(x, -1) - x, np.roll(y, -1) - y).sum()
    for turns in range(len(outline)):
        vertices, polygons = plate(outline, turns)
        path = tmp_path / f"plate.{suffix}"
        if suffix == "ply":
            write_ply(path, vertices, polygons)
        else:
            path.write_text("".join(f"v {a} {b} {c}\n" for a, b, c in vertices)
                            + "".join("f " + " ".join(str(k + 1) for k in p) + "\n" for p in polygons))  # fmt: skip
        surface, volume = areas_and_volume(ObjectModel.load(path, units="mm"))
        assert surface == pytest.approx(2 * area + 12 * rim, rel=1e-4)
        assert abs(volume) == pytest.approx(12 * area, rel=1e-4)


def test_a_polygon_that_crosses_itself_is_refused(tmp_path: Path) -> None:
    star = [(np.cos(2.4 * np.pi * k / 3 * 2 / 2), np.sin(2.4 * np.pi * k / 3 * 2 / 2), 0.0) for k in range(5)]
    path = tmp_path / "star.obj"
    path.write_text("".join(f"v {a} {b} {c}\n" for a, b, c in star) + "f 1 2 3 4 5\nf 5 4 3 2 1\n")
    with pytest.raises(
        MeshError, match=r"star.obj has a polygon of 5 corners that crosses itself.*triangulate the mesh"
    ):
        ObjectModel.load(path)


def test_negative_indices_and_continued_lines(tmp_path: Path) -> None:
    vertices, polygons = plate(ELL, 0)
    path = tmp_path / "plate.obj"
    text = "".join(f"v {a} {b} {c}\n" for a, b, c in vertices)
    path.write_text(text + "".join("f " + " \\\n".join(str(k - 12) for k in p) + "\n" for p in polygons))
    assert abs(areas_and_volume(ObjectModel.load(path, units="mm"))[1]) == pytest.approx(12 * 1700, rel=1e-4)


def coloured_ply(path: Path, kind: str, scale: float, names: tuple[str, ...] = ("red", "green", "blue")) -> Path:
    head = "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n"
    head += "".join(f"property {kind} {name}\n" for name in names)
    head += "element face 12\nproperty list uchar int vertex_indices\nend_header\n"
    number = "{:.6f}" if kind in ("float", "double") else "{:.0f}"
    rows = [" ".join([*map(str, v), *(number.format(float(x) * scale) for x in c)])
            for v, c in zip(CORNERS, COLOURS, strict=True)]  # fmt: skip
    path.write_text(head + "\n".join(rows) + "\n" + "".join("3 {} {} {}\n".format(*f) for f in FACES))
    return path


@pytest.mark.parametrize(
    ("kind", "scale"),
    [("uchar", 1), ("float", 1 / 255), ("double", 1 / 255), ("float", 1), ("double", 1), ("int", 1), ("ushort", 1),
     ("ushort", 257), ("int", 257), ("uint", 257)],
)  # fmt: skip
@pytest.mark.parametrize("names", [("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"),
                                   ("r", "g", "b")])  # fmt: skip
def test_colours_of_every_kind(kind: str, scale: float, names: tuple[str, ...], tmp_path: Path) -> None:
    model = ObjectModel.load(coloured_ply(tmp_path / "c.ply", kind, scale, names))
    assert model.colors is not None
    assert {tuple(c) for c in model.colors.tolist()} == {tuple(c) for c in COLOURS.tolist()}


def test_colours_that_are_not_understood_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert ObjectModel.load(coloured_ply(tmp_path / "a.ply", "float", -1)).colors is None
    assert "a.ply: its colours are from -230 to 0, which is not understood" in caplog.text
    assert (
        ObjectModel.load(coloured_ply(tmp_path / "b.ply", "uchar", 1, ("my_red", "my_green", "my_blue"))).colors is None
    )
    assert "b.ply: its colours (my_red, my_green, my_blue) are not understood" in caplog.text


@pytest.mark.parametrize("scale", [1, 255])
def test_obj_colours(scale: int, tmp_path: Path) -> None:
    rows = [(*v, *(c / 255 * scale)) for v, c in zip(CORNERS, COLOURS, strict=True)]
    text = "".join("v {} {} {} {:.5f} {:.5f} {:.5f}\n".format(*row) for row in rows)
    (tmp_path / "c.obj").write_text(text + "".join("f {} {} {}\n".format(*(f + 1)) for f in FACES))
    model = ObjectModel.load(tmp_path / "c.obj")
    assert model.colors is not None
    assert {tuple(c) for c in model.colors.tolist()} == {tuple(c) for c in COLOURS.tolist()}


def test_polygons_with_a_colour_of_their_own(tmp_path: Path) -> None:
    vertices, polygons = plate(ELL, 2)
    head = "ply\nformat ascii 1.0\nelement vertex 12\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 8\n"
    head += "property list uchar int vertex_indices\n" + "".join(
        f"property uchar {c}\n" for c in ("red", "green", "blue")
    )
    rows = [" ".join(map(str, v)) for v in vertices]
    rows += [" ".join(map(str, [len(p), *p, 20 * k, 7, 9])) for k, p in enumerate(polygons)]
    (tmp_path / "p.ply").write_text(head + "end_header\n" + "\n".join(rows) + "\n")
    model = ObjectModel.load(tmp_path / "p.ply", units="mm")
    assert model.colors is not None and abs(areas_and_volume(model)[1]) == pytest.approx(12 * 1700, rel=1e-4)
    top = model.colors[model.vertices[:, 2] > 0.011]
    assert (0, 7, 9) in {tuple(c) for c in top.tolist()}


@pytest.mark.parametrize("name", ["C:\\Users\\x\\Desktop\\skin.png", "/home/x/skin.png", "SKIN.PNG", "my%20skin.png",
                                  "..\\tex\\skin.png", "./skin.png", "-bm 1.0 .\\skin.png"])  # fmt: skip
def test_textures_are_found_beside_the_mesh(name: str, tmp_path: Path) -> None:
    pixels = picture(tmp_path / ("my skin.png" if "%20" in name else "skin.png"))
    model = ObjectModel.load(write_obj(tmp_path / "m.obj", name))
    assert model.texture is not None
    np.testing.assert_array_equal(model.texture, pixels)


def test_nothing_outside_the_meshs_folder_is_read(tmp_path: Path) -> None:
    picture(tmp_path / "secret.png")
    (tmp_path / "inside").mkdir()
    for name in ("../secret.png", str(tmp_path / "secret.png"), "..\\secret.png", "%2e%2e/secret.png"):
        with pytest.raises(MeshError, match=r"which is not there: put it at .*inside.secret.png"):
            ObjectModel.load(write_obj(tmp_path / "inside" / "m.obj", name))
    (tmp_path / "inside" / "link.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(MeshError, match="which is not there"):
        ObjectModel.load(write_obj(tmp_path / "inside" / "m.obj", "link.png"))


@pytest.mark.parametrize("bits", [12, 16])
def test_deep_textures(bits: int, tmp_path: Path) -> None:
    ramp = np.tile(np.linspace(0, (1 << bits) - 1, 32).astype(np.uint16), (16, 1))
    cv2.imwrite(str(tmp_path / "skin.png"), np.dstack([ramp, ramp // 2, ramp // 4]))
    model = ObjectModel.load(write_obj(tmp_path / "m.obj"))
    assert model.texture is not None and model.texture[0, -1].tolist() == [64, 127, 255]
    cv2.imwrite(str(tmp_path / "skin.png"), ramp)
    model = ObjectModel.load(write_obj(tmp_path / "m.obj"))
    assert model.texture is not None and abs(int(model.texture[0, 16, 0]) - 131) < 2


def binary_stl(path: Path, told: int, tail: bytes = b"") -> Path:
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *CORNERS[f].ravel(), 0) for f in FACES)
    path.write_bytes(b"solid or not".ljust(80) + struct.pack("<I", told) + body + tail)
    return path


@pytest.mark.parametrize("told", [0, 5, 19, 2**32 - 1])
def test_stl_is_read_by_its_size(told: int, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert len(ObjectModel.load(binary_stl(tmp_path / "a.stl", told)).faces) == 12
    assert f"a.stl: it says that it has {told} triangles, its size that it has 12" in caplog.text


def test_stl_that_is_cut_off(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match=r"says that it has 20 triangles, and ends within number 13: it is cut off"):
        ObjectModel.load(binary_stl(tmp_path / "a.stl", 20, bytes(20)))


@pytest.mark.parametrize("told", [12, 5])
def test_bytes_behind_the_triangles_of_an_stl(told: int, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert len(ObjectModel.load(binary_stl(tmp_path / "a.stl", told, bytes(7))).faces) == told
    assert f"bytes follow its {told} triangles and are not read" in caplog.text


def mixed_ply(path: Path, order: str, *, colours: str = "", cut: int = 0, changed: int | None = None) -> Path:
    """A prism over an L in binary PLY: two polygons of six corners, six of four. colours: of the faces, "before" or
    "after" their corners."""
    corners = [(100, 10), (10, 10), (10, 80), (0, 80), (0, 0), (100, 0)]
    polygons = [[11, 10, 9, 8, 7, 6][::-1], [5, 4, 3, 2, 1, 0]]
    polygons += [[k, (k + 1) % 6, 6 + (k + 1) % 6, 6 + k] for k in range(6)]
    rgb = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
    head = (
        f"ply\nformat binary_{'little' if order == '<' else 'big'}_endian 1.0\nelement vertex 12\nproperty float x\n"
        f"property float y\nproperty double z\nelement face 8\n{rgb if colours == 'before' else ''}"
        f"property list uint8 uint vertex_indices\n{rgb if colours == 'after' else ''}end_header\n"
    ).encode()
    data = b"".join(struct.pack(order + "ffd", x, y, z) for z in (0, 12) for x, y in corners)
    for k, polygon in enumerate(polygons):
        row = struct.pack(f"{order}B{len(polygon)}I", len(polygon), *polygon)
        colour = bytes((30 * k, 5, 6))
        data += colour + row if colours == "before" else row + colour if colours == "after" else row
    if changed is not None:  # the first polygon's number of corners
        at = 12 * 16 + (3 if colours == "before" else 0)
        data = data[:at] + bytes([changed]) + data[at + 1 :]
    path.write_bytes(head + data[: len(data) - cut])
    return path


def surface(model: ObjectModel) -> float:
    a, b, c = (np.asarray(model.vertices, dtype=np.float64)[model.faces[:, k]] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("colours", ["", "before", "after"])
def test_polygons_of_different_sizes_in_a_binary_ply(order: str, colours: str, tmp_path: Path) -> None:
    """As Blender writes quads and triangles together."""
    model = ObjectModel.load(mixed_ply(tmp_path / "a.ply", order, colours=colours), units="mm")
    assert len(model.faces) == 2 * 4 + 6 * 2
    assert surface(model) == pytest.approx((2 * 1700 + 360 * 12) * 1e-6)  # a fan would leave the L
    if colours:
        assert model.colors is not None
        assert np.unique(model.colors, axis=0).tolist() == [[30 * k, 5, 6] for k in range(8)]


@pytest.mark.parametrize(("cut", "changed"), [(1, None), (40, None), (0, 200), (0, 0)])
def test_a_damaged_binary_ply_of_polygons(cut: int, changed: int | None, tmp_path: Path) -> None:
    with pytest.raises(MeshError, match=r"a.ply (cannot be read as PLY|has a face that names vertex)"):
        ObjectModel.load(mixed_ply(tmp_path / "a.ply", "<", cut=cut, changed=changed))


@pytest.mark.parametrize("name", ["a.ply", "a.obj", "a.stl", "a.glb"])
@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\n", "git lfs pull"),
        ("\n<!DOCTYPE html><html></html>", "holds a web page"),
    ],
)
def test_files_that_hold_something_else(name: str, text: str, reason: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(MeshError, match=reason):
        ObjectModel.load(tmp_path / name)


def test_texts_in_utf16_are_read(tmp_path: Path) -> None:
    corners = "".join("v {} {} {}\n".format(*corner) for corner in CORNERS)
    faces = "".join("f {} {} {}\n".format(*(face + 1)) for face in FACES)
    (tmp_path / "a.obj").write_bytes((corners + faces).encode("utf-16"))
    assert len(ObjectModel.load(tmp_path / "a.obj").faces) == 12


@pytest.mark.parametrize("names", ["Red Green Blue", "ambient_red ambient_green ambient_blue"])
def test_more_names_of_colours(names: str, tmp_path: Path) -> None:
    properties = "".join(f"property uchar {name}\n" for name in names.split())
    rows = "".join("{} {} {} 9 80 200\n".format(*corner) for corner in CORNERS)
    faces = "".join("3 {} {} {}\n".format(*face) for face in FACES)
    (tmp_path / "a.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n{properties}"
        f"element face 12\nproperty list uchar int vertex_indices\nend_header\n{rows}{faces}"
    )
    colours = ObjectModel.load(tmp_path / "a.ply").colors
    assert colours is not None and colours[0].tolist() == [9, 80, 200]


@pytest.mark.parametrize("embedded", [True, False])
def test_textures_are_limited(embedded: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("POSEKIT_MOST_PIXELS", "1000")
    if embedded:
        textured_glb(tmp_path / "a.glb", None, cv2.imencode(".png", np.zeros((40, 40, 3), np.uint8))[1].tobytes())
    else:
        Image.new("RGB", (40, 40)).save(tmp_path / "a.png")
        (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd a.png\n")
        (tmp_path / "a.obj").write_text(
            "mtllib a.mtl\nv 0 0 0\nv 90 0 0\nv 0 90 0\nvt 0 0\nvt 1 0\nvt 1 1\nusemtl m\nf 1/1 2/2 3/3\n"
        )
    with pytest.raises(
        MeshError, match=r"has a texture of 40x40 pixels, at most 0.001 megapixels .* POSEKIT_MOST_PIXELS"
    ):
        ObjectModel.load(next(path for path in tmp_path.iterdir() if path.suffix in (".glb", ".obj")))


def test_texture_coordinates_that_are_no_pairs(tmp_path: Path) -> None:
    corners = "".join("v {} {} {}\n".format(*corner) for corner in CORNERS)
    faces = "".join("f {}/1 {}/2 {}/3\n".format(*(face + 1)) for face in FACES)
    Image.new("RGB", (8, 8)).save(tmp_path / "a.png")
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd a.png\n")
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{corners}vt 0 0\nvt 1 0\nvt 1\n1\nusemtl m\n{faces}")
    with pytest.raises(MeshError, match="texture coordinates that are no pairs of numbers"):
        ObjectModel.load(tmp_path / "a.obj")


def test_colours_of_a_material_up_to_255(tmp_path: Path) -> None:
    corners = "".join("v {} {} {}\n".format(*corner) for corner in CORNERS)
    faces = "".join("f {} {} {}\n".format(*(face + 1)) for face in FACES)
    (tmp_path / "a.mtl").write_text("newmtl m\nKd 200 30 0\n")
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{corners}usemtl m\n{faces}")
    colours = ObjectModel.load(tmp_path / "a.obj").colors
    assert colours is not None and colours[0].tolist() == [200, 30, 0]


def test_vertex_colours_that_are_not_understood_are_not_drawn(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    corners = "".join("v {} {} {} -0.5 0.5 0.9\n".format(*corner) for corner in CORNERS)
    faces = "".join("f {} {} {}\n".format(*(face + 1)) for face in FACES)
    (tmp_path / "a.obj").write_text(f"#MRGB ff00ff00\n{corners}{faces}")
    assert ObjectModel.load(tmp_path / "a.obj").colors is None
    assert "it is drawn grey" in caplog.text and "#MRGB" in caplog.text


@pytest.mark.parametrize(("extension", "told"), [("FOO_bar", "needs FOO_bar, which posekit does not know"),
                                                 ("KHR_texture_basisu", "compressed with Basis")])  # fmt: skip
def test_extensions_that_change_what_is_seen_are_told(
    extension: str, told: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    textured_glb(tmp_path / "a.glb", None)
    data = (tmp_path / "a.glb").read_bytes()
    length = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + length]) | {"extensionsRequired": [extension], "extensionsUsed": [extension]}
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII", b"glTF", 2, len(data) - length + len(text), len(text)) + b"JSON"
    (tmp_path / "a.glb").write_bytes(head + text + data[20 + length :])
    assert len(ObjectModel.load(tmp_path / "a.glb").faces)
    assert told in caplog.text


@pytest.mark.parametrize(("extension", "name"), [("KHR_draco_mesh_compression", "Draco"),
                                                 ("EXT_meshopt_compression", "meshopt")])  # fmt: skip
def test_compressed_geometry_is_named(extension: str, name: str, tmp_path: Path) -> None:
    document = json.dumps({"asset": {"version": "2.0"}, "extensionsRequired": [extension]}).encode()
    document += b" " * (-len(document) % 4)
    data = struct.pack("<III", 0x46546C67, 2, 20 + len(document)) + struct.pack("<II", len(document), 0x4E4F534A)
    (tmp_path / "a.glb").write_bytes(data + document)
    with pytest.raises(MeshError, match=rf"a.glb is compressed with {name}, .*export it without compression"):
        ObjectModel.load(tmp_path / "a.glb")


@pytest.mark.parametrize(("units", "metres"), [("mm", 0.001), ("cm", 0.01), ("m", 1.0), ("in", 0.0254)])
def test_units_by_hand(units: str, metres: float, tmp_path: Path) -> None:
    size = np.asarray(BOX.vertices) * (0.1 / metres) / np.linalg.norm((0.10, 0.06, 0.04))
    assert ObjectModel.load(write_ply(tmp_path / "b.ply", size, FACES), units=units).diameter == pytest.approx(0.1)


def test_the_note_on_units_says_the_size(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, logger="posekit")
    size = np.asarray(BOX.vertices) * 27 / np.linalg.norm((0.10, 0.06, 0.04))
    ObjectModel.load(write_ply(tmp_path / "b.ply", size, FACES))
    assert "the object is 27 mm long" in caplog.text and "; in cm it is 27 cm long" in caplog.text


def textured_glb(
    path: Path,
    moved: dict[str, object] | None,
    picture: bytes | None = None,
    material: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
) -> None:
    """A quad from trimesh, its colour texture moved, or replaced by another PNG. material: makes another of it."""
    scene = trimesh.Scene()
    scene.add_geometry(quad(plain_picture((200, 0, 0)), 0.0), geom_name="a")
    data = scene.export(file_type="glb")
    length = int.from_bytes(data[12:16], "little")
    document, buffer = json.loads(data[20 : 20 + length]), data[28 + length :]
    if moved is not None:
        texture = document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
        texture["extensions"] = {"KHR_texture_transform": moved}
        document["extensionsUsed"] = ["KHR_texture_transform"]
    if material is not None:
        document["materials"] = [material(document["materials"][0])]
    if picture is not None:
        start = len(buffer) + -len(buffer) % 4
        buffer = buffer.ljust(start, b"\0") + picture
        document["bufferViews"].append({"buffer": 0, "byteOffset": start, "byteLength": len(picture)})
        document["images"][0] = {"bufferView": len(document["bufferViews"]) - 1, "mimeType": "image/png"}
        document["buffers"][0]["byteLength"] = len(buffer)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    buffer += bytes(-len(buffer) % 4)
    chunks = len(text).to_bytes(4, "little") + b"JSON" + text + len(buffer).to_bytes(4, "little") + b"BIN\0" + buffer
    path.write_bytes(b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks)


def test_texture_transforms_are_applied(tmp_path: Path) -> None:
    textured_glb(tmp_path / "plain.glb", None)
    textured_glb(tmp_path / "moved.glb", {"offset": [0.5, 0.25], "scale": [0.5, 0.1]})
    textured_glb(tmp_path / "turned.glb", {"rotation": np.pi / 2})
    plain, moved, turned = (ObjectModel.load(tmp_path / f"{name}.glb").uvs for name in ("plain", "moved", "turned"))
    assert plain is not None and moved is not None and turned is not None
    u, v = plain[:, 0], 1 - plain[:, 1]  # as the file has them, v down
    np.testing.assert_allclose(moved, np.stack([0.5 + 0.5 * u, 1 - (0.25 + 0.1 * v)], axis=1), atol=1e-6)
    np.testing.assert_allclose(turned, np.stack([v, 1 + u], axis=1), atol=1e-6)


def test_a_transform_that_cannot_be_applied_is_told(tmp_path: Path) -> None:
    textured_glb(tmp_path / "a.glb", {"offset": "left"})
    with pytest.raises(MeshError, match="its texture transform cannot be applied"):
        ObjectModel.load(tmp_path / "a.glb")


def test_an_embedded_texture_of_twelve_bits_in_sixteen(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    deep = np.full((8, 8, 3), (0, 2048, 4095), np.uint16)  # OpenCV's order
    textured_glb(tmp_path / "a.glb", None, cv2.imencode(".png", deep)[1].tobytes())
    texture = ObjectModel.load(tmp_path / "a.glb").texture
    assert texture is not None and texture[0, 0].tolist() == [255, 128, 0]
    assert "they are taken for 12 bits" in caplog.text


@pytest.mark.parametrize("plain", [{}, {"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 1]}}])
def test_colours_of_specular_glossiness(tmp_path: Path, plain: dict[str, Any]) -> None:
    def textured(material: dict[str, Any]) -> dict[str, Any]:
        old = {"diffuseTexture": material["pbrMetallicRoughness"]["baseColorTexture"]}
        return plain | {"extensions": {"KHR_materials_pbrSpecularGlossiness": old}}

    def coloured(_: dict[str, Any]) -> dict[str, Any]:
        return {"extensions": {"KHR_materials_pbrSpecularGlossiness": {"diffuseFactor": [0.0, 1.0, 0.0, 1.0]}}}

    textured_glb(tmp_path / "a.glb", None, material=textured)
    texture = ObjectModel.load(tmp_path / "a.glb").texture
    assert texture is not None and texture[0, 0].tolist() == [200, 0, 0]  # it was white
    textured_glb(tmp_path / "b.glb", None, material=coloured)
    model = ObjectModel.load(tmp_path / "b.glb")
    colours = model.colors if model.texture is None else model.texture.reshape(-1, 3)
    assert colours is not None and colours[0].tolist() == [0, 255, 0]


@pytest.mark.parametrize(("mode", "alpha", "told"), [("MASK", 0, True), ("MASK", 255, False), ("OPAQUE", 0, False)])
def test_transparent_parts_are_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, mode: str, alpha: int, told: bool
) -> None:
    pixels = np.full((8, 8, 4), (0, 128, 255, 255), np.uint8)
    pixels[:4, :, 3] = alpha
    textured_glb(tmp_path / "a.glb", None, cv2.imencode(".png", pixels)[1].tobytes(), lambda m: m | {"alphaMode": mode})
    assert ObjectModel.load(tmp_path / "a.glb").texture is not None
    assert ("are transparent; they are drawn solid" in caplog.text) == told


def test_limits_of_meshes_can_be_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.ply"
    trimesh.creation.icosphere(2, 0.1).export(path)
    monkeypatch.setenv("POSEKIT_MOST_FACES", "100")
    with pytest.raises(MeshError, match=r"a\.ply has 320 faces, at most 100 are read.*set POSEKIT_MOST_FACES"):
        ObjectModel.load(path)
    monkeypatch.setenv("POSEKIT_MOST_MESH_BYTES", "1000")
    with pytest.raises(MeshError, match="set POSEKIT_MOST_MESH_BYTES"):
        ObjectModel.load(path)

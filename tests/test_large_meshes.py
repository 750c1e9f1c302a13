"""Meshes of very many faces: read, kept and drawn in bounded time and memory, with the results of the plain way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from posekit.camera import Camera
from posekit.geometry import Pose
from posekit.mesh import kept, light, ply, processing
from posekit.mesh.model import ObjectModel
from posekit.render import Renderer


@pytest.fixture
def sphere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A coloured sphere of 5120 faces, which counts as large; kept files go to a folder of their own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(kept, "FACES", 1000)
    monkeypatch.setattr(kept, "_BYTES", 1000)
    monkeypatch.setattr(light, "FACES", 3000)
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=50.0)
    mesh.visual.vertex_colors = np.clip(mesh.vertices * 2 + 128, 0, 255).astype(np.uint8)
    path = tmp_path / "sphere.ply"
    mesh.export(path)
    return path


def test_a_large_mesh_is_the_same_from_the_cache(sphere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = ObjectModel.load(sphere)
    monkeypatch.setattr("posekit.mesh.reading.read_parts", lambda path: pytest.fail("it was read again"))
    again = ObjectModel.load(sphere)
    for name in ("vertices", "faces", "normals", "colors", "hull_vertices"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name), strict=True)
    assert (again.name, again.units, again.digest) == ("sphere", "mm", first.digest)
    assert again.diameter == first.diameter


def test_a_small_mesh_of_plain_properties_is_kept_too(sphere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept, "FACES", 100_000)
    monkeypatch.setattr(kept, "_BYTES", 5_000_000)
    first = ObjectModel.load(sphere)
    monkeypatch.setattr("posekit.mesh.reading.read_parts", lambda path: pytest.fail("it was read again"))
    again = ObjectModel.load(sphere)
    for name in ("vertices", "faces", "normals", "colors", "hull_vertices"):
        np.testing.assert_array_equal(getattr(again, name), getattr(first, name), strict=True)
    assert again.diameter == first.diameter
    [file] = (sphere.parent / "cache").rglob("*.npz")
    assert file.parent.name == "meshes-small"


def test_a_small_mesh_of_other_properties_is_read_each_time(sphere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept, "FACES", 100_000)
    sphere.write_bytes(sphere.read_bytes().replace(b"uchar alpha", b"uchar gray0", 1))
    ObjectModel.load(sphere)
    assert not list((sphere.parent / "cache").rglob("*.npz"))


def test_a_changed_mesh_and_other_units_are_read_anew(sphere: Path) -> None:
    assert ObjectModel.load(sphere).diameter == pytest.approx(0.1, rel=0.01)
    assert ObjectModel.load(sphere, units="cm").diameter == pytest.approx(1.0, rel=0.01)
    data = sphere.read_bytes()
    sphere.write_bytes(data[:-4] + b"\x00\x00\x00\x00")
    ObjectModel.load(sphere)
    assert len(list((sphere.parent / "cache").rglob("*.npz"))) == 3


def test_a_damaged_kept_mesh_is_read_anew(sphere: Path) -> None:
    first = ObjectModel.load(sphere)
    [file] = (sphere.parent / "cache").rglob("*.npz")
    file.write_bytes(file.read_bytes()[:1000])
    np.testing.assert_array_equal(ObjectModel.load(sphere).vertices, first.vertices)


def test_normals_do_not_depend_on_portions(sphere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = ObjectModel.load(sphere)
    arguments = mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64)
    whole = processing.smooth_normals(*arguments)
    monkeypatch.setattr(processing, "_PORTION", 700)  # several of them: in threads
    for one, other in zip(processing.smooth_normals(*arguments), whole, strict=True):
        np.testing.assert_array_equal(one, other, strict=True)


def test_the_light_copy_looks_like_the_mesh(sphere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = ObjectModel.load(sphere)
    copy = light.light_copy(model)
    assert len(copy.faces) <= 3000
    assert light.light_copy(model) is copy
    monkeypatch.setattr(light, "_MADE", {})
    monkeypatch.setattr(ObjectModel, "simplified", lambda *_: pytest.fail("it was simplified again"))
    np.testing.assert_array_equal(light.light_copy(model).vertices, copy.vertices)
    camera, pose = Camera(600, 600, 79.5, 59.5, 160, 120), Pose.translation([0, 0, 0.7])
    [drawn] = Renderer().render(model, [pose], camera)
    monkeypatch.setattr("posekit.mesh.light.SHOWN", 0)
    [exact] = Renderer().render(model, [pose], camera)
    assert (drawn.mask != exact.mask).sum() < 0.1 * np.pi * 0.1 / 0.7 * 600  # a tenth of a pixel of the outline
    both = drawn.mask & exact.mask
    assert np.abs(drawn.image[both].astype(int) - exact.image[both]).mean() < 2


def test_templates_are_drawn_from_a_still_lighter_copy(sphere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(light, "TEMPLATE_FACES", 1500)
    model = ObjectModel.load(sphere)
    assert len(light.drawn_copy(model, 64).faces) <= 1500 < len(light.drawn_copy(model, 160).faces)
    assert light.drawn_copy(model, 64) is light.drawn_copy(model, 32)
    assert light.drawn_copy(model, light.SHOWN + 1) is model
    few = model.simplified(2000)
    assert light.drawn_copy(few, 64) is few


def test_files_of_triangles_alone_are_not_walked_through(sphere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ply, "_walk", lambda *_: pytest.fail("it was walked through"))
    data = sphere.read_bytes()
    assert ply.triangles_alone(data, "sphere") is data


@pytest.mark.parametrize("portion", [7, 1000])
def test_normals_do_not_depend_on_the_portions(portion: int, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2)
    vertices = mesh.vertices + np.random.default_rng(0).normal(0, 0.05, mesh.vertices.shape)
    whole = processing.smooth_normals(vertices, mesh.faces)
    monkeypatch.setattr(processing, "_PORTION", portion)
    for one, other in zip(whole, processing.smooth_normals(vertices, mesh.faces), strict=True):
        np.testing.assert_array_equal(one, other)


def test_distinct_pairs_are_those_of_numpy() -> None:
    rng = np.random.default_rng(0)
    vertex, normal = rng.integers(0, 20, 300), rng.integers(-1, 2, (300, 3)) * 5000
    keys = np.column_stack([vertex, normal])
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    for shift in (0, 3_000_000):  # the second has too many vertices for one number
        found = processing._distinct(vertex + shift, normal)
        np.testing.assert_array_equal(found[0], first)
        np.testing.assert_array_equal(found[1], inverse.ravel())

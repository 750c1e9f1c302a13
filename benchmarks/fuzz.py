"""Damaged and odd files for every reader: nothing but a PosekitError may leave it.

    python benchmarks/fuzz.py [--inputs 100000] [--seed 0] [--readers obj,glb] [--keep fuzz-faults]

Each input is a good file that is made on the spot and changed: bytes, numbers, names, parts of its JSON. A fault is an
exception that is no PosekitError, a log line that cannot be formatted, a process that dies, more than 5 seconds, more
than 6 GB, a file opened outside the input's own folder (Python's own and its libraries' code aside), anything written
at all, a connection or a program that is started. Files that libraries in C open by themselves are not seen.
The first input of each kind of fault is kept. An input depends on the reader, the seed and its number alone:
`--readers obj --first 1234 --inputs 1` makes that one again. Exit code 1 where there is a fault.
"""

from __future__ import annotations

import argparse
import copy
import io
import json
import logging
import os
import random
import re
import resource
import shutil
import signal
import struct
import subprocess
import sys
import sysconfig
import tempfile
import time
import traceback
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

SECONDS, MEMORY = 5, 6 << 30
SIZE = (64, 48)  # of pictures

Files = dict[str, bytes]  # by name; the first one is the one that is changed, unless a case says otherwise


@dataclass(frozen=True)
class Case:
    """Files of one input. changed: those of which one is changed at a time. opened: what the reader is given."""

    files: Files
    opened: str
    changed: tuple[str, ...]


@dataclass(frozen=True)
class Reader:
    """share: of all inputs, relative to the others. cases: good files. read: what is tried."""

    share: float
    cases: Callable[[], list[Case]]
    read: Callable[[Path], object]


# --- good files ---------------------------------------------------------------------------------------------------


def _single(files: Files) -> list[Case]:
    return [Case({name: data}, name, (name,)) for name, data in files.items()]


def _picture() -> Any:
    import numpy as np

    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    return np.stack([4 * x, 5 * y, (x * y) % 256], axis=-1).astype(np.uint8)


def images() -> list[Case]:
    import cv2
    import numpy as np
    from PIL import Image

    found: Files = {}
    rgb = Image.fromarray(_picture())
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769).update({0x920A: 4.2, 0xA405: 28, 0xA002: SIZE[0], 0xA003: SIZE[1]})
    for name, options in {
        "a.png": {}, "b.jpg": {"exif": exif, "quality": 90}, "c.tif": {"compression": "tiff_lzw"}, "d.bmp": {},
        "e.webp": {}, "f.gif": {}, "g.tif": {},
    }.items():  # fmt: skip
        file = io.BytesIO()
        rgb.save(file, {".jpg": "jpeg", ".tif": "tiff"}.get(name[-4:], name.split(".")[1]), **options)
        found[name] = file.getvalue()
    for name, mode in {"p.png": "P", "l.png": "L", "la.png": "LA", "one.png": "1", "rgba.png": "RGBA"}.items():
        file = io.BytesIO()
        rgb.convert(mode).save(file, "png")
        found[name] = file.getvalue()
    deep = _picture().astype(np.uint16) * 16
    for name, values in {"deep.png": deep, "deepgrey.png": deep[..., 0], "deep.tif": deep}.items():
        found[name] = cv2.imencode(Path(name).suffix, values)[1].tobytes()
    return _single(found)


def masks() -> list[Case]:
    import numpy as np
    from PIL import Image

    covered = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    covered[10:30, 12:40] = 255
    found: Files = {}
    for name, mode in {"m.png": "L", "one.png": "1", "m.jpg": "L", "p.png": "P", "rgba.png": "RGBA", "f.tif": "F",
                       "i.png": "I;16"}.items():  # fmt: skip
        file = io.BytesIO()
        kind = {"jpg": "jpeg", "tif": "tiff"}.get(name.split(".")[1], "png")
        Image.fromarray(covered).convert(mode).save(file, kind)
        found[name] = file.getvalue()
    return _single(found)


VERTICES = [(x, y, z) for x in (0, 60.0) for y in (0, 80.0) for z in (0, 100.0)]
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
FACES = [face for a, b, c, d in QUADS for face in ((a, b, c), (a, c, d))]
UVS = [(k % 2, k // 4) for k in range(8)]


def _texture() -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(_picture()[:8, :8]).save(file, "png")
    return file.getvalue()


def _ply(names: str, row: Callable[[int], str], polygons: list[tuple[int, ...]], comment: str = "") -> bytes:
    properties = "".join(f"property {name}\n" for name in names.split(",") if name)
    head = (
        f"ply\nformat ascii 1.0\n{comment}element vertex 8\nproperty float x\nproperty float y\nproperty float z\n"
        f"{properties}element face {len(polygons)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    body = "".join(f"{' '.join(map(str, v))} {row(k)}\n" for k, v in enumerate(VERTICES))
    return (head + body + "".join(f"{len(p)} {' '.join(map(str, p))}\n" for p in polygons)).encode()


def ply() -> list[Case]:
    colours = "uchar red,uchar green,uchar blue"
    head = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 12\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    body = b"".join(struct.pack("<3f3B", *v, 10 * k, 20, 30) for k, v in enumerate(VERTICES))
    binary = head.encode() + body + b"".join(struct.pack("<B3i", 3, *face) for face in FACES)
    mixed_head = head.replace("element face 12", "element face 8")
    mixed = QUADS[:4] + [face for a, b, c, d in QUADS[4:] for face in ((a, b, c), (a, c, d))]
    rows = b"".join(struct.pack(f"<B{len(face)}i", len(face), *face) for face in mixed)
    textured = _ply("float s,float t", lambda k: f"{UVS[k][0]} {UVS[k][1]}", FACES, "comment TextureFile tex.png\n")
    return [
        *_single({
            "plain.ply": _ply("", lambda _: "", FACES),
            "coloured.ply": _ply(colours, lambda k: f"{20 * k} 30 40", FACES),
            "float.ply": _ply(colours.replace("uchar", "float"), lambda k: f"{k / 8} 0.5 1", FACES),
            "polygons.ply": _ply("", lambda _: "", QUADS),
            "binary.ply": binary,
            "mixed.ply": mixed_head.encode() + body + rows,
        }),
        Case({"tex.ply": textured, "tex.png": _texture()}, "tex.ply", ("tex.ply", "tex.ply", "tex.png")),
    ]  # fmt: skip


def obj() -> list[Case]:
    places = "".join(f"v {x:g} {y:g} {z:g}\n" for x, y, z in VERTICES)
    quads = "".join("f " + " ".join(str(k + 1) for k in quad) + "\n" for quad in QUADS)
    coloured = "".join(f"v {x:g} {y:g} {z:g} {25 * k} 10 200\n" for k, (x, y, z) in enumerate(VERTICES))
    negative = "".join("f " + " ".join(str(k - 8) for k in quad) + "\n" for quad in QUADS)
    textured = "".join("f " + " ".join(f"{v + 1}/{k + 1}" for k, v in enumerate(quad)) + "\n" for quad in QUADS)
    bracket = [(100, 10), (10, 10), (10, 80), (0, 80), (0, 0), (100, 0)]
    ngon = "".join(f"v {x} {y} {z}\n" for z in (0, 12) for x, y in bracket) + "f 7 8 9 10 11 12\nf 6 5 4 3 2 1\n"
    corners = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    return [
        *_single({"quads.obj": (places + quads).encode(), "coloured.obj": (coloured + quads).encode(),
                  "negative.obj": (places + negative).encode(), "ngon.obj": ngon.encode()}),
        Case(
            {"tex.obj": f"mtllib tex.mtl\n{places}{corners}usemtl a\n{textured}".encode(),
             "tex.mtl": b"newmtl a\nKd 0.5 0.6 0.7\nmap_Kd -s 1 1 1 tex.png\n", "tex.png": _texture()},
            "tex.obj", ("tex.obj", "tex.mtl", "tex.png"),
        ),
    ]  # fmt: skip


def stl() -> list[Case]:
    binary = b"binary".ljust(80, b" ") + struct.pack("<I", len(FACES))
    ascii_ = "solid a\n"
    for face in FACES:
        corners = [VERTICES[k] for k in face]
        binary += struct.pack("<12f", 0, 0, 0, *(value for corner in corners for value in corner)) + b"\0\0"
        rows = "".join("vertex {:g} {:g} {:g}\n".format(*corner) for corner in corners)
        ascii_ += f"facet normal 0 0 0\nouter loop\n{rows}endloop\nendfacet\n"
    return _single({"binary.stl": binary, "ascii.stl": (ascii_ + "endsolid a\n").encode()})


def _gltf() -> tuple[dict[str, Any], bytes]:
    places = b"".join(struct.pack("<3f", *(0.001 * value for value in vertex)) for vertex in VERTICES)
    uvs = b"".join(struct.pack("<2f", *uv) for uv in UVS)
    faces = b"".join(struct.pack("<3H", *face) for face in FACES)
    parts, views, buffer = [places, uvs, faces, _texture()], [], b""
    for part in parts:
        views.append({"buffer": 0, "byteOffset": len(buffer), "byteLength": len(part)})
        buffer += part + b"\0" * (-len(part) % 4)
    moved = {"index": 0, "extensions": {"KHR_texture_transform": {"offset": [0.5, 0], "scale": [0.5, 1]}}}
    document = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
        "extensionsUsed": ["KHR_texture_transform"],
        "nodes": [{"mesh": 0, "translation": [0, 0, 0.1], "children": [1]}, {"mesh": 0, "scale": [-1, 1, 1]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": moved, "baseColorFactor": [1, 0.5, 0.5, 1]}}],
        "textures": [{"source": 0}], "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3", "min": [0, 0, 0],
             "max": [0.06, 0.08, 0.1]},
            {"bufferView": 1, "componentType": 5126, "count": 8, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 36, "type": "SCALAR"},
        ],
        "bufferViews": views, "buffers": [{"byteLength": len(buffer)}],
    }  # fmt: skip
    return document, buffer


def _glb(document: Any, buffer: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    buffer += b"\0" * (-len(buffer) % 4)
    return (
        struct.pack("<III", 0x46546C67, 2, 28 + len(text) + len(buffer)) + struct.pack("<II", len(text), 0x4E4F534A)
        + text + struct.pack("<II", len(buffer), 0x004E4942) + buffer
    )  # fmt: skip


def glb() -> list[Case]:
    document, buffer = _gltf()
    apart = json.loads(json.dumps(document))
    apart["buffers"][0]["uri"] = "part.bin"
    apart["images"] = [{"uri": "tex.png"}]
    files = {"part.gltf": json.dumps(apart).encode(), "part.bin": buffer, "tex.png": _texture()}
    return [
        *_single({"part.glb": _glb(document, buffer)}),
        Case(files, "part.gltf", ("part.gltf", "part.gltf", "part.bin", "tex.png")),
    ]


def cameras() -> list[Case]:
    K = [[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]]
    yaml = (
        "%YAML:1.0\n---\nimage_width: 64\nimage_height: 48\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n"
        "   dt: d\n   data: [60., 0., 31.5, 0., 60., 23.5, 0., 0., 1.]\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n   data: [-0.1, 0.02, 0, 0, 0]\n"
    )
    xml = (
        "<?xml version='1.0'?><opencv_storage><cameraMatrix type_id='opencv-matrix'><rows>3</rows><cols>3</cols>"
        "<dt>d</dt><data>60 0 31.5 0 60 23.5 0 0 1</data></cameraMatrix></opencv_storage>"
    )
    named = {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48,
             "distortion_coefficients": [-0.1, 0.02, 0, 0, 0], "distortion_model": "plumb_bob"}  # fmt: skip
    fisheye = {"K": K, "resolution": [48, 64], "distortion": [0.1, 0.01, 0.0, 0.0], "camera_model": "fisheye"}
    scene = {str(k): {"cam_K": sum(K, []), "depth_scale": 1.0} for k in (3, 8)}  # noqa: RUF017 - three rows
    single = {"camera": {"k1": -0.1, "k2": 0.02, "p1": 0.0, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5}}
    block = "camera_matrix:\n" + "".join(f"- {row}\n" for row in K) + "dist_coeffs: [[-0.1, 0.02, 0, 0, 0]]\n"
    return _single({
        "a.json": json.dumps(named).encode(), "b.json": json.dumps(fisheye).encode(), "c.yml": yaml.encode(),
        "d.yaml": block.encode(), "e.xml": xml.encode(), "f.json": json.dumps(scene).encode(),
        "g.txt": b"60 0 31.5\n0 60 23.5\n0 0 1\n", "h.json": json.dumps(single).encode(),
    })  # fmt: skip


_IDENTITY = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]


def poses() -> list[Case]:
    matrix = [[1.0, 0.0, 0.0, 0.1], [0.0, 1.0, 0.0, 0.2], [0.0, 0.0, 1.0, 0.8], [0.0, 0.0, 0.0, 1.0]]
    return _single({
        "a.json": json.dumps({"T_cam_obj": matrix}).encode(),
        "b.json": json.dumps({"estimates": [{"T_cam_obj": matrix, "score": 0.5}]}).encode(),
        "c.json": json.dumps({"cam_R_m2c": _IDENTITY, "cam_t_m2c": [10, 20, 800]}).encode(),
    })  # fmt: skip


def _detected() -> list[dict[str, Any]]:
    counts = [48 * 12 + 10, 20, 28, 20, 48 * 50 - 20 - 28 - 10]
    mask = {"size": [48, 64], "counts": counts}
    mask["counts"][-1] = 48 * 64 - sum(counts[:-1])  # type: ignore[index]
    entry = {"scene_id": 2, "image_id": 3, "category_id": 6, "score": 0.9, "bbox": [12.0, 10.0, 20.0, 20.0],
             "segmentation": mask, "time": 0.1}  # fmt: skip
    polygon = [[12, 10, 40, 10, 40, 30, 12, 30]]
    return [entry, {**entry, "score": 0.5, "segmentation": polygon}]


def detections() -> list[Case]:
    entries = _detected()
    coco = {
        "images": [{"id": 77, "file_name": "rgb/000003.png", "width": 64, "height": 48}],
        "categories": [{"id": 1, "name": "obj_000006"}],
        "annotations": [{**entry, "id": k, "image_id": 77, "category_id": 1} for k, entry in enumerate(entries)],
    }
    return _single({
        "bop.json": json.dumps(entries).encode(), "coco.json": json.dumps(coco).encode(),
        "byimage.json": json.dumps({"3": entries}).encode(),
    })  # fmt: skip


def results() -> list[Case]:
    rotation, moved = " ".join(map(str, _IDENTITY)), "10 20 800"
    rows = "".join(f"2,{image},6,0.9,{rotation},{moved},0.5\n" for image in (3, 8))
    table = "scene_id,im_id,obj_id,score,R,t,time\n" + rows
    return _single({"r.csv": table.encode(), "d.json": json.dumps(_detected()[:1]).encode()})


def bop() -> list[Case]:
    scene = "test/000002/"
    truth = [{"obj_id": 1, "cam_R_m2c": _IDENTITY, "cam_t_m2c": [10, 20, 800]}]
    info = [{"bbox_obj": [1, 2, 10, 10], "bbox_visib": [1, 2, 10, 9], "visib_fract": 0.9}]
    K = [60.0, 0.0, 31.5, 0.0, 60.0, 23.5, 0.0, 0.0, 1.0]
    symmetric = {"diameter": 141.4, "symmetries_discrete": [[-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]}
    made: dict[str, Any] = {
        scene + "scene_camera.json": {"0": {"cam_K": K, "depth_scale": 1.0}, "1": {"cam_K": K}},
        scene + "scene_gt.json": {"0": truth, "1": truth},
        scene + "scene_gt_info.json": {"0": info, "1": info},
        "models/models_info.json": {"1": symmetric},
        "test_targets_bop19.json": [{"scene_id": 2, "im_id": 0, "obj_id": 1, "inst_count": 1}],
    }
    files = {name: json.dumps(data).encode() for name, data in made.items()}
    files["models/obj_000001.ply"] = _ply("", lambda _: "", FACES)
    files[scene + "rgb/000000.png"] = files[scene + "rgb/000001.png"] = _texture()
    return [Case(files, "models/..", tuple(made))]


def videos() -> list[Case]:
    import av
    import numpy as np

    found: Files = {}
    for name in ("a.mp4", "b.mkv", "c.avi"):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / name
            with av.open(str(path), "w") as container:
                stream = container.add_stream("libx264" if name != "c.avi" else "mpeg4", rate=10)
                stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
                for k in range(4):
                    picture = np.roll(_picture(), k, axis=1)
                    container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
                container.mux(stream.encode())
            found[name] = path.read_bytes()
    return _single(found)


def configurations() -> list[Case]:
    from posekit.train.config import default_config, write_config

    return _single({f"{kind}.toml": write_config(default_config(kind)).encode() for kind in ("lite", "paper")})


def weights() -> list[Case]:
    import torch

    from posekit.nets.config import LiteConfig
    from posekit.nets.weights import build, save_networks

    torch.manual_seed(0)  # an input that is made again is the same
    small = LiteConfig(widths=(8, 16), blocks=1, bottleneck=8, fine=8)
    with tempfile.TemporaryDirectory() as folder:
        save_networks(Path(folder) / "lite", build("lite", small), {"trained_on": "nothing"})
        files = {path.name: path.read_bytes() for path in Path(folder).iterdir()}
    return [Case(files, "lite.safetensors", ("lite.toml", "lite.toml", "lite.safetensors"))]


# --- what is tried --------------------------------------------------------------------------------------------------


def read_image(path: Path) -> object:
    from posekit.io.load import load_view

    return load_view(path)


def read_mask(path: Path) -> object:
    from posekit.io.load import load_mask

    return load_mask(path, SIZE)


def read_mesh(path: Path) -> object:
    from posekit.mesh.model import ObjectModel

    model = ObjectModel.load(path)
    return model.diameter, model.hull_vertices


def read_camera(path: Path) -> object:
    from posekit.io.calibration import load_calibration

    return load_calibration(path, SIZE, "000003.png").undistorted(_picture())


def read_pose(path: Path) -> object:
    from posekit.io.load import load_pose

    return load_pose(path)


def _view_and_model() -> Any:
    from posekit.camera import Camera
    from posekit.mesh.model import ObjectModel
    from posekit.view import View

    model = ObjectModel.from_arrays([[0.1 * v for v in vertex] for vertex in VERTICES], FACES, name="obj_000006")
    return View(_picture(), Camera(60.0, 60.0, 31.5, 23.5, *SIZE)), model


def read_detections(path: Path) -> object:
    from posekit.detect.external import DetectionsFile

    view, model = _view_and_model()
    return DetectionsFile.read(path, Path("000003.png")).detect(view, [model])


def read_results(path: Path) -> object:
    from posekit.datasets import results_csv as bop_results

    known = {(2, 3): [6], (2, 8): [6]}
    if path.suffix == ".csv":
        return bop_results.read_results(path, known, [6])
    regions = bop_results.read_detections(path, known, [6])
    return [region.mask() for found in regions.values() for region in found]


def read_bop(path: Path) -> object:
    from posekit.datasets.bop import BopDataset
    from posekit.io.video import open_frames

    data = BopDataset(path)
    model = data.measured_model(1)
    for scene, image in data.images():
        data.instances(scene, image), data.instances(scene, image, every=True), data.camera(scene, image, SIZE)
    return model, [frame.problem for frame in open_frames(str(path / "test" / "000002"))]


def read_video(path: Path) -> object:
    from posekit.io.video import open_frames

    return [frame.problem for frame, _ in zip(open_frames(str(path), "60,60,31.5,23.5"), range(20), strict=False)]


def read_configuration(path: Path) -> object:
    from posekit.train.config import read_config

    return read_config(path)


def read_weights(path: Path) -> object:
    from posekit.nets.weights import load_networks

    return load_networks("lite", path)


READERS = {
    "images": Reader(12, images, read_image),
    "masks": Reader(10, masks, read_mask),
    "ply": Reader(10, ply, read_mesh),
    "obj": Reader(10, obj, read_mesh),
    "stl": Reader(8, stl, read_mesh),
    "glb": Reader(10, glb, read_mesh),
    "cameras": Reader(12, cameras, read_camera),
    "poses": Reader(8, poses, read_pose),
    "detections": Reader(8, detections, read_detections),
    "results": Reader(4, results, read_results),
    "bop": Reader(6, bop, read_bop),
    "videos": Reader(2, videos, read_video),
    "configurations": Reader(6, configurations, read_configuration),
    "weights": Reader(2, weights, read_weights),
}

# --- changes ------------------------------------------------------------------------------------------------------

NUMBERS = ("0", "-1", "1", "2", "3", "255", "256", "65536", "2147483647", "-2147483648", "4294967296", "1e308",
           "-1e308", "1e-320", "NaN", "nan", "Infinity", "-inf", "1e999", "9" * 400, "0x10", "1_000", "", "true",
           "null", "1,5", "99999999999999999999")  # fmt: skip
NAMES = ("../../../../etc/passwd", "/etc/passwd", "http://127.0.0.1:9/x.png", "file:///etc/passwd", "\\\\host\\x.png",
         "C:\\x\\tex.png", "%2e%2e/%2e%2e/etc/passwd", "a\0b", "x" * 5000, ".", "", "tex.png/..", "data:,", "~", "*",
         "data:image/png;base64,AAAA", "\udcff", "é", "/dev/zero", "/dev/stdin")  # fmt: skip
VALUES: tuple[Any, ...] = (None, True, False, 0, -1, 1, 3, 10**9, 10**30, -(10**30), 1.5, 1e308, -1e-320, float("nan"),
                           float("inf"), "", "0", "x", [], {}, [[]], [None], {"": 0}, [0] * 9, [0] * 16,
                           [[1, 2], [3]], {"0": {}}, *NAMES)  # fmt: skip


def _bytes_changed(data: bytes, rng: random.Random) -> bytes:
    made = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4, 16))):
        if not made:
            break
        at, length = rng.randrange(len(made)), rng.choice((1, 1, 2, 4, 8, 64))
        kind = rng.randrange(8)
        if kind == 0:
            made[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            made[at] = rng.choice((0, 1, 127, 128, 255, rng.randrange(256)))
        elif kind == 2:
            del made[at : at + length]
        elif kind == 3:
            made[at:at] = bytes(rng.randrange(256) for _ in range(length))
        elif kind == 4:
            made[at:at] = made[at : at + rng.choice((8, 64, 512))]
        elif kind == 5:
            made[at : at + 4] = struct.pack(rng.choice("<>") + "I", rng.choice((0, 1, 1 << 16, 1 << 31, (1 << 32) - 1)))
        elif kind == 6:
            source = rng.randrange(len(made))
            made[at : at + length] = made[source : source + length]
        else:
            del made[at:]
    return bytes(made)


def _text_changed(data: bytes, rng: random.Random) -> bytes:
    """A number, a word or a line in it."""
    made = data
    for _ in range(rng.choice((1, 1, 2, 5))):
        kind = rng.randrange(6)
        if kind <= 1:
            found = list(re.finditer(rb"-?\d+(\.\d+)?([eE][-+]?\d+)?", made))
            new = rng.choice(NUMBERS).encode()
        elif kind == 2:
            found = list(re.finditer(rb"[A-Za-z_][\w.]{2,}", made))
            new = rng.choice((*NAMES, *NUMBERS)).encode("utf-8", "surrogateescape")
        elif kind == 3:
            found, new = list(re.finditer(rb"[^\n]*\n", made)), b""
        elif kind == 4:
            found = list(re.finditer(rb"[^\n]*\n", made))
            new = rng.choice(found)[0] * rng.choice((2, 3)) if found else b""
        else:
            found = list(re.finditer(rb"[\s{}\[\],:\"']", made))
            new = rng.choice((b"", b"{", b"[", b'"', b"'", b",", b":", b"\n", b"\0", b"[" * 3000, b"&a", b"*a", b"<"))
        if found:
            chosen = rng.choice(found)
            made = made[: chosen.start()] + new + made[chosen.end() :]
    return made


def _nodes(data: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    yield path
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in items:
        yield from _nodes(value, (*path, key))


def _json_changed(data: bytes, rng: random.Random) -> bytes:
    """Values put in others' places, left out, repeated, or odd ones."""
    made = json.loads(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        places = list(_nodes(made))[1:]
        if not places:
            break
        *way, last = rng.choice(places)
        parent = made
        for key in way:
            parent = parent[key]
        kind = rng.randrange(8)
        if kind == 0:
            del parent[last]
        elif kind == 1:
            other = made
            for key in rng.choice(places):
                other = other[key]
            parent[last] = json.loads(json.dumps(other))
        elif kind == 2 and isinstance(parent, list):
            parent.insert(last, parent[last])
        elif kind == 2:
            parent[rng.choice((*NAMES, *NUMBERS))] = parent.pop(last)
        elif kind == 3 and isinstance(parent[last], int | float):
            parent[last] = parent[last] * rng.choice((-1, 10, 1e6, 1e-6, 1e300))
        elif kind == 4:
            parent[last] = [parent[last]] * rng.choice((1, 2, 10))
        elif kind == 5:
            parent[last] = str(parent[last])
        else:
            parent[last] = copy.deepcopy(rng.choice(VALUES))  # later changes reach into it
    return json.dumps(made).encode()


def _checksums_right(data: bytes) -> bytes:
    """A PNG's chunks with the checksums of what they hold now."""
    made, at = bytearray(data), 8
    while at + 12 <= len(made):
        length = int.from_bytes(made[at : at + 4])
        if at + 12 + length > len(made):
            break
        made[at + 8 + length : at + 12 + length] = zlib.crc32(made[at + 4 : at + 8 + length]).to_bytes(4)
        at += 12 + length
    return bytes(made)


def _digest_right(files: Files) -> None:
    """Weights whose TOML has the hash of the file that there is now."""
    import hashlib

    digest = hashlib.sha256(files["lite.safetensors"]).hexdigest()[:16].encode()
    files["lite.toml"] = re.sub(rb"(?m)^sha256_16 = .*$", b'sha256_16 = "' + digest + b'"', files["lite.toml"])


def changed(case: Case, rng: random.Random) -> Files:
    """The files of a case, one of them changed."""
    files, name = dict(case.files), rng.choice(case.changed)
    data, suffix = files[name], Path(name).suffix
    if suffix in (".json", ".gltf") and rng.random() < 0.6:
        data = _json_changed(data, rng)
    elif suffix == ".glb" and rng.random() < 0.6:
        length = struct.unpack_from("<I", data, 12)[0]
        data = _glb(json.loads(_json_changed(data[20 : 20 + length], rng)), data[28 + length :])
    elif suffix in (".json", ".gltf", ".obj", ".mtl", ".ply", ".stl", ".yml", ".yaml", ".xml", ".txt", ".csv",
                    ".toml") and rng.random() < 0.7:  # fmt: skip
        data = _text_changed(data, rng)
    else:
        data = _bytes_changed(data, rng)
    if suffix == ".png" and rng.random() < 0.7:
        data = _checksums_right(data)
    files[name] = data
    if "lite.safetensors" in files and rng.random() < 0.7:
        _digest_right(files)
    return files


# --- the watch ------------------------------------------------------------------------------------------------------


class TooLong(BaseException):
    """Past every `except Exception`."""


class Forbidden(BaseException):
    pass


@dataclass
class Watch:
    """What a reader opens. folder: of the input, None where nothing is watched."""

    folder: str | None = None
    broken: list[str] = field(default_factory=list)
    code: tuple[str, ...] = ()

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self.folder is None:
            return
        if event == "open" and not isinstance(arguments[0], int):
            path = os.path.abspath(os.fsdecode(arguments[0]))  # noqa: PTH100 - checked as it is named
            mode, flags = arguments[1] or "", arguments[2] or 0
            writes = any(letter in mode for letter in "wax+") or flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
            if writes and path != os.devnull:
                self.broken.append(f"writes {path}")
            elif not os.path.realpath(path).startswith((self.folder, *self.code)):
                self.broken.append(f"reads {path}")
        elif event.startswith("socket.") and event not in ("socket.__new__",):
            self.broken.append(event)
        elif event in ("subprocess.Popen", "os.system", "os.posix_spawn", "os.remove", "os.rename", "os.mkdir",
                       "os.rmdir", "shutil.rmtree", "urllib.Request"):  # fmt: skip
            self.broken.append(f"{event} {arguments[0]!r}")


class _Formatted(logging.Handler):
    """Log lines are formatted, so that one that cannot be is found."""

    def emit(self, record: logging.LogRecord) -> None:
        record.getMessage()


def _fault(error: BaseException) -> str:
    """A name for a kind of fault: the exception, the last line of posekit and the last line at all."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if "posekit" in Path(f.filename).parts]
    places = [f"{Path(f.filename).name}:{f.lineno} {f.name}" for f in (*own[-1:], *frames[-1:])]
    return f"{type(error).__name__} at {' < '.join(dict.fromkeys(places))}: {' '.join(str(error).split())[:120]}"


def _kind(fault: str) -> str:
    return re.sub(r"[\d.]{3,}|'.*?'|\".*?\"", "_", fault.partition(": ")[0])


def _write(folder: Path, files: Files) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


def work(name: str, first: int, count: int, seed: int, folder: Path) -> None:
    """Try inputs; a line of JSON for each fault, and for the counts now and then."""
    from posekit.errors import PosekitError

    reader, cases = READERS[name], READERS[name].cases()
    logging.getLogger("posekit").addHandler(_Formatted())
    logging.raiseExceptions = False
    logging.captureWarnings(True)
    for case in cases:  # loads what is loaded late, and shows that the good files are good
        _write(folder, case.files)
        reader.read(folder / case.opened)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    code = {sysconfig.get_paths()[key] for key in ("stdlib", "purelib", "platlib")} | {sys.prefix, sys.base_prefix}
    watch = Watch(code=(*code, str(Path(__file__).resolve().parent.parent / "src"), "/proc/", "/sys/", "/usr/"))
    sys.addaudithook(watch)

    def late(*_: Any) -> None:
        raise TooLong(f"over {SECONDS} s")

    signal.signal(signal.SIGALRM, late)
    counts: Counter[str] = Counter()
    for number in range(first, first + count):
        rng = random.Random(f"{seed}/{name}/{number}")
        case = rng.choice(cases)
        _write(folder, changed(case, rng))
        (folder.parent / "number").write_text(str(number))
        watch.folder, watch.broken = str(folder), []
        started, fault = time.perf_counter(), ""
        signal.setitimer(signal.ITIMER_REAL, SECONDS)
        try:
            reader.read(folder / case.opened)
            counts["read"] += 1
        except PosekitError:
            counts["refused"] += 1
        except (Exception, TooLong) as error:
            fault = _fault(error)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            watch.folder = None
        fault = fault or (f"{watch.broken[0]}" if watch.broken else "")
        slowest = max(counts["slowest_ms"], round(1000 * (time.perf_counter() - started)))
        counts["slowest_ms"] = slowest
        if fault:
            counts["faults"] += 1
            print(json.dumps({"fault": fault, "number": number}), flush=True)
        if number % 200 == 199 or number == first + count - 1:
            counts["done"] = number + 1 - first
            print(json.dumps(dict(counts)), flush=True)


# --- all of them ----------------------------------------------------------------------------------------------------


def _run(name: str, first: int, count: int, seed: int, keep: Path) -> tuple[Counter[str], dict[str, tuple[int, str]]]:
    """All inputs of a reader, in processes that may die."""
    totals: Counter[str] = Counter()
    kinds: dict[str, tuple[int, str]] = {}
    end = first + count
    with tempfile.TemporaryDirectory(prefix="posekit-fuzz-") as place:
        folder = Path(place).resolve() / "input"
        while first < end:
            command = [sys.executable, __file__, "--work", name, "--first", str(first), "--inputs", str(end - first),
                       "--seed", str(seed), "--folder", str(folder)]  # fmt: skip
            process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
            last: dict[str, Any] = {}
            assert process.stdout is not None
            for line in process.stdout:
                message = json.loads(line)
                if "fault" in message:
                    kind = _kind(message["fault"])
                    if kind not in kinds:
                        _write(keep / f"{name}-{message['number']}", _again(name, message["number"], seed))
                    kinds[kind] = (kinds.get(kind, (0, ""))[0] + 1, f"{message['fault']} (input {message['number']})")
                else:
                    last = message
            code = process.wait()
            totals.update({key: last.get(key, 0) for key in ("done", "read", "refused", "faults")})
            totals["slowest_ms"] = max(totals["slowest_ms"], last.get("slowest_ms", 0))
            if code == 0:
                break
            marker = folder.parent / "number"
            died = int(marker.read_text()) if marker.is_file() else first
            kind = f"the process died, exit code {code}"
            kinds[kind] = (kinds.get(kind, (0, ""))[0] + 1, f"{kind} (input {died})")
            if not marker.is_file():
                break
            _write(keep / f"{name}-{died}", _again(name, died, seed))
            totals.update({"done": died + 1 - first - last.get("done", 0), "faults": 1})
            marker.unlink()
            first = died + 1
    return totals, kinds


def _again(name: str, number: int, seed: int) -> Files:
    rng = random.Random(f"{seed}/{name}/{number}")
    return changed(rng.choice(READERS[name].cases()), rng)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=100_000, help="over all readers")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of each reader's first input")
    parser.add_argument("--readers", default=",".join(READERS))
    parser.add_argument("--keep", type=Path, default=Path("fuzz-faults"), help="folder for inputs with faults")
    parser.add_argument("--work", help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.work:
        work(chosen.work, chosen.first, chosen.inputs, chosen.seed, chosen.folder)
        return 0
    names = chosen.readers.split(",")
    whole = sum(READERS[name].share for name in names)
    print(f"{'reader':15}{'inputs':>8}{'read':>8}{'refused':>8}{'faults':>8}{'slowest':>10}{'minutes':>9}", flush=True)
    every: Counter[str] = Counter()
    for name in names:
        started = time.perf_counter()
        share = max(1, round(chosen.inputs * READERS[name].share / whole))
        totals, kinds = _run(name, chosen.first, share, chosen.seed, chosen.keep)
        every.update({key: totals[key] for key in ("done", "read", "refused", "faults")})
        minutes = (time.perf_counter() - started) / 60
        print(
            f"{name:15}{totals['done']:8}{totals['read']:8}{totals['refused']:8}{totals['faults']:8}"
            f"{totals['slowest_ms']:7} ms{minutes:9.1f}",
            flush=True,
        )
        for count, text in sorted(kinds.values(), reverse=True):
            print(f"    {count} x {text}", flush=True)
    print(f"{'all':15}{every['done']:8}{every['read']:8}{every['refused']:8}{every['faults']:8}", flush=True)
    return 1 if every["faults"] else 0


if __name__ == "__main__":
    sys.exit(main())

"""Unpacks openly licensed meshes for training into a folder: see scripts/meshes.

Keeps what posekit can load, under a size limit, from catalogues in the public domain or under CC-BY, and writes
LICENCES.md with every mesh's author and licence.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from rich.progress import track

from posekit.errors import PosekitError
from posekit.mesh.model import ObjectModel

ALLOWED = re.compile(r"public domain|CC[- ]?0|CC[- ]?BY(?!-?(NC|ND|SA))|Creative Commons Attribution(?! ?-)", re.I)
CATALOGUE = "PluginFurnitureCatalog.properties"


@dataclass(frozen=True)
class Source:
    """One mesh in an archive. files: what belongs to it, the mesh first. size: of its box's diagonal, in metres."""

    name: str
    files: tuple[str, ...]
    size: float
    licence: str
    author: str


def properties(text: str) -> dict[str, str]:
    pairs = (line.split("=", 1) for line in text.splitlines() if "=" in line and not line.startswith("#"))
    return {key.strip(): value.strip() for key, value in pairs}


def furniture(archive: zipfile.ZipFile, stem: str) -> Iterator[Source]:
    """The models of a Sweet Home 3D catalogue, if its licence allows them."""
    found = properties(archive.read(CATALOGUE).decode("latin-1"))
    licence = found.get("license", "")
    if not ALLOWED.search(licence):
        print(f"{stem}: left out, its licence is {licence or 'not named'!r}", file=sys.stderr)
        return
    names = set(archive.namelist())
    for key in sorted(k for k in found if k.startswith("model#")):
        mesh = found[key].lstrip("/")
        if mesh.endswith(".obj") and mesh in names:
            folder = str(PurePosixPath(mesh).parent) + "/"
            beside = tuple(n for n in names if n.startswith(folder) and n != mesh and not n.endswith("/"))
            author = found.get(key.replace("model#", "creator#"), "not named")
            sides = [float(found.get(key.replace("model#", f"{side}#"), "0")) for side in ("width", "depth", "height")]
            name = f"{stem}_{PurePosixPath(mesh).stem}"
            yield Source(name, (mesh, *sorted(beside)), math.hypot(*sides) / 100, licence, author)


def shapes(archive: zipfile.ZipFile) -> Iterator[Source]:
    """pybullet's random shapes (zlib licence)."""
    for mesh in sorted(n for n in archive.namelist() if "/random_urdfs/" in n and n.endswith(".obj")):
        material = mesh.replace(".obj", ".mtl")
        yield Source(f"shape_{PurePosixPath(mesh).stem}", (mesh, material), 0.1, "zlib", "Bullet Physics")


def scaled(obj: bytes, size: float) -> bytes:
    """A Wavefront mesh with a box whose diagonal is ``size``: the archives' own units differ from mesh to mesh."""
    lines = obj.decode("latin-1").splitlines()
    at = [k for k, line in enumerate(lines) if line.startswith("v ")]
    points = np.array([lines[k].split()[1:4] for k in at], dtype=np.float64)
    diagonal = np.linalg.norm(np.ptp(points, axis=0)) if len(points) else 0.0
    if size <= 0 or diagonal <= 0:
        return obj
    for k, point in zip(at, points * (size / diagonal), strict=True):
        lines[k] = "v " + " ".join(f"{x:.6g}" for x in point)
    return "\n".join(lines).encode("latin-1")


def unpack(archive: zipfile.ZipFile, source: Source, out: Path, largest: int) -> bool:
    """Write one mesh into a folder of its own; False where it is too large or cannot be loaded."""
    if sum(archive.getinfo(name).file_size for name in source.files) > largest:
        return False
    folder = out / source.name
    folder.mkdir(parents=True)
    root = PurePosixPath(source.files[0]).parent
    for name in source.files:
        target = folder / PurePosixPath(name).relative_to(root)
        target.parent.mkdir(parents=True, exist_ok=True)
        data = archive.read(name)
        target.write_bytes(scaled(data, source.size) if name == source.files[0] else data)
    try:
        ObjectModel.load(folder / PurePosixPath(source.files[0]).name, units="m")
    except PosekitError as error:
        print(f"{source.name}: left out: {error}", file=sys.stderr)
        for path in sorted(folder.rglob("*"), reverse=True):
            path.unlink() if path.is_file() else path.rmdir()
        folder.rmdir()
        return False
    return True


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--furniture", type=Path, help="folder of .sh3f catalogues")
    parser.add_argument("--shapes", type=Path, help="pybullet's wheel")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--largest-kb", type=int, default=3000, help="of a mesh with its textures")
    parser.add_argument("--max-shapes", type=int, default=200)
    args = parser.parse_args()
    if args.out.exists() and any(args.out.iterdir()):
        parser.error(f"{args.out} holds files: name another folder")
    lines = []
    archives = [(p, p.stem) for p in sorted(args.furniture.glob("*.sh3f"))] if args.furniture else []
    archives += [(args.shapes, "")] if args.shapes else []
    for path, stem in archives:
        with zipfile.ZipFile(path) as archive:
            found = list(furniture(archive, stem) if stem else shapes(archive))
            found = found if stem else found[: args.max_shapes]
            for source in track(found, description=path.name):
                if unpack(archive, source, args.out, 1000 * args.largest_kb):
                    lines.append(f"| {source.name} | {source.author} | {source.licence} | {path.name} |")
    text = "| mesh | author | licence | from |\n|---|---|---|---|\n" + "\n".join(lines) + "\n"
    (args.out / "LICENCES.md").write_text(text, encoding="utf-8")
    print(f"{len(lines)} meshes in {args.out}")


if __name__ == "__main__":
    main()

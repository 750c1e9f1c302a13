"""How fast posekit is here, as ratios within one run: writes docs/performance.md.

    python benchmarks/performance.py LINEMOD [--frames 26] [--repeats 5] [--pyrender PYTHON] [--out docs/performance.md]

LINEMOD: a folder of LINEMOD in BOP layout (models, test). frames: pictures that are estimated. PYTHON: an interpreter
that has pyrender (a virtual environment of its own: it wants an older NumPy). --quick leaves out the largest mesh.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from posekit import metrics
from posekit.camera import Camera
from posekit.datasets.bop import BopDataset
from posekit.detect.novel import make_detector
from posekit.estimate.estimator import EstimateOptions, Estimators, PoseEstimator
from posekit.estimate.instances import find_instances
from posekit.estimate.refine import RefineOptions, compare, refine
from posekit.geometry import Pose, PoseNoise, random_rotation
from posekit.mesh.model import ObjectModel
from posekit.nets.runtime import Runtime
from posekit.render import Renderer
from posekit.results import Detection
from posekit.view import View

VIEWS = 200  # that are drawn
SEARCHED = 7  # pictures that are searched without a box
# A process between, since what one takes counts for those that it starts.
MEASURED = """
import resource, subprocess, sys, time
started = time.perf_counter()
code = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL).returncode
print(time.perf_counter() - started, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e6, code)
"""
PYRENDER = """
import json, sys, time, numpy as np, trimesh, pyrender
mesh, poses, K = sys.argv[1], np.array(json.loads(sys.argv[2])), json.loads(sys.argv[3])
scene = pyrender.Scene(ambient_light=[.4] * 3, bg_color=[0, 0, 0, 0])
node = scene.add(pyrender.Mesh.from_trimesh(trimesh.load(mesh, process=False)))
scene.add(pyrender.IntrinsicsCamera(*K, znear=10, zfar=10000), pose=np.diag([1, -1, -1, 1]))
scene.add(pyrender.DirectionalLight(intensity=3.0), pose=np.diag([1, -1, -1, 1]))
renderer = pyrender.OffscreenRenderer(160, 120)
for k, pose in enumerate(np.concatenate([poses[:5], poses])):
    if k == 5: started = time.perf_counter()
    scene.set_pose(node, pose)
    colour, depth = renderer.render(scene)
print((time.perf_counter() - started) / len(poses), float((depth > 0).mean()))
"""


def milliseconds(work: Callable[[], Any], repeats: int) -> float:
    """The median, after one run that does not count."""
    work()
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - started)
    return 1e3 * median(seconds)


def alternating(one: Callable[[], Any], other: Callable[[], Any], repeats: int) -> tuple[float, float]:
    """Milliseconds of two, the medians, after three runs that do not count: in turn, so that both meet one load."""
    seconds: tuple[list[float], list[float]] = ([], [])
    for _ in range(3 + repeats):
        for work, took in zip((one, other), seconds, strict=True):
            started = time.perf_counter()
            work()
            took.append(time.perf_counter() - started)
    first, second = (1e3 * median(took[3:]) for took in seconds)
    return first, second


def command(arguments: list[str], cache: Path | None = None) -> tuple[float, float]:
    """Seconds and gigabytes of ``posekit`` with these arguments; cache: where it keeps what takes long to make."""
    environment = dict(os.environ) | ({} if cache is None else {"XDG_CACHE_HOME": str(cache)})
    program = [sys.executable, "-c", MEASURED, sys.executable, "-m", "posekit", *arguments]
    done = subprocess.run(program, env=environment, capture_output=True, text=True, check=False)
    seconds, gigabytes, code = (float(v) for v in done.stdout.split())
    if code:
        raise SystemExit(f"posekit {' '.join(arguments)} ended with exit code {code:.0f}")
    return seconds, gigabytes


def table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


class Frames:
    """LINEMOD's pictures, each with its object's box from the truth."""

    def __init__(self, root: Path, most: int) -> None:
        self.root, self.data = root, BopDataset(root)
        self.keys = self.data.images()[:most]
        if not self.keys:
            raise SystemExit(f"{root} has no pictures of the split test")

    def get(self, index: int) -> tuple[View, ObjectModel, Detection, Pose]:
        scene, image = self.keys[index]
        truth = self.data.instances(scene, image)[0]
        model, view = self.data.model(truth.obj_id), self.data.view(scene, image)
        box = view.camera.points_box(truth.T_cam_obj.apply(model.hull_vertices))
        return view, model, Detection(box=box, score=1.0, label=model.name), truth.T_cam_obj

    def arguments(self, index: int, mesh: Path | None = None) -> list[str]:
        (scene, image), (view, _, detection, _) = self.keys[index], self.get(index)
        truth, camera = self.data.instances(scene, image)[0], view.camera
        mesh = mesh or self.root / "models" / f"obj_{truth.obj_id:06d}.ply"
        numbers = ",".join(f"{v:g}" for v in (camera.fx, camera.fy, camera.cx, camera.cy))
        box = ",".join(f"{v:.1f}" for v in detection.box)
        return ["estimate", str(self.data.image_path(scene, image)), "--model", str(mesh), "--camera", numbers,
                "--box", box, "--force"]  # fmt: skip


def rendering(frames: Frames, repeats: int, python: str | None) -> str:
    _, model, _, _ = frames.get(0)
    rng, camera, renderer = np.random.default_rng(0), Camera(600, 600, 79.5, 59.5, 160, 120), Renderer()
    poses = [Pose(random_rotation(rng), [0, 0, 5 * model.diameter]) @ model.T_ctr_obj for _ in range(VIEWS)]
    all_ = milliseconds(lambda: renderer.render(model, poses, camera), repeats) / VIEWS
    colour = milliseconds(lambda: renderer.render(model, poses, camera, coords=False), repeats) / VIEWS
    rows = [["posekit, colour, mask, depth, coordinates", f"{all_:.2f}", ""],
            ["posekit, colour and mask", f"{colour:.2f}", ""]]  # fmt: skip
    if python is None:
        rows.append(["pyrender", "not measured: no --pyrender", ""])
    else:
        scale = {"mm": 1e3, "cm": 1e2, "m": 1.0, "in": 1 / 0.0254}[model.units]
        matrices = [np.vstack([np.c_[p.R, p.t * scale], [0, 0, 0, 1]]) for p in poses]
        mesh = frames.arguments(0)[3]
        done = subprocess.run(
            [python, "-c", PYRENDER, mesh, json.dumps(np.round(matrices, 6).tolist()), "[600, 600, 80, 60]"],
            env=dict(os.environ) | {"PYOPENGL_PLATFORM": "egl"}, capture_output=True, text=True, check=False,
        )  # fmt: skip
        if done.returncode:
            rows.append(["pyrender", f"failed: {done.stderr.strip().splitlines()[-1][:80]}", ""])
        else:
            theirs, covered = (float(v) for v in done.stdout.split())
            rows.append(["pyrender, colour and depth", f"{1e3 * theirs:.2f}", f"{1e3 * theirs / all_:.1f} times"])
            if not covered:
                raise SystemExit("pyrender drew nothing")
    text = f"One view of 160x120 pixels, a mesh of {len(model.faces)} faces, batches of {VIEWS}.\n\n"
    return text + table(["", "ms", "of posekit's first line"], rows)


def iteration(frames: Frames, repeats: int) -> str:
    view, model, _, truth = frames.get(0)
    start, rows = PoseNoise(5.0, 15.0, (0.005, 0.005, 0.02)).disturb(truth, np.random.default_rng(0)), []
    renderer, one = Renderer(), RefineOptions(iterations=1)
    for runtime in ("openvino", "torch"):
        predictor = Runtime(runtime=runtime).predictor
        _, seen, drawn = compare(view, model, model.hull_ctr, [start], predictor, renderer)
        network, whole = alternating(
            lambda p=predictor, s=seen, d=drawn: p.predict(s, d),
            lambda p=predictor: refine(view, model, [start], p, renderer, one),
            5 * repeats,
        )
        rows.append([runtime, f"{network:.0f}", f"{whole:.0f}", f"{whole / network:.2f}"])
    return "One pair of crops.\n\n" + table(["", "network alone, ms", "refine iteration, ms", "ratio"], rows)


def estimating(frames: Frames) -> str:
    rows, count = [], len(frames.keys)
    medians = {}
    for runtime in ("openvino", "torch"):
        shared, made, seconds = Runtime(runtime=runtime), {}, []
        for k in range(count):
            view, model, detection, _ = frames.get(k)
            if model not in made:
                made[model] = PoseEstimator(model, networks=shared)
                made[model].estimate(view, [detection])  # what is made once per mesh
            started = time.perf_counter()
            made[model].estimate(view, [detection])
            seconds.append(time.perf_counter() - started)
        medians[runtime] = median(seconds)
        rows.append([f"warm, {runtime}", f"{median(seconds):.2f}", f"{max(seconds):.2f}", ""])
    with tempfile.TemporaryDirectory() as folder:
        out = ["--out", f"{folder}/out"]
        first, memory = command(frames.arguments(0) + out, Path(folder))
        cold = [command(frames.arguments(k) + out, Path(folder)) for k in range(count)]
    rows.append(["the command, a mesh's first use or a later one", f"{median(s for s, _ in cold):.2f}",
                 f"{max(s for s, _ in cold):.2f}", f"{max(m for _, m in cold):.2f}"])  # fmt: skip
    rows.append(["the command, nothing kept on disk", f"{first:.2f}", f"{first:.2f}", f"{memory:.2f}"])
    text = (
        f"From a box, {count} pictures; torch takes {medians['torch'] / medians['openvino']:.2f} times OpenVINO's.\n\n"
    )
    return text + table(["", "median, s", "largest, s", "memory, GB"], rows)


def searching(frames: Frames) -> str:
    """Without a box: detecting and estimating, for the object that a picture shows, and for that one and others of
    the data set, six in all where the pictures show so many; what is made once per mesh does not count."""
    chosen = sorted({int(k) for k in np.linspace(0, len(frames.keys) - 1, SEARCHED)})
    models = {model.name: model for _, model, _, _ in map(frames.get, range(len(frames.keys)))}
    detector, _ = make_detector(None, list(models.values()), doubtful=True)
    estimators, rows = Estimators(), []

    def search(view: View, wanted: list[ObjectModel]) -> list[float]:
        started = time.perf_counter()
        detections = detector.detect(view, wanted)
        detected = time.perf_counter()
        find_instances(estimators, view, wanted, detections)
        return [detected - started, time.perf_counter() - started]

    for count in (1, 6):
        seconds = []
        for k in chosen:
            view, model, _, _ = frames.get(k)
            others = [other for name, other in models.items() if name != model.name]
            wanted = [models[model.name], *others[: count - 1]]
            if not seconds or count == 1:
                search(view, wanted)  # what is made once per mesh
            seconds.append(search(View(view.image, view.camera), wanted))
        detecting, whole = np.median(seconds, axis=0)
        rows.append([str(len(wanted)), f"{detecting:.1f}", f"{whole:.1f}", f"{max(total for _, total in seconds):.1f}"])
    head = ["meshes", "detection, median, s", "all, median, s", "all, largest, s"]
    return f"Warm, {len(chosen)} pictures.\n\n" + table(head, rows)


def beside(frames: Frames, repeats: int) -> str:
    """Estimating alone and beside two processes that never wait, in turn, all at the same niceness."""
    view, model, detection, _ = frames.get(0)
    estimator, seconds = PoseEstimator(model), ([], [])  # type: tuple[list[float], list[float]]
    estimator.estimate(view, [detection])  # what is made once per mesh
    for _ in range(repeats):
        for count, took in zip((0, 2), seconds, strict=True):
            busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
            try:
                time.sleep(0.5)  # until they have started
                started = time.perf_counter()
                estimator.estimate(view, [detection])
                took.append(time.perf_counter() - started)
                if any(each.poll() is not None for each in busy):
                    raise SystemExit("a process that was to be busy has ended")
            finally:
                for each in busy:
                    each.kill()
                    each.wait()
    alone, crowded = (median(each) for each in seconds)
    rows = [["alone", f"{alone:.2f}", f"{max(seconds[0]):.2f}", ""],
            ["beside two busy processes", f"{crowded:.2f}", f"{max(seconds[1]):.2f}",
             f"{crowded / alone:.1f} times"]]  # fmt: skip
    text = f"Warm, from a box, {repeats} estimates of one picture each way, in turn; the bound is 3 times.\n\n"
    return text + table(["", "median, s", "largest, s", "of alone"], rows)


def scoring(frames: Frames, poses: int) -> str:
    _, model, _, _ = frames.get(0)
    rng, noise, points = np.random.default_rng(0), PoseNoise(5.0, 15.0, (0.005, 0.005, 0.02)), model.vertices
    truth = [Pose(random_rotation(rng), [0, 0, rng.uniform(0.5, 1.2)]) for _ in range(poses)]
    estimated, some = [noise.disturb(each, rng) for each in truth], min(poses, 200)

    def plain(e: Pose, t: Pose) -> float:
        return float(cKDTree(e.apply(points)).query(t.apply(points))[0].mean())

    def corresponding(e: Pose, t: Pose) -> float:
        return float(np.linalg.norm(e.apply(points) - t.apply(points), axis=1).mean())

    rows, values = [], {}
    measures: list[tuple[str, Callable[..., Any], Callable[..., float]]] = [
        ("ADD-S", metrics.adds, plain), ("ADD", metrics.add, corresponding)
    ]  # fmt: skip
    for name, ours, loop in measures:
        started = time.process_time()
        values[name] = ours(estimated, truth, points)
        mine = (time.process_time() - started) / poses
        started = time.process_time()
        looped = [loop(e, t) for e, t in zip(estimated[:some], truth[:some], strict=True)]
        theirs = (time.process_time() - started) / some
        np.testing.assert_allclose(values[name][:some], looped, rtol=1e-6)
        rows.append([name, f"{1e3 * mine:.3f}", f"{1e3 * theirs:.3f}", f"{theirs / mine:.1f} times"])
    text = f"{poses} poses of {len(points)} vertices, CPU time; the loop makes one pose at a time.\n\n"
    return text + table(["", "posekit, ms a pose", "plain loop, ms a pose", ""], rows)


def growth(frames: Frames, repeats: int, quick: bool) -> str:
    view, model, detection, _ = frames.get(0)
    shared, rows = Runtime(), []

    def timed(what: str, v: View, m: ObjectModel, d: Detection, options: EstimateOptions = EstimateOptions()) -> None:
        estimator = PoseEstimator(m, networks=shared, options=options)
        rows.append([what, f"{milliseconds(lambda: estimator.estimate(v, [d]), repeats):.0f}", ""])

    for factor in (0.5, 1, 2, 4):
        size = round(factor * view.camera.width), round(factor * view.camera.height)
        larger = View(np.asarray(cv2.resize(view.image, size), np.uint8), view.camera.resized(*size))
        x0, y0, x1, y1 = (factor * v for v in detection.box)
        box = (x0, y0, x1, y1)
        timed(f"picture of {size[0]}x{size[1]}", larger, model, Detection(box=box, score=1.0, label=model.name))
    for count in (1, 3, 5, 10):
        timed(f"{count} hypotheses", view, model, detection, EstimateOptions(hypotheses=count))
    for faces in (1_000, 4_000, 16_000):
        timed(f"mesh of {faces} faces", view, model.simplified(faces), detection)
    for side in (224, 1000)[: 1 if quick else 2]:
        with tempfile.TemporaryDirectory() as folder:
            mesh = Path(folder) / "scan.ply"
            faces = write_scan(mesh, side)
            arguments = [*frames.arguments(0, mesh), "--out", f"{folder}/out"]
            command([*frames.arguments(0), "--out", f"{folder}/out"], Path(folder))  # converts the networks
            (first, most), (later, less) = command(arguments, Path(folder)), command(arguments, Path(folder))
            rows.append([f"the command, a scan of {faces} faces, first use", f"{1e3 * first:.0f}", f"{most:.2f}"])
            rows.append(["the same, later use", f"{1e3 * later:.0f}", f"{less:.2f}"])
    text = "Warm `estimate` from a box in Python; the last rows are the command's, with the networks converted.\n\n"
    return text + table(["", "ms", "memory, GB"], rows)


def write_scan(path: Path, side: int) -> int:
    """A noisy sphere with bumps and vertex colours, millimetres; returns the number of its faces, 2 side^2."""
    rng = np.random.default_rng(0)
    theta, phi = np.linspace(1e-3, np.pi - 1e-3, side + 1), np.linspace(0, 2 * np.pi, side, endpoint=False)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    unit = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1).reshape(-1, 3)
    radius = 1 + 0.15 * np.sin(5 * unit[:, 0] + 1) * np.cos(4 * unit[:, 1]) + rng.normal(0, 5e-4, len(unit))
    vertices = np.zeros(len(unit), [(n, "<f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")])
    colours = np.clip(127 + 100 * np.sin(6 * unit + [0, 1, 2]) + rng.normal(0, 3, unit.shape), 0, 255)
    for k, (axis, channel) in enumerate(zip("xyz", ("red", "green", "blue"), strict=True)):
        vertices[axis], vertices[channel] = radius * unit[:, k] * (60, 50, 40)[k], colours[:, k]
    index: NDArray[np.int64] = np.arange(len(unit)).reshape(side + 1, side)
    a, b, c, d = index[:-1], index[1:], np.roll(index[:-1], -1, 1), np.roll(index[1:], -1, 1)
    faces = np.zeros(2 * side * side, [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"] = 3
    faces["corners"] = np.stack([np.stack([a, b, c], -1), np.stack([c, b, d], -1)]).reshape(-1, 3)
    properties = [f"property float {n}" for n in "xyz"] + [f"property uchar {n}" for n in ("red", "green", "blue")]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}", *properties,
            f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]  # fmt: skip
    path.write_bytes("\n".join(head).encode() + vertices.tobytes() + faces.tobytes())
    return len(faces)


def machine() -> str:
    told = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    name = next((line.partition(": ")[2] for line in told.splitlines() if line.startswith("model name")), "")
    commit = subprocess.run(["git", "describe", "--always", "--dirty"], capture_output=True, text=True, check=False,
                            cwd=Path(__file__).parent).stdout.strip()  # fmt: skip
    cores, load = len(os.sched_getaffinity(0)), os.getloadavg()[0]
    return (
        f"{name or platform.processor()}, {cores} cores, Python {platform.python_version()}, commit {commit or '?'}; "
        f"load before the run {load:.1f}. Made by `./scripts/bench`."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path, metavar="LINEMOD")
    parser.add_argument("--frames", type=int, default=26)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--poses", type=int, default=20_000, help="that are scored")
    parser.add_argument("--pyrender", metavar="PYTHON")
    parser.add_argument("--quick", action="store_true", help="without the mesh of 2 million faces")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent.parent / "docs" / "performance.md")
    parser.add_argument("--only", action="append", metavar="SECTION", help="a section's title, printed; repeat it")
    args = parser.parse_args()
    about, frames = machine(), Frames(args.root, args.frames)
    sections: dict[str, Callable[[], str]] = {
        "Rendering": lambda: rendering(frames, args.repeats, args.pyrender),
        "One refine iteration": lambda: iteration(frames, args.repeats),
        "Estimating from a box": lambda: estimating(frames),
        "Estimating without a box": lambda: searching(frames),
        "Beside busy processes": lambda: beside(frames, args.repeats),
        "Scoring": lambda: scoring(frames, args.poses),
        "Growth": lambda: growth(frames, args.repeats, args.quick),
    }
    if args.only is not None:
        sections = {title: section for title, section in sections.items() if title in args.only}
    text = f"# Performance\n{about}\n"
    for title, section in sections.items():
        print(f"{title} ...", file=sys.stderr)
        text += f"\n## {title}\n{section()}\n"
    if args.only is None:
        args.out.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()

"""A camera's intrinsics and lens distortion from pictures of a calibration board, by OpenCV. Layer 4."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from posekit.camera import Camera
from posekit.errors import CameraError, InputError
from posekit.io.board import Board
from posekit.io.video import Frame, VideoFrames, open_uncalibrated
from posekit.lens import Lens

Array = NDArray[np.float64]
Told = Callable[[str], None]

LEAST_VIEWS = 3  # fewer do not determine a camera
FEW_VIEWS = 8  # fewer are warned of
LEAST_COVERAGE = 0.5  # of the picture
LEAST_TILT_DEG = 20.0  # between the two views whose boards are turned most against each other
FACING_DEG = 8.0  # boards turned less than so against each other and the camera do not determine the focal length
MOST_FOCAL_STD = 0.1  # of the focal length; more is refused
_WARNED_FOCAL_STD = 0.01
_WARNED_RMS = 1 / 1500  # of the picture's longer side
_KNOWN_STD = 3.0  # how many standard deviations a distortion coefficient must be away from 0
_WORSE = 1.1  # times the error of a model with more coefficients
_WIDEST = 4.0  # tangent of the angle to the optical axis up to which distortion is looked at
_OUTLIER = 3.0  # times the median error of a picture
_NO_OUTLIER_PX = 0.5
_MOST_CANDIDATES = 300  # frames of a video in which the board is looked for
_NEAR = 0.02  # of the picture's diagonal: how little frames of a video may differ
_SHARPNESS_SIDE = 640  # pixels
_GRID = (3, 3)
_PLACES = ("top left", "top", "top right", "left", "middle", "right", "bottom left", "bottom", "bottom right")


@dataclass(frozen=True)
class CalibrationConfig:
    """most_views: so many are used at most, the most different ones. fisheye: OpenCV's fisheye model in place of the
    pinhole one with radial and tangential distortion."""

    board: Board = Board()
    fisheye: bool = False
    most_views: int = 40


@dataclass(frozen=True, eq=False)
class BoardView:
    """A board that was seen. label: of the picture. size: its (width, height). corners: which of the board's (N,).
    pixels: where (N, 2)."""

    label: str
    size: tuple[int, int]
    corners: NDArray[np.int64]
    pixels: Array


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """camera, coefficients, model: as `posekit.lens.Lens` takes them. rms_px: reprojection error over all corners.
    errors_px: by picture, root mean square over its corners. left_out: pictures that were not used, and why.
    unneeded: how many more pictures show the board much like one that is used. std_px: standard deviations of fx, fy,
    cx, cy, None for a fisheye, for which OpenCV tells none. coverage: share of the picture that the board was seen in.
    tilt_deg: largest angle between the boards of two pictures. distance_m: of the nearest and the farthest board.
    warnings: what makes the result worse than it could be, and what to do."""

    camera: Camera
    coefficients: tuple[float, ...]
    model: str
    board: Board
    rms_px: float
    errors_px: dict[str, float]
    left_out: dict[str, str]
    unneeded: int
    std_px: tuple[float, float, float, float] | None
    coverage: float
    tilt_deg: float
    distance_m: tuple[float, float]
    warnings: tuple[str, ...]

    @property
    def worst(self) -> tuple[str, float]:
        """The picture of the largest error, and its error in pixels."""
        return max(self.errors_px.items(), key=lambda item: item[1])

    def to_json(self) -> str:
        """The camera file, as `posekit.io.calibration.load_calibration` reads it."""
        camera = self.camera
        about: dict[str, object] = {
            "rms_px": round(self.rms_px, 4),
            "used": len(self.errors_px),
            "board": str(self.board),
            "covered": round(self.coverage, 3),
        }
        if self.std_px is not None:
            about["std_px"] = [round(value, 4) for value in self.std_px]
        content = {
            "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
            "width": camera.width, "height": camera.height,
            "distortion_model": self.model,
            "distortion_coefficients": list(self.coefficients),
            "calibration": about,
        }  # fmt: skip
        return json.dumps(content, indent=1) + "\n"


def calibrate(
    sources: Sequence[str | Path], config: CalibrationConfig = CalibrationConfig(), told: Told = lambda _: None
) -> CalibrationResult:
    """A camera from pictures, folders or globs of pictures, or videos of a board.

    told: is given a line for each picture that is looked at. Of a video sharp frames that differ are taken.
    Raises InputError where a source is missing or the board is seen in too few pictures, CameraError where the views
    do not determine the camera.
    """
    views, left_out, hint = list[BoardView](), dict[str, str](), ""
    unneeded = 0
    for source in sources:
        frames = open_uncalibrated(str(source))
        if isinstance(frames, VideoFrames):
            seen = _of_video(frames, config.board, left_out, told)
            kept = _different(seen, config.most_views, _NEAR)
            unneeded += len(seen) - len(kept)
            views += kept
            continue
        for frame in frames:
            told(frame.file)
            label = _free(frame.file, source, views, left_out)
            view = _seen(frame, label, config.board)
            if isinstance(view, BoardView):
                views.append(view)
                continue
            left_out[label] = view
            if not views and not hint and frame.image is not None:
                hint = config.board.better_dictionary(frame.image) or ""
    views = _of_one_size(views, left_out)
    if len(views) < LEAST_VIEWS:
        raise InputError(_too_few(len(views), left_out, hint, config.board))
    kept = _different(views, config.most_views)
    return calibrate_views(kept, config, left_out, unneeded + len(views) - len(kept))


def calibrate_views(
    views: Sequence[BoardView],
    config: CalibrationConfig = CalibrationConfig(),
    left_out: dict[str, str] | None = None,
    unneeded: int = 0,
) -> CalibrationResult:
    """A camera from boards that were seen, all in pictures of one size. Pictures whose error is far above the others'
    are left out. Raises CameraError where the views do not determine the camera."""
    left_out = dict(left_out or {})
    solve = _fisheye if config.fisheye else _pinhole
    views = list(views)
    while True:
        found = solve(views, config.board)
        errors = np.array([_rms(residuals) for residuals in found.residuals])
        limit = max(_NO_OUTLIER_PX, _OUTLIER * float(np.median(errors)))
        good = [view for view, error in zip(views, errors, strict=True) if error <= limit]
        if len(good) == len(views) or len(good) < max(LEAST_VIEWS, 0.5 * len(views)):
            break
        for view, error in zip(views, errors, strict=True):
            if error > limit:
                left_out[view.label] = (
                    f"its error is {error:.1f} pixels, of most {np.median(errors):.1f}: is it blurred, or was the "
                    "board bent?"
                )
        views = good
    return _result(views, found, config, left_out, unneeded)


# --- boards in pictures -----------------------------------------------------------------------------------------


def _free(name: str, source: str | Path, views: Sequence[BoardView], left_out: dict[str, str]) -> str:
    """A picture's name, with its folder where another picture has that name already."""
    taken = {view.label for view in views} | set(left_out)
    if name not in taken:
        return name
    path = Path(source) / name if Path(source).is_dir() else Path(source)
    label, number = str(path), 2
    while label in taken:
        label, number = f"{path} ({number})", number + 1
    return label


def _seen(frame: Frame, label: str, board: Board) -> BoardView | str:
    if frame.image is None:
        return frame.problem
    found = board.found(frame.image)
    return found if isinstance(found, str) else BoardView(label, frame.image.shape[1::-1], *found)


def _of_video(frames: VideoFrames, board: Board, left_out: dict[str, str], told: Told) -> list[BoardView]:
    """The board in the sharpest frame of each quarter of a second, or of longer where the video is long."""
    name, views, reasons = frames.path.name, list[BoardView](), Counter[str]()
    for frame in _sharpest(frames, reasons):
        told(f"{name}, frame {frame.number}")
        view = _seen(frame, f"{name}, frame {frame.number}", board)
        if isinstance(view, BoardView):
            views.append(view)
        else:
            reasons[view] += 1
    if reasons:
        reason, count = reasons.most_common(1)[0]
        left_out[name] = f"{sum(reasons.values())} of {len(views) + sum(reasons.values())} frames, most since {reason}"
    return views


def _sharpest(frames: VideoFrames, reasons: Counter[str]) -> Iterator[Frame]:
    """The sharpest frame of each window of frames. reasons: is given those of frames that cannot be decoded."""
    window = max(1, round(frames.rate / 4), -(-(frames.count or 0) // _MOST_CANDIDATES))
    best, sharpness = None, -1.0
    for count, frame in enumerate(frames, 1):
        if frame.image is None:
            reasons[frame.problem] += 1
        elif (own := _sharpness(frame.image)) > sharpness:
            best, sharpness = frame, own
        if count % window == 0 and best is not None:
            yield best
            best, sharpness = None, -1.0
    if best is not None:
        yield best


def _sharpness(image: NDArray[np.uint8]) -> float:
    """Higher for a sharper picture of the same things."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    step = max(1, max(grey.shape) // _SHARPNESS_SIDE)
    return float(cv2.Laplacian(grey[::step, ::step], cv2.CV_32F).var())


def _of_one_size(views: Sequence[BoardView], left_out: dict[str, str]) -> list[BoardView]:
    """Views of the size that most have."""
    if not views:
        return []
    size, _ = Counter(view.size for view in views).most_common(1)[0]
    for view in views:
        if view.size != size:
            turned = " Hold the camera the same way for all." if view.size == size[::-1] else ""
            left_out[view.label] = (
                f"it has {view.size[0]}x{view.size[1]} pixels, most have {size[0]}x{size[1]}.{turned}"
            )
    return [view for view in views if view.size == size]


def _different(views: Sequence[BoardView], most: int, near: float = -1.0) -> list[BoardView]:
    """The views that differ most, ``most`` at most, none nearer to another than ``near`` times the diagonal, in the
    order in which they came."""
    if len(views) <= most and near < 0:
        return list(views)
    if not views:
        return []
    places = np.stack([_outline(view) for view in views])
    diagonal = float(np.hypot(*views[0].size))
    chosen = [max(range(len(views)), key=lambda k: len(views[k].corners))]
    distances = np.full(len(views), np.inf)
    while len(chosen) < most:
        apart = np.linalg.norm(places - places[chosen[-1]], axis=2).mean(axis=1) / diagonal
        distances = np.minimum(distances, apart)
        farthest = int(np.argmax(distances))
        if distances[farthest] <= max(near, 0.0):
            break
        chosen.append(farthest)
    return [views[k] for k in sorted(chosen)]


def _outline(view: BoardView) -> Array:
    """Where a view's board lies: its corners' box, and their middle (3, 2), pixels."""
    return np.stack([view.pixels.min(axis=0), view.pixels.max(axis=0), view.pixels.mean(axis=0)])


def _too_few(count: int, left_out: dict[str, str], hint: str, board: Board) -> str:
    some = [f"{label}: {reason}" for label, reason in list(left_out.items())[:4]]
    more = f"; and {len(left_out) - 4} more" if len(left_out) > 4 else ""
    why = f" ({'; '.join(some)}{more})" if some else ""
    help_ = (
        f"Some show markers of the dictionary {hint}: pass --dictionary {hint}, with the board's --squares."
        if hint
        else "Check --pattern and --squares (columns x rows of squares, not inner corners), and take sharp pictures of "
        "the board from different sides, near enough to fill half of the picture."
    )
    usable = "1 usable picture" if count == 1 else f"{count} usable pictures"
    return f"the board ({board}) is seen in {usable}, at least {LEAST_VIEWS} are needed{why}. {help_}"


# --- from corners to a camera -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Solution:
    """turns, shifts: T_cam_board of each view. residuals: (N, 2) pixels of each."""

    K: Array
    coefficients: Array
    turns: list[Array]
    shifts: list[Array]
    residuals: list[Array]
    std: tuple[float, float, float, float] | None = None


def _pinhole(views: Sequence[BoardView], board: Board) -> _Solution:
    """Of the models with k1, k2, p1, p2, k3; without k3; and with k1 and tangential distortion alone the first whose
    last radial coefficient is known better than its own size, and which can be undone over the picture; but no simpler
    one that fits worse. A coefficient beyond that would follow noise where no corner was seen."""
    points, pixels = _lists(views, board, np.float32)
    size, solved, count = views[0].size, None, 5
    for flags, last, more in ((0, 4, 5), (cv2.CALIB_FIX_K3, 1, 4), (cv2.CALIB_FIX_K3 | cv2.CALIB_FIX_K2, 0, 4)):
        tried = _solved(points, pixels, size, flags)
        if solved is not None and tried[0] > _WORSE * solved[0] + 0.01:
            break
        solved, count = tried, more
        coefficients, std = solved[2].ravel(), solved[5].ravel()
        known = abs(coefficients[last]) >= _KNOWN_STD * std[4 + last]
        if known and _undoable(solved[1], coefficients[:count], size):
            break
    assert solved is not None
    _, K, D, turns, shifts, std, *_ = solved
    coefficients, std = D.ravel()[:count], std.ravel()
    residuals = [
        cv2.projectPoints(p, r, t, K, coefficients)[0].reshape(-1, 2) - x.reshape(-1, 2)
        for p, x, r, t in zip(points, pixels, turns, shifts, strict=True)
    ]
    fx, fy, cx, cy = (float(value) for value in std[:4])
    return _Solution(K, coefficients, _matrices(turns), _vectors(shifts), residuals, (fx, fy, cx, cy))


def _undoable(K: Array, coefficients: Array, size: tuple[int, int]) -> bool:
    """Whether radial distortion grows steadily up to the picture's corners, and moves them at most by half or twice."""
    k1, k2, k3 = (*coefficients[:2], *coefficients[4:5], 0.0)[:3]
    r = np.linspace(0.0, _WIDEST, 4000)
    bent = r * (1 + r**2 * (k1 + r**2 * (k2 + r**2 * k3)))
    steady = np.maximum.accumulate(bent) == bent
    end = len(r) if steady.all() else int(np.argmin(steady))
    edges = np.array([(u, v) for u in (0, size[0] - 1) for v in (0, size[1] - 1)])
    corner = np.linalg.norm((edges - K[:2, 2]) / np.diag(K)[:2], axis=1).max()
    if bent[end - 1] < corner:
        return False
    undone = float(np.interp(corner, bent[:end], r[:end]))
    return bool(0.5 * corner < undone < 2 * corner)


def _solved(points: list[Any], pixels: list[Any], size: tuple[int, int], flags: int) -> Any:
    ends = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9)
    try:
        return cv2.calibrateCameraExtended(points, pixels, size, None, None, flags=flags, criteria=ends)
    except cv2.error as error:
        raise CameraError(_unsolved(error)) from error


def _fisheye(views: Sequence[BoardView], board: Board) -> _Solution:
    points, pixels = _lists(views, board, np.float64, (1, -1))  # as its check of shapes wants them
    flags = sum(
        getattr(cv2.fisheye, name, getattr(cv2, name, 0)) for name in ("CALIB_RECOMPUTE_EXTRINSIC", "CALIB_FIX_SKEW")
    )  # OpenCV 4 and 5 keep them in different places
    ends = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9)
    K, D = np.zeros((3, 3)), np.zeros((4, 1))
    try:
        _, K, D, turns, shifts = cv2.fisheye.calibrate(points, pixels, views[0].size, K, D, flags=flags, criteria=ends)
    except cv2.error as error:
        raise CameraError(_unsolved(error)) from error
    residuals = [
        cv2.fisheye.projectPoints(p, r, t, K, D)[0].reshape(-1, 2) - x.reshape(-1, 2)
        for p, x, r, t in zip(points, pixels, turns, shifts, strict=True)
    ]
    return _Solution(K, D.ravel(), _matrices(turns), _vectors(shifts), residuals)


def _unsolved(error: Exception) -> str:
    reason = " ".join(str(error).split())[:160]
    return (
        f"OpenCV finds no camera that fits these views ({reason}): take at least {FEW_VIEWS} pictures with the board "
        "tilted to different sides, in all parts of the picture."
    )


def _lists(
    views: Sequence[BoardView], board: Board, kind: type, shape: tuple[int, int] = (-1, 1)
) -> tuple[list[Any], list[Any]]:
    """Points (metres) and pixels of each view, (N, 1, 3) and (N, 1, 2), or of another such ``shape``."""
    corners = board.corners
    points: list[Any] = [corners[view.corners].reshape(*shape, 3).astype(kind) for view in views]
    return points, [view.pixels.reshape(*shape, 2).astype(kind) for view in views]


def _matrices(turns: Sequence[Any]) -> list[Array]:
    return [np.asarray(cv2.Rodrigues(np.asarray(turn, np.float64).reshape(3, 1))[0]) for turn in turns]


def _vectors(shifts: Sequence[Any]) -> list[Array]:
    return [np.asarray(shift, np.float64).ravel() for shift in shifts]


def _rms(residuals: Array) -> float:
    return float(np.sqrt(np.square(residuals).sum(axis=1).mean()))


def _result(
    views: Sequence[BoardView], found: _Solution, config: CalibrationConfig, left_out: dict[str, str], unneeded: int
) -> CalibrationResult:
    """Raises CameraError where the camera is not determined or its distortion cannot be undone."""
    K, size, model = found.K, views[0].size, "fisheye" if config.fisheye else "pinhole"
    advice = f"take at least {FEW_VIEWS} pictures with the board tilted to different sides, in all parts of the picture"
    if not (np.isfinite(K).all() and np.isfinite(found.coefficients).all() and K[0, 0] > 0 and K[1, 1] > 0):
        raise CameraError(f"these {len(views)} views give no camera (fx {K[0, 0]:g}, fy {K[1, 1]:g}): {advice}.")
    doubt = max(found.std[0] / K[0, 0], found.std[1] / K[1, 1]) if found.std is not None else 0.0
    if not doubt <= MOST_FOCAL_STD:
        raise CameraError(
            f"these {len(views)} views do not determine the focal length ({K[0, 0]:.0f} pixels, give or take "
            f"{100 * doubt:.0f} %): {advice}."
        )
    camera = Camera(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), *size)
    coefficients = tuple(float(value) for value in found.coefficients)
    try:
        Lens(camera, coefficients, model)
    except CameraError as error:
        raise CameraError(
            f"the distortion that fits these {len(views)} views ({', '.join(f'{v:.3g}' for v in coefficients)}) cannot "
            f"be undone up to the picture's edge: {advice}, above all in its corners."
        ) from error
    tilt = _largest_angle_deg([turn[:, 2] for turn in found.turns])
    if (
        tilt < FACING_DEG
        and _largest_angle_deg([np.array([0.0, 0.0, 1.0]), *(R[:, 2] for R in found.turns)]) < FACING_DEG
    ):
        raise CameraError(
            f"all boards face the camera (turned by {tilt:.0f} degrees at most): near with a short focal length looks "
            f"like far with a long one. So {advice}."
        )
    rms = _rms(np.concatenate(found.residuals))
    covered, missing = _coverage(views)
    middle = config.board.corners.mean(axis=0)
    distances = [float(np.linalg.norm(R @ middle + t)) for R, t in zip(found.turns, found.shifts, strict=True)]
    warnings = _warnings(len(views), covered, missing, tilt, rms, doubt, size, config)
    return CalibrationResult(
        camera, coefficients, model, config.board, rms,
        {view.label: _rms(residuals) for view, residuals in zip(views, found.residuals, strict=True)},
        left_out, unneeded, found.std, covered, tilt, (min(distances), max(distances)), warnings,
    )  # fmt: skip


def _coverage(views: Sequence[BoardView]) -> tuple[float, list[str]]:
    """The share of the picture inside the boards' corners, and the ninths of it without any corner."""
    width, height = views[0].size
    scale = 200 / max(width, height)
    mask = np.zeros((max(1, round(scale * height)), max(1, round(scale * width))), np.uint8)
    counts = np.zeros(_GRID[0] * _GRID[1], dtype=int)
    for view in views:
        hull = cv2.convexHull(np.rint(view.pixels * scale).astype(np.int32))
        cv2.fillConvexPoly(mask, hull, 1)
        cells = np.clip((view.pixels / (width, height) * _GRID).astype(int), 0, (_GRID[0] - 1, _GRID[1] - 1))
        np.add.at(counts, cells[:, 1] * _GRID[0] + cells[:, 0], 1)
    return float(mask.mean()), [place for place, count in zip(_PLACES, counts, strict=True) if not count]


def _largest_angle_deg(normals: Sequence[Array]) -> float:
    directions = np.stack(normals)
    return float(np.degrees(np.arccos(np.clip(directions @ directions.T, -1.0, 1.0).min())))


def _warnings(
    count: int, covered: float, missing: list[str], tilt: float, rms: float, doubt: float, size: tuple[int, int],
    config: CalibrationConfig,
) -> tuple[str, ...]:  # fmt: skip
    found = []
    if count < FEW_VIEWS:
        found.append(f"only {count} pictures are used: take {FEW_VIEWS} or more, better 15 to 30.")
    if covered < LEAST_COVERAGE or missing:
        where = f", and none of its corners in the {_listed(missing)}" if missing else ""
        found.append(
            f"the board was seen in {100 * covered:.0f} % of the picture{where}: distortion is a guess elsewhere. "
            "Take pictures with the board there."
        )
    if tilt < LEAST_TILT_DEG:
        found.append(
            f"all boards are nearly parallel (within {tilt:.0f} degrees), which leaves focal length and distance "
            "undecided: tilt the board by 30 to 45 degrees, to different sides."
        )
    if doubt > _WARNED_FOCAL_STD:
        found.append(f"the focal length is uncertain by {100 * doubt:.1f} %: take more pictures of a tilted board.")
    if rms > max(_NO_OUTLIER_PX, _WARNED_RMS * max(size)):
        lens = "" if config.fisheye else ", or the lens is so wide that it needs --fisheye"
        found.append(
            f"the reprojection error of {rms:.2f} pixels is large: pictures are blurred, the board is not flat{lens}."
        )
    return tuple(found)


def _listed(places: Sequence[str]) -> str:
    return " and ".join([", ".join(places[:-1]), places[-1]] if len(places) > 1 else places)

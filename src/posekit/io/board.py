"""The calibration board: a ChArUco board or a chessboard, how it is found, and its page to print. Layer 2."""

from __future__ import annotations

import io
import math
import re
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from posekit.errors import ConfigError

Pattern = Literal["charuco", "chessboard"]
Paper = Literal["a4", "letter"]

PAPERS_MM = {"a4": (297.0, 210.0), "letter": (279.4, 215.9)}  # longer side first
MOST_SQUARES = 100  # each way
_EDGE_MM = 6.0  # what printers leave white
_TEXT_MM = 15.0  # below the board, for what is written there
_LETTER_MM = 3.2
_DOTS_MM = 20  # about 500 dots an inch
_RULER_MM = 100
_SEARCH_SIDE = 1400  # pixels, longer side of the picture in which a chessboard is looked for
_DICTIONARIES = tuple(
    f"{bits}X{bits}_{count}" for bits in (4, 5, 6, 7) for count in (50, 100, 250, 1000)
)  # OpenCV's, with DICT_ before their names


@dataclass(frozen=True)
class Board:
    """columns, rows: squares, not inner corners. square_mm, marker_mm: sides of a square and of a marker in it.
    dictionary: of the markers, by OpenCV's name with or without ``DICT_``; a chessboard has none.

    Raises ConfigError where there is no such board.
    """

    pattern: Pattern = "charuco"
    columns: int = 7
    rows: int = 5
    square_mm: float = 35.0
    marker_mm: float = 26.0
    dictionary: str = "5X5_50"

    def __post_init__(self) -> None:
        least = 3 if self.pattern == "charuco" else 4
        if not all(least <= count <= MOST_SQUARES for count in (self.columns, self.rows)):
            raise ConfigError(
                f"a {self.pattern} board of {self.columns}x{self.rows} squares: give from {least} to {MOST_SQUARES} "
                "each way, as 7x5."
            )
        if not (math.isfinite(self.square_mm) and self.square_mm > 0):
            raise ConfigError(f"squares of {self.square_mm:g} mm: give the measured side of a square, above 0.")
        if self.pattern == "chessboard":
            return
        if not 0 < self.marker_mm < self.square_mm:
            raise ConfigError(
                f"markers of {self.marker_mm:g} mm in squares of {self.square_mm:g} mm: a marker is smaller than its "
                "square. Measure both (--marker-mm, --square-mm)."
            )
        if self._name not in _DICTIONARIES:
            raise ConfigError(
                f"there is no dictionary {self.dictionary}: OpenCV has {', '.join(_DICTIONARIES)}; the board's maker "
                "says which."
            )
        markers, there = self.columns * self.rows // 2, int(self._name.partition("_")[2])
        if markers > there:
            raise ConfigError(
                f"a board of {self.columns}x{self.rows} squares has {markers} markers, the dictionary {self._name} "
                f"only {there}: take a larger dictionary or fewer squares."
            )

    @classmethod
    def chosen(
        cls,
        pattern: Pattern = "charuco",
        squares: str | None = None,
        square_mm: float | None = None,
        marker_mm: float | None = None,
        dictionary: str | None = None,
    ) -> Board:
        """A board by what is known of it; what is not is as on the page that posekit prints (`page`).

        squares: ``COLUMNSxROWS``. Raises ConfigError.
        """
        found = re.fullmatch(r"\s*(\d{1,4})\s*[xX×]\s*(\d{1,4})\s*", squares) if squares is not None else None
        if squares is not None and found is None:
            raise ConfigError(f"squares {squares!r}: give COLUMNSxROWS, as 7x5.")
        if pattern == "chessboard":
            if marker_mm is not None or dictionary is not None:
                raise ConfigError("a chessboard has no markers: leave --marker-mm and --dictionary out.")
            columns, rows = map(int, found.groups()) if found else (10, 7)
            return cls(pattern, columns, rows, 25.0 if square_mm is None else square_mm)
        columns, rows = map(int, found.groups()) if found else (7, 5)
        square = 35.0 if square_mm is None else square_mm
        marker = 26.0 / 35.0 * square if marker_mm is None else marker_mm
        return cls(pattern, columns, rows, square, marker, dictionary or "5X5_50")

    def __str__(self) -> str:
        text = f"{self.columns}x{self.rows} squares of {self.square_mm:g} mm"
        if self.pattern == "chessboard":
            return f"chessboard, {text}"
        return f"ChArUco board, {text}, markers of {self.marker_mm:g} mm, dictionary {self._name}"

    @property
    def corners(self) -> NDArray[np.float64]:
        """The inner corners (N, 3), metres, row by row, in the board's frame: x right, y down, z = 0."""
        x, y = np.meshgrid(np.arange(1.0, self.columns), np.arange(1.0, self.rows))
        return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) * (self.square_mm / 1000.0)

    @property
    def least_corners(self) -> int:
        """How many corners a picture must show to be used."""
        total = (self.columns - 1) * (self.rows - 1)
        return total if self.pattern == "chessboard" else max(4, min(8, total // 2))

    def found(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.float64]] | str:
        """The board in a picture, uint8 RGB (H, W, 3): which of `corners` it shows (N,), and at which pixels (N, 2);
        else the reason why it cannot be used."""
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        return self._chessboard_in(grey) if self.pattern == "chessboard" else self._charuco_in(grey)

    def better_dictionary(self, image: NDArray[np.uint8]) -> str | None:
        """Another dictionary, of which a picture shows markers: what to try where `found` finds nothing."""
        if self.pattern == "chessboard":
            return None
        best, most = None, 3
        for bits in (4, 5, 6, 7):
            detector = cv2.aruco.ArucoDetector(_dictionary(f"{bits}X{bits}_1000"))
            ids = detector.detectMarkers(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))[1]
            if ids is not None and len(ids) > most:
                count = next(count for count in (50, 100, 250, 1000) if int(np.max(ids)) < count)
                best, most = f"{bits}X{bits}_{count}", len(ids)
        return None if best == self._name else best

    def page(self, paper: Paper = "a4") -> bytes:
        """The board on a page as PDF, at true scale, with its measures and a ruler below it.

        Raises ConfigError where it does not fit on the paper.
        """
        picture, dots_mm = self.page_picture(paper)
        file = io.BytesIO()
        picture.save(file, "PDF", resolution=25.4 * dots_mm, title=f"posekit: {self}", producer="posekit")
        return file.getvalue()

    def page_picture(self, paper: Paper = "a4") -> tuple[Image.Image, float]:
        """`page` as a picture of black and white pixels, and how many of them make a millimetre."""
        long, short = PAPERS_MM[paper]
        width_mm, height_mm = (long, short) if self.columns >= self.rows else (short, long)
        room = (width_mm - 2 * _EDGE_MM, height_mm - 2 * _EDGE_MM - _TEXT_MM)
        if self.columns * self.square_mm > room[0] or self.rows * self.square_mm > room[1]:
            largest = math.floor(2 * min(room[0] / self.columns, room[1] / self.rows)) / 2
            raise ConfigError(
                f"{self.columns}x{self.rows} squares of {self.square_mm:g} mm do not fit on {paper.upper()} paper: "
                f"squares of {largest:g} mm do (--square-mm {largest:g})."
            )
        side = max(8, round(self.square_mm * _DOTS_MM))  # whole pixels, so that all squares are equal
        dots = side / self.square_mm
        page = Image.new("L", (round(width_mm * dots), round(height_mm * dots)), 255)
        board = Image.fromarray(self.picture(side))
        left = (page.width - board.width) // 2
        top = round((height_mm - _TEXT_MM - self.rows * self.square_mm) / 2 * dots)
        page.paste(board, (left, top))
        self._write_below(page, left, dots, height_mm)
        return page.convert("1", dither=Image.Dither.NONE), dots

    def picture(self, side: int) -> NDArray[np.uint8]:
        """The board alone, grey (rows * side, columns * side), without a rim. side: of a square, pixels."""
        if self.pattern == "charuco":
            size = (self.columns * side, self.rows * side)
            return np.asarray(self._charuco.generateImage(size, marginSize=0), dtype=np.uint8)
        dark = np.add.outer(np.arange(self.rows), np.arange(self.columns)) % 2 == 0
        return np.kron(np.where(dark, 0, 255), np.ones((side, side))).astype(np.uint8)

    def _write_below(self, page: Image.Image, left: int, dots: float, height_mm: float) -> None:
        """What the board is, how to print it, and a ruler to check it by."""
        draw, black = ImageDraw.Draw(page), 0
        font = ImageFont.load_default(_LETTER_MM * dots)
        options = f"--squares {self.columns}x{self.rows} --square-mm {self.square_mm:g}"
        if self.pattern == "charuco":
            options += f" --marker-mm {self.marker_mm:g} --dictionary {self._name}"
        else:
            options = f"--pattern chessboard {options}"
        y = (height_mm - _EDGE_MM - _TEXT_MM) * dots + 3 * dots
        lines = (
            f"Print at 100 % (not “fit to page”). Squares: {self.square_mm:g} mm.",
            f"posekit calibrate PHOTOS {options}",
        )
        for k, line in enumerate(lines):
            room = 0.97 * (page.width - left - _EDGE_MM * dots)
            size = min(1.0, room / draw.textlength(line, font=font))
            draw.text(
                (left, y + 1.5 * k * _LETTER_MM * dots), line, black, ImageFont.load_default(size * _LETTER_MM * dots)
            )
        # the ruler, beside the first line
        right, line_width = page.width - left, max(1, round(0.25 * dots))
        ruler_y, tick = y + 0.6 * _LETTER_MM * dots, 1.5 * dots
        start = right - _RULER_MM * dots
        if start < left + draw.textlength(lines[0], font=font) + 4 * dots:
            return  # a small board has no room for it: its squares can be measured
        draw.line([(start, ruler_y), (right, ruler_y)], black, line_width)
        for k in range(0, _RULER_MM + 1, 10):
            x = start + k * dots
            draw.line([(x, ruler_y - tick * (1 if k % 50 else 1.5)), (x, ruler_y)], black, line_width)
        text = f"{_RULER_MM} mm"
        small = ImageFont.load_default(0.7 * _LETTER_MM * dots)
        x = start + (_RULER_MM * dots - draw.textlength(text, font=small)) / 2
        draw.text((x, ruler_y + 0.4 * dots), text, black, small)

    @property
    def _name(self) -> str:
        return self.dictionary.upper().removeprefix("DICT_")

    @cached_property
    def _charuco(self) -> Any:
        return self._charuco_board(legacy=False)

    def _charuco_board(self, legacy: bool) -> Any:
        sides = self.square_mm / 1000, self.marker_mm / 1000
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), *sides, _dictionary(self._name))
        board.setLegacyPattern(legacy)
        return board

    @cached_property
    def _detectors(self) -> list[Any]:
        """Before OpenCV 4.6 boards with an even number of rows began with a white square: both are looked for."""
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        boards = [self._charuco, *([] if self.rows % 2 else [self._charuco_board(legacy=True)])]
        return [cv2.aruco.CharucoDetector(board, cv2.aruco.CharucoParameters(), parameters) for board in boards]

    def _charuco_in(self, grey: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.float64]] | str:
        results = [detector.detectBoard(grey) for detector in self._detectors]
        pixels, ids, _, markers = max(results, key=lambda result: 0 if result[1] is None else len(result[1]))
        count = 0 if ids is None else len(ids)
        if count == 0:
            seen = 0 if markers is None else len(markers)
            if not seen:
                return f"no marker of the dictionary {self._name} is seen"
            counted = "only 1 marker is seen, and" if seen == 1 else f"{seen} markers are seen, but"
            return f"{counted} no corner of a board of {self.columns}x{self.rows} squares"
        if count < self.least_corners:
            return f"only {count} corners of the board are seen, {self.least_corners} are needed"
        if self._charuco.checkCharucoCornersCollinear(ids):
            return "the corners that are seen lie on one line"
        return np.asarray(ids, np.int64).ravel(), np.asarray(pixels, np.float64).reshape(-1, 2) - _charuco_offset()

    def _chessboard_in(self, grey: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.float64]] | str:
        inner = (self.columns - 1, self.rows - 1)
        shrink = min(1.0, _SEARCH_SIDE / max(grey.shape))  # the search takes half a minute at 24 megapixels
        small = grey if shrink == 1 else cv2.resize(grey, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
        there, pixels = cv2.findChessboardCornersSB(small, inner, flags=flags)
        if not there:
            return f"no whole chessboard of {self.columns}x{self.rows} squares is seen"
        if shrink < 1:
            pixels = self._at_full_size(grey, pixels, small.shape)
        return np.arange(inner[0] * inner[1]), np.asarray(pixels, np.float64).reshape(-1, 2)

    def _at_full_size(self, grey: NDArray[np.uint8], pixels: Any, found_in: tuple[int, ...]) -> Any:
        """Corners (N, 1, 2) that were found in a smaller picture, found again in the picture itself."""
        scale = np.array(grey.shape[::-1]) / np.array(found_in[::-1])
        start = ((np.asarray(pixels).reshape(self.rows - 1, self.columns - 1, 2) + 0.5) * scale - 0.5).astype(
            np.float32
        )
        steps = [np.linalg.norm(np.diff(start, axis=axis), axis=2).min() for axis in (0, 1)]
        window = int(np.clip(0.3 * min(steps), 3, 15))
        ends = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3)
        return cv2.cornerSubPix(grey, start.reshape(-1, 1, 2), (window, window), (-1, -1), ends)


@lru_cache(maxsize=1)
def _charuco_offset() -> float:
    """How far OpenCV puts a ChArUco board's corners to the right of and below where they are, pixels: half a pixel in
    its version 4, nothing in version 5. Measured on a board that is drawn, whose corners lie between pixels."""
    board, side = Board(), 40
    picture = np.pad(board.picture(side), side, constant_values=255)
    pixels, ids, *_ = board._detectors[0].detectBoard(picture)
    place = (1000 / board.square_mm * board.corners[np.ravel(ids), :2] + 1) * side - 0.5
    return float(np.rint(2 * np.mean(np.reshape(pixels, (-1, 2)) - place)) / 2)


def _dictionary(name: str) -> Any:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))

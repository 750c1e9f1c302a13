"""Charts as SVG text, for the report. Colours are the page's CSS variables and follow its light or dark mode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import ArrayLike

WIDTH, HEIGHT = 340, 210
_LEFT, _RIGHT, _TOP, _BOTTOM = 44, 12, 12, 38


@dataclass(frozen=True)
class Axes:
    """Labels and ranges of a chart; both axes start at 0 but for ``x_from``."""

    x_label: str
    y_label: str
    x_to: float
    y_to: float = 100.0
    x_from: float = 0.0

    def x(self, value: float) -> float:
        """Where a value lies, SVG units from the left."""
        return _LEFT + (value - self.x_from) / (self.x_to - self.x_from) * (WIDTH - _LEFT - _RIGHT)

    def y(self, value: float) -> float:
        """Where a value lies, SVG units from the top."""
        return HEIGHT - _BOTTOM - value / self.y_to * (HEIGHT - _TOP - _BOTTOM)


def lines(axes: Axes, curves: Sequence[tuple[str, ArrayLike, ArrayLike]], title: str) -> str:
    """A line for each (name, x, y); names are shown where there are several."""
    parts = []
    for k, (name, xs, ys) in enumerate(curves):
        points = " ".join(
            f"{axes.x(x):.1f},{axes.y(y):.1f}" for x, y in zip(np.asarray(xs), np.asarray(ys), strict=True)
        )
        parts.append(f'<polyline class="line c{k}" points="{points}"/>')
        if len(curves) > 1:
            y = _TOP + 14 + 15 * k
            parts.append(f'<line class="line c{k}" x1="{WIDTH - 118}" x2="{WIDTH - 100}" y1="{y - 4}" y2="{y - 4}"/>')
            parts.append(f'<text x="{WIDTH - 95}" y="{y}">{escape(name)}</text>')
    return _chart(axes, "".join(parts), title)


def histogram(axes: Axes, values: ArrayLike, bins: int, title: str) -> str:
    """Bars of how many values (percent of all) fall into each of the bins; what lies beyond is in the last one."""
    data = np.asarray(values, dtype=np.float64)
    edges = np.linspace(axes.x_from, axes.x_to, bins + 1)
    counts, _ = np.histogram(np.clip(data, axes.x_from, axes.x_to), edges)
    shares = 100.0 * counts / max(1, len(data))
    top = nice_top(max(float(shares.max()), 1.0))
    scaled = Axes(axes.x_label, axes.y_label, axes.x_to, top, axes.x_from)
    bars = "".join(
        f'<rect class="bar" x="{scaled.x(a) + 0.5:.1f}" y="{scaled.y(s):.1f}" '
        f'width="{max(0.5, scaled.x(b) - scaled.x(a) - 1):.1f}" height="{scaled.y(0) - scaled.y(s):.1f}">'
        f"<title>{a:.3g} to {b:.3g}{' and more' if b == edges[-1] else ''}: {s:.1f} %</title></rect>"
        for a, b, s in zip(edges[:-1], edges[1:], shares, strict=True)
    )
    return _chart(scaled, bars, title)


def bars(names: Sequence[str], groups: Sequence[tuple[str, Sequence[float]]], title: str) -> str:
    """Grouped horizontal bars in percent: for each name one bar of each group."""
    row, height = 13 * len(groups) + 8, 30 + (13 * len(groups) + 8) * len(names)
    left, right = 110, 640 - 50
    parts = []
    for k, name in enumerate(names):
        top = 22 + k * row
        parts.append(f'<text class="name" x="{left - 8}" y="{top + row / 2}">{escape(name)}</text>')
        for g, (label, values) in enumerate(groups):
            y, value = top + 13 * g, float(values[k])
            width = (right - left) * value / 100.0
            parts.append(
                f'<rect class="fill c{g}" x="{left}" y="{y}" width="{max(width, 0.5):.1f}" height="10">'
                f"<title>{escape(label)}: {value:.1f} %</title></rect>"
                f'<text x="{left + width + 5:.1f}" y="{y + 9}">{value:.1f}</text>'
            )
    for g, (label, _) in enumerate(groups):
        x = left + 100 * g
        parts.append(f'<rect class="fill c{g}" x="{x}" y="3" width="10" height="10"/>')
        parts.append(f'<text x="{x + 14}" y="12">{escape(label)}</text>')
    return (
        f'<svg class="wide" viewBox="0 0 640 {height}" role="img" aria-label="{escape(title)}">{"".join(parts)}</svg>'
    )


def spark(values: Sequence[float], width: int = 120, height: int = 26) -> str:
    """A line without axes, from 0 to the largest value."""
    top = max(max(values), 1e-9)
    step = (width - 4) / max(1, len(values) - 1)
    points = " ".join(f"{2 + k * step:.1f},{height - 2 - (height - 4) * v / top:.1f}" for k, v in enumerate(values))
    return f'<svg class="spark" viewBox="0 0 {width} {height}"><polyline class="line c0" points="{points}"/></svg>'


def nice_top(value: float) -> float:
    """The next of 1, 2, 2.5, 5 and 10 times a power of ten: five ticks below it are short numbers."""
    power = 10.0 ** np.floor(np.log10(max(value, 1e-9)))
    return float(next(step * power for step in (1, 2, 2.5, 5, 10) if step * power >= value))


def _chart(axes: Axes, content: str, title: str) -> str:
    bottom, right = HEIGHT - _BOTTOM, WIDTH - _RIGHT
    grid = []
    for k in range(6):
        x, y = axes.x_from + (axes.x_to - axes.x_from) * k / 5, axes.y_to * k / 5
        grid.append(f'<line class="grid" x1="{_LEFT}" x2="{right}" y1="{axes.y(y):.1f}" y2="{axes.y(y):.1f}"/>')
        grid.append(f'<text class="left" x="{_LEFT - 6}" y="{axes.y(y) + 4:.1f}">{y:.3g}</text>')
        grid.append(f'<text class="middle" x="{axes.x(x):.1f}" y="{bottom + 15}">{x:.3g}</text>')
    labels = (
        f'<text class="middle" x="{(_LEFT + right) / 2}" y="{HEIGHT - 6}">{escape(axes.x_label)}</text>'
        f'<text class="middle" transform="translate(11,{(_TOP + bottom) / 2}) rotate(-90)">'
        f"{escape(axes.y_label)}</text>"
    )
    return (
        f'<figure><figcaption>{escape(title)}</figcaption><svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
        f'aria-label="{escape(title)}">{"".join(grid)}{content}{labels}</svg></figure>'
    )

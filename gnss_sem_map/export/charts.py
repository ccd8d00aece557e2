"""Charts of a page as SVG, drawn by its templates: lines over two axes, with ticks at round numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 640, 220
LEFT, RIGHT, TOP, BOTTOM = 56, 12, 12, 40


@dataclass(frozen=True)
class Line:
    """A line of a chart; a `css` class of the page gives its colour."""

    name: str
    css: str
    points: str
    """For the attribute of a polyline, px."""


@dataclass(frozen=True)
class Chart:
    """Lines in a frame; all places in px."""

    title: str
    x_title: str
    y_title: str
    lines: tuple[Line, ...]
    x_ticks: tuple[tuple[float, str], ...]
    y_ticks: tuple[tuple[float, str], ...]
    width: int = WIDTH
    height: int = HEIGHT
    frame: tuple[int, int, int, int] = field(default=(LEFT, TOP, WIDTH - RIGHT, HEIGHT - BOTTOM))
    has_legend: bool = False


Values = Sequence[float] | NDArray[np.float64]
Curve = tuple[str, str, Values, Values]
"""Name, CSS class, x and y."""


def chart(
    title: str,
    x_title: str,
    y_title: str,
    curves: Iterable[Curve],
    x_range: tuple[float, float] | None = None,
    y_range: tuple[float, float] | None = None,
    width: int = WIDTH,
    height: int = HEIGHT,
    is_equal: bool = False,
    has_legend: bool = False,
) -> Chart:
    """A chart of some curves; without ranges the axes end at their values. `is_equal`: a metre is as long on both.

    `has_legend`: the names of the curves stand below; else they are seen where the mouse points.
    """
    curves = list(curves)
    x_low, x_high = x_range or _range(np.concatenate([np.asarray(x, float) for _, _, x, _ in curves]))
    y_low, y_high = y_range or _range(np.concatenate([np.asarray(y, float) for _, _, _, y in curves]))
    x0, y0, x1, y1 = frame = LEFT, TOP, width - RIGHT, height - BOTTOM
    if is_equal:
        scale = max((x_high - x_low) / (x1 - x0), (y_high - y_low) / (y1 - y0))
        x_low, x_high = _about_middle(x_low, x_high, scale * (x1 - x0))
        y_low, y_high = _about_middle(y_low, y_high, scale * (y1 - y0))

    def x_px(value: float) -> float:
        return round(x0 + (x1 - x0) * (value - x_low) / (x_high - x_low), 1)

    def y_px(value: float) -> float:
        return round(y1 - (y1 - y0) * (value - y_low) / (y_high - y_low), 1)

    lines = tuple(
        Line(name, css, " ".join(f"{x_px(a)},{y_px(b)}" for a, b in zip(x, y, strict=True)))
        for name, css, x, y in curves
    )
    x_ticks = tuple((x_px(value), f"{value:g}") for value in ticks(x_low, x_high))
    y_ticks = tuple((y_px(value), f"{value:g}") for value in ticks(y_low, y_high))
    return Chart(title, x_title, y_title, lines, x_ticks, y_ticks, width, height, frame, has_legend)


def ticks(low: float, high: float, most: int = 7) -> list[float]:
    """Multiples of 1, 2 or 5 times a power of ten from `low` to `high`, at most `most` of them."""
    power = 10.0 ** math.floor(math.log10((high - low) / most))
    step = next(power * factor for factor in (1, 2, 5, 10, 20) if (high - low) / (power * factor) <= most - 1)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(number * step, 12) for number in range(first, last + 1)]


def _range(values: NDArray[np.float64]) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _about_middle(low: float, high: float, length: float) -> tuple[float, float]:
    return (low + high - length) / 2, (low + high + length) / 2

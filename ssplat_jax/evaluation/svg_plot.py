"""Line plots as SVG text, for pages that must need no network and no package."""

import dataclasses
import html
import math
from collections.abc import Sequence

import numpy as np

WIDTH, HEIGHT = 460, 240
LEFT, RIGHT, TOP, BOTTOM = 52, 14, 34, 42  # margins, pixels
COLORS = ("#3b6ea5", "#c2703d", "#4f8a5b", "#8b6bab")
MAX_TICKS = 6


@dataclasses.dataclass(frozen=True)
class Line:
    """One line of a plot; points that are not finite are left out."""

    name: str
    x: Sequence[float | int | None]
    y: Sequence[float | int | None]


def line_plot(title: str, x_label: str, y_label: str, lines: Sequence[Line]) -> str:
    """An SVG element that shows lines over a common x axis. Colors of text and grid follow the page (`currentColor`).

    Limits:
        A single point is drawn as a dot. Without finite points the plot says that there is nothing to show.
    """
    points = [_finite_points(line) for line in lines]
    used = np.concatenate([p for p in points if len(p)] or [np.zeros((0, 2))])
    parts = [_text(LEFT, 18, title, "start", "title")]
    if len(used):
        x_ticks, y_ticks = (_ticks(used[:, axis].min(), used[:, axis].max()) for axis in (0, 1))
        scale = _Scale(x_ticks, y_ticks)
        parts += _axes(scale, x_label, y_label)
        for place, (line, xy) in enumerate(zip(lines, points, strict=True)):
            parts += _line(line.name, xy, scale, COLORS[place % len(COLORS)])
        if len(lines) > 1:
            parts += _legend([line.name for line in lines])
    else:
        parts.append(_text(WIDTH / 2, HEIGHT / 2, "nothing to show", "middle", "tick"))
    head = f'<svg class="plot" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{html.escape(title)}">'
    return "\n".join([head, *parts, "</svg>"])


@dataclasses.dataclass(frozen=True)
class _Scale:
    """Map of values to pixels; the first and last ticks are the ends of the axes."""

    x_ticks: list[float]
    y_ticks: list[float]

    def x(self, value: float) -> float:
        share = (value - self.x_ticks[0]) / (self.x_ticks[-1] - self.x_ticks[0])
        return round(LEFT + share * (WIDTH - LEFT - RIGHT), 2)

    def y(self, value: float) -> float:
        share = (value - self.y_ticks[0]) / (self.y_ticks[-1] - self.y_ticks[0])
        return round(HEIGHT - BOTTOM - share * (HEIGHT - TOP - BOTTOM), 2)


def _finite_points(line: Line) -> np.ndarray:
    """The points of a line as rows (x, y)."""
    xy = np.array([[math.nan if v is None else v for v in axis] for axis in (line.x, line.y)], np.float64).T
    return xy[np.isfinite(xy).all(axis=1)].reshape(-1, 2)


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers from at most `low` to at least `high`, two to `MAX_TICKS` of them."""
    if high - low < 1e-9 * max(abs(low), abs(high), 1e-9):
        margin = 0.5 * abs(low) or 0.5
        low, high = low - margin, high + margin
    raw = (high - low) / (MAX_TICKS - 2)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw * (1 - 1e-9))
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(k * step, 12) for k in range(first, last + 1)]


def _axes(scale: _Scale, x_label: str, y_label: str) -> list[str]:
    """Grid, numbers and labels."""
    bottom, right = HEIGHT - BOTTOM, WIDTH - RIGHT
    parts = []
    for value in scale.y_ticks:
        y = scale.y(value)
        parts.append(f'<path class="grid" d="M{LEFT} {y}H{right}"/>')
        parts.append(_text(LEFT - 7, y + 3.5, f"{value:g}", "end", "tick"))
    for value in scale.x_ticks:
        parts.append(_text(scale.x(value), bottom + 16, f"{value:g}", "middle", "tick"))
    parts.append(_text((LEFT + right) / 2, HEIGHT - 6, x_label, "middle", "tick"))
    middle = (TOP + bottom) / 2
    turned = f'transform="rotate(-90 12 {middle})"'
    parts.append(_text(12, middle, y_label, "middle", "tick", turned))
    return parts


def _line(name: str, xy: np.ndarray, scale: _Scale, color: str) -> list[str]:
    """The line, with a dot at its last point."""
    if len(xy) == 0:
        return []
    places = [(scale.x(x), scale.y(y)) for x, y in xy]
    path = "M" + "L".join(f"{x} {y}" for x, y in places)
    (x, y), value = places[-1], xy[-1, 1]
    return [
        f'<path fill="none" stroke="{color}" stroke-width="1.8" stroke-linejoin="round" d="{path}"/>',
        f'<circle cx="{x}" cy="{y}" r="3" fill="{color}"><title>{html.escape(name)}: {value:g}</title></circle>',
    ]


def _legend(names: Sequence[str]) -> list[str]:
    """Names in the colors of their lines, at the right of the title."""
    parts, x = [], WIDTH - RIGHT
    for place in reversed(range(len(names))):
        parts.append(_text(x, 18, names[place], "end", "tick", f'style="fill:{COLORS[place % len(COLORS)]}"'))
        x -= 7 * len(names[place]) + 16
    return parts


def _text(x: float | int, y: float | int, text: str, anchor: str, kind: str, more: str = "") -> str:
    return f'<text x="{x}" y="{y}" text-anchor="{anchor}" class="{kind}" {more}>{html.escape(text)}</text>'

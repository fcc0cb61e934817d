"""The plots of the flight report: inline SVG made of text, without a script."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from sorvolo.geometry.arrays import Floats
from sorvolo.survey.mosaic import Status

_WIDE_PX = 720
_LOW_PX = 250
_MARGIN_PX = 46.0
_PLAN_HIGHEST_PX = 620.0
_MARK_PX = 3.2


@dataclass(frozen=True, eq=False)
class TrackColumns:
    """The rows of the report's "track" as columns: (N,) numbers, NaN where nothing is known."""

    names: tuple[str, ...]
    statuses: tuple[str, ...]
    columns: Mapping[str, Floats]

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, name: str) -> Floats:
        return self.columns[name]


@dataclass(frozen=True)
class Scale:
    """A straight map from values to pixels of a drawing."""

    low: float
    high: float
    low_px: float
    high_px: float

    def __call__(self, value: float) -> float:
        """Where the value lies, px."""
        share = (value - self.low) / (self.high - self.low)
        return self.low_px + share * (self.high_px - self.low_px)

    def ticks(self, count: int) -> Iterator[float]:
        """Round values inside the scale, about `count` of them."""
        step = round_length((self.high - self.low) / count)
        first = math.ceil(self.low / step - 1e-9)
        for k in range(first, math.floor(self.high / step + 1e-9) + 1):
            yield k * step


def round_length(about: float) -> float:
    """The largest of ... 0.2, 0.5, 1, 2, 5, 10, 20 ... that is no more than `about`, a positive number."""
    power = 10.0 ** math.floor(math.log10(about))
    return power * max(each for each in (1, 2, 5) if each <= about / power * (1 + 1e-9) or each == 1)


def track_plan(track: TrackColumns, *, unit: str) -> str:
    """Camera places seen from above, coloured by status, each tied to its GPS fix; north is up.

    The fix is the camera's place less its GPS residual. Frames without a place are left out; "" without any.
    """
    east, north = track["east_m"], track["north_m"]
    fix_east, fix_north = east - track["gps_east_m"], north - track["gps_north_m"]
    shown = np.isfinite(east) & np.isfinite(north)
    if not shown.any():
        return ""
    known = shown & np.isfinite(fix_east) & np.isfinite(fix_north)
    x_low, x_high = _extent(np.concatenate([east[shown], fix_east[known]]))
    y_low, y_high = _extent(np.concatenate([north[shown], fix_north[known]]))
    room_x, room_y = _WIDE_PX - 2 * _MARGIN_PX, _PLAN_HIGHEST_PX - 2 * _MARGIN_PX
    px = min(room_x / (x_high - x_low), room_y / (y_high - y_low))
    left = (_WIDE_PX - px * (x_high - x_low)) / 2
    height = px * (y_high - y_low) + 2 * _MARGIN_PX
    x = Scale(x_low, x_high, left, _WIDE_PX - left)
    y = Scale(y_low, y_high, height - _MARGIN_PX, _MARGIN_PX)
    path = " ".join(f"{x(east[k]):.1f},{y(north[k]):.1f}" for k in np.flatnonzero(shown))
    parts = [f'<polyline class="path" points="{path}"/>']
    for k in np.flatnonzero(known):
        fx, fy = x(fix_east[k]), y(fix_north[k])
        parts.append(f'<path class="tie" d="M{x(east[k]):.1f},{y(north[k]):.1f} L{fx:.1f},{fy:.1f}"/>')
        parts.append(f'<circle class="fix" cx="{fx:.1f}" cy="{fy:.1f}" r="2.4"/>')
    parts += [_mark(x(east[k]), y(north[k]), track, int(k)) for k in np.flatnonzero(shown)]
    first = int(np.flatnonzero(shown)[0])
    second = int(np.flatnonzero(shown)[:2][-1])
    around = [x(east[first])] + ([x(fix_east[first])] if known[first] else [])
    # on the side to which the track does not go, clear of the fix
    if east[second] < east[first]:
        parts.append(_label(max(around) + 9, y(north[first]) + 4, "start", "start"))
    else:
        parts.append(_label(min(around) - 9, y(north[first]) + 4, "start", "end"))
    length = round_length((x_high - x_low + y_high - y_low) / 6)
    bar_y = height - 12
    parts.append(
        f'<path class="ink" d="M12,{bar_y:.1f} h{length * px:.1f} m0,-4 v8 m{-length * px:.1f},-8 v8"/>'
        f'<text class="label" x="12" y="{bar_y - 8:.1f}">{length:g} {escape(unit)}</text>'
    )
    if unit == "m":
        parts.append(
            f'<path class="arrow" d="M{_WIDE_PX - 20},14 l6,18 l-6,-5 l-6,5 z"/>'
            f'<text class="label" x="{_WIDE_PX - 20}" y="46" text-anchor="middle">N</text>'
        )
    return _svg(height, "Plan of the flight: camera places and GPS fixes", parts)


def residuals_along(track: TrackColumns) -> str:
    """Residuals of the frames in the order of the flight; frames without one are marks on the axis."""
    values = track["residual_px"]
    highest = float(np.nanmax(values)) if np.isfinite(values).any() else 1.0
    x, y, parts = _frame_axes(len(track), 0.0, max(highest, 1e-3) * 1.08, "px")
    for k, value in enumerate(values):
        parts.append(_mark(x(k + 1), y(value if math.isfinite(value) else 0.0), track, k))
    return _svg(_LOW_PX, "Residual of each frame along the flight", parts)


def gps_along(track: TrackColumns, *, unit: str) -> str:
    """The GPS residual's east, north and up along the flight; "" when no frame has one."""
    names = ("east", "north", "up")
    series = [track[f"gps_{name}_m"] for name in names]
    known = np.concatenate([each[np.isfinite(each)] for each in series])
    if not len(known):
        return ""
    reach = max(float(np.abs(known).max()) * 1.08, 0.1)
    x, y, parts = _frame_axes(len(track), -reach, reach, unit)
    for name, values in zip(names, series):
        for run in _runs(np.isfinite(values)):
            points = " ".join(f"{x(k + 1):.1f},{y(values[k]):.1f}" for k in run)
            parts.append(f'<polyline class="line {name}" points="{points}"/>')
            if len(run) == 1:
                cx, cy = x(run[0] + 1), y(values[run[0]])
                parts.append(f'<circle class="dot {name}" cx="{cx:.1f}" cy="{cy:.1f}" r="2"/>')
    return _svg(_LOW_PX, "Camera place less GPS fix, along the flight", parts)


def gps_scatter(track: TrackColumns, *, unit: str) -> str:
    """East and north of the GPS residual as points around zero, with the circle that holds half of them."""
    east, north = track["gps_east_m"], track["gps_north_m"]
    known = np.isfinite(east) & np.isfinite(north)
    if not known.any():
        return ""
    distances = np.hypot(east[known], north[known])
    reach = max(float(np.abs(np.concatenate([east[known], north[known]])).max()) * 1.12, 0.1)
    size = 360.0
    x, y = Scale(-reach, reach, _MARGIN_PX, size - 12), Scale(-reach, reach, size - _MARGIN_PX, 12)
    parts = []
    for tick in x.ticks(6):
        parts.append(f'<path class="grid" d="M{x(tick):.1f},12 V{size - _MARGIN_PX:.1f}"/>')
        parts.append(f'<path class="grid" d="M{_MARGIN_PX:.1f},{y(tick):.1f} H{size - 12:.1f}"/>')
        parts.append(_label(x(tick), size - _MARGIN_PX + 16, f"{tick:g}", "middle"))
        parts.append(_label(_MARGIN_PX - 6, y(tick) + 4, f"{tick:g}", "end"))
    parts.append(_label(size - 12, size - 10, f"east, {unit}", "end"))
    parts.append(_label(8, 22, f"north, {unit}", "start"))
    parts.append(f'<path class="zero" d="M{x(0):.1f},12 V{size - _MARGIN_PX:.1f}"/>')
    parts.append(f'<path class="zero" d="M{_MARGIN_PX:.1f},{y(0):.1f} H{size - 12:.1f}"/>')
    half = float(np.median(distances)) / (2 * reach) * (size - 12 - _MARGIN_PX)
    parts.append(f'<circle class="median" cx="{x(0):.1f}" cy="{y(0):.1f}" r="{half:.1f}"/>')
    parts += [_mark(x(east[k]), y(north[k]), track, int(k)) for k in np.flatnonzero(known)]
    return _svg(size, "Camera place less GPS fix, east and north", parts, width=size)


def _svg(height: float, title: str, parts: Sequence[str], width: float = _WIDE_PX) -> str:
    return (
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" style="max-width:{1.2 * width:.0f}px">'
        f"<title>{escape(title)}</title>{''.join(parts)}</svg>"
    )


def _frame_axes(count: int, low: float, high: float, unit: str) -> tuple[Scale, Scale, list[str]]:
    """Scales and axes of a plot along the flight: frames to the right in order, values up."""
    x = Scale(1, max(count, 2), _MARGIN_PX + 8, _WIDE_PX - 14)
    y = Scale(low, high, _LOW_PX - 34, 18)
    parts = []
    for tick in y.ticks(5):
        style = "zero" if abs(tick) < 1e-12 else "grid"
        parts.append(f'<path class="{style}" d="M{_MARGIN_PX:.1f},{y(tick):.1f} H{_WIDE_PX - 8}"/>')
        parts.append(_label(_MARGIN_PX - 6, y(tick) + 4, f"{tick:g}", "end"))
    for tick in x.ticks(8):
        if tick == round(tick):
            parts.append(_label(x(tick), _LOW_PX - 16, f"{tick:g}", "middle"))
    parts.append(_label(8, 12, unit, "start"))
    parts.append(_label(_WIDE_PX - 8, _LOW_PX - 2, "selected frame, in order", "end"))
    return x, y, parts


def _mark(x: float, y: float, track: TrackColumns, k: int) -> str:
    """A frame: a disc by vision, a square by GPS alone, a cross when rejected; hovering names it."""
    status, r = track.statuses[k], _MARK_PX
    if status == Status.VISION:
        shape = f'<circle class="vision" cx="{x:.1f}" cy="{y:.1f}" r="{r}">'
        end = "</circle>"
    elif status == Status.GPS_ONLY:
        shape = f'<rect class="gps-only" x="{x - r:.1f}" y="{y - r:.1f}" width="{2 * r}" height="{2 * r}">'
        end = "</rect>"
    else:
        d = f"M{x - r:.1f},{y - r:.1f} l{2 * r},{2 * r} m0,{-2 * r} l{-2 * r},{2 * r}"
        shape, end = f'<path class="rejected" d="{d}">', "</path>"
    residual = track["residual_px"][k]
    tail = f", residual {residual:.2f} px" if math.isfinite(residual) else ""
    words = f"{track.names[k]}: {status}{tail}"
    return f"{shape}<title>{escape(words)}</title>{end}"


def _label(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text class="label" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _extent(values: Floats) -> tuple[float, float]:
    """The values' range, at least one unit wide."""
    low, high = float(values.min()), float(values.max())
    widen = max(0.0, 1.0 - (high - low)) / 2
    return low - widen, high + widen


def _runs(known: Sequence[bool] | Floats) -> Iterator[list[int]]:
    """The stretches of neighbouring indices that are known."""
    run: list[int] = []
    for k, each in enumerate(known):
        if each:
            run.append(k)
        elif run:
            yield run
            run = []
    if run:
        yield run

"""The plots of the pages: places and numbers worked out here, drawn as inline SVG by the templates in plots/."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from markupsafe import Markup

from sorvolo.geometry.arrays import Floats
from sorvolo.store.pages.words import render

_WIDE_PX = (
    720  # of all drawings: a phone's screen and a page's column take it; the rest by choice too
)
_LOW_PX = 250
_MARGIN_PX = 46.0
_PLAN_HIGHEST_PX = 620.0
SIDE_PX = 420.0
"""A side of a square plot."""

_COLOURS = 5  # styles of a line, c0 to c4; c5 is for what was rejected
_STATUS_WORDS = {"vision": "matched", "gps-only": "GPS only", "rejected": "not placed"}


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

    def __call__(self, value: Any) -> Any:
        """Where the value lies, or the values, px."""
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
    return power * max(
        each for each in (1, 2, 5) if each <= about / power * (1 + 1e-9) or each == 1
    )


@dataclass(frozen=True)
class Mark:
    """One frame in a plot: a disc where it was matched, a square by GPS alone, a cross where it was not placed."""

    x: float
    y: float
    status: str
    words: str


@dataclass(frozen=True)
class PlotLabel:
    """A text in a plot."""

    x: float
    y: float
    text: str
    anchor: str = "middle"


@dataclass(frozen=True)
class Axes:
    """The frame of a plot: lines across and down by style and place, and labels."""

    left: float
    right: float
    top: float
    bottom: float
    across: tuple[tuple[str, float], ...] = ()
    down: tuple[tuple[str, float], ...] = ()
    labels: tuple[PlotLabel, ...] = ()


@dataclass(frozen=True)
class Line:
    """A line in a plot, and dots on it that its words explain; `style` is a class of the style sheet."""

    style: str
    points: Sequence[tuple[float, float]]
    dots: Sequence[tuple[float, float]] = field(default=())
    words: str = ""
    dot_px: float = 2.0


@dataclass(frozen=True)
class Bar:
    """One bar of a group: its style, its share from 0 to 1, and what it is."""

    style: str
    share: float
    words: str


def bar_plot(
    title: str, groups: Sequence[tuple[str, Sequence[Bar]]], width: float, height: float
) -> Markup:
    """Groups of bars beside each other, shares in per cent upwards, each group with its name below."""
    y = Scale(0, 1, height - 34, 18)
    wide = (width - 2 * _MARGIN_PX) / max(1, len(groups))
    drawn, labels = [], [PlotLabel(8, 12, "%", "start")]
    for place, (name, bars) in enumerate(groups):
        left, step = _MARGIN_PX + (place + 0.1) * wide, 0.8 * wide / max(1, len(bars))
        labels.append(PlotLabel(_MARGIN_PX + (place + 0.5) * wide, height - 14, name))
        for k, bar in enumerate(bars):
            drawn.append(
                (
                    bar.style,
                    left + k * step,
                    y(bar.share),
                    0.85 * step,
                    y(0) - y(bar.share),
                    bar.words,
                )
            )
            labels.append(
                PlotLabel(left + (k + 0.42) * step, y(bar.share) - 4, f"{100 * bar.share:.0f}")
            )
    ticks = (0.0, 0.25, 0.5, 0.75, 1.0)
    labels += [PlotLabel(_MARGIN_PX - 6, y(tick) + 4, f"{100 * tick:g}", "end") for tick in ticks]
    frame = Axes(
        _MARGIN_PX,
        width - 8,
        18,
        y(0),
        tuple((_line_style(tick), y(tick)) for tick in ticks),
        (),
        tuple(labels),
    )
    return render(
        "plots/bars.svg", title=title, bars=drawn, frame=frame, width=width, height=height
    )


def colour_class(place: int) -> str:
    """The style of a line, by its place in the list."""
    return f"c{place % _COLOURS}"


def line_plot(
    title: str, lines: Sequence[Line], frame: Axes, width: float, height: float
) -> Markup:
    """Lines over their axes."""
    return render(
        "plots/lines.svg", title=title, lines=lines, frame=frame, width=width, height=height
    )


def unit_axes(across: str, upwards: str) -> tuple[Scale, Scale, Axes]:
    """Scales and axes of a square plot, SIDE_PX a side, of two shares from 0 to 1."""
    x, y = Scale(0, 1, _MARGIN_PX, SIDE_PX - 12), Scale(0, 1, SIDE_PX - _MARGIN_PX, 12)
    ticks = (0.0, 0.25, 0.5, 0.75, 1.0)
    labels = [PlotLabel(x(tick), y(0) + 16, f"{tick:g}") for tick in ticks]
    labels += [PlotLabel(x(0) - 6, y(tick) + 4, f"{tick:g}", "end") for tick in ticks]
    labels += [
        PlotLabel(x(1), SIDE_PX - 8, across, "end"),
        PlotLabel(6, SIDE_PX - 8, f"{upwards} upwards", "start"),
    ]
    return (
        x,
        y,
        Axes(
            x(0),
            x(1),
            12,
            y(0),
            tuple(("grid", y(tick)) for tick in ticks),
            tuple(("grid", x(tick)) for tick in ticks),
            tuple(labels),
        ),
    )


def track_plan(track: TrackColumns, *, unit: str) -> str:
    """Camera positions seen from above, coloured by status, each tied to its GPS fix; north is up.

    The fix is the camera's position less its GPS residual. Frames without a position are left out; "" without any.
    """
    east, north = track["east_m"], track["north_m"]
    fix_east, fix_north = east - track["gps_east_m"], north - track["gps_north_m"]
    shown = np.isfinite(east) & np.isfinite(north)
    if not shown.any():
        return ""
    fixed = shown & np.isfinite(fix_east) & np.isfinite(fix_north)
    x, y, height, px = _plan_scales(
        np.concatenate([east[shown], fix_east[fixed]]),
        np.concatenate([north[shown], fix_north[fixed]]),
    )
    length = round_length((x.high - x.low + y.high - y.low) / 6)
    return render(
        "plots/track.svg",
        width=_WIDE_PX,
        height=height,
        path=[(x(east[k]), y(north[k])) for k in np.flatnonzero(shown)],
        fixes=[
            (x(east[k]), y(north[k]), x(fix_east[k]), y(fix_north[k]))
            for k in np.flatnonzero(fixed)
        ],
        marks=[_mark(x(east[k]), y(north[k]), track, int(k)) for k in np.flatnonzero(shown)],
        start=_start_label(
            x(east[shown]),
            y(north[shown]),
            x(fix_east) if fixed[np.flatnonzero(shown)[0]] else None,
            int(np.flatnonzero(shown)[0]),
        ),
        bar=length * px,
        bar_words=f"{length:g} {unit}".strip(),
        has_north=unit == "m",
    )


def residuals_along(track: TrackColumns) -> str:
    """Misalignment of the frames in the order of the flight; frames without one are marks on the axis."""
    values = track["residual_px"]
    highest = float(np.nanmax(values)) if np.isfinite(values).any() else 1.0
    x, y, frame = _frame_axes(len(track), 0.0, max(highest, 1e-3) * 1.08, "px")
    marks = [
        _mark(x(k + 1), y(value if math.isfinite(value) else 0.0), track, k)
        for k, value in enumerate(values)
    ]
    return render(
        "plots/marks.svg",
        title="Misalignment of each frame along the flight",
        frame=frame,
        marks=marks,
        width=_WIDE_PX,
        height=_LOW_PX,
    )


def gps_along(track: TrackColumns, *, unit: str) -> str:
    """The GPS residual's east, north and up along the flight; "" when no frame has one."""
    names = ("east", "north", "up")
    series = [track[f"gps_{name}_m"] for name in names]
    known = np.concatenate([each[np.isfinite(each)] for each in series])
    if not len(known):
        return ""
    reach = max(float(np.abs(known).max()) * 1.08, 0.1)
    x, y, frame = _frame_axes(len(track), -reach, reach, unit)
    lines = []
    for name, values in zip(names, series):
        for run in _runs(np.isfinite(values)):
            points = [(x(k + 1), y(values[k])) for k in run]
            lines.append(Line(name, points, points if len(run) == 1 else ()))
    return line_plot(
        "Camera position less GPS fix, along the flight", lines, frame, _WIDE_PX, _LOW_PX
    )


def stated_and_found(
    rows: Sequence[tuple[str, float, float, float, float, int]],
    *,
    across: str = "stated",
    upwards: str = "found",
) -> Markup:
    """What came true over what was stated, both 0 to 1; on the rising line both agree.

    Rows of a name, stated, found with the bounds of its interval, and how many; rows of one name have one colour.
    `across` and `upwards` name the two in words.
    """
    x, y, frame = unit_axes(across, upwards)
    names = list(dict.fromkeys(name for name, *_ in rows))
    lines = [Line("median", [(x(0), y(0)), (x(1), y(1))])]
    for name, stated, found, found_low, found_high, count in rows:
        words = f"{name}: {stated:.2f} {across}, {found:.2f} {upwards} of {count}"
        lines.append(
            Line(
                colour_class(names.index(name)),
                [(x(stated), y(found_low)), (x(stated), y(found_high))],
                [(x(stated), y(found))],
                words,
                4.0,
            )
        )
    return line_plot(f"{upwards.capitalize()} over {across}", lines, frame, SIDE_PX, SIDE_PX)


def _plan_scales(east: Floats, north: Floats) -> tuple[Scale, Scale, float, float]:
    """Scales that show all of these at one scale, north up; the drawing's height, and pixels a metre."""
    x_low, x_high = _extent(east)
    y_low, y_high = _extent(north)
    room_x, room_y = _WIDE_PX - 2 * _MARGIN_PX, _PLAN_HIGHEST_PX - 2 * _MARGIN_PX
    px = min(room_x / (x_high - x_low), room_y / (y_high - y_low))
    left = (_WIDE_PX - px * (x_high - x_low)) / 2
    height = px * (y_high - y_low) + 2 * _MARGIN_PX
    x = Scale(x_low, x_high, left, _WIDE_PX - left)
    return x, Scale(y_low, y_high, height - _MARGIN_PX, _MARGIN_PX), height, px


def _start_label(x: Floats, y: Floats, fix_x: Floats | None, first: int) -> PlotLabel:
    """The word at the track's start, on the side to which the track does not go, clear of the fix."""
    around = [float(x[0])] + ([] if fix_x is None else [float(fix_x[first])])
    if x[:2][-1] < x[0]:
        return PlotLabel(max(around) + 9, float(y[0]) + 4, "start", "start")
    return PlotLabel(min(around) - 9, float(y[0]) + 4, "start", "end")


def _frame_axes(count: int, low: float, high: float, unit: str) -> tuple[Scale, Scale, Axes]:
    """Scales and axes of a plot along the flight: frames to the right in order, values up."""
    x = Scale(1, max(count, 2), _MARGIN_PX + 8, _WIDE_PX - 14)
    y = Scale(low, high, _LOW_PX - 34, 18)
    ticks = list(y.ticks(5))
    labels = [PlotLabel(_MARGIN_PX - 6, y(tick) + 4, f"{tick:g}", "end") for tick in ticks]
    labels += [
        PlotLabel(x(tick), _LOW_PX - 16, f"{tick:g}") for tick in x.ticks(8) if tick == round(tick)
    ]
    labels += [
        PlotLabel(8, 12, unit, "start"),
        PlotLabel(_WIDE_PX - 8, _LOW_PX - 2, "selected frame, in order", "end"),
    ]
    across = tuple((_line_style(tick), y(tick)) for tick in ticks)
    return x, y, Axes(_MARGIN_PX, _WIDE_PX - 8, 18, _LOW_PX - 34, across, (), tuple(labels))


def _line_style(tick: float) -> str:
    return "zero" if abs(tick) < 1e-12 else "grid"


def _mark(x: float, y: float, track: TrackColumns, k: int) -> Mark:
    """A frame's mark, whose words name it."""
    status, residual = track.statuses[k], track["residual_px"][k]
    tail = f", misalignment {residual:.2f} px" if math.isfinite(residual) else ""
    return Mark(
        float(x), float(y), status, f"{track.names[k]}: {_STATUS_WORDS.get(status, status)}{tail}"
    )


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

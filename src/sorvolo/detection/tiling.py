"""Which looks the detector takes at a picture: how large and in which tiles, from the ground that a pixel covers.

A network knows objects of some sizes better than of others. Where the ground that a pixel covers is known, the picture
is shown at the right size; where it is not, in several (an image pyramid, `fusing`), and only the boxes themselves show
which of them to believe.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sorvolo.detection.contract import MOST_LARGER, ModelInfo, Pyramid
from sorvolo.detection.fusing import trust
from sorvolo.detection.session import Seen
from sorvolo.errors import SettingsError
from sorvolo.geometry.planning import BOTTOM_CRITICAL_M, Task, required_px_per_m
from sorvolo.survey.objects import TYPICAL_SIZE_M

Tiles = Literal["auto"] | int | None
"""How a picture is cut: "auto", tiles of this many of its pixels a side, or not at all."""

MOST_WHOLE_PX = 2_400_000
"""Up to this many pixels "auto" shows a picture at once: 1920 x 1080 and a little more."""

MOST_AT_ONCE_PX = 8_400_000
"""A larger picture than a 4K frame is cut into tiles even if it was asked for whole: it would take gigabytes."""

TASK = Task.RECOGNITION
"""What a person must at least be shown for (Johnson's criteria): 6 px over the critical dimension."""

COARSEST_M = 1 / required_px_per_m(TASK, BOTTOM_CRITICAL_M)
"""The ground that a pixel may cover for a person from straight above to be recognised (eq. 3.9): 10 cm."""

_THERMAL_PX = 2.0  # times as many pixels as by day must a person have: thermal optics blur, and clothes hide limbs
# where the ground's sampling distance is not known: thermal sensors have few pixels
_THERMAL_LARGER = 1.5
_MUCH_LONGER = 1.4  # times what the model knows: from there on a class gets a look of its own, which costs half or less
_LEAST_OVERLAP_PX, _SPARE = 64, 1.15
_LEAST_SIDE_PX = 64  # of a tile: less is a typing error
MOST_MAGNIFIED_PX = 20_000_000  # of a magnified picture: what a photo of that size costs; by choice
# a score from which on something small is worth a closer look: as of the second look
_LEAST_SMALL = 0.3


@dataclass(frozen=True)
class TilePlan:
    """Tiles of a picture, left, top, right, bottom in its pixels, each shown `scale` times as large."""

    scale: float
    places_px: tuple[tuple[int, int, int, int], ...]


def scale_for(
    info: ModelInfo, m_per_px: float, wanted: Sequence[str], thermal: bool = False
) -> float:
    """How many times larger the model should see a picture whose pixel covers `m_per_px` of ground.

    A person from straight above must be as large as Johnson's criteria ask (`TASK`, the same numbers as `sorvolo
    plan`) and as the model needs, `best_px`; else the picture is magnified, at most three times. A person's whole
    length, as seen aslant, must not be larger than the model knows; else the picture is made smaller. Between the two
    it stays as it is. Where no person is `wanted`, the smallest wanted class of known size takes its place; where
    there is none, the scale is 1. A `thermal` frame must show a person twice as large.
    """
    known = [name for name in wanted if name in TYPICAL_SIZE_M]
    if not known:
        return 1.0
    name = "person" if "person" in known else min(known, key=lambda each: TYPICAL_SIZE_M[each][0])
    length_m, width_m, height_m = TYPICAL_SIZE_M[name]
    critical_m = BOTTOM_CRITICAL_M if name == "person" else width_m
    most_px = info.best_px[name][1]
    least = m_per_px * max(
        required_px_per_m(TASK, critical_m), needed_px_per_m(info, name, length_m)
    )
    if thermal and name == "person":
        least *= _THERMAL_PX
    most = m_per_px * most_px / max(length_m, height_m)
    if least > 1:
        return min(least, MOST_LARGER)
    return min(1.0, max(least, most))


def coarsest_m_per_px(label: str, info: ModelInfo) -> float:
    """The most ground that a pixel may cover for a class to be recognised: by Johnson's criteria, at its smallest
    decisive side; infinite for a class of unknown size."""
    if label not in TYPICAL_SIZE_M:
        return math.inf
    critical_m = BOTTOM_CRITICAL_M if label == "person" else TYPICAL_SIZE_M[label][1]
    return critical_m / TASK.pixels if label in info.classes else critical_m


def is_too_small(name: str, m_per_px: float) -> bool:
    """Whether a person from straight above fills fewer pixels, each covering `m_per_px`, than `TASK` takes (eq. 3.9).

    What so few pixels show, a post with its shadow shows as well (0086). NaN, an unknown scale, is not too small.
    """
    return name == "person" and m_per_px > COARSEST_M


def looks_for(
    info: ModelInfo, m_per_px: float, wanted: Sequence[str], thermal: bool = False
) -> tuple[tuple[str, ...], ...]:
    """The `wanted` classes by the look that finds them, each at the `scale_for` its own classes.

    One look, but where people are shown so large that another class (cars) is much longer than the model knows,
    `best_px`: that class is then looked for in a smaller copy of the picture.
    """
    if not 0 < m_per_px < math.inf:
        return (tuple(wanted),)
    px_per_m = scale_for(info, m_per_px, wanted, thermal) / m_per_px
    large = tuple(
        name
        for name in wanted
        if name in TYPICAL_SIZE_M
        and TYPICAL_SIZE_M[name][0] * px_per_m > _MUCH_LONGER * info.best_px[name][1]
    )
    others = tuple(name for name in wanted if name not in large)
    return (others, large) if others and large else (tuple(wanted),)


def needed_px_per_m(info: ModelInfo, name: str, length_m: float) -> float:
    """The ground resolution from which on the model finds objects of a class well that show a side of `length_m`."""
    return info.best_px[name][0] / length_m


def whole_m_per_px(
    info: ModelInfo, wanted: Sequence[str], m_per_px: float, size_px: tuple[int, int]
) -> float:
    """The sampling distance by which "auto" magnifies a picture of (height, width) `size_px` no further than to one
    tile, `MOST_WHOLE_PX`: of many frames that show the same ground none needs to be searched at any price."""
    scale = scale_for(info, m_per_px, wanted)
    most = max(1.0, math.sqrt(MOST_WHOLE_PX / (size_px[0] * size_px[1])))
    return m_per_px * min(1.0, most / scale)


def plan_tiles(
    size_px: tuple[int, int],
    info: ModelInfo,
    wanted: Sequence[str],
    *,
    tiles: Tiles = "auto",
    m_per_px: float = math.nan,
    fixed_px: tuple[int, int] | None = None,
    thermal: bool = False,
    times: float = 1.0,
) -> TilePlan:
    """The tiles of a picture of (height, width) `size_px`.

    `tiles` "auto": the scale comes from `m_per_px`; where that is unknown (NaN), it is 1, or 1.5 for a `thermal` frame
    that is small. A picture that is still small is one tile; else it is cut into tiles of at most that size, which show
    the fewest pixels twice. A number: tiles of as many of the picture's pixels, not scaled. None: the picture as
    it is. Tiles overlap by the longest object that is wanted, as far as its size is known, at most by half. A model of
    one input size, `fixed_px`, gets tiles of that size from "auto". `times`: "auto" shows it so many times as large.
    Raises SettingsError for a tile size or a sampling distance that cannot be.
    """
    height, width = size_px
    if m_per_px <= 0 or math.isinf(m_per_px):
        raise SettingsError(f"the ground sampling distance must be positive, not {m_per_px} m/px")
    if tiles is None:
        if fixed_px is not None or height * width <= MOST_AT_ONCE_PX:
            return TilePlan(1.0, ((0, 0, width, height),))
        return _auto_plan(size_px, info, wanted, math.nan, 1.0, fixed_px)
    if tiles == "auto":
        scale = times * _auto_scale(height * width, info, wanted, m_per_px, thermal)
        return _auto_plan(size_px, info, wanted, m_per_px, scale, fixed_px)
    if type(tiles) is not int or tiles < _LEAST_SIDE_PX:
        raise SettingsError(
            f"tiles must be 'auto' or at least {_LEAST_SIDE_PX} px a side, not {tiles!r}"
        )
    return TilePlan(
        1.0, _places(size_px, (tiles, tiles), _overlap_px(info, wanted, m_per_px, 1.0), info.stride)
    )


def _auto_scale(
    area_px: int, info: ModelInfo, wanted: Sequence[str], m_per_px: float, thermal: bool
) -> float:
    if not math.isnan(m_per_px):
        return scale_for(info, m_per_px, wanted, thermal)
    return _THERMAL_LARGER if thermal and area_px * _THERMAL_LARGER**2 <= MOST_WHOLE_PX else 1.0


def _auto_plan(
    size_px: tuple[int, int],
    info: ModelInfo,
    wanted: Sequence[str],
    m_per_px: float,
    scale: float,
    fixed_px: tuple[int, int] | None,
) -> TilePlan:
    """One tile where the picture at this scale is small enough for that, else tiles that are."""
    height, width = size_px
    overlap_px, step = _overlap_px(info, wanted, m_per_px, scale), info.stride / scale
    if fixed_px is not None:
        sides = fixed_px[0] / scale, fixed_px[1] / scale
        return TilePlan(scale, _places(size_px, sides, overlap_px, step))
    if height * width * scale**2 <= MOST_WHOLE_PX:
        return TilePlan(scale, ((0, 0, width, height),))
    # (height, width) of the tiles of at most MOST_WHOLE_PX, as the model sees them, that show least in all
    most = MOST_WHOLE_PX / (scale * step) ** 2  # in steps
    best = (math.inf, (math.sqrt(most) * step, math.sqrt(most) * step))
    for height in range(math.ceil(math.sqrt(most / 2)), math.ceil(math.sqrt(most * 2))):
        sides = min(height * step, size_px[0]), min(math.floor(most / height) * step, size_px[1])
        places = np.array(_places(size_px, sides, overlap_px, step))
        shown_px = float(np.prod(places[:, 2:] - places[:, :2], axis=1).sum())
        best = min(best, (shown_px, sides))
    cheapest_sides = best[1]
    return TilePlan(scale, _places(size_px, cheapest_sides, overlap_px, step))


def _places(
    size_px: tuple[int, int], sides: tuple[float, float], overlap_px: float, step: float
) -> tuple[tuple[int, int, int, int], ...]:
    """Left, top, right and bottom of tiles of at most (height, width) `sides`, row by row."""
    rows = _spans(size_px[0], sides[0], overlap_px, step)
    columns = _spans(size_px[1], sides[1], overlap_px, step)
    return tuple((left, top, right, bottom) for top, bottom in rows for left, right in columns)


def _overlap_px(info: ModelInfo, wanted: Sequence[str], m_per_px: float, scale: float) -> float:
    """How far tiles overlap, in the picture's pixels: so far that the longest wanted object is whole in one."""
    lengths = [
        _SPARE * math.hypot(*TYPICAL_SIZE_M[name][:2]) / m_per_px
        for name in wanted
        if name in TYPICAL_SIZE_M and not math.isnan(m_per_px)
    ]
    if not lengths:
        lengths = [info.best_px[name][1] / scale for name in wanted]
    return max(_LEAST_OVERLAP_PX / scale, *lengths)


def _spans(length: int, side: float, overlap: float, step: float) -> list[tuple[int, int]]:
    """(start, end) of evenly laid spans no longer than `side`, as short as that many allow in whole `step`s."""
    if length <= side:
        return [(0, length)]
    overlap = min(overlap, side / 2)
    count = math.ceil((length - overlap) / (side - overlap) - 1e-9)
    short = math.ceil((length + (count - 1) * overlap) / count / step - 1e-9) * step
    whole = max(1, min(math.floor(side), math.floor(short), length))
    starts = np.rint(np.linspace(0, length - whole, count)).astype(int).tolist()
    return [(start, start + whole) for start in starts]


def sizes_for(
    size_px: tuple[int, int],
    info: ModelInfo,
    wanted: Sequence[str],
    tiles: Tiles,
    m_per_px: float,
) -> dict[float, tuple[str, ...]]:
    """How many times as large a picture of (height, width) `size_px` is shown besides as it is, and for which classes.

    Where "auto" does not know its scale, those of the model's `pyramid` at which it has `MOST_MAGNIFIED_PX` or less.
    """
    asked = {name: each.times for name, each in _asked(info, wanted, tiles, m_per_px).items()}
    return _within(size_px, asked)


def closer_for(
    size_px: tuple[int, int],
    info: ModelInfo,
    wanted: Sequence[str],
    tiles: Tiles,
    m_per_px: float,
    looks: Sequence[Seen],
    times: Sequence[float],
) -> dict[float, tuple[str, ...]]:
    """Return upscaling factors of closer looks: for classes of which the `looks` so far, `times` as large, show
    something small. The first look shows the picture as it is.

    Small is what the model knows better as large as it is shown there than in any look so far.
    """
    asked = {}
    for name, pyramid in _asked(info, wanted, tiles, m_per_px).items():
        label = info.classes.index(name)
        boxes = [
            look.boxes_px[(look.labels == label) & (look.scores >= _LEAST_SMALL)] for look in looks
        ]
        shown = np.array([*times, *(times[0] * each for each in pyramid.closer)])
        best = trust(np.concatenate(boxes), shown, pyramid).argmax(axis=1)
        asked[name] = tuple(
            each for k, each in enumerate(pyramid.closer, len(times)) if (best == k).any()
        )
    return _within(size_px, asked)


def _asked(
    info: ModelInfo, wanted: Sequence[str], tiles: Tiles, m_per_px: float
) -> dict[str, Pyramid]:
    """The classes that are looked for in several sizes."""
    if tiles != "auto" or not math.isnan(m_per_px):
        return {}
    return {name: info.pyramid[name] for name in wanted if name in info.pyramid}


def _within(
    size_px: tuple[int, int], asked: Mapping[str, Sequence[float]]
) -> dict[float, tuple[str, ...]]:
    """The sizes at which a picture has not too many pixels, each with its classes."""
    area_px = size_px[0] * size_px[1]
    return {
        each: tuple(name for name, times in asked.items() if each in times)
        for each in sorted({each for times in asked.values() for each in times})
        if area_px * each**2 <= MOST_MAGNIFIED_PX
    }

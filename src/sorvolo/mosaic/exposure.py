"""Exposure: one gain per frame and channel and one vignette per camera, solved from points seen in two
frames.

A lens darkens towards its corners, V(r) = exp(a2 r^2 + a4 r^4) with r = 1 at the corner, and a frame's gain g
undoes its exposure: what two frames a and b show of the same ground agrees when log I_a + log g_a - log
V(r_a) = log I_b + log g_b - log V(r_b). That is linear in log g, a2 and a4.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import splu

from sorvolo.geometry.arrays import (
    Bytes,
    Floats,
    Floats16,
    Floats32,
    ImageRGB,
    Mask,
    PointsPx,
    Rows,
    frozen,
)

_SHRINK = 4  # times smaller pictures: colours are means of so many pixels a side
_ITERATIONS = 8  # rounds of the robust solve; by choice
_LINKS_AT_ONCE = 512  # bounds the memory
_FIELD_PX = 1 << 17  # of a picture, corrected at a time
_SHOULDER = 200.0  # level from which on brightening is compressed; by choice
_SIGMA_FROM_MEDIAN = 1.126  # of the root mean square of three normal numbers


# sigmas are of the logarithm of a gain (0.1 is about 10 %)
_GAIN_SIGMA = 0.15  # prior about gain 1: keeps the whole map from drifting along a chain of links
_VIGNETTE_SIGMA = 0.3  # prior about no vignette: where radii do not differ it stays at 0
_COLOUR_SIGMA = 0.03  # least spread of a point's colour: noise, texture and misplacement
_LARGEST_LOG_GAIN = np.log(2.0)  # a picture that would need more is left darker; by choice
POINTS_PER_LINK = 48
"""Colours of the ground that both pictures show."""


@dataclass(frozen=True, eq=False)
class ColourPairs:
    """The same ground in two images: mean colours, (N, 3) each, and squared radii (corner = 1), (N,) each.

    Kept to a thousandth, which is a thirtieth of what colours scatter: a long flight has a million of them.
    """

    colours_a: Floats16
    colours_b: Floats16
    radius2_a: Floats16
    radius2_b: Floats16

    def __post_init__(self) -> None:
        for name in ("colours_a", "colours_b", "radius2_a", "radius2_b"):
            object.__setattr__(self, name, frozen(getattr(self, name), np.float16))

    def __len__(self) -> int:
        return len(self.colours_a)

    def thinned(self, most: int) -> "ColourPairs":
        """At most this many of them, taken evenly."""
        if len(self) <= most:
            return self
        pick = np.linspace(0, len(self) - 1, most).astype(int)
        return ColourPairs(
            self.colours_a[pick], self.colours_b[pick], self.radius2_a[pick], self.radius2_b[pick]
        )


@dataclass(frozen=True, eq=False)
class Exposure:
    """Gains (3,) that multiply each frame's channels, the camera's `vignette` (a2, a4), and the spread left.

    `spread` is the robust relative difference of the colours of the same ground after correction.
    """

    gains: Mapping[int, Floats]
    vignette: Floats = field(default_factory=lambda: np.zeros(2))
    spread: float = 0.0

    def gains_of(self, frame_id: int) -> Floats:
        """(3,) the frame's gains; ones where nothing is known of it."""
        return self.gains.get(frame_id, np.ones(3))

    def updated(self, newer: "Exposure") -> "Exposure":
        """With all that the newer one knows, and what only this one does."""
        vignette = newer.vignette if newer.gains else self.vignette
        return Exposure({**self.gains, **newer.gains}, vignette, newer.spread)


def tie_colours(
    image_a: ImageRGB, points_a_px: PointsPx, image_b: ImageRGB, points_b_px: PointsPx
) -> ColourPairs:
    """The mean colours around matched points, (N, 2) each, of two undistorted images.

    Means are over about 8 px, from quarter-size copies. Points that are clipped or nearly black in either
    image show nothing of exposure and are left out.
    """
    colours_a, colours_b = _sample(image_a, points_a_px), _sample(image_b, points_b_px)
    both = np.hstack([colours_a, colours_b])
    keep = (both.min(axis=1) > 6) & (both.max(axis=1) < 247)
    return ColourPairs(
        colours_a[keep],
        colours_b[keep],
        _radius2(points_a_px, image_a)[keep],
        _radius2(points_b_px, image_b)[keep],
    )


def solve_exposure(pairs: Mapping[tuple[int, int], ColourPairs]) -> Exposure:
    """Gains of all frames named in `pairs` (frame a, frame b), by robust least squares of log colours.

    Frames with few pairs stay near gain 1, and few pairs leave the vignette near none.
    """
    ids = sorted({each for link in pairs for each in link})
    if not any(len(each) for each in pairs.values()):
        return Exposure({each: np.ones(3) for each in ids})
    # the equations of all links, at least one of which has pairs
    links = sorted(pairs)
    counts = np.array([min(len(pairs[each]), POINTS_PER_LINK) for each in links])
    links, counts = [each for each, count in zip(links, counts) if count], counts[counts > 0]
    exists = np.arange(counts.max()) < counts[:, None]
    radius2_a, radius2_b = np.zeros((2, *exists.shape), np.float32)
    difference = np.zeros((*exists.shape, 3), np.float32)
    for row, (link, count) in enumerate(zip(links, counts.tolist(), strict=True)):
        chosen = pairs[link].thinned(POINTS_PER_LINK)
        radius2_a[row, :count], radius2_b[row, :count] = chosen.radius2_a, chosen.radius2_b
        colours_a, colours_b = (
            each.astype(np.float32) for each in (chosen.colours_a, chosen.colours_b)
        )
        difference[row, :count] = np.log(np.maximum(colours_a, 1.0)) - np.log(
            np.maximum(colours_b, 1.0)
        )
    lens = [len(ids), len(ids) + 1]
    columns = np.column_stack(
        [np.searchsorted(ids, links), np.tile([*lens, *lens], (len(links), 1))]
    )
    solution, spread = _robust_solution(
        _Equations(columns, radius2_a, radius2_b, difference, exists), len(ids)
    )
    gains = np.exp(np.clip(solution[:-2], -_LARGEST_LOG_GAIN, _LARGEST_LOG_GAIN))
    return Exposure(dict(zip(ids, gains)), solution[-2:, 0].copy(), spread)


def corrected(
    image: ImageRGB, gains: Floats, vignette: Floats, place: tuple[int, int, int, int] | None = None
) -> ImageRGB:
    """The image as it would be with gain 1 and no vignette: times gains (3,), divided by exp(a2 r^2 + a4 r^4).

    `place` is the part of a whole picture that the image is: its first pixel's x and y, the whole's width and height.
    """
    if not vignette.any():
        if (gains == 1).all():
            return image
        levels = np.arange(256.0)
        table = np.stack([_brightened(levels, gain) for gain in gains.tolist()], axis=1)
        return cv2.LUT(image, table[None])  # type: ignore[return-value]
    height, width = image.shape[:2]
    x0, y0, whole_width, whole_height = place or (0, 0, width, height)
    diagonal2 = whole_width**2 + whole_height**2
    x = (2 * np.arange(x0, x0 + width) - (whole_width - 1)) ** 2 / diagonal2
    y = (2 * np.arange(y0, y0 + height) - (whole_height - 1)) ** 2 / diagonal2
    x, y = x.astype(np.float32), y.astype(np.float32)
    result = np.empty((height, width, 3), np.uint8)
    # at a time: the field of a whole picture is five times as large as the picture
    rows = max(1, _FIELD_PX // width)
    for first in range(0, height, rows):
        some = slice(first, first + rows)
        radius2 = y[some, None] + x
        field = cv2.exp(-(np.float32(vignette[0]) + np.float32(vignette[1]) * radius2) * radius2)
        cv2.merge(
            [
                cv2.multiply(channel, field, scale=float(gain), dtype=cv2.CV_8U)
                for channel, gain in zip(cv2.split(image[some]), gains)
            ],
            result[some],
        )
    return result


def _brightened(levels: Floats, gain: float) -> Bytes:
    """Gray levels times a gain; beyond the shoulder ever less, so that only what is white in the picture is white."""
    if gain <= 1:
        return (levels * gain + 0.5).astype(np.uint8)
    brightened = np.interp(levels, [0, _SHOULDER / gain, 255], [0, _SHOULDER, 255])
    return np.where(levels < 255, np.minimum(brightened + 0.5, 254), 255).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class _Equations:
    """Colour pairs as equations, those of a link beside each other, L links of up to P pairs.

    `columns` (L, 6) of their unknowns, gains and then the vignette's two, squared radii (L, P),
    log-colour `difference` (L, P, 3); `exists` (L, P) is False where a link has fewer pairs.
    """

    columns: Rows
    radius2_a: Floats32
    radius2_b: Floats32
    difference: Floats32
    exists: Mask

    def batches(self) -> "Iterator[tuple[slice, Floats]]":
        """Some links after the others, and the factors (l, P, 6) of their unknowns: those of all would be large."""
        for first in range(0, len(self.columns), _LINKS_AT_ONCE):
            some = slice(first, first + _LINKS_AT_ONCE)
            a, b = self.radius2_a[some].astype(np.float64), self.radius2_b[some].astype(np.float64)
            one = np.ones_like(a)
            yield some, np.stack([one, -one, -a, -(a**2), b, b**2], axis=-1)


def _robust_solution(equations: _Equations, frames: int) -> tuple[Floats, float]:
    """(U, 3) unknowns per channel, logarithms of gains first, and the robust spread of what is left."""
    prior = np.repeat([_GAIN_SIGMA**-2, _VIGNETTE_SIGMA**-2], [frames, 2])
    solution, typical = np.zeros((len(prior), 3)), 0.0
    for _ in range(_ITERATIONS):
        length = np.concatenate(
            [
                np.linalg.norm(
                    equations.difference[some] + factors @ solution[equations.columns[some]],
                    axis=-1,
                )
                for some, factors in equations.batches()
            ]
        ) / np.sqrt(3)
        typical = float(np.median(length[equations.exists]))
        spread = max(_COLOUR_SIGMA, _SIGMA_FROM_MEDIAN * typical)
        weight = equations.exists / (1 + (length / spread) ** 2) / spread**2
        # (U, 3) unknowns from weighted normal equations; the vignette is one for all
        # channels
        columns, count = equations.columns, len(prior)
        blocks, right = np.zeros((len(columns), 6, 6)), np.zeros((count, 3))
        for some, factors in equations.batches():
            weighted = np.swapaxes(factors * weight[some, :, None], 1, 2)  # (l, 6, P)
            blocks[some] = weighted @ factors
            np.add.at(right, columns[some], -(weighted @ equations.difference[some]))
        rows, others = np.broadcast_arrays(columns[:, :, None], columns[:, None, :])
        normal = csc_array(
            (blocks.ravel(), (rows.ravel(), others.ravel())), shape=(count, count)
        ) + diags_array(prior)
        # gains per channel eliminated for the vignette of their mean, then put back with that vignette
        normal = normal.tocsc()
        mean = _solved(normal, right.mean(axis=1))
        lens = mean[frames:]
        known = (normal[:frames, frames:] @ lens)[:, None]
        gains = _solved(normal[:frames, :frames], right[:frames] - known)
        solution = np.vstack([gains, np.tile(lens[:, None], (1, 3))])
    return solution, typical * _SIGMA_FROM_MEDIAN


def _solved(normal: csc_array, right: Floats) -> Floats:
    """The solution of symmetric, positive definite equations."""
    factors = splu(
        normal, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}, diag_pivot_thresh=0.0
    )
    return np.asarray(factors.solve(right))


def _sample(image: ImageRGB, points_px: PointsPx) -> Floats:
    small = cv2.resize(image, None, fx=1 / _SHRINK, fy=1 / _SHRINK, interpolation=cv2.INTER_AREA)
    smooth = cv2.blur(small, (3, 3))
    at = ((np.asarray(points_px, dtype=np.float64) + 0.5) / _SHRINK - 0.5).astype(np.float32)
    # remap takes at most 32767 points in a row
    columns = 1024
    padded = np.zeros((-(-len(at) // columns) * columns, 2), np.float32)
    padded[: len(at)] = at
    grid = padded.reshape(-1, columns, 2)
    if not len(at):
        return np.zeros((0, 3))
    colours = cv2.remap(  # type: ignore[call-overload]
        smooth, grid, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(colours.reshape(-1, 3)[: len(at)], np.float64)


def _radius2(points_px: PointsPx, image: ImageRGB) -> Floats:
    height, width = image.shape[:2]
    centred = np.asarray(points_px, dtype=np.float64).reshape(-1, 2) - [
        (width - 1) / 2,
        (height - 1) / 2,
    ]
    return (centred**2).sum(axis=1) * 4 / (width**2 + height**2)

"""Where a camera's top points: by the pictures' way without a compass, and how wrong compasses and telemetry are."""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from sorvolo.geometry.arrays import Floats, Matrix3, PointsM, PointsPx
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.ground import ground_from_pixels
from sorvolo.geometry.homography import apply_homography
from sorvolo.geometry.pose import Pose, rotation_from_vector, site_from_gimbal_rotation
from sorvolo.registration.place_search import SmallView, second_from_first, small_view
from sorvolo.survey.flight import CameraPrior, Frame
from sorvolo.survey.objects import Detections, no_detections
from sorvolo.tracking.image_motion import ImageMotion

_WINDOW_S = 60.0  # of the way that is laid on the fixes; by choice
_SHORT_S = 20.0  # the same where tilts are unknown: they sway
_LEAST_M = 6.0  # of way, rms: less is within the fixes' own errors
_WANDER_M = 1.0  # of the fixes' error along a way: it turns the way, and fits all the same
_TILTED = 0.1  # sigma of where the axis meets the ground, in heights: 6 degrees; by choice
_LEAST_SIGMA_DEG = 4.0  # however well two photos fit
_STEPS_PER_ERROR = 8.0  # neighbouring fixes, and neighbouring frames' tilts, err alike


@dataclass(frozen=True)
class Way:
    """What the pictures' way beside the fixes shows of a camera that looks down; sigmas are infinite where that is not known.

    `heading_deg` is the picture's top's, clockwise from north. The middle of the picture lies by `beside_m` too far to
    the right (real) and the top (imaginary part) by telemetry. `scale` is the true height above the ground in
    telemetry's.
    """

    heading_deg: float = 0.0
    sigma_deg: float = float("inf")
    beside_m: complex = 0j
    beside_sigma_m: float = float("inf")
    scale: float = 1.0
    scale_sigma: float = float("inf")

    @property
    def sure_scale(self) -> float:
        """The scale, as far as it is sure."""
        return 1 + (self.scale - 1) * _sure(self.scale - 1, self.scale_sigma)


class HeadingFromMotion:
    """A downward camera's heading from its own pictures and the fixes; `add` and `lose` change it.

    `ImageMotion` lays each picture into the first one, which shows how the camera turned and moved since, all but the
    direction in which it began, its scale and what turns with the camera: least squares lay that way on the places by
    telemetry (complex numbers: real part right or east, imaginary part up or north). What turns with the camera shows
    only where it turns: until then its own sigma, `_TILTED`, keeps it from being taken for the fixes' shift.
    """

    def __init__(self, window_s: float = _WINDOW_S) -> None:
        self._window_s, self._turned_rad = window_s, 0.0  # clockwise since the first picture
        self._points: deque[tuple[float, complex, complex, complex, float]] = deque()

    def add(
        self,
        time_s: float,
        outline_px: PointsPx,
        place_m: Floats,
        height_m: float = 50.0,
        fx_px: float = 1000.0,
    ) -> Way:
        """Take in one picture and return what the way shows by now.

        `outline_px` (4, 2) are its corners, from the top-left one clockwise, in the first picture's pixels; `place_m`
        (2,) what its middle shows by telemetry, east and north; `fx_px` is the camera's, in the first picture's pixels.
        """
        right, down = outline_px[1] - outline_px[0]
        self._turned_rad = float(np.arctan2(down, right))
        x, y = outline_px.mean(axis=0)
        to_right = np.exp(-1j * self._turned_rad)
        told_m = complex(place_m[0], place_m[1])
        self._points.append((time_s, complex(x, -y) * height_m / fx_px, told_m, to_right, height_m))
        while time_s - self._points[0][0] > self._window_s:
            self._points.popleft()
        return self._known()

    def lose(self) -> None:
        """The pictures' way is broken (a cut, a frame that fits nothing): begin anew."""
        self._points.clear()

    def _known(self) -> Way:
        _, seen_m, told_m, to_right, height_m = np.array(self._points).T
        told_m = told_m - told_m.mean()
        rows = np.column_stack([np.ones_like(seen_m), seen_m - seen_m.mean(), to_right])
        if len(rows) < 5 or told_m.std() < _LEAST_M or seen_m.std() <= 0:
            return Way()
        normal = rows.conj().T @ rows / len(rows)
        normal[2, 2] += (_WANDER_M / (_TILTED * height_m.real.mean())) ** 2
        inverse = np.linalg.inv(normal)
        fit = inverse @ (rows.conj().T @ told_m) / len(rows)
        turn, reach_m = complex(fit[1]), float(abs(fit[1]) * seen_m.std())
        miss_m = float(np.std(told_m - rows @ fit))
        if reach_m <= 2 * miss_m:
            return Way()
        aside_m = np.hypot(miss_m / np.sqrt(max(1.0, len(rows) / _STEPS_PER_ERROR)), _WANDER_M)
        sigmas = aside_m * np.sqrt(np.diag(inverse).real)
        return Way(
            float(np.degrees(self._turned_rad - np.angle(turn))) % 360,
            float(np.degrees(np.arctan2(sigmas[1], abs(turn)))),
            complex(fit[2]) * turn.conjugate() / abs(turn),
            float(sigmas[2]),
            abs(turn),
            float(sigmas[1]),
        )


SeenPlace = tuple[int, int, complex, complex, float]
"""Of a picture: its segment; its time, ns; its middle in pixels of the segment's first picture, and by telemetry, m (real
part right, or east); the camera's height above it by telemetry, times how large the first picture shows it beside this."""
_WAY_NS = 30 * 10**9  # of a stretch in which the pictures' way is held against telemetry's
_JUDGED_M = 10.0  # of way, rms, by either of the two: less is within the fixes' errors
_LONGER = 1.4  # than the other a way may be, as where the ground falls; by choice
_ASTRAY = 0.35  # of a way, rms, that does not fit the other; by choice
_MISS_M = 1.5  # rms, by which ways must miss each other before a mirror image or another moment explains it
_TURN_M = 3.0  # rms, beside a way at one velocity; by choice
_MIRRORED = "its positions are a mirror image: latitude and longitude swapped, or a sign lost"
_APART = (
    "its positions do not follow the pictures: a receiver that stopped, a wrong clock, or a camera "
    "that looks elsewhere than stated"
)
_LATE = "its clock is off: about {} s more --offset fits the pictures"
_SHIFTS_S = np.arange(-20.0, 20.01, 0.25)
_COVERED = 0.6  # of a stretch's pictures that telemetry must place at a shift
_APART_S = 2.0  # between shifts that are named each where they fit alike
_LATE_S = 0.75  # receivers lag, and clocks of one second round, by less; by choice
_TILT = 0.21  # of the height, on the ground: 12 degrees
_HEIGHTS = (
    "its heights are not those above this ground (feet, a slope: give --ground-elevation or --height-model), or "
    "--camera or the zoom is another"
)


def contradiction(places: Sequence[SeenPlace], fx_px: float, *, knows_tilt: bool) -> str:
    """What in a flight's telemetry the pictures' way contradicts, in words; "" where nothing does.

    Without `knows_tilt` a camera that does not look straight down is a while ahead, or behind, all the way.
    """
    reasons, late_m = list[str](), list[list[float]]()
    every_s = np.array([time_ns / 1e9 for _, time_ns, *_ in places])
    every_m = np.array([told_m for *_, told_m, _ in places])
    for _, stretch in groupby(places, lambda each: (each[0], (each[1] - places[0][1]) // _WAY_NS)):
        _, time_ns, seen_px, told_m, height_m = np.array([*stretch]).T
        up_m, times_s = float(np.median(height_m.real)), time_ns.real / 1e9
        seen_m = seen_px * up_m / fx_px
        way_m, told_way_m = seen_m.std(), told_m.std()
        if len(told_m) < 5 or max(way_m, told_way_m) < _JUDGED_M:
            continue
        miss_m = _miss_m(seen_m, told_m)
        centred, both = told_m - told_m.mean(), np.column_stack([seen_m, seen_m.conj()])
        fit, *_ = np.linalg.lstsq(both - both.mean(axis=0), centred, rcond=None)
        left_m = (centred - both @ fit).std()
        misses_m = []
        for shift_s in _SHIFTS_S:
            at_s = times_s + shift_s
            inside = (at_s >= every_s[0]) & (at_s <= every_s[-1])
            then_m = np.interp(at_s[inside], every_s, every_m)
            is_covered = inside.mean() > _COVERED
            misses_m.append(_miss_m(seen_m[inside], then_m) if is_covered else np.inf)
        best_s = float(_SHIFTS_S[int(np.argmin(misses_m))])
        gone_m = abs(np.interp(times_s + best_s, times_s, told_m) - told_m).mean()
        is_late = abs(best_s) >= _LATE_S and gone_m > (0.0 if knows_tilt else _TILT) * up_m
        if is_late and miss_m > max(_MISS_M, 2 * min(misses_m)):
            late_m.append(misses_m)
        if abs(fit[1]) > 2 * abs(fit[0]) and miss_m > max(_MISS_M, 2 * left_m):
            reasons.append(_MIRRORED)
        elif late_m and late_m[-1] is misses_m:
            reasons.append(_LATE)
        elif miss_m >= _ASTRAY * told_way_m:
            reasons.append(_APART)
        else:
            is_alike = way_m < _LONGER * told_way_m < _LONGER**2 * way_m
            reasons.append("" if is_alike else _HEIGHTS)
    worst = max(filter(None, reasons), key=reasons.count, default="")
    if 4 * reasons.count(worst) <= len(reasons):
        return ""
    if worst not in (_MIRRORED, _LATE) or not late_m:
        return worst
    together_m = np.ma.masked_invalid(late_m).mean(axis=0).filled(np.inf)
    alike = np.flatnonzero(together_m <= 2 * max(together_m.min(), _MISS_M / 4))
    apart = np.split(alike, np.flatnonzero(np.diff(_SHIFTS_S[alike]) > _APART_S) + 1)
    fits_s = [float(_SHIFTS_S[each[np.argmin(together_m[each])]]) for each in apart]
    late = _LATE.format(" or ".join(f"{each:+.1f}" for each in sorted(fits_s, key=abs)))
    return late if worst == _LATE else f"{_MIRRORED}, or {late}"


def is_uniform(places: Sequence[SeenPlace], fx_px: float) -> bool:
    """Whether the pictures' way is long and at one velocity, so that it fits the telemetry of any moment."""
    uneven_m, along_m = [0.0], [0.0]
    for _, stretch in groupby(places, lambda each: each[0]):
        _, time_ns, seen_px, _, height_m = np.array([*stretch]).T
        way_m = (seen_px - seen_px.mean()) * np.median(height_m.real) / fx_px
        since_ns = time_ns.real - time_ns.real.mean()
        velocity_m_ns = since_ns @ way_m / max(since_ns @ since_ns, 1.0)
        uneven_m.append(float(np.std(way_m - since_ns * velocity_m_ns)))
        along_m.append(float(np.std(way_m)))
    return max(uneven_m) < _TURN_M and max(along_m) > _JUDGED_M


def _miss_m(seen_m: NDArray[np.complex128], told_m: NDArray[np.complex128]) -> float:
    """By how much, rms, places (N,) miss those that were seen, which are turned, scaled and shifted to fit them."""
    seen_m, told_m = seen_m - seen_m.mean(), told_m - told_m.mean()
    turn = np.vdot(seen_m, told_m) / (np.vdot(seen_m, seen_m).real + 1e-9)
    return float(np.std(told_m - turn * seen_m))


class HeadingFromPictures:
    """What the motion in a camera's pictures shows of it; where its heading is known the way begins anew with a picture
    that shows no motion that fits."""

    def __init__(self, fx_px: float, *, knows_heading: bool) -> None:
        self._motion, self._fx_px = ImageMotion(), fx_px
        self._heading = HeadingFromMotion(_WINDOW_S if knows_heading else _SHORT_S)
        self._segments, self._guessed, self._over_guesses = 1, 0, not knows_heading
        self.places: list[SeenPlace] = []

    def way(
        self, frame: Frame, time_ns: int, found: Detections, prior: CameraPrior, below_m: float
    ) -> Way:
        """What the way to a frame shows, which has to be given each."""
        _, outline_px = self._motion.locate(found, frame, time_ns)
        is_guess = self._motion.guessed != self._guessed and not self._over_guesses
        if self._motion.segments != self._segments or is_guess:
            self._heading.lose()
        self._segments, self._guessed = self._motion.segments, self._motion.guessed
        ahead, up_m = prior.rotation[:, 2], float(prior.position_m[2]) - below_m
        if not prior.knows_place or not (ahead[2] < -_LEAST_DOWN and up_m > 0):
            return Way()
        middle_m = prior.position_m[:2] - up_m / ahead[2] * ahead[:2]
        x, y = outline_px.mean(axis=0)
        shrunk = float(np.hypot(*(outline_px[1] - outline_px[0]))) / frame.image.shape[1]
        told_m = complex(middle_m[0], middle_m[1])
        self.places.append((self._segments, frame.time_ns, complex(x, -y), told_m, up_m / shrunk))
        return self._heading.add(time_ns / 1e9, outline_px, middle_m, up_m, self._fx_px * shrunk)


def righted(prior: CameraPrior, way: Way, below_m: float) -> CameraPrior:
    """The prior with its tilt and its height above the ground corrected by what is sure of what a way shows."""
    up_m = float(prior.position_m[2]) - below_m
    height_m = up_m * way.sure_scale
    tilt = way.beside_m * _sure(abs(way.beside_m), way.beside_sigma_m) / height_m
    tilted = rotation_from_vector(np.array([-tilt.imag, -tilt.real, 0.0]))
    return replace(
        prior,
        position_m=np.array([*prior.position_m[:2], below_m + height_m]),
        position_sigma_m=np.minimum(
            prior.position_sigma_m, [np.inf, np.inf, way.scale_sigma * height_m]
        ),
        rotation=prior.rotation @ tilted,
    )


def _sure(shown: float, sigma: float) -> float:
    """How much of an error that may have any size is sure, where it is shown with this sigma (James and Stein's positive
    part)."""
    return 1 - min(1.0, sigma / (abs(shown) + 1e-9)) ** 2


_LEAST_DOWN = 0.96  # of the optical axis: 16 degrees off straight down or less; the heading of others is not checked
_WRONG_DEG = 30.0  # less is within what tilts, winds and small compasses do; by choice
_WRONG_SIGMAS = 4.0  # and it must be beyond what both sides may err by; by choice


@dataclass(frozen=True)
class HeadingTurn:
    """By how much a heading has to turn clockwise, from -180 to 180 degrees, and how well that is known."""

    turn_deg: float
    sigma_deg: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "turn_deg", (self.turn_deg + 180) % 360 - 180)


def is_checked(prior: CameraPrior) -> bool:
    """Whether a camera's place and heading are known at all, and it looks about straight down."""
    is_known = (
        prior.knows_place
        and bool(np.isfinite(prior.attitude_sigma_deg[2]))
        and prior.position_m[2] > 0
    )
    return is_known and -float(prior.rotation[2, 2]) >= _LEAST_DOWN


def is_wrong(shown: HeadingTurn, prior: CameraPrior) -> bool:
    """Whether a heading is one that cannot be, where pictures show this turn."""
    both_deg = float(np.hypot(shown.sigma_deg, prior.attitude_sigma_deg[2]))
    return abs(shown.turn_deg) > max(_WRONG_DEG, _WRONG_SIGMAS * both_deg)


def heading_deg(prior: CameraPrior) -> float:
    """Where the picture's top points, clockwise from north."""
    return float(np.degrees(np.arctan2(-prior.rotation[0, 1], -prior.rotation[1, 1])))


def turned(prior: CameraPrior, turn: HeadingTurn) -> CameraPrior:
    """The prior turned about the vertical, its heading as well known as the turn."""
    rotation = (
        rotation_from_vector(np.array([0.0, 0.0, -np.radians(turn.turn_deg)])) @ prior.rotation
    )
    sigma_deg = np.array([*prior.attitude_sigma_deg[:2], turn.sigma_deg])
    return replace(prior, rotation=rotation, attitude_sigma_deg=sigma_deg)


_REMEMBERED_S = 20.0  # of what was shown; by choice


@dataclass
class CompassError:
    """By how much headings by telemetry have to turn clockwise: the mean of what pictures showed lately.

    Only what is sure of it is corrected (`_sure`). `turns_deg` are the turns of what was corrected.
    """

    turns_deg: list[float] = field(default_factory=list)
    _shown: complex = 0j  # sums of turns, inverse variances and weights
    _known: float = 0.0
    _weight: float = 0.0

    @property
    def sigma_deg(self) -> float:
        """How well it is known; infinite while nothing was shown."""
        return float(np.sqrt(self._weight / self._known)) if self._weight else float("inf")

    @property
    def turn(self) -> HeadingTurn:
        """The mean as it is."""
        return HeadingTurn(float(np.degrees(np.angle(self._shown))), self.sigma_deg)

    def add(self, shown: HeadingTurn, elapsed_s: float, *, anew: bool) -> None:
        """Take in what a picture shows, so long after the last one; `anew` forgets those before."""
        kept = 0.0 if anew else float(np.exp(-elapsed_s / _REMEMBERED_S))
        weight = max(elapsed_s, _LEAST_ELAPSED_S) / shown.sigma_deg**2
        self._shown = kept * self._shown + weight * np.exp(1j * np.radians(shown.turn_deg))
        self._known = kept * self._known + weight / shown.sigma_deg**2
        self._weight = kept * self._weight + weight

    def corrected(self, prior: CameraPrior) -> CameraPrior:
        """The prior, turned by what is sure."""
        turn = self.turn
        kept = _sure(turn.turn_deg, turn.sigma_deg)
        if kept == 0:
            return prior
        self.turns_deg.append(kept * turn.turn_deg)
        return turned(prior, HeadingTurn(kept * turn.turn_deg, turn.sigma_deg))


_LEAST_ELAPSED_S = 0.1  # the first one weighs as much; by choice
_TURNS_DEG_S = 20.0  # a drone that turns faster has its heading not checked; by choice
_CLOCK_OFF_NS = 1_000_000_000  # by which telemetry's clock may be off: so long after a turn headings are not checked
_AHEAD_NS = 60 * 10**9  # so far a recording is looked at before it begins; by choice
_SURE_DEG, _SURE_M = 1.7, 2.0  # what is shown so well needs no further look ahead; by choice
_FAR_OFF_DEG = 15.0  # what was placed before such a turn showed is doubted; by choice
_JUMP_DEG = 60.0  # from one frame to the next, against the pictures' own turning; by choice


class HeadingCheck:
    """A video's cameras corrected by the motion that their pictures show, where they look about straight down.

    While the drone turns nothing but a jump is judged: telemetry's clock may be off. `unturned` are the detections that
    were placed before the pictures showed, at `shown_ns`, a heading that is far off, by `shown_rad`. `shown` is the way by which heights and tilts are
    corrected, `tilt_deg` by how much the tilts
    were at most.
    """

    def __init__(self, fx_px: float, *, knows_heading: bool) -> None:
        self._fx_px, self._knows_heading = fx_px, knows_heading
        self.pictures = HeadingFromPictures(fx_px, knows_heading=knows_heading)
        self.error, self.shown = CompassError(), Way()
        self._last: tuple[int, float, float] | None = None  # time, heading, turn, as last shown
        self._steady_ns = 0  # the drone turns until then
        self._unjudged, self.unturned, self.tilt_deg = 0, 0, 0.0
        self.shown_ns, self.shown_rad = 0, 0.0

    def look_ahead(
        self, coming: Iterable[tuple[Frame, CameraPrior]], below_m: Callable[[CameraPrior], float]
    ) -> None:
        """Begin with the turn that the flight's first frames show together."""
        ahead, first_ns = HeadingCheck(self._fx_px, knows_heading=self._knows_heading), -1
        for frame, prior in coming:
            first_ns = frame.time_ns if first_ns < 0 else first_ns
            looks_aside = prior.knows_place and -float(prior.rotation[2, 2]) < _LEAST_DOWN
            if looks_aside or frame.time_ns - first_ns > _AHEAD_NS:
                break
            ahead.take(frame, frame.time_ns, no_detections(()), prior, below_m(prior))
            if ahead.error.sigma_deg < _SURE_DEG and ahead.shown.beside_sigma_m < _SURE_M:
                break
        self.error, self.shown = replace(ahead.error, turns_deg=[]), ahead.shown

    def take(
        self, frame: Frame, time_ns: int, found: Detections, prior: CameraPrior, below_m: float
    ) -> CameraPrior:
        """The prior with its heading, tilt and height corrected; `below_m` is the ground's height."""
        shown = self.pictures.way(frame, time_ns, found, prior, below_m)
        if not self._knows_heading:
            if not np.isfinite(shown.sigma_deg):
                return prior
            sigma_deg = np.array([*prior.attitude_sigma_deg[:2], shown.sigma_deg])
            rotation = site_from_gimbal_rotation(shown.heading_deg, -90.0, 0.0)
            return replace(prior, rotation=rotation, attitude_sigma_deg=sigma_deg)
        if not is_checked(prior):
            return prior
        if np.isfinite(shown.sigma_deg):
            self._judge(time_ns, shown, prior)
            if shown.beside_sigma_m < max(self.shown.beside_sigma_m, _SURE_M):
                self.shown = shown
        turn = self.error.turn
        if not np.isfinite(turn.sigma_deg):
            self._unjudged += len(found)
        elif not self.error.turns_deg and abs(turn.turn_deg) > max(_FAR_OFF_DEG, turn.sigma_deg):
            self.unturned = self._unjudged
            self.shown_ns, self.shown_rad = time_ns, np.radians(turn.turn_deg)
        turned_prior = self.error.corrected(prior)
        corrected = righted(turned_prior, self.shown, below_m)
        along = float(turned_prior.rotation[:, 2] @ corrected.rotation[:, 2])
        tilt_deg = float(np.degrees(np.arccos(min(along, 1.0))))
        self.tilt_deg = max(self.tilt_deg, tilt_deg)
        return corrected

    def _judge(self, time_ns: int, shown: Way, prior: CameraPrior) -> None:
        """Take in what a frame's way shows of the compass, where the frame allows it."""
        turn = HeadingTurn(shown.heading_deg - heading_deg(prior), shown.sigma_deg)
        now = (time_ns, shown.heading_deg, turn.turn_deg)
        (then_ns, *then_deg), self._last = self._last or now, now
        turned_deg, jump_deg = (
            abs(HeadingTurn(angle - then, 0.0).turn_deg) for angle, then in zip(now[1:], then_deg)
        )
        if turned_deg * 1e9 > _TURNS_DEG_S * (time_ns - then_ns):
            self._steady_ns = time_ns + _CLOCK_OFF_NS
        has_jumped = jump_deg > _JUMP_DEG  # no clock that is off does that
        if has_jumped or time_ns >= self._steady_ns:
            self.error.add(turn, (time_ns - then_ns) / 1e9, anew=has_jumped)


_MOST_SIGMA_DEG = 20.0  # a heading shown less well is not used; by choice
# a photo that shows nothing shares its predecessor's error if their headings are as alike
_ALIKE_DEG = 45.0


class PhotoHeadings:
    """The headings of photos, one after another, in order of time. `see` and `take` change it.

    The middle of the photo before lies on the ground where telemetry has it, almost straight below that camera,
    whatever its heading. Where the new photo shows that place, the direction to it from the new camera must be the
    same: the turn about the vertical by which it is not is the heading's error. (Angles of a gimbal that are wrong by
    half a turn, for a whole strip, occur in real flights.) The first photo is held against the one after it, which
    `see` is given before.
    """

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._last: tuple[int, SmallView, CameraPrior] | None = None
        self._right: CameraPrior | None = None  # the last one's
        self.error = CompassError()

    def see(self, frame: Frame, prior: CameraPrior) -> None:
        """Hold the next photo given to `take` against this one."""
        self._last = None
        if is_checked(prior):
            self._last, self._right = (frame.time_ns, small_view(frame.image), prior), prior

    def take(self, frame: Frame, prior: CameraPrior) -> CameraPrior:
        """A photo's prior, its heading corrected by what its picture and those before show."""
        last, right = self._last, self._right
        self.see(frame, prior)
        if last is None or right is None or self._last is None:
            return prior
        (then_ns, before, other), view = last, self._last[1]
        here_from_before = second_from_first(before, view)
        shown = None
        if here_from_before is not None:
            shown = self._shown(prior, right, before.size_px, here_from_before)
        if shown is not None:
            beside = HeadingTurn(shown.turn_deg - self.error.turn.turn_deg, shown.sigma_deg)
            elapsed_s = abs(frame.time_ns - then_ns) / 1e9
            self.error.add(shown, elapsed_s, anew=is_wrong(beside, prior))
        elif abs(HeadingTurn(heading_deg(prior) - heading_deg(other), 0).turn_deg) > _ALIKE_DEG:
            return prior
        self._right = self.error.corrected(prior)
        return self._right

    def _shown(
        self,
        prior: CameraPrior,
        other: CameraPrior,
        other_size_px: tuple[int, int],
        here_from_other: Matrix3,
    ) -> HeadingTurn | None:
        """What the middle of another photo shows of a photo's heading; None where that is known too badly."""
        middle_px = (np.array([other_size_px[::-1]], np.float64) - 1) / 2
        seen_m = (
            self._on_ground(apply_homography(here_from_other, middle_px), prior)
            - prior.position_m[:2]
        )
        true_m = self._on_ground(middle_px, other) - prior.position_m[:2]
        reach_m = min(float(np.linalg.norm(seen_m)), float(np.linalg.norm(true_m)))
        if not reach_m > 0:  # at the horizon there is none
            return None
        tilt_deg = max(each.attitude_sigma_deg[:2].max() for each in (prior, other))
        fix_m = max(each.position_sigma_m[:2].max() for each in (prior, other))
        miss_m = np.sqrt(2) * np.hypot(
            fix_m, prior.position_m[2] * np.radians(tilt_deg)
        )  # of both photos
        sigma_deg = float(np.hypot(np.degrees(miss_m / reach_m), _LEAST_SIGMA_DEG))
        turn_deg = _bearing_deg(true_m) - _bearing_deg(seen_m)
        return HeadingTurn(turn_deg, sigma_deg) if sigma_deg <= _MOST_SIGMA_DEG else None

    def _on_ground(self, pixels: PointsPx, prior: CameraPrior) -> PointsM:
        """(2,) where a pixel, (1, 2), lies on the level ground."""
        return ground_from_pixels(self._camera, Pose(prior.rotation, prior.position_m), pixels)[0]


def _bearing_deg(east_north_m: PointsM) -> float:
    """Clockwise from north, of (2,)."""
    return float(np.degrees(np.arctan2(east_north_m[0], east_north_m[1])))

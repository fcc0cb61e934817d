"""`--method planar`: frames to keyframes, keyframes to links, links to the pose graph, one frame at a time."""

import io
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice

import numpy as np

from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import Floats, ImageRGB, Matrix3, PointsM, shrunk, size_within
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.homography import apply_homography, site_from_image_homography
from sorvolo.geometry.pose import Pose
from sorvolo.mosaic.exposure import (
    POINTS_PER_LINK,
    ColourPairs,
    Exposure,
    solve_exposure,
    tie_colours,
)
from sorvolo.mosaic.graph_report import GraphReport
from sorvolo.mosaic.graph_settings import PoseGraphSettings
from sorvolo.mosaic.ground_ties import GroundTies
from sorvolo.mosaic.overview import Overview, lay_out
from sorvolo.mosaic.pose_graph import PoseGraph, pose_from_link
from sorvolo.mosaic.shelf import Shelf, ShelvedRows
from sorvolo.registration.features import (
    gray_from_rgb,
    normalise_contrast,
    orb_features,
    release_network,
)
from sorvolo.registration.link import Effort, LinkCache, LinkPrediction, LinkSettings, link
from sorvolo.survey.flight import CameraPrior
from sorvolo.survey.mosaic import Features, Keyframe, Link, NoLink, Status


class LinkedColours(Mapping[tuple[int, int], ColourPairs]):
    """Colour pairs by link (frame a, frame b), `points_per_link` at most; `keep` adds those of a link."""

    def __init__(self, points_per_link: int, shelf: Shelf | None = None) -> None:
        self._most = points_per_link
        self._places: dict[tuple[int, int], tuple[int, int]] = {}  # row, and pairs in it
        self._rows = ShelvedRows("colours", (points_per_link, 8), np.float16, shelf)

    def __len__(self) -> int:
        return len(self._places)

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return iter(self._places)

    def __getitem__(self, link: tuple[int, int]) -> ColourPairs:
        row, count = self._places[link]
        found = self._rows.read(np.array([row]))[0, :count]
        return ColourPairs(found[:, :3], found[:, 3:6], found[:, 6], found[:, 7])

    def keep(self, link: tuple[int, int], pairs: ColourPairs) -> None:
        """Take the pairs of a link in, in place of earlier ones of it."""
        kept = pairs.thinned(self._most)
        row = np.zeros((self._most, 8), np.float16)
        row[: len(kept)] = np.column_stack(
            [kept.colours_a, kept.colours_b, kept.radius2_a, kept.radius2_b]
        )
        self._places[link] = len(self._rows), len(kept)
        self._rows.append(row)

    def newest(self, count: int) -> dict[tuple[int, int], ColourPairs]:
        """Those of the newest links."""
        return {link: self[link] for link in islice(reversed(self._places), count)}


@dataclass(frozen=True, eq=False)
class _Rest:
    """What is always in memory of a keyframe."""

    camera: Camera
    prior: CameraPrior
    kind: str


class Keyframes:
    """Keyframes and their thumbnails by id, at most `most_bytes` of them in memory where there is a shelf.

    What comes back from the shelf equals what was put there, bit by bit.
    """

    def __init__(self, shelf: Shelf | None = None, most_bytes: int = 1 << 28) -> None:
        self._shelf, self._most_bytes = shelf, most_bytes
        self._rest: dict[int, _Rest] = {}
        self._near: OrderedDict[int, tuple[Keyframe, ImageRGB]] = OrderedDict()
        self._shelved: set[int] = set()
        self._bytes = 0

    def __contains__(self, keyframe_id: int) -> bool:
        return keyframe_id in self._rest

    def add(self, keyframe: Keyframe, thumbnail: ImageRGB) -> None:
        """Keep a keyframe, with a small copy of its picture in colour."""
        self._rest[keyframe.id] = _Rest(keyframe.camera, keyframe.prior, keyframe.features.kind)
        self._take(keyframe, thumbnail)

    def camera(self, keyframe_id: int) -> Camera:
        """The camera of the keyframe's picture, as large as it is registered."""
        return self._rest[keyframe_id].camera

    def keyframe(self, keyframe_id: int) -> Keyframe:
        """The keyframe, from the shelf if it has to be."""
        return self._both(keyframe_id)[0]

    def thumbnail(self, keyframe_id: int) -> ImageRGB:
        """The small copy of the keyframe's picture, from the shelf if it has to be."""
        return self._both(keyframe_id)[1]

    def release(self) -> None:
        """Put all on the shelf: nothing is wanted of them for a while. Without a shelf they stay."""
        while self._shelf is not None and self._near:
            self._shelve_oldest(self._shelf)

    # ---- inside -----------------------------------------------------------------------------------------------

    def _both(self, keyframe_id: int) -> tuple[Keyframe, ImageRGB]:
        found = self._near.get(keyframe_id)
        if found is None:
            assert self._shelf is not None
            rest = self._rest[keyframe_id]
            with np.load(io.BytesIO(self._shelf.get(keyframe_id)), allow_pickle=False) as kept:
                features = Features(rest.kind, kept["points_px"], kept["descriptors"])
                found = (
                    Keyframe(keyframe_id, rest.camera, kept["gray"], features, rest.prior),
                    kept["thumbnail"],
                )
            self._take(*found)
        self._near.move_to_end(keyframe_id)
        return found

    def _take(self, keyframe: Keyframe, thumbnail: ImageRGB) -> None:
        """Into memory; those used longest ago make room."""
        self._near[keyframe.id] = keyframe, thumbnail
        self._bytes += _size(keyframe, thumbnail)
        while self._shelf is not None and self._bytes > self._most_bytes and len(self._near) > 1:
            self._shelve_oldest(self._shelf)

    def _shelve_oldest(self, shelf: Shelf) -> None:
        keyframe_id, (oldest, small) = self._near.popitem(last=False)
        self._bytes -= _size(oldest, small)
        if keyframe_id not in self._shelved:
            shelf.put(keyframe_id, _bytes(oldest, small))
            self._shelved.add(keyframe_id)


def _size(keyframe: Keyframe, thumbnail: ImageRGB) -> int:
    features = keyframe.features
    return (
        keyframe.gray.nbytes
        + features.points_px.nbytes
        + features.descriptors.nbytes
        + thumbnail.nbytes
    )


def _bytes(keyframe: Keyframe, thumbnail: ImageRGB) -> bytes:
    data = io.BytesIO()
    np.savez(
        data,
        gray=keyframe.gray,
        points_px=keyframe.features.points_px,
        descriptors=keyframe.features.descriptors,
        thumbnail=thumbnail,
    )
    return data.getvalue()


_REGISTRATION_SIDE_PX = 1024  # longest side of the image that is registered
_PREVIOUS = 2  # keyframes before, always tried
_SPATIAL = 2  # further ones under the predicted view: they close loops between strips
_WANTED_LINKS = 4  # with fewer, pictures that refused are asked again with SIFT
_LEAST_OVERLAP = 0.2  # of a view, for a spatial neighbour
_RECOVERY = 30  # keyframes tried for a frame that is lost and has no GPS
# Pictures that show no plane, such as an orbit's, would be asked the dear way over and over. By choice:
_DEAR_TRIALS = 40  # dear fits of a flight after which it is known whether they are worth it
_DEAR_WORTH = 0.1  # share of them that link, below which they are not
_DEAR_BOUND = 2  # so many of them a frame are enough then


_RECENT_LINKS = 400  # of which colours are compared while the flight goes on
_LINKS = LinkSettings()


@dataclass(frozen=True, eq=False)
class KnownKeyframe:
    """A keyframe of the map that exists already; `image` loads its undistorted picture, of `camera`'s size.

    `sigma_m` is its own error on the ground: what is tied to it errs at least as much.
    """

    id: int
    camera: Camera
    site_from_camera: Pose
    sigma_m: float
    image: Callable[[], ImageRGB]


@dataclass(frozen=True, eq=False)
class Outcome:
    """How one keyframe ended for now, and which keyframes moved on the ground since they were last named."""

    status: Status
    reason: str
    moved: frozenset[int]


@dataclass(frozen=True, eq=False)
class Registered:
    """A keyframe and what ties it to the others, before it is one of them: all that placing it needs.

    `guess` is where it stands by that, None nowhere; `reason` is what failed. `met` are the keyframes of the known map
    that were tried, in the order in which they were first met. `dear` are how many fits were tried the dear way, and
    how many of these linked.
    """

    keyframe: Keyframe
    thumbnail: ImageRGB
    links: tuple[Link, ...]
    guess: Pose | None
    reason: str
    met: tuple[int, ...]
    dear: tuple[int, int]


@dataclass(frozen=True, eq=False)
class _Refusal:
    reason: str
    prediction: LinkPrediction | None


@dataclass(eq=False)
class _Tie:
    """A new keyframe while its links are sought: where it stands by what is known so far, and who refused it."""

    new: Keyframe
    guess: Pose | None
    links: list[Link] = field(default_factory=list)
    refusals: dict[int, _Refusal] = field(default_factory=dict)
    dear: tuple[int, int] = (0, 0)  # asked the dear way, and linked by that


class PlanarMapper:
    """Everything `--method planar` knows of one flight. `add` takes a keyframe; `retime` and `settle` end it.

    What is not needed of an older keyframe goes to the `shelf`, where there is one.
    """

    def __init__(
        self,
        graph: PoseGraphSettings,
        known: Sequence[KnownKeyframe] = (),
        shelf: Shelf | None = None,
        keyframe_bytes: int = 1 << 28,
    ) -> None:
        self._graph = PoseGraph(graph, shelf)
        self._ground_miss_m = 0.0  # per axis: see `note_ground_miss`
        self._clock_miss_m = 0.0  # per axis: see `note_clock_miss`
        self._cache = LinkCache(_LINKS.features)
        self._keyframes = Keyframes(shelf, keyframe_bytes)
        self._own: list[int] = []
        self._known = {each.id: each for each in known}
        self._known_centres_m = np.array(
            [each.site_from_camera.translation_m for each in known]
        ).reshape(-1, 3)
        self._colours = LinkedColours(POINTS_PER_LINK, shelf)
        self._failures: dict[int, str] = {}
        self._dear = 0, 0  # fits of the flight that were asked the dear way, and those that linked
        self._met: list[int] = []  # of the known map, in the order in which they were loaded

    def add(self, keyframe_id: int, camera: Camera, image: ImageRGB, prior: CameraPrior) -> Outcome:
        """Place an undistorted picture, (H, W, 3), of the distortion-free `camera` (at the picture's size)."""
        return self.place(self.register(keyframe_id, camera, image, prior))

    def release(self) -> None:
        """Put what links need out of memory: no frame comes for a while."""
        self._keyframes.release()
        release_network()

    def register(
        self, keyframe_id: int, camera: Camera, image: ImageRGB, prior: CameraPrior
    ) -> Registered:
        """Tie an undistorted picture to the map as it is; `place` is what adds it."""
        keyframe = self._keyframe(keyframe_id, camera, image, prior)
        before = len(self._met)
        tie, reason = self._tie(keyframe)
        return Registered(
            keyframe,
            _thumbnail(image),
            tuple(tie.links),
            tie.guess,
            reason,
            tuple(self._met[before:]),
            tie.dear,
        )

    def place(self, new: Registered) -> Outcome:
        """Add a registered picture to the map."""
        for known in new.met:
            self._picture(known)
        self._dear = self._dear[0] + new.dear[0], self._dear[1] + new.dear[1]
        keyframe = new.keyframe
        if new.guess is None:
            self._failures[keyframe.id] = new.reason
            return Outcome(Status.REJECTED, new.reason, frozenset())
        self._keyframes.add(keyframe, new.thumbnail)
        moved = self._graph.add(keyframe.id, keyframe.camera, keyframe.prior, new.links, new.guess)
        self._own.append(keyframe.id)
        for each in new.links:
            self._tie_colours(each)
        status = Status.VISION if new.links or len(self._own) == 1 else Status.GPS_ONLY
        self._failures[keyframe.id] = "" if new.links else new.reason
        return Outcome(status, new.reason if status is Status.GPS_ONLY else "", moved)

    def settle(self) -> frozenset[int]:
        """Solve the whole flight once more; the keyframes that moved."""
        return self._graph.conclude()

    def retime(self, priors: Mapping[int, CameraPrior]) -> frozenset[int]:
        """Take the telemetry of another clock offset; the keyframes that moved."""
        return self._graph.retime(
            {each: prior for each, prior in priors.items() if each in self._graph}
        )

    def tie_to_ground(self, ties: GroundTies, *, is_datum: bool) -> frozenset[int]:
        """See `PoseGraph.tie_to_ground`; the keyframes that moved."""
        return self._graph.tie_to_ground(ties, is_datum=is_datum)

    def note_ground_miss(self, miss_m: float) -> None:
        """Known ground lies so far beside the tied map, rms per axis, beyond what is expected: a part of `sigmas_m`."""
        self._ground_miss_m = miss_m

    def note_clock_miss(self, miss_m: float) -> None:
        """What is not known of telemetry's clock moves all of a map that fixes place so far, 1 sigma per axis."""
        self._clock_miss_m = miss_m

    def ground_places_m(self, ties: GroundTies) -> PointsM:
        """See `PoseGraph.ground_places_m`."""
        return self._graph.ground_places_m(ties)

    def overview(self, side_px: int) -> Overview | None:
        """All of the flight in one small picture; None before any frame lies on the ground."""
        frames = []
        for each in self._own:
            small, camera = self._keyframes.thumbnail(each), self._graph.camera(each)
            resized = camera.resized(small.shape[1], small.shape[0])
            frames.append((small, site_from_image_homography(resized, self._graph.pose(each))))
        return lay_out(frames, side_px)

    def refined(self, camera: Camera) -> Camera:
        """A camera of this flight with the focal length found so far."""
        return self._graph.refined(camera)

    def m_per_px(self, full: Camera) -> float:
        """What a pixel of the flight's pictures, of `full`'s size, usually covers on the ground."""
        return float(
            np.median(self._graph.centres_m(self._own)[:, 2]) / self._graph.refined(full).fx_px
        )

    def median_move_m(self, before_m: PointsM) -> float:
        """How far cameras are from where `path_m` had them, median; NaN without any."""
        away_m = np.linalg.norm((self.path_m() - before_m)[:, :2], axis=1)
        return float(np.nanmedian(away_m)) if np.isfinite(away_m).any() else float("nan")

    def registration_scale(self, keyframe_id: int, full: Camera) -> float:
        """Pixels at which a keyframe was registered in one of its full size."""
        return self._keyframes.camera(keyframe_id).width_px / full.width_px

    def pose(self, keyframe_id: int) -> Pose:
        """site_from_camera as it stands."""
        return self._graph.pose(keyframe_id)

    def placed(self) -> list[int]:
        """The flight's keyframes that have a place."""
        return list(self._own)

    def ending(self, keyframe_id: int) -> tuple[Status, str]:
        """How the keyframe ends, in words if not by vision."""
        if keyframe_id not in self._graph:
            return Status.REJECTED, self._failures.get(keyframe_id, "never placed")
        if self._graph.neighbours(keyframe_id) or len(self._own) == 1:
            return Status.VISION, ""
        reason = self._failures.get(keyframe_id) or "its links contradicted the rest of the map"
        return Status.GPS_ONLY, f"no other picture fits it: {reason}"

    @property
    def focal_scale(self) -> float:
        """Focal length found over the one given."""
        return self._graph.focal_scale

    @property
    def altitude_offset_m(self) -> float:
        """See `PoseGraph.altitude_offset_m`."""
        return self._graph.altitude_offset_m

    @property
    def radial(self) -> float:
        """Left-over radial distortion (see `PoseGraph.radial`)."""
        return self._graph.radial

    def report(self) -> GraphReport:
        """What the flight taught about itself."""
        return self._graph.report()

    def pieces(self) -> list[list[int]]:
        """See `PoseGraph.pieces`."""
        return self._graph.pieces()

    def residuals_px(self, full: Camera) -> dict[int, float]:
        """Median transfer residual of each keyframe, px of the full frame's size."""
        return {
            each: value * full.width_px / self._keyframes.camera(each).width_px
            for each, value in self._graph.residuals_px().items()
            if each in self._keyframes
        }

    def sigmas_m(self, *, leans: bool = True) -> dict[int, float]:
        """One-sigma error on the ground of each keyframe, per axis: its own and what all of the flight err in common.

        What a flight errs in common is its receiver's, or that of the known map it is tied to. Over ground that is not
        level what its slopes may move a flat map by is added (`leans`), and by what known ground was seen to miss it.
        """
        tied_to = [self._known[each].sigma_m for each in self._known if each in self._graph]
        common_m = (
            float(np.nanmedian(tied_to))
            if np.isfinite(tied_to).any()
            else float(np.hypot(self._graph.common_sigma_m(), self._clock_miss_m))
        )
        leans_m = self._graph.leans_m() if leans else {}
        return {
            each: float(
                np.sqrt(
                    sigma_m**2 + common_m**2 + leans_m.get(each, 0.0) ** 2 + self._ground_miss_m**2
                )
            )
            for each, sigma_m in self._graph.sigmas_m().items()
        }

    def gps_residuals_m(self) -> dict[int, Floats]:
        """Camera position minus fix, (3,)."""
        return self._graph.gps_residuals_m()

    def path_m(self) -> PointsM:
        """(N, 3) positions of the keyframes placed by vision, in the order of `placed()`; NaN for the others."""
        centres = self._graph.centres_m(self._own)
        tied = np.array([bool(self._graph.neighbours(each)) for each in self._own], bool)
        centres[~tied] = np.nan
        return centres

    def site_from_image(self, keyframe_id: int, camera: Camera) -> Matrix3:
        """(3, 3) of an undistorted image of the size that `camera` has: the stored one's or the frame's own."""
        refined = camera.with_focal_px(camera.fx_px * self.focal_scale)
        return site_from_image_homography(refined, self.pose(keyframe_id))

    def exposure(self) -> Exposure:
        """Gains and vignette from the colours that linked keyframes share."""
        return solve_exposure(self._colours)

    def recent_exposure(self) -> Exposure:
        """The same from the newest links alone: good enough for a map that still moves, at a price that does not grow
        with the flight."""
        newest = self._colours.newest(_RECENT_LINKS)
        return solve_exposure(newest)

    # ---- inside -----------------------------------------------------------------------------------------------

    def _keyframe(
        self, keyframe_id: int, camera: Camera, image: ImageRGB, prior: CameraPrior
    ) -> Keyframe:
        size = size_within(image, _REGISTRATION_SIDE_PX)
        gray = normalise_contrast(shrunk(gray_from_rgb(image), size))
        if gray.shape != image.shape[:2]:
            camera = camera.resized(*size)
        return Keyframe(keyframe_id, camera, gray, orb_features(gray, _LINKS.features), prior)

    def _tie(self, new: Keyframe) -> tuple[_Tie, str]:
        """The links of a new keyframe, where it stands by them or by telemetry, and what failed.

        All candidates are tried the cheap way first. Only where few of them link are those that refused tried
        with SIFT and learned features, until enough link: few links let tall trees bend a strip.
        """
        previous = self._own[::-1][:_PREVIOUS]
        tie = _Tie(new, self._guess_by_telemetry(new))
        if previous:
            # where telemetry alone puts it, if it knows enough to be a help
            loose = None
            if tie.guess is not None and np.isfinite(new.prior.attitude_sigma_deg[2]):
                loose = self._prediction(new, previous[0], tie.guess, tight=False)
            self._ask(tie, previous[0], loose, Effort.CHEAP)
        self._ask_under(tie, previous)
        if len(tie.links) < _WANTED_LINKS:
            self._ask_dearly(tie)
            self._ask_under(tie, previous)
        if not tie.links and not new.prior.knows_place:
            # Ask the last pictures and some of all the flight until one links: nobody knows where
            # the new one is.
            for each in [*self._own[::-1][1:10], *self._own[:: max(1, len(self._own) // 20)]]:
                if (
                    each not in tie.refusals
                    and len(tie.refusals) < _RECOVERY
                    and not tie.links
                    and self._is_worth(tie)
                ):
                    self._ask(tie, each, None, Effort.ALL)
        if not self._own and tie.guess is None:
            tie.guess = Pose(new.prior.rotation, new.prior.position_m)
        # why the picture that refused first did
        first = next(iter(tie.refusals.values()), None)
        reason = first.reason if first else "nothing of the map lies under it"
        if not tie.links and self._own and not new.prior.knows_place:
            tie.guess = None
            reason = f"no picture of the map fits it ({reason}) and telemetry reports no position"
        return tie, reason

    def _ask(
        self, tie: _Tie, other: int, prediction: LinkPrediction | None, effort: Effort
    ) -> None:
        """Try to link one picture; the first link places the new keyframe."""
        found = link(tie.new, self._picture(other), prediction, _LINKS, self._cache, effort)
        if effort is not Effort.CHEAP:
            tie.dear = tie.dear[0] + 1, tie.dear[1] + isinstance(found, Link)
        if isinstance(found, NoLink):
            tie.refusals[other] = _Refusal(found.reason, prediction)
            return
        tie.refusals.pop(other, None)
        tie.links.append(found)
        if len(tie.links) == 1:
            old = self._graph.camera(found.old_id)
            tie.guess = (
                pose_from_link(
                    found, self._graph.refined(tie.new.camera), old, self._graph.pose(found.old_id)
                )
            ) or tie.guess

    def _ask_under(self, tie: _Tie, previous: Sequence[int]) -> None:
        """Ask the pictures under the predicted view the cheap way; again those that refused a vague prediction."""
        if tie.guess is None:
            return
        asked = {each.old_id for each in tie.links}
        asked |= {
            other
            for other, no in tie.refusals.items()
            if not tie.links or (no.prediction is not None and no.prediction.is_tight)
        }
        for each in self._under(tie.new, tie.guess, asked, previous, bool(tie.links)):
            self._ask(
                tie,
                each,
                self._prediction(tie.new, each, tie.guess, tight=bool(tie.links)),
                Effort.CHEAP,
            )

    def _ask_dearly(self, tie: _Tie) -> None:
        for other, refusal in list(tie.refusals.items()):
            if not self._is_worth(tie):
                return
            self._ask(tie, other, refusal.prediction, Effort.DEAR)
            if not tie.links and other in tie.refusals and refusal.prediction is not None:
                # telemetry may be plainly wrong (pictures turned by half a turn, a compass that hangs): ask them alone
                self._ask(tie, other, None, Effort.ALL)
            if len(tie.links) >= _WANTED_LINKS:
                return

    def _is_worth(self, tie: _Tie) -> bool:
        """Whether one more dear fit is: always, unless hardly any of the flight's linked so far and this frame had its
        share of them."""
        tried, linked = self._dear
        seldom = tried >= _DEAR_TRIALS and linked < _DEAR_WORTH * tried
        return not seldom or tie.dear[0] < _DEAR_BOUND

    def _guess_by_telemetry(self, new: Keyframe) -> Pose | None:
        prior = new.prior
        if not prior.knows_place:
            return None
        rotation, up_m = prior.rotation, float(prior.position_m[2])
        if self._own:
            recent = self._graph.pose(self._own[-1])
            if not np.isfinite(prior.position_sigma_m[2]) or up_m < 0.3 * recent.translation_m[2]:
                up_m = float(recent.translation_m[2])
            if not np.isfinite(prior.attitude_sigma_deg[2]):
                rotation = recent.rotation
        return Pose(rotation, np.array([*prior.position_m[:2], max(up_m, 0.5)]))

    def _prediction(
        self, new: Keyframe, old: int, guess: Pose, *, tight: bool
    ) -> LinkPrediction | None:
        """Where the old keyframe falls in the new one, off by the errors of telemetry, or of the graph if `tight`."""
        try:
            site_from_new = site_from_image_homography(new.camera, guess)
            new_from_old = np.linalg.inv(site_from_new) @ self._site_from_image(old)
        except GeometryError:
            return None
        side = max(new.camera.width_px, new.camera.height_px)
        if tight:
            search = 0.05 * side
        else:
            tilt = np.radians(np.nan_to_num(new.prior.attitude_sigma_deg[:2].max(), posinf=15.0))
            place = new.prior.position_sigma_m[:2].max() / max(guess.translation_m[2], 0.5)
            search = float(
                np.clip(2.5 * new.camera.fx_px * (tilt + place), 0.08 * side, 0.5 * side)
            )
        return LinkPrediction(new_from_old, search, is_tight=tight)

    def _under(
        self, new: Keyframe, guess: Pose, tried: set[int], previous: Sequence[int], linked: bool
    ) -> list[int]:
        """The keyframes to try: those before, and the ones of other strips that lie most under the view."""
        ids = [*self._own, *self._known]
        overlap = self._overlaps(new, guess)
        count = len(self._own)  # the keyframes before are the last of the flight's own
        chosen = [
            each
            for k, each in enumerate(previous, 1)
            if each not in tried and overlap[count - k] > 0.1
        ]
        under = np.flatnonzero(overlap > _LEAST_OVERLAP)
        limit = len(chosen) + _SPATIAL + (0 if linked else 3)
        near = {*tried, *previous}
        for k in under[np.argsort(-overlap[under], kind="stable")].tolist():
            each = ids[k]
            if len(chosen) >= limit:
                break
            if each not in near:
                chosen.append(each)
                near |= {each - 1, each, each + 1}  # neighbours along a strip show the same again
        return chosen

    def _overlaps(self, new: Keyframe, guess: Pose) -> Floats:
        """(N,) the share of the new view that each keyframe shows, the flight's own first, then the known map's.

        All are taken for as large as the new view; 0 where the guess does not see the ground.
        """
        centres = np.concatenate([self._graph.centres_m(self._own), self._known_centres_m])
        axes = np.concatenate(
            [
                self._graph.axes(self._own),
                np.array(
                    [each.site_from_camera.rotation[:, 2] for each in self._known.values()]
                ).reshape(-1, 3),
            ]
        )
        centres = centres - axes * (centres[:, 2] / np.minimum(axes[:, 2], -0.1))[:, None]
        try:
            image_from_site = np.linalg.inv(site_from_image_homography(new.camera, guess))
        except GeometryError:
            return np.zeros(len(centres))
        seen = apply_homography(image_from_site, centres[:, :2])
        offset = np.abs(seen - [new.camera.cx_px, new.camera.cy_px]) / [
            new.camera.width_px,
            new.camera.height_px,
        ]
        with np.errstate(invalid="ignore"):
            return np.nan_to_num(np.clip(1 - offset, 0, 1).prod(axis=1))

    def _site_from_image(self, other: int) -> Matrix3:
        if other in self._graph:
            return site_from_image_homography(self._graph.camera(other), self._graph.pose(other))
        known = self._known[other]
        return site_from_image_homography(self._picture(other).camera, known.site_from_camera)

    def _picture(self, other: int) -> Keyframe:
        """A keyframe ready to be linked; one of the known map is loaded when it is first met."""
        if other not in self._keyframes:
            known = self._known[other]
            unknown = CameraPrior(
                known.site_from_camera.translation_m,
                np.full(3, np.inf),
                known.site_from_camera.rotation,
                np.full(3, np.inf),
            )
            image = known.image()
            self._keyframes.add(
                self._keyframe(other, known.camera, image, unknown), _thumbnail(image)
            )
            self._graph.add_known(other, self._keyframes.camera(other), known.site_from_camera)
            self._met.append(other)
        return self._keyframes.keyframe(other)

    def _tie_colours(self, each: Link) -> None:
        small_new = self._keyframes.thumbnail(each.new_id)
        small_old = self._keyframes.thumbnail(each.old_id)
        new, old = self._keyframes.camera(each.new_id), self._keyframes.camera(each.old_id)
        pairs = tie_colours(
            small_new,
            _scaled(each.new_px, new, small_new),
            small_old,
            _scaled(each.old_px, old, small_old),
        )
        self._colours.keep((each.new_id, each.old_id), pairs)


def _thumbnail(image: ImageRGB) -> ImageRGB:
    return shrunk(image, size_within(image, 320, 8))


def _scaled(points_px: Floats, camera: Camera, small: ImageRGB) -> Floats:
    scale = np.array([small.shape[1] / camera.width_px, small.shape[0] / camera.height_px])
    return (points_px + 0.5) * scale - 0.5

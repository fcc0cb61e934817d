"""The detector: any picture in, people, cars and small objects out."""

import math
import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sorvolo.detection.contract import ModelInfo
from sorvolo.detection.engine import Provider
from sorvolo.detection.fusing import (
    SeenTile,
    agreed_in_sizes,
    calibrated,
    merge_tiles,
)
from sorvolo.detection.layouts import AUTO
from sorvolo.detection.light import Picture, is_thermal, rgb_from_picture
from sorvolo.detection.models import demand_searching, find_model, thermal_model
from sorvolo.detection.second_look import rescore
from sorvolo.detection.session import Seen, Session, adopted
from sorvolo.detection.tiling import (
    COARSEST_M,
    Tiles,
    closer_for,
    is_too_small,
    looks_for,
    plan_tiles,
    sizes_for,
)
from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import ImageRGB, Labels
from sorvolo.paths import AnyPath
from sorvolo.survey.flight import Notice
from sorvolo.survey.objects import Detections, Early, no_detections


@dataclass(frozen=True, eq=False)
class _SizedLook:
    """What was seen in a picture, in its own pixels, shown `scale` times as large, and the classes looked for."""

    seen: Seen
    scale: float
    names: tuple[str, ...]


@dataclass(frozen=True)
class _Search:
    """How one picture is searched, and by which model; `names` are the classes looked for."""

    session: Session
    names: tuple[str, ...]
    tiles: Tiles
    m_per_px: float  # NaN: not known
    is_thermal: bool
    overlapping: bool

    def groups(self) -> Sequence[tuple[str, ...]]:
        """The classes by the look that finds them, that of large ones last."""
        if self.tiles != "auto":
            return (self.names,)
        return looks_for(self.session.info, self.m_per_px, self.names, self.is_thermal)

    def see(
        self, picture: ImageRGB, early: Callable[[tuple[str, ...], Seen], None] | None = None
    ) -> Seen:
        """What all looks at a picture (H, W, 3) see; `early` is given those that have classes of their own, first."""
        groups = self.groups()
        looks: dict[tuple[str, ...], Seen] = {}
        for names in reversed(groups):  # the smaller look first: it is known soon
            looks[names] = self._in_sizes(picture, names)
            if early is not None and names != groups[0]:
                early(names, looks[names])
        return _together([looks[names] for names in groups], groups, self.session.info.classes)

    def _in_sizes(self, picture: ImageRGB, names: Sequence[str]) -> Seen:
        """What the looks of all sizes at a picture see together, best first."""
        info = self.session.info
        size_px = picture.shape[0], picture.shape[1]
        looks = [self._look(picture, names)]
        if self.overlapping:
            return looks[0].seen
        sizes = sizes_for(size_px, info, names, self.tiles, self.m_per_px)
        if not sizes:
            return looks[0].seen
        looks += [self._look(picture, some, times) for times, some in sizes.items()]
        seen, scales = [look.seen for look in looks], [look.scale for look in looks]
        closer = closer_for(size_px, info, names, self.tiles, self.m_per_px, seen, scales)
        looks += [self._look(picture, some, times) for times, some in closer.items()]
        # the first look was for all classes
        several = [name for name in names if any(name in look.names for look in looks[1:])]
        groups, fused = [[name for name in names if name not in several]], [looks[0].seen]
        for name in several:
            own = [look for look in looks if name in look.names]
            groups.append([name])
            fused.append(
                agreed_in_sizes(
                    [look.seen for look in own],
                    [look.scale for look in own],
                    info.classes.index(name),
                    info.pyramid[name],
                )
            )
        return _together(fused, groups, info.classes)

    def _look(self, picture: ImageRGB, names: Sequence[str], times: float = 1.0) -> _SizedLook:
        """What the model sees in all tiles of a picture that is shown `times` as large as planned."""
        size_px = picture.shape[0], picture.shape[1]
        plan = plan_tiles(
            size_px,
            self.session.info,
            names,
            tiles=self.tiles,
            m_per_px=self.m_per_px,
            fixed_px=self.session.fixed_px,
            thermal=self.is_thermal,
            times=times,
        )
        tiles = []
        for place in plan.places_px:
            left, top, right, bottom = place
            seen = self.session.see(picture[top:bottom, left:right], plan.scale)
            corner = np.array([left, top, left, top], np.float32)
            tiles.append(SeenTile(place, Seen(seen.boxes_px + corner, seen.scores, seen.labels)))
        merged = tiles[0].seen if len(tiles) == 1 else merge_tiles(tiles, size_px)
        return _SizedLook(merged, plan.scale, tuple(names))


class Detector:
    """A model that is ready to look at pictures. `load` opens one; `detect` is called after, by any threads."""

    def __init__(
        self,
        session: Session,
        *,
        provider: Provider = "auto",
        threads: int | None = None,
        stand_in: bool = True,
    ) -> None:
        self._session, self._wanted_provider, self._threads = session, provider, threads
        self._any_may_stand_in = stand_in
        self._at_night: Session | None = None
        self._night_was_sought = False
        self._opinions: dict[str, Session] = {}  # by name, those who look a second time
        self._seeking = threading.Lock()
        self._thermal_frames = self._daylight_frames = self._too_small_frames = 0
        self._looks: Counter[str] = Counter()  # of the others

    @classmethod
    def load(
        cls,
        name_or_path: AnyPath = "default",
        *,
        provider: Provider = "auto",
        threads: int | None = None,
        stand_in: bool = True,
    ) -> "Detector":
        """Open an installed model by its name (`sorvolo models list`), or a model file.

        `provider` "auto" takes CUDA where there is one, else OpenVINO where it is installed, else the CPU; `threads`
        None takes as many as the process may use. `stand_in`: where a model knows daylight alone and names no other,
        any installed one that knows thermal frames looks at those; False to measure the model itself. Raises InputError for a name that is not
        installed, for a file that is missing, damaged or no model of Sorvolo's, and for a model that searches no whole
        pictures (`second_only`); SettingsError for a provider that is not there.
        """
        session = Session(find_model(name_or_path), provider, threads)
        demand_searching(session.info)
        return cls(session, provider=provider, threads=threads, stand_in=stand_in)

    @classmethod
    def from_onnx(
        cls,
        path: AnyPath,
        layout: str = AUTO,
        classes: Sequence[str] | None = None,
        *,
        provider: Provider = "auto",
        threads: int | None = None,
    ) -> "Detector":
        """Open another maker's ONNX file: YOLO, RT-DETR, NanoDet and others (`layouts.LAYOUTS`).

        `layout` "auto" goes by the network's outputs. `classes` names its classes in its order, where its file does
        not: COCO's are known. `sorvolo models import` keeps it under a name instead. Raises InputError for what cannot
        be recognised or run.
        """
        model = adopted(Path(path), layout, classes)
        return cls(
            Session(Path(path), provider, threads, model), provider=provider, threads=threads
        )

    @property
    def classes(self) -> tuple[str, ...]:
        """The names of what it finds, in the order of its labels."""
        return self._session.info.classes

    @property
    def info(self) -> ModelInfo:
        """What the model file states about itself."""
        return self._session.info

    @property
    def others(self) -> tuple[tuple[ModelInfo, int], ...]:
        """The models that looked at pictures in its place, or a second time, and how often each has."""
        sessions = [] if self._at_night is None else [self._at_night]
        looks = [
            (each.info, self._looks[each.info.name])
            for each in (*sessions, *self._opinions.values())
        ]
        return tuple((info, count) for info, count in looks if count)

    @property
    def provider(self) -> str:
        """Where it runs, in words."""
        return self._session.provider

    @property
    def notices(self) -> tuple[Notice, ...]:
        """What to know of the pictures seen so far: whose light the model does not know, who looked at them."""
        own, notices = self.info.name, []
        if (count := self._thermal_frames) and self._at_night is not None:
            night = self._at_night.info.name
            why = (
                "which was trained for them"
                if self.info.thermal
                else f"since '{own}' knows only daylight"
            )
            text = f"{count} thermal frames were seen by the model '{night}', {why}"
            notices.append(Notice("thermal_model", count, text))
        elif count and not self.info.thermal:
            known = (
                "daylight and no installed one on thermal frames"
                if self._any_may_stand_in
                else "daylight alone"
            )
            text = (
                f"{count} frames are thermal, but the model '{own}' was trained on {known}: what it "
                "finds in them is unreliable"
            )
            notices.append(Notice("thermal_untrained", count, text))
        if count := self._daylight_frames:
            text = (
                f"{count} frames are in colour, but the model '{own}' was trained on thermal frames alone: "
                "what it finds in them is unreliable; take another model"
            )
            notices.append(Notice("daylight_untrained", count, text))
        if count := self._too_small_frames:
            text = (
                f"{count} frames are too coarse for people seen from above, who were not looked for in them: a pixel "
                f"may cover {100 * COARSEST_M:.0f} cm; fly lower (`sorvolo plan` gives the height)"
            )
            notices.append(Notice("people_too_small", count, text))
        return tuple(notices)

    def detect(
        self,
        image: Picture,
        *,
        tiles: Tiles = None,
        m_per_px: float | None = None,
        least_score: float | None = None,
        classes: Sequence[str] | None = None,
        from_above: bool = False,
        overlapping: bool = False,
        early: Early | None = None,
        is_part: bool = False,
    ) -> Detections:
        """The objects in a picture, best first.

        A picture is uint8 RGB (H, W, 3), grey (H, W) or (H, W, 1), RGBA (its alpha is dropped), or uint16 of these
        (grey is stretched as a thermal camera's). `tiles` cuts a large one: "auto" by `m_per_px` (the ground's
        sampling distance; None or NaN: not known), a number of its pixels a side, or None for the picture as a whole;
        docs/detector.md gives the rule. `least_score` None means each class's own threshold; `classes` None means all.
        `from_above`: the camera looked about straight down; people by day are then not looked for where they are too
        small to be recognised (`is_too_small`).
        `overlapping`: others show the same (a video's frames), and none is worth looks in several sizes (`pyramid`).
        `early` is given the classes that have a look of their own (see `looks_for`), and what was
        found of them, while the picture is searched for the others; in the end the same objects are among all.
        `is_part`: it is part of a frame, or made from frames, and counts as none in `notices`.
        Raises InputError for anything that is no picture, SettingsError for a class, score or tile that cannot be.
        """
        wanted = self._wanted(classes)
        if least_score is not None and not 0 <= least_score <= 1:
            raise SettingsError(f"the least score must lie in 0 to 1, not {least_score}")
        # which model looks, and for what
        sampling = math.nan if m_per_px is None else float(m_per_px)
        thermal = is_thermal(image)
        session = self._session if self._is_own(thermal=thermal) else self._night_session()
        info = session.info
        self._looks[info.name] += session is not self._session
        rgb = rgb_from_picture(image)
        names = [name for name in wanted if name in info.classes]
        small = _too_small(names, sampling, thermal=thermal, from_above=from_above)
        if not is_part:
            self._daylight_frames += not (thermal or self.info.daylight)
            self._thermal_frames += not self._is_own(thermal=thermal)
            self._too_small_frames += bool(small)
        names = [name for name in names if name not in small]
        if not names:
            return no_detections(self.classes)
        search = _Search(session, tuple(names), tiles, sampling, thermal, overlapping)

        def report(seen: Seen, names: Sequence[str]) -> Detections:
            """What is reported of these classes, in this detector's labels."""
            seen = calibrated(seen, info)
            thresholds = info.thresholds
            least = np.array(
                [
                    np.inf
                    if name not in names
                    else thresholds[name]
                    if least_score is None
                    else least_score
                    for name in info.classes
                ]
            )
            kept = seen.scores >= least[seen.labels]
            labels = seen.labels[kept]
            if session is not self._session:
                labels = _places_in(self.classes, info.classes)[labels]
            return Detections(seen.boxes_px[kept], seen.scores[kept], labels, self.classes)

        def report_early(names: tuple[str, ...], seen: Seen) -> None:
            if early is not None and not info.second_look.keys() & set(names):
                early(names, report(seen, names))

        seen = search.see(rgb, report_early)
        # a second look at the reports, by each model that has one
        second_look_by_label = {
            info.classes.index(name): how for name, how in info.second_look.items() if name in names
        }
        for by in dict.fromkeys(how.by for how in second_look_by_label.values()):
            looking = self._second(session, by)
            if looking.fixed_px is not None:  # sheets have sizes of their own
                continue
            places = _places_in(info.classes, looking.info.classes)

            def see_again(
                sheet: ImageRGB, looking: Session = looking, places: Labels = places
            ) -> Seen:
                self._looks[looking.info.name] += 1
                again = looking.see(sheet)
                return Seen(again.boxes_px, again.scores, places[again.labels])

            mine = {label: how for label, how in second_look_by_label.items() if how.by == by}
            seen = rescore(seen, rgb, see_again, mine)
        return report(seen, names)

    def thresholds_for(
        self,
        picture: Picture,
        *,
        from_above: bool = False,
        m_per_px: float | None = None,
    ) -> Mapping[str, float]:
        """From which score on each class is reported in such a picture, by the model that looks at it; of those that
        `detect` looks for in it alone."""
        thermal = is_thermal(picture)
        info = self.info if self._is_own(thermal=thermal) else self._night_session().info
        least = info.thresholds
        sampling = math.nan if m_per_px is None else m_per_px
        too_small = _too_small(list(least), sampling, thermal=thermal, from_above=from_above)
        return {
            name: score
            for name, score in least.items()
            if name in self.classes and name not in too_small
        }

    def rest(self) -> None:
        """Give back memory that is kept for the next picture: before work that needs it, and after the last picture."""
        for each in (self._session, self._at_night, *self._opinions.values()):
            if each is not None:
                each.rest()

    def _wanted(self, classes: Sequence[str] | None) -> tuple[str, ...]:
        if classes is None:
            return self.classes
        if isinstance(classes, str):
            classes = (classes,)
        if not classes or (unknown := [name for name in classes if name not in self.classes]):
            named = ", ".join(map(repr, unknown)) if classes else "no class"
            there = ", ".join(self.classes)
            raise SettingsError(
                f"the model '{self.info.name}' does not find {named}; it finds {there}"
            )
        return tuple(name for name in self.classes if name in classes)

    def _is_own(self, *, thermal: bool) -> bool:
        """Whether this model itself looks at frames of such light, and no other is sought."""
        return not thermal or (self.info.thermal and not self.info.thermal_by)

    def _night_session(self) -> Session:
        """What looks at thermal frames in this model's place; threads that ask at once wait for it."""
        with self._seeking:
            if not self._night_was_sought:
                named = self.info.thermal_by
                found = (
                    thermal_model(self.classes, named) if named or self._any_may_stand_in else None
                )
                self._at_night = None if found is None else self._opened(found)
                self._night_was_sought = True
        return self._at_night or self._session

    def _second(self, session: Session, by: str) -> Session:
        """Return the session of the second look, loaded once; threads wait for it."""
        if not by:
            return session
        with self._seeking:
            if by not in self._opinions:
                self._opinions[by] = self._opened(find_model(by))
            return self._opinions[by]

    def _opened(self, path: Path) -> Session:
        return Session(path, self._wanted_provider, self._threads)


def _together(
    looks: Sequence[Seen], groups: Sequence[Sequence[str]], classes: Sequence[str]
) -> Seen:
    """What looks at one picture saw, each of its own group of classes, best first."""
    if len(looks) == 1:
        return looks[0]
    kept = [
        np.isin(look.labels, [classes.index(name) for name in names])
        for look, names in zip(looks, groups)
    ]
    scores = np.concatenate([look.scores[mine] for look, mine in zip(looks, kept)])
    order = np.argsort(-scores, kind="stable")
    return Seen(
        np.concatenate([look.boxes_px[mine] for look, mine in zip(looks, kept)])[order],
        scores[order],
        np.concatenate([look.labels[mine] for look, mine in zip(looks, kept)])[order],
    )


def _places_in(classes: Sequence[str], names: Sequence[str]) -> Labels:
    """(names,) where each name stands in `classes`; -1 where it does not."""
    return np.array([classes.index(name) if name in classes else -1 for name in names], np.int64)


def _too_small(
    names: Sequence[str], m_per_px: float, *, thermal: bool, from_above: bool
) -> list[str]:
    """Those of the classes that are not looked for in such a picture."""
    return [name for name in names if from_above and not thermal and is_too_small(name, m_per_px)]

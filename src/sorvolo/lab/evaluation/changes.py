"""Measure what `sorvolo compare` found: its events and masks against a simulation's truth, or masks against masks."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import Matrix3, PointsM, floats
from sorvolo.geometry.ground import is_on_ground
from sorvolo.geometry.homography import apply_homography
from sorvolo.lab.evaluation.change_metrics import (
    VIDEO_VIEWS,
    ComparedGround,
    EventMatch,
    EventScores,
    FoundEvent,
    TrueEvent,
    compared_ground,
    match_events,
    score_events,
)
from sorvolo.lab.evaluation.frame_rows import (
    paired_flights,
    read_features,
    refuse_simulation,
    time_ns_of,
    truth_file,
)
from sorvolo.lab.evaluation.mask_folders import MaskScores, compare_mask_folders, has_masks
from sorvolo.mosaic.paired_flights import PairedFlights
from sorvolo.paths import AnyPath, Json, JsonView
from sorvolo.store.exports.plain import features_path, plain_json
from sorvolo.store.site.archive import Archive
from sorvolo.survey.findings import ChangeKind
from sorvolo.survey.flight import Site

PHOTO_VIEWS = 2
"""So many clear views of photos make an event one that must be found; what moves needs `VIDEO_VIEWS`."""


@dataclass(frozen=True)
class ClassCounts:
    """Found events of the right kind: their classes are right, wrong, or missing."""

    right: int
    wrong: int
    unnamed: int


@dataclass(frozen=True, eq=False)
class MeasuredChanges:
    """One compared flight against the truth; what could not be measured is None, and `remarks` state why.

    `map_shift_m` is how far the map lies from the truth (rms over frames); it is taken out before events are matched.
    `classes` is None where no change has a class: nobody looked.
    """

    flight: str
    masks: MaskScores | None
    events: EventScores | None
    match: EventMatch | None
    map_shift_m: float
    remarks: tuple[str, ...]
    classes: ClassCounts | None = None


def evaluate_changes(
    found: AnyPath, truth: AnyPath, *, flight: str | None = None, least_px: int = 1
) -> tuple[MeasuredChanges, ...]:
    """Measure the compared flights of a site folder, or a folder of masks, against the truth.

    `truth` is a simulation's folder, the truth folder in it, or a folder of masks; `flight` one of the site's flights;
    `least_px` how many changed pixels make a frame positive. Raises InputError for folders that hold neither, or not
    the same frames.
    """
    found = Path(found)
    truth = Path(truth)
    refuse_simulation(found)
    true_flights = _true_flights(truth)
    if not (found / "flights").is_dir():
        if not found.is_dir():
            raise InputError(f"{found}: no such folder; give a site folder, or a folder of masks")
        return (
            _masks_alone(found.name, found, _true_masks(truth, true_flights, flight), least_px),
        )
    names = _compared_flights(found, flight)
    if not true_flights:
        folders = [(name, _own_masks(found, name)) for name in names]
        return tuple(_masks_alone(name, folder, truth, least_px) for name, folder in folders)
    # The site's compared flights, as far as the truth knows them
    with Archive.open(found, write=False) as archive:
        described = archive.site()
    if described.is_local:
        raise InputError(
            f"{found}: a map without geo-reference cannot be compared with a simulation's truth"
        )
    for path in (features_path(found / "flights" / name, "frames") for name in names):
        if not path.is_file():
            raise InputError(
                f"{path} is missing: this flight is there only in part; run `sorvolo compare` again"
            )
    flights = paired_flights(found, truth_file(truth), described)
    known = [name for name in names if flights.true_name(name) in true_flights]
    if not known:
        raise InputError(
            f"{truth}: knows the later flights {', '.join(true_flights)}, the site compared {', '.join(names)}, and no "
            "frame is in both; give the truth of these flights"
        )
    return tuple(
        _evaluate(found, described, flights, name, true_flights[flights.true_name(name)], least_px)
        for name in known
    )


def _masks_alone(name: str, found: Path, true: Path, least_px: int) -> MeasuredChanges:
    """A folder of masks against another."""
    return MeasuredChanges(
        name, compare_mask_folders(found, true, least_px), None, None, math.nan, ()
    )


def as_json(measured: Sequence[MeasuredChanges]) -> list[Json]:
    """The measures with all their rates, as JSON can hold them."""
    written = []
    for each in measured:
        masks, events = each.masks, each.events
        counted = ("compared", "only_found", "only_true", "least_px")
        written.append(
            {
                "flight": each.flight,
                "pixels": masks and _rates(masks.pixels, _COUNTS),
                "frames": masks and _rates(masks.frames, _COUNTS),
                "masks": masks and _rates(masks, counted),
                "events": events
                and plain_json(events) | _rates(events, ("found_share", "false_per_hectare")),
                "lists": each.match and _lists(each.match),
                "classes": plain_json(each.classes),
                "map_shift_m": plain_json(each.map_shift_m),
                "remarks": list(each.remarks),
            }
        )
    return written


_COUNTS = ("tp", "fp", "fn", "tn", "unknown", "precision", "recall", "accuracy", "f1")
"""Counts and their rates, as in Tables 4.3 to 4.5."""


def _rates(of: object, names: Sequence[str]) -> Json:
    """Some of a record's numbers; one that does not exist as None."""
    return {name: plain_json(getattr(of, name)) for name in names}


def _lists(match: EventMatch) -> Json:
    return {
        "found": [
            {
                "true": pair.true.id,
                "found": pair.found.id,
                "kind": str(pair.true.kind),
                "named": str(pair.found.kind),
                "error_m": round(pair.error_m, 3),
                "delay_s": plain_json(pair.delay_s),
            }
            for pair in match.pairs
        ],
        "missed": [{"true": each.id, "kind": str(each.kind)} for each in match.missed],
        **{
            name: [{"found": each.id, "kind": str(each.kind)} for each in events]
            for name, events in (
                ("twice", match.twice),
                ("false", match.false),
                ("optional", match.optional),
            )
        },
    }


def _true_flights(truth: Path) -> dict[str, Path]:
    """The later flights of a simulation and their truth folders; empty where `truth` is a folder of masks."""
    for folder in (truth / "truth", truth):
        if (folder / "frames.geojson").is_file() and (folder / "objects.geojson").is_file():
            later = {
                path.name: path for path in sorted(folder.iterdir()) if (path / "changes").is_dir()
            }
            if not later:
                raise InputError(
                    f"{truth}: this simulation has no second flight; simulate one with --flights 2"
                )
            return later
    if not truth.is_dir():
        raise InputError(
            f"no such folder: {truth}; give the folder that `sorvolo simulate` made, or a folder with one mask a frame"
        )
    if not has_masks(truth):
        raise InputError(
            f"{truth}: holds neither the truth of a simulation nor masks; give the folder that `sorvolo simulate` "
            "made, or a folder with one mask a frame"
        )
    return {}


def _true_masks(truth: Path, true_flights: Mapping[str, Path], flight: str | None) -> Path:
    if not true_flights:
        return truth
    name = flight or (next(iter(true_flights)) if len(true_flights) == 1 else "")
    if name not in true_flights:
        raise InputError(f"{truth}: has masks of {', '.join(true_flights)}; name one with --flight")
    return true_flights[name] / "changes"


def _compared_flights(site: Path, flight: str | None) -> list[str]:
    names = sorted(path.parent.name for path in (site / "flights").glob("*/changes.*json"))
    if not names:
        raise InputError(
            f"{site}: no flight of it was compared; run `sorvolo compare INPUT --site {site}` first"
        )
    if flight is None:
        return names
    if flight not in names:
        raise SettingsError(
            f"--flight {flight}: the compared flights of {site} are {', '.join(names)}"
        )
    return [flight]


def _own_masks(site: Path, flight: str) -> Path:
    folder = site / "flights" / flight / "masks"
    if not has_masks(folder):
        raise InputError(
            f"{site}: no masks of {flight} were written; run `sorvolo compare` again with --masks DIR"
        )
    return folder


def _evaluate(
    site: Path,
    described: Site,
    flights: PairedFlights,
    flight: str,
    true_folder: Path,
    least_px: int,
) -> MeasuredChanges:
    remarks = []
    masks = None
    if has_masks(own := site / "flights" / flight / "masks"):
        masks = compare_mask_folders(own, true_folder / "changes", least_px)
    else:
        remarks.append(
            "no masks were written: frames and pixels are judged after `sorvolo compare` with --masks DIR"
        )
    # The flights that made the map: those not compared themselves, which may have been laid onto it less well
    others = [name for name in flights.mine if name != flight]
    makers = [
        name for name in others if not features_path(site / "flights" / name, "changes").is_file()
    ] or others
    map_from_truth, shift_m = flights.map_from_truth(makers)
    if math.isnan(shift_m):
        remarks.append("no frame of the map is known to the truth: events are compared as they lie")
    ground = compared_ground(
        *([row.outline_m for _, row in flights.placed(names)] for names in ([flight], makers))
    )
    is_photos = any(not row.name.isdecimal() for row in flights.mine[flight])
    least_views = PHOTO_VIEWS if is_photos else VIDEO_VIEWS
    events = true_folder / "events.geojson"
    true = _read_true(events, described, map_from_truth, ground, least_views)
    # the reported events; those reported only in the end were announced with the last frame
    path = features_path(site / "flights" / flight, "changes")
    ended_ns, behind_ns = flights.clock(flight)
    found = []
    for feature in read_features(path):
        try:
            properties = feature["properties"]
            announced_ns = None
            if "announced" in properties:
                announced = properties["announced"]
                announced_ns = behind_ns + (time_ns_of(announced) if announced else ended_ns)
            world_sigma_m = _known(properties.get("sigma_m"))
            # earlier versions stated one for both
            sigma_m = _known(properties.get("sigma_in_map_m", world_sigma_m))
            found.append(
                FoundEvent(
                    str(properties["id"]),
                    ChangeKind(properties["kind"]),
                    _ring(feature, described, path),
                    sigma_m,
                    announced_ns,
                    world_sigma_m,
                )
            )
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise InputError(
                f"{path}: a change is not as docs/formats.md has it ({error!r})"
            ) from error
    match = match_events(found, true)
    scores = score_events(match, ground.area_m2)
    if match.pairs and not scores.judged_late:
        remarks.append("when events were announced is not known: none is judged late")
    classes = _class_counts(match, path, true_folder / "events.geojson")
    return MeasuredChanges(flight, masks, scores, match, shift_m, tuple(remarks), classes)


def _class_counts(match: EventMatch, found: Path, true: Path) -> ClassCounts | None:
    """How many of the pairs of one kind have the truth's classes, before and after as far as the kind has them."""
    reported = {str(each["properties"]["id"]): _classes_of(each) for each in read_features(found)}
    if not any(name for classes in reported.values() for name in classes):
        return None
    known = {_event_name(each["properties"]): _classes_of(each) for each in read_features(true)}
    counts = {"right": 0, "wrong": 0, "unnamed": 0}
    for pair in match.pairs:
        if pair.found.kind is pair.true.kind:
            mine = reported[pair.found.id]
            counts[
                "right" if mine == known[pair.true.id] else "wrong" if any(mine) else "unnamed"
            ] += 1
    return ClassCounts(**counts)


def _classes_of(feature: JsonView) -> tuple[str, str]:
    """What was there, and what is; of what moves only what it is."""
    properties = feature["properties"]
    before = "" if properties["kind"] == ChangeKind.MOVING else properties.get("class_before") or ""
    return before, properties.get("class_after") or ""


def _event_name(properties: JsonView) -> str:
    return f"{properties['number']} {properties['class_before'] or properties['class_after']}"


def _read_true(
    path: Path, described: Site, map_from_truth: Matrix3, ground: ComparedGround, views: int
) -> list[TrueEvent]:
    if not path.is_file():
        raise InputError(f"{path} is missing: an older simulation; run `sorvolo simulate` again")
    events = []
    for feature in read_features(path):
        try:
            properties = feature["properties"]
            true_m = _ring(feature, described, path)
            outline_m = apply_homography(map_from_truth, true_m)
            places = properties["path"]
            path_m = (
                apply_homography(map_from_truth, described.frame.ground_from_lonlat(places))
                if places
                else floats(())
            )
            event = TrueEvent(
                _event_name(properties),
                ChangeKind(properties["kind"]),
                outline_m,
                float(properties["length_m"]),
                [time_ns_of(text) for text in properties["clear_views"]],
                path_m,
                map_off_m=outline_m.mean(axis=0) - true_m.mean(axis=0),
            )
            true_event = replace(
                event, must_find=event.is_shown(ground, views, max(views, VIDEO_VIEWS))
            )
            events.append(true_event)
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise InputError(
                f"{path}: an event is not as docs/simulation.md has it ({error!r})"
            ) from error
    return events


def _known(stated: float | None) -> float:
    return math.nan if stated is None else float(stated)


def _ring(feature: JsonView, described: Site, path: Path) -> PointsM:
    corners = feature["geometry"]["coordinates"][0][:-1]
    ring_m = described.frame.ground_from_lonlat(corners)
    if len(ring_m) < 3 or not is_on_ground(ring_m):
        raise InputError(
            f"{path}: an outline needs at least three corners, got {json.dumps(corners)[:80]}"
        )
    return ring_m

"""What is each rule of change detection worth? Every rule switched off alone, on flights that nothing was tuned on.

python benchmarks/change_ablation.py CACHE --record [--real DATA]     (simulate, map and compare once; slow)
python benchmarks/change_ablation.py CACHE --digest                   (one line per flight: the same before and after?)
python benchmarks/change_ablation.py CACHE [--rules NAME ...] [--stage evidence|pair]

CACHE is a folder for short simulated flights, recorded once: of each view the pictures that were compared, and what
came out. After that only the stage that a rule belongs to is computed again. `evidence` starts from the recorded
views, `pair` from their pictures. Seeds come from a commit's hash, so that nobody chose them. A rule is switched off
by replacing one constant or settings value (RULES below). Figures are sums over the flights: events found,
false, reported twice, announced during the flight but withdrawn. Events of real flights without change (--real) are
all false, or moved. Every row is written to results/change_ablation.json as soon as it is known.
"""

import argparse
import gc
import hashlib
import importlib
import json
import pickle
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np

from change_events import flight as flight_path
from provenance import commit, machine
from real_strips import FLIGHTS as FLIGHTS_OF_PHOTOS
from real_strips import photos_of
from sorvolo.change import views
from sorvolo.change.evidence.evidence_map import EvidenceMap, EvidenceSettings
from sorvolo.change.metrics import FoundEvent, match_events, score_events
from sorvolo.change.pair import robust
from sorvolo.change.pair.corroboration import CorroborationSettings, Difference, believed
from sorvolo.change.pair.flight_tuning import FlightTuning
from sorvolo.change.pair.shade import shade_of_view
from sorvolo.change.shape.shadows import without_shadow
from sorvolo.missions.compare import run
from sorvolo.missions.compare.flights import compare_flights
from sorvolo.missions.evaluate import changes as evaluation
from sorvolo.missions.flight.settings import CompareSettings, MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.missions.simulate.site import simulate_site
from sorvolo.simulation.presets import preset
from sorvolo.survey.findings import ComparedView

RESULTS = Path(__file__).parent / "results" / "change_ablation.json"
SEEDS_FROM = "16ebd5df70a31436834ccd2cd668cb9935c3628a"
FLIGHTS = (
    ("compare", 25), ("compare-urban", 25), ("compare-dirt", 25), ("compare-photos", 40), ("compare-photos", 40),
    ("compare-none", 25),
)
"""Preset and length of a strip, m: short, for each rule is one more run over all of them."""

REAL = (("caliterra", 3), ("brighton_beach", 0))
"""Flights of real photos, and which of their pairs of strips: one is mapped, the other compared."""


def main() -> None:
    """Record flights, print what they give, or switch rules off."""
    layout = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=layout)
    parser.add_argument("cache", type=Path)
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--real", type=Path, help="folder of real flights, recorded as well")
    parser.add_argument("--presets", nargs="*", help="record flights of these presets only")
    parser.add_argument("--seeds-from", default=SEEDS_FROM, help="hash of a commit that seeds are drawn from")
    parser.add_argument("--digest", action="store_true")
    parser.add_argument("--stage", choices=("evidence", "pair"), default="evidence")
    parser.add_argument("--rules", nargs="*", help="names of RULES; all of the stage without it")
    parser.add_argument("--flights", nargs="*", help="names of recorded flights; all without it")
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    if options.record:
        record_all(options.cache, options.real, options.presets, options.seeds_from)
        return
    recorded = [each for each in read_all(options.cache) if not options.flights or each.name in options.flights]
    if options.digest:
        for each in recorded:
            print(each.name, digest(each, options.stage), flush=True)
        return
    ablate(recorded, options)


# ---- recording ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Recorded:
    """A flight that was compared: its folder of views, the evidence's scale, and the true events, None on real ones."""

    name: str
    folder: Path
    m_per_px: float
    truth: tuple[Any, ...] | None  # true events, settings, compared m2, how far the truth's clock is ahead
    events: int

    def views(self) -> Iterator[tuple[ComparedView, list[tuple[Any, Any]]]]:
        """What was compared, with what the earlier pictures showed of it, in order of time."""
        for path in sorted(self.folder.glob("view-*.pickle")):
            yield pickle.loads(path.read_bytes())

    def found(self) -> Iterator[ComparedView]:
        """The views with the differences that were found then; their shade is made anew."""
        for path in sorted(self.folder.glob("found-*.pickle")):
            yield with_shade(pickle.loads(path.read_bytes()))


def with_shade(view: ComparedView) -> ComparedView:
    """The view with its shade mask, as `ViewMaker` makes it."""
    return replace(view, shade=shade_of_view(view.reference, view.image, view.valid))


class RecordingViewMaker(views.ViewMaker):
    """Writes down what is compared."""

    folder = Path()

    def corroborate(self, looked: Any) -> Any:
        """As ever; the pictures are kept."""
        outcome = super().corroborate(looked)
        if isinstance(looked, views.OneSided):
            height, width = looked.valid.shape
            aligned, frame = looked.aligned, looked.posed.frame
            earlier = [] if self._pictures is None else [
                (picture.copy(), sees & self._lens_sees) for picture, sees in self._pictures.seen_from(
                    aligned.site_from_image, aligned.camera_m, width, height,
                    views.ViewSettings().witnesses,
                )
            ]
            blank = np.zeros(looked.valid.shape, np.uint8)
            view = ComparedView(
                frame.index, frame.name, self._flight.utc_ns(frame.time_ns), aligned.site_from_image, aligned.camera_m,
                looked.image, looked.reference, looked.valid, blank, np.zeros((0, 4), np.int64), np.zeros(0),
                aligned.residual_px, blank,
            )
            place = self.folder / f"view-{frame.index:06d}.pickle"
            place.write_bytes(pickle.dumps((view, earlier), protocol=5))
            if outcome.view is not None:
                found = self.folder / f"found-{frame.index:06d}.pickle"
                found.write_bytes(pickle.dumps(outcome.view, protocol=5))
        return outcome


def seed_of(name: str, number: int, seeds_from: str = SEEDS_FROM) -> int:
    """A seed that nobody chose."""
    return int(hashlib.sha256(f"{seeds_from} {name} {number}".encode()).hexdigest()[:6], 16)


def record_all(cache: Path, real: Path | None, presets: Sequence[str] | None, seeds_from: str) -> None:
    """Simulate, map and compare each flight once; what is there already is kept."""
    for number, (name, length_m) in enumerate(FLIGHTS):
        folder = cache / f"{number}-{name}"
        if (folder / "recorded.pickle").is_file() or (presets and name not in presets):
            continue
        started = time.process_time()
        settings = replace(preset(name), seed=seed_of(name, number, seeds_from))
        settings = replace(settings, path=replace(settings.path, length_m=length_m))
        # no more frames than are compared: five a second
        settings = replace(
            settings, imaging=replace(settings.imaging, fps=5.0), output=replace(settings.output, truth_step=1)
        )
        simulation, site = folder / "simulation", folder / "site"
        if not simulation.is_dir():
            for _ in simulate_site(simulation, settings):
                pass
        print(folder.name, "simulated", round(time.process_time() - started), "s", flush=True)
        camera = simulation / "camera.xml"
        for _ in map_flights([flight_path(simulation, 1)], site, MapSettings(model="none"), camera=camera):
            pass
        print(folder.name, "mapped", round(time.process_time() - started), "s", flush=True)
        record(folder, flight_path(simulation, 2), site, camera, simulation)
        print(folder.name, "recorded", round(time.process_time() - started), "s", flush=True)
    for name, number in REAL if real is not None else ():
        folder = cache / f"real-{name}"
        if (folder / "recorded.pickle").is_file():
            continue
        started = time.process_time()
        earlier, later = (folder / part for part in ("earlier", "later"))
        for strip, photos in zip(FLIGHTS_OF_PHOTOS[name].pairs[number], (earlier, later)):
            photos.mkdir(parents=True, exist_ok=True)
            for path in photos_of(real / name, FLIGHTS_OF_PHOTOS[name].strips[strip]):
                (photos / path.name).symlink_to(path.resolve())
        list(map_flights([earlier], folder / "site", MapSettings(model="none")))
        record(folder, later, folder / "site", None, None)
        print(folder.name, "recorded", round(time.process_time() - started), "s", flush=True)


def record(folder: Path, later: Path, site: Path, camera: Path | None, simulation: Path | None) -> None:
    """Compare a flight, writing down its views, and match its events with the truth."""
    scales: list[float] = []

    class RecordingEvidence(EvidenceMap):
        def __init__(self, m_per_px: float, *rest: Any, **named: Any) -> None:
            scales.append(m_per_px)
            super().__init__(m_per_px, *rest, **named)

    RecordingViewMaker.folder = folder
    with mock.patch.multiple(run, ViewMaker=RecordingViewMaker, EvidenceMap=RecordingEvidence):
        for _ in compare_flights([later], site, CompareSettings(model="none"), camera=camera):
            pass
    truth, events = None, 0
    if simulation is not None:
        kept: list[Any] = []

        def keeping_match(found: Any, true: Any, settings: Any) -> Any:
            kept.extend([found, true, settings])
            return match_events(found, true, settings)

        def keeping_score(match: Any, area_m2: float, settings: Any) -> Any:
            kept.append(area_m2)
            return score_events(match, area_m2, settings)

        with mock.patch.object(evaluation, "match_events", keeping_match), \
                mock.patch.object(evaluation, "score_events", keeping_score):
            evaluation.evaluate_changes(site, simulation)
        found, true, settings, area_m2 = kept
        truth, events = (true, settings, area_m2, found), len(found)
    (folder / "recorded.pickle").write_bytes(pickle.dumps(Recorded(folder.name, folder, scales[0], truth, events)))


def read_all(cache: Path) -> list[Recorded]:
    """The recorded flights."""
    return [pickle.loads(path.read_bytes()) for path in sorted(cache.glob("*/recorded.pickle"))]


# ---- replaying ------------------------------------------------------------------------------------------------------


def compared_again(recorded: Recorded) -> Iterator[ComparedView]:
    """The views compared anew, as `missions/compare` does it."""
    tuning = FlightTuning()
    rules = CorroborationSettings()
    for view, earlier in recorded.views():
        reference, query = (cv2.cvtColor(each, cv2.COLOR_RGB2BGR) for each in (view.reference, view.image))
        found = robust.compare_robust(
            reference, query, view.valid, replace(tuning.settings(), least_score=rules.least_score)
        )
        tuning.observe(found)
        by_map = Difference(found.mask, found.boxes, found.scores)
        settings = replace(tuning.settings(), least_score=rules.least_score)
        opinions = []
        for picture, sees in earlier:
            other = robust.compare_robust(picture, query, sees, settings)
            opinions.append((Difference(other.mask, other.boxes, other.scores), sees))
        kept = believed((by_map, view.valid), opinions, rules)
        if np.count_nonzero(kept.mask) <= 0.5 * max(1, np.count_nonzero(view.valid)):
            yield with_shade(replace(view, changed=kept.mask, boxes=kept.boxes, scores=kept.scores, shade=kept.mask))


def gathered(recorded: Recorded, compared: Iterator[ComparedView]) -> tuple[list[Any], int]:
    """The changes that a flight ends with, and how many more were announced meanwhile."""
    evidence = EvidenceMap(recorded.m_per_px, EvidenceSettings(), recorded.name)
    early = [each.id for view in compared for each in evidence.add(view)]
    final = [without_shadow(each) for each in evidence.conclude()]
    kept = {each.id for each in final}
    return final, sum(each not in kept for each in early)


def run_of(recorded: Recorded, stage: str) -> tuple[list[Any], int]:
    """The changes of a flight, computed again from a stage on, and how many more were announced meanwhile."""
    return gathered(recorded, recorded.found() if stage == "evidence" else compared_again(recorded))


def digest(recorded: Recorded, stage: str) -> str:
    """A hash of all that is reported of a flight, to the last bit."""
    total = hashlib.sha256()
    compared = recorded.found() if stage == "evidence" else compared_again(recorded)
    evidence = EvidenceMap(recorded.m_per_px, EvidenceSettings(), recorded.name)
    for view in compared:
        if stage == "pair":
            absorb(total, (view.changed, view.boxes, view.scores))
        absorb(total, evidence.add(view))
    changes = [without_shadow(each) for each in evidence.conclude()]
    absorb(total, changes)
    return f"{total.hexdigest()[:16]} {len(changes)} changes"


def absorb(total: Any, value: Any) -> None:
    """Feed any record of arrays and plain values to a hash."""
    if isinstance(value, np.ndarray):
        total.update(np.ascontiguousarray(value).tobytes())
    elif is_dataclass(value):
        for each in fields(value):
            absorb(total, getattr(value, each.name))
    elif isinstance(value, (list, tuple)):
        for each in value:
            absorb(total, each)
    else:
        total.update(repr(value).encode())


def scored(recorded: Recorded, changes: Sequence[Any], withdrawn: int) -> dict[str, int]:
    """What a flight's changes are worth; `withdrawn` ones were announced as well."""
    if recorded.truth is None:
        return {"real": len(changes), "withdrawn": withdrawn}
    true, settings, area_m2, first = recorded.truth
    ahead_ns = {each.id: each.announced_ns for each in first}
    found = [FoundEvent(each.id, each.kind, each.outline_m, each.sigma_m, _when(each, ahead_ns)) for each in changes]
    match = match_events(found, true, settings)
    scores = score_events(match, area_m2, settings)
    return {
        "found": scores.found, "of": scores.must_find, "false": scores.false, "twice": scores.twice,
        "named": scores.named_right, "optional": scores.optional,
        "withdrawn": withdrawn,
    }


def _when(change: Any, _: dict[str, Any]) -> int | None:
    return None if change.announced_ns < 0 else change.announced_ns


# ---- switching off --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Rule:
    """One rule and what switches it off: `place` is module:name, or module:Class.field of a settings record."""

    name: str
    stage: str
    decision: str
    switches: tuple[tuple[str, Any], ...]


@contextmanager
def switched_off(rule: Rule | None) -> Iterator[None]:
    """The rule's constants replaced meanwhile."""
    with ExitStack() as stack:
        for place, value in () if rule is None else rule.switches:
            module, _, name = place.partition(":")
            target: Any = importlib.import_module(f"sorvolo.change.{module}")
            *path, last = name.split(".")
            for each in path:
                target = getattr(target, each)
            if isinstance(target, type) and is_dataclass(target):
                defaults = list(target.__init__.__defaults__ or ())
                names = [each.name for each in fields(target) if each.init]
                defaults[len(defaults) - len(names) + names.index(last)] = value
                stack.enter_context(mock.patch.object(target.__init__, "__defaults__", tuple(defaults)))
            stack.enter_context(mock.patch.object(target, last, value))
        yield


def ablate(recorded: Sequence[Recorded], options: argparse.Namespace) -> None:
    """One row for the code as it is, and one for each rule without it."""
    wanted = [each for each in RULES if each.stage == options.stage]
    if options.rules is not None:
        wanted = [each for each in RULES if each.name in options.rules]
    known = json.loads(options.output.read_text()) if options.output.is_file() else {"rows": []}
    rows = known["rows"]
    done = {(row["rule"], row["stage"]) for row in rows}
    for rule in (None, *wanted):
        name, stage = ("all rules", options.stage) if rule is None else (rule.name, rule.stage)
        if (name, stage) in done:
            continue
        started, flights = time.process_time(), {}
        with switched_off(rule):
            for each in recorded:
                flights[each.name] = scored(each, *run_of(each, stage))
                gc.collect()
        totals = {
            key: sum(each.get(key, 0) for each in flights.values())
            for key in ("found", "of", "false", "twice", "withdrawn", "named", "real")
        }
        rows.append({
            "rule": name, "stage": stage, "decision": rule.decision if rule else "", **totals, "flights": flights,
            "cpu_s": round(time.process_time() - started),
        })
        print(f"{name:32} {stage:9}", *(f"{key} {value}" for key, value in totals.items()), file=sys.stderr, flush=True)
        options.output.write_text(json.dumps({
            "benchmark": "change_ablation", "machine": machine(), "commit": commit(),
            "flights": [[name, length_m, seed_of(name, i)] for i, (name, length_m) in enumerate(FLIGHTS)],
            "rows": rows,
        }, indent=1) + "\n")


def _nothing(*_: Any) -> None:
    return None


def _no(*_: Any) -> bool:
    return False


def _yes(*_: Any) -> bool:
    return True


def _new_at_once(parts: Any, row: int, thing: Any, named: Any, now_ns: int, next_id: Any) -> dict[int, Any]:
    whole = all(each.id != thing.id for each in named.values())
    return {row: thing if whole else replace(thing, id=next_id(), announced_ns=now_ns)}


def _no_pieces(*_: Any) -> list[Any]:
    return []


def _all_parts_one(_: Any, kind: Any, changed: Any, __: Any) -> list[Any]:
    return [(changed, kind)]


def _thing_alone(thing: Any, *_: Any) -> Any:
    return thing


def _rule(name: str, decision: str, *switches: tuple[str, Any], stage: str = "evidence") -> Rule:
    return Rule(name, stage, decision, switches)


_INFINITE = float("inf")
_ANNOUNCING, _PARALLAX = "evidence.announcing:AnnounceSettings", "motion.parallax:ParallaxSettings"
_THINGS, _EVIDENCE = "shape.shadows:ThingSettings", "evidence.evidence_map"
_OPINIONS, _PICTURES = "pair.corroboration:CorroborationSettings", "evidence.pictures:PictureSettings"
_RESTLESS = f"{_EVIDENCE}:RestlessSettings"
RULES: tuple[Rule, ...] = (
    # when a change is announced, and when it is withdrawn
    _rule("large must be sure", "0018", (f"{_ANNOUNCING}.large_score", 0.0)),
    _rule("specks of shade", "0015", (f"{_ANNOUNCING}.shade_score", 0.0)),
    _rule("restless ground", "before 0014", (f"{_ANNOUNCING}.restless_half", _INFINITE)),
    _rule("restless ground, only for the unsure", "0007", (f"{_ANNOUNCING}.doubt", _INFINITE)),
    _rule("never seen whole", "0007", (f"{_ANNOUNCING}.cut_off", 1.0)),
    _rule("from one place", "before 0014", (f"{_ANNOUNCING}.one_place", 0.0)),
    _rule("leaning neighbours", "0015", (f"{_EVIDENCE}:PassingSettings.share", 0.0)),
    _rule("unsteady blobs must stand", "0017", (f"{_EVIDENCE}:GatherSettings.stands_s", 0.0)),
    _rule("frames all changed", "before 0014", (f"{_EVIDENCE}:GatherSettings.all_changed", 2.0)),
    _rule("only new places count", "before 0014", (f"{_EVIDENCE}:GatherSettings.moved_heights", 0.0)),
    _rule("restless ground: not what leans with it", "before 0014", (f"{_RESTLESS}.lean", 0.0)),
    _rule("restless ground: not what changed itself", "before 0014", (f"{_RESTLESS}.changed_itself", 1.0)),
    # what a change is made of
    _rule("a dark car stays whole", "before 0014", ("shape.shadows:_may_be_a_car", _no)),
    _rule("pieces that lie apart", "0016", ("shape.shadows:_groups", _no_pieces)),
    _rule("pieces: came and left by a neck", "0016", (f"{_THINGS}.neck_m", 0.0)),
    _rule("solid things", "0018", (f"{_THINGS}.solid", 0.0)),
    _rule("large things", "0018", (f"{_THINGS}.least_m2", 0.0)),
    _rule("the shadow of what came", "before 0014", ("shape.shadows:_CONTRARY", {})),
    _rule("parts at all", "before 0014", ("evidence.pictures:things_of", _all_parts_one)),
    _rule("parts: shown twice first", "before 0014", ("shape.things:Parts._new_at", _new_at_once)),
    _rule("replaced is seldom", "before 0014", ("shape.kinds:_REPLACED_PRIOR", 1.0)),
    _rule("outlines without tiny pieces", "before 0014", ("shape.outlines:_LEAST_PART", 0.0)),
    _rule("outlines by the majority of masks", "before 0014", (f"{_PICTURES}.least_majority", _INFINITE)),
    # what moves
    _rule("walks against the flight, photos", "0016", ("motion.blob_tracker:floats", _no)),
    _rule("rigid blobs", "before 0016", ("motion.blob_tracker:is_rigid", _no)),
    _rule("photos: three views", "0016", (f"{_PARALLAX}.photos_apart_s", _INFINITE)),
    _rule("unlikely parallax", "before 0014", (f"{_PARALLAX}.unlikely", _INFINITE)),
    _rule("steady motion", "before 0014", ("motion.blob_tracker:_is_plausible", _yes)),
    _rule("nothing goes with the camera", "before 0014", ("motion.blob_tracker:goes_with_camera", _no)),
    _rule("blobs without their shadows", "before 0014", ("motion.blobs:thing_of", _thing_alone)),
    _rule("blobs: no large part of the view", "before 0014", ("motion.blobs:BlobSettings.most_of_view", 1.0)),
    _rule("blobs: on known ground", "before 0014", ("motion.blobs:_is_known_around", _yes)),
    _rule("feet of people", "before 0014", ("motion.blobs:_foot_m", _nothing)),
    # one pair of pictures, on flights
    _rule("one very sure opinion", "0016", (f"{_OPINIONS}.very_sure", 2.0), stage="pair"),
    _rule("opinions: what leans lies beside", "0007", (f"{_OPINIONS}.near_px", 1), stage="pair"),
    _rule("opinions: all of it seen", "0007", (f"{_OPINIONS}.seen", 0.0), stage="pair"),
    _rule("growing: not what is doubted", "0007", ("pair.robust:MaskSettings.least_grown", 0.0), stage="pair"),
    _rule("hulls", "0007", ("pair.robust:MaskSettings.convexity", 2.0), stage="pair"),
    _rule("growing: limit by quiet ground", "0007", ("pair.region_extent:ExtentSettings.of_quiet", 0.0), stage="pair"),
)
_LIGHT, _MOVED = "pair.illumination:LightSettings", "pair.moved_shadows:MovedShadowSettings"
_EXTENT, _MASKS = "pair.region_extent:ExtentSettings", "pair.robust:MaskSettings"
PAIR_RULES: tuple[Rule, ...] = tuple(_rule(name, decision, *switches, stage="pairs") for name, decision, *switches in (
    ("light: small things do not count", "0007", (f"{_LIGHT}.median_cells", 1)),
    ("light: only the same ground counts", "0007", (f"{_LIGHT}.alike", (-2.0, -1.0))),
    ("light: flat ground counts a little", "0007", (f"{_LIGHT}.flat_trust", 0.0)),
    ("light: four reaches", "0007", (f"{_LIGHT}.reaches", ((7, 1.0), (49, 1e-3)))),
    ("light: slopes drawn to one", "0007", (f"{_LIGHT}.no_slope", 0.0)),
    ("moved shadows", "0014", ("pair.illumination:_shades", _nothing)),
    ("moved shadows: three levels", "0014", (f"{_MOVED}.levels", (8,))),
    ("moved shadows: colours alike", "0014", (f"{_MOVED}.most_tint", 256)),
    ("moved shadows: no cloud", "0014", (f"{_MOVED}.largest", 1.0)),
    ("moved shadows: sharp edge", "0014", (f"{_MOVED}.sharp", 0.0)),
    ("moved shadows: same structure", "0014", (f"{_MOVED}.least_alike", -_INFINITE)),
    ("moved shadows: surer where small", "0014", (f"{_MOVED}.alike_of_few", 0.0)),
    ("moved shadows: narrow parts beside", "0014", (f"{_MOVED}.most_apart", 0)),
    ("growing", "0007", (f"{_MASKS}.least_grown", 2.0)),
    ("growing: limit by the thing's height", "0007", (f"{_EXTENT}.of_top", 0.0)),
    ("growing: limit by quiet ground", "0007", (f"{_EXTENT}.of_quiet", 0.0)),
    ("growing: not into shade", "0007", (f"{_EXTENT}.shade_of_top", 0.0)),
    ("growing: blurred rim", "0007", (f"{_EXTENT}.blurred", 0.0)),
    ("growing: nearly convex", "0007", (f"{_EXTENT}.convexity", 0.0)),
    ("growing: a whole thing", "0026", (f"{_EXTENT}.edge", -1.0)),
    ("growing: sharp rim", "0007", (f"{_EXTENT}.beside", _INFINITE)),
    ("regions: activity around", "0007", ("pair.regions:RegionSettings.activity_factor", 0.0)),
    ("regions: bounded activity", "0007", ("pair.regions:RegionSettings.most_clutter", 255.0)),
    ("calm pairs search less far", "0007", ("pair.robust:RobustSettings.calm_px", -1.0)),
    ("hulls", "0007", (f"{_MASKS}.convexity", 2.0)),
    ("rims drawn anew", "0007", ("pair.robust:_outlined", _thing_alone)),
    ("what left in the reference's pixels", "0007", (f"{_MASKS}.same_place_px", _INFINITE)),
    ("rim of the unknown", "0007", ("pair.robust:RobustSettings.unknown_px", 0)),
))
"""For pair_ablation.py."""

if __name__ == "__main__":
    main()

"""What is each rule of change detection worth? Every rule switched off alone, on flights that nothing was tuned on.

python benchmarks/change_ablation.py CACHE --record [--real DATA] [--dates DATA]  (simulate, map and compare once; slow)
python benchmarks/change_ablation.py CACHE --digest                   (one line per flight: the same before and after?)
python benchmarks/change_ablation.py CACHE [--rules NAME ...] [--stage decision|evidence|pair]

CACHE is a folder for short simulated flights, recorded once: of each view the pictures that were compared, and what
came out. After that only the stage that a rule belongs to is computed again. `decision` starts from the evidence before
its end, gathered once (decision_replay.py), `evidence` from the recorded views, `pair` from their pictures. Seeds come
from a commit's hash, so that nobody chose them. A rule is switched off by replacing one constant or settings value
(change_rules.py). Figures are sums over the flights: events found, false, reported twice, announced during the flight
but withdrawn, and the mean intersection over union of what stands still with its footprint. Events of real flights
without change (--real) are all false, or moved. Every row is written to results/change_ablation.json as soon as it is
known.
"""

import argparse
import gc
import hashlib
import json
import pickle
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np

import real_dates
from change_events import flight as flight_path
from change_rules import RULES, Rule, switched_off
from decision_replay import decided, gather
from provenance import commit, machine
from real_strips import FLIGHTS as FLIGHTS_OF_PHOTOS
from real_strips import photos_of
from sorvolo.change import views
from sorvolo.change.corroboration import CorroborationSettings, Difference, believed
from sorvolo.change.evidence import EvidenceMap, EvidenceSettings
from sorvolo.change.outlines import overlap
from sorvolo.change.pair import robust
from sorvolo.change.shade import shade_of_view
from sorvolo.change.things import without_shadow
from sorvolo.change.tuning import FlightTuning
from sorvolo.lab.evaluation import changes as evaluation
from sorvolo.lab.evaluation.change_metrics import FoundEvent, match_events, score_events
from sorvolo.lab.evaluation.frame_rows import map_frames
from sorvolo.lab.simulate.site import simulate_site
from sorvolo.lab.simulation.presets import preset
from sorvolo.missions.compare import run
from sorvolo.missions.compare.flights import compare_flights
from sorvolo.missions.flight.settings import CompareSettings, MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.store.site.archive import Archive
from sorvolo.survey.findings import ComparedView

RESULTS = Path(__file__).parent / "results" / "change_ablation.json"
SEEDS_FROM = "16ebd5df70a31436834ccd2cd668cb9935c3628a"
FLIGHTS = (
    ("compare", 25),
    ("compare-urban", 25),
    ("compare-dirt", 25),
    ("compare-photos", 40),
    ("compare-photos", 40),
    ("compare-none", 25),
)
"""Preset and length of a strip, m: short, for each rule is one more run over all of them."""

GATHERED = "gathered.pickle"  # in a recorded flight's folder: its evidence before its end
REAL = (("caliterra", 3), ("brighton_beach", 0))
"""Flights of real photos, and which of their pairs of strips: one is mapped, the other compared."""


def main() -> None:
    """Record flights, print what they give, or switch rules off."""
    layout = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=layout)
    parser.add_argument("cache", type=Path)
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--real", type=Path, help="folder of real flights, recorded as well")
    parser.add_argument(
        "--dates", type=Path, help="folder of real flights: the first pair of real_dates.py as well"
    )
    parser.add_argument("--presets", nargs="*", help="record flights of these presets only")
    parser.add_argument(
        "--seeds-from", default=SEEDS_FROM, help="hash of a commit that seeds are drawn from"
    )
    parser.add_argument("--digest", action="store_true")
    parser.add_argument("--stage", choices=("decision", "evidence", "pair"), default="decision")
    parser.add_argument("--rules", nargs="*", help="names of RULES; all of the stage without it")
    parser.add_argument("--flights", nargs="*", help="names of recorded flights; all without it")
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    if options.record:
        record_all(options.cache, options.real, options.presets, options.seeds_from)
        if options.dates is not None:
            record_dates(options.cache, options.dates)
        return
    recorded = [
        each
        for each in read_all(options.cache)
        if not options.flights or each.name in options.flights
    ]
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
    truth: (
        tuple[Any, ...] | None
    )  # true events, settings, compared m2, how far the truth's clock is ahead
    events: int
    drawn: tuple[Any, ...] | None = (
        None  # of the real pair of dates: frame, map from true, size of the orthophoto
    )

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
            earlier = (
                []
                if self._pictures is None
                else [
                    (picture.copy(), sees & self._lens_sees)
                    for picture, sees in self._pictures.seen_from(
                        aligned.site_from_image,
                        aligned.camera_m,
                        width,
                        height,
                        views.ViewSettings().witnesses,
                    )
                ]
            )
            blank = np.zeros(looked.valid.shape, np.uint8)
            view = ComparedView(
                frame.index,
                frame.name,
                self._flight.utc_ns(frame.time_ns),
                aligned.site_from_image,
                aligned.camera_m,
                looked.image,
                looked.reference,
                looked.valid,
                blank,
                np.zeros((0, 4), np.int64),
                np.zeros(0),
                aligned.residual_px,
                blank,
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


def record_all(
    cache: Path, real: Path | None, presets: Sequence[str] | None, seeds_from: str
) -> None:
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
            settings,
            imaging=replace(settings.imaging, fps=5.0),
            output=replace(settings.output, truth_step=1),
        )
        simulation, site = folder / "simulation", folder / "site"
        if not simulation.is_dir():
            for _ in simulate_site(simulation, settings):
                pass
        print(folder.name, "simulated", round(time.process_time() - started), "s", flush=True)
        camera = simulation / "camera.xml"
        for _ in map_flights(
            [flight_path(simulation, 1)], site, MapSettings(model="none"), camera=camera
        ):
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


def record_dates(cache: Path, data: Path) -> None:
    """Compare the first pair of real dates, whose changes are drawn by hand; the later date has its attitude."""
    folder, (earlier, later) = cache / "dates", real_dates.DEVELOPMENT[0].split("/")
    if (folder / "recorded.pickle").is_file():
        return
    first, size_px = real_dates.fly(data, earlier, 2)
    second, _ = real_dates.fly(data, later, 3)
    mapped, flown = folder / "photos_earlier", folder / "photos_later"
    folder.mkdir(parents=True, exist_ok=True)
    shown = real_dates.write_photos(first, mapped, size_px, "known", real_dates.begins_ns(earlier))
    real_dates.write_photos(second, flown, size_px, "known", real_dates.begins_ns(later))
    camera, site = folder / "camera.xml", folder / "site"
    for _ in map_flights([mapped], site, MapSettings(model="none"), camera=camera):
        pass
    record(folder, flown, site, camera, None)
    with Archive.open(site, write=False) as archive:
        frame = archive.site().frame
        rows = map_frames(site, archive.site())[mapped.name]
    stored: Recorded = pickle.loads((folder / "recorded.pickle").read_bytes())
    truth = (frame, real_dates.map_error(first, shown, rows, frame), size_px)
    (folder / "recorded.pickle").write_bytes(pickle.dumps(replace(stored, drawn=truth)))


def record(
    folder: Path, later: Path, site: Path, camera: Path | None, simulation: Path | None
) -> None:
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

        with (
            mock.patch.object(evaluation, "match_events", keeping_match),
            mock.patch.object(evaluation, "score_events", keeping_score),
        ):
            evaluation.evaluate_changes(site, simulation)
        found, true, settings, area_m2 = kept
        truth, events = (true, settings, area_m2, found), len(found)
    (folder / "recorded.pickle").write_bytes(
        pickle.dumps(Recorded(folder.name, folder, scales[0], truth, events))
    )


def read_all(cache: Path) -> list[Recorded]:
    """The recorded flights."""
    return [pickle.loads(path.read_bytes()) for path in sorted(cache.glob("*/recorded.pickle"))]


# ---- replaying ------------------------------------------------------------------------------------------------------


def compared_again(recorded: Recorded) -> Iterator[ComparedView]:
    """The views compared anew, as `missions/compare` does it."""
    tuning = FlightTuning()
    rules = CorroborationSettings()
    for view, earlier in recorded.views():
        reference, query = (
            cv2.cvtColor(each, cv2.COLOR_RGB2BGR) for each in (view.reference, view.image)
        )
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
            yield with_shade(
                replace(
                    view, changed=kept.mask, boxes=kept.boxes, scores=kept.scores, shade=kept.mask
                )
            )


def gathered(recorded: Recorded, compared: Iterator[ComparedView]) -> tuple[list[Any], int]:
    """The changes that a flight ends with, and how many more were announced meanwhile."""
    evidence = EvidenceMap(recorded.m_per_px, EvidenceSettings(), recorded.name)
    early = [each.id for view in compared for each in evidence.add(view)]
    final = [without_shadow(each) for each in evidence.conclude()]
    kept = {each.id for each in final}
    return final, sum(each not in kept for each in early)


def run_of(recorded: Recorded, stage: str) -> tuple[list[Any], int]:
    """The changes of a flight, computed again from a stage on, and how many more were announced meanwhile."""
    if stage == "decision":
        return decided(recorded.folder / GATHERED)
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


def scored(recorded: Recorded, changes: Sequence[Any], withdrawn: int) -> dict[str, float]:
    """What a flight's changes are worth; `withdrawn` ones were announced as well."""
    if recorded.drawn is not None:
        frame, map_from_true, size_px = recorded.drawn
        rings_m = {each.id: each.outline_m for each in changes}
        by_hand = json.loads((Path(__file__).parent / "real_dates.json").read_text())
        drawn = real_dates.found_among(rings_m, frame, map_from_true, by_hand, size_px)
        keys = {"found": "drawn_found", "false": "drawn_false", "elsewhere": "drawn_elsewhere"}
        return {ours: drawn[theirs] for theirs, ours in keys.items()} | {
            "drawn_withdrawn": withdrawn
        }
    if recorded.truth is None:
        return {"real": len(changes), "withdrawn": withdrawn}
    true, settings, area_m2, first = recorded.truth
    ahead_ns = {each.id: each.announced_ns for each in first}
    found = [
        FoundEvent(each.id, each.kind, each.outline_m, each.sigma_m, _when(each, ahead_ns))
        for each in changes
    ]
    match = match_events(found, true, settings)
    scores = score_events(match, area_m2, settings)
    still = [each for each in match.pairs if not len(each.true.path_m)]
    ious = [overlap(each.found.outline_m, each.true.outline_m)[0] for each in still]
    return {
        "found": scores.found,
        "of": scores.must_find,
        "false": scores.false,
        "twice": scores.twice,
        "named": scores.named_right,
        "optional": scores.optional,
        "withdrawn": withdrawn,
        "outlines": len(still),
        "iou_sum": round(sum(ious), 3),
    }


def _when(change: Any, _: dict[str, Any]) -> int | None:
    return None if change.announced_ns < 0 else change.announced_ns


# ---- switching off --------------------------------------------------------------------------------------------------


def wanted_rules(options: argparse.Namespace) -> list[Rule]:
    """The rules that were named; else those of the stage."""
    if options.rules is not None:
        return [each for each in RULES if each.name in options.rules]
    return [each for each in RULES if each.stage == options.stage]


def totals_of(flights: Sequence[dict[str, Any]]) -> dict[str, float]:
    """The scores of all flights together; `iou` is the mean over their outlines."""
    keys = (
        "found",
        "of",
        "false",
        "twice",
        "withdrawn",
        "named",
        "real",
        "drawn_found",
        "drawn_false",
        "drawn_elsewhere",
    )
    outlines = sum(each.get("outlines", 0) for each in flights)
    iou = round(sum(each.get("iou_sum", 0) for each in flights) / max(outlines, 1), 4)
    return {key: sum(each.get(key, 0) for each in flights) for key in keys} | {"iou": iou}


def ablate(recorded: Sequence[Recorded], options: argparse.Namespace) -> None:
    """One row for the code as it is, and one for each rule without it."""
    rows = json.loads(options.output.read_text())["rows"] if options.output.is_file() else []
    done = {(row["rule"], row["stage"]) for row in rows}
    if options.stage == "decision":
        for each in recorded:
            gather(each.found(), each.m_per_px, each.name, each.folder / GATHERED)
    for rule in (None, *wanted_rules(options)):
        name, stage = ("all rules", options.stage) if rule is None else (rule.name, rule.stage)
        if (name, stage) in done:
            continue
        decision = "" if rule is None else rule.decision
        rows.append(
            {
                "rule": name,
                "stage": stage,
                "decision": decision,
                **scored_without(rule, stage, recorded),
            }
        )
        options.output.write_text(
            json.dumps(
                {
                    "benchmark": "change_ablation",
                    "machine": machine(),
                    "commit": commit(),
                    "seeds_from": options.seeds_from,
                    "lengths_m": dict(FLIGHTS),
                    "rows": rows,
                },
                indent=1,
            )
            + "\n"
        )


def scored_without(rule: Rule | None, stage: str, recorded: Sequence[Recorded]) -> dict[str, Any]:
    """The scores of all flights without a rule, together and each by itself."""
    started, flights = time.process_time(), {}
    with switched_off(rule):
        for each in recorded:
            flights[each.name] = scored(each, *run_of(each, stage))
            gc.collect()
    totals, name = totals_of(list(flights.values())), "all rules" if rule is None else rule.name
    print(
        f"{name:32} {stage:9}",
        *(f"{key} {value}" for key, value in totals.items()),
        file=sys.stderr,
        flush=True,
    )
    return {**totals, "flights": flights, "cpu_s": round(time.process_time() - started)}


if __name__ == "__main__":
    main()

"""`sorvolo compare`: a later flight against the map; each change is printed as it is announced."""

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.markup import escape

from sorvolo.cli.options import (
    Again,
    Area,
    AsJson,
    Camera,
    Classes,
    EnoughLookedAt,
    GiveUp,
    GroundElevation,
    Inputs,
    Model,
    Offset,
    PlaceFormat,
    PlaceFormatOption,
    SiteOption,
    Telemetry,
    option,
    wanted_classes,
)
from sorvolo.cli.pdf import Pdf, write_pdfs
from sorvolo.cli.printing import (
    TO_CHECK,
    Console,
    announce_people,
    new_table,
    place_heading,
    place_words,
    print_json,
    read_json,
    show_notices_and_warnings,
    show_path,
    site_of,
)
from sorvolo.cli.progress import ProgressReport, Resumed, rate_words
from sorvolo.cli.sites import OpenedSite, ended_by_signal, opened_site, run_on_site
from sorvolo.paths import Json, JsonView
from sorvolo.survey.wording import area_text, counted, plural

if TYPE_CHECKING:
    from sorvolo.missions.mission import FlightOutcome, Mission
    from sorvolo.survey.findings import CompareUpdate

_COLOURS = {
    "appeared": "green",
    "disappeared": "red",
    "replaced": "yellow",
    "area": "blue",
    "moving": "cyan",
}
_MAX_ROWS, _MAX_REASONS = 40, 6
_MIN_GAP = 0.01  # of the compared ground: smaller gaps are in the report alone


MethodOption = Annotated[
    Literal["robust", "thesis"],
    option("robust: copes with light, shadows and wind. thesis: the baseline."),
]
MasksFolder = Annotated[Path | None, option("Folder for each frame's change mask and boxes.")]
StepsFolder = Annotated[
    Path | None,
    option("Folder for pictures of method thesis's eight steps (4-8 MB a view)."),
]
Votes = Annotated[
    int, option("Views, of the last two more, that must show a change.", min=1, max=6)
]
UpdatesMap = Annotated[
    bool,
    option("Update the map where the ground changed or is new.", "--update/--no-update"),
]
Sort = Annotated[
    Literal["importance", "size", "score"],
    option("Order of the printed changes; importance: people, vehicles, large things."),
]
Least = Annotated[
    float,
    option("Print only changes of this length or more, m, and what has a class.", min=0),
]
TrustsMap = Annotated[
    bool, option("Compare even with a map that contradicts itself.", "--trust-map")
]


def compare(
    inputs: Inputs,
    site: SiteOption,
    telemetry: Telemetry = None,
    camera: Camera = "",
    area: Area = None,
    method: MethodOption = "robust",
    votes: Votes = 3,
    offset: Offset = None,
    ground_elevation: GroundElevation = None,
    masks: MasksFolder = None,
    steps: StepsFolder = None,
    update: UpdatesMap = True,
    trust_map: TrustsMap = False,
    model: Model = "default",
    classes: Classes = None,
    enough_looked_at: EnoughLookedAt = 0.9,
    give_up: GiveUp = 30.0,
    sort: Sort = "importance",
    least: Least = 0.0,
    coordinates: PlaceFormatOption = "latlon",
    pdf: Pdf = False,
    again: Again = False,
    as_json: AsJson = False,
) -> None:
    """Find what appeared, disappeared, was replaced or moves since the map was made, and update the map.

    Live sources are those of `sorvolo map`. Ctrl-C ends a live flight and keeps its changes; a second Ctrl-C discards
    them. After a crash or a power cut, run the same command again: it continues where it was.

    Example: sorvolo compare DJI_0057.MP4 --site field

    Example: sorvolo compare photos/ --site field --masks masks --json
    """
    from sorvolo.capture.live.reconnect import LiveSettings
    from sorvolo.missions.compare.flights import compare_flights
    from sorvolo.missions.flight.settings import CompareSettings
    from sorvolo.missions.mission import is_good
    from sorvolo.store.atomic import make_folder, writing

    if masks is not None:
        make_folder(masks)
    thesis = None
    if method != "robust":
        from sorvolo.lab.thesis.changes import ThesisComparison

        thesis = ThesisComparison()
    settings = CompareSettings(
        thesis,
        votes=votes,
        voters=votes + 2,
        offset_s=offset,
        ground_elevation_m=ground_elevation,
        updates_map=update,
        writes_masks=masks is not None,
        model=model,
        trusts_map=trust_map,
        classes=wanted_classes(classes),
        enough_looked_at=enough_looked_at,
    )
    with opened_site(site, writes=True) as place:
        with ended_by_signal(inputs) as until:
            comparing = compare_flights(
                inputs,
                place.folder,
                settings,
                telemetry=telemetry,
                camera=camera or None,
                area=area,
                steps=steps,
                live=LiveSettings(keeps_all=True, give_up_s=give_up),
                until=until,
                again=again,
            )
            results = read_results(comparing, place, coordinates)
        if masks is not None:
            # Leave the masks that the site keeps of these flights in a folder as well, a folder for each flight
            with writing(masks):
                for result in results:
                    made = place.folder / "flights" / result["flight"] / "masks"
                    if made.is_dir():
                        shutil.copytree(made, masks / result["flight"], dirs_exist_ok=True)
        if as_json:
            print_json({"site": str(place.folder), "flights": results})
        else:
            show_results(results, place.folder, Console(), coordinates, sort, least)
        if pdf:
            folders = [place.folder / "flights" / result["flight"] for result in results]
            names = ("changes.html", "report.html")
            write_pdfs((each / name for each in folders for name in names), Console(stderr=as_json))
    if not all(is_good(result["comparison"]["headline"]) for result in results):
        raise typer.Exit(TO_CHECK)


def read_results(
    comparing: "Mission[CompareUpdate, tuple[FlightOutcome, ...]]",
    place: OpenedSite,
    form: PlaceFormat = "latlon",
) -> list[Json]:
    """Compare with progress and announcements on stderr; return the results of each flight.

    A result has the parts of the flight's report that people ask for, its changes, and the ids of those announced on
    the way and withdrawn in the end.
    """
    from sorvolo.store.exports.plain import features_path

    announced: list[str] = []

    def show(updates: "Iterator[CompareUpdate]") -> None:
        announced.extend(_show_progress(updates, place.folder, Console(stderr=True), form))

    results = []
    for folder in run_on_site(comparing, place, show, "compared"):
        report = read_json(folder / "report.json")
        changes = read_json(features_path(folder, "changes"))
        kept = {feature["properties"]["id"] for feature in changes["features"]}
        withdrawn = [
            change
            for change in announced
            if change.rpartition("-")[0] == report["flight"] and change not in kept
        ]
        shown = (
            "flight",
            "method",
            "comparison",
            "objects",
            "frames",
            "peak_memory_mb",
            "warnings",
            "notices",
        )
        results.append(
            {name: report[name] for name in shown}
            | {"seconds": report["seconds"]["total"], "changes": changes, "withdrawn": withdrawn}
        )
    return results


def show_results(
    results: Sequence[JsonView],
    site: Path,
    console: Console,
    form: PlaceFormat = "latlon",
    sort: str = "importance",
    least_m: float = 0.0,
) -> None:
    """Print what changed, what could not be compared, and where the files are."""
    from sorvolo.store.exports.plain import features_path

    for result in results:
        comparison, features = result["comparison"], result["changes"]["features"]
        dark = " (too dark: most changes would be missed)" if comparison.get("most_missed") else ""
        console.print(
            f"Flight {escape(result['flight'])}: {comparison['headline']['text']}{dark}",
            style="bold",
        )
        is_local = result["changes"].get("crs", "WGS84") is None  # no place on Earth, no metres
        if features:
            console.print(escape(comparison["in_short"]), soft_wrap=True)
            _show_changes(_in_rows(features, sort, least_m), console, form, is_local=is_local)
        views = comparison["views"]
        console.print(
            f"{views['compared']:,} of {counted(sum(views.values()), 'view')} compared in {result['seconds']:.1f} s; "
            f"memory at most {result['peak_memory_mb']:,.0f} MB",
        )
        _show_coverage(comparison["coverage"], console, is_local=is_local)
        extension = comparison.get("extension") or {}
        if extension.get("frames"):
            more = extension["shown_as_well"]
            same = f"; {counted(more, 'more frame')} {plural('shows', more)} the same ground"
            console.print(
                f"the map grew by {extension['area_m2']:,.0f} m2 from {counted(extension['frames'], 'frame')}"
                f"{same if more else ''}",
            )
        if result["withdrawn"]:
            console.print(
                f"withdrawn (not confirmed by the whole flight): {', '.join(result['withdrawn'])}",
                markup=False,
            )
        for reason, count in list(comparison["reasons"].items())[:_MAX_REASONS]:
            console.print(f"  {counted(count, 'view')}: {escape(reason)}")
        show_notices_and_warnings(result, console)
        announce_people(result, site, console, form)
        folder = site / "flights" / result["flight"]
        show_path("page", folder / "changes.html", console)
        show_path("list", features_path(folder, "changes"), console)
        show_path("report", folder / "report.html", console)
    show_path("map", site / "preview.png", console)


def _show_progress(
    updates: "Iterator[CompareUpdate]", folder: Path, console: Console, form: PlaceFormat
) -> list[str]:
    """Take all updates, printing each change as it is announced; return the ids of these."""
    announced: list[str] = []
    site, resumed = None, Resumed(console)
    with ProgressReport(console) as progress:
        progress.show("opening")
        for update in updates:
            resumed.take(update.views, is_resumed=update.is_resumed)
            announced += [change.id for change in update.announced]
            for change in () if update.is_resumed else update.announced:
                site = site or site_of(folder)
                unit, colour = "units" if site.is_local else "m", _COLOURS[change.kind]
                what = _class_words(change.kind, change.class_before, change.class_after)
                console.print(
                    f"[{colour}]{change.kind.value:>11}[/{colour}]  {escape(change.id)}: "
                    f"{what + ', ' if what else ''}{change.length_m:.1f} {unit} long, "
                    f"at {place_words(site, form)(change.centre_m)} (accuracy {change.sigma_m:.2f} {unit})",
                    soft_wrap=True,
                )
            compared = f"{update.compared:,} of {counted(update.views, 'view')} compared"
            progress.show(
                "looking for the flight, frame" if update.comes_again else "comparing, frame",
                update.frames_read,
                max(update.frames_expected, update.frames_read),
                f"{rate_words(update.frames_read, update.seconds)}{compared}, {counted(len(announced), 'change')}",
            )
        resumed.end()
    return announced


def _class_words(kind: str, before: str | None, after: str | None) -> str:
    """What stood there and stands there: "car", "car to person"; "" for changed ground."""
    words = " to ".join(escape(name) for name in (before, after) if name)
    return words or ("" if kind == "area" else "unknown object")


def _show_coverage(coverage: JsonView, console: Console, *, is_local: bool) -> None:
    """Print what kept ground from being compared, and how small a thing would be found on the rest."""
    from sorvolo.survey.coverage import GAP_WORDS, Gap

    for name, area in coverage["gaps_m2"].items():
        if area >= _MIN_GAP * coverage["compared_m2"]:
            console.print(
                f"  not compared: {area_text(area, is_local=is_local)}, {GAP_WORDS[Gap(name)]}",
            )
    if is_local:
        return
    plain_m, faint_m, large = coverage["smallest_m"], coverage["faint_m"], coverage["large_found"]
    if large is None:
        words = "too few: the smallest size that would be found is unknown"
    elif plain_m is None:
        words = f"only {large:.0%} of even the largest are found"
    else:
        faint = "faint ones are not found" if faint_m is None else f"faint ones from {faint_m:g} m"
        if not coverage["faint_known"]:
            faint = "too few faint ones were drawn to know"
        words = f"on half of the ground, plain ones are found from {plain_m:g} m; {faint}"
    console.print(f"test objects drawn into these views: {words}")


def _in_rows(features: Sequence[Any], sort: str, least_m: float) -> list[list[Any]]:
    """The groups of changes that are printed, each by rank, in the order asked for."""
    groups: dict[str, list[Any]] = {}
    for feature in sorted(features, key=lambda each: each["properties"]["rank"]):
        groups.setdefault(feature["properties"]["group"], []).append(feature)

    def is_shown(change: JsonView) -> bool:
        return bool(
            change["length_m"] >= least_m or change["class_before"] or change["class_after"]
        )

    rows = [
        each for each in groups.values() if any(is_shown(feature["properties"]) for feature in each)
    ]
    if column := {"size": "length_m", "score": "score"}.get(sort):
        rows.sort(key=lambda row: -max(each["properties"][column] for each in row))
    return rows


def _show_changes(
    rows: Sequence[Sequence[Any]], console: Console, form: PlaceFormat, *, is_local: bool
) -> None:
    from sorvolo.geometry.coordinates import Coordinates, place_text

    unit = "units" if is_local else "m"
    place_name = place_heading(is_local, form)
    table = new_table(
        *("id", "kind", f"length {unit}", place_name, f"accuracy {unit}", "views", "score"),
        whole=("id", "kind", place_name),
    )
    for feature, *others in rows[:_MAX_ROWS]:
        change = feature["properties"]
        # the middle of the outline's box: the place that pages, exports and `review` print
        xs, ys = zip(*(point[:2] for point in feature["geometry"]["coordinates"][0]))
        x, y = (min(xs) + max(xs)) / 2, (min(ys) + max(ys)) / 2
        what = _class_words(change["kind"], change["class_before"], change["class_after"])
        more = f"and {len(others)} more" if others else ""
        table.add_row(
            escape(change["id"]),
            "\n".join(filter(None, (change["kind"], what, more))),
            f"{change['length_m']:.2f}",
            f"{x:.1f}, {y:.1f}" if is_local else place_text(y, x, Coordinates(form)),
            f"{change['sigma_m']:.2f}",
            str(change["views"]),
            f"{change['score']:.2f}",
        )
    console.print(table)
    if len(rows) > _MAX_ROWS:
        console.print(f"and {len(rows) - _MAX_ROWS:,} more in changes.geojson")
    features = [each for row in rows for each in row]
    single = sum(bool(feature["properties"].get("single_view")) for feature in features)
    alone = f"; {counted(single, 'change')} by one view alone, where no other saw the ground"
    console.print(
        f"accuracy: 1 sigma; views: how many show it{alone if single else ''}; score: 0 to 1, how sure",
        style="dim",
    )

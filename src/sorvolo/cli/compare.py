"""`sorvolo compare`: a later flight against the map; each change is printed as it is announced."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from sorvolo.cli.exit_codes import TO_CHECK
from sorvolo.cli.map import ended_by_signal
from sorvolo.cli.options import (
    Again,
    Area,
    AsJson,
    Camera,
    GiveUp,
    GroundElevation,
    LiveTelemetry,
    Offset,
    PlaceFormat,
    PlaceFormatOption,
    wanted_classes,
)
from sorvolo.cli.places import place_heading, place_words
from sorvolo.cli.places_of_sites import Passing, not_sent, opened_site
from sorvolo.cli.progress import ProgressReport, Resumed, rate_words
from sorvolo.cli.shown import (
    newest_version,
    read_json,
    show_done,
    show_notices_and_warnings,
    show_path,
    site_of,
    unit_of,
)
from sorvolo.survey.wording import area_text, counted, plural

if TYPE_CHECKING:
    from sorvolo.capture.live.reconnect import LiveSettings
    from sorvolo.missions.flight.request import AlreadyDone
    from sorvolo.missions.flight.settings import CompareSettings
    from sorvolo.survey.findings import Change, CompareUpdate

_COLOURS = {
    "appeared": "green",
    "disappeared": "red",
    "replaced": "yellow",
    "area": "blue",
    "moving": "cyan",
}
_MOST_ROWS, _MOST_REASONS = 40, 6
_LEAST_SHOWN = 0.01  # of the compared ground: gaps smaller than that are in the report alone


class ChangeMethod(StrEnum):
    """How a frame is compared with the map."""

    ROBUST = "robust"
    THESIS = "thesis"


LaterFlights = Annotated[
    list[str],
    typer.Argument(help="Videos, folders of photos, photos, or live sources of a later flight."),
]
ComparedSite = Annotated[
    str, typer.Option(help="Folder of the map that an earlier flight made, or s3://BUCKET/NAME.")
]
MethodOption = Annotated[
    ChangeMethod,
    typer.Option(help="robust: copes with light, shadows and wind. thesis: the baseline."),
]
ViewsPerSecond = Annotated[
    float, typer.Option(help="Frames of a video compared per second of flight.")
]
Votes = Annotated[
    int, typer.Option(help="How many views must show a change before it is announced ...")
]
Voters = Annotated[int, typer.Option(help="... and of how many, the last ones of that ground.")]
WritesMasks = Annotated[
    bool, typer.Option("--masks", help="Also write each frame's change mask and boxes.")
]
StepsFolder = Annotated[
    Path | None,
    typer.Option(help="Folder for pictures of method thesis's eight steps (4-8 MB a view)."),
]
ThesisValues = Annotated[
    list[str] | None,
    typer.Option(
        help="A value of Table 4.2 for method thesis, such as T_gray=light, W_a=8x8, eq3.21=printed or threads=4. "
        "Can be repeated. See docs/thesis.md."
    ),
]
UpdatesMap = Annotated[
    bool,
    typer.Option("--update/--no-update", help="Update the map where the ground changed or is new."),
]
TrustsMap = Annotated[
    bool, typer.Option("--trust-map", help="Compare even with a map that contradicts itself.")
]
NamedClasses = Annotated[
    str | None,
    typer.Option(
        help="What to look for, with commas.", show_default="what the model usually reports"
    ),
]
NamingModel = Annotated[
    str, typer.Option(help="Detector that names what changed: a model's name, a file, or none.")
]


def compare(
    inputs: LaterFlights,
    site: ComparedSite,
    telemetry: LiveTelemetry = None,
    camera: Camera = "",
    area: Area = None,
    method: MethodOption = ChangeMethod.ROBUST,
    views_per_second: ViewsPerSecond = 5.0,
    votes: Votes = 3,
    voters: Voters = 5,
    offset: Offset = None,
    ground_elevation: GroundElevation = None,
    masks: WritesMasks = False,
    steps: StepsFolder = None,
    thesis: ThesisValues = None,
    update: UpdatesMap = True,
    trust_map: TrustsMap = False,
    model: NamingModel = "default",
    classes: NamedClasses = None,
    give_up: GiveUp = 30.0,
    coordinates: PlaceFormatOption = PlaceFormat.LATLON,
    again: Again = False,
    as_json: AsJson = False,
) -> None:
    """Find what appeared, disappeared, was replaced or moves since the map was made, and update the map.

    Live sources are those of `sorvolo map`. Ctrl-C ends a live flight and keeps its changes; a second Ctrl-C discards
    them. After a crash or a power cut, run the same command again: it continues where it was.

    Example: sorvolo compare DJI_0057.MP4 --site field

    Example: sorvolo compare photos/ --site field --masks --json
    """
    from sorvolo.capture.live.reconnect import LiveSettings
    from sorvolo.change.pair.thesis_options import thesis_options
    from sorvolo.missions.flight.settings import CompareSettings

    settings = CompareSettings(
        method.value,
        views_per_second,
        votes,
        voters,
        offset,
        ground_elevation,
        updates_map=update,
        writes_masks=masks,
        model=model,
        thesis=thesis_options(thesis or []),
        trusts_map=trust_map,
        classes=wanted_classes(classes),
    )
    with opened_site(site, writes=True) as place:
        results = compare_and_read_results(
            inputs,
            place.folder,
            settings,
            telemetry=telemetry,
            camera=camera or None,
            area=area,
            steps=steps,
            live=LiveSettings(keeps_all=True, give_up_s=give_up),
            form=coordinates,
            again=again,
            sent=place.sent,
        )
        if as_json:
            typer.echo(json.dumps({"site": str(place.folder), "flights": results}, indent=1))
        else:
            show_results(results, place.folder, Console(), coordinates)
    if any(each["comparison"]["headline"]["quality"] != "compared" for each in results):
        raise typer.Exit(TO_CHECK)


def compare_and_read_results(
    inputs: Sequence[Path | str],
    site: Path,
    settings: "CompareSettings",
    *,
    telemetry: Path | str | None = None,
    camera: str | None = None,
    area: Path | None = None,
    steps: Path | None = None,
    live: "LiveSettings | None" = None,
    form: PlaceFormat = PlaceFormat.LATLON,
    again: bool = False,
    sent: Passing = not_sent,
) -> list[dict[str, Any]]:
    """Compare with progress and announcements on stderr; report and changes of each flight, in order.

    `sent` sees the mission's updates and may send what a flight added.
    """
    from sorvolo.capture.live.reconnect import LiveSettings
    from sorvolo.missions.compare.flights import compare_flights
    from sorvolo.store.site.archive import Archive

    before = newest_version(site)
    with ended_by_signal(inputs) as until:
        comparing = sent(
            compare_flights(
                inputs,
                site,
                settings,
                telemetry=telemetry,
                camera=camera,
                area=area,
                steps=steps,
                live=live or LiveSettings(keeps_all=True),
                until=until,
                again=again,
            )
        )
        known: list[AlreadyDone] = []

        def noted() -> "Iterator[CompareUpdate]":
            known.extend((yield from comparing))

        # closed even when the bar is stopped: then the site is as it was
        with closing(comparing):
            announced = _show_progress(noted(), site, Console(stderr=True), form)
    show_done(known, "compared")
    with Archive.open(site, write=False) as archive:
        compared = [
            each.flight_id for each in archive.versions() if each.complete and each.id > before
        ]
        compared += [each.flight for each in known]
        return [_result(archive.flight_folder(flight_id), announced) for flight_id in compared]


def show_results(
    results: Sequence[Mapping[str, Any]],
    site: Path,
    console: Console,
    form: PlaceFormat = PlaceFormat.LATLON,
) -> None:
    """Print what changed, what could not be compared, and where the files are."""
    from sorvolo.store.exports.plain import features_path

    for result in results:
        _show_result(result, console, form)
        folder = site / "flights" / result["flight"]
        show_path("page", folder / "changes.html", console)
        show_path("list", features_path(folder, "changes"), console)
        show_path("report", folder / "report.html", console)
    show_path("map", site / "preview.png", console)


def _show_progress(
    updates: "Iterable[CompareUpdate]", folder: Path, console: Console, form: PlaceFormat
) -> list[str]:
    """Take all updates, printing each change as it is announced; the ids of these."""
    announced: list[str] = []
    words, resumed = None, Resumed(console)
    with ProgressReport(console) as progress:
        progress.show("opening")
        for update in updates:
            resumed.take(update.views, is_resumed=update.is_resumed)
            announced += [change.id for change in update.announced]
            for change in () if update.is_resumed else update.announced:
                words = words or _announcement(folder, form)
                console.print(words(change), highlight=False, soft_wrap=True)
            compared = f"{update.compared:,} of {counted(update.views, 'view')} compared"
            doing = "looking for the flight, frame" if update.comes_again else "comparing, frame"
            progress.show(
                doing,
                update.frames_read,
                max(update.frames_expected, update.frames_read),
                f"{rate_words(update.frames_read, update.seconds)}{compared}, {counted(len(announced), 'change')}",
            )
        resumed.end()
    return announced


def _announcement(folder: Path, form: PlaceFormat) -> "Callable[[Change], str]":
    """What is printed of a change when it is announced."""
    site = site_of(folder)
    unit, place = unit_of(site), place_words(site, form)

    def words(change: "Change") -> str:
        colour = _COLOURS[change.kind]
        what = _class_words(change.class_before, change.class_after)
        middle_m = (change.outline_m.min(axis=0) + change.outline_m.max(axis=0)) / 2
        return (
            f"[{colour}]{change.kind.value:>11}[/{colour}]  {escape(change.id)}: {what + ', ' if what else ''}"
            f"{change.length_m:.1f} {unit} long, at {place(middle_m)} "
            f"(accuracy {change.sigma_m:.2f} {unit})"
        )

    return words


def _class_words(before: str | None, after: str | None) -> str:
    """What stood there and stands there: "car", "car to person"."""
    return " to ".join(escape(name) for name in (before, after) if name)


def _result(folder: Path, announced: Sequence[str]) -> dict[str, Any]:
    """A flight's report and changes, and which changes were announced on the way and withdrawn in the end."""
    from sorvolo.store.exports.plain import features_path

    report = read_json(folder / "report.json")
    changes = read_json(features_path(folder, "changes"))
    kept = {feature["properties"]["id"] for feature in changes["features"]}
    withdrawn = [
        each
        for each in announced
        if each.rpartition("-")[0] == report["flight"] and each not in kept
    ]
    return {
        "flight": report["flight"],
        "method": report["method"],
        "comparison": report["comparison"],
        "frames": report["frames"],
        "seconds": report["seconds"]["total"],
        "peak_memory_mb": report["peak_memory_mb"],
        "warnings": report["warnings"],
        "notices": report["notices"],
        "changes": changes,
        "withdrawn": withdrawn,
    }


def _show_result(result: Mapping[str, Any], console: Console, form: PlaceFormat) -> None:
    comparison, features = result["comparison"], result["changes"]["features"]
    dark = " (too dark: most changes would be missed)" if comparison.get("most_missed") else ""
    console.print(
        f"Flight {escape(result['flight'])}: {comparison['headline']['text']}{dark}",
        style="bold",
        highlight=False,
    )
    is_local = result["changes"].get("crs", "WGS84") is None  # no place on Earth, no metres
    if features:
        _show_changes(features, console, form, is_local=is_local)
    views = comparison["views"]
    console.print(
        f"{views['compared']:,} of {counted(sum(views.values()), 'view')} compared in {result['seconds']:.1f} s; "
        f"memory at most {result['peak_memory_mb']:,.0f} MB",
        highlight=False,
    )
    _show_coverage(comparison["coverage"], console, is_local=is_local)
    extension = comparison.get("extension") or {}
    if extension.get("frames"):
        more = extension["shown_as_well"]
        console.print(
            f"the map grew by {extension['area_m2']:,.0f} m2 from {counted(extension['frames'], 'frame')}"
            + (
                f"; {counted(more, 'more frame')} {plural('shows', more)} the same ground"
                if more
                else ""
            ),
            highlight=False,
        )
    if result["withdrawn"]:
        console.print(
            f"withdrawn (not confirmed by the whole flight): {', '.join(result['withdrawn'])}",
            highlight=False,
            markup=False,
        )
    for reason, count in list(comparison["reasons"].items())[:_MOST_REASONS]:
        console.print(f"  {counted(count, 'view')}: {escape(reason)}", highlight=False)
    show_notices_and_warnings(result, console)


def _show_coverage(coverage: Mapping[str, Any], console: Console, *, is_local: bool) -> None:
    """What kept ground from being compared, and how small a thing would have been found on the rest."""
    from sorvolo.survey.coverage import GAP_WORDS, Gap

    gaps = {
        name: area
        for name, area in coverage["gaps_m2"].items()
        if area >= _LEAST_SHOWN * coverage["compared_m2"]
    }
    for name, area in gaps.items():
        console.print(
            f"  not compared: {area_text(area, is_local=is_local)}, {GAP_WORDS[Gap(name)]}",
            highlight=False,
        )
    if not is_local:
        console.print(
            f"test objects drawn into these views: {_size_words(coverage)}", highlight=False
        )


def _size_words(coverage: Mapping[str, Any]) -> str:
    """How small a thing is found in four of five pictures."""
    plain, faint, large = coverage["smallest_m"], coverage["faint_m"], coverage["large_found"]
    if large is None:
        return "too few: the smallest size that would be found is unknown"
    if plain is None:
        return f"only {large:.0%} of even the largest are found"
    faint_words = "faint ones are not found" if faint is None else f"faint ones from {faint:g} m"
    if not coverage["faint_known"]:
        faint_words = "of faint ones too few were drawn to know"
    return f"on half of the ground, plain ones are found from {plain:g} m; {faint_words}"


def _show_changes(
    features: Sequence[Any], console: Console, form: PlaceFormat, *, is_local: bool
) -> None:
    from sorvolo.geometry.coordinates import Coordinates, place_text

    unit = "units" if is_local else "m"
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    place_name = place_heading(is_local, form)
    for name in ("id", "kind", f"length {unit}", place_name, f"accuracy {unit}", "views", "score"):
        table.add_column(
            name,
            no_wrap=name in ("id", "kind", place_name),
            overflow="fold",
            min_width=max(map(len, name.split())),
        )
    for feature in features[:_MOST_ROWS]:
        each = feature["properties"]
        x, y = _middle(feature["geometry"]["coordinates"][0])
        what = _class_words(each["class_before"], each["class_after"])
        table.add_row(
            escape(each["id"]),
            f"{each['kind']}\n{what}" if what else str(each["kind"]),
            f"{each['length_m']:.2f}",
            f"{x:.1f}, {y:.1f}" if is_local else place_text(y, x, Coordinates(form.value)),
            f"{each['sigma_m']:.2f}",
            str(each["views"]),
            f"{each['score']:.2f}",
        )
    console.print(table)
    if len(features) > _MOST_ROWS:
        console.print(f"and {len(features) - _MOST_ROWS:,} more in changes.geojson")
    single = sum(bool(each["properties"].get("single_view")) for each in features)
    alone = (
        f"; {counted(single, 'change')} by one view alone, where no other saw the ground"
        if single
        else ""
    )
    console.print(
        f"accuracy: 1 sigma; views: how many show it{alone}; score: 0 to 1, how sure",
        style="dim",
        highlight=False,
    )


def _middle(ring: Sequence[Sequence[float]]) -> tuple[float, float]:
    """The middle of the box around an outline: the place that pages, exports and `review` print."""
    xs, ys = zip(*(each[:2] for each in ring))
    return (min(xs) + max(xs)) / 2, (min(ys) + max(ys)) / 2

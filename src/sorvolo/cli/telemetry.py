"""`sorvolo telemetry`: a mapped flight's telemetry corrected by its map, and in words what was wrong with it."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.markup import escape

from sorvolo.cli.options import (
    AsJson,
    Authority,
    Camera,
    Cot,
    CotCertificate,
    Flight,
    ResultsFolder,
    SiteOption,
    Telemetry,
    argument,
    option,
)
from sorvolo.cli.printing import Console, print_json, show_path
from sorvolo.cli.progress import show_progress
from sorvolo.cli.sites import OpenedSite, opened_site, run_on_site
from sorvolo.errors import InputError, SettingsError
from sorvolo.survey.wording import counted

if TYPE_CHECKING:
    from sorvolo.missions.telemetry.doctor import TelemetryOutcome


def telemetry_command(
    source: Annotated[
        str,
        argument(
            "A flight (video, folder of photos), with --site; or a map's folder, or s3://BUCKET/NAME."
        ),
    ],
    site: SiteOption = "",
    flight: Flight = "",
    telemetry: Telemetry = None,
    camera: Camera = "",
    detections: Annotated[
        Path | None,
        option(
            "Folder of this video's `sorvolo watch`: its detections go into the KLV (VMTI, MISB ST 0903)."
        ),
    ] = None,
    out: ResultsFolder = None,
    cot: Cot = "",
    cot_ca: Authority = None,
    cot_cert: CotCertificate = None,
    as_json: AsJson = False,
) -> None:
    """Correct a flight's telemetry by its map, and report what was wrong: compass, clock, heights.

    Writes geo.txt (OpenDroneMap), track.gpx, track.csv, cot.xml (Cursor on Target with the camera's field of view), and
    for a video the same pictures as a transport stream with corrected KLV (MISB ST 0601). Nothing is re-encoded.

    Example: sorvolo telemetry DJI_0042.MP4 --site field

    Example: sorvolo telemetry field --flight DJI_0042 --cot udp://239.2.3.1:6969
    """
    from sorvolo.missions.telemetry.doctor import (
        CotReceiver,
        chosen_flight,
        correct_telemetry,
    )
    from sorvolo.missions.watch.cot_sender import CotTls, check_cot, check_host, cot_place

    _check_source(source, site, has_own_options=bool(telemetry or camera or detections))
    tls = CotTls(cot_ca, cot_cert)
    check_cot(cot, tls)
    receiver = None
    if cot:  # checked before minutes of work
        receiver = CotReceiver(cot_place(cot), tls)
        check_host(receiver.place)
        tls.context()
    with opened_site(site or source, writes=bool(site)) as place:
        if site:
            flight = _map_if_new(Path(source), place, flight, telemetry or None, camera or None)
        chosen = chosen_flight(place.folder, flight)
        target = out or place.results("telemetry") / chosen
        outcome = correct_telemetry(
            place.folder,
            target,
            flight=chosen,
            source=Path(source) if site else None,
            telemetry=telemetry or None,
            camera=camera or None,
            cot=receiver,
            watched=detections,
        )
    if as_json:
        print_json({"folder": str(target), **outcome.report, "cot_sent": outcome.cot_sent})
    else:
        _show(outcome, Console())


def _check_source(source: str, site: str, *, has_own_options: bool) -> None:
    """Raise InputError or SettingsError unless `source` is a flight with --site, or a map without.

    `has_own_options` is whether --telemetry, --camera or --detections was given.
    """
    from sorvolo.store.site.catalogue_place import is_site

    ways = (
        "give a flight's video or folder of photos with --site FOLDER, or the folder of a map alone"
    )
    scheme = source.partition("://")[0] if "://" in source else ""
    if scheme and scheme not in ("s3", "file"):
        raise SettingsError(
            f"{scheme}:// is the address of a live stream, and only recorded telemetry can be corrected: {ways}"
        )
    if not scheme and not Path(source).exists():
        raise InputError(f"no such file or folder: {source}; {ways}")
    is_map = bool(scheme) or is_site(Path(source))
    if is_map and site:
        raise SettingsError(
            f"{source} is a map, and so is --site {site}: give the flight's video or folder of photos with --site, or "
            "the map alone, where it has several flights with --flight"
        )
    if not is_map and not site:
        raise SettingsError(
            f"{source} is no map: give the map that this flight is in, or is to be mapped into first, as --site FOLDER"
        )
    if is_map and has_own_options:
        raise SettingsError(
            f"{source} is a map, and --telemetry, --camera and --detections belong to a flight: give its video or folder of photos "
            f"with --site {source}"
        )


def _show(outcome: "TelemetryOutcome", console: Console) -> None:
    words = f"Telemetry of {escape(outcome.flight)}, {counted(outcome.frames, 'frame')}"
    console.print(words, style="bold")
    for sentence in outcome.sentences:
        console.print(f"  {sentence}", soft_wrap=True)
    for warning in outcome.warnings:
        console.print(f"[yellow]warning[/yellow]  {escape(warning)}")
    if outcome.cot_sent is not None:
        console.print(f"  {outcome.cot_sent} of {outcome.frames} Cursor on Target events sent")
    for path in outcome.paths.values():
        show_path("written", path, console)


def _map_if_new(
    source: Path, place: OpenedSite, wanted: str, telemetry: str | None, camera: str | None
) -> str:
    """Map the flight if the site has it under no name; return its name there, or `wanted` if that is given.

    Raises InputError where the site has no flight of the wanted name, and for a new flight without fixes.
    """
    from sorvolo.capture.source import opened_sources
    from sorvolo.missions.flight.settings import MapSettings
    from sorvolo.missions.flight.setup import known_flights
    from sorvolo.missions.map.flights import map_flights
    from sorvolo.missions.telemetry.doctor import mapped_flights

    mapped = mapped_flights(place.folder)
    if wanted:
        if wanted not in mapped:
            raise InputError(
                f"{place.address} has no flight {wanted!r}, only {', '.join(mapped) or 'none'}: leave --flight out, "
                f"and {source} is mapped into it"
            )
        return wanted
    known = known_flights(place.folder)
    with opened_sources([source], telemetry, camera, known) as (flight, *_):
        for name, fingerprint in mapped.items():
            if fingerprint == flight.fingerprint:
                return name
        if flight.name in mapped:
            return flight.name
        if not flight.telemetry.has_fixes:
            raise InputError(
                f"{source}: no telemetry with positions was found in it or beside it, and there is nothing to correct "
                "without: give its log with --telemetry FILE"
            )
        name = flight.name
    mapping = map_flights(
        [source], place.folder, MapSettings(model="none"), telemetry=telemetry, camera=camera
    )
    console = Console(stderr=True)
    run_on_site(mapping, place, lambda updates: show_progress(updates, console), "mapped")
    return name

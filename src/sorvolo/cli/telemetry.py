"""`sorvolo telemetry`: a mapped flight's telemetry corrected by its map, and in words what was wrong with it."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from sorvolo.cli.options import AsJson, Camera, CotAuthority, CotCertificate
from sorvolo.cli.places_of_sites import OpenedSite, opened_site
from sorvolo.cli.shown import show_path
from sorvolo.errors import InputError, SettingsError
from sorvolo.survey.wording import counted

if TYPE_CHECKING:
    from sorvolo.capture.source import Source
    from sorvolo.missions.telemetry.doctor import CotReceiver
    from sorvolo.missions.watch.cot_sender import CotTls

_Site = Annotated[
    str,
    typer.Option(
        help="Folder of the map that the flight is in or is mapped into first, or s3://BUCKET/NAME."
    ),
]
_Flight = Annotated[str, typer.Option(help="Flight of the map.", show_default="its only one")]
_Log = Annotated[str, typer.Option(help="The flight's log if it is not beside the video.")]
_Cot = Annotated[
    str,
    typer.Option(
        help="Send the track to a TAK server or team: udp://host:port, tcp://host:port, tls://host:port."
    ),
]
_Out = Annotated[
    Path | None, typer.Option(help="Folder for results.", show_default="SITE-telemetry/FLIGHT")
]


def telemetry_command(
    source: Annotated[
        str,
        typer.Argument(
            help="A flight (video, folder of photos), with --site; or a map's folder, or s3://BUCKET/NAME."
        ),
    ],
    site: _Site = "",
    flight: _Flight = "",
    telemetry: _Log = "",
    camera: Camera = "",
    out: _Out = None,
    cot: _Cot = "",
    cot_ca: CotAuthority = None,
    cot_cert: CotCertificate = None,
    as_json: AsJson = False,
) -> None:
    """Correct a flight's telemetry by its map, and report what was wrong: compass, clock, heights.

    Writes geo.txt (OpenDroneMap), track.gpx, track.csv, cot.xml (Cursor on Target with the camera's field of view), and
    for a video the same pictures as a transport stream with corrected KLV (MISB ST 0601). Nothing is encoded anew.

    Example: sorvolo telemetry DJI_0042.MP4 --site field

    Example: sorvolo telemetry field --flight DJI_0042 --cot udp://239.2.3.1:6969
    """
    from sorvolo.missions.telemetry.doctor import chosen_flight, correct_telemetry
    from sorvolo.missions.watch.cot_sender import CotTls

    _check_source(source, site, has_own_options=bool(telemetry or camera))
    tls = CotTls(cot_ca, cot_cert)
    if tls != CotTls() and not cot.startswith("tls://"):
        raise SettingsError("--cot-ca and --cot-cert are for --cot tls://host:port")
    receiver = _receiver(cot, tls) if cot else None
    with opened_site(site or source, writes=bool(site)) as place:
        of_source = _map_if_new(Path(source), place, flight, telemetry, camera) if site else flight
        chosen = chosen_flight(place.folder, of_source)
        target = out or place.results("telemetry") / chosen
        report = correct_telemetry(
            place.folder,
            target,
            flight=chosen,
            source=Path(source) if site else None,
            telemetry=telemetry or None,
            camera=camera or None,
            cot=receiver,
        )
    _print(report, target, as_json=as_json)


def _print(report: Mapping[str, Any], target: Path, *, as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps({"folder": str(target), **report}, indent=1))
    else:
        _show(report, target, Console())


def _check_source(source: str, site: str, *, has_own_options: bool) -> None:
    """Raise InputError or SettingsError unless it is a flight with --site, or a map without; `has_own_options`: given
    with it was what belongs to a flight."""
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
            f"{source} is a map, and --telemetry and --camera belong to a flight: give its video or folder of photos "
            f"with --site {source}"
        )


def _receiver(address: str, tls: "CotTls") -> "CotReceiver":
    """Who gets the track; checked before minutes of work."""
    from sorvolo.missions.telemetry.doctor import CotReceiver
    from sorvolo.missions.watch.cot_sender import check_host, cot_place

    receiver = CotReceiver(cot_place(address), tls)
    check_host(receiver.place)
    receiver.tls.context()
    return receiver


def _show(report: Mapping[str, Any], target: Path, console: Console) -> None:
    words = f"Telemetry of {escape(report['flight'])}, {counted(report['frames'], 'frame')}"
    console.print(words, style="bold", highlight=False)
    for sentence in report["sentences"]:
        console.print(f"  {sentence}", highlight=False, soft_wrap=True)
    for warning in report["warnings"]:
        console.print(f"[yellow]warning[/yellow]  {escape(warning)}", highlight=False)
    if report["cot_sent"] is not None:
        console.print(
            f"  {report['cot_sent']} of {report['frames']} Cursor on Target events sent",
            highlight=False,
        )
    for name in report["files"]:
        show_path("kept" if report["diagnosed_before"] else "written", target / name, console)


def _map_if_new(source: Path, place: OpenedSite, wanted: str, telemetry: str, camera: str) -> str:
    """Map the flight where the site does not have it yet, under any name; its name there, `wanted` if that is given.

    Raises InputError where the site has no flight of the wanted name, and for a new flight without fixes.
    """
    from sorvolo.capture.source import opened_sources
    from sorvolo.cli.map import map_and_read_reports
    from sorvolo.missions.flight.settings import MapSettings
    from sorvolo.missions.flight.setup import known_flights
    from sorvolo.missions.telemetry.doctor import mapped_flights

    mapped = mapped_flights(place.folder)
    if wanted:
        if wanted not in mapped:
            raise InputError(
                f"{place.address} has no flight {wanted!r}, only {', '.join(mapped) or 'none'}: leave --flight out, "
                f"and {source} is mapped into it"
            )
        return wanted
    with opened_sources(
        [source], telemetry or None, camera or None, known_flights(place.folder)
    ) as sources:
        name = next(
            (each for each, mark in mapped.items() if mark == sources[0].fingerprint),
            sources[0].name,
        )
        if name not in mapped:
            _check_fixes(sources[0], source)
    if name not in mapped:
        map_and_read_reports(
            [source],
            place.folder,
            MapSettings(model="none"),
            telemetry=telemetry or None,
            camera=camera or None,
            sent=place.sent,
        )
    return name


def _check_fixes(flight: "Source", source: Path) -> None:
    """Raise InputError for a flight that would be mapped in vain: without fixes there is nothing to correct."""
    if not flight.telemetry.has_fixes:
        raise InputError(
            f"{source}: no telemetry with positions was found in it or beside it, and there is nothing to correct "
            "without: give its log with --telemetry FILE"
        )

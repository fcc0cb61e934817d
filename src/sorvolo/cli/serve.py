"""`sorvolo serve` and `sorvolo token`: the ground station, and who may use it."""

import importlib.util
import json
import os
import threading
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sorvolo.cli.options import AsJson, Authority, Cot, CotCertificate, argument, option
from sorvolo.cli.printing import Console, new_table, print_json
from sorvolo.cli.sites import show_copy
from sorvolo.errors import InputError, SettingsError

if TYPE_CHECKING:
    from sorvolo.station.settings import StationSettings
    from sorvolo.station.tokens import TokenEntry

_NEEDED = ("fastapi", "uvicorn", "websockets", "titiler.core", "prometheus_client", "paho.mqtt")

Root = Annotated[
    str,
    argument("Folder that holds the sites, or s3://BUCKET/PREFIX; a site itself will do."),
]
Host = Annotated[
    str,
    option("Address to listen at; others than this machine's own need TLS and tokens."),
]
Port = Annotated[int, option("Port to listen at.")]
Certificate = Annotated[Path | None, option("TLS certificate, PEM.")]
Key = Annotated[Path | None, option("TLS key, PEM.")]
InsecureLan = Annotated[
    bool, option("Listen without TLS in a network that you trust.", "--insecure-lan")
]
Names = Annotated[
    list[str] | None, option("A host name that browsers use. Can be repeated.", "--name")
]
PublicUrl = Annotated[
    str,
    option(
        "Address of a TLS proxy on this machine before the station, such as https://maps.example."
    ),
]
BaseMap = Annotated[Path | None, option("Base map that pages show below the maps, PMTiles.")]
StreamFrom = Annotated[
    list[str] | None,
    option(
        "Network whose cameras the station may connect to, such as 192.168.1.0/24. Can be repeated."
    ),
]
Opens = Annotated[bool, option("Open the page in a browser.", "--open")]
Webhooks = Annotated[
    list[str] | None,
    option(
        "Web address to post new objects and changes to, signed (HMAC) by SORVOLO_WEBHOOK_SECRET if set. "
        "Can be repeated.",
        "--webhook",
    ),
]
Mqtt = Annotated[
    str,
    option(
        "MQTT broker: mqtt://HOST:PORT/PREFIX (port, prefix optional), mqtts://USER@HOST; password: "
        "SORVOLO_MQTT_PASSWORD."
    ),
]
LogJson = Annotated[
    bool, option("Log each request and fault as a line of JSON on stderr.", "--log-json")
]
TokenName = Annotated[
    str, argument("Who it is for, such as a person's name.", show_default="list tokens")
]
TokenRole = Annotated[str, option("view, review (also judge), or operate (also run missions).")]
Days = Annotated[float | None, option("Days until it expires.", show_default="never")]
Revoke = Annotated[bool, option("Revoke the token of this name.", "--revoke")]


def serve(
    root: Root,
    host: Host = "127.0.0.1",
    port: Port = 8750,
    tls_cert: Certificate = None,
    tls_key: Key = None,
    insecure_lan: InsecureLan = False,
    name: Names = None,
    stream_from: StreamFrom = None,
    public_url: PublicUrl = "",
    base_map: BaseMap = None,
    open_page: Opens = False,
    webhook: Webhooks = None,
    mqtt: Mqtt = "",
    mqtt_ca: Authority = None,
    cot: Cot = "",
    cot_ca: Authority = None,
    cot_cert: CotCertificate = None,
    log_json: LogJson = False,
) -> None:
    """Serve a folder of sites to browsers: the map while it grows, changes, objects, and what to do with them.

    Only this computer can reach it unless --host is given. Ctrl-C ends it; running missions continue.

    Example: sorvolo serve demo-site --open

    Example: sorvolo serve maps --host 0.0.0.0 --tls-cert cert.pem --tls-key key.pem

    Example: sorvolo serve maps --mqtt mqtt://192.168.1.5 --cot udp://239.2.3.1:6969

    Example: sorvolo serve s3://survey-archive
    """
    demand_extra()
    from sorvolo.missions.watch.cot_sender import CotTls
    from sorvolo.station.app import run_station
    from sorvolo.station.outward import OutwardSettings
    from sorvolo.station.settings import StationSettings

    # secrets come from the environment: every user of the machine sees arguments
    receivers = OutwardSettings(
        tuple(webhook or ()),
        os.environ.get("SORVOLO_WEBHOOK_SECRET", ""),
        mqtt,
        os.environ.get("SORVOLO_MQTT_PASSWORD", "") if mqtt else "",
        mqtt_ca,
        cot,
        CotTls(cot_ca, cot_cert),
    )
    with _served_folder(root) as folder:
        settings = StationSettings(
            folder,
            host,
            port,
            tls_cert,
            tls_key,
            insecure_lan,
            tuple(name or ()),
            tuple(stream_from or ()),
            public_url=public_url,
            base_map=base_map,
        )
        run_station(
            settings,
            lambda: _announce(settings, opens=open_page),
            receivers,
            logs_json=log_json,
        )


@contextmanager
def _served_folder(root: str) -> Iterator[Path]:
    """The folder of the sites; those of a store are kept in step with it meanwhile."""
    from sorvolo.missions.site.copy import folder_of
    from sorvolo.station.store_root import StoreRoot

    folder = folder_of(root)
    if folder is not None:
        _demand_folder(folder)
        yield folder
        return
    sites, over = StoreRoot(root), threading.Event()
    for name, fault in show_copy(sites.step(), "fetching, file").items():
        typer.echo(f"warning: {name}: {fault}", err=True)
    keeping = threading.Thread(target=sites.keep, args=(over,), name="store", daemon=True)
    keeping.start()
    try:
        yield sites.folder
    finally:
        over.set()
        keeping.join()


def token(
    root: Root,
    name: TokenName = "",
    role: TokenRole = "view",
    days: Days = None,
    revoke: Revoke = False,
    as_json: AsJson = False,
) -> None:
    """Make a token for a person or a program, list the tokens, or revoke one.

    A token is printed once; the station keeps a hash of it. From the first one on, everybody needs one.

    Example: sorvolo token maps "Ada" --role review
    """
    demand_extra()
    from sorvolo.station.settings import STATE_FOLDER
    from sorvolo.station.state import StationState
    from sorvolo.station.tokens import list_tokens, make_token, revoke_token

    if revoke and not name:
        raise SettingsError(
            "--revoke: of which token? give its name; without a name, tokens are listed"
        )
    state = StationState.open(_folder_of(root) / STATE_FOLDER)
    try:
        if revoke:
            revoke_token(state, name)
            typer.echo(json.dumps({"revoked": name}) if as_json else f"the token of {name} is void")
        elif name:
            made = make_token(state, name, role, days)
            typer.echo(json.dumps({"name": name, "role": role, "token": made}) if as_json else made)
        else:
            known = list_tokens(state)
            print_json(known) if as_json else _show_tokens(known)
    finally:
        state.close()


def _folder_of(root: str) -> Path:
    """Where the station of these sites keeps its own files."""
    from sorvolo.missions.site.copy import folder_of
    from sorvolo.station.store_root import StoreRoot

    folder = folder_of(root)
    if folder is None:
        return StoreRoot(root).folder
    _demand_folder(folder)
    return folder


def _announce(settings: "StationSettings", *, opens: bool) -> None:
    console = Console(stderr=True)
    where = (
        settings.address
        if not settings.public_url
        else f"{settings.public_url} (proxy to {settings.address})"
    )
    console.print(f"station at {where}", soft_wrap=True, markup=False)
    if not settings.is_loopback and settings.tls_cert is None:
        console.print(
            "[yellow]warning[/yellow]  without TLS: who listens in this network can read tokens and maps"
        )
    if opens:
        webbrowser.open(settings.address)


def _show_tokens(tokens: "list[TokenEntry]") -> None:
    if not tokens:
        typer.echo("no tokens: only this machine reaches the station, and needs none")
        return
    table = new_table("name", "role", "made (UTC)", "expires (UTC)")
    for each in tokens:
        table.add_row(each.name, each.role, each.made_at[:16], (each.expires_at or "never")[:16])
    Console().print(table)


def _demand_folder(root: Path) -> None:
    if not root.is_dir():
        raise InputError(f"no such folder: {root}; `sorvolo demo` makes one with a site in it")


def demand_extra() -> None:
    """Raise SettingsError where the packages of the station are not installed."""
    for name in _NEEDED:
        try:
            is_there = importlib.util.find_spec(name) is not None
        except ModuleNotFoundError:
            is_there = False
        if not is_there:
            raise SettingsError(
                "the station needs more packages; install them: pip install 'sorvolo[station]'"
            )

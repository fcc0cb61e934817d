"""Options that several commands share, each worded once."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from sorvolo.errors import SettingsError

Camera = Annotated[
    str,
    typer.Option(
        help="Camera: a calibration file, a drone's name such as 'Mavic 2 Pro', or aov=DEGREES."
    ),
]
Again = Annotated[
    bool,
    typer.Option(
        "--again", help="Do it anew, though the site has the flight already or a run was stopped."
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of tables.")]
AsJsonSteps = Annotated[bool, typer.Option("--json", help="Print one JSON object per step.")]
GroupPattern = Annotated[
    str | None,
    typer.Option(help="Regular expression; its group is the video's name in a picture's path."),
]
Area = Annotated[
    Path | None,
    typer.Option(help="Outline of the area: GeoJSON, KML, KMZ. Frames outside it are not used."),
]
LiveTelemetry = Annotated[
    str | None,
    typer.Option(
        help="The flight's log if it is not beside the video; for a live source, the receiver's address."
    ),
]
Offset = Annotated[
    float | None,
    typer.Option(help="Telemetry time minus video time, s. Without it: estimated from the motion."),
]
GroundElevation = Annotated[
    float | None,
    typer.Option(help="Elevation of the ground, m, in the telemetry's own height reference."),
]
CotAuthority = Annotated[
    Path | None, typer.Option(help="For tls://: the authority of the server's certificate, PEM.")
]
CotCertificate = Annotated[
    Path | None, typer.Option(help="For tls://: own certificate and its key in one PEM file.")
]
GiveUp = Annotated[
    float, typer.Option(help="End a live source after this many seconds without a picture.")
]


class PlaceFormat(StrEnum):
    """How places are written: the names of `geometry.coordinates.Coordinates`."""

    LATLON = "latlon"
    UTM = "utm"
    MGRS = "mgrs"


class Compression(StrEnum):
    """How a GeoTIFF is compressed: the names of `store.rasters.geotiff.COMPRESSIONS`."""

    DEFLATE = "deflate"
    JPEG = "jpeg"


PlaceFormatOption = Annotated[
    PlaceFormat, typer.Option("--coordinates", help="How places are written: latlon, utm or mgrs.")
]


def size_px(text: str) -> tuple[int, int] | None:
    """Width and height of "1920x1080"; None for no text. Raises SettingsError for anything else."""
    if not text:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) > 0 and int(height) > 0):
        raise SettingsError(f"--size {text!r}: give width x height in pixels, such as 1920x1080")
    return int(width), int(height)


def names(text: str) -> tuple[str, ...]:
    """The names in a list with commas."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def wanted_classes(text: str | None, option: str = "--classes") -> tuple[str, ...]:
    """The classes in a list with commas; none where the option is not given.

    Raises SettingsError where it is given and names none, such as by a variable of a shell that is not set.
    """
    found = names(text or "")
    if text is not None and not found:
        raise SettingsError(
            f"{option} {text!r} names no class; give some, separated by commas, or leave {option} out"
        )
    return found


def class_names(text: str | None) -> dict[str, str] | None:
    """ "Van=car,person" as {"Van": "car", "person": "person"}; None where the option is not given.

    Raises SettingsError for anything else, and as `wanted_classes`.
    """
    pairs = [each.partition("=") for each in wanted_classes(text)]
    if not all(theirs.strip() and (ours.strip() or not equals) for theirs, equals, ours in pairs):
        raise SettingsError(f"--classes {text!r}: give names as THEIRS=OURS, separated by commas")
    return {theirs.strip(): ours.strip() or theirs.strip() for theirs, _, ours in pairs} or None

"""Options that several commands share, each worded once, and what their texts mean."""

import re
from pathlib import Path
from typing import Annotated, Literal

import typer

from sorvolo.errors import SettingsError

Inputs = Annotated[
    list[str], typer.Argument(help="Videos, folders of photos, photos, or live sources.")
]
SiteArgument = Annotated[str, typer.Argument(help="Folder of the map, or s3://BUCKET/NAME.")]
SiteOption = Annotated[str, typer.Option("--site", help="Folder of the map, or s3://BUCKET/NAME.")]
Flight = Annotated[
    str, typer.Option(help="Flight of the map, by its name.", show_default="its newest or only one")
]
OnlyFlight = Annotated[str | None, typer.Option("--flight", help="Only this flight.")]
Telemetry = Annotated[
    str | None,
    typer.Option(
        help="The flight's log, or photos' geo.txt or Timestamp.MRK, if not beside the pictures; live: the receiver's address."
    ),
]
Camera = Annotated[
    str,
    typer.Option(
        help="Camera: a calibration file, a drone's name such as 'Mavic 2 Pro', or aov=DEGREES."
    ),
]
Area = Annotated[
    Path | None,
    typer.Option(help="Outline of the area: GeoJSON, KML, KMZ, .plan, or a list of corners."),
]
Offset = Annotated[
    float | None,
    typer.Option(
        help="Seconds to add to the pictures' time to get the log's: 7200 if the camera's clock is two hours behind.",
        show_default="from motion or clocks",
    ),
]
GroundElevation = Annotated[
    float | None,
    typer.Option(help="Elevation of the ground, m, in the telemetry's own height reference."),
]
Resolution = Annotated[
    float | None,
    typer.Option(
        "--gsd", help="Ground resolution of a new map, m a pixel.", show_default="the frames' own"
    ),
]
Model = Annotated[
    str, typer.Option(help="Detector: a name from `sorvolo models list`, a .onnx file, or none.")
]
Classes = Annotated[
    str | None,
    typer.Option(
        help="What to look for: person,car,small object.",
        show_default="what the model usually reports",
    ),
]
EnoughLookedAt = Annotated[
    float,
    typer.Option(help="Exit code 3 where a smaller share of the flown ground was looked at."),
]
FlightHeight = Annotated[
    float | None, typer.Option("--height", help="Flight height above ground, m.")
]
OutFile = Annotated[Path, typer.Option("--out", help="File to write.")]
OutFolder = Annotated[Path, typer.Option("--out", help="Folder for results.")]
GiveUp = Annotated[
    float, typer.Option(help="End a live source after this many seconds without a picture.")
]
Again = Annotated[
    bool, typer.Option("--again", help="Repeat the flight, and discard what a stopped run left.")
]
Refly = Annotated[
    list[Path] | None,
    typer.Option(
        help="Write waypoints over ground that was missed: .plan, .kmz (DJI), .geojson, .kml. Can be repeated."
    ),
]
DjiDrone = Annotated[
    str,
    typer.Option(
        help="For a .kmz: fly (DJI Fly), m300, m350, m30, m30t, m3e, m3t, m3m, m3d, m3td."
    ),
]
ResultsFolder = Annotated[
    Path | None, typer.Option("--out", help="Folder for results.", show_default="beside the input")
]
Cot = Annotated[
    str,
    typer.Option(
        help="Send objects or the track to TAK: udp://host:port, tcp://host:port, tls://host:port."
    ),
]
Authority = Annotated[Path | None, typer.Option(help="Authority of the server's certificate, PEM.")]
CotCertificate = Annotated[
    Path | None, typer.Option(help="For tls://: own certificate and its key in one PEM file.")
]
AlertCommand = Annotated[
    str,
    typer.Option(
        help="Program to run for each object; {flight} {id} {class} {score} {latitude} {longitude} {time} {crop}."
    ),
]
AlertUrl = Annotated[str, typer.Option(help="Post each new object to this web address as JSON.")]
SearchRate = Annotated[
    float | None,
    typer.Option(
        help="Frames searched per second of flight.", show_default="10; live: as many as possible"
    ),
]
LeastScore = Annotated[
    float | None,
    typer.Option(help="Lowest score to report, 0 to 1.", show_default="each class's own"),
]
CatalogueAddress = Annotated[
    str,
    typer.Option(
        help="Database of a new map or index: postgresql://USER@HOST/DATABASE with PostGIS, or sqlite.",
        show_default="a file in the folder",
    ),
]
Truth = Annotated[
    Path | None, typer.Option(help="Folder that `sorvolo simulate` made, or of true change masks.")
]
Seed = Annotated[int | None, typer.Option(help="Random seed; the same seed gives the same result.")]
LabelClasses = Annotated[
    str | None,
    typer.Option("--classes", help="Class names of the labels as ours: Pedestrian=person,Van=car."),
]
IgnoredClasses = Annotated[
    str, typer.Option("--ignore", help="Class names whose boxes are ignored: Bicycle,DontCare.")
]
UnlabelledClasses = Annotated[
    str,
    typer.Option(
        "--unlabelled", help="Our classes that the pictures may show without a label: person."
    ),
]
GroupPattern = Annotated[
    str | None,
    typer.Option(help="Regular expression; its group is the video's name in a picture's path."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")]


PlaceFormat = Literal["latlon", "utm", "mgrs"]
PlaceFormatOption = Annotated[
    PlaceFormat, typer.Option("--coordinates", help="How places are written: latlon, utm or mgrs.")
]


SaveOption = Annotated[
    Literal["none", "video", "pictures"],
    typer.Option("--save", help="Keep the frames with the objects drawn in."),
]


def size_px(text: str) -> tuple[int, int] | None:
    """Width and height of "1920x1080"; None for no text. Raises SettingsError for anything else."""
    if not text:
        return None
    if not (size := re.fullmatch(r"([1-9]\d{1,4})x([1-9]\d{1,4})", text, re.ASCII | re.IGNORECASE)):
        raise SettingsError(f"--size {text!r}: give width x height in pixels, such as 1920x1080")
    return int(size[1]), int(size[2])


def names(text: str) -> tuple[str, ...]:
    """The names in a list with commas."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def wanted_classes(text: str | None, option: str = "--classes") -> tuple[str, ...]:
    """The classes in a list with commas; none where the option is not given.

    Raises SettingsError for a given option without a class, such as an unset shell variable.
    """
    classes = names(text or "")
    if text is not None and not classes:
        raise SettingsError(
            f"{option} {text!r} names no class; give some, separated by commas, or leave {option} out"
        )
    return classes


def class_names(text: str | None) -> dict[str, str] | None:
    """ "Van=car,person" as {"Van": "car", "person": "person"}; None where the option is not given.

    Raises SettingsError for anything else, and as `wanted_classes`.
    """
    pairs = [pair.partition("=") for pair in wanted_classes(text)]
    if not all(theirs.strip() and (ours.strip() or not equals) for theirs, equals, ours in pairs):
        raise SettingsError(f"--classes {text!r}: give names as THEIRS=OURS, separated by commas")
    return {theirs.strip(): ours.strip() or theirs.strip() for theirs, _, ours in pairs} or None

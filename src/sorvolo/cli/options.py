"""Options that several commands share, each worded once, and what their texts mean."""

import re
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from sorvolo.errors import SettingsError


def option(words: str, *names: str, **more: Any) -> Any:
    """An option by its help; `names` where it is called other than its parameter."""
    return typer.Option(*names, help=words, **more)


def argument(words: str, **more: Any) -> Any:
    """An argument by its help."""
    return typer.Argument(help=words, **more)


Inputs = Annotated[list[str], argument("Videos, folders of photos, photos, or live sources.")]
SiteArgument = Annotated[str, argument("Folder of the map, or s3://BUCKET/NAME.")]
SiteOption = Annotated[str, option("Folder of the map, or s3://BUCKET/NAME.", "--site")]
Flight = Annotated[
    str, option("Flight of the map, by its name.", show_default="its newest or only one")
]
OnlyFlight = Annotated[str | None, option("Only this flight.", "--flight")]
Telemetry = Annotated[
    str | None,
    option(
        "The flight's log, or photos' geo.txt or Timestamp.MRK, if not beside the pictures; live: the receiver's address."
    ),
]
Camera = Annotated[
    str,
    option("Camera: a calibration file, a drone's name such as 'Mavic 2 Pro', or aov=DEGREES."),
]
Area = Annotated[
    Path | None,
    option("Outline of the area: GeoJSON, KML, KMZ, .plan, or a list of corners."),
]
Offset = Annotated[
    float | None,
    option(
        "Seconds to add to the pictures' time to get the log's: 7200 if the camera's clock is two hours behind.",
        show_default="from motion or clocks",
    ),
]
GroundElevation = Annotated[
    float | None,
    option("Elevation of the ground, m, in the telemetry's own height reference."),
]
Resolution = Annotated[
    float | None,
    option("Ground resolution of a new map, m a pixel.", "--gsd", show_default="the frames' own"),
]
Model = Annotated[
    str, option("Detector: a name from `sorvolo models list`, a .onnx file, or none.")
]
Classes = Annotated[
    str | None,
    option(
        "What to look for: person,car,small object.", show_default="what the model usually reports"
    ),
]
EnoughLookedAt = Annotated[
    float,
    option("Exit code 3 where a smaller share of the flown ground was looked at."),
]
FlightHeight = Annotated[float | None, option("Flight height above ground, m.", "--height")]
OutFile = Annotated[Path, option("File to write.", "--out")]
OutFolder = Annotated[Path, option("Folder for results.", "--out")]
GiveUp = Annotated[float, option("End a live source after this many seconds without a picture.")]
Again = Annotated[
    bool, option("Repeat the flight, and discard what a stopped run left.", "--again")
]
Refly = Annotated[
    list[Path] | None,
    option(
        "Write waypoints over ground that was missed: .plan, .kmz (DJI), .geojson, .kml. Can be repeated."
    ),
]
DjiDrone = Annotated[
    str,
    option("For a .kmz: fly (DJI Fly), m300, m350, m30, m30t, m3e, m3t, m3m, m3d, m3td."),
]
ResultsFolder = Annotated[
    Path | None, option("Folder for results.", "--out", show_default="beside the input")
]
Cot = Annotated[
    str,
    option("Send objects or the track to TAK: udp://host:port, tcp://host:port, tls://host:port."),
]
Authority = Annotated[Path | None, option("Authority of the server's certificate, PEM.")]
CotCertificate = Annotated[
    Path | None, option("For tls://: own certificate and its key in one PEM file.")
]
AlertCommand = Annotated[
    str,
    option(
        "Program to run for each object; {flight} {id} {class} {score} {latitude} {longitude} {time} {crop}."
    ),
]
AlertUrl = Annotated[str, option("Post each new object to this web address as JSON.")]
SearchRate = Annotated[
    float | None,
    option("Frames searched per second of flight.", show_default="10; live: as many as possible"),
]
LeastScore = Annotated[
    float | None,
    option("Lowest score to report, 0 to 1.", show_default="each class's own"),
]
CatalogueAddress = Annotated[
    str,
    option(
        "Database of a new map or index: postgresql://USER@HOST/DATABASE with PostGIS, or sqlite.",
        show_default="a file in the folder",
    ),
]
Truth = Annotated[
    Path | None, option("Folder that `sorvolo simulate` made, or of true change masks.")
]
Seed = Annotated[int | None, option("Random seed; the same seed gives the same result.")]
LabelClasses = Annotated[
    str | None,
    option("Class names of the labels as ours: Pedestrian=person,Van=car.", "--classes"),
]
IgnoredClasses = Annotated[
    str, option("Class names whose boxes are ignored: Bicycle,DontCare.", "--ignore")
]
UnlabelledClasses = Annotated[
    str,
    option("Our classes that the pictures may show without a label: person.", "--unlabelled"),
]
GroupPattern = Annotated[
    str | None,
    option("Regular expression; its group is the video's name in a picture's path."),
]
AsJson = Annotated[bool, option("Print JSON instead of tables.", "--json")]


PlaceFormat = Literal["latlon", "utm", "mgrs"]
PlaceFormatOption = Annotated[
    PlaceFormat, option("How places are written: latlon, utm or mgrs.", "--coordinates")
]


SaveOption = Annotated[
    Literal["none", "video", "pictures"],
    option("Keep the frames with the objects drawn in.", "--save"),
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

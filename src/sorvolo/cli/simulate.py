"""`sorvolo simulate`: flights over a synthetic site whose truth is known."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from sorvolo.cli.options import AsJsonSteps, size_px
from sorvolo.cli.progress import ProgressReport
from sorvolo.errors import SettingsError
from sorvolo.survey.wording import counted

if TYPE_CHECKING:
    from sorvolo.lab.simulate.site import SimulationProgress
    from sorvolo.lab.simulation.pictures import PictureSettings
    from sorvolo.lab.simulation.settings import SimulationSettings

SimulationFolder = Annotated[
    Path, typer.Argument(help="Folder to make; an earlier simulation in it is replaced.")
]
PresetName = Annotated[
    str, typer.Option("--preset", help="What to simulate; --list-presets lists them.")
]
SeedOption = Annotated[
    int | None, typer.Option(help="Random seed; the same seed gives the same flights.")
]
Ground = Annotated[
    str, typer.Option(help="Ground: dirt, countryside, urban, sand, or an orthophoto's file.")
]
GroundResolution = Annotated[
    float | None, typer.Option(help="Ground resolution of an orthophoto without a CRS, m a pixel.")
]
ReliefHeight = Annotated[
    float | None,
    typer.Option(
        "--relief", help="Hills, from the lowest to the highest ground, m. Without it: level."
    ),
]
FlightCount = Annotated[
    int | None, typer.Option(help="Number of flights; between them things change.")
]
GpsNoise = Annotated[float | None, typer.Option(help="GPS noise of each fix and axis, m rms.")]
GpsRate = Annotated[
    float | None, typer.Option(help="GPS fixes a second.", show_default="the format's own")
]
ClockOffset = Annotated[float | None, typer.Option(help="Telemetry clock minus video clock, s.")]
TelemetryFormat = Annotated[
    str, typer.Option(help="Telemetry format: csv, srt, nmea, gpx, all or none.")
]
FaultCount = Annotated[
    int, typer.Option(help="Number of gaps, jumps, 0/0 fixes and bad checksums each.")
]
FlightHeight = Annotated[float | None, typer.Option(help="Flight height above ground, m.")]
GroundSpeed = Annotated[float | None, typer.Option(help="Ground speed, m/s.")]
StripLength = Annotated[float | None, typer.Option(help="Length of a strip, m.")]
StripCount = Annotated[int | None, typer.Option(help="Number of strips.")]
Tilt = Annotated[float | None, typer.Option(help="Roll and pitch of the drone, deg rms.")]
FrameRate = Annotated[float | None, typer.Option(help="Video frames a second.")]
PictureSize = Annotated[str, typer.Option(help="Picture size, such as 1280x720.")]
AsPhotos = Annotated[
    bool, typer.Option("--photos", help="Write geo-tagged JPEG photos instead of a video.")
]
PictureCount = Annotated[
    int | None,
    typer.Option(
        help="Make this many single labelled pictures (COCO) of different sites instead of flights."
    ),
]
ThermalShare = Annotated[
    float, typer.Option(help="With --pictures: share of thermal pictures, 0 to 1.")
]


def _print_presets(wanted: bool) -> None:
    from sorvolo.lab.simulation.presets import preset_names

    if wanted:
        typer.echo("\n".join(preset_names()))
        raise typer.Exit


ListPresets = Annotated[
    bool,
    typer.Option(
        "--list-presets", callback=_print_presets, is_eager=True, help="List the presets and stop."
    ),
]


def simulate(
    folder: SimulationFolder,
    preset_name: PresetName = "demo",
    seed: SeedOption = None,
    ground: Ground = "",
    ground_gsd: GroundResolution = None,
    relief: ReliefHeight = None,
    flights: FlightCount = None,
    gps_noise: GpsNoise = None,
    gps_rate: GpsRate = None,
    clock_offset: ClockOffset = None,
    telemetry: TelemetryFormat = "",
    faults: FaultCount = 0,
    height: FlightHeight = None,
    speed: GroundSpeed = None,
    length: StripLength = None,
    strips: StripCount = None,
    tilt: Tilt = None,
    fps: FrameRate = None,
    size: PictureSize = "",
    photos: AsPhotos = False,
    pictures: PictureCount = None,
    thermal: ThermalShare = 0.0,
    list_presets: ListPresets = False,
    as_json: AsJsonSteps = False,
) -> None:
    """Simulate flights: video or photos, telemetry, and the truth about every frame and object.

    Example: sorvolo simulate demo-site --preset demo

    Example: sorvolo simulate town --preset survey --ground urban --photos --gps-noise 0.5 --telemetry all

    Example: sorvolo simulate labelled --pictures 500 --thermal 0.3 --seed 7
    """
    from sorvolo.lab.simulation.presets import preset

    ground_file = _ground_file(ground)
    ground_kind = ground if ground_file is None else "orthophoto"
    if pictures is None and thermal:
        raise SettingsError(
            "--thermal is for single pictures: give their number with --pictures as well"
        )
    if pictures is not None:
        _refuse_options_of_flights(
            {
                "--preset": preset_name != "demo",
                "--relief": relief,
                "--flights": flights,
                "--gps-noise": gps_noise,
                "--gps-rate": gps_rate,
                "--clock-offset": clock_offset,
                "--telemetry": telemetry,
                "--speed": speed,
                "--faults": faults or None,
                "--length": length,
                "--strips": strips,
                "--tilt": tilt,
                "--fps": fps,
                "--size": size,
                "--photos": photos,
            }
        )
        asked = _picture_settings(pictures, seed, ground_kind, thermal, height)
        _simulate_pictures(folder, asked, ground_file, ground_gsd, as_json)
        return
    settings = _with_options(
        preset(preset_name),
        top={"seed": seed, "flights": flights},
        scene={"ground": ground_kind or None, "relief_m": relief},
        path={"height_m": height, "speed_m_s": speed, "length_m": length, "strips": strips},
        motion={"tilt_rms_deg": tilt},
        imaging={"fps": fps, **_size(size)},
        sensor=_sensor_options(gps_noise, gps_rate, clock_offset, faults),
        output={"telemetry": telemetry or None, "photos": photos or None},
    )
    _simulate_flights(folder, settings, ground_file, ground_gsd, as_json)


def _ground_file(ground: str) -> Path | None:
    """The orthophoto's file; None where `ground` names a kind of ground, or nothing."""
    from sorvolo.lab.simulation.ground import GroundKind

    if not ground or ground in list(GroundKind):
        return None
    if not Path(ground).exists():
        raise SettingsError(f"--ground {ground}: no such file, and none of {', '.join(GroundKind)}")
    return Path(ground)


def _refuse_options_of_flights(options: Mapping[str, object]) -> None:
    """Raises SettingsError where one was given: None, False and no text are options that were not given."""
    given = [
        name
        for name, value in options.items()
        if value is not None and value is not False and value != ""
    ]
    if given:
        raise SettingsError(
            f"--pictures makes single pictures, not flights: leave out {', '.join(given)}"
        )


def _picture_settings(
    pictures: int, seed: int | None, ground_kind: str, thermal: float, height_m: float | None
) -> "PictureSettings":
    from sorvolo.lab.simulation.pictures import PictureSettings

    settings = PictureSettings(pictures, 1 if seed is None else seed, ground_kind, thermal)
    return settings if height_m is None else replace(settings, height_m=(height_m, height_m))


def _simulate_pictures(
    folder: Path,
    settings: "PictureSettings",
    ground_file: Path | None,
    ground_gsd: float | None,
    as_json: bool,
) -> None:
    from sorvolo.lab.simulate.pictures import simulate_pictures

    last = None
    console = Console()
    with ProgressReport(Console(stderr=True), stays=True) as progress:
        for last in simulate_pictures(folder, settings, ground_file, ground_gsd):
            progress.show("simulating pictures", last.pictures_done, settings.pictures)
    if last is not None and as_json:
        typer.echo(json.dumps(asdict(last)))
    elif last is not None:
        pictures, boxes = counted(last.pictures_done, "picture"), counted(last.boxes, "box")
        console.print(
            f"{pictures} with {boxes} in {last.seconds:.0f} s: {folder}",
            highlight=False,
            soft_wrap=True,
        )


def _simulate_flights(
    folder: Path,
    settings: "SimulationSettings",
    ground_file: Path | None,
    ground_gsd: float | None,
    as_json: bool,
) -> None:
    from sorvolo.lab.simulate.site import simulate_site

    steps = simulate_site(folder, settings, ground_file, ground_gsd)
    if not as_json:
        _show(steps, folder)
        return
    for step in steps:
        if step.stage != "frames" or step.frames_done == step.frames_total:
            typer.echo(json.dumps(asdict(step)))


def _sensor_options(
    gps_noise_m: float | None, gps_rate_hz: float | None, clock_offset_s: float | None, faults: int
) -> dict[str, object]:
    """The fields of SensorSettings; None for an option that was not given."""
    kinds = ("gaps", "jumps", "zero_fixes", "bad_checksums") if faults else ()
    return {
        "noise_m": None if gps_noise_m is None else (gps_noise_m,) * 3,
        "rate_hz": gps_rate_hz,
        "clock_offset_s": clock_offset_s,
        **dict.fromkeys(kinds, faults),
    }


def _with_options(
    settings: "SimulationSettings", top: dict[str, object], **parts: dict[str, object]
) -> "SimulationSettings":
    """The settings with every option that was given; None was not."""
    for name, options in parts.items():
        given = {key: value for key, value in options.items() if value is not None}
        settings = replace(settings, **{name: replace(getattr(settings, name), **given)})
    return replace(settings, **{key: value for key, value in top.items() if value is not None})  # type: ignore[arg-type]


def _size(text: str) -> dict[str, object]:
    size = size_px(text)
    return {} if size is None else {"width_px": size[0], "height_px": size[1]}


def _show(steps: Iterator["SimulationProgress"], folder: Path) -> None:
    console, last = Console(), None
    with ProgressReport(Console(stderr=True), stays=True) as progress:
        for last in steps:
            if last.stage == "frames":
                progress.show(
                    f"simulating {last.flight}, frame", last.frames_done, last.frames_total
                )
    if last is not None:
        made = counted(last.frames_done, "frame")
        console.print(f"{made} in {last.seconds:.0f} s: {folder}", highlight=False, soft_wrap=True)
        truth, camera = folder / "truth", folder / "camera.xml"
        console.print(
            f"the truth is in {truth}; the camera is in {camera}", highlight=False, soft_wrap=True
        )

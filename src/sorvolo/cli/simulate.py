"""`sorvolo simulate`: flights over a synthetic site whose truth is known."""

import json
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from sorvolo.cli.options import size_px
from sorvolo.cli.progress import ProgressReport
from sorvolo.errors import SettingsError
from sorvolo.survey.wording import counted

if TYPE_CHECKING:
    from sorvolo.missions.simulate.site import SimulationProgress
    from sorvolo.simulation.pictures import PictureSettings
    from sorvolo.simulation.settings import SimulationSettings


def simulate(
    folder: Annotated[Path, typer.Argument(help="Folder to make; an earlier simulation in it is replaced.")],
    preset_name: Annotated[
        str, typer.Option("--preset", help="What to simulate; --list-presets lists them.")
    ] = "demo",
    seed: Annotated[int | None, typer.Option(help="Random seed; the same seed gives the same flights.")] = None,
    ground: Annotated[
        str, typer.Option(help="Ground: dirt, countryside, urban, sand, or an orthophoto's file.")
    ] = "",
    ground_gsd: Annotated[
        float | None, typer.Option(help="Ground resolution of an orthophoto without a CRS, m a pixel.")
    ] = None,
    flights: Annotated[int | None, typer.Option(help="Number of flights; between them things change.")] = None,
    gps_noise: Annotated[float | None, typer.Option(help="GPS noise of each fix and axis, m rms.")] = None,
    gps_rate: Annotated[float | None, typer.Option(help="GPS fixes a second.", show_default="the format's own")] = None,
    clock_offset: Annotated[
        float | None, typer.Option(help="Telemetry clock minus video clock, s.")
    ] = None,
    telemetry: Annotated[str, typer.Option(help="Telemetry format: csv, srt, nmea, gpx, all or none.")] = "",
    faults: Annotated[int, typer.Option(help="Number of gaps, jumps, 0/0 fixes and bad checksums each.")] = 0,
    height: Annotated[float | None, typer.Option(help="Flight height above ground, m.")] = None,
    speed: Annotated[float | None, typer.Option(help="Ground speed, m/s.")] = None,
    length: Annotated[float | None, typer.Option(help="Length of a strip, m.")] = None,
    strips: Annotated[int | None, typer.Option(help="Number of strips.")] = None,
    tilt: Annotated[float | None, typer.Option(help="Roll and pitch of the drone, deg rms.")] = None,
    fps: Annotated[float | None, typer.Option(help="Video frames a second.")] = None,
    size: Annotated[str, typer.Option(help="Picture size, such as 1280x720.")] = "",
    photos: Annotated[
        bool, typer.Option("--photos", help="Write geo-tagged JPEG photos instead of a video.")
    ] = False,
    pictures: Annotated[
        int | None,
        typer.Option(help="Make this many single labelled pictures (COCO) of different sites instead of flights."),
    ] = None,
    thermal: Annotated[float, typer.Option(help="With --pictures: share of thermal pictures, 0 to 1.")] = 0.0,
    list_presets: Annotated[bool, typer.Option("--list-presets", help="List the presets and stop.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object per step.")] = False,
) -> None:
    """Simulate flights: video or photos, telemetry, and the truth about every frame and object.

    Example: sorvolo simulate demo-site --preset demo

    Example: sorvolo simulate town --preset survey --ground urban --photos --gps-noise 0.5 --telemetry all

    Example: sorvolo simulate labelled --pictures 500 --thermal 0.3 --seed 7
    """
    from sorvolo.missions.simulate.site import simulate_site
    from sorvolo.simulation.ground import GroundKind
    from sorvolo.simulation.pictures import PictureSettings
    from sorvolo.simulation.presets import preset, preset_names

    if list_presets:
        typer.echo("\n".join(preset_names()))
        return
    ground_file = None if not ground or ground in list(GroundKind) else Path(ground)
    if ground_file is not None and not ground_file.exists():
        raise SettingsError(f"--ground {ground}: no such file, and none of {', '.join(GroundKind)}")
    if pictures is None and thermal:
        raise SettingsError("--thermal is for single pictures: give their number with --pictures as well")
    if pictures is not None:
        of_flights = {
            "--preset": preset_name != "demo", "--flights": flights, "--gps-noise": gps_noise, "--gps-rate": gps_rate,
            "--clock-offset": clock_offset, "--telemetry": telemetry, "--faults": faults or None, "--speed": speed,
            "--length": length, "--strips": strips, "--tilt": tilt, "--fps": fps, "--size": size, "--photos": photos,
        }
        given = [name for name, value in of_flights.items() if value is not None and value is not False and value != ""]
        if given:
            raise SettingsError(f"--pictures makes single pictures, not flights: leave out {', '.join(given)}")
        wanted = PictureSettings(
            pictures, 1 if seed is None else seed, ground if ground_file is None else "orthophoto", thermal
        )
        if height is not None:
            wanted = replace(wanted, height_m=(height, height))
        _picture_folder(folder, wanted, ground_file, ground_gsd, as_json)
        return
    settings = preset(preset_name)
    if ground:
        kind = ground if ground_file is None else "orthophoto"
        settings = replace(settings, scene=replace(settings.scene, ground=kind))
    settings = _with_options(
        settings,
        top={"seed": seed, "flights": flights},
        path={"height_m": height, "speed_m_s": speed, "length_m": length, "strips": strips},
        motion={"tilt_rms_deg": tilt},
        imaging={"fps": fps, **_size(size)},
        sensor={
            "noise_m": None if gps_noise is None else (gps_noise,) * 3, "rate_hz": gps_rate,
            "clock_offset_s": clock_offset,
            **(dict.fromkeys(("gaps", "jumps", "zero_fixes", "bad_checksums"), faults) if faults else {}),
        },
        output={"telemetry": telemetry or None, "photos": photos or None},
    )
    steps = simulate_site(folder, settings, ground_file, ground_gsd)
    if as_json:
        for step in steps:
            if step.stage != "frames" or step.frames_done == step.frames_total:
                typer.echo(json.dumps(asdict(step)))
    else:
        _show(steps, folder)


def _picture_folder(
    folder: Path, settings: "PictureSettings", ground_file: Path | None, ground_gsd: float | None, as_json: bool
) -> None:
    from sorvolo.missions.simulate.pictures import simulate_pictures

    last = None
    console = Console()
    with ProgressReport(Console(stderr=True), stays=True) as progress:
        for last in simulate_pictures(folder, settings, ground_file, ground_gsd):
            progress.show("simulating pictures", last.pictures_done, settings.pictures)
    if last is not None and as_json:
        typer.echo(json.dumps(asdict(last)))
    elif last is not None:
        pictures, boxes = counted(last.pictures_done, "picture"), counted(last.boxes, "box")
        console.print(f"{pictures} with {boxes} in {last.seconds:.0f} s: {folder}", highlight=False, soft_wrap=True)


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
                progress.show(f"simulating {last.flight}, frame", last.frames_done, last.frames_total)
    if last is not None:
        made = counted(last.frames_done, "frame")
        console.print(f"{made} in {last.seconds:.0f} s: {folder}", highlight=False, soft_wrap=True)
        truth, camera = folder / "truth", folder / "camera.xml"
        console.print(f"the truth is in {truth}; the camera is in {camera}", highlight=False, soft_wrap=True)

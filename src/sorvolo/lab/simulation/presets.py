"""Ready-made simulations: the demo, the benchmark flights, and the variety of the UMCD dataset (Tables 2.1-2.4)."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from sorvolo.errors import SettingsError
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    LaterSettings,
    MotionSettings,
    OutputSettings,
    PathSettings,
    RevisitSettings,
    SceneSettings,
    SensorSettings,
    SimulationSettings,
    WeatherSettings,
)


@dataclass(frozen=True)
class _Row:
    """One video of the dataset, as its tables describe it; height, speed and size are ours where they are silent."""

    ground: str
    length_s: float
    fps: float
    height_m: float
    speed_m_s: float
    size_px: tuple[int, int]
    telemetry: str = "none"
    objects: tuple[int, int, int] = (0, 0, 0)  # people, cars, small objects of the later flight

    @property
    def flights(self) -> int:
        """A path that was flown again to look for changes has two."""
        return 2 if any(self.objects) else 1


_SD, _HD, _FULL = (720, 540), (1280, 720), (1920, 1080)
# length s, fps, altitude m, speed m/s of one video after another: Table 2.1
_WITHOUT_TELEMETRY = {
    "dirt": """
        18 25  8 3   15 25  9 3   16 25  9 5   11 25  9 3   19 25  8 3    8 25  8 4    9 25  8 4
        12 25 10 2    9 25  9 3   13 25 10 3   12 25  9 2    8 25  8 3   13 50 15 3   16 50 14 3
        15 50 15 2   22 50 13 2   16 50 10 2    8 50  6 4   10 50  6 3   20 50  6 2""",
    "countryside": """
        11 30 12 5    7 50 12 4    6 50 11 4    9 50 10 2    8 50 10 6   14 50 10 6    8 50  8 7
        12 50  8 5    8 50  9 4   13 25  8 2""",
}
# Tables 2.3 and 2.4: the mosaicking flight, and the objects that the change flight found on its path
_WITH_TELEMETRY = {
    "urban-path1": _Row("urban", 47, 25, 12, 4, _HD, "csv", (1, 0, 2)),
    "urban-path2": _Row("urban", 22, 30, 10, 6, _FULL, "nmea", (2, 0, 0)),
    "urban-path3": _Row("urban", 16, 30, 10, 8, _FULL, "nmea", (2, 0, 0)),
    "urban-path4": _Row("urban", 100, 30, 15, 12, _HD, "nmea", (0, 1, 0)),
    "dirt-path1": _Row("dirt", 144, 25, 10, 3, _SD, "csv", (1, 0, 3)),
    "dirt-path2": _Row("dirt", 138, 25, 10, 3, _SD, "csv", (1, 0, 3)),
    "dirt-path3": _Row("dirt", 75, 30, 8, 4, _FULL, "nmea", (0, 0, 1)),
    "dirt-path4": _Row("dirt", 67, 24, 8, 4, _FULL, "nmea", (0, 0, 1)),
    "countryside-path1": _Row("countryside", 39, 25, 12, 5, _HD, "csv", (1, 0, 1)),
    "countryside-path2": _Row("countryside", 61, 25, 12, 5, _HD, "csv", (1, 0, 2)),
}


_COMPARE_LATER = LaterSettings(people=2, cars=1, small_objects=3, removed=3, moved=3)


def preset_names() -> tuple[str, ...]:
    """All presets, the general ones first."""
    return (*_GENERAL, *_dataset())


def preset(name: str) -> SimulationSettings:
    """The settings of a preset.

    Raises SettingsError for an unknown name, with those that come close in it.
    """
    if name in _GENERAL:
        return replace(_GENERAL[name], preset=name)
    rows = _dataset()
    if name not in rows:
        raise SettingsError(
            f"unknown preset {name!r}; choose {', '.join(_GENERAL)}, or one of {', '.join(rows)}"
        )
    row = rows[name]
    return SimulationSettings(
        preset=name,
        flights=row.flights,
        scene=SceneSettings(row.ground, people=0, cars=0, small_objects=0),
        path=PathSettings(row.height_m, row.speed_m_s, row.length_s * row.speed_m_s, strips=1),
        motion=MotionSettings(height_rms_m=0.25, drift_rms_m=0.3),
        imaging=ImagingSettings(*row.size_px, fps=row.fps),
        # the phantom's stated accuracy: 1.5 m level, 0.5 m in height (section 2.2)
        sensor=SensorSettings(noise_m=(0.3, 0.3, 0.2), wander_m=1.0),
        later=LaterSettings(
            people=row.objects[0],
            cars=row.objects[1],
            small_objects=row.objects[2],
            removed=0,
            moved=0,
        ),
        output=OutputSettings(telemetry=row.telemetry),
    )


def _dataset() -> dict[str, _Row]:
    rows: dict[str, _Row] = {}
    for ground, table in _WITHOUT_TELEMETRY.items():
        numbers = [int(each) for each in table.split()]
        videos = zip(*(numbers[column::4] for column in range(4)))
        for number, (length_s, fps, height_m, speed_m_s) in enumerate(videos, start=1):
            size_px = _HD if fps == 50 else _SD
            rows[f"umcd-{ground}-path{number:02d}"] = _Row(
                ground, length_s, fps, height_m, speed_m_s, size_px
            )
    return rows | {f"umcd-telemetry-{name}": row for name, row in _WITH_TELEMETRY.items()}


def _survey(ground: str) -> SimulationSettings:
    return SimulationSettings(
        flights=1,
        scene=SceneSettings(ground),
        # 40 m and 62 degrees give 0.05 m a pixel; five strips at 70 % overlap along, 60 % across
        path=PathSettings(height_m=40, speed_m_s=8, length_m=104, strips=5, strip_spacing_m=19),
        imaging=ImagingSettings(fps=5),
        sensor=SensorSettings(noise_m=(1.0, 1.0, 1.0)),
    )


def _compare(
    ground: str = "countryside", later: LaterSettings = _COMPARE_LATER
) -> SimulationSettings:
    """Two short video flights over the same path: things added, taken away, moved and moving, in other weather."""
    return SimulationSettings(
        scene=SceneSettings(ground, people=3, cars=2, small_objects=5),
        # 24 m and 62 degrees give 0.022 m a pixel: a person is some 20 pixels wide
        path=PathSettings(height_m=24, speed_m_s=5, length_m=45, strips=2, strip_spacing_m=12),
        imaging=ImagingSettings(*_HD, fps=30),
        sensor=SensorSettings(noise_m=(0.5, 0.5, 0.5)),
        later=later,
        # views are taken about five times a second: every sixth frame
        output=OutputSettings(truth_step=3),
    )


def _compare_unlike(
    weather: WeatherSettings = WeatherSettings(), revisit: RevisitSettings = RevisitSettings()
) -> SimulationSettings:
    """The flights of `compare`, shorter, the second one in a way that makes comparing hard or impossible."""
    settings = _compare(later=replace(_COMPARE_LATER, weather=weather, revisit=revisit))
    return replace(
        settings,
        path=replace(settings.path, length_m=25),
        imaging=replace(settings.imaging, fps=10),
        output=replace(settings.output, truth_step=2),
    )


_GENERAL: Mapping[str, SimulationSettings] = {
    "demo": SimulationSettings(
        scene=SceneSettings("countryside", people=4, cars=3, small_objects=5),
        path=PathSettings(height_m=24, speed_m_s=5, length_m=50, strips=3, strip_spacing_m=12),
        imaging=ImagingSettings(fps=10),
        sensor=SensorSettings(noise_m=(0.5, 0.5, 0.5), wander_m=0.5),
    ),
    "survey": _survey("countryside"),
    "survey-urban": _survey("urban"),
    "survey-dirt": _survey("dirt"),
    "sand": _survey("sand"),
    # a small flying wing: 60 % overlap, gusts that roll it by 15 degrees, wind across, poor light
    "fixed-wing": SimulationSettings(
        flights=1,
        scene=SceneSettings("countryside"),
        # 65 m and 72 degrees give 0.06 m a pixel; strips at 60 % overlap both ways
        path=PathSettings(
            height_m=65, speed_m_s=13, length_m=260, strips=4, strip_spacing_m=38, heading_deg=60
        ),
        motion=MotionSettings(
            tilt_rms_deg=3.0,
            yaw_rms_deg=3.0,
            height_rms_m=3.0,
            drift_rms_m=2.0,
            roll_rms_deg=6.0,
            is_fixed_wing=True,
            wind_m_s=5.0,
            wind_from_deg=300.0,
        ),
        imaging=ImagingSettings(1600, 1200, 72.0, fps=5, exposure_s=1 / 400),
        sensor=SensorSettings(noise_m=(1.0, 1.0, 1.5), wander_m=1.0, attitude_noise_deg=2.0),
        output=OutputSettings(photos=True, photo_overlap=0.6),
    ),
    "compare": _compare(),
    "compare-urban": _compare("urban"),
    "compare-dirt": _compare("dirt"),
    # each place of the ground in four or more of the photos
    "compare-photos": SimulationSettings(
        scene=SceneSettings("countryside", people=4, cars=3, small_objects=6),
        path=PathSettings(height_m=36, speed_m_s=6, length_m=70, strips=3, strip_spacing_m=17),
        imaging=ImagingSettings(1600, 1200, fps=5),
        sensor=SensorSettings(noise_m=(0.5, 0.5, 0.5)),
        later=replace(_COMPARE_LATER, people=3, small_objects=4),
        output=OutputSettings(photos=True, photo_overlap=0.75),
    ),
    # nothing changed but light, clouds and wind: whatever is found is false
    "compare-none": replace(
        _compare(later=LaterSettings(people=0, cars=0, small_objects=0, removed=0, moved=0)),
        scene=SceneSettings("countryside", people=3, cars=2, small_objects=5, moving_share=0.0),
    ),
    "compare-higher": _compare_unlike(revisit=RevisitSettings(height_factor=1.5)),
    "compare-across": _compare_unlike(revisit=RevisitSettings(heading_change_deg=90)),
    "compare-back": _compare_unlike(revisit=RevisitSettings(heading_change_deg=180)),
    "compare-camera": _compare_unlike(
        revisit=RevisitSettings(
            imaging=ImagingSettings(1920, 1080, 74.0, (-0.02, 0.01, 0.0, 0.0, 0.0), fps=10)
        ),
    ),
    "compare-night": _compare_unlike(WeatherSettings(has_clouds=False, brightness=0.06)),
    "compare-snow": _compare_unlike(WeatherSettings(has_clouds=False, snow=1.0)),
}

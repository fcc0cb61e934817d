"""A flight's control points: read, found among its pictures, and held against its telemetry before it is mapped."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from sorvolo.capture.control_points import (
    LEAST_POINTS,
    ControlFile,
    marks_in_frames,
    read_control_points,
)
from sorvolo.capture.source import Source
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.geodesy import LocalFrame
from sorvolo.mosaic.control import ControlProblem, ControlSettings, tie_control
from sorvolo.mosaic.planar import PlanarMapper
from sorvolo.survey.control import ControlReport, GroundControl
from sorvolo.survey.flight import Notice

_ANOTHER_PLACE_M = 2_000.0  # from the flight: farther than flights within sight go; by choice


@dataclass(frozen=True, eq=False)
class FlightControl:
    """The control points of one flight. `is_datum`: the flight has no GPS, they alone place its map."""

    source: Source
    file: ControlFile
    control: GroundControl
    settings: ControlSettings
    notices: tuple[Notice, ...]
    is_datum: bool

    @property
    def words(self) -> str:
        """They, in words."""
        return f"the control point file ({self.file.path.name})"

    @property
    def frame(self) -> LocalFrame:
        """A site frame amid the points, for a flight without GPS."""
        return LocalFrame(self.control.middle)

    def tie(
        self, mapper: PlanarMapper, keyframe_of: Mapping[str, int], frame: LocalFrame
    ) -> ControlReport:
        """Tie the map to them; see `tie_control`. `keyframe_of`: the keyframe that shows each frame, by name."""
        camera = self.source.camera.camera
        problem = ControlProblem(
            self.control, keyframe_of, camera, frame, self.is_datum, self._other_readings
        )
        return tie_control(mapper, problem, self.settings)

    def check_place(self, distance_m: Callable[[GroundControl], float]) -> None:
        """Raise InputError for points far from the flight, naming the mistake where another reading lies on it."""
        off_m = distance_m(self.control)
        if off_m <= _ANOTHER_PLACE_M:
            return
        hint = "check its CRS and the order of x and y"
        for words, other in self.file.other_readings():
            if distance_m(other) <= _ANOTHER_PLACE_M:
                hint = f"they would lie on the flight if {words}: correct the file"
                break
        raise InputError(
            f"{self.file.path}: the control points lie {off_m / 1000:,.0f} km from the flight {self.source.name}, in "
            f"{self.control.crs}; {hint}"
        )

    def _other_readings(self) -> Iterator[tuple[str, GroundControl]]:
        for words, control in self.file.other_readings():
            try:
                yield words, marks_in_frames(control, self.source)[0]
            except InputError:
                continue


def open_control(path: Path, source: Source, settings: ControlSettings) -> FlightControl:
    """Read a flight's control points. Raises InputError or SettingsError with what to do."""
    file = read_control_points(path)
    control, notices = marks_in_frames(file.control, source)
    labels = [each.label for each in file.control.points]
    for each in settings.checks:
        if not any(ControlSettings(checks=(each,)).holds_back(label) for label in labels):
            raise SettingsError(
                f"--check {each}: {path} has no such control point; it has {', '.join(labels[:8])}"
            )
    left = [each.label for each in control.points if not settings.holds_back(each.label)]
    if len(left) < LEAST_POINTS:
        raise SettingsError(
            f"--check holds back all but {len(left)} of {len(control.points)} control points; at least {LEAST_POINTS} "
            "have to tie the map"
        )
    return FlightControl(source, file, control, settings, notices, not source.telemetry.has_fixes)

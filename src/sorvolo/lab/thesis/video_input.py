"""One video of the dataset as the missions take it: its telemetry recognised by content, a camera that fits it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sorvolo.capture.calibration import camera_from_option
from sorvolo.capture.telemetry import is_telemetry
from sorvolo.capture.video import read_video_info
from sorvolo.errors import InputError
from sorvolo.lab.thesis.npu_folder import photos_of_sequence
from sorvolo.lab.thesis.umcd_folder import UmcdVideo


@dataclass(frozen=True)
class VideoInput:
    """A video that can be read. `camera` is None where the dataset's calibration is of another shape of picture."""

    video: Path
    telemetry: Path | None
    camera: Path | None
    fps: float
    length_s: float

    @property
    def options(self) -> dict[str, Any]:
        """What `map_flights` and `compare_flights` take besides the video."""
        return {"telemetry": self.telemetry, "camera": self.camera}


def video_input(each: UmcdVideo, camera: Path | None, scratch: Path) -> VideoInput:
    """Look into a video and what lies beside it; raises InputError for one that cannot be used, naming what it lacks.

    A sequence of the NPU Drone-Map dataset, a folder, is made photos in `scratch`.

    A table of telemetry is not read here: the mission that reads it reports what is wrong with it.
    """
    if each.video.is_dir():
        photos, own_camera = photos_of_sequence(each.video, scratch)
        return VideoInput(photos, None, own_camera, 1.0, 0.0)
    info = read_video_info(each.video)
    telemetry = next((path for path in each.texts if is_telemetry(path)), None)
    if each.has_telemetry and telemetry is None:
        beside = ", ".join(path.name for path in each.texts) or "nothing"
        raise InputError(
            f"{each.video}: no telemetry beside it (found: {beside}); add the table or the NMEA log under its name"
        )
    try:
        if camera is not None:
            camera_from_option(str(camera), info.width_px, info.height_px)
    except InputError:
        camera = None
    return VideoInput(each.video, telemetry, camera, info.frame_rate_hz, info.duration_s)

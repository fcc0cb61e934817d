"""What a flight's report says: counted, measured and named while it is mapped."""

import platform
import resource
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from enum import StrEnum
from importlib.metadata import version
from typing import Any

import numpy as np

import sorvolo
from sorvolo.capture.sync import OffsetEstimate
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, ImageRGBA
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.grid import TileIndex
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.mosaic.pose_graph import GraphReport
from sorvolo.survey.flight import Notice, Site
from sorvolo.survey.mosaic import PlacedFrame, Status

_OBLIQUE_DEG = 35.0  # pictures that look to opposite sides share too little to be linked


class Stage(StrEnum):
    """What time is spent on; reading is what the other stages leave.

    Some work beside them: the detector's stage is what was waited for it, and laying on the ground what it saw; that of
    comparing is what was waited for views.
    """

    UNDISTORT = "undistort"
    REGISTER = "register"
    COMPARE = "compare"
    EVIDENCE = "evidence"
    DETECT = "detect"
    PAINT = "paint"
    STORE = "store"
    REPORT = "report"


@dataclass(frozen=True)
class Ending:
    """How one selected frame ended, for now."""

    index: int
    name: str
    time_ns: int
    status: Status
    reason: str


class FlightLog:
    """Endings and times of one flight as they happen."""

    def __init__(self) -> None:
        self.endings: dict[int, Ending] = {}
        self.wall_s: dict[str, float] = {}
        self.cpu_s: dict[str, float] = {}
        self.offset_applied_s = 0.0
        self._started_cpu_s = time.process_time()

    def end(self, index: int, name: str, time_ns: int, status: Status, reason: str) -> None:
        """Say how a frame ended; a later word replaces an earlier one."""
        self.endings[index] = Ending(index, name, time_ns, status, reason)

    def count(self, status: Status) -> int:
        """Frames that ended so."""
        return sum(each.status is status for each in self.endings.values())

    def commonest_reason(self) -> str:
        """The reason that most rejected frames share; "" without any."""
        reasons = Counter(each.reason for each in self.endings.values() if each.status is Status.REJECTED)
        return reasons.most_common(1)[0][0] if reasons else ""

    @contextmanager
    def stage(self, stage: Stage) -> Iterator[None]:
        """Count the wall and CPU seconds of a block."""
        wall_s, cpu_s = time.monotonic(), time.process_time()
        try:
            yield
        finally:
            self.wall_s[stage.value] = self.wall_s.get(stage.value, 0.0) + time.monotonic() - wall_s
            self.cpu_s[stage.value] = self.cpu_s.get(stage.value, 0.0) + time.process_time() - cpu_s

    def total_cpu_s(self) -> float:
        """CPU seconds of the process since the flight began."""
        return time.process_time() - self._started_cpu_s


def nothing_placed(name: str, log: FlightLog) -> InputError:
    """The error for a flight none of whose frames has a place on the ground."""
    reason = log.commonest_reason() or "none was selected"
    return InputError(
        f"no frame of {name} could be placed: {reason}; `sorvolo inspect` tells what the flight holds and what to do"
    )


def build_report(
    setup: FlightSetup, settings: MapSettings, log: FlightLog, placed: Sequence[PlacedFrame], site: Site,
    offset: OffsetEstimate | None, graph: GraphReport | None, camera: Camera, tiles: Mapping[TileIndex, ImageRGBA],
    notices: Sequence[Notice], seconds: float, *, spread: float,
) -> dict[str, Any]:
    """report.json of one flight; its keys are specified in docs/formats.md. Numbers that are not known are None."""
    source, telemetry = setup.source, setup.source.telemetry
    seen = [each for each in placed if each.status is not Status.REJECTED]
    gps = np.array([each.gps_residual_m for each in seen]).reshape(-1, 3)
    horizontal_m = np.hypot(gps[:, 0], gps[:, 1])
    heights_m = [each.site_from_camera.translation_m[2] for each in seen if each.site_from_camera is not None]
    residuals = np.array([each.residual_px for each in seen])
    model = source.camera
    area_m2 = _area_m2(tiles, site.m_per_px)
    selected = max(1, len(placed))
    registering_s = sum(log.cpu_s.get(stage.value, 0.0) for stage in (Stage.REGISTER, Stage.UNDISTORT))
    all_notices = [*telemetry.notices, *notices]
    return {
        "sorvolo": sorvolo.__version__,
        "flight": source.name,
        "site": site.name,
        "method": settings.method,
        "inputs": list(source.inputs),
        "georeferenced": not site.is_local,
        "frames": {
            "total": source.frame_count,
            "selected": len(placed),
            **{status.value: sum(each.status is status for each in placed) for status in Status},
            "reasons": dict(Counter(each.reason for each in placed if each.reason).most_common()),
        },
        "camera": {
            "origin": model.origin,
            "width_px": model.camera.width_px,
            "height_px": model.camera.height_px,
            "focal_px": model.camera.fx_px,
            "focal_sigma_relative": model.focal_sigma,
            "focal_found_px": camera.fx_px,
            "focal_found_sigma_relative": graph.focal_scale_sigma if graph else None,
            "distortion_k1_k2_p1_p2_k3": list(model.camera.distortion),
            "radial_found": graph.radial if graph else None,
        },
        "telemetry": {
            "format": telemetry.format,
            "samples": len(telemetry),
            "tie": setup.clock.tie if setup.clock else "none",
            "height": setup.track.height_words if setup.track else "none",
            "attitude": setup.track.attitude if setup.track else "none",
        },
        "time_offset": _offset(settings, log, offset),
        "residual_px": {"median": _median(residuals), "p95": _percentile(residuals, 95)},
        "gps_residual_m": {
            "median": _median(horizontal_m),
            "rms": _rms(horizontal_m),
            "vertical_median": _median(np.abs(gps[:, 2])),
        },
        "sigma_m": _median(np.array([each.sigma_m for each in seen])),
        "relief_m": graph.relief_m if graph else None,
        "altitude_offset_m": graph.altitude_offset_m if graph else None,
        "links": {"kept": graph.links, "dropped_as_false": graph.links_dropped} if graph else None,
        "colour_spread": spread,
        "ground_sampling_distance_m": site.m_per_px,
        "native_ground_sampling_distance_m": float(np.median(heights_m) / camera.fx_px) if heights_m else None,
        "height_above_ground_m": _median(np.array(heights_m)),
        "area_m2": area_m2,
        "seconds": {"total": seconds, **{name: round(value, 3) for name, value in log.wall_s.items()}},
        "cpu_s": {"total": log.total_cpu_s(), **{name: round(value, 3) for name, value in log.cpu_s.items()}},
        "registration_cpu_s_per_keyframe": registering_s / selected,
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "notices": [asdict(each) for each in all_notices],
        "warnings": [*_warnings(placed, residuals, horizontal_m, seen, setup), *_clock_warnings(setup, log)],
        "settings": asdict(settings),
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("numpy", "scipy", "opencv-contrib-python-headless", "av", "rasterio")},
        },
        "track": [_track_row(each) for each in placed],
    }


def _offset(settings: MapSettings, log: FlightLog, offset: OffsetEstimate | None) -> dict[str, Any]:
    result: dict[str, Any] = {
        "applied_s": settings.offset_s if settings.offset_s is not None else log.offset_applied_s,
        "origin": "given" if settings.offset_s is not None else ("estimated" if log.offset_applied_s else "none"),
        "estimate_s": None, "sigma_s": None,
    }
    if offset is not None and np.isfinite(offset.sigma_s):
        result |= {"estimate_s": offset.offset_s, "sigma_s": offset.sigma_s}
        result |= {"rms_at_zero_m": offset.rms_at_zero_m, "rms_m": offset.rms_m}
    return result


def _warnings(
    placed: Sequence[PlacedFrame], residuals: Floats, horizontal_m: Floats, seen: Sequence[PlacedFrame],
    setup: FlightSetup,
) -> list[str]:
    warnings = []
    lost = len(placed) - len(seen)
    if lost > 0.1 * len(placed):
        warnings.append(f"{lost} of {len(placed)} frames have no place in the map; `reasons` says why")
    blind = sum(each.status is Status.GPS_ONLY for each in seen)
    if blind > 0.1 * len(placed):
        warnings.append(f"{blind} frames are placed by GPS alone: expect steps of some metres at their edges")
    if np.isfinite(horizontal_m).any() and len(seen) > 3:
        centres = np.array([each.outline_m.mean(axis=0) for each in seen])
        reach = float(np.linalg.norm(centres.std(axis=0)))
        median = float(np.nanmedian(horizontal_m))
        if median > max(0.25 * reach, 8.0):
            warnings.append(
                f"the pictures' own path and the telemetry disagree by {median:.0f} m (median): is this the telemetry "
                "of this flight, and is the clock offset right?"
            )
    if np.isfinite(residuals).any() and float(np.nanmedian(residuals)) > 3.0:
        warnings.append("pictures fit each other badly: high trees or houses, a wrong camera, or a rolling shutter")
    axes_up = [each.site_from_camera.rotation[2, 2] for each in seen if each.site_from_camera is not None]
    tilt_deg = float(np.degrees(np.arccos(np.clip(-np.median(axes_up), -1, 1)))) if axes_up else 0.0
    if setup.track is not None and setup.track.attitude == "none" and tilt_deg > _OBLIQUE_DEG:
        warnings.append(
            f"the camera looks {tilt_deg:.0f} deg away from straight down and telemetry does not say where to: strips "
            "flown in opposite directions may not fit each other; give telemetry with the camera's angles"
        )
    if setup.source.camera.focal_sigma > 0.1:
        warnings.append(f"camera: {setup.source.camera.origin}; until then the scale is not sure")
    return warnings


def _clock_warnings(setup: FlightSetup, log: FlightLog) -> list[str]:
    clock, applied_s = setup.clock, log.offset_applied_s
    if clock is None or abs(applied_s) <= 2 * clock.sigma_s:
        return []
    return [
        f"the pictures fit this telemetry best {applied_s:+.1f} s from where its clock puts them, more than clocks "
        f"tied like these differ ({clock.tie}): is it the telemetry of this flight? --offset 0 keeps to its clock"
    ]


def _track_row(each: PlacedFrame) -> dict[str, Any]:
    """One frame for the report's plots, in site metres."""
    centre = each.outline_m.mean(axis=0)
    camera_m = each.site_from_camera.translation_m if each.site_from_camera is not None else np.append(centre, np.nan)
    return {
        "frame": each.name, "status": each.status.value,
        "east_m": float(camera_m[0]), "north_m": float(camera_m[1]), "up_m": float(camera_m[2]),
        "residual_px": each.residual_px, "sigma_m": each.sigma_m,
        "gps_east_m": float(each.gps_residual_m[0]), "gps_north_m": float(each.gps_residual_m[1]),
        "gps_up_m": float(each.gps_residual_m[2]),
    }


def _area_m2(tiles: Mapping[TileIndex, ImageRGBA], m_per_px: float) -> float:
    return float(sum(int(np.count_nonzero(tile[..., 3])) for tile in tiles.values()) * m_per_px**2)


def _median(values: Floats) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None


def _percentile(values: Floats, share: float) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.percentile(known, share)) if len(known) else None


def _rms(values: Floats) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else None

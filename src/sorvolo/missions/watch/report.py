"""A watch's report: counted and timed while it runs, written at the end."""

import platform
import resource
import statistics
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from typing import Any

import sorvolo
from sorvolo.capture.source import Source
from sorvolo.detection.contract import ModelInfo
from sorvolo.geometry.coordinates import Coordinates, place_text
from sorvolo.missions.flight.detector_protocol import ObjectDetector
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.missions.watch.settings import WatchOutputs, WatchSettings
from sorvolo.store.exports.plain import utc_text
from sorvolo.survey.flight import Notice, Site
from sorvolo.survey.objects import Detections, Track
from sorvolo.survey.wording import counted, most_first

# notices of sources about frames that cannot be used: left out where the reasons are reported
_OF_LOST_FRAMES = (
    "unreadable_photo",
    "corrupt_photo",
    "duplicate_photo",
    "other_size",
    "other_shape",
)


@dataclass
class WatchLog:
    """Frames, detections and times of one watch as they happen."""

    read: int = 0  # frames that the source went past
    detected: int = 0  # frames searched
    with_detections: int = 0
    lost: Counter[str] = field(default_factory=Counter)  # reasons of frames that cannot be used
    found: Counter[str] = field(default_factory=Counter)  # detections by class
    placed: int = 0  # detections with a place on the ground
    latency_s: list[float] = field(default_factory=list)
    first_ns: int = -1
    last_ns: int = -1
    wall_s: dict[str, float] = field(default_factory=dict)
    started_s: float = field(default_factory=time.monotonic)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the wall seconds of a block."""
        started_s = time.monotonic()
        try:
            yield
        finally:
            self.wall_s[name] = self.wall_s.get(name, 0.0) + time.monotonic() - started_s

    def searched(self, time_ns: int, found: Detections, placed: int) -> None:
        """Count one frame that was searched."""
        self.detected += 1
        self.with_detections += len(found) > 0
        self.found.update(found.names)
        self.placed += placed
        self.first_ns = time_ns if self.first_ns < 0 else self.first_ns
        self.last_ns = time_ns

    @property
    def seconds(self) -> float:
        """Since the watch began."""
        return time.monotonic() - self.started_s


def found_words(
    track: Track, site: Site, form: Coordinates = Coordinates.LATLON
) -> tuple[str, str]:
    """A new object's name, and where it is (none of a local site) and how sure that is."""
    name, seen = (
        f"{track.label} {track.id}",
        f"score {track.score:.2f}, {counted(track.views, 'view')}",
    )
    if site.is_local:
        return name, seen
    latitude, longitude, _ = site.frame.wgs84_from_site(track.position_m[None])
    place = place_text(float(latitude[0]), float(longitude[0]), form)
    return name, f"at {place} (accuracy {track.sigma_m:.1f} m), {seen}"


def count_by_class(tracks: Sequence[Track]) -> dict[str, int]:
    """How many confirmed tracks of each class, most first, equals by name."""
    return most_first(each.label for each in tracks if each.confirmed)


def model_facts(model: ModelInfo) -> dict[str, Any]:
    """What the report states of a model that looked at pictures."""
    return {
        "name": model.name,
        "version": model.version,
        "preset": model.preset,
        "precision": model.precision,
        "classes": list(model.classes),
        "thresholds": dict(model.thresholds),
        "calibrated": list(model.calibration),
        "licence": model.licence,
        "trained_on": model.trained_on,
        "created": model.created,
    }


def build_watch_report(
    setup: FlightSetup,
    settings: WatchSettings,
    outputs: WatchOutputs,
    detector: ObjectDetector,
    log: WatchLog,
    tracks: Sequence[Track],
    notices: Sequence[Notice],
    warnings: Sequence[str],
    *,
    looked_for: Sequence[str],
    others: Sequence[Mapping[str, Any]],
    ended: str,
    skipped: int,
    set_aside: int,
    on_ground: bool,
) -> dict[str, Any]:
    """report.json of one watch; its keys are specified in docs/formats.md. Numbers that are not known are None.

    `others` are the `model_facts` of the models that looked at pictures besides the detector's own.
    """
    source, camera = setup.source, setup.source.camera
    total = sum(log.found.values())
    seconds = log.seconds
    return {
        "sorvolo": sorvolo.__version__,
        "flight": source.name,
        "inputs": list(source.inputs),
        "georeferenced": on_ground,
        "first_frame": utc_text(log.first_ns) if log.first_ns >= 0 else None,
        "last_frame": utc_text(log.last_ns) if log.last_ns >= 0 else None,
        "ended": ended,
        "looked_for": list(looked_for),
        "objects": {"total": len(tracks), "by_class": count_by_class(tracks)},
        "frames": {
            "read": log.read,
            "detected": log.detected,
            "with_detections": log.with_detections,
            "skipped": skipped,
            "lost": sum(log.lost.values()),
            "reasons": dict(log.lost.most_common()),
        },
        "detections": {
            "total": total,
            "placed": log.placed,
            "not_placed": total - log.placed - set_aside,
            "set_aside": set_aside,
            "by_class": dict(log.found.most_common()),
        },
        "model": {**model_facts(detector.info), "runs_on": detector.provider},
        "other_models": list(others),
        "camera": {
            "origin": camera.origin,
            "width_px": camera.camera.width_px,
            "height_px": camera.camera.height_px,
            "focal_px": camera.camera.fx_px,
            "focal_sigma_relative": camera.focal_sigma,
        },
        "telemetry": _telemetry(setup, on_ground),
        "latency_s": {
            "median": statistics.median(log.latency_s) if log.latency_s else None,
            "max": max(log.latency_s, default=None),
        },
        "frames_per_second": log.detected / seconds if seconds > 0 else None,
        "seconds": {
            "total": round(seconds, 3),
            **{name: round(value, 3) for name, value in log.wall_s.items()},
        },
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "notices": [asdict(each) for each in notices],
        "warnings": list(warnings),
        "settings": {
            **asdict(settings),
            "save": outputs.save,
            "labels": list(outputs.labels),
            "cot": outputs.cot,
        },
        "versions": {
            "python": platform.python_version(),
            **{
                name: version(name)
                for name in ("numpy", "opencv-contrib-python-headless", "av", "onnxruntime")
            },
        },
    }


def _telemetry(setup: FlightSetup, on_ground: bool) -> dict[str, Any]:
    telemetry = setup.source.telemetry
    height = setup.track.height_words if setup.track else "none"
    return {
        "format": telemetry.format,
        "samples": len(telemetry),
        "tie": setup.clock.tie if setup.clock else "none",
        "height": height if on_ground else height.split(",")[0],  # the rest is how a map finds it
        "attitude": setup.track.attitude if setup.track else "none",
    }


def source_notices(source: Source, log: WatchLog) -> tuple[Notice, ...]:
    """The notices of the source and its telemetry, and one about unusable frames."""
    lost = sum(log.lost.values())
    reasons = "; ".join(f"{count} x {reason}" for reason, count in log.lost.most_common(5))
    unusable = (
        (Notice("lost_frames", lost, f"{counted(lost, 'frame')} could not be used: {reasons}"),)
        if lost
        else ()
    )
    others = [each for each in source.notices() if not (lost and each.code in _OF_LOST_FRAMES)]
    return (*source.telemetry.notices, *others, *unusable)

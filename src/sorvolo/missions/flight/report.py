"""What a flight's report has: counted, measured and named while it is mapped."""

import resource
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from math import isfinite, nan
from typing import Any

from sorvolo.build import build
from sorvolo.capture.clock_offset import OffsetEstimate
from sorvolo.capture.video import VideoSource
from sorvolo.geometry.camera import Camera
from sorvolo.missions.flight.headline import (
    clock_doubts,
    clock_remarks,
    flight_warnings,
    map_headline,
    place_doubts,
    still_fixes,
    unlevelled,
)
from sorvolo.missions.flight.log import FlightLog, Stage
from sorvolo.missions.flight.request import software
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.mosaic.base_ties import BaseReport
from sorvolo.mosaic.consistency import Stated, consistency
from sorvolo.mosaic.flight_figures import (
    delay_figures,
    flight_figures,
    stated_height_m,
    track_row,
)
from sorvolo.mosaic.graph_report import GraphReport
from sorvolo.store.exports.ground_files import control_summary
from sorvolo.store.exports.map_pictures import Picture
from sorvolo.store.exports.plain import utc_text
from sorvolo.survey.control import ControlReport
from sorvolo.survey.flight import CameraModel, Notice, Site
from sorvolo.survey.mosaic import PlacedFrame, Status


@dataclass(frozen=True)
class MapShape:
    """Whether a map is flat, else a true orthophoto over heights, and why, in one sentence."""

    is_flat: bool
    why: str


_WRONG_HEIGHT = (
    5.0  # times the height that pictures show: a stated one so far off pulls at the map's scale
)
_COARSE = 1.5  # times the pixel of the pictures

LEVEL = MapShape(True, "the map is flat: a level plane explains the pictures")


@dataclass(frozen=True, eq=False)
class FlightResult:
    """How a flight ended: its frames where they lie, the camera as it was found, what method planar's graph and the
    search for a clock offset gave (None: another method), and the spread of colours after correction."""

    placed: Sequence[PlacedFrame]
    camera: Camera
    offset: OffsetEstimate | None = None
    graph: GraphReport | None = None
    colour_spread: float = float("nan")
    makes_map: bool = True  # else it was compared with one
    control: ControlReport | None = None
    base: BaseReport | None = None
    pieces: Sequence[Sequence[int]] = ()  # frames, by index, that links tie together
    shape: MapShape = LEVEL


def build_report(
    setup: FlightSetup,
    settings: MapSettings,
    log: FlightLog,
    result: FlightResult,
    site: Site,
    shown: Picture,
    notices: Sequence[Notice],
    seconds: float,
) -> dict[str, Any]:
    """report.json of one flight; its keys are specified in docs/formats.md. Numbers that are not known are None.

    `shown` is the map made small, whatever its size. `notices` are those of the source and of what worked on its
    frames; telemetry's and the setup's are added.
    """
    source, placed, graph = setup.source, result.placed, result.graph
    figures = flight_figures(placed, result.camera.fx_px)
    # what the plane of a flat map shows of itself is no witness of a map that stands on heights
    plane = graph if result.shape.is_flat else None
    stated = _stated(setup, result)
    agreement = consistency(placed, result.pieces, figures, stated, plane)
    agreement = replace(agreement, faults=(*still_fixes(figures, setup), *agreement.faults))
    times = stated.height_m / (figures.height_m or nan)
    if agreement.remarks and not 1 / _WRONG_HEIGHT < times < _WRONG_HEIGHT:
        agreement = replace(agreement, steps=(*agreement.steps, *agreement.remarks), remarks=())
    headline = {}
    # the first pictures, or another flight, decided the map's resolution
    native_m = figures.native_m_per_px or 0.0
    chose = site.is_local or settings.m_per_px or not result.makes_map
    is_coarse = not chose and site.m_per_px > _COARSE * native_m > 0
    coarse = (
        f"the map has {100 * site.m_per_px:.1f} cm a pixel, and the pictures show {100 * native_m:.1f} cm: --gsd "
        f"{native_m:.2g} maps them so into a new folder"
    )
    others = [*clock_doubts(setup, result.offset, settings.offset_s), *place_doubts(setup)]
    if result.makes_map:
        headline["headline"] = asdict(
            map_headline(
                placed,
                figures,
                is_video=source.kind == "video",
                agreement=agreement,
                others=[*others, *unlevelled(placed, plane, setup)],
                graph=plane,
            )
        )
    return {
        **report_head(setup, is_local=site.is_local),
        "site": site.name,
        "method": settings.method_name,
        "flown": utc_text(setup.flown_ns) if setup.flown_ns else None,
        **headline,
        "frames": {
            "total": source.frame_count,
            "selected": len(placed),
            **{status.value: sum(each.status is status for each in placed) for status in Status},
            "reasons": dict(Counter(each.reason for each in placed if each.reason).most_common()),
        },
        "reading": asdict(source.reading) if isinstance(source, VideoSource) else None,
        "camera": {
            **camera_facts(source.camera),
            "focal_found_px": result.camera.fx_px,
            "focal_found_sigma_relative": graph.focal_scale_sigma if graph else None,
            "distortion_k1_k2_p1_p2_k3": list(source.camera.camera.distortion),
            "radial_found": graph.radial if graph else None,
        },
        "telemetry": telemetry_facts(setup),
        "time_offset": _offset(settings, log, result.offset),
        "pieces": [asdict(each) for each in agreement.pieces],
        "residual_px": {"median": figures.residual_median_px, "p95": figures.residual_p95_px},
        "gps_residual_m": {
            "median": figures.gps_median_m,
            "rms": figures.gps_rms_m,
            "vertical_median": figures.gps_vertical_median_m,
        },
        "sigma_m": figures.sigma_m,
        "control": control_summary(result.control) if result.control else None,
        "base": asdict(result.base) if result.base else None,
        **({} if result.shape == LEVEL else {"shape": asdict(result.shape)}),
        "relief_m": graph.relief_m if graph else None,
        "altitude_offset_m": graph.altitude_offset_m if graph else None,
        "links": {"kept": graph.links, "dropped_as_false": graph.links_dropped} if graph else None,
        "colour_spread": result.colour_spread,
        "ground_sampling_distance_m": site.m_per_px,
        "native_ground_sampling_distance_m": figures.native_m_per_px,
        "height_above_ground_m": figures.height_m,
        "area_m2": shown.shown_m2(site.m_per_px),
        "delay_s": delay_figures(log.delays_s),
        **_effort(log, seconds, max(1, len(placed))),
        "notices": [asdict(each) for each in (*source.telemetry.notices, *setup.notices, *notices)],
        "warnings": [
            *flight_warnings(placed, figures, setup, log, agreement, plane, others),
            *clock_remarks(setup, None if settings.offset_s is not None else result.offset),
            *([coarse] if is_coarse else ()),
            *(result.control.remarks if result.control else ()),
        ],
        "settings": asdict(settings),
        "versions": software(),
        "track": [track_row(each) for each in placed],
    }


def _stated(setup: FlightSetup, result: FlightResult) -> Stated:
    """What telemetry states, to hold the map against; heights only where they are known to count from the ground."""
    telemetry, graph = setup.telemetry, result.graph
    source = "the photos' heights" if setup.source.kind == "photos" else "the telemetry's heights"
    if telemetry is None or graph is None:
        return Stated(0.0, float("nan"), source)
    height_m = (
        stated_height_m(result.placed, graph.altitude_offset_m)
        if telemetry.knows_ground
        else float("nan")
    )
    return Stated(telemetry.usual_sigma_m, height_m, source)


def report_head(setup: FlightSetup, *, is_local: bool) -> dict[str, Any]:
    """Return what every mission's report begins with."""
    return {
        "sorvolo": build(),
        "flight": setup.source.name,
        "inputs": list(setup.source.inputs),
        "georeferenced": not is_local,
    }


def camera_facts(model: CameraModel) -> dict[str, Any]:
    """Return a report's part on the camera as it was known before the flight."""
    return {
        "origin": model.origin,
        "width_px": model.camera.width_px,
        "height_px": model.camera.height_px,
        "focal_px": model.camera.fx_px,
        "focal_sigma_relative": model.focal_sigma,
    }


def telemetry_facts(setup: FlightSetup) -> dict[str, Any]:
    """Return a report's part on telemetry."""
    telemetry, track = setup.source.telemetry, setup.track
    return {
        "format": telemetry.format,
        "samples": len(telemetry),
        "tie": setup.clock.tie if setup.clock else "none",
        "height": track.height_words if track else "none",
        "attitude": track.attitude if track else "none",
    }


def peak_memory_mb() -> float:
    """Return the most memory that this process held so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _effort(log: FlightLog, seconds: float, selected: int) -> dict[str, Any]:
    registering_s = sum(
        log.cpu_s.get(stage.value, 0.0) for stage in (Stage.REGISTER, Stage.UNDISTORT)
    )
    return {
        "seconds": {
            "total": seconds,
            **{name: round(value, 3) for name, value in log.wall_s.items()},
        },
        "cpu_s": {
            "total": log.total_cpu_s(),
            **{name: round(value, 3) for name, value in log.cpu_s.items()},
        },
        "registration_cpu_s_per_keyframe": registering_s / selected,
        "peak_memory_mb": peak_memory_mb(),
    }


def _offset(settings: MapSettings, log: FlightLog, offset: OffsetEstimate | None) -> dict[str, Any]:
    result: dict[str, Any] = {
        "applied_s": settings.offset_s if settings.offset_s is not None else log.offset_applied_s,
        "origin": "given"
        if settings.offset_s is not None
        else ("estimated" if log.offset_applied_s else "none"),
        "estimate_s": None,
        "sigma_s": None,
    }
    if offset is not None and offset.is_known:
        result |= {"estimate_s": offset.offset_s, "sigma_s": offset.sigma_s}
        at_zero_m = offset.rms_at_zero_m
        result |= {"rms_at_zero_m": at_zero_m if isfinite(at_zero_m) else None}
        result |= {"rms_m": offset.rms_m}
    if offset is not None and offset.rivals_s:
        result["rivals_s"] = list(offset.rivals_s)
    return result

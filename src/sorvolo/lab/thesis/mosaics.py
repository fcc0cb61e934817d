"""Section 4.1: videos mapped by each method, how long it takes, how good the map is, and what the figures show."""

import shutil
import time
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from sorvolo.capture.photos import read_picture
from sorvolo.errors import InputError
from sorvolo.geometry.polygons import signed_area
from sorvolo.lab.evaluation.frame_rows import map_frames
from sorvolo.lab.evaluation.map_quality import MapDeviation, correlation
from sorvolo.lab.evaluation.mosaic import evaluate_mosaic
from sorvolo.lab.thesis.mapping import ThesisMapping
from sorvolo.lab.thesis.settings import FIGURE_PX
from sorvolo.lab.thesis.stitching import RoiStitcher, RoiStitchingSettings
from sorvolo.lab.thesis.video_input import VideoInput
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.map.flights import map_flights
from sorvolo.paths import Json
from sorvolo.registration.features import gray_from_rgb
from sorvolo.registration.lens import at_most
from sorvolo.store.atomic import writing
from sorvolo.store.exports.map_pictures import picture
from sorvolo.store.images import jpeg_from_image, jpeg_from_rgba
from sorvolo.store.site.archive import Archive

_LAID_OVER_PX = 2048  # longer side at which mosaics without coordinates are compared


Transform = Literal["similarity", "homography"]


def map_video(
    flight: VideoInput, site: Path, method: str, transform: Transform = "similarity"
) -> Json:
    """A row of Table 4.1: one video mapped into a new site folder, and the deviation of section 4.1.1.

    Raises InputError and StoreError as `map_flights`.
    """
    with writing(site):
        shutil.rmtree(site, ignore_errors=True)
        site.parent.mkdir(parents=True, exist_ok=True)
    thesis = ThesisMapping(RoiStitchingSettings(transform=transform))
    settings = MapSettings(thesis if method == "thesis" else None, model="none")
    started_s, started_cpu_s = time.monotonic(), time.process_time()
    updates = list(map_flights([flight.video], site, settings, **flight.options))
    minutes = (time.monotonic() - started_s) / 60
    cpu_minutes = (time.process_time() - started_cpu_s) / 60
    deviation = evaluate_mosaic(site).deviation
    with Archive.open(site, write=False) as archive:
        headline = archive.report(archive.flights()[0].id).get("headline", {})
    return {
        "frames": updates[-1].frames_read,
        "keyframes": len(updates),
        "matched": updates[-1].by_vision,
        "minutes": minutes,
        "cpu_minutes": cpu_minutes,
        "seconds_per_keyframe": 60 * cpu_minutes / len(updates),
        "deviation": deviation.mean,
        "histogram": deviation.histogram,
        "quality": headline.get("quality"),
        "camera": "calibrated" if flight.camera else "guessed",
    }


def map_jpeg(site: Path) -> bytes:
    """The whole map made small, on grey, as a JPEG."""
    with Archive.open(site, write=False) as archive:
        return jpeg_from_rgba(picture(archive.tiles(), 2 * FIGURE_PX).rgba, FIGURE_PX)


def example_jpegs(site: Path) -> dict[str, bytes]:
    """Figure 4.1a: a part of the map, the keyframe in the flight's middle that it was made of, and their difference."""
    with Archive.open(site, write=False) as archive:
        keyframes = archive.keyframes()
        middle = keyframes[len(keyframes) // 2]
        shown = MapDeviation(archive.tiles(), archive.site_grid()).shown(
            archive.image(middle), middle.site_from_image
        )
    return {name: jpeg_from_image(each, FIGURE_PX) for name, each in shown.items()}


def distortion_of(site: Path) -> Json:
    """Figure 3.12 in numbers, over the frames that lie on the map.

    `sides` is the largest ratio of two opposite sides (1: none is a trapezium), `areas` the largest area over the
    smallest, `bend` the path's largest distance from the chord of its ends, over the chord: NaN where the ends are
    closer than half a frame is wide. All are NaN where there is no frame.
    """
    with Archive.open(site, write=False) as archive:
        described = archive.site()
    (rows,) = map_frames(site, described).values()
    corners = np.array([row.outline_m for row in rows if row.has_outline])
    counts = {"frames": len(corners), "selected": len(rows)}
    if not len(corners):
        return {**counts, "sides": np.nan, "areas": np.nan, "bend": np.nan}
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    pairs = np.stack([lengths[:, :2], lengths[:, 2:]])
    areas = np.abs([signed_area(each) for each in corners])
    away = corners.mean(axis=1) - corners[0].mean(axis=0)
    chord = away[-1]
    length2 = float(chord @ chord)
    bend = np.abs(away @ [chord[1], -chord[0]]).max() / max(length2, 1e-9)
    return {
        **counts,
        "sides": float((pairs.max(axis=0) / pairs.min(axis=0)).max()),
        "areas": float(areas.max() / areas.min()),
        "bend": float(bend) if length2 >= areas[0] / 4 else np.nan,
    }


def correlation_of(site: Path, mosaic: Path) -> Json:
    """Eq. 4.1 of a flight's map and another mosaic of it. A GeoTIFF is compared as it lies and after the shift between
    them; a picture without coordinates is laid over the map by the thesis's own features.

    Raises InputError as `evaluate_mosaic`, and where the picture is found nowhere on the map.
    """
    if mosaic.suffix.lower() not in (".tif", ".tiff"):
        other = at_most(read_picture(mosaic), _LAID_OVER_PX)
        with Archive.open(site, write=False) as archive:
            own = picture(archive.tiles(), _LAID_OVER_PX)
            m_per_px = archive.site().m_per_px * own.step_px
        stitcher = RoiStitcher(RoiStitchingSettings(ransac_px=10.0))
        stitcher.add(0, other)
        found = stitcher.add(1, np.ascontiguousarray(own.rgba[..., :3]))
        if isinstance(found, str):
            raise InputError(f"{mosaic}: was not found on the map ({found})")
        gray = gray_from_rgb(other)
        under = np.asarray(
            cv2.warpPerspective(own.rgba, found.mosaic_from_image, gray.shape[::-1]), np.uint8
        )
        # what a mosaic does not show is one colour, black or white
        known = (under[..., 3] == 255) & (gray > 0) & (gray < 255)
        value = correlation(gray, gray_from_rgb(np.ascontiguousarray(under[..., :3])), known)
        scale = float(np.sqrt(abs(np.linalg.det(found.mosaic_from_image[:2, :2]))))
        return {
            "correlation": value,
            "correlation_after_shift": value,
            "m_per_px": m_per_px / scale,
            "area_m2": float(known.sum()) * (m_per_px / scale) ** 2,
        }
    reference = evaluate_mosaic(site, reference=mosaic).reference
    assert reference is not None
    names = "correlation", "correlation_after_shift", "m_per_px", "area_m2"
    return {name: getattr(reference, name) for name in names}

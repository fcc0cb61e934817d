"""A flight report as `missions` makes it, and a picture of a map, both made up."""

from typing import Any

import numpy as np

from sorvolo.geometry.arrays import ImageRGBA


def fake_report(frames: int = 60, *, georeferenced: bool = True) -> dict[str, Any]:
    """A lawnmower of three strips: most frames by vision, a few by GPS alone, a few rejected."""
    rng = np.random.default_rng(7)
    along = np.linspace(0, 3, frames, endpoint=False)
    strip = along.astype(int)
    east = np.where(strip % 2, 1 - along % 1, along % 1) * 60 - 30
    north = strip * 14.0 - 14
    statuses = np.array(["vision"] * frames, dtype=object)
    statuses[3 * frames // 5 : 3 * frames // 5 + 3] = "gps-only"
    statuses[[frames // 4, frames // 4 + 1]] = "rejected"
    track = []
    for k in range(frames):
        seen, by_vision = statuses[k] != "rejected", statuses[k] == "vision"
        gps = rng.normal(0, 0.8, 3) if seen else np.full(3, np.nan)
        track.append(
            {
                "frame": str(12 * k),
                "status": statuses[k],
                "east_m": float(east[k]) if seen else np.nan,
                "north_m": float(north[k]) if seen else np.nan,
                "up_m": 24.0 if seen else np.nan,
                "residual_px": float(0.4 + rng.gamma(2, 0.15)) if by_vision else np.nan,
                "sigma_m": 0.3 if by_vision else 1.9 if seen else np.nan,
                "gps_east_m": float(gps[0]),
                "gps_north_m": float(gps[1]),
                "gps_up_m": float(gps[2]),
            }
        )
    counts = {
        status: int((statuses == status).sum()) for status in ("vision", "gps-only", "rejected")
    }
    return {
        "sorvolo": "0.1.0",
        "flight": "field_0042",
        "site": "river bend",
        "method": "planar",
        "inputs": ["DJI_0042.MP4"],
        "georeferenced": georeferenced,
        "frames": {
            "total": 12 * frames,
            "selected": frames,
            **counts,
            "reasons": {"blurred": 2, "no neighbour fits: too few points in common": 3},
        },
        "camera": {
            "origin": "camera.xml",
            "width_px": 960,
            "height_px": 540,
            "focal_px": 798.8,
            "focal_sigma_relative": 0.002,
            "focal_found_px": 799.31,
            "focal_found_sigma_relative": 0.0008,
            "distortion_k1_k2_p1_p2_k3": [-0.08, 0.02, 0.0004, -0.0003, 0.0],
            "radial_found": 0.0011,
        },
        "telemetry": {
            "format": "umcd",
            "samples": 431,
            "tie": "the file's own clock of the video",
            "height": "above take-off",
            "attitude": "gimbal",
        },
        "time_offset": {
            "applied_s": 0.412,
            "origin": "estimated",
            "estimate_s": 0.412,
            "sigma_s": 0.021,
            "rms_at_zero_m": 1.94,
            "rms_m": 0.83,
        },
        "residual_px": {"median": 0.62, "p95": 1.31},
        "gps_residual_m": {"median": 0.94, "rms": 1.12, "vertical_median": 0.52},
        "sigma_m": 0.31,
        "relief_m": 0.42,
        "altitude_offset_m": -0.8,
        "links": {"kept": 214, "dropped_as_false": 3},
        "colour_spread": 0.031,
        "ground_sampling_distance_m": 0.03,
        "native_ground_sampling_distance_m": 0.0301,
        "height_above_ground_m": 24.0,
        "area_m2": 3412.0,
        "seconds": {
            "total": 31.2,
            "undistort": 1.1,
            "register": 9.4,
            "paint": 7.9,
            "store": 3.1,
            "report": 0.6,
        },
        "cpu_s": {
            "total": 38.0,
            "undistort": 1.4,
            "register": 11.0,
            "paint": 9.0,
            "store": 2.7,
            "report": 0.6,
        },
        "registration_cpu_s_per_keyframe": 0.052,
        "peak_memory_mb": 412.3,
        "notices": [
            {"code": "bad_checksum", "count": 3, "text": "3 sentences had a wrong checksum"},
            {"code": "gap", "count": 1, "text": "one gap of 3.1 s without fixes"},
        ],
        "warnings": ["camera: a GUESS, give --camera; until then the scale is not sure"],
        "settings": {"method": "planar", "m_per_px": None, "overlap": 0.7, "offset_s": None},
        "versions": {"python": "3.11.9", "numpy": "2.4.6"},
        "track": track,
    }


def fake_picture(width_px: int = 900, height_px: int = 500, *, noise: float = 30.0) -> ImageRGBA:
    """A slanted field with a transparent rim."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[0:height_px, 0:width_px]
    rgb = np.stack([110 + 30 * np.sin(x / 40), 130 + 25 * np.cos(y / 33), 80 + 0 * x], axis=-1)
    rgb += rng.normal(0, noise, rgb.shape)
    seen = np.abs(y - height_px / 2 - 0.08 * (x - width_px / 2)) < 0.4 * height_px
    seen &= np.abs(x - width_px / 2) < 0.46 * width_px
    return np.dstack([np.clip(rgb, 0, 255), np.where(seen, 255, 0)]).astype(np.uint8)

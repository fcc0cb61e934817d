"""Cameras by model name: sensor, focal length and image size of common drones.

docs/calibrate.md ("Camera presets") states for each where its figures come from and how far they agree with another
source; `focal_sigma` covers the difference.
"""

import re
import tomllib
from dataclasses import dataclass
from importlib.resources import files


@dataclass(frozen=True)
class CameraPreset:
    """One model. `codes` are its names in EXIF; `width_px` and `height_px` its largest photo.

    `focal_sigma` is the relative uncertainty of the focal length in such a photo. The lens of an
    interchangeable or zooming camera (`changes_lens`) is the one that EXIF states, `focal_mm` only its
    usual one.
    """

    name: str
    codes: tuple[str, ...]
    sensor_width_mm: float
    sensor_height_mm: float
    focal_mm: float
    width_px: int
    height_px: int
    focal_sigma: float = 0.02
    changes_lens: bool = False


_STORED = tomllib.loads(
    files("sorvolo.capture").joinpath("camera_presets.toml").read_text(encoding="utf-8")
)
CAMERA_PRESETS = tuple(
    CameraPreset(name, tuple(codes), *numbers) for name, codes, *numbers in _STORED["presets"]
)
_SOLD_AS: dict[str, str] = _STORED["sold_as"]


def find_presets(name: str) -> list[CameraPreset]:
    """The presets with this name, a drone's full name or EXIF code; several where a drone has several cameras.

    Case, blanks, hyphens and "DJI" before it do not matter.
    """
    plain = _plain(name)
    wanted = {plain, plain.removeprefix("dji")}
    wanted |= {_plain(preset) for sold, preset in _SOLD_AS.items() if _plain(sold) in wanted}
    return [
        preset
        for preset in CAMERA_PRESETS
        if wanted & {_plain(preset.name), *(_plain(code) for code in preset.codes)}
    ]


def preset_names() -> str:
    """Every preset with its EXIF codes, for a message."""
    return ", ".join(
        f"{preset.name} ({', '.join(preset.codes)})" if preset.codes else preset.name
        for preset in CAMERA_PRESETS
    )


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())

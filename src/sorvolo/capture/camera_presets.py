"""Cameras by model name: sensor, focal length and image size of common drones.

docs/calibrate.md ("Camera presets") states for each where its figures come from and how far they agree with another
source; `focal_sigma` covers the difference.
"""

import re
from dataclasses import dataclass


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


CAMERA_PRESETS = (
    # 1/2.3 inch sensors with 1.55 um pixels: 4000 x 1.55 um = 6.2 mm
    CameraPreset(
        "Phantom 3", ("FC300X", "FC300S", "FC300C", "FC300SE"), 6.2, 4.65, 3.61, 4000, 3000
    ),
    CameraPreset("Zenmuse X3", ("FC350",), 6.2, 4.65, 3.61, 4000, 3000),
    CameraPreset("Phantom 4", ("FC330",), 6.2, 4.65, 3.61, 4000, 3000),
    CameraPreset("Mavic Pro", ("FC220",), 6.2, 4.65, 4.73, 4000, 3000),
    CameraPreset("Mavic Air", ("FC2103",), 6.29, 4.71, 4.5, 4056, 3040, 0.03),
    CameraPreset("Mavic Mini", ("FC7203",), 6.3, 4.73, 4.49, 4000, 3000, 0.03),
    CameraPreset("Mini 2", ("FC7303",), 6.3, 4.73, 4.49, 4000, 3000, 0.03),
    CameraPreset(
        "Mavic 2 Zoom", ("FC2204",), 6.2, 4.65, 4.386, 4000, 3000, 0.03, changes_lens=True
    ),
    CameraPreset("Phantom 4 Multispectral", ("FC6360",), 4.87, 3.96, 5.74, 1600, 1300),
    # 1 inch
    CameraPreset("Phantom 4 Pro", ("FC6310", "FC6310S"), 13.2, 8.8, 8.8, 5472, 3648),
    CameraPreset("Phantom 4 RTK", ("FC6310R",), 13.2, 8.8, 8.8, 5472, 3648),
    CameraPreset("Zenmuse X4S", ("FC6510",), 13.2, 8.8, 8.8, 5472, 3648),
    CameraPreset("Zenmuse L1", (), 13.2, 8.8, 8.8, 5472, 3648),
    CameraPreset("Mavic 2 Pro", ("L1D-20c",), 13.2, 8.8, 10.26, 5472, 3648),
    CameraPreset("Air 2S", ("FC3411",), 13.2, 8.8, 8.38, 5472, 3648, 0.03),
    CameraPreset("Mini 5 Pro", (), 12.8, 9.6, 8.88, 8192, 6144, 0.05),
    CameraPreset("senseFly S.O.D.A.", ("S.O.D.A.", "SODA"), 12.75, 8.5, 10.6, 5472, 3648),
    # 1/2 and 1/1.3 inch
    CameraPreset("Mavic Air 2", ("FC3170",), 6.4, 4.8, 4.5, 4000, 3000, 0.03),
    CameraPreset("Mavic 3T", ("M3T", "M3TD"), 6.4, 4.8, 4.4, 4000, 3000, 0.03),
    CameraPreset("Matrice 30", ("M30", "M30T"), 6.49, 4.87, 4.5, 4000, 3000, 0.03),
    CameraPreset("Matrice 4T", ("M4T", "M4TD"), 9.7, 7.3, 6.72, 8064, 6048, 0.04),
    CameraPreset("Zenmuse H30", ("H30", "H30T"), 9.7, 7.3, 6.72, 8064, 6048, 0.04),
    CameraPreset("Air 3", (), 9.7, 7.3, 6.72, 8064, 6048, 0.04),
    CameraPreset("Air 3 tele", (), 9.7, 7.3, 19.6, 8064, 6048, 0.05),
    CameraPreset("Zenmuse H20", ("ZH20", "ZH20T", "ZH20N"), 6.17, 4.63, 4.5, 4056, 3040, 0.05),
    CameraPreset("Mini 3", ("FC3682",), 9.7, 7.3, 6.72, 4000, 3000, 0.04),
    CameraPreset("Mini 3 Pro", ("FC3582",), 9.7, 7.3, 6.72, 4032, 3024, 0.04),
    CameraPreset("Mini 4 Pro", ("FC8482",), 9.7, 7.3, 6.72, 4032, 3024, 0.06),
    # 4/3 inch and larger
    CameraPreset("Mavic 3", ("L2D-20c",), 17.3, 13.0, 12.29, 5280, 3956, 0.03),
    CameraPreset("Mavic 3E", ("M3E", "M3M"), 17.3, 13.0, 12.29, 5280, 3956, 0.03),
    CameraPreset("Matrice 4E", ("M4E", "M4D"), 17.3, 13.0, 12.29, 5280, 3956, 0.03),
    CameraPreset("Zenmuse L2", (), 17.3, 13.0, 12.29, 5280, 3956, 0.03),
    CameraPreset(
        "Zenmuse X5", ("FC550", "FC550RAW"), 17.3, 13.0, 15.0, 4608, 3456, changes_lens=True
    ),
    CameraPreset("Zenmuse X5S", ("FC6520",), 17.3, 13.0, 15.0, 5280, 3956, changes_lens=True),
    CameraPreset("Zenmuse X7", ("FC6540",), 23.5, 15.7, 24.0, 6016, 4008, changes_lens=True),
    CameraPreset("Zenmuse P1", ("ZenmuseP1",), 35.9, 24.0, 35.0, 8192, 5460, changes_lens=True),
    CameraPreset("senseFly Aeria X", ("AeriaX",), 23.5, 15.6, 18.5, 6000, 4000),
    # Skydio's own calibrations: the sensor's size is that which makes its focal length in mm one in pixels
    CameraPreset(
        "Skydio 2", ("Skydio 2+", "Skydio X2", "Skydio X2 WIDE"), 6.315, 4.733, 3.7, 4056, 3040
    ),
    CameraPreset(
        "Skydio X2 narrow", ("X2E", "X2D", "Skydio X2 NARROW"), 6.275, 4.718, 7.5, 4056, 3040
    ),
    CameraPreset(
        "Skydio X10 wide", ("VT300-L_93", "V100-L_93"), 13.107, 9.83, 7.74, 8192, 6144, 0.03
    ),
    CameraPreset(
        "Skydio X10 narrow",
        ("VT300-Z_50", "VT300-L_50", "V100-L_50"),
        7.213,
        5.44,
        9.88,
        9248,
        6944,
    ),
    # unverified, from memory (docs/calibrate.md): focal lengths that an angle of view or a length at 35 mm gives
    CameraPreset("Autel EVO II", ("XT701",), 6.4, 4.8, 4.74, 8000, 6000, 0.06),
    CameraPreset("Autel EVO II Pro", ("XT705", "XL705"), 12.75, 8.5, 10.57, 5472, 3648, 0.05),
    CameraPreset("Autel EVO II Dual 640T", ("XT709",), 6.4, 4.8, 4.74, 8000, 6000, 0.06),
    CameraPreset("Autel EVO Nano", ("XT724",), 6.4, 4.8, 4.36, 8000, 6000, 0.06),
    CameraPreset("Autel EVO Nano Plus", ("XL724",), 9.8, 7.35, 6.6, 8192, 6144, 0.06),
    CameraPreset("Autel EVO Max 4T", (), 9.8, 7.35, 6.6, 8192, 6144, 0.06),
    CameraPreset("Parrot ANAFI Ai", ("AnafiAi",), 6.4, 4.8, 4.4, 8000, 6000, 0.06),
    # lenses far from a pinhole: a calibration is worth much more than the preset
    CameraPreset(
        "Parrot ANAFI", ("Anafi", "AnafiUSA", "AnafiThermal"), 5.985, 4.498, 4.0, 5344, 4016, 0.05
    ),
    CameraPreset("GoPro HERO4", ("HERO4 Black", "HERO4 Silver"), 6.17, 4.63, 2.92, 4000, 3000, 0.1),
    CameraPreset("GoPro HERO5", ("HERO5 Black", "HERO6 Black"), 6.17, 4.63, 2.92, 4000, 3000, 0.1),
    # multispectral and thermal, beside the colour camera of the same name: the focal length in EXIF distinguishes them
    CameraPreset("Mavic 3M multispectral", ("M3M",), 5.133, 3.874, 4.34, 2592, 1944, 0.03),
    CameraPreset("Mavic 3T thermal", ("M3T", "M3TD"), 7.68, 6.144, 9.1, 640, 512, 0.04),
    CameraPreset("Matrice 30T thermal", ("M30T",), 7.68, 6.144, 9.1, 640, 512, 0.04),
    CameraPreset("Matrice 4T thermal", ("M4T", "M4TD"), 7.68, 6.144, 12.05, 640, 512, 0.05),
    CameraPreset("Zenmuse H20T thermal", ("ZH20T",), 7.68, 6.144, 13.5, 640, 512, 0.04),
    CameraPreset(
        "Skydio X10 thermal", ("VT300-Z_40", "VT300-L_40"), 7.68, 6.144, 13.6, 640, 512, 0.03
    ),
    CameraPreset(
        "Autel EVO II Dual 640T thermal", ("XT709", "XL709"), 7.68, 6.144, 13.0, 640, 512, 0.05
    ),
    CameraPreset("Autel EVO Max 4T thermal", (), 7.68, 6.144, 9.1, 640, 512, 0.05),
    CameraPreset("Zenmuse H30T thermal", ("H30T",), 15.36, 12.288, 24.0, 1280, 1024, 0.04),
)


_SOLD_AS = {
    "Phantom 3 Advanced": "Phantom 3",
    "Phantom 3 Professional": "Phantom 3",
    "Phantom 3 Standard": "Phantom 3",
    "Phantom 3 SE": "Phantom 3",
    "Phantom 4 Advanced": "Phantom 4 Pro",
    "Phantom 4 Pro V2.0": "Phantom 4 Pro",
    "Inspire 1": "Zenmuse X3",
    "Mavic Pro Platinum": "Mavic Pro",
    "Mavic 3 Classic": "Mavic 3",
    "Mavic 3 Cine": "Mavic 3",
    "Mavic 3 Pro": "Mavic 3",
    "Mavic 3 Enterprise": "M3E",
    "Mavic 3 Thermal": "M3T",
    "Mavic 3 Multispectral": "M3M",
    "Matrice 30T": "M30T",
    "Matrice 4 Enterprise": "M4E",
    "Matrice 4 Thermal": "M4T",
}
"""Full names of drones that have a preset's camera: the preset's name or its code in EXIF."""


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

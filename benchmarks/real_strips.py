"""The strips of real photo flights that are compared with each other, and the crowns of their ground.

A strip is what a flight passes over in one direction; the next one sees most of the same ground from beside.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sorvolo.geometry.geodesy import LocalFrame, Projection
from sorvolo.geometry.polygons import points_inside
from sorvolo.lab.evaluation.change_metrics import ComparedGround


@dataclass(frozen=True)
class RealFlight:
    """A flight's strips, as the first and last number in their photos' names, and which of them are compared.

    `shadow_deg` is where shadows point, from east to north, measured on the map; None under clouds.
    """

    strips: tuple[tuple[int, int], ...]
    pairs: tuple[tuple[int, int], ...]
    shadow_deg: float | None
    is_held_out: bool
    is_grey: bool = False


FLIGHTS = {
    "brighton_beach": RealFlight(((18, 23), (24, 29), (30, 35)), ((0, 1), (1, 2)), 10.0, False),
    "caliterra": RealFlight(
        (
            (9364, 9370),
            (9374, 9379),
            (9384, 9389),
            (9394, 9399),
            (9403, 9409),
            (9413, 9417),
            (9423, 9430),
        ),
        ((0, 1), (2, 3), (4, 5), (4, 6)),
        None,
        False,
    ),
    "fixed_wing": RealFlight(
        ((552, 557), (558, 564), (565, 573), (574, 578), (579, 583)),
        ((0, 1), (1, 2), (2, 3), (3, 4)),
        90.0,
        True,
        True,
    ),
}


# UTM metres less the offset (east, north), outlines of crowns and tall shrubs
CROWNS: dict[str, tuple[str, tuple[float, float], list[list[tuple[float, float]]]]] = {
    "brighton_beach": (
        "EPSG:32615",
        (576628.1, 5188243.3),
        [
            [
                (-12, -70),
                (15, -30),
                (25, -18),
                (60, 15),
                (80, -2),
                (88, -2),
                (108, -17),
                (102, -34),
                (95, -43),
                (89, -51),
                (86, -56),
                (77, -60),
                (72, -65),
                (68, -72),
                (62, -76),
                (55, -81),
                (50, -86),
                (49, -94),
                (44, -98),
                (37, -103),
            ],
            [
                (97, -93),
                (103, -86),
                (112, -86),
                (114, -91),
                (118, -94),
                (125, -95),
                (128, -91),
                (137, -89),
                (133, -100),
                (127, -105),
                (126, -113),
                (120, -120),
                (114, -127),
                (107, -127),
                (100, -122),
                (99, -115),
                (98, -103),
            ],
            [
                (112, -59),
                (120, -53),
                (128, -49),
                (137, -50),
                (144, -56),
                (137, -66),
                (133, -74),
                (124, -73),
                (112, -68),
            ],
            [(100, -82), (108, -79), (116, -76), (121, -80), (114, -87), (103, -89)],
            [(104, -70), (114, -70), (114, -76), (104, -76)],
            [(69, -75), (74, -71), (81, -71), (87, -77), (84, -83), (77, -83), (71, -80)],
            [(76, -95), (84, -93), (86, -98), (81, -103), (76, -100)],
            [(89, -56), (97, -54), (98, -60), (91, -61)],
            [(100, -46), (109, -46), (113, -49), (109, -53), (100, -52)],
            [(102, -54), (109, -53), (110, -59), (103, -60)],
            [(83, -63), (96, -62), (96, -69), (83, -69)],
            [
                (66, -128),
                (68, -120),
                (76, -115),
                (86, -113),
                (91, -110),
                (97, -112),
                (98, -118),
                (90, -121),
                (80, -119),
                (77, -124),
                (70, -130),
                (65, -136),
                (59, -137),
                (59, -133),
            ],
            [(133, -91), (136, -82), (141, -75), (151, -80), (146, -87), (139, -91)],
            [(71, -81), (77, -81), (77, -91), (71, -91)],
            [(83, -81), (88, -81), (89, -90), (83, -90)],
            [(40, -117), (43, -113), (49, -114), (50, -119), (46, -120)],
        ],
    ),
    "caliterra": (
        "EPSG:32614",
        (587519.4, 3338227.7),
        [
            [
                (45, -35),
                (71, -45),
                (64, -68),
                (56, -84),
                (52, -111),
                (45, -128),
                (37, -137),
                (35, -145),
                (-10, -140),
                (5, -105),
                (20, -85),
                (30, -60),
            ],
            [(117, -26), (128, -23), (141, -40), (138, -44), (123, -39)],
            [
                (104, -170),
                (108, -157),
                (120, -152),
                (132, -160),
                (133, -176),
                (121, -186),
                (108, -183),
            ],
            [(152, -169), (160, -160), (172, -162), (176, -172), (170, -183), (158, -183)],
        ],
    ),
}


def photos_of(folder: Path, strip: tuple[int, int]) -> list[Path]:
    """The photos of a strip, by the number in their names."""
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in (".jpg", ".jpeg"))
    return [path for path in files if strip[0] <= int(path.stem.split("_")[1]) <= strip[1]]


def crowns_m(name: str, frame: LocalFrame) -> list[np.ndarray]:
    """The crowns of a flight's ground in the site's metres."""
    if name not in CROWNS:
        return []
    crs, (east, north), rings = CROWNS[name]
    outlines = []
    for ring in rings:
        latitude, longitude = Projection(crs).wgs84_from_projected(
            np.array(ring, float) + np.array([east, north])
        )
        outlines.append(frame.ground_from_lonlat(np.column_stack([longitude, latitude])))
    return outlines


def within(crowns: list[np.ndarray], points_m: np.ndarray) -> np.ndarray:
    """(N,) whether points lie in any crown."""
    return np.any(
        [points_inside([ring], points_m) for ring in crowns] or [np.zeros(len(points_m), bool)],
        axis=0,
    )


def crown_area_m2(ground: ComparedGround, crowns: list[np.ndarray]) -> float:
    """Compared ground under crowns, counted on every fifth cell each way."""
    rows, columns = np.nonzero(ground.cells[::5, ::5])
    if not len(rows):
        return 0.0
    step_m = 5 * ground.cell_m
    points = np.column_stack([ground.west_m + columns * step_m, ground.north_m - rows * step_m])
    return float(within(crowns, points).mean()) * ground.area_m2

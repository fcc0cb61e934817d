"""Waypoints over what a search did not see well enough, where another flight may."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sorvolo.detection.contract import ModelInfo
from sorvolo.geometry.arrays import Floats
from sorvolo.missions.plan_flight import ReflySettings, fly_again
from sorvolo.missions.search.report import Searched, is_coarse, needed_m_per_px
from sorvolo.missions.search.settings import SearchSettings
from sorvolo.store.exports.pod_files import CellGrid, Region, swollen_polygons
from sorvolo.survey.area import Area


@dataclass(frozen=True)
class Refly:
    """A second flight: how many holes of which area, how high, how long, and the files."""

    holes: int
    area_m2: float
    height_m: float
    duration_s: float
    files: tuple[str, ...]


def write_refly(
    again: Sequence[Region],
    grid: CellGrid,
    searched: Searched,
    settings: SearchSettings,
    info: ModelInfo,
    files: Sequence[Path],
    *,
    dji_drone: str,
) -> Refly | None:
    """Plan passes over the holes and write them; None where no hole is worth a flight.

    It is flown as high as the first flights, lower where their pictures were too coarse for the detector.
    """
    pace = ReflySettings()
    large = [each for each in again if each.area_m2 >= pace.least_m2][: pace.most_holes]
    if not large:
        return None
    area = Area(tuple(_rings(large, grid)), "holes of the search")
    camera, height_m = searched.camera, searched.height_m
    if is_coarse(searched, settings, info):
        needed = needed_m_per_px(searched.labels[0], info)
        height_m = max(pace.lowest_m, min(height_m, 0.9 * needed * camera.fx_px))
    plan = fly_again(area, camera, height_m, files, dji_drone=dji_drone, settings=pace)
    return Refly(
        len(large),
        sum(each.area_m2 for each in large),
        plan.height_m,
        plan.duration_s,
        tuple(map(str, files)),
    )


def _rings(regions: Sequence[Region], grid: CellGrid) -> list[tuple[Floats, ...]]:
    return swollen_polygons(regions, grid, grid.cell_m / 2)

"""`sorvolo search --through-trees`: a mapped flight's pictures put together on the floor below crowns, and its finds."""

import json
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sorvolo.canopy.finds import Find, Finds, average, look_under_trees
from sorvolo.canopy.integral import LEAST_VIEWS, Floor, Picture, UnderTrees, lay, levelled
from sorvolo.canopy.planting import PlantedFloor, free_share, plant_on_floor
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats32, ImageGray, ImageRGB, ImageRGBA, Numbers, shrunk
from sorvolo.heights.cameras import Cameras3D, Matches, find_tracks, solve_steady, solve_tracks
from sorvolo.heights.field import HeightField
from sorvolo.heights.figures import camera_figures
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.views import View, ground_outlines_m
from sorvolo.missions.heights.run import (
    FlightPictures,
    flight_views,
    height_grid,
    newest_flight,
    run_of,
    solved_before,
)
from sorvolo.missions.mission import mission
from sorvolo.missions.search.measure import SeenFloor
from sorvolo.paths import AnyPath
from sorvolo.registration.features import gray_from_rgb
from sorvolo.store.atomic import atomic_write_bytes, make_folder, write_page
from sorvolo.store.exports.places import place_deg
from sorvolo.store.exports.plain import feature, feature_collection, geojson_bytes, json_bytes
from sorvolo.store.images import BytesCache, jpeg_from_image
from sorvolo.store.pages.search import under_trees_page
from sorvolo.store.rasters.height_model import read_height_cog, write_height_cog
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.files import UNDER_TREES
from sorvolo.survey.flight import Site
from sorvolo.survey.map_objects import MapObject
from sorvolo.survey.objects import PERSON
from sorvolo.survey.wording import counted

_PICTURES_BYTES = 224 << 20
_LEAST_CELL_M = 0.08  # a body is ten cells long; finer ones cost more and show no more
_GRAY = 12  # levels between the colours of a pixel in a thermal picture, at most
FLOOR_M = -40.0, 5.0
"""Where the floor is looked for, above a map's level ground: that may be crowns."""
_TILT = float(np.tan(np.radians(10)))  # as far as fixes alone hold the tilt that cameras share
_MOST_STRETCH = 0.06  # of the focal length, three sigmas of what it may be off
_MOST_SWING_DEG = 3.0  # median, of cameras that a gimbal holds
_LEAST_STEADY = 0.7  # of the observations, that fit cameras of one tilt
_POD = "pod", "pod_low", "pod_high"
_RING_M = 2.0  # around a find
_CROP_M, _CROP_CELL_M = 8.0, 0.04


@dataclass(frozen=True)
class UnderTreesUpdate:
    """What a look below the trees does next: stage `number` of `total`."""

    flight: str
    stage: str
    number: int
    total: int = 3


@dataclass(frozen=True, eq=False)
class LookedUnderTrees:
    """What pictures put together show of the floor: what files and pages state of it, and the finds as objects."""

    report: dict[str, Any]
    objects: tuple[MapObject, ...]
    finds: Finds
    views: Sequence[View]  # with pixels of a body's size
    picture: Picture
    under: UnderTrees
    cameras: Mapping[str, Any]
    site: Site

    def write(self, folder: Path) -> None:
        """Write under_trees.tif (mean, anomaly, number of views, free share, floor's height), .html, .geojson and .json."""
        under, site, report = self.under, self.site, self.report
        make_folder(folder)
        free, floor_m = (
            free_share(under, self.views, self.picture),
            under.floor_m + site.origin.height_m,
        )
        bands = under.mean, under.anomaly, under.views.astype(np.float32), free, floor_m
        names = "mean", "anomaly, sigmas", "views", "free share", f"floor, {site.height_reference}"
        grid = height_grid(site, report["cell_m"]).grid
        write_height_cog(bands, names, under.lattice.first, grid, folder / "under_trees.tif")
        features = [
            feature({"type": "Point", "coordinates": place_deg(find.place_m, site)}, row)
            for find, row in zip(self.finds.people, report["people"])
        ]
        collection = feature_collection("under_trees", features, is_local=False)
        atomic_write_bytes(folder / "under_trees.geojson", geojson_bytes(collection))
        atomic_write_bytes(folder / "under_trees.json", json_bytes(report))
        ringed = _ringed(under, self.finds)
        page = under_trees_page(report, ringed, [each.crop_jpeg for each in self.objects])
        write_page(folder / "under_trees.html", page)


def look_through_trees(
    name: str,
    site: Site,
    views: Sequence[View],
    opened: Callable[[Sequence[View], tuple[float, float]], Callable[[int], ImageRGB]],
    times_ns: Mapping[str, int],
    sigma_m: float,
    *,
    before: Cameras3D | None = None,
    floor_m: tuple[float, float] = FLOOR_M,
    plants: int = 80,
    matches: Matches | None = None,
    is_quick: bool = False,
) -> Generator[UnderTreesUpdate, None, LookedUnderTrees]:
    """Put a flight's views together on the floor, yielding progress.

    `opened` gives the pictures of views by number, the left-over distortion taken out; `sigma_m` is what places err by
    where cameras are solved. `before` are cameras that were solved before, `matches` what earlier looks at the
    flight's views left; `is_quick` takes all tilts as one, and plants nothing. Raises InputError for too few pictures,
    or without a floor in focus.
    """
    if len(views) < LEAST_VIEWS:
        raise InputError(
            f"flight {name} has {len(views)} pictures with a place; to look through trees each spot needs "
            f"{LEAST_VIEWS} or more: fly strips side by side, and map photos or watch the flight (a map keeps few frames of a video)"
        )
    yield UnderTreesUpdate(name, "cameras", 0)
    radial = 0.0, 0.0
    solved, warning = _solved(views, opened(views, radial), before, matches, is_quick=is_quick)
    if solved is not None:
        views, radial = solved.views, solved.radial
    unknown = np.zeros((0, 3)), np.nan, 1.0, radial, np.full(3, np.nan), 0
    cameras = camera_figures(solved or Cameras3D(tuple(views), (), *unknown))
    yield UnderTreesUpdate(name, "floor", 1)
    colour = opened(views, radial)
    views, cell_m = _at_body_size(views, floor_m[0])
    is_thermal = int(np.ptp(colour(0).astype(np.int16), axis=2).max()) <= _GRAY

    def load(number: int) -> Any:
        size = views[number].camera.width_px, views[number].camera.height_px
        stored = gray_from_rgb(colour(number)) if is_thermal else colour(number)
        image = shrunk(stored, size)
        # half levels take half the memory of floats: a median is at one
        return (2 * levelled(image)).astype(np.int16)

    kept = BytesCache[int, Any](_PICTURES_BYTES, lambda image: image.nbytes)

    def picture(number: int) -> Floats32:
        return kept.get(number, lambda: load(number)) * np.float32(0.5)

    lattice = Lattice.over(ground_outlines_m(views, floor_m[0]), height_grid(site, cell_m))
    under, floor, finds = look_under_trees(views, picture, lattice, *floor_m)
    planted = None
    if is_thermal and not is_quick:
        yield UnderTreesUpdate(name, "planted bodies", 2)
        planted = plant_on_floor(under, views, picture, finds.people, plants)
    if warning:  # of cameras that share a tilt, which nothing but their fixes holds
        above_m = np.median([each.site_from_camera.translation_m[2] for each in views])
        sigma_m = float(np.hypot(sigma_m, _TILT * (above_m - np.median(floor.up_m))))
    crops = [_crop(each, views, picture) for each in finds.people]
    report = _report(name, site, under, floor, finds, planted, sigma_m)
    report |= {"pictures": len(views), "warnings": [warning] if warning else [], "cell_m": cell_m}
    report["headline"]["complete"] = not warning
    if warning:
        report["headline"]["text"] += (
            f"; the cameras may be off: places are good to {sigma_m:.0f} m, and people may be missed"
        )
    objects = _objects(name, finds, sigma_m, times_ns, crops)
    return LookedUnderTrees(report, tuple(objects), finds, views, picture, under, cameras, site)


@mission
def search_under_trees(
    site_folder: AnyPath, folder: AnyPath, *, flight: str = "", plants: int = 80
) -> Generator[UnderTreesUpdate, None, dict[str, Any]]:
    """Put a flight's pictures together on the floor below the trees, yielding progress; the result is the report.

    `plants` bodies are planted on the floor of thermal pictures for the probability of detection.
    The files of `LookedUnderTrees.write` appear in `folder`; the finds become objects of the flight. Raises InputError
    for a flight without GPS, with too few pictures or without a floor in focus.
    """
    Archive.open(Path(site_folder), write=False).close()  # to write would make a folder
    with Archive.open(Path(site_folder), write=True) as archive:
        name, site = flight or newest_flight(archive), archive.site()
        keyframes = [each for each in archive.sound_keyframes(name) if each.site_from_camera]
        views = flight_views(archive, name, keyframes)
        by_name = {each.name: each for each in keyframes}
        looked = yield from look_through_trees(
            name,
            site,
            views,
            lambda some, radial: (
                FlightPictures(archive, [by_name[each.name] for each in some], radial).load
            ),
            {each.name: each.time_ns for each in keyframes},
            float(np.median([each.sigma_m for each in keyframes])),
            before=solved_before(archive, keyframes, views),
            plants=plants,
        )
        archive.keep_under_trees(name, looked.objects)
        low, high = np.nanpercentile(looked.under.contrast, [1, 99.5])
        report = looked.report | {"run": run_of(keyframes)}
        kept_floor = {
            "run": report["run"],
            "floor_m": report["floor_m"] - site.origin.height_m,
            "levels": [float(low), float(high)],
            "cameras": looked.cameras,
        }
        file = f"flights/{name}/{UNDER_TREES}"
        with archive.replacing(file):
            atomic_write_bytes(archive.folder / file, json_bytes(kept_floor))
        report["notices"] = [asdict(each) for each in archive.notices]
    replace(looked, report=report).write(Path(folder))
    return report


def seen_floor(folder: Path, archive: Archive, flight: str) -> SeenFloor | None:
    """What a look through the trees of a flight's present map, its files in `folder`, saw of the floor; None without
    one, without its probability of detection, or where its cameras were not solved as they should be."""
    try:
        report = json.loads((folder / "under_trees.json").read_text())
        is_present = report["flight"] == flight and report["run"] == run_of(
            archive.keyframes(flight)
        )
        if not (is_present and report["detection"] and report["headline"]["complete"]):
            return None
        grid = height_grid(archive.site(), float(report["cell_m"]))
        read = read_height_cog(folder / "under_trees.tif", grid.grid)
        _, _, views, free, _ = read.bands
        lattice = Lattice.at(grid, read.first, views.shape[1], views.shape[0])
        pod = {name: float(report["detection"][name]) for name in _POD}
        return SeenFloor(pod, HeightField(lattice, views, free))
    except (OSError, ValueError, KeyError, TypeError, InputError):  # damaged: it counts as unseen
        return None


def _solved(
    views: Sequence[View],
    colour: Callable[[int], ImageRGB],
    before: Cameras3D | None,
    matches: Matches | None,
    *,
    is_quick: bool,
) -> tuple[Cameras3D | None, str]:
    """The cameras in space, as solved before where heights are made, else none, and a warning where they are not what
    they should be.

    Where crowns share few points, cameras that are free end anywhere; then a gimbal's one tilt and the fixes hold them.
    """

    def gray(number: int) -> ImageGray:
        return gray_from_rgb(colour(number))

    try:
        if before is None:
            tracks = find_tracks(views, gray, matches)
        if matches is not None and not is_quick:  # the last look
            matches.features.clear()
        is_held = False
        if not is_quick:
            free = before or solve_tracks(views, tracks)
            # how far cameras tilt from their usual tilt: a gimbal's hardly do, those that crowns leave free do
            ups = np.array([view.site_from_camera.rotation[2] for view in free.views])
            swings = np.linalg.norm(ups - np.median(ups, axis=0), axis=1)
            swing_deg, stretch = np.degrees(np.median(swings)), abs(np.log(free.focal_scale))
            is_held = len(free.lost) <= 0.1 * len(views) and stretch < _MOST_STRETCH
            if is_held and swing_deg < _MOST_SWING_DEG:
                return free, ""
        if before is not None:
            views = _by_given_lens(views, before)
            tracks = find_tracks(views, gray)
        steady = solve_steady(views, tracks)
        share = steady.observations / len(tracks.view)
        why = (
            f"points hold {len(steady.views)} of {len(views)} pictures, and {share:.0%} of them fit"
        )
        if len(steady.lost) <= 0.3 * len(views) and share > _LEAST_STEADY:
            held = f"{why}: the camera's tilt was taken as steady, and people may be missed if it was not"
            return steady, held
        if is_held:
            return (
                free,
                f"cameras tilt by {swing_deg:.0f} degrees to and fro: crowns may have held them badly",
            )
    except InputError as error:
        why = f"{error}"
    return None, (
        f"cameras are as mapped, not solved in space ({why}): 0.5 m or 1 degree of error hides people"
    )


def _by_given_lens(views: Sequence[View], before: Cameras3D) -> Sequence[View]:
    """Views by the lens that the flight was mapped with, not by that which free cameras made of crowns: a map over
    heights keeps theirs, and a flat one its own. Where it is taken back its centre is the picture's middle."""
    camera, focal_px = views[0].camera, before.views[0].camera.fx_px / before.focal_scale
    if np.isclose(camera.fx_px, focal_px):
        return views
    x_px, y_px = (camera.width_px - 1) / 2, (camera.height_px - 1) / 2
    given = replace(camera.with_focal_px(focal_px), cx_px=x_px, cy_px=y_px)
    return [replace(view, camera=given) for view in views]


def _at_body_size(views: Sequence[View], lowest_m: float) -> tuple[list[View], float]:
    """The views with pixels on the lowest floor no finer than the cells, and the cells' side, m."""
    height_m = float(np.median([each.site_from_camera.translation_m[2] for each in views]))
    focal_px = views[0].camera.fx_px
    cell_m = float(f"{max(height_m / focal_px, _LEAST_CELL_M):.3g}")
    share = min(1.0, (height_m - lowest_m) / focal_px / cell_m * 1.25)
    return [each.smaller(share) for each in views], cell_m


def _report(
    name: str,
    site: Site,
    under: UnderTrees,
    floor: Floor,
    finds: Finds,
    planted: PlantedFloor | None,
    sigma_m: float,
) -> dict[str, Any]:
    seen = under.views >= LEAST_VIEWS
    seen_m2 = float(seen.sum()) * under.lattice.cell_m**2
    text = (
        f"{counted(len(finds.people), 'possible person')} under trees on {seen_m2:,.0f} m2 of floor"
    )
    pod = None
    if planted is not None and len(planted.found):
        pod = dict(zip(_POD, planted.pod))
        pod |= {"planted": len(planted.found), "free_share": float(planted.free_share.mean())}
        text += (
            f"; probability of detection of a person lying there: {pod['pod']:.2f} (90 % interval "
            f"{pod['pod_low']:.2f} to {pod['pod_high']:.2f})"
        )
    people = []
    for find in finds.people:
        longitude_deg, latitude_deg = place_deg(find.place_m, site)
        place = {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg, "sigma_m": sigma_m}
        people.append(asdict(find) | place | {"place_m": find.place_m.tolist()})
    return {
        "flight": name,
        "headline": {"text": text},
        "people": people,
        "refused": dict(finds.refused),
        "seen_m2": seen_m2,
        "views_median": float(np.median(under.views[seen])),
        "detection": pod,
        "floor_m": float(np.median(floor.up_m)) + site.origin.height_m,
        "floor_sigma_m": float(np.median(floor.sigma_m)),
        "height_reference": site.height_reference,
    }


def _objects(
    name: str,
    finds: Finds,
    sigma_m: float,
    times_ns: Mapping[str, int],
    crops: Sequence[Any],
) -> list[MapObject]:
    """The finds, each with its crop, as objects of the flight."""
    return [
        MapObject(
            f"{name}-u{number}",
            PERSON,
            float(np.clip(find.weakest_half, 0, 1)),
            find.place_m[:2],
            sigma_m,
            *find.size_m,
            find.views,
            find.views,
            min(times_ns[each] for each in find.pictures),
            max(times_ns[each] for each in find.pictures),
            class_scores={PERSON: 1.0},
            best_frame=find.pictures[0],
            crop_jpeg=jpeg_from_image(crop),
        )
        for number, (find, crop) in enumerate(zip(finds.people, crops, strict=True), start=1)
    ]


def _crop(find: Find, views: Sequence[View], picture: Picture) -> Any:
    """(H, 2 W, 3) the floor around a find, in the picture that shows it best and in the mean of all."""
    half, cells = _CROP_M / 2, round(_CROP_M / _CROP_CELL_M)
    east_m, north_m, up_m = find.place_m
    corner = [[_CROP_CELL_M, 0, east_m - half], [0, -_CROP_CELL_M, north_m + half], [0, 0, 1]]
    window = Lattice(np.array(corner), cells, cells, _CROP_CELL_M)
    laid = [lay(view, picture(number), window, float(up_m)) for number, view in enumerate(views)]
    numbers = {view.name: number for number, view in enumerate(views)}
    shown = [laid[numbers[find.pictures[0]]], average(np.stack(laid))]
    return np.hstack([_stretched(each) for each in shown])


def _ringed(under: UnderTrees, finds: Finds) -> ImageRGBA:
    """(H, W, 4) what stands out from the floor around it, with a ring around each find."""
    picture = _stretched(under.contrast[..., None])
    lattice = under.lattice
    for find in finds.people:
        x, y = np.round(lattice.cells_from_site(find.place_m[None, :2])[0]).astype(int).tolist()
        cv2.circle(picture, (x, y), round(_RING_M / lattice.cell_m), (255, 60, 60), 2, cv2.LINE_AA)
    return np.dstack([picture, np.isfinite(under.mean).astype(np.uint8) * 255])


def _stretched(levels: Numbers) -> Any:
    """(H, W, 3) uint8 between the darkest and the brightest of a hundred."""
    low, high = np.nanpercentile(levels, [1, 99.5])
    grey = np.clip((np.nan_to_num(levels, nan=low) - low) / max(high - low, 1e-6) * 255, 0, 255)
    return np.broadcast_to(grey, (*grey.shape[:2], 3)).astype(np.uint8)

"""`sorvolo search --through-trees`: a mapped flight's pictures put together on the floor below crowns, and its finds."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sorvolo.canopy.finds import Find, look_under_trees
from sorvolo.canopy.integral import LEAST_VIEWS
from sorvolo.errors import InputError
from sorvolo.heights.cameras import solve_cameras
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.views import View, ground_outlines_m
from sorvolo.missions.heights.run import FlightPictures, flight_views, height_grid, newest_flight
from sorvolo.paths import AnyPath
from sorvolo.store.atomic import atomic_write_bytes, make_folder
from sorvolo.store.exports.places import place_deg
from sorvolo.store.exports.plain import feature, feature_collection, geojson_bytes, json_bytes
from sorvolo.store.images import ImageCache
from sorvolo.store.rasters.height_model import write_height_cog
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import Site

_PICTURES_BYTES = 160 << 20
_LEAST_CELL_M = 0.08  # a body is ten cells long; finer ones cost more and show no more
_GRAY = 12  # levels between the colours of a pixel in a thermal picture, at most


def search_under_trees(
    site_folder: AnyPath,
    folder: AnyPath,
    *,
    flight: str = "",
    floor_m: tuple[float, float] = (-30.0, 5.0),
) -> dict[str, Any]:
    """Put a flight's pictures together on the floor below the trees; return the report, with files in `folder`.

    The floor is looked for between two heights, `floor_m`, above the map's level ground. Files: under_trees.tif
    (mean, anomaly, number of views, floor's height), under_trees.geojson and under_trees.json.
    Raises InputError for a flight without GPS, with too few pictures or without a floor in focus.
    """
    folder, notices = Path(folder), []
    with Archive.open(Path(site_folder), write=False) as archive:
        name = flight or newest_flight(archive)
        keyframes = [each for each in archive.sound_keyframes(name) if each.site_from_camera]
        views: Sequence[View] = flight_views(archive, name, keyframes)
        if len(views) < LEAST_VIEWS:
            raise InputError(
                f"flight {name} has {len(views)} pictures with a place; to look through trees each spot needs "
                f"{LEAST_VIEWS} or more: map photos of strips side by side (of a video only few frames are kept)"
            )
        radial = 0.0, 0.0
        try:
            solved = solve_cameras(views, FlightPictures(archive, keyframes).gray)
        except InputError as error:
            notices.append(f"cameras are as mapped, not solved in space: {error}")
        else:
            views, radial = solved.views, solved.radial
            keyframes = [each for each in keyframes if each.name not in set(solved.lost)]
        site = archive.site()
        pictures = FlightPictures(archive, keyframes, radial)
        height_m = float(np.median([each.site_from_camera.translation_m[2] for each in views]))
        pixel_m = height_m / views[0].camera.fx_px
        cell_m = float(f"{max(pixel_m, _LEAST_CELL_M):.3g}")
        share = min(1.0, pixel_m / cell_m * 1.25)
        views = [
            replace(v, camera=v.camera.resized(*(max(32, round(n * share)) for n in (v.camera.width_px, v.camera.height_px))))
            for v in views
        ]  # fmt: skip
        colours = pictures.colour(0).astype(np.int16)
        is_thermal = int(np.ptp(colours, axis=2).max()) <= _GRAY

        def load(number: int) -> Any:
            size = views[number].camera.width_px, views[number].camera.height_px
            image = cv2.resize(pictures.colour(number), size, interpolation=cv2.INTER_AREA)
            return image[..., 1] if is_thermal else image

        grid = height_grid(site, cell_m)
        lattice = Lattice.over(ground_outlines_m(views), grid)
        under, floor, finds = look_under_trees(
            views, ImageCache(load, _PICTURES_BYTES).get, lattice, *floor_m
        )
    zero_m = site.origin.height_m
    make_folder(folder)
    bands = under.mean, under.anomaly, under.views.astype(np.float32), under.floor_m + zero_m
    names = "mean", "anomaly, sigmas", "views", f"floor, {site.height_reference}"
    write_height_cog(bands, names, lattice.first, grid.grid, folder / "under_trees.tif")
    seen = under.views >= LEAST_VIEWS
    rows = [_properties(each, site) for each in finds.people]
    report = {
        "flight": name,
        "people": rows,
        "refused": dict(finds.refused),
        "pictures": len(views),
        "seen_m2": float(seen.sum()) * cell_m**2,
        "views_median": float(np.median(under.views[seen])),
        "floor_m": float(np.median(floor.up_m)) + zero_m,
        "floor_sigma_m": float(np.median(floor.sigma_m)),
        "height_reference": site.height_reference,
        "notices": [*notices, *(each.text for each in archive.notices)],
    }
    features = [
        feature({"type": "Point", "coordinates": place_deg(find.place_m, site)}, row)
        for find, row in zip(finds.people, rows)
    ]
    collection = feature_collection("under_trees", features, is_local=False)
    atomic_write_bytes(folder / "under_trees.geojson", geojson_bytes(collection))
    atomic_write_bytes(folder / "under_trees.json", json_bytes(report))
    return report


def _properties(find: Find, site: Site) -> dict[str, Any]:
    longitude_deg, latitude_deg = place_deg(find.place_m, site)
    return asdict(find) | {
        "latitude_deg": latitude_deg,
        "longitude_deg": longitude_deg,
        "pictures": list(find.pictures),
        "place_m": find.place_m.tolist(),
    }

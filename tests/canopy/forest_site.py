"""A site whose one flight was mapped over a forest, made without mapping."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sorvolo.geometry.geodesy import Geodetic
from sorvolo.geometry.homography import site_from_image_homography
from sorvolo.heights.views import View, outline_m
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import PlacedFrame, Status

SITE = Site("forest", Geodetic(48.33, 14.33, 400.0), "EPSG:32633", 0.05)


def forest_site(
    folder: Path, views: Sequence[View], pictures: Sequence[np.ndarray], sigma_m: float = 0.3
) -> Path:
    """The views as keyframes, their residuals camera minus fix, their pictures gray as of a thermal camera."""
    placed = [
        PlacedFrame(
            view.name,
            number,
            1_700_000_000_000_000_000 + number * 1_000_000_000,
            Status.VISION,
            "",
            view.camera,
            view.site_from_camera,
            site_from_image_homography(view.camera, view.site_from_camera),
            outline_m(view),
            0.5,
            sigma_m,
            gps_residual_m=view.site_from_camera.translation_m - view.fix_m,
        )
        for number, view in enumerate(views)
    ]
    with Archive.open(folder, write=True) as archive:
        archive.create_site(SITE)
        with archive.begin_flight("flown", "", {"method": "planar"}) as writer:
            paths = {
                number: writer.save_image(number, np.dstack([picture] * 3))
                for number, picture in enumerate(pictures)
            }
            writer.commit(placed, paths, {}, "")
    return folder

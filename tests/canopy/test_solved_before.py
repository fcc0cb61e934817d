"""A look through trees takes the cameras that heights were made with, and no others."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from forest_site import forest_site
from thermal_forest import fly, make_forest

from sorvolo.missions.heights.run import flight_views, solved_before
from sorvolo.missions.search.through_trees import _by_given_lens
from sorvolo.store.site.archive import Archive


def test_cameras_of_the_same_run_are_taken_and_those_of_an_earlier_one_are_not(
    tmp_path: Path,
) -> None:
    forest = make_forest(5, 44, 0.0, np.zeros((0, 2)), -18.0)
    views = [
        replace(each, fix_m=each.site_from_camera.translation_m + 0.4)
        for each in fly(forest, np.zeros(1), np.arange(0, 3.0))
    ]
    site = forest_site(tmp_path / "site", views, [np.zeros((512, 512), np.uint8)] * 3)
    with Archive.open(site, write=True) as archive:
        keyframes = archive.sound_keyframes("flown")
        mapped = flight_views(archive, "flown", keyframes)
        assert solved_before(archive, keyframes, mapped) is None
        cameras = {
            "places": [
                {"frame": view.name, "east_m": 1.0, "north_m": 2.0, "up_m": 30.0 + k}
                | {"rotation": np.diag([1.0, -1, -1]).ravel().tolist()}
                for k, view in enumerate(mapped[:2])
            ],
            "focal_px": 500.0,
            "optical_centre_px": [250.0, 260.0],
            "focal_scale": 0.9,
            "radial": [0.01, 0.0],
            "lost": [mapped[2].name],
            "residual_rms_px": 0.2,
            "observations": 60,
        }
        report = archive.flight_folder("flown") / "heights.json"
        run = keyframes[0].image_path.rsplit("/", 2)[-2]
        report.write_text(json.dumps({"run": run, "cameras": cameras}))
        solved = solved_before(archive, keyframes, mapped)
        assert solved is not None and solved.lost == (mapped[2].name,)
        assert [each.site_from_camera.translation_m[2] for each in solved.views] == [30, 31]
        assert solved.views[0].camera.fx_px == 500 and solved.views[0].camera.cy_px == 260
        assert np.allclose(solved.views[0].fix_m, mapped[0].fix_m)
        # the lens as given: 500 / 0.9 px, whether the map kept it, or the solved one
        given = [replace(each, camera=each.camera.with_focal_px(500 / 0.9)) for each in mapped]
        assert [each.camera for each in _by_given_lens(given, solved)] == [
            each.camera for each in given
        ]
        (taken_back, *_) = _by_given_lens(solved.views, solved)
        assert np.allclose(taken_back.camera.matrix, given[0].camera.matrix)
        report.write_text(json.dumps({"run": "an earlier one", "cameras": cameras}))
        assert solved_before(archive, keyframes, mapped) is None
        report.write_text(json.dumps({"run": run, "cameras": {}}))
        assert solved_before(archive, keyframes, mapped) is None

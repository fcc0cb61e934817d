"""Cameras above crowns, from fixes half a metre off and the map's attitudes, which take crowns for level ground."""

from dataclasses import replace

import numpy as np
from thermal_forest import CAMERA

from sorvolo.geometry.pose import NADIR_CAMERA_NORTH_UP, Pose, rotation_from_vector
from sorvolo.heights.cameras import Tracks, solve_steady
from sorvolo.heights.views import View, inside


def test_a_gimbals_one_tilt_is_found_from_fixes_and_crowns() -> None:
    draw = np.random.default_rng(20261130)
    east_m, north_m = (each.ravel() for each in np.meshgrid(np.arange(-12, 13, 4.0), np.arange(-12, 13, 2.0), indexing="ij"))  # fmt: skip
    eyes_m = np.column_stack([east_m, north_m, np.full(len(east_m), 45.0)])
    tilt = NADIR_CAMERA_NORTH_UP @ rotation_from_vector(np.radians([12.0, 5.0, 0.0]))
    back = 180.0 * (np.arange(len(eyes_m)) // 13 % 2)  # every other strip is flown the other way
    yaws = back + draw.normal(0, 2, len(eyes_m))
    turns = rotation_from_vector(np.radians(yaws)[:, None] * [0, 0, 1.0]) @ tilt
    true = [View(f"{k}", CAMERA, Pose(r, t), np.full(3, np.nan)) for k, (r, t) in enumerate(zip(turns, eyes_m))]  # fmt: skip
    crowns_m = draw.uniform([-30, -30, 18], [30, 30, 27], (2500, 3))
    view, point, seen = [], [], []
    for number, each in enumerate(true):
        pixels = each.pixels_from_site(crowns_m)
        rows = np.flatnonzero(inside(pixels, CAMERA) & (draw.uniform(size=len(crowns_m)) < 0.3))
        noisy = pixels[rows] + draw.normal(0, 0.5, (len(rows), 2))
        view, point = [*view, np.full(len(rows), number)], [*point, rows]
        seen.append(CAMERA.rays_from_pixels(noisy)[:, :2])
    tracks = Tracks(
        np.concatenate(view), np.concatenate(point), np.concatenate(seen), len(crowns_m)
    )  # fmt: skip
    off = NADIR_CAMERA_NORTH_UP.T @ tilt
    mapped = []
    for each in true:
        fix_m = each.site_from_camera.translation_m + draw.normal(0, 0.5, 3)
        lean = rotation_from_vector(np.radians(draw.normal(0, [3, 3, 6])))
        pose = Pose(each.site_from_camera.rotation @ off.T @ lean, fix_m + draw.normal(0, 0.5, 3))
        mapped.append(replace(each, site_from_camera=pose, fix_m=fix_m))
    solved = solve_steady(mapped, tracks).views
    floor_m = []
    for found, each in zip(solved, true):
        middle = np.append(each.site_from_camera.translation_m[:2], 0.0)
        ray = found.camera.rays_from_pixels(each.pixels_from_site(middle[None]))[0]
        ray = found.site_from_camera.rotation @ ray
        eye_m = found.site_from_camera.translation_m
        floor_m.append((eye_m - ray * eye_m[2] / ray[2] - middle)[:2])
    off_m = np.array(floor_m)
    # all alike is a shift of the floor; what differs blurs it
    assert np.sqrt(((off_m - off_m.mean(axis=0)) ** 2).sum(axis=1).mean()) < 0.2
    assert np.linalg.norm(off_m.mean(axis=0)) < 0.8

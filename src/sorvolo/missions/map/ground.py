"""Whether a flight's map is flat or stands on the heights of its ground, and its frames where they stand in space."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sorvolo.errors import GeometryError, InputError
from sorvolo.geometry.arrays import Matrix3
from sorvolo.geometry.ground import is_on_ground
from sorvolo.geometry.homography import apply_homography
from sorvolo.heights.views import View, fix_from_residual, ground_outlines_m
from sorvolo.missions.flight.report import LEVEL, MapShape
from sorvolo.missions.flight.result_cache import ResultCache
from sorvolo.missions.heights.run import GroundModel, Tied, model_ground
from sorvolo.mosaic.graph_report import GraphReport
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import StoredKeyframe
from sorvolo.survey.mosaic import PlacedFrame, Status

# Pictures of a flight whose heights are made unasked: features of 600 take a gigabyte, and after landing
# somebody waits for the map. By choice.
_MOST, _MOST_LIVE = 600, 100
_SIDE = 12  # rays a side through a picture, to the ground below it


def shape_of(
    graph: GraphReport,
    frames: Sequence[PlacedFrame],
    asked: bool | None,
    *,
    is_local: bool,
    is_tied: bool,
    is_live: bool = False,
) -> MapShape:
    """Whether a map is to stand on heights: as `asked`, or (None) where its pictures fit as over uneven ground.

    `is_local`: without metres; `is_tied`: to control points or a base map, which hold a plane alone.
    """
    placed = sum(each.site_from_camera is not None for each in frames)
    uneven = "the ground is not level"
    if asked is False:
        return MapShape(True, "the map is flat, as asked for")
    if asked is None and not graph.is_uneven:
        return LEVEL
    if is_local:
        return MapShape(True, f"the map is flat though {uneven}: heights need GPS positions")
    if is_tied:
        return MapShape(
            True,
            f"the map is flat though {uneven}: it is tied to known ground; `sorvolo heights` adds a true orthophoto",
        )
    if asked is None and placed > (_MOST_LIVE if is_live else _MOST):
        return MapShape(
            True,
            f"the map is flat though {uneven}: heights of {placed:,} pictures take long; --heights makes them",
        )
    why = "heights were asked for" if asked else uneven
    return MapShape(False, f"the map is a true orthophoto over measured heights: {why}")


def ground_of(
    archive: Archive,
    frames: Sequence[PlacedFrame],
    keyframes: Sequence[StoredKeyframe],
    memo: ResultCache,
    tied: Tied,
) -> GroundModel | str:
    """The ground that a flight's frames see, each stored as the keyframe beside it; why there is none, in words."""
    views = [
        View(
            stored.name,
            stored.camera,
            stored.site_from_camera,
            fix_from_residual(stored.site_from_camera, frame.gps_residual_m.tolist()),
        )
        for frame, stored in zip(frames, keyframes, strict=True)
        if stored.site_from_camera is not None
    ]
    work = model_ground(archive, views, keyframes, memo=memo, tied=tied)
    while True:
        try:
            next(work)
        except StopIteration as end:
            model: GroundModel = end.value
            return model
        except (InputError, GeometryError) as error:
            return f"{error}"


def standing_frames(
    frames: Sequence[PlacedFrame], model: GroundModel, sigmas_m: Mapping[int, float]
) -> list[PlacedFrame]:
    """Frames where their cameras stand in space, with their pictures on the plane that fits the bare ground below best;
    those that no points in space hold stay as they are. `sigmas_m` are by frame index."""
    solved = model.solved
    at = {view.name: k for k, view in enumerate(solved.views)}
    result = []
    for frame in frames:
        k = at.get(frame.name)
        if k is None or frame.site_from_camera is None:
            result.append(frame)
            continue
        view, full = solved.views[k], frame.camera
        camera = view.camera.resized(full.width_px, full.height_px)
        pose = view.site_from_camera
        site_from_image = _on_plane(view, camera.matrix, model)
        corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (
            full.width_px - 1,
            full.height_px - 1,
        )
        outline_m = apply_homography(site_from_image, corners)
        if not is_on_ground(outline_m):
            result.append(frame)
            continue
        miss_m = frame.gps_residual_m + pose.translation_m - frame.site_from_camera.translation_m
        result.append(
            replace(
                frame,
                status=Status.VISION,
                reason="",
                camera=replace(camera, distortion=full.distortion),
                site_from_camera=pose,
                site_from_image=site_from_image,
                outline_m=outline_m,
                residual_px=solved.view_residuals_px[k] * full.width_px / view.camera.width_px,
                sigma_m=sigmas_m[frame.index],
                gps_residual_m=miss_m,
            )
        )
    return result


def pieces_of(frames: Sequence[PlacedFrame], model: GroundModel) -> list[list[int]]:
    """The frames, by index, that points in space tie to each other."""
    index_of = {frame.name: frame.index for frame in frames}
    pieces: dict[int, list[int]] = {}
    for view, piece in zip(model.solved.views, model.solved.view_pieces.tolist(), strict=True):
        pieces.setdefault(piece, []).append(index_of[view.name])
    return list(pieces.values())


def _on_plane(view: View, matrix: Matrix3, model: GroundModel) -> Matrix3:
    """(3, 3) from pixels of a view's picture, whose camera has this matrix, to site metres on the bare ground's plane."""
    corners_m = ground_outlines_m([view], float(np.median(model.bare_m)))
    share = np.linspace(0.05, 0.95, _SIDE)
    low, high = corners_m.min(axis=0), corners_m.max(axis=0)
    x, y = (each.ravel() for each in np.meshgrid(*(low + np.outer(share, high - low)).T))
    terms = np.column_stack([x, y, np.ones(len(x))])
    plane = np.linalg.lstsq(terms, model.bare_at(terms[:, :2])[0], rcond=None)[0]
    turn = view.site_from_camera.rotation.T
    project = matrix @ np.column_stack([turn, -turn @ view.site_from_camera.translation_m])
    raised = np.array([[1.0, 0, 0], [0, 1, 0], plane, [0, 0, 1]])
    site_from_image = np.linalg.inv(project @ raised)
    return np.asarray(site_from_image / site_from_image[2, 2])

"""Whether a flight's map is flat or stands on the heights of its ground, and its frames where they stand in space."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Self

import cv2
import numpy as np

from sorvolo.change.relief import OrthoSurface
from sorvolo.errors import GeometryError, InputError
from sorvolo.geometry.arrays import Matrix3
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.ground import is_on_ground
from sorvolo.geometry.homography import apply_homography
from sorvolo.geometry.pose import Pose
from sorvolo.heights.cameras import Cameras3D
from sorvolo.heights.lattice import Lattice
from sorvolo.heights.terrain import closed, filled
from sorvolo.heights.views import View, fix_from_residual, ground_outlines_m, inside
from sorvolo.missions.flight.report import LEVEL, MapShape
from sorvolo.missions.flight.result_cache import ResultCache
from sorvolo.missions.heights.measure import (
    flights_with_heights,
    radial_of,
    read_field,
    without_heights,
)
from sorvolo.missions.heights.run import FlightPictures, GroundModel, height_grid, model_ground
from sorvolo.mosaic.graph_report import GraphReport
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import StoredKeyframe
from sorvolo.store.site.files import HeightFile
from sorvolo.survey.mosaic import PlacedFrame, Status

# Pictures of a flight whose heights are made unasked: features of 600 take a gigabyte, and after landing
# somebody waits for the map. By choice.
_MOST, _MOST_LIVE = 600, 100
_SAME_LENS = (
    0.1  # of the focal length: pictures that differ less may be of one camera, solved otherwise
)
_LEAST_SHARED = 0.15  # of a picture's width on the ground
_MOST_BESIDE = 100  # keyframes of the map that hold a flight; by choice
_LEAST_POINTS, _ROUNDS, _AGREE = 100, 8, 2.5  # of a fit to the map's surface; medians off
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


def flights_over_heights(archive: Archive, but: str) -> list[str]:
    """The flights, the oldest first, `but` one, whose maps are true orthophotos over heights that can be read."""
    newest_first = [
        each
        for each in flights_with_heights(archive, but)
        if not archive.report(each).get("shape", {"is_flat": True})["is_flat"]
    ]
    return newest_first[::-1]


def map_surface(archive: Archive, flights: Sequence[str]) -> OrthoSurface | None:
    """The heights that flights' true orthophotos, the oldest first, were painted over, without holes: as on the map, what
    one shows is not painted again. None without flights."""
    if not flights:
        return None
    fields = [
        [read_field(archive, each, file) for file in (HeightFile.SURFACE, HeightFile.GROUND)]
        for each in flights
    ]
    lattices = [surface.lattice for surface, _ in fields]
    ends_m = [
        apply_homography(each.site_from_cells, np.array([[0, 0], [each.width, each.height]]))
        for each in lattices
    ]
    site, corners_m = archive.site(), np.concatenate(ends_m)
    cell_m = min(each.cell_m for each in lattices)
    if len(fields) > 1:  # flights far apart span more cells than each has
        cell_m = max(cell_m, Lattice.cell_for(corners_m, site.m_per_px))
    whole = Lattice.over(corners_m, height_grid(site, cell_m))
    cells_from_site = np.asarray(np.linalg.inv(whole.site_from_cells), np.float64)
    up_m = np.full(whole.shape, np.nan, np.float32)
    measured = [surface.up_m for surface, _ in fields]
    without_holes = [closed(bare.lattice, surface.up_m, bare.up_m) for surface, bare in fields]
    for lattice, layer in zip(lattices * 2, measured + without_holes):
        moved = cv2.warpAffine(
            layer,
            (cells_from_site @ lattice.site_from_cells)[:2],
            whole.shape[::-1],
            borderValue=np.nan,
        )
        up_m = np.where(np.isfinite(up_m), up_m, moved)
    up_m = filled(up_m, np.isfinite(up_m)) - np.float32(site.origin.height_m)
    return OrthoSurface(up_m, cells_from_site)


@dataclass(frozen=True, eq=False)
class MapGround:
    """The ground that a site's map shows over heights, None where it is flat, and what holds a new flight on it.

    `stands` are pictures, by their view's name, with a camera and where it stands over the surface; `keyframes` are those
    of the map among them.
    """

    surface: OrthoSurface | None
    stands: dict[str, tuple[Camera, Pose]] = field(default_factory=dict)
    keyframes: dict[str, StoredKeyframe] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)
    """What keeps the flight from being held."""

    @classmethod
    def of_map(cls, archive: Archive, but: str, keyframes: Sequence[StoredKeyframe]) -> Self:
        """That of the newest map, without a flight; `keyframes` are the others'."""
        flights = flights_over_heights(archive, but)
        found = cls(map_surface(archive, flights))
        found.remarks.extend(each.text for each in without_heights(archive, but))
        for each in keyframes:
            if each.flight_id in flights and each.site_from_camera is not None:
                name = f"{each.flight_id}/{each.name}"
                found.keyframes[name] = each
                found.stands[name] = each.camera, each.site_from_camera
        return found

    def with_map(
        self, archive: Archive, views: Sequence[View]
    ) -> tuple[Sequence[View], list[tuple[View, FlightPictures]]]:
        """A flight's views, and beside them one of each keyframe of the map that shows ground of theirs and may be of
        their camera: with its lens all are seen. Keyframes have no fix."""
        wide = views[0].camera.fx_px / views[0].camera.width_px
        places_m = np.array([each.site_from_camera.translation_m for each in views])
        reach_m = (1 - _LEAST_SHARED) * float(np.median(places_m[:, 2])) / wide
        near: list[tuple[float, View, StoredKeyframe]] = []
        for name, each in self.keyframes.items():
            own, pose = self.stands[name]
            if abs(own.fx_px / own.width_px / wide - 1) < _SAME_LENS:
                apart_m = np.linalg.norm((places_m - pose.translation_m)[:, :2], axis=1).min()
                near.append((apart_m, View(name, own, pose, np.full(3, np.nan)), each))
        nearest = sorted(near, key=lambda one: one[0])[: min(len(views), _MOST_BESIDE)]
        beside = [(view, each) for apart_m, view, each in nearest if apart_m < reach_m]
        if not beside:
            return views, []
        lens = beside[-1][0].camera
        seen = [
            replace(each, camera=lens.resized(each.camera.width_px, each.camera.height_px))
            for each in views
        ]
        radial = cache(partial(radial_of, archive))
        return seen, [
            (view, FlightPictures(archive, [each], radial(each.flight_id))) for view, each in beside
        ]

    def tied(self, solved: Cameras3D) -> Cameras3D:
        """A flight's cameras in space, moved so that its points lie where the map's surface has them: those that stand see
        the same points there.

        The similarity is Umeyama's (1991) of the points that agree; cameras that see too few of them on the map stay.
        """
        own_m, map_m = [np.zeros((0, 3))], [np.zeros((0, 3))]
        for view in solved.views:
            if self.surface is None or view.name not in self.stands:
                continue
            camera, pose = self.stands[view.name]
            pixels = view.pixels_from_site(solved.points_m)
            seen = inside(pixels, view.camera)
            same = camera.undistorted().resized(view.camera.width_px, view.camera.height_px)
            rays = same.rays_from_pixels(pixels[seen]) @ pose.rotation.T
            met_m = self.surface.met(pose.translation_m, rays)
            is_on = np.isfinite(met_m[:, 0])
            own_m.append(solved.points_m[seen][is_on])
            map_m.append(met_m[is_on])
        own, known = np.concatenate(own_m), np.concatenate(map_m)
        if len(own) < _LEAST_POINTS:
            if len(own_m) > 1:
                self.remarks.append(
                    "too few of the flight's points lie on the map's heights, so that it stands by its fixes alone"
                )
            return solved
        agree = np.ones(len(own), bool)
        for _ in range(_ROUNDS):
            affine, scale = cv2.estimateAffine3D(own[agree], known[agree], force_rotation=True)
            turn, shift_m = affine[:, :3], affine[:, 3]
            miss_m = np.linalg.norm(scale * own @ turn.T + shift_m - known, axis=1)
            agree = miss_m < _AGREE * np.median(miss_m)
        poses = (each.site_from_camera for each in solved.views)
        moved = (
            Pose(turn @ at.rotation, scale * turn @ at.translation_m + shift_m) for at in poses
        )
        views = [replace(each, site_from_camera=at) for each, at in zip(solved.views, moved)]
        points_m = scale * solved.points_m @ turn.T + shift_m
        return replace(solved, views=tuple(views), points_m=points_m)


def ground_of(
    archive: Archive,
    frames: Sequence[PlacedFrame],
    keyframes: Sequence[StoredKeyframe],
    memo: ResultCache,
    known: MapGround,
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
    seen, beside = known.with_map(archive, views)
    work = model_ground(archive, seen, keyframes, memo=memo, tied=known.tied, beside=beside)
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
    return site_from_image / site_from_image[2, 2]

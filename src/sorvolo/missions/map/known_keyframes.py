"""The keyframes of earlier flights over a site, as its map has them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sorvolo.geometry.grid import SiteGrid
from sorvolo.geometry.homography import pose_from_homography
from sorvolo.mosaic.canvas_frame import CanvasFrame
from sorvolo.mosaic.placing import canvas_frame
from sorvolo.mosaic.planar import KnownKeyframe
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue import StoredKeyframe


@dataclass(frozen=True, eq=False)
class _Known:
    """One of them; `is_superseded`: of this flight's own earlier run."""

    stored: StoredKeyframe
    rank: int
    is_superseded: bool


@dataclass(frozen=True, eq=False)
class KnownKeyframes:
    """The site's keyframes; their place in the list is their id on the canvas and in the graph."""

    _archive: Archive
    _known: Sequence[_Known]

    @classmethod
    def of(cls, archive: Archive, flight: str) -> "KnownKeyframes":
        """Those of the site when `flight` is mapped; its own of an earlier run are marked as superseded.

        When that run made the newest map its tiles are taken out anyway, and its keyframes are left out.
        """
        if not archive.has_site:
            return cls(archive, ())
        ranks: Mapping[str, int] = {each.id: each.rank for each in archive.flights()}
        newest = next((v for v in reversed(archive.versions()) if v.complete), None)
        is_newest = newest is not None and newest.flight_id == flight
        return cls(
            archive,
            [
                _Known(each, ranks[each.flight_id], each.flight_id == flight)
                for each in archive.keyframes()
                if not (is_newest and each.flight_id == flight)
            ],
        )

    def __getitem__(self, keyframe_id: int) -> _Known:
        return self._known[keyframe_id]

    @property
    def count(self) -> int:
        """How many there are: the first id of a new flight's keyframes."""
        return len(self._known)

    @property
    def next_rank(self) -> int:
        """The rank of a flight that comes after all of them."""
        return 1 + max((each.rank for each in self._known), default=-1)

    @property
    def superseded(self) -> list[int]:
        """The ids of this flight's own earlier run."""
        return [number for number, each in enumerate(self._known) if each.is_superseded]

    def for_graph(self) -> list[KnownKeyframe]:
        """All of them as the pose graph ties new ones to them."""
        return [self._for_graph(number, each.stored) for number, each in enumerate(self._known)]

    def canvas_frames(self, site_grid: SiteGrid) -> list[CanvasFrame]:
        """All of them as they were painted."""
        frames = [
            canvas_frame(
                number,
                each.rank,
                each.stored.camera,
                each.stored.site_from_image,
                site_grid,
                each.stored.gains,
                each.stored.vignette,
                None,
            )
            for number, each in enumerate(self._known)
        ]
        return [each for each in frames if each is not None]

    def _for_graph(self, number: int, stored: StoredKeyframe) -> KnownKeyframe:
        # the thesis's method knows a similarity only: that of a camera looking straight down
        pose = stored.site_from_camera or pose_from_homography(
            stored.site_from_image, stored.camera
        )
        assert pose is not None
        return KnownKeyframe(
            number, stored.camera, pose, stored.sigma_m, lambda: self._archive.image(stored)
        )

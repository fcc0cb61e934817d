"""The pose graph: keyframes come in one at a time with their links, and the ones that moved come out."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import SuperLU

from sorvolo.geometry.arrays import Floats, Mask, Matrix3, PointsM, Rows
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.ground import footprint
from sorvolo.geometry.homography import pose_from_homography, site_from_image_homography
from sorvolo.geometry.pose import Pose, site_from_gimbal_rotation
from sorvolo.mosaic.bundle import (
    NO_GROUND,
    SHARED,
    Ground,
    Nodes,
    Solution,
    linearise_ground,
    solve,
)
from sorvolo.mosaic.graph_report import GraphReport, ground_sigmas_m, leans_m
from sorvolo.mosaic.graph_rows import (
    LinkRows,
    NodeRows,
    Trust,
    change_to_fixes,
    change_to_ground,
    link_noise,
    miss_px,
    move_all,
    telemetry_trust,
)
from sorvolo.mosaic.graph_settings import (
    OFFSET_ALTITUDE_M,
    OFFSET_HEADING_RAD,
    OFFSET_LEAST_SIGMAS,
    OFFSET_TILT_RAD,
    OFFSET_WIDEST_SIGMA,
    UNEVEN,
    WINDOW,
    PoseGraphSettings,
)
from sorvolo.mosaic.ground_ties import GroundTies
from sorvolo.mosaic.shelf import Shelf
from sorvolo.survey.flight import CameraPrior
from sorvolo.survey.mosaic import Link

_GROUPS = ((2,), (5, 6), (7,))  # of SHARED: altitude's zero, tilt, heading; judged together


def shared_sigma(settings: PoseGraphSettings, as_reported: Mask) -> Floats:
    """(8,) prior sigma of each shared unknown; those taken as reported, (8,) bool, are held close to zero."""
    tilt, heading = np.radians([settings.tilt_offset_sigma_deg, settings.heading_offset_sigma_deg])
    sigma = np.array(
        [
            settings.focal_sigma,
            settings.radial_sigma,
            settings.altitude_offset_sigma_m,
            settings.gps_offset_sigma_m,
            settings.gps_offset_sigma_m,
            tilt,
            tilt,
            heading,
        ]
    )
    # (8,) prior sigma of an offset that is taken as telemetry reports it.
    tilt_rad = OFFSET_TILT_RAD
    return np.where(
        as_reported,
        np.minimum(
            sigma,
            np.array(
                [
                    np.inf,
                    np.inf,
                    OFFSET_ALTITUDE_M,
                    np.inf,
                    np.inf,
                    tilt_rad,
                    tilt_rad,
                    OFFSET_HEADING_RAD,
                ]
            ),
        ),
        sigma,
    )


def shared_variances(factors: SuperLU) -> Floats:
    """(8,) of the shared unknowns, the last of the normal equations."""
    units = np.zeros((factors.shape[0], len(SHARED)))
    units[-len(SHARED) :] = np.eye(len(SHARED))
    return np.diag(factors.solve(units)[-len(SHARED) :])


@dataclass(eq=False)
class _Node:
    camera: Camera
    own: bool
    reported_m: PointsM


class PoseGraph:
    """Cameras over a ground plane, tied by links and telemetry. `add`, `retime`, `settle` and `conclude` change it.

    Every method that changes it returns the ids whose ground outline moved by more than half a pixel since it was
    last returned: those, and no others, have to be painted again.
    """

    def __init__(
        self,
        settings: PoseGraphSettings = PoseGraphSettings(),
        shelf: Shelf | None = None,
    ) -> None:
        self._settings = settings
        self._ids: dict[int, int] = {}
        self._names: list[int] = []
        self._nodes: list[_Node] = []
        self._rows = NodeRows()
        self._links = LinkRows(shelf)
        self._shared = np.zeros(len(SHARED))
        self._dropped = 0
        self._solved_at = 0
        self._trust = Trust()
        self._as_reported = np.zeros(len(SHARED), bool)
        self._ground = NO_GROUND
        self._ground_common_m = 0.0

    def __contains__(self, keyframe_id: int) -> bool:
        return keyframe_id in self._ids

    def __len__(self) -> int:
        return len(self._nodes)

    def pose(self, keyframe_id: int) -> Pose:
        """site_from_camera as it stands now."""
        at = self._ids[keyframe_id]
        return Pose(self._rows.rotations[at].copy(), self._rows.centres_m[at].copy())

    def camera(self, keyframe_id: int) -> Camera:
        """The keyframe's registration camera with the focal length and radial distortion found so far."""
        node = self._nodes[self._ids[keyframe_id]]
        return self.refined(node.camera) if node.own else node.camera

    def refined(self, camera: Camera) -> Camera:
        """A camera of this flight with the focal length found so far."""
        return camera.with_focal_px(camera.fx_px * self.focal_scale)

    @property
    def focal_scale(self) -> float:
        """Focal length found over the one given."""
        return float(np.exp(self._shared[0]))

    @property
    def altitude_offset_m(self) -> float:
        """Height of the ground above telemetry's zero, negated: stated height = height above ground + this."""
        return float(self._shared[2])

    @property
    def radial(self) -> float:
        """Left-over radial distortion k: ideal = seen * (1 + k r^2), r in the calibration's focal lengths."""
        return float(self._shared[1])

    def centres_m(self, keyframe_ids: Sequence[int]) -> PointsM:
        """(N, 3) camera positions."""
        return self._rows.centres_m[self._at(keyframe_ids)].reshape(-1, 3)

    def axes(self, keyframe_ids: Sequence[int]) -> PointsM:
        """(N, 3) unit vectors that the cameras look along."""
        return self._rows.rotations[self._at(keyframe_ids), :, 2].reshape(-1, 3)

    def ids(self) -> list[int]:
        """All keyframes in the order of their coming."""
        return list(self._names)

    def neighbours(self, keyframe_id: int) -> list[int]:
        """The keyframes that links tie to this one."""
        at, old, new = self._ids[keyframe_id], self._links.old, self._links.new
        theirs = np.flatnonzero((old == at) | (new == at))
        return [self._names[int(old[k] if new[k] == at else new[k])] for k in theirs]

    def pieces(self) -> list[list[int]]:
        """The flight's keyframes in groups that links tie together, in the order of their coming; a known map's
        keyframes tie as well."""
        labels = self._piece_labels()
        groups: list[list[int]] = [[] for _ in range(int(labels.max(initial=-1)) + 1)]
        for at in np.flatnonzero(self._own()).tolist():
            groups[labels[at]].append(self._names[at])
        return [each for each in groups if each]

    def add_known(self, keyframe_id: int, camera: Camera, site_from_camera: Pose) -> None:
        """A keyframe of the known map: it ties others down and never moves."""
        prior = CameraPrior(
            site_from_camera.translation_m,
            np.full(3, np.inf),
            site_from_camera.rotation,
            np.full(3, np.inf),
        )
        self._append(keyframe_id, _Node(camera, False, np.zeros((4, 2))), prior, site_from_camera)

    def add(
        self,
        keyframe_id: int,
        camera: Camera,
        prior: CameraPrior,
        links: Sequence[Link],
        guess: Pose,
    ) -> frozenset[int]:
        """Tie a new keyframe to the graph by its links (`new_id` is this one), starting from `guess`."""
        self._append(keyframe_id, _Node(camera, True, np.full((4, 2), np.inf)), prior, guess)
        for each in links:
            old, new = self._ids[each.old_id], self._ids[each.new_id]
            self._links.append(
                each,
                (old, self._nodes[old].camera),
                (new, self._nodes[new].camera),
                max(self._settings.sigma_px, each.sigma_px),
            )
        free = np.zeros(len(self._nodes), bool)
        free[-WINDOW:] = True
        free[[self._ids[each.old_id] for each in links]] = True
        free &= self._own()
        # The free nodes among those that they have links with: it costs the same however long the flight is.
        pairs = self._links.of(np.flatnonzero(free[self._links.old] | free[self._links.new]))
        near = np.unique(np.concatenate([np.flatnonzero(free), pairs.old, pairs.new]))
        solution = solve(
            self._state(near),
            replace(
                pairs, old=np.searchsorted(near, pairs.old), new=np.searchsorted(near, pairs.new)
            ),
            self._shared,
            np.zeros(len(SHARED)),
            free[near],
            2,
            ground=self._weighed_ground().among(near),
        )
        self._rows.rotations[near] = solution.nodes.rotations
        self._rows.centres_m[near] = solution.nodes.centres_m
        if len(self._nodes) - self._solved_at >= max(4, len(self._nodes) // 6):
            return self.settle(iterations=3)
        return self._moved(np.flatnonzero(free))

    def settle(self, iterations: int = 8) -> frozenset[int]:
        """Solve everything at once: align to GPS, weigh links by what they show, drop false ones."""
        self._solved_at = len(self._nodes)
        self._align()
        self._solve(self._own(), iterations)
        self._weigh_links()
        self._weigh_telemetry()
        return self._moved(np.flatnonzero(self._own()))

    def retime(self, priors: Mapping[int, CameraPrior]) -> frozenset[int]:
        """Replace the telemetry of some keyframes (another clock offset) and solve again."""
        for keyframe_id, prior in priors.items():
            self._rows.set_prior(self._ids[keyframe_id], prior)
        return self.conclude()

    def tie_to_ground(self, ties: GroundTies, *, is_datum: bool) -> frozenset[int]:
        """Take these ties to known ground in place of earlier ones, bring the map there, and solve it anew.

        `is_datum`: nothing but them knows where the map lies; of telemetry only that cameras look down stays.
        """
        node = np.array([self._ids[each] for each in ties.keyframe_ids], int)
        focal_px = np.array([self._nodes[at].camera.fx_px for at in node])
        self._ground = Ground(
            node,
            ties.ideal,
            ties.place_m,
            focal_px,
            np.maximum(ties.sigma_px, self._settings.sigma_px),
            ties.sigma_m,
        )
        self._ground_common_m = ties.common_m
        self._align()
        if is_datum:
            # take the flight's own frame out of its telemetry: looking down, with the heading that the map has
            forward = -self._rows.rotations[:, :2, 1]
            for at in np.flatnonzero(self._own()).tolist():
                yaw_deg = float(np.degrees(np.arctan2(forward[at, 0], forward[at, 1])))
                sigma_deg = np.array([*np.degrees(self._rows.stated_sigma_rad[at, :2]), np.inf])
                down = site_from_gimbal_rotation(yaw_deg, -90.0, 0.0)
                self._rows.set_prior(
                    at,
                    CameraPrior(
                        self._rows.centres_m[at].copy(), np.full(3, np.inf), down, sigma_deg
                    ),
                )
        return self.conclude()

    def ground_places_m(self, ties: GroundTies) -> PointsM:
        """(M, 2) where the map has the tied points: their rays cut at the height of their known places."""
        node = np.array([self._ids[each] for each in ties.keyframe_ids], int)
        ideal = (
            ties.ideal
            * (1 + self.radial * (ties.ideal**2).sum(1, keepdims=True))
            / self.focal_scale
        )
        rays = np.column_stack([ideal, np.ones(len(ideal))])
        turned = np.einsum("mij,mj->mi", self._rows.rotations[node], rays)
        centres_m = self._rows.centres_m[node]
        reach = (ties.place_m[:, 2] - centres_m[:, 2]) / np.minimum(turned[:, 2], -1e-3)
        return centres_m[:, :2] + reach[:, None] * turned[:, :2]

    def conclude(self) -> frozenset[int]:
        """The flight is over: settle with every offset free, judge which are real, and settle again."""
        self._as_reported[:] = False
        moved = self.settle()
        sigma = shared_sigma(self._settings, self._as_reported)
        factors = self._solve(self._own(), 0).equations.factorised()
        # the offsets, as indices of SHARED, that a flight does not show: telemetry is taken
        # as it reports them
        variances = shared_variances(factors)
        silent = set()
        for k in (k for group in _GROUPS for k in group):
            if not 0 < sigma[k] < OFFSET_WIDEST_SIGMA:
                continue
            variance = max(float(variances[k]), 1e-30)
            information = 1 / variance - 1 / sigma[k] ** 2  # of the flight alone, without the prior
            estimate = self._shared[k] / variance / information if information > 0 else 0.0
            if estimate**2 * max(information, 0.0) <= OFFSET_LEAST_SIGMAS**2:
                silent.add(k)
        self._as_reported[[k for group in _GROUPS if silent.issuperset(group) for k in group]] = (
            True
        )
        return moved | self.settle()

    def report(self) -> GraphReport:
        """Focal length, offsets, links and residuals as they stand."""
        sigma = 0.0
        if self._settings.focal_sigma > 0:
            factors = self._solve(self._own(), 0).equations.factorised()
            sigma = float(np.sqrt(max(0.0, shared_variances(factors)[0])))
        rms = np.array([value for value in self.residuals_px().values() if np.isfinite(value)])
        leans = list(self.leans_m().values())
        tilts_rad = self._rows.stated_sigma_rad[self._own(), 0]
        heights_m = self._rows.centres_m[self._own(), 2]
        return GraphReport(
            float(np.exp(self._shared[0])),
            sigma,
            float(self._shared[1]),
            float(self._shared[2]),
            len(self._links),
            self._dropped,
            self._relief_m(),
            float(np.sqrt(np.mean(rms**2))) if len(rms) else float("nan"),
            len(self._trust.contradicted),
            (
                float(np.degrees(np.linalg.norm(self._shared[5:7]))),
                float(np.degrees(self._shared[7])),
            ),
            self._is_uneven(),
            float(np.median(leans)) if leans else 0.0,
            float(np.median(tilts_rad * heights_m)) if leans else 0.0,
        )

    def leans_m(self) -> dict[int, float]:
        """What the ground's own slopes may move own keyframes by, per axis: see graph_report. 0 on level ground, for
        frames without stated angles or with contradicted ones, and where known ground holds the map."""
        own = np.flatnonzero(self._own())
        leans = np.zeros(len(own))
        if self._is_uneven() and len(own) == len(self._nodes) and not len(self._ground.node):
            rows = self._rows
            leans = leans_m(rows.rotations[own], rows.prior_rotations[own], rows.centres_m[own, 2])
            is_stated = np.isfinite(rows.stated_sigma_rad[own]).all(axis=1)
            leans[~is_stated | np.isin(own, self._trust.contradicted)] = 0.0
        return {self._names[at]: float(lean) for at, lean in zip(own, leans, strict=True)}

    def residuals_px(self) -> dict[int, float]:
        """Each keyframe's median transfer residual over its links, px at registration size; NaN without links."""
        result = dict.fromkeys(self._ids, float("nan"))
        gathered: dict[int, list[Floats]] = {}
        for old, new, miss in miss_px(self._state(), self._links, self._shared):
            for row, ends in enumerate(zip(old.tolist(), new.tolist(), strict=True)):
                for at in ends:
                    gathered.setdefault(at, []).append(miss[row])
        for at, rows in gathered.items():
            result[self._names[at]] = float(np.nanmedian(np.concatenate(rows)))
        return result

    def sigmas_m(self) -> dict[int, float]:
        """Each own keyframe's one-sigma error on the ground at its image centre, per axis, by the covariance; NaN where
        nothing shows where it lies."""
        own = self._own()
        solution = self._solve(own, 0)
        sigmas = dict.fromkeys((self._names[at] for at in np.flatnonzero(own)), float("nan"))
        index = np.flatnonzero(own & self._held())
        sample = (
            index
            if len(index) <= 250
            else index[np.linspace(0, len(index) - 1, 250).round().astype(int)]
        )
        found = ground_sigmas_m(
            self._rows.rotations[sample],
            self._rows.centres_m[sample, 2],
            6 * solution.position[sample],
            solution.equations.factorised(),
        )
        every = np.interp(index, sample, found) if len(sample) else np.zeros(0)
        return sigmas | {
            self._names[at]: float(value) for at, value in zip(index, every, strict=True)
        }

    def common_sigma_m(self) -> float:
        """What all fixes of the flight err in common, per axis, m; 0 without fixes.

        A receiver's errors repeat for minutes, so a map made from a hundred fixes is hardly better placed than one
        fix: seven tenths of a fix's sigma, or of the scatter that the pictures found if that is larger. Of known ground
        it is that of the mean of all places.
        """
        if len(self._ground.node):
            return float(
                np.hypot(self._ground_common_m, 1 / np.sqrt((self._ground.sigma_m**-2.0).sum()))
            )
        stated_m = self._rows.stated_sigma_m[self._own(), 0]
        stated_m = stated_m[np.isfinite(stated_m)]
        fixes = self._own().any() and len(stated_m) >= 2
        return float(0.7 * np.median(stated_m) * max(1.0, self._trust.place[0])) if fixes else 0.0

    def gps_residuals_m(self) -> dict[int, Floats]:
        """Own keyframes' camera position minus the reported one, (3,) east, north, up; NaN where none is reported."""
        miss_m = np.where(np.isfinite(self._rows.stated_sigma_m), self._gps_miss_m(), np.nan)
        return {self._names[at]: miss_m[at] for at in np.flatnonzero(self._own())}

    # ---- inside -----------------------------------------------------------------------------------------------

    def _piece_labels(self) -> Rows:
        """(N,) which piece each node belongs to; see `pieces`."""
        size = len(self._nodes)
        ties = coo_matrix(
            (np.ones(len(self._links)), (self._links.old, self._links.new)), shape=(size, size)
        )
        known = np.flatnonzero(~self._own())
        if len(known):
            ones = np.ones(len(known))
            ties = ties + coo_matrix(
                (ones, (known, np.full(len(known), known[0]))), shape=(size, size)
            )
        return np.asarray(connected_components(ties, directed=False)[1], int)

    def _held(self) -> Mask:
        """(N,) nodes whose piece has a fix, a known keyframe or known ground: the others have a place by guess alone,
        such as a frame without links after telemetry's last fix."""
        anchored = np.isfinite(self._rows.stated_sigma_m[:, :2]).all(axis=1) | ~self._own()
        anchored[self._ground.node] = True
        labels = self._piece_labels()
        return np.isin(labels, labels[anchored])

    def _append(self, keyframe_id: int, node: _Node, prior: CameraPrior, pose: Pose) -> None:
        self._ids[keyframe_id] = len(self._nodes)
        self._names.append(keyframe_id)
        self._nodes.append(node)
        self._rows.append(prior, pose, own=node.own)

    def _at(self, keyframe_ids: Sequence[int]) -> Rows:
        """(N,) the keyframes' node indices."""
        return np.fromiter(map(self._ids.__getitem__, keyframe_ids), int, len(keyframe_ids))

    def _own(self) -> Mask:
        return self._rows.own

    def _state(self, at: Rows | slice = slice(None)) -> Nodes:
        """All nodes, or some of them."""
        return self._rows.nodes(self._trust.place, self._trust.contradicted, at)

    def _gps_miss_m(self) -> Floats:
        return self._rows.centres_m + self._shared[[3, 4, 2]] - self._rows.prior_centres_m

    def _relief_m(self) -> float:
        """Relief left between linked pictures, the median link's."""
        return float(np.median(self._links.relief_m)) if len(self._links) else 0.0

    def _is_uneven(self) -> bool:
        own = self._own()
        return bool(own.any()) and self._relief_m() > UNEVEN * np.median(
            self._rows.centres_m[own, 2]
        )

    def _solve(self, free: Mask, iterations: int) -> Solution:
        sigma = shared_sigma(self._settings, self._as_reported)
        solution = solve(
            self._state(),
            self._links,
            self._shared,
            sigma,
            free,
            iterations,
            ground=self._weighed_ground(),
        )
        if iterations:
            self._rows.rotations[:], self._rows.centres_m[:] = (
                solution.nodes.rotations,
                solution.nodes.centres_m,
            )
            self._shared = solution.shared
        return solution

    def _weighed_ground(self) -> Ground:
        """The ties to known ground, their sigmas as large as most of them miss by now: else none would pull."""
        ground = self._ground
        if not len(ground.node):
            return ground
        rows = linearise_ground(self._state(), ground, self._shared)
        miss = np.linalg.norm(rows.residual_px, axis=1) / rows.sigma_px
        factor = float(np.clip(np.median(miss[rows.seen]), 1.0, 1e4)) if rows.seen.any() else 1.0
        return replace(ground, sigma_px=ground.sigma_px * factor, sigma_m=ground.sigma_m * factor)

    def _align(self) -> None:
        """Bring the whole map to known ground, else to its GPS fixes, by a similarity where it is far off: the solve
        only bends a little."""
        if not self._own().all():
            return
        change = self._change_to_ground() if len(self._ground.node) else self._change_to_fixes()
        if change is not None:
            move_all(self._rows, change)

    def _change_to_fixes(self) -> Matrix3 | None:
        sigma_m = self._rows.stated_sigma_m[:, :2].max(axis=1)
        usable = np.isfinite(sigma_m)
        if usable.sum() < 3:
            return None
        places_m, fixes_m = self._rows.centres_m[usable, :2], self._rows.prior_centres_m[usable, :2]
        return change_to_fixes(places_m, fixes_m, sigma_m[usable])

    def _change_to_ground(self) -> Matrix3 | None:
        names = np.array(self._names)[self._ground.node]
        ties = GroundTies(
            names,
            self._ground.ideal,
            self._ground.place_m,
            self._ground.sigma_px,
            self._ground.sigma_m,
        )
        places_m = self.ground_places_m(ties)
        known = np.isfinite(places_m).all(axis=1)
        return change_to_ground(places_m[known], ties.place_m[known, :2])

    def _weigh_links(self) -> None:
        """Learn each link's noise across the parallax and the relief along it; drop links that cannot be true."""
        if not len(self._links):
            return
        noise = link_noise(self._state(), self._links, self._shared)
        # a link's relief is half its own and half that of most
        overall = float(np.median(noise.relief_m))
        self._links.relief_m[:] = np.clip(np.sqrt(0.5 * (noise.relief_m**2 + overall**2)), 0.0, 5.0)
        self._links.sigma_px[:] = np.clip(noise.across_px, self._settings.sigma_px, 5.0)
        false = noise.is_false(float(np.median(noise.across_px)))
        if false.any():
            self._dropped += int(false.sum())
            self._links.keep(~false)

    def _weigh_telemetry(self) -> None:
        tied = np.zeros(len(self._nodes), bool)
        tied[self._links.old] = tied[self._links.new] = True
        self._trust = telemetry_trust(self._rows, tied & self._own(), self._gps_miss_m())

    def _moved(self, candidates: Iterable[int]) -> frozenset[int]:
        moved = set()
        for at in candidates:
            node = self._nodes[at]
            camera = self.refined(node.camera)
            outline = footprint(
                camera, Pose(self._rows.rotations[at].copy(), self._rows.centres_m[at].copy())
            )
            m_per_px = max(self._rows.centres_m[at, 2], 1e-6) / camera.fx_px
            if not np.nanmax(np.abs(outline - node.reported_m), initial=0.0) <= 0.5 * m_per_px:
                node.reported_m = outline
                moved.add(self._names[at])
        return frozenset(moved)


def pose_from_link(each: Link, new: Camera, old: Camera, site_from_old: Pose) -> Pose | None:
    """The new keyframe's pose as one link gives it."""
    site_from_new = site_from_image_homography(old, site_from_old) @ np.linalg.inv(
        each.new_from_old
    )
    centre = site_from_new @ np.array([new.cx_px, new.cy_px, 1.0])
    return pose_from_homography(site_from_new * np.sign(centre[2]), new)

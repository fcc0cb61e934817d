"""Cars, people and small things cut from labelled pictures, and planted on the ground that several photos show.

What is cut out stays in memory: the labelled pictures may be measured on, not handed on (DATA's README). A label's box
is cut with a margin, GrabCut finds the thing in it, and a mask that is no clear thing (too little or too much of the
box, several parts, the box's own outline) is set aside. Bags carry labels in none of the sets: bicycles and dogs stand
for what is small.

A planted thing lies flat at one place of the site, as long as such a thing is, with its shadow, in the light of each
photo around that place. It has no height: it does not lean, as a real one would in a photo's corner.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from sorvolo.geometry.arrays import Floats, PointsM
from sorvolo.geometry.homography import apply_homography

MARGIN = 0.3  # of the box, around it, which GrabCut takes for ground
SIDE_PX = 160  # a cut-out's longest side at most
LEAST_SIDE_PX = {"car": 60, "person": 24, "small": 24}
LENGTH_M = {"car": (4.1, 4.8), "person": (0.6, 0.9), "bicycle": (1.6, 1.9), "dog": (0.7, 1.1)}
HEIGHT_M = {"car": 1.4, "person": 1.7, "bicycle": 1.0, "dog": 0.5}
KINDS = {"car": ("car",), "person": ("person",), "small": ("bicycle", "dog")}
SETS = {"semantic_drone": ("person", "car", "bicycle", "dog")}
SHAPES = {"car": (1.5, 2.9), "person": (1.0, 1.7), "bicycle": (1.0, 3.5), "dog": (1.0, 3.0)}
"""The longer side of a box over the shorter one: cars along the picture's axes, people seen from above."""


@dataclass(frozen=True, eq=False)
class Cutout:
    """A thing cut out: rgb float32 (h, w, 3), alpha float32 (h, w) from 0 to 1, and what it is."""

    kind: str
    label: str
    rgb: Floats
    alpha: Floats
    length_m: float
    height_m: float


@dataclass(frozen=True, eq=False)
class Planted:
    """A thing on the ground: its cut-out in the colours it has there, and where; angles go from east to north."""

    cutout: Cutout
    place_m: Floats  # (2,) its middle
    angle_deg: float
    shadow_deg: float
    shadow_m: float
    darkness: float  # of its shadow, 0 to 1
    is_low: bool  # of low contrast

    @property
    def outline_m(self) -> PointsM:
        """(N, 2) the thing's own outline on the ground."""
        inside = (self.cutout.alpha > 0.5).astype(np.uint8)
        rings, _ = cv2.findContours(inside, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        ring = max(rings, key=cv2.contourArea)[:, 0].astype(float)
        return apply_homography(self._site_from_sprite(0.0), ring)

    @property
    def shadow_outline_m(self) -> PointsM:
        """(N, 2) the same moved to where its shadow ends."""
        along = np.radians(self.shadow_deg)
        return self.outline_m + self.shadow_m * np.array([np.cos(along), np.sin(along)])

    def paint(self, photo: Floats, image_from_site: Floats, gain: float = 1.0) -> None:
        """Put the thing on the photo, float32 (h, w, 3); `gain` is the photo's light over the cut-out's."""
        ends = apply_homography(
            image_from_site, np.concatenate([self.outline_m, self.shadow_outline_m])
        )
        low = np.maximum(np.floor(ends.min(axis=0)).astype(int) - 8, 0)
        high = np.minimum(np.ceil(ends.max(axis=0)).astype(int) + 9, photo.shape[1::-1])
        if (high <= low).any():
            return
        part = photo[low[1] : high[1], low[0] : high[0]]
        to_part = np.array([[1, 0, -low[0]], [0, 1, -low[1]], [0, 0, 1]]) @ image_from_site
        size = part.shape[1], part.shape[0]
        shade = np.max(
            [
                self._laid(self.cutout.alpha, to_part @ self._site_from_sprite(share), size)
                for share in np.linspace(0, 1, 9)
            ],
            axis=0,
        )
        lit = part * (1 - self.darkness * cv2.GaussianBlur(shade, (0, 0), 1.5)[..., None])
        to_part = to_part @ self._site_from_sprite(0.0)
        cover = self._laid(self.cutout.alpha, to_part, size)[..., None]
        part[:] = lit * (1 - cover) + cover * np.clip(
            self._laid(self.cutout.rgb, to_part, size) * gain, 0, 255
        )

    # ---- inside -----------------------------------------------------------------------------------------------

    def _site_from_sprite(self, share: float) -> Floats:
        """(3, 3) from the cut-out's pixels to metres, moved by a share of its shadow's length."""
        high, wide = self.cutout.alpha.shape
        m_per_px = self.cutout.length_m / max(high, wide)
        turn, along = np.radians([self.angle_deg, self.shadow_deg])
        east, north = (
            np.array([np.cos(turn), np.sin(turn)]),
            np.array([np.sin(turn), -np.cos(turn)]),
        )
        corner = self.place_m + share * self.shadow_m * np.array([np.cos(along), np.sin(along)])
        corner = corner - m_per_px * ((wide - 1) / 2 * east + (high - 1) / 2 * north)
        return np.array(
            [
                [*(m_per_px * np.array([east[0], north[0]])), corner[0]],
                [*(m_per_px * np.array([east[1], north[1]])), corner[1]],
                [0, 0, 1],
            ]
        )

    def _laid(self, picture: Floats, image_from_sprite: Floats, size: tuple[int, int]) -> Floats:
        """The cut-out as the photo shows it: made smaller first, so that no pixel is skipped."""
        high, wide = picture.shape[:2]
        ends = apply_homography(
            image_from_sprite, np.array([[0, 0], [wide - 1, 0], [0, high - 1]], float)
        )
        scale = min(
            1.0, np.linalg.norm(ends[1] - ends[0]) / wide, np.linalg.norm(ends[2] - ends[0]) / high
        )
        small = max(2, round(wide * scale)), max(2, round(high * scale))
        shown = cv2.resize(picture, small, interpolation=cv2.INTER_AREA)
        full_from_small = np.diag([wide / small[0], high / small[1], 1.0])
        full_from_small[:2, 2] = 0.5 * np.diag(full_from_small)[:2] - 0.5
        return cv2.warpPerspective(
            shown, image_from_sprite @ full_from_small, size, flags=cv2.INTER_LINEAR
        )


def cutouts(data: Path, kind: str, rng: np.random.Generator) -> Iterator[Cutout]:
    """Things of a kind (car, person, small) from the labelled pictures under DATA/detection, in a drawn order."""
    chosen = []
    for name, labels in SETS.items():
        folder = data / "detection" / name
        chosen += [
            (path, labels) for path in sorted(folder.glob("*.txt")) if path.stem != "classes"
        ]
    for number in rng.permutation(len(chosen)):
        path, labels = chosen[number]
        wanted = _labelled(path, labels, kind)
        picture = cv2.imread(str(path.with_suffix(".jpg")), cv2.IMREAD_COLOR) if wanted else None
        for label, box in wanted[:4]:
            found = _cut(picture, box, kind, label, rng)
            if found is not None:
                yield found


def in_light_of(cutout: Cutout, ground: Floats, is_low: bool, rng: np.random.Generator) -> Cutout:
    """The cut-out in the light of its new ground, (3,) mean colour; of low contrast, it nearly has that colour."""
    inside = cutout.alpha > 0.5
    mean = cutout.rgb[inside].mean(axis=0)
    if is_low:
        shift = rng.choice([-1, 1]) * rng.uniform(12, 20)
        rgb = ground + shift + 0.3 * (cutout.rgb - mean)
    else:
        rgb = cutout.rgb * float(np.clip(ground.mean() / 110, 0.5, 1.5))
    return Cutout(
        cutout.kind,
        cutout.label,
        np.float32(np.clip(rgb, 0, 255)),
        cutout.alpha,
        cutout.length_m,
        cutout.height_m,
    )


def contrast(cutout: Cutout, ground: Floats) -> float:
    """The mean over the thing of the largest difference of a channel from the ground's mean colour, grey levels."""
    return float(np.abs(cutout.rgb[cutout.alpha > 0.5] - ground).max(axis=1).mean())


def _labelled(path: Path, labels: tuple[str, ...], kind: str) -> list[tuple[str, Floats]]:
    """The boxes of a kind in one label file, (4,) middle and sides as shares of the picture, each with its label."""
    rows = [line.split() for line in path.read_text().splitlines() if line.strip()]
    boxes = [(labels[int(row[0])], np.array(row[1:5], float)) for row in rows]
    return [(label, box) for label, box in boxes if label in KINDS[kind] and not _rides(box, boxes)]


def _rides(box: Floats, boxes: list[tuple[str, Floats]]) -> bool:
    """Whether another label's middle lies in the box, or this one's in another's: a person on a bicycle, in a car."""

    def holds(outer: Floats, inner: Floats) -> bool:
        return bool((np.abs(outer[:2] - inner[:2]) < 0.5 * outer[2:]).all())

    return any(other is not box and (holds(other, box) or holds(box, other)) for _, other in boxes)


def _cut(
    picture: np.ndarray, box: Floats, kind: str, label: str, rng: np.random.Generator
) -> Cutout | None:
    """One label's thing; None where it is too small, cut by the picture's rim, or not clear."""
    size = np.array(picture.shape[1::-1])
    low, high = (box[:2] - box[2:] / 2) * size, (box[:2] + box[2:] / 2) * size
    sides = high - low
    shape = SHAPES[label]
    if max(sides) < LEAST_SIDE_PX[kind] or not shape[0] <= max(sides) / min(sides) <= shape[1]:
        return None
    from_px, to_px = (
        np.floor(low - MARGIN * sides).astype(int),
        np.ceil(high + MARGIN * sides).astype(int),
    )
    if (from_px < 0).any() or (to_px > size).any():
        return None
    crop = picture[from_px[1] : to_px[1], from_px[0] : to_px[0]]
    scale = min(1.0, SIDE_PX / max(crop.shape[:2]))
    crop = cv2.resize(crop, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    inner = np.round(np.array([*(low - from_px), *sides]) * scale).astype(int)
    mask = np.zeros(crop.shape[:2], np.uint8)
    cv2.setRNGSeed(int(rng.integers(2**31)))
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(crop, mask, tuple(int(v) for v in inner), *models, 4, cv2.GC_INIT_WITH_RECT)
    thing = np.isin(mask, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.uint8)
    thing = cv2.morphologyEx(thing, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    thing = _one_part(thing, float(inner[2] * inner[3]))
    if thing is None:
        return None
    alpha = cv2.GaussianBlur(thing.astype(np.float32), (0, 0), 0.8)
    x, y, wide, tall = cv2.boundingRect(thing)
    window = np.s_[max(y - 2, 0) : y + tall + 2, max(x - 2, 0) : x + wide + 2]
    return Cutout(
        kind,
        label,
        crop[window][..., ::-1].astype(np.float32),
        alpha[window],
        float(rng.uniform(*LENGTH_M[label])),
        HEIGHT_M[label],
    )


def _one_part(mask: np.ndarray, box_px: float) -> np.ndarray | None:
    """The mask's largest part without holes, if it is nearly all of the mask and fills the box as a thing does."""
    rings, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not rings:
        return None
    largest = cv2.drawContours(np.zeros_like(mask), [max(rings, key=cv2.contourArea)], -1, 1, -1)
    clear = largest[mask > 0].sum() >= 0.85 * mask.sum() and 0.3 <= largest.sum() / box_px <= 0.9
    return largest if clear else None

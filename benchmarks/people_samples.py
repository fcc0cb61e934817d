"""Training pictures for people from the air: crops of real pictures with rendered people and things laid on them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from detection_data import SMALL, aerial_cars, hituav, mannequin, tinyperson
from drawn_meshes import Sprite
from painted_grounds import painted_ground
from rendered_people import Scene
from sorvolo.geometry.arrays import Floats, ImageRGB
from sorvolo.lab.training.samples import Augmentation, Sample, Share, cut_sample
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import CLASSES

PERSON = 0
_PLAIN = Augmentation(
    blur=0.0, haze=0.0, grey=0.0, noise=0.0
)  # what is pasted gets the rest together with the ground
_FEW_BARE = 0.15  # of thermal crops without people
_LEAST_SEEN, _LEAST_PX = 0.45, 11.0  # of a pasted person; less teaches nothing


@dataclass(frozen=True, eq=False)
class Source:
    """Pictures to cut from, and how rendered people come onto them: on this share of crops, 0 for never.

    `seen`: what becomes of a picture before it is cut. `least_px`: real people whose longer side is shorter are
    ignored; of crops without any, few are taken then.
    """

    share: Share
    pasted: float
    seen: Callable[[ImageRGB, np.random.Generator], ImageRGB] = lambda picture, _: picture
    least_px: float = 0.0


@dataclass(frozen=True, eq=False)
class Shown:
    """A picture (S, S, 3), its people (N, 4) px, and regions to ignore (M, 4)."""

    image: ImageRGB
    boxes: Floats
    ignored: Floats


def sources(
    data: Path, simulated: LabelledSet, ignored: Callable[[LabelledSet], LabelledSet]
) -> list[Source]:
    """All that people are learnt from. Pictures with unlabelled people pass through `ignored` first."""
    cars, dummy = ignored(aerial_cars(data)["train"]), mannequin(data)["train"]
    site, thermal = ground(data, "caliterra", "IMG_9354.jpg", "IMG_9399.jpg"), hituav(data)["train"]
    thermal = thermal.only([each for each in thermal.pictures if (each.labels == PERSON).any()])
    return [
        Source(Share(site, 3.0, (0.3, 2.2)), 0.8),
        Source(Share(replace(cars, unlabelled=frozenset({SMALL})), 2.2, (0.4, 1.5)), 0.85),
        Source(Share(simulated, 0.6, (0.6, 1.6)), 0.6),
        Source(Share(tinyperson(data)["train"], 1.6, (1.0, 3.0), aslant=True), 0.35),
        Source(Share(dummy, 0.7, (0.35, 1.2)), 0.6),
        Source(Share(thermal, 1.6, (1.2, 3.0)), 0.25, by_day, 14.0),
        Source(Share(replace(site, name="painted"), 1.6, (0.5, 2.0)), 0.7, Painted()),
    ]


class Painted:
    """Grounds painted over photos: the first few dozen that are asked for, again and again, for they take long."""

    def __init__(self, count: int = 48) -> None:
        self._count = count
        self._made: dict[int, ImageRGB] = {}

    def __call__(self, picture: ImageRGB, rng: np.random.Generator) -> ImageRGB:
        """One of them."""
        number = int(rng.integers(self._count))
        if number not in self._made:
            self._made[number] = np.ascontiguousarray(
                painted_ground(picture, np.random.default_rng((number, 99)))
            )
        return self._made[number]


def by_day(frame: ImageRGB, rng: np.random.Generator) -> ImageRGB:
    """A thermal frame as if by day: black hot or white hot, of any contrast, tinted."""
    grey = frame[..., :1].astype(np.float32)
    if rng.random() < 0.5:
        grey = 255 - grey
    grey = 255 * (grey / 255) ** np.exp(rng.normal(0, 0.3))
    grey = (grey - 128) * rng.uniform(0.5, 1.2) + rng.uniform(80, 170)
    return np.clip(grey * (1 + rng.normal(0, 0.07, 3)), 0, 255).astype(np.uint8)


def ground(data: Path, flight: str, first: str = "", last: str = "~") -> LabelledSet:
    """Photos of a flight that show nobody."""
    none = np.zeros((0, 4), np.float32)
    pictures = tuple(
        LabelledPicture(str(path), 1, 1, flight, none, np.zeros(0, np.int64), none)
        for path in sorted((data.parent / "flights" / flight).glob("*.[jJ][pP][gG]"))
        if first <= path.name <= last
    )
    return LabelledSet(flight, CLASSES, pictures, frozenset({SMALL}))


def shown(
    source: Source,
    scenes: Sequence[Scene],
    read: Callable[[str], ImageRGB],
    side_px: int,
    rng: np.random.Generator,
    stones: Callable[["Shown", np.random.Generator], "Shown"] | None = None,
) -> Shown:
    """One picture to learn from; `stones` lays some on it."""
    pictures, plain = source.share.labelled.pictures, replace(_PLAIN, side_px=side_px)
    while True:
        picture = pictures[int(rng.integers(len(pictures)))]
        own = people_of(
            cut_sample(
                source.seen(read(picture.path), rng), picture, source.share, CLASSES, plain, rng
            )
        )
        if not source.least_px or len(own.boxes) or rng.random() < _FEW_BARE:
            break
    if source.least_px:
        small = (own.boxes[:, 2:] - own.boxes[:, :2]).max(1, initial=0) < source.least_px
        own = Shown(own.image, own.boxes[~small], np.vstack([own.ignored, own.boxes[small]]))
    if stones is not None:
        own = stones(own, rng)
    if rng.random() < source.pasted:
        own = pasted(own, scenes[int(rng.integers(len(scenes)))], rng)
    return replace(own, image=finished(own.image, rng))


def people_of(sample: Sample) -> Shown:
    """The sample's people alone."""
    return Shown(
        sample.image,
        sample.boxes[sample.labels == PERSON].astype(float),
        sample.ignored.astype(float),
    )


def pasted(below: Shown, scene: Scene, rng: np.random.Generator) -> Shown:
    """The picture with some of a scene's people and things on it; whom others hide, or the edge cuts, is ignored."""
    side = below.image.shape[0]
    px_per_m = float(np.exp(rng.uniform(np.log(15), np.log(scene.px_per_m))))
    turns, mirror = int(rng.integers(4)) * scene.is_steep, bool(rng.random() < 0.5)
    picture, light = below.image.astype(np.float32), drawn_tone(below.image, rng)
    owner = np.zeros((side, side), np.int32)
    areas: dict[int, int] = {}
    soft = max(0.0, rng.normal(0.3, 0.45))  # as the ground below may be
    for number, (index, centre) in enumerate(places(scene, px_per_m, side, rng), 1):
        cut = resized(
            scene.sprites[index], px_per_m / scene.px_per_m * rng.uniform(0.93, 1.07), turns, mirror
        )
        cut = softened(cut, soft)
        corner = np.round(centre - np.array(cut.shape[1::-1]) / 2).astype(int)
        if not _is_free(below.boxes, corner, cut.shape):
            continue
        area = laid(picture, owner, cut, corner, number, light, scene.sunlight)
        if scene.is_person[index]:
            areas[number] = area
    boxes, hidden = _boxes(owner, areas)
    return Shown(
        np.clip(picture, 0, 255).astype(np.uint8),
        np.vstack([below.boxes, boxes]),
        np.vstack([below.ignored, hidden]),
    )


def places(
    scene: Scene, px_per_m: float, side: int, rng: np.random.Generator
) -> list[tuple[int, Floats]]:
    """Which sprites are laid where, their centres (2,) px: alone or in groups, things among them."""
    count = int(rng.choice([0, 1, 2, 3, 5, 8], p=[0.12, 0.28, 0.2, 0.2, 0.12, 0.08]))
    people = rng.permutation(np.nonzero(scene.is_person)[0])[:count]
    things = rng.permutation(np.nonzero(~np.array(scene.is_person))[0])[: int(rng.integers(0, 7))]
    middle, is_group = rng.uniform(0.2, 0.8, 2) * side, rng.random() < 0.4
    found = []
    for index in rng.permutation(np.concatenate([people, things])):
        alone = rng.uniform(-0.02, 1.02, 2) * side
        found.append((int(index), middle + rng.normal(0, 1.3, 2) * px_per_m if is_group else alone))
    return found


def drawn_tone(image: ImageRGB, rng: np.random.Generator) -> Floats:
    """(2, 3) by what colours are multiplied, and what is added: light like that of the ground, more or less."""
    bright = (float(image.mean()) / 110) ** 0.6 * np.exp(rng.normal(0, 0.22))
    tint = image.mean((0, 1)) / max(float(image.mean()), 1.0)
    cast = bright * tint ** rng.uniform(0.3, 0.9) * rng.uniform(0.95, 1.05, 3)
    haze = rng.uniform(0, 0.15)
    return np.stack([cast * (1 - haze), haze * image.mean((0, 1))])


def resized(sprite: Sprite, scale: float, turns: int, mirror: bool) -> np.ndarray:
    """(H, W, 5) float32 of colours, cover and shade, turned by quarters."""
    whole = np.dstack([sprite.rgba, sprite.shade]).astype(np.float32)
    whole[..., :3] *= whole[..., 3:4] / 255  # colours count by their cover
    size = np.maximum(np.round(np.array(whole.shape[1::-1]) * scale), 2).astype(int)
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    to = (int(size[0]), int(size[1]))
    small = np.dstack(
        [cv2.resize(whole[..., part], to, interpolation=way) for part in (slice(4), 4)]
    )
    small = np.rot90(small, turns)
    return np.ascontiguousarray(small[:, ::-1] if mirror else small)


def softened(cut: np.ndarray, sigma_px: float) -> np.ndarray:
    """(H, W, 5) the cut-out out of focus, with room for that."""
    if sigma_px < 0.25:
        return cut
    wide = np.pad(cut, ((2, 2), (2, 2), (0, 0)))
    return np.dstack(
        [cv2.GaussianBlur(wide[..., part], (0, 0), sigma_px) for part in (slice(4), 4)]
    )


def finished(image: ImageRGB, rng: np.random.Generator) -> ImageRGB:
    """Lens, sensor and file: blur, noise, JPEG; sometimes without colours."""
    x = image.astype(np.float32)
    if rng.random() < 0.06:
        x[:] = x.mean(2, keepdims=True)
    if rng.random() < 0.5:
        x = cv2.GaussianBlur(x, (0, 0), rng.uniform(0.3, 1.1))
    if rng.random() < 0.3:
        x = x + rng.uniform(0.2, 0.8) * (
            x - cv2.GaussianBlur(x, (0, 0), 1.2)
        )  # sharpened, as small cameras do
    if rng.random() < 0.5:
        x = x + rng.normal(0, rng.uniform(1, 8), x.shape).astype(np.float32)
    out = np.clip(x, 0, 255).astype(np.uint8)
    if rng.random() < 0.6:
        _, data = cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(35, 95))])
        out = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
    return out


def _is_free(boxes: Floats, corner: np.ndarray, shape: Sequence[int]) -> bool:
    """Whether a cut-out hides none of the real people."""
    left, top = corner
    right, bottom = left + shape[1], top + shape[0]
    over = (
        (boxes[:, 0] < right) & (boxes[:, 2] > left) & (boxes[:, 1] < bottom) & (boxes[:, 3] > top)
    )
    return not over.any()


def laid(
    picture: np.ndarray,
    owner: np.ndarray,
    cut: np.ndarray,
    corner: np.ndarray,
    number: int,
    light: Floats,
    sunlight: float,
) -> int:
    """Lay one cut-out on the picture, in place; how many pixels it would have if all of it showed."""
    side = picture.shape[0]
    left, top = np.maximum(corner, 0)
    right, bottom = np.minimum(corner + np.array(cut.shape[1::-1]), side)
    if right - left < 1 or bottom - top < 1:
        return 0
    part = cut[top - corner[1] : bottom - corner[1], left - corner[0] : right - corner[0]]
    dark = 1 - (1 - sunlight) ** (1 / 2.2) if sunlight > 0 else 0.3
    window = picture[top:bottom, left:right]
    cover = part[..., 3:4] / 255
    window *= 1 - dark * part[..., 4:5] / 255
    window *= 1 - cover
    window += part[..., :3] * light[0] + cover * light[1]
    owner[top:bottom, left:right][part[..., 3] > 127] = number
    return int((cut[..., 3] > 127).sum())


def _boxes(owner: np.ndarray, areas: dict[int, int]) -> tuple[Floats, Floats]:
    """Boxes of people who show enough, and of those who do not."""
    boxes, hidden = [], []
    for number, area in areas.items():
        rows, columns = np.nonzero(owner == number)
        if not len(rows):
            continue
        box = [columns.min(), rows.min(), columns.max() + 1.0, rows.max() + 1.0]
        is_small = max(box[2] - box[0], box[3] - box[1]) < _LEAST_PX
        (hidden if is_small or len(rows) < _LEAST_SEEN * area else boxes).append(box)
    return np.array(boxes, float).reshape(-1, 4), np.array(hidden, float).reshape(-1, 4)

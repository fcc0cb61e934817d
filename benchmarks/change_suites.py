"""Pairs of aligned pictures with an exact answer: what changed, each suite isolating one nuisance.

The grounds are real photos; objects are painted on the reference's ground (they disappeared) or on the query's (they
appeared), half of the pairs have none. `real` pairs neighbouring photos of one flight. Development and test use
different photos, flights and random numbers. Shadows that objects cast are left out of the score. Without the photos
the grounds are procedural, and `Ground.source` is "procedural".
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from change_objects import Cutout, Scene, paint_objects
from sorvolo.lab.simulation.ground import GroundKind, paint_ground
from sorvolo.lab.simulation.ground_painting import Area

SIZES = ((1280, 720), (960, 540))
MARGIN_PX = 24  # of ground around the picture, so that warps know what comes in at its rim


@dataclass(frozen=True)
class Nuisance:
    """How much of each disturbance a pair has: the largest value, in px or as a factor's spread; 0 has none of it."""

    illumination: float = 0.0
    cloud: float = 0.0  # how often a cloud's shadow lies over a part
    wind_px: float = 0.0
    parallax_px: float = 0.0
    misaligned_px: float = 0.3
    object_scale: float = 1.0
    low_contrast: float = 0.0  # how often an object has the ground's own colours
    changed: float = 0.5  # how often anything changed
    cast_shadows: float = (
        0.0  # how often shadows of standing things lie elsewhere: the sun has moved
    )
    exact: bool = True  # the value itself rather than anything up to it


SUITES: dict[str, Nuisance] = {
    "plain": Nuisance(),
    "illumination": Nuisance(illumination=1.0),
    "cloud": Nuisance(cloud=1.0),
    "wind": Nuisance(wind_px=2.5),
    "parallax 4": Nuisance(parallax_px=4.0),
    "parallax 10": Nuisance(parallax_px=10.0),
    "misaligned 1": Nuisance(misaligned_px=1.0),
    "misaligned 2": Nuisance(misaligned_px=2.0),
    "misaligned 3": Nuisance(misaligned_px=3.0),
    "misaligned 5": Nuisance(misaligned_px=5.0),
    "small": Nuisance(object_scale=0.5),
    "low contrast": Nuisance(low_contrast=1.0),
    "hard": Nuisance(1.0, 0.6, 2.5, 10.0, 4.0, 1.0, 0.25, exact=False),
    "none": Nuisance(1.0, 0.6, 2.5, 10.0, 4.0, changed=0.0, exact=False),
    "large": Nuisance(0.3, wind_px=1.0, parallax_px=3.0, misaligned_px=2.0, object_scale=5.0),
    "cast shadows": Nuisance(0.3, parallax_px=3.0, misaligned_px=1.0, cast_shadows=1.0),
    "real": Nuisance(),
}
REAL = (
    "brighton_beach",
    "caliterra",
)  # neighbouring photos of a flight, registered: leaning trees as they are


@dataclass(frozen=True, eq=False)
class Pair:
    """Two aligned pictures and the answer: `truth` is what changed, `ignored` pixels do not count."""

    suite: str
    source: str
    reference: np.ndarray  # (h, w, 3) uint8, BGR
    query: np.ndarray
    valid: np.ndarray  # (h, w) bool
    truth: np.ndarray  # (h, w) bool
    ignored: np.ndarray  # (h, w) bool


@dataclass(frozen=True)
class Ground:
    """A photo (or a procedural ground) that pairs are cut from."""

    source: str
    path: str
    labels: str = ""
    car_classes: tuple[int, ...] = field(default=(0,))


def grounds(data: Path, split: str) -> list[Ground]:
    """The photos of `split` ("dev" or "test"), or procedural grounds where `data` has none."""
    wanted: dict[str, dict[str, tuple[str, ...]]] = {
        "dev": {
            "flights/caliterra": ("IMG_",),
            "detection/aerial_cars/images": ("DJI",),
            "detection/cats/images": ("0_", "2_", "4_"),
            "detection/sdd/images": ("nexus", "quad"),
        },
        "test": {
            "flights/brighton_beach": ("DJI",),
            "detection/cats/images": ("1_", "3_", "Drone2"),
            "detection/sdd/images": ("gates", "hyang"),
        },
    }
    found: list[Ground] = []
    for folder, prefixes in wanted[split].items():
        name = folder.split("/")[1]
        for path in sorted((data / folder).glob("*")):
            if path.name.startswith(prefixes) and path.suffix.lower() in (".jpg", ".png"):
                label = path.parent.parent / "labels" / f"{path.stem}.txt"
                found.append(Ground(name, str(path), str(label) if label.exists() else ""))
    if found:
        return found
    first = 0 if split == "dev" else 100
    return [
        Ground("procedural", f"{kind.value} {first + n}") for kind in GroundKind for n in range(3)
    ]


@lru_cache(maxsize=24)
def picture(path: str) -> np.ndarray:
    """A ground's picture, BGR."""
    if Path(path).suffix:
        return np.asarray(cv2.imread(path, cv2.IMREAD_COLOR))
    kind, seed = path.split()
    rng = np.random.default_rng((int(seed), 77))
    raster = paint_ground(GroundKind(kind), Area(-32.0, -20.0, 32.0, 20.0), 0.04, rng).raster
    return np.ascontiguousarray(raster.rgb[..., ::-1])


def pairs(
    suite: str, seed: int, count: int, places: list[Ground], split: str, crowding: int = 1
) -> Iterator[Pair]:
    """`count` pairs of a suite, with `crowding` times as many things; the same arguments give the same pairs."""
    for number in range(count):
        rng = _random(suite, seed, number, split)
        scene, source, known = _scene(rng, suite, places, crowding)
        yield _pair(suite, source, scene, known, rng, clouds_before=True)


def views(
    suite: str, seed: int, number: int, places: list[Ground], split: str, count: int = 5
) -> list[Pair]:
    """`count` views of one ground, each with nuisances of its own; they show the same changes."""
    rng = _random(f"{suite} views", seed, number, split)
    scene, source, known = _scene(rng, suite, places)
    return [_pair(suite, source, scene, known, rng, clouds_before=False) for _ in range(count)]


def _random(suite: str, seed: int, number: int, split: str) -> np.random.Generator:
    return np.random.default_rng([seed, number, *f"{split} {suite}".encode()])


def _scene(
    rng: np.random.Generator, suite: str, places: list[Ground], crowding: int = 1
) -> tuple[Scene, str, np.ndarray]:
    """Ground with a margin before and after, masks of what differs, where both are known; sources weigh the same."""
    nuisance = SUITES[suite]
    if suite == "real":
        places = [each for each in places if each.source in REAL]
    sources = sorted({each.source for each in places})
    source = sources[int(rng.integers(len(sources)))]
    choice = [each for each in places if each.source == source]
    place = choice[int(rng.integers(len(choice)))]
    size = SIZES[int(rng.integers(2))]
    whole = picture(place.path)
    if min(whole.shape[0] / size[1], whole.shape[1] / size[0]) < 1.2:
        size = SIZES[1]
    pictures = (whole, whole, np.full(whole.shape[:2], 255, np.uint8))
    if suite == "real":
        at = choice.index(place)
        pictures = _registered(place.path, choice[at + 1 if at + 1 < len(choice) else at - 1].path)
    for _attempt in range(20):
        before, after, known = _cut(pictures, size, rng)
        if (known > 250).mean() > 0.7:
            break
    scale = size[0] / 1280 * nuisance.object_scale
    scene = Scene(before, after, *[np.zeros(before.shape[:2], np.float32)] * 4)
    inside = known[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX] > 250
    if rng.uniform() >= nuisance.changed:
        return scene, source, inside
    for _ in range(crowding):
        cutouts = [_cutout(choice, rng) for _ in range(3)]
        donor = picture(choice[int(rng.integers(len(choice)))].path)
        kept = [each for each in cutouts if each is not None]
        scene = paint_objects(scene, rng, scale, nuisance.low_contrast, kept, donor, MARGIN_PX)
    return scene, source, inside


def _cut(
    pictures: tuple[np.ndarray, ...], size: tuple[int, int], rng: np.random.Generator
) -> list[np.ndarray]:
    """The same piece of all pictures as frames of `size` with the margin, float32, turned and mirrored at random."""
    width, height = size[0] + 2 * MARGIN_PX, size[1] + 2 * MARGIN_PX
    whole = pictures[0].shape
    largest = min(whole[1] / width, whole[0] / height)
    factor = rng.uniform(min(1.0, largest), max(min(2.0, largest), min(1.0, largest)))
    cut_width, cut_height = int(width * factor), int(height * factor)
    x = int(rng.integers(whole[1] - cut_width + 1))
    y = int(rng.integers(whole[0] - cut_height + 1))
    across, down = (-1 if rng.uniform() < 0.5 else 1 for _ in range(2))
    how = cv2.INTER_AREA if factor > 1 else cv2.INTER_CUBIC
    pieces = [
        cv2.resize(each[y : y + cut_height, x : x + cut_width], (width, height), interpolation=how)[
            ::down, ::across
        ]
        for each in pictures
    ]
    return [np.ascontiguousarray(piece, np.float32) for piece in pieces]


@lru_cache(maxsize=8)
def _registered(path: str, other: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A photo, its neighbour laid over it by a homography, and where both are known (255); itself if it fits not."""
    before, after = picture(path), picture(other)
    factor = 1000 / before.shape[1]
    sift = cv2.SIFT_create(4000)
    found = [
        sift.detectAndCompute(
            cv2.resize(cv2.cvtColor(each, cv2.COLOR_BGR2GRAY), None, fx=factor, fy=factor), None
        )
        for each in (after, before)
    ]
    pairs_of = cv2.BFMatcher().knnMatch(found[0][1], found[1][1], k=2)
    good = [near for near, far in pairs_of if near.distance < 0.75 * far.distance]
    from_points = np.float32([found[0][0][each.queryIdx].pt for each in good]) / factor
    to_points = np.float32([found[1][0][each.trainIdx].pt for each in good]) / factor
    homography, inliers = cv2.findHomography(from_points, to_points, cv2.USAC_MAGSAC, 3.0)
    size = before.shape[1::-1]
    if homography is None or inliers.sum() < 40:
        return before, before, np.full(before.shape[:2], 255, np.uint8)
    warped = cv2.warpPerspective(after, homography, size, flags=cv2.INTER_CUBIC)
    known = cv2.warpPerspective(np.full(after.shape[:2], 255, np.uint8), homography, size)
    return before, warped, cv2.erode(known, np.ones((5, 5), np.uint8))


def _cutout(choice: list[Ground], rng: np.random.Generator) -> Cutout | None:
    """A labelled thing of another photo of the same source."""
    place = choice[int(rng.integers(len(choice)))]
    if not place.labels:
        return None
    rows = [line.split() for line in Path(place.labels).read_text().splitlines() if line.strip()]
    if not rows:
        return None
    row = rows[int(rng.integers(len(rows)))]
    image = picture(place.path)
    high, wide = image.shape[:2]
    x, y, w, h = (float(value) for value in row[1:5])
    left, top = max(0, int((x - w / 2) * wide)), max(0, int((y - h / 2) * high))
    piece = image[top : int((y + h / 2) * high), left : int((x + w / 2) * wide)]
    return Cutout(piece) if min(piece.shape[:2]) >= 10 else None


def _pair(
    suite: str,
    source: str,
    scene: Scene,
    known: np.ndarray,
    rng: np.random.Generator,
    clouds_before: bool,
) -> Pair:
    nuisance = SUITES[suite]
    size = scene.before.shape[1] - 2 * MARGIN_PX, scene.before.shape[0] - 2 * MARGIN_PX
    scale = size[0] / 1280
    given = nuisance if nuisance.exact else _some_of(nuisance, rng)
    still = _flow(scene.before.shape[:2], rng, 0.3)
    flow = _flow(scene.before.shape[:2], rng, given.misaligned_px)
    gain = np.ones(scene.before.shape[:2], np.float32)
    if given.wind_px or given.parallax_px:
        plants = _plants(scene.before, rng)
        if given.wind_px:
            flow += _wobble(plants, given.wind_px * scale, rng)
            gain += 0.06 * plants * _clouds(plants.shape, rng, 5.0)
        if given.parallax_px:
            heights = _heights(plants, rng, given.parallax_px * scale)
            angle = rng.uniform(0, 2 * np.pi)
            flow += heights[..., None] * np.float32([np.cos(angle), np.sin(angle)])
    pictures = [_warped(scene.before, still), _warped(scene.after * gain[..., None], flow)]
    truth = (_warped(scene.removed, still) > 0.5) | (_warped(scene.added, flow) > 0.5)
    shade = (_warped(scene.shade_before, still) > 0.04) | (_warped(scene.shade_after, flow) > 0.04)
    if rng.uniform() < given.cloud:
        shadowed = int(rng.uniform() < 0.7) if clouds_before else 1
        pictures[shadowed] = pictures[shadowed] * _cloud_shadow(pictures[shadowed].shape[:2], rng)
    if rng.uniform() < given.cast_shadows:
        pictures = [each * _cast_shadows(each.shape[:2], rng) for each in pictures]
    if given.illumination:
        pictures[1] = _relit(pictures[1], rng)
    valid = _coverage(size, rng) & known
    reference = _taken(pictures[0], rng, rng.uniform(0.3, 0.8), int(rng.integers(85, 96)))
    query = _taken(pictures[1], rng, rng.uniform(0.0, 0.7), int(rng.integers(80, 96)))
    reference[~valid] = 0
    truth, cut = _within(truth, valid)
    return Pair(suite, source, reference, query, valid, truth, (shade | cut) & ~truth)


def _within(truth: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The changes in the known part, and those of which too little is known to ask for them."""
    count, labels = cv2.connectedComponents(truth.astype(np.uint8), connectivity=8)
    whole = np.bincount(labels.ravel(), minlength=count)
    known = np.bincount(labels[valid], minlength=count)
    asked = known >= 0.7 * whole
    asked[0] = False
    return truth & valid & asked[labels], truth & ~asked[labels]


def _some_of(nuisance: Nuisance, rng: np.random.Generator) -> Nuisance:
    return replace(
        nuisance,
        wind_px=nuisance.wind_px * rng.uniform(),
        parallax_px=nuisance.parallax_px * rng.uniform(),
        misaligned_px=nuisance.misaligned_px * rng.uniform(0.1, 1.0),
    )


def _flow(shape: tuple[int, int], rng: np.random.Generator, size_px: float) -> np.ndarray:
    """A homography's displacement, at most about `size_px` long at the corners."""
    height, width = shape
    corners = np.float32([[0, 0], [width, 0], [width, height], [0, height]])
    common = rng.normal(size=2)
    moves = 0.7 * common / np.linalg.norm(common) + 0.3 * rng.uniform(-1, 1, (4, 2))
    moves *= size_px / np.linalg.norm(moves, axis=1).max()
    homography = cv2.getPerspectiveTransform(corners, np.float32(corners + moves))
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    moved = cv2.perspectiveTransform(np.dstack([x, y]).reshape(-1, 1, 2), homography).reshape(
        height, width, 2
    )
    return moved - np.dstack([x, y])


def _warped(image: np.ndarray, flow: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    warped = cv2.remap(
        image, x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )
    return warped[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]


def _clouds(shape: tuple[int, int], rng: np.random.Generator, grain_px: float) -> np.ndarray:
    """A smooth random field of spread one whose grain has about the size given."""
    small = max(2, int(shape[0] / grain_px)), max(2, int(shape[1] / grain_px))
    noise = cv2.resize(
        rng.normal(size=small).astype(np.float32), shape[::-1], interpolation=cv2.INTER_CUBIC
    )
    return noise / max(float(noise.std()), 1e-6)


def _plants(world: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Where plants are, 0 to 1: the green, and where there is none, patches anywhere."""
    blue, green, red = cv2.split(cv2.blur(world, (15, 15)))
    cover = np.clip((2 * green - red - blue - 10) / 20, 0, 1)
    if cover.mean() < 0.05:
        cover = np.clip(_clouds(cover.shape, rng, 120.0) - 0.4, 0, 1)
    return np.asarray(cv2.GaussianBlur(cover, (0, 0), 4), np.float32)


def _wobble(plants: np.ndarray, size_px: float, rng: np.random.Generator) -> np.ndarray:
    moves = [
        0.5 * _clouds(plants.shape, rng, 14.0) + 0.35 * _clouds(plants.shape, rng, 6.0)
        for _ in range(2)
    ]
    return np.dstack(moves).astype(np.float32) * plants[..., None] * np.float32(size_px)


def _heights(plants: np.ndarray, rng: np.random.Generator, size_px: float) -> np.ndarray:
    """How far standing things lean, px: crowns among the plants with leaves of their own height, and walls."""
    height, width = plants.shape
    lean = np.zeros(plants.shape, np.float32)
    for _ in range(int(rng.integers(6, 16))):
        centre = int(rng.integers(width)), int(rng.integers(height))
        axes = tuple(int(v) for v in rng.uniform(25, 90, 2))
        one = np.zeros(plants.shape, np.float32)
        if rng.uniform() < 0.7:
            cv2.ellipse(
                one, centre, axes, rng.uniform(0, 180), 0, 360, float(rng.uniform(0.5, 1)), -1
            )
            leaves = cv2.GaussianBlur(one, (0, 0), 5) * (1 + 0.12 * _clouds(one.shape, rng, 8.0))
            lean = np.maximum(lean, leaves * (0.3 + 0.7 * plants))
        else:
            corners = cv2.boxPoints((centre, axes, float(rng.uniform(0, 90)))).astype(np.int32)
            cv2.fillConvexPoly(one, corners, float(rng.uniform(0.4, 1)))
            lean = np.maximum(lean, cv2.GaussianBlur(one, (0, 0), 1 + 0.3 * size_px))
    return np.asarray(lean / max(float(lean.max()), 1e-6) * size_px, np.float32)


def _cloud_shadow(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    soft_px = rng.uniform(5, 30)
    edge = _clouds(shape, rng, rng.uniform(200, 500)) + 0.15 * _clouds(shape, rng, 60.0)
    cover = cv2.GaussianBlur((edge > rng.uniform(-0.3, 0.5)).astype(np.float32), (0, 0), soft_px)
    depth = rng.uniform(0.3, 0.55) * np.float32([0.92, 1.0, 1.05])  # a shadow is bluer than the sun
    return 1 - cover[..., None] * depth


def _cast_shadows(shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Sharp shadows of crowns and roofs at one time of day."""
    height, width = shape
    cover = np.zeros(shape, np.float32)
    for _ in range(int(rng.integers(2, 7))):
        one = np.zeros(shape, np.float32)
        centre = int(rng.integers(width)), int(rng.integers(height))
        axes = tuple(int(v) for v in np.exp(rng.uniform(np.log(12), np.log(110), 2)))
        if rng.uniform() < 0.6:
            cv2.ellipse(one, centre, axes, rng.uniform(0, 180), 0, 360, 1.0, -1)
            one = (cv2.GaussianBlur(one, (0, 0), 3) + 0.15 * _clouds(shape, rng, 9.0) > 0.5).astype(
                np.float32
            )
        else:
            cv2.fillConvexPoly(
                one, cv2.boxPoints((centre, axes, float(rng.uniform(0, 90)))).astype(np.int32), 1.0
            )
        cover = np.maximum(cover, one)
    cover = cv2.GaussianBlur(cover, (0, 0), rng.uniform(0.7, 2.5))
    return 1 - cover[..., None] * rng.uniform(0.35, 0.6) * np.float32([0.88, 0.98, 1.04])


def _relit(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    powered = (
        255 * np.clip(image / 255, 0, None) ** rng.uniform(0.75, 1.35) * rng.uniform(0.85, 1.15, 3)
    )
    # a camera exposes for the picture as a whole: never black, never overexposed everywhere
    powered *= rng.uniform(0.6, 1.5) * float(image.mean()) / max(float(powered.mean()), 1.0)
    return powered * min(1.0, 235 / max(float(np.quantile(powered, 0.95)), 1.0))


def _taken(image: np.ndarray, rng: np.random.Generator, blur_px: float, quality: int) -> np.ndarray:
    """What the camera makes of a view: blur, noise of two grey levels, JPEG."""
    if blur_px > 0.2:
        image = cv2.GaussianBlur(image, (0, 0), blur_px)
    noisy = np.clip(image + rng.normal(0, 2.0, image.shape) + 0.5, 0, 255).astype(np.uint8)
    _, encoded = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR))


def _coverage(size: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    """Where the map is known: everywhere, or for one pair in five not beyond a slanted line."""
    valid = np.ones((size[1], size[0]), bool)
    if rng.uniform() < 0.2:
        angle = rng.uniform(0, 2 * np.pi)
        x, y = np.meshgrid(np.linspace(-1, 1, size[0]), np.linspace(-1, 1, size[1]))
        valid = x * np.cos(angle) + y * np.sin(angle) < rng.uniform(0.5, 1.0)
    return valid

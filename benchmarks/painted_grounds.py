"""Grounds of other looks than the photos at hand: recoloured, with streets, lawns, roofs and markings painted on.

A check of regions that learns from one site's brown soil takes a green lane for a thing; these teach it surfaces of any
colour, smooth ones above all, with hard edges between them.
"""

import cv2
import numpy as np

SIZE = (1800, 1200)


def painted_ground(photo: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Another ground (h, w, 3) uint8 BGR made from a `photo` of ground, of `SIZE`."""
    image = _recoloured(_piece(photo, rng), rng)
    for _ in range(int(rng.integers(3, 16))):
        image = _surface(image, rng)
    image = np.clip(image, 0, 255).astype(np.uint8)
    for _ in range(int(rng.integers(0, 60))):
        _mark(image, rng)
    grain = cv2.GaussianBlur(
        rng.normal(0, 1, image.shape[:2]).astype(np.float32), (0, 0), float(rng.uniform(0.5, 2))
    )
    image = image + grain[..., None] * np.float32(rng.uniform(0, 3) / max(float(grain.std()), 1e-6))
    return np.asarray(
        np.clip(cv2.GaussianBlur(image, (0, 0), float(rng.uniform(0.4, 1.2))), 0, 255), np.uint8
    )


def _piece(photo: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    factor = rng.uniform(0.5, 1.0) * min(photo.shape[1] / SIZE[0], photo.shape[0] / SIZE[1])
    width, height = int(SIZE[0] * factor), int(SIZE[1] * factor)
    x, y = (
        int(rng.integers(photo.shape[1] - width + 1)),
        int(rng.integers(photo.shape[0] - height + 1)),
    )
    piece = cv2.resize(photo[y : y + height, x : x + width], SIZE, interpolation=cv2.INTER_CUBIC)
    return np.asarray(piece, np.float32)


def _recoloured(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Other hue, colourfulness, contrast and brightness; of some only the coarse structure is kept."""
    mean = image.mean(axis=2, keepdims=True)
    level = float(mean.mean())
    tint = rng.uniform(0.75, 1.25, 3).astype(np.float32)
    grey = (mean - level) * np.float32(rng.uniform(0.4, 1.6)) + np.float32(rng.uniform(50, 190))
    colour = (image - mean) * np.float32(rng.uniform(0, 1.8))
    turned = np.ascontiguousarray((grey + colour[..., rng.permutation(3)]) * tint)
    if rng.uniform() < 0.3:
        turned = cv2.GaussianBlur(turned, (0, 0), float(rng.uniform(2, 12)))
    return turned


def _surface(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A street, a lawn, a roof, a lane: one colour, with as much of the structure below as its smoothness leaves."""
    cover = np.zeros(image.shape[:2], np.float32)
    centre = rng.uniform(0, SIZE[0]), rng.uniform(0, SIZE[1])
    if rng.uniform() < 0.5:
        axes = rng.uniform(1500, 3500), np.exp(rng.uniform(np.log(15), np.log(400)))
    else:
        axes = tuple(np.exp(rng.uniform(np.log(40), np.log(700), 2)))
    angle = float(rng.choice([0, 90, rng.uniform(0, 180)]))
    if rng.uniform() < 0.8:
        cv2.fillConvexPoly(
            cover, cv2.boxPoints((centre, axes, angle)).astype(np.int32), 1.0, cv2.LINE_AA
        )
    else:
        cv2.ellipse(cover, (centre, axes, angle), 1.0, -1, cv2.LINE_AA)
    if rng.uniform() < 0.3:
        cover = cv2.GaussianBlur(cover, (0, 0), float(rng.uniform(1, 15)))
    structure = image - cv2.blur(image, (61, 61))
    skin = _colour(rng) + np.float32(rng.uniform(0, 0.8)) * structure.mean(axis=2, keepdims=True)
    if rng.uniform() < 0.25:  # rows: tiles, boards, planting
        pitch = rng.uniform(6, 50)
        x, y = np.meshgrid(
            np.arange(SIZE[0], dtype=np.float32), np.arange(SIZE[1], dtype=np.float32)
        )
        phase = (x * np.cos(np.radians(angle)) + y * np.sin(np.radians(angle))) * np.float32(
            2 * np.pi / pitch
        )
        rows = np.sign(np.sin(phase) - np.float32(rng.uniform(0, 0.9)))
        skin = skin + np.float32(rng.uniform(3, 25)) * rows[..., None]
    rim = (
        cv2.morphologyEx(
            (cover > 0.5).astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((5, 5), np.uint8)
        )
        > 0
    )
    image = image + cover[..., None] * (skin - image)
    if rng.uniform() < 0.4:
        image[rim] = _colour(rng)
    return np.asarray(image, np.float32)


def _mark(image: np.ndarray, rng: np.random.Generator) -> None:
    """A painted line, letters, a cover in the road, a dot of rubbish."""
    place = int(rng.integers(SIZE[0])), int(rng.integers(SIZE[1]))
    white = float(rng.uniform(140, 250)) * np.array([rng.uniform(0.6, 1), 1, 1])
    colour = tuple(float(v) for v in (white if rng.uniform() < 0.6 else _colour(rng)))
    kind = int(rng.integers(4))
    if kind == 0:
        angle, length = rng.choice([0, np.pi / 2, rng.uniform(0, np.pi)]), rng.uniform(20, 900)
        end = int(place[0] + length * np.cos(angle)), int(place[1] + length * np.sin(angle))
        cv2.line(image, place, end, colour, int(rng.integers(1, 14)), cv2.LINE_AA)
    elif kind == 1:
        letters = "".join(rng.choice(list("ABEHKLNOPRSTUXY"), int(rng.integers(1, 5))))
        cv2.putText(
            image,
            letters,
            place,
            cv2.FONT_HERSHEY_DUPLEX,
            float(rng.uniform(0.6, 4)),
            colour,
            int(rng.integers(1, 9)),
            cv2.LINE_AA,
        )
    elif kind == 2:
        cv2.circle(image, place, int(rng.integers(3, 26)), colour, -1, cv2.LINE_AA)
    else:
        axes = tuple(float(v) for v in rng.uniform(5, 60, 2))
        box = cv2.boxPoints((place, axes, float(rng.uniform(0, 180)))).astype(np.int32)
        cv2.fillConvexPoly(image, box, colour, cv2.LINE_AA)


def _colour(rng: np.random.Generator) -> np.ndarray:
    """Asphalt and concrete, plants, or anything (3,) float32 BGR."""
    kind = rng.uniform()
    if kind < 0.45:
        hsv = [rng.integers(180), rng.uniform(0, 30), rng.uniform(30, 220)]
    elif kind < 0.75:
        hsv = [rng.integers(30, 90), rng.uniform(50, 220), rng.uniform(50, 220)]
    else:
        hsv = [rng.integers(180), rng.uniform(0, 220), rng.uniform(20, 240)]
    return cv2.cvtColor(np.uint8([[hsv]]), cv2.COLOR_HSV2BGR)[0, 0].astype(np.float32)

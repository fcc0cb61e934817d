"""Things painted on a photo of ground for the change suites: boxes, cars, people, rubbish, cut-outs of photos."""

from dataclasses import dataclass

import cv2
import numpy as np

LEAST_CONTRAST = (
    25.0  # mean largest difference of a channel between a thing and its ground, grey levels
)
LEAST_LOW_CONTRAST = 10.0


@dataclass(frozen=True, eq=False)
class Cutout:
    """A labelled thing cut from a photo, (h, w, 3) uint8, BGR."""

    image: np.ndarray


@dataclass(frozen=True, eq=False)
class Scene:
    """One piece of ground on two dates: pictures float32 (h, w, 3) BGR, covers float32 (h, w), 0 to 1."""

    before: np.ndarray
    after: np.ndarray
    removed: np.ndarray
    added: np.ndarray
    shade_before: np.ndarray
    shade_after: np.ndarray


def paint_objects(
    scene: Scene,
    rng: np.random.Generator,
    scale: float,
    low_contrast: float,
    cutouts: list[Cutout],
    donor: np.ndarray,
    margin_px: int,
) -> Scene:
    """One to three more things put on the ground before or after; each 12 to 80 px times `scale`."""
    pictures = [scene.before.copy(), scene.after.copy()]
    covers = [scene.removed.copy(), scene.added.copy()]
    shades = [scene.shade_before.copy(), scene.shade_after.copy()]
    taken = (scene.removed > 0) | (scene.added > 0)
    sun = rng.uniform(0, 2 * np.pi)
    for _ in range(int(rng.integers(1, 4))):
        is_low = rng.uniform() < low_contrast
        for _attempt in range(12):
            when = int(rng.uniform() < 0.6)
            length = np.exp(rng.uniform(np.log(12), np.log(80))) * scale
            thing, alpha = _thing(rng, length, scene.before, is_low, cutouts, donor)
            high, wide = alpha.shape
            edge = margin_px + 4
            y = int(rng.integers(edge, taken.shape[0] - high - edge))
            x = int(rng.integers(edge, taken.shape[1] - wide - edge))
            window = np.s_[y : y + high, x : x + wide]
            if taken[window].any():
                continue
            ground = pictures[when][window]
            contrast = np.abs(thing - ground).max(axis=2)[alpha > 0.5].mean()
            if contrast < (LEAST_LOW_CONTRAST if is_low else LEAST_CONTRAST):
                continue
            shade = _shade(taken.shape, alpha, (x, y), sun, rng, length)
            taken[window] = True
            pictures[when] = pictures[when] * (1 - shade[..., None])
            lit = pictures[when][window]
            pictures[when][window] = lit + alpha[..., None] * (thing - lit)
            covers[when][window] = np.maximum(covers[when][window], alpha)
            shades[when] = np.maximum(shades[when], shade)
            break
    return Scene(pictures[0], pictures[1], covers[0], covers[1], shades[0], shades[1])


def _shade(
    shape: tuple[int, ...],
    alpha: np.ndarray,
    at: tuple[int, int],
    sun: float,
    rng: np.random.Generator,
    length: float,
) -> np.ndarray:
    """The soft shadow that a thing casts, how much it darkens."""
    shade = np.zeros(shape[:2], np.float32)
    reach = rng.uniform(0.05, 0.3) * length
    left, top = int(at[0] + reach * np.cos(sun)), int(at[1] + reach * np.sin(sun))
    top, left = max(top, 0), max(left, 0)
    high, wide = min(alpha.shape[0], shape[0] - top), min(alpha.shape[1], shape[1] - left)
    shade[top : top + high, left : left + wide] = alpha[:high, :wide]
    soft = cv2.GaussianBlur(shade, (0, 0), max(1.0, 0.04 * length))
    return np.asarray(soft * rng.uniform(0.0, 0.5), np.float32)


def _thing(
    rng: np.random.Generator,
    length: float,
    ground: np.ndarray,
    is_low: bool,
    cutouts: list[Cutout],
    donor: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """A thing's picture and cover in its bounding rectangle."""
    breadth = max(length * rng.uniform(0.4, 1.0), min(length, 6.0))
    reach = int(np.ceil(np.hypot(length, breadth))) + 4
    shape = (reach, reach)
    middle = (reach - 1) / 2
    kind = int(rng.integers(6 if cutouts and not is_low else 5))
    angle = float(rng.uniform(0, 180))
    if kind == 5 and length >= 16:
        return _pasted(cutouts[int(rng.integers(len(cutouts)))].image, length, angle, rng)
    fine = 4  # drawn four times finer, for smooth edges
    big = np.zeros((reach * fine, reach * fine), np.uint8)
    centre = ((middle + 0.5) * fine, (middle + 0.5) * fine)
    axes = (length * fine, breadth * fine)
    if kind in (1, 4):
        cv2.ellipse(big, (centre, axes, angle), 255, -1)
    elif kind == 2:
        turns = np.sort(rng.uniform(0, 2 * np.pi, 7)) + np.radians(angle)
        spread = rng.uniform(0.6, 1.0, 7)[:, None] * np.column_stack([np.cos(turns), np.sin(turns)])
        cv2.fillPoly(big, [np.int32(centre + spread * np.array(axes) / 2)], 255)
    else:
        cv2.fillConvexPoly(big, cv2.boxPoints((centre, axes, angle)).astype(np.int32), 255)
    alpha = cv2.resize(big, shape[::-1], interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    brightness = float(ground.mean()) / 110
    skin = _texture(rng, shape, ground if is_low else donor, brightness, is_low)
    if kind in (3, 4) and not is_low:
        skin = _detailed(skin, rng, (length, breadth), angle, is_person=kind == 4)
    return skin, alpha


def _texture(
    rng: np.random.Generator,
    shape: tuple[int, int],
    donor: np.ndarray,
    brightness: float,
    is_low: bool,
) -> np.ndarray:
    """A surface: a piece of a photo, or a colour with grain and a gradient."""
    if is_low or rng.uniform() < 0.35:
        y = int(rng.integers(donor.shape[0] - shape[0]))
        x = int(rng.integers(donor.shape[1] - shape[1]))
        piece = donor[y : y + shape[0], x : x + shape[1]].astype(np.float32)
        return np.clip(piece * rng.uniform(0.75, 1.3), 0, 255)
    hsv = np.uint8([[[rng.integers(180), 255 * rng.beta(1, 1.7), rng.uniform(20, 245)]]])
    colour = cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)[0, 0].astype(np.float32) * np.clip(
        brightness, 0.6, 1.3
    )
    grain = cv2.GaussianBlur(
        rng.normal(0, 1, shape).astype(np.float32), (0, 0), rng.uniform(0.8, 3)
    )
    grain *= rng.uniform(2, 10) / max(float(grain.std()), 1e-6)
    slope = np.linspace(-1, 1, shape[1], dtype=np.float32) * rng.uniform(-12, 12)
    return np.clip(colour + (grain + slope)[..., None], 0, 255)


def _detailed(
    skin: np.ndarray,
    rng: np.random.Generator,
    axes: tuple[float, float],
    angle: float,
    is_person: bool,
) -> np.ndarray:
    """Windows of a car, or the head of a person seen from above."""
    skin = np.ascontiguousarray(skin)
    middle = (skin.shape[0] - 1) / 2
    along = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    if is_person:
        head = tuple(float(v) for v in rng.uniform(20, 150, 3))
        cv2.circle(
            skin, (round(middle), round(middle)), max(1, int(axes[1] * 0.28)), head, -1, cv2.LINE_AA
        )
        return skin
    glass = float(rng.uniform(15, 70))
    for offset, part in ((0.2, 0.12), (-0.3, 0.1)):
        centre = np.array([middle, middle]) + along * axes[0] * offset
        box = (tuple(float(v) for v in centre), (axes[0] * part, axes[1] * 0.75), angle)
        cv2.fillConvexPoly(
            skin, cv2.boxPoints(box).astype(np.int32), (glass + 10, glass, glass), cv2.LINE_AA
        )
    return skin


def _pasted(
    cut: np.ndarray, length: float, angle: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """A cut-out at the wanted length, its corners rounded off, turned."""
    factor = length / max(cut.shape[:2])
    small = cv2.resize(
        cut,
        None,
        fx=factor,
        fy=factor,
        interpolation=cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC,
    )
    high, wide = small.shape[:2]
    y, x = np.mgrid[:high, :wide]
    radius = np.abs((x + 0.5) / wide * 2 - 1) ** 4 + np.abs((y + 0.5) / high * 2 - 1) ** 4
    alpha = np.clip((0.9 - radius) * min(high, wide) / 4, 0, 1).astype(np.float32)
    reach = int(np.ceil(np.hypot(high, wide))) + 4
    turn = cv2.getRotationMatrix2D(((wide - 1) / 2, (high - 1) / 2), angle, 1.0)
    turn[:, 2] += [(reach - wide) / 2, (reach - high) / 2]
    turned = cv2.warpAffine(
        small, turn, (reach, reach), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    cover = cv2.warpAffine(alpha, turn, (reach, reach), flags=cv2.INTER_LINEAR)
    return turned.astype(np.float32) * rng.uniform(0.9, 1.1), cover

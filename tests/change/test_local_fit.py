"""What no homography explains: found where two dates share texture, and nothing else is followed."""

import cv2
import numpy as np
import pytest

from sorvolo.change.local_fit import fit_locally

WIDTH, HEIGHT = 640, 360
M_PER_PX = 0.2
KNOWN = np.ones((HEIGHT, WIDTH), bool)


def texture(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    total = np.zeros((HEIGHT, WIDTH), np.float32)
    for octave in (2, 5, 14, 40):
        small = rng.normal(0, 1, (HEIGHT // octave + 2, WIDTH // octave + 2)).astype(np.float32)
        total += cv2.resize(small, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    return np.clip(120 + 22 * total, 0, 255).astype(np.uint8)


def waves(most_px: float) -> np.ndarray:
    """(H, W, 2) a smooth displacement."""
    rng = np.random.default_rng(5)
    moved = np.dstack(
        [
            cv2.resize(
                rng.normal(0, 1, (2, 3)).astype(np.float32),
                (WIDTH, HEIGHT),
                interpolation=cv2.INTER_CUBIC,
            )
            for _ in range(2)
        ]
    )
    return moved / np.abs(moved).max() * most_px


def moved(image: np.ndarray, by_px: np.ndarray) -> np.ndarray:
    """The picture shows at y + by_px there what it showed at y: a query for the reference `image`."""
    x, y = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT, dtype=np.float32))
    back = by_px.astype(
        np.float32
    )  # smooth: where it comes from it is nearly what it is where it arrives
    for _ in range(5):
        back = cv2.remap(
            by_px.astype(np.float32), x - back[..., 0], y - back[..., 1], cv2.INTER_LINEAR
        )
    return cv2.remap(
        image, x - back[..., 0], y - back[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )


def later(image: np.ndarray, share: float, seed: int = 9) -> np.ndarray:
    """The same ground on another date: so much of it replaced in blocks, other light, noise."""
    rng = np.random.default_rng(seed)
    blocks = (rng.random((18, 32)) < share).astype(np.uint8)
    new = cv2.resize(blocks, (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST) > 0
    mixed = np.where(new, texture(seed + 1), image)
    return np.clip(255 * (mixed / 255.0) ** 1.6 + rng.normal(0, 3, mixed.shape), 0, 255).astype(
        np.uint8
    )


def at_cells(by_px: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    return cv2.resize(by_px.astype(np.float32), shape[::-1], interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_a_smooth_displacement_is_found_although_half_of_the_ground_changed(share: float) -> None:
    before, by_px = texture(1), waves(4.0)
    found = fit_locally(before, later(moved(before, by_px), share), KNOWN, M_PER_PX)
    assert found is not None
    true = at_cells(by_px, found.is_known.shape)
    miss = np.linalg.norm(found.moved_px - true, axis=2)
    assert np.median(np.linalg.norm(true, axis=2)) > 1.8
    assert np.median(miss) < 0.4 * np.median(np.linalg.norm(true, axis=2))
    assert found.rest < 0.4


def test_the_warped_query_lies_on_the_reference() -> None:
    before, by_px = texture(1), waves(4.0)
    query = moved(before, by_px)
    found = fit_locally(before, query, KNOWN, M_PER_PX)
    assert found is not None
    image, valid = found.warped(np.dstack([query] * 3), KNOWN)
    inner = np.zeros_like(valid)
    inner[20:-20, 20:-20] = True
    apart = np.abs(image[..., 0].astype(int) - before)[inner & valid].mean()
    assert apart < 0.5 * np.abs(query.astype(int) - before)[inner].mean()
    assert valid.mean() > 0.95 and not valid.all()


@pytest.mark.parametrize("seed", [2, 3, 4, 5])
def test_other_ground_gives_no_displacement(seed: int) -> None:
    assert fit_locally(texture(1), later(texture(10 * seed), 0.0), KNOWN, M_PER_PX) is None


def test_what_already_lies_right_is_left_alone() -> None:
    before = texture(1)
    found = fit_locally(before, later(before, 0.3), KNOWN, M_PER_PX)
    assert found is None or found.median_px < 0.3


@pytest.mark.parametrize("size", [(24, 10), (60, 26), (110, 45)])
def test_things_that_moved_are_not_followed(size: tuple[int, int]) -> None:
    """A box, a lorry, a building of 22 x 9 m that moved by 1 m while the ground around is displaced smoothly."""
    wide, high = size
    before, by_px = texture(1), waves(3.0)
    after = later(moved(before, by_px), 0.2)
    place = np.s_[150 : 150 + high, 260 : 260 + wide]
    shown = texture(77)[place]
    before[place] = shown
    shift = by_px[150 + high // 2, 260 + wide // 2]
    dx, dy = round(float(shift[0])) + 5, round(float(shift[1]))
    after[150 + dy : 150 + dy + high, 260 + dx : 260 + dx + wide] = shown
    found = fit_locally(before, after, KNOWN, M_PER_PX)
    assert found is not None
    field = cv2.resize(found.moved_px.astype(np.float32), (WIDTH, HEIGHT))
    at_thing = field[place].reshape(-1, 2).mean(axis=0)
    assert (
        np.linalg.norm(at_thing - by_px[place].reshape(-1, 2).mean(axis=0)) < 1.0
    )  # px; it moved by 5


def test_the_displacement_is_bounded_in_metres_and_holes_show_nothing() -> None:
    before, known = texture(1), KNOWN.copy()
    known[:, 400:] = False
    by_px = np.full((HEIGHT, WIDTH, 2), [4.0, 0.0], np.float32)
    query = moved(before, by_px)
    query[:, 404:] = 0
    found = fit_locally(before, query, known, M_PER_PX)
    assert found is not None
    assert not found.is_known[:, -6:].any()
    assert np.median(np.linalg.norm(found.moved_px - [4.0, 0.0], axis=2)[found.is_known]) < 0.4
    close = fit_locally(
        before, query, known, 0.5
    )  # 4 px are 2 m there, more than relief and maps do
    assert close is None or np.linalg.norm(close.moved_px, axis=2).max() <= 3.0 + 1e-6

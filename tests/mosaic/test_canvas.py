"""The canvas: seamless tiles, the same picture whatever the order, and no more work than a change needs."""

import time

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from real_data import real_data
from sorvolo.errors import GeometryError
from sorvolo.geometry.grid import Grid
from sorvolo.geometry.homography import apply_homography
from sorvolo.mosaic.canvas import Canvas
from sorvolo.mosaic.canvas_frame import CanvasFrame, coverage, warp

WIDTH, HEIGHT = 320, 240


def textured(height: int, width: int, seed: int = 0) -> np.ndarray:
    """Noise with detail at every scale, so that a misplaced or mixed-up pixel shows."""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width, 3), np.float32)
    for octave in (4, 16, 64, 256):
        small = rng.normal(0, 1, (height // octave + 2, width // octave + 2, 3)).astype(np.float32)
        total += cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 22 * total, 0, 255).astype(np.uint8)


GROUND = textured(900, 1100)


def pose(
    x: float, y: float, turn_deg: float = 0.0, scale: float = 1.0, bend: float = 0.0
) -> np.ndarray:
    a = np.radians(turn_deg)
    return np.array(
        [
            [scale * np.cos(a), -scale * np.sin(a), x],
            [scale * np.sin(a), scale * np.cos(a), y],
            [bend, -bend, 1.0],
        ]
    )


def photographed(grid_from_image: np.ndarray, gain: float = 1.0) -> np.ndarray:
    """What a camera at this place sees of GROUND, which lies at grid pixel (-100, -80)."""
    image_from_ground = np.linalg.inv(grid_from_image) @ np.array(
        [[1, 0, -100], [0, 1, -80], [0, 0, 1.0]]
    )
    image = cv2.warpPerspective(
        GROUND, image_from_ground, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT
    )
    return np.clip(image * gain, 0, 255).astype(np.uint8)


def flight(
    seed: int = 3, gain_spread: float = 0.0
) -> tuple[list[CanvasFrame], dict[int, np.ndarray]]:
    """Twelve frames in three strips, turned, scaled and a little tilted at random."""
    rng = np.random.default_rng(seed)
    frames, images = [], {}
    for number in range(12):
        x, y = 110 * (number % 4) + 30.0, 150 * (number // 4) - 30.0
        matrix = pose(x, y, rng.uniform(-8, 8), rng.uniform(0.95, 1.05), rng.normal(0, 3e-5))
        images[number] = photographed(matrix, float(np.exp(rng.normal(0, gain_spread))))
        frames.append(CanvasFrame(number, 0, WIDTH, HEIGHT, matrix))
    return frames, images


def whole(tiles: dict, side: int) -> np.ndarray:
    """The map from grid pixel (-512, -512) on, 1536 x 1536."""
    result = np.zeros((1536, 1536, 4), np.uint8)
    for (column, row), tile in tiles.items():
        for_x, for_y = column * side + 512, row * side + 512
        result[for_y : for_y + side, for_x : for_x + side] = tile
    return result


def painted(frames, images, side=512) -> np.ndarray:
    tiles: dict = {}
    Canvas(Grid((0.0, 0.0), 0.05, side), tiles, images.__getitem__).paint(frames)
    return whole(tiles, side)


@pytest.fixture(scope="module")
def scene():
    return flight(gain_spread=0.08)


@pytest.fixture(scope="module")
def reference(scene):
    return painted(*scene)


def test_the_picture_is_the_ground(reference):
    frames, images = flight()
    picture = painted(frames, images)
    truth = np.zeros_like(picture[..., :3])
    truth[512 - 80 : 512 + 820, 512 - 100 : 512 + 1000] = GROUND
    seen = picture[..., 3] == 255
    seen[: 512 - 80] = seen[:, : 512 - 100] = False
    assert seen.sum() > 150_000
    assert np.abs(picture[..., :3].astype(int) - truth)[seen].mean() < 3.0


@pytest.mark.parametrize("side", [64, 256])
def test_tiles_meet_without_seams(scene, reference, side, monkeypatch):
    monkeypatch.setattr("sorvolo.mosaic.canvas._WINDOW_PX", 256)
    small = painted(*scene, side=side)
    assert np.array_equal(small[..., 3], reference[..., 3])
    assert np.abs(small.astype(int) - reference).max() <= 2


def test_each_tile_is_stored_once(scene, reference, monkeypatch):
    """Where much is painted at once: tiles are compressed when memory runs out."""

    class Counted(dict):
        stored = 0

        def __setitem__(self, index, tile):
            self.stored += 1
            super().__setitem__(index, tile)

    frames, images = scene
    for side, window_px in ((128, 256), (256, 300), (64, 200)):
        tiles = Counted()
        monkeypatch.setattr("sorvolo.mosaic.canvas._WINDOW_PX", window_px)
        Canvas(Grid((0.0, 0.0), 0.05, side), tiles, images.__getitem__).paint(frames)
        assert len(tiles) == tiles.stored > 9
        assert np.abs(whole(tiles, side).astype(int) - reference).max() <= 2


def test_frames_one_by_one_in_any_order_paint_the_same(scene, reference):
    frames, images = scene
    tiles: dict = {}
    canvas = Canvas(Grid((0.0, 0.0), 0.05), tiles, images.__getitem__)
    order = np.random.default_rng(1).permutation(len(frames))
    for number in order:
        before = {index: tile.copy() for index, tile in tiles.items()}
        touched = canvas.paint([frames[number]])
        assert touched == {
            i for i in tiles if i not in before or not np.array_equal(before[i], tiles[i])
        }
    assert np.abs(whole(tiles, 512).astype(int) - reference).max() <= 2


def test_forgetting_and_moving_end_as_if_never_there(scene, reference):
    frames, images = scene
    tiles: dict = {}
    canvas = Canvas(Grid((0.0, 0.0), 0.05), tiles, images.__getitem__)
    stray = CanvasFrame(50, 0, WIDTH, HEIGHT, pose(200, 100, 30))
    far = CanvasFrame(51, 0, WIDTH, HEIGHT, pose(3000, 3000))
    misplaced = [
        CanvasFrame(f.id, 0, WIDTH, HEIGHT, pose(7, -5) @ f.grid_from_image) for f in frames[:3]
    ]
    images = {**images, 50: photographed(pose(0, 0)), 51: photographed(pose(0, 0))}
    canvas._images = images.__getitem__
    canvas.paint([*misplaced, *frames[3:], stray, far])
    assert any(index[0] > 4 for index in tiles)
    gone = canvas.paint(frames, forget=[50, 51])
    assert any(index[0] > 4 for index in gone), "emptied tiles are named"
    assert not any(index[0] > 4 for index in tiles), "and deleted"
    assert np.abs(whole(tiles, 512).astype(int) - reference).max() <= 2


def test_a_small_move_is_left_alone_until_it_adds_up(scene):
    frames, images = scene
    tiles: dict = {}
    canvas = Canvas(Grid((0.0, 0.0), 0.05), tiles, images.__getitem__)
    canvas.paint(frames)

    def shifted(px: float) -> list[CanvasFrame]:
        return [CanvasFrame(5, 0, WIDTH, HEIGHT, pose(px, 0) @ frames[5].grid_from_image)]

    assert canvas.paint(shifted(0.3)) == frozenset()
    assert canvas.paint(shifted(0.45)) == frozenset()
    assert canvas.paint(shifted(0.7))


def test_a_canvas_opened_again_goes_on_where_it_was(scene, reference):
    frames, images = scene
    tiles: dict = {}
    Canvas(Grid((0.0, 0.0), 0.05), tiles, images.__getitem__).paint(frames[:7])
    again = Canvas(Grid((0.0, 0.0), 0.05), tiles, images.__getitem__, painted=frames[:7])
    assert again.paint(frames[:7]) == frozenset()
    again.paint(frames)
    assert np.abs(whole(tiles, 512).astype(int) - reference).max() <= 2


def test_ground_of_an_earlier_flight_stays():
    earlier = CanvasFrame(9, 0, WIDTH, HEIGHT, pose(0, 0))
    later = CanvasFrame(2, 1, WIDTH, HEIGHT, pose(150, 0))
    images = {
        9: np.full((HEIGHT, WIDTH, 3), 60, np.uint8),
        2: np.full((HEIGHT, WIDTH, 3), 200, np.uint8),
    }
    picture = painted([earlier, later], images)[512 : 512 + HEIGHT, 512:]
    assert abs(int(picture[120, WIDTH - 80, 0]) - 60) <= 3
    assert abs(int(picture[120, WIDTH + 80, 0]) - 200) <= 3
    row = picture[120, : 150 + WIDTH, 0].astype(int)
    assert np.abs(np.diff(row)).max() < 12, "the border is blended"


def test_the_finer_frame_wins():
    coarse = CanvasFrame(0, 0, WIDTH, HEIGHT, pose(-WIDTH, -HEIGHT, 0, 3.0))
    fine = CanvasFrame(1, 0, WIDTH, HEIGHT, pose(0, 0, 0, 1.0))
    images = {
        0: np.full((HEIGHT, WIDTH, 3), 50, np.uint8),
        1: np.full((HEIGHT, WIDTH, 3), 150, np.uint8),
    }
    picture = painted([coarse, fine], images)[512:, 512:]
    assert abs(int(picture[HEIGHT // 2, WIDTH // 2, 0]) - 150) <= 3
    assert abs(int(picture[30, 40, 0]) - 150) < 40


def test_nothing_bleeds_in_from_outside():
    frames = [CanvasFrame(i, 0, WIDTH, HEIGHT, pose(150 * i, 40 * i, 10 * i)) for i in range(3)]
    images = {i: np.full((HEIGHT, WIDTH, 3), 180, np.uint8) for i in range(3)}
    picture = painted(frames, images)
    covered = picture[..., 3] == 255
    assert covered.sum() > 100_000
    assert np.abs(picture[..., :3][covered].astype(int) - 180).max() <= 1
    assert not picture[~covered].any()


def test_black_lens_borders_are_neither_shown_nor_bleed():
    yy, xx = np.mgrid[:HEIGHT, :WIDTH]
    valid = np.hypot(xx - WIDTH / 2, (yy - HEIGHT / 2) * WIDTH / HEIGHT) < WIDTH / 2
    image = np.where(valid[..., None], np.uint8(170), np.uint8(0)) * np.ones(3, np.uint8)
    frames = [CanvasFrame(i, 0, WIDTH, HEIGHT, pose(120 * i, 0), valid=valid) for i in range(2)]
    picture = painted(frames, {0: image, 1: image})
    covered = picture[..., 3] == 255
    union = np.pad(valid, ((0, 0), (0, 120))) | np.pad(valid, ((0, 0), (120, 0)))
    assert not (covered[512 : 512 + HEIGHT, 512 : 512 + WIDTH + 120] & ~union).any()
    assert covered.sum() > 0.97 * union.sum()
    assert np.abs(picture[..., :3][covered].astype(int) - 170).max() <= 2


def test_gains_and_vignette_make_exposures_agree():
    yy, xx = np.mgrid[:HEIGHT, :WIDTH]
    radius2 = (
        ((xx - (WIDTH - 1) / 2) ** 2 + (yy - (HEIGHT - 1) / 2) ** 2) * 4 / (WIDTH**2 + HEIGHT**2)
    )
    seen = 140 * np.exp(-0.4 * radius2)[..., None] * np.array([0.8, 1.0, 1.1])
    frame = CanvasFrame(
        0,
        0,
        WIDTH,
        HEIGHT,
        pose(0, 0),
        gains=1 / np.array([0.8, 1.0, 1.1]),
        vignette=np.array([-0.4, 0.0]),
    )
    picture = painted([frame], {0: seen.round().astype(np.uint8)})
    covered = picture[..., 3] == 255
    assert np.abs(picture[..., :3][covered].astype(int) - 140).max() <= 2


@settings(max_examples=25, deadline=None)
@given(
    st.floats(-180, 180),
    st.floats(0.3, 3.0),
    st.floats(-700, 700),
    st.floats(-700, 700),
    st.floats(-3e-4, 3e-4),
)
def test_coverage_holds_exactly_the_pixels_whose_centre_the_image_sees(turn, scale, x, y, bend):
    frame = CanvasFrame(0, 0, WIDTH, HEIGHT, pose(x, y, turn, scale, bend))
    low = np.floor(frame.outline_px.min(axis=0)).astype(int) - 5
    window = low[0], low[1], low[0] + 150, low[1] + 130
    mask = coverage(frame, window) > 0
    yy, xx = np.mgrid[window[1] : window[3], window[0] : window[2]]
    points = np.column_stack([xx.ravel(), yy.ravel()]).astype(float)
    image_from_grid = np.linalg.inv(frame.grid_from_image)
    image_from_grid /= np.sign((image_from_grid @ np.append(frame.outline_px.mean(axis=0), 1))[2])
    seen = apply_homography(image_from_grid, points)
    distance = np.hstack([seen + 0.5, np.array([WIDTH, HEIGHT]) - 0.5 - seen]).min(axis=1)
    clear = np.isfinite(distance) & (np.abs(distance) > 1e-6)
    assert np.array_equal(mask.ravel()[clear], distance[clear] > 0)


def test_shrinking_does_not_alias():
    stripes = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    stripes[:, ::2] = 255
    frame = CanvasFrame(0, 0, WIDTH, HEIGHT, pose(0.3, 0.2, 0.0, 0.26))
    small = warp(stripes, frame, (8, 8, 72, 56))
    assert small.std() < 25
    assert abs(small.mean() - 127.5) < 5


def test_covers_gives_the_painted_share(scene):
    frames, images = scene
    canvas = Canvas(Grid((0.0, 0.0), 0.05), {}, images.__getitem__)
    assert canvas.covers(frames[0].outline_px) == 0.0
    canvas.paint(frames[:1])
    assert canvas.covers(frames[0].outline_px) > 0.97
    assert canvas.covers(frames[0].outline_px + np.array([WIDTH / 2, 0])) == pytest.approx(
        0.5, abs=0.12
    )


@pytest.mark.parametrize(
    "change",
    [
        {"grid_from_image": np.zeros((3, 3))},
        {"grid_from_image": np.full((3, 3), np.nan)},
        {"grid_from_image": pose(0, 0, bend=-1e-2)},
        {"valid": np.ones((3, 3), dtype=bool)},
        {"gains": np.ones(2)},
        {"id": -1},
    ],
)
def test_impossible_frames_are_refused(change):
    fields = {
        "id": 0,
        "rank": 0,
        "width_px": WIDTH,
        "height_px": HEIGHT,
        "grid_from_image": pose(0, 0),
    }
    with pytest.raises(GeometryError):
        CanvasFrame(**{**fields, **change})


def test_an_image_of_another_size_is_refused():
    canvas = Canvas(Grid((0.0, 0.0), 0.05), {}, lambda _: np.zeros((10, 10, 3), np.uint8))
    with pytest.raises(GeometryError, match="10x10"):
        canvas.paint([CanvasFrame(0, 0, WIDTH, HEIGHT, pose(0, 0))])


def test_painting_a_frame_stays_cheap():
    """960 x 540 frames with 75 % overlap; the bound is wide, machines and their load differ."""
    image = textured(540, 960, 5)
    canvas = Canvas(Grid((0.0, 0.0), 0.05), {}, lambda _: image)
    spent_s = []
    for number in range(8):
        started = time.process_time()
        canvas.paint(
            [CanvasFrame(number, 0, 960, 540, pose(240 * number, 30 * number, 3.0 * number))]
        )
        spent_s.append(time.process_time() - started)
    assert np.median(spent_s) < 0.4


def test_real_photos_blend_without_visible_seams():
    photos = sorted(real_data("flights/brighton_beach").rglob("*.[jJ][pP][gG]"))
    photo = cv2.cvtColor(cv2.imread(str(photos[0]), cv2.IMREAD_REDUCED_COLOR_4), cv2.COLOR_BGR2RGB)
    photo = photo[:520, :960]
    frames, images = [], {}
    for number in range(4):
        x = 180 * number
        crop = photo[60:460, x : x + 420]
        images[number] = np.clip(crop * (1.0 + 0.06 * (-1) ** number), 0, 255).astype(np.uint8)
        frames.append(CanvasFrame(number, 0, 420, 400, pose(x, 0)))
    tiles: dict = {}
    Canvas(Grid((0.0, 0.0), 0.05), tiles, images.__getitem__).paint(frames)
    picture = whole(tiles, 512)[512:912, 512:1472, :3].astype(float).mean(axis=2)
    own = photo[60:460].astype(float).mean(axis=2)
    ratio = (picture.mean(axis=0) / own.mean(axis=0))[5:-5]
    assert np.abs(np.diff(ratio)).max() < 0.02, "no column jumps against its neighbour"


@pytest.mark.parametrize("scale", [1.0, 0.3, 0.12])
@pytest.mark.parametrize("bends", [0.0, 2e-4])
def test_a_pixel_does_not_depend_on_the_window_that_it_is_painted_in(scale, bends):
    image = textured(480, 640, 5)
    valid = np.ones((480, 640), bool)
    valid[:9], valid[:, 633:] = False, False
    gains, vignette = np.array([1.1, 0.9, 1.0]), np.array([-0.4, 0.1])
    frame = CanvasFrame(
        0, 0, 640, 480, pose(40.3, 30.7, 9.0, scale, bends * scale), gains, vignette, valid
    )
    whole = warp(image, frame, (-120, -120, 720, 720))
    for x, y, side in (
        (-100, -90, 64),
        (20, 40, 32),
        (100, 60, 208),
        (-120, 70, 100),
        (36, 24, 80),
    ):
        part = warp(image, frame, (x, y, x + side, y + side))
        away = cv2.absdiff(part, whole[y + 120 : y + 120 + side, x + 120 : x + 120 + side])
        assert (
            away.max() <= 1 and (away > 0).mean() < 1e-3
        )  # OpenCV interpolates in single precision
    assert whole.any()


def test_a_window_shows_what_it_sees_of_a_large_picture_at_the_price_of_that():
    image = np.zeros((6000, 8000, 3), np.uint8)
    image[3000:3064, 4000:4064] = 200
    frame = CanvasFrame(
        0, 0, 8000, 6000, np.eye(3), np.array([1.2, 1.0, 1.0]), np.array([-0.4, 0.1])
    )
    warp(image, frame, (3900, 2900, 4156, 3156))
    start = time.process_time()
    for _ in range(5):
        seen = warp(image, frame, (3900, 2900, 4156, 3156))
    assert (time.process_time() - start) / 5 < 0.1  # 0.6 s where all 48 megapixels are corrected
    assert (seen[100:164, 100:164, 0] > 230).all()
    assert not seen[:90].any()

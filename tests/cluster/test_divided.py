"""A flight mapped in blocks gives the map that it gives when it is mapped whole; what cannot be divided is named."""

import json
import os
import shutil
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, NamedTuple, Self
from unittest.mock import create_autospec

import av
import cv2
import numpy as np
import pytest

from ended_work import ended
from small_flights import simulate_into, small_flight
from sorvolo.capture.source import opened_sources
from sorvolo.cluster import worker
from sorvolo.cluster.batch import BatchReport, BatchSettings, run_batch
from sorvolo.cluster.cost import Cost
from sorvolo.cluster.local_executor import LocalExecutor
from sorvolo.cluster.orders import Ending, FlightWish, Mission, Order, Outcome, PartKind
from sorvolo.cluster.table import BatchTable, State
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.homography import apply_homography
from sorvolo.lab.simulation.settings import OutputSettings
from sorvolo.missions.flight.settings import MapSettings
from sorvolo.missions.map.blocks import prepare_divided
from sorvolo.missions.map.chosen_frames import choose_frames, frames_again
from sorvolo.missions.map.flights import map_flights
from sorvolo.missions.map.joining import plan_blocks
from sorvolo.mosaic.selection import Selected
from sorvolo.store.site.archive import Archive


class Flown(NamedTuple):
    """A flight of three strips: its photos or its video, its camera, and the site of it when it is mapped whole."""

    source: Path
    camera: Path
    whole: Path


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    folder = tmp_path_factory.mktemp("strips")
    settings = small_flight(7, length_m=26, spacing_m=7, fps=1, output=OutputSettings(photos=True))
    simulate_into(folder / "flown", replace(settings, path=replace(settings.path, strips=3)))
    photos, camera = folder / "flown" / "flight1" / "photos", folder / "flown" / "camera.xml"
    (photos / "0099.jpg").write_bytes(b"no picture")
    ended(map_flights([photos], folder / "whole", MapSettings(model="none"), camera=camera))
    return Flown(photos, camera, folder / "whole")


class Disturbed(LocalExecutor):
    """A local executor that ends the process of the second block."""

    def start(self, key: tuple[str, str], order: Order, cost: Cost) -> None:
        super().start(key, order, cost)
        if order.part is not None and (order.part.kind, order.part.number) == (PartKind.BLOCK, 1):
            os.kill(self._running[key][0].pid, signal.SIGSEGV)


class Here:
    """An executor that does each order at once, in this process, as a worker would; `orders` is what it did."""

    orders: ClassVar[list[Order]] = []
    cache_mb = 64.0

    def __init__(self, _workers: int, _stall_s: float, _lock: int) -> None:
        self.running: dict[tuple[str, str], Ending] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def has_room(self, _: Cost) -> bool:
        return not self.running

    def start(self, key: tuple[str, str], order: Order, _: Cost) -> None:
        received = Order.of(json.loads(order.line())["order"])
        assert received == order
        answers = create_autospec(worker.Answers, instance=True)
        flight, words, is_good = worker._done(received, answers, threading.Event())
        self.orders.append(order)
        self.running[key] = Ending(Outcome.DONE if is_good else Outcome.DOUBTFUL, words, flight)

    def finish(self, _: tuple[str, str]) -> None:
        raise AssertionError("nothing is live")

    def next_ended(self, timeout_s: float | None = None) -> tuple[tuple[str, str], Ending] | None:
        return self.running.popitem() if self.running else None


def run(
    flight: Flown, root: Path, blocks: int, by: type[LocalExecutor | Here], most_tries: int = 3
) -> BatchReport:
    @contextmanager
    def executor(table: BatchTable) -> Iterator[LocalExecutor | Here]:
        with by(2, 300.0, table.lock) as made:
            yield made

    wish = FlightWish(camera=str(flight.camera), model="none")
    settings = BatchSettings(wish, most_tries=most_tries, retries=True, blocks=blocks)
    return ended(run_batch([flight.source], root, settings, executor))


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """Like the flight, with a key frame of the stream each second, as drones record."""
    folder = tmp_path_factory.mktemp("video")
    settings = small_flight(8, length_m=26, spacing_m=7, fps=5)
    simulate_into(folder / "flown", replace(settings, path=replace(settings.path, strips=3)))
    flown, camera = folder / "flown" / "flight1" / "flight1.mp4", folder / "flown" / "camera.xml"
    with_key_frames(flown, 5)
    ended(map_flights([flown], folder / "whole", MapSettings(model="none"), camera=camera))
    return Flown(flown, camera, folder / "whole")


def with_key_frames(video: Path, every: int) -> None:
    """Encode a video anew, with a key frame of its stream each so many frames."""
    copy = video.with_name(f"copy-{video.name}")
    with av.open(str(video)) as source, av.open(str(copy), "w") as made:
        made.metadata.update(source.metadata)
        old = source.streams.video[0]
        new = made.add_stream(
            "libx264",
            rate=old.average_rate,
            options={
                "crf": "14",
                "x264-params": f"keyint={every}:min-keyint={every}:scenecut=0:bframes=2:threads=1",
            },
        )
        new.width, new.height, new.pix_fmt = old.width, old.height, "yuv420p"
        for each in source.decode(old):
            made.mux(new.encode(each))
        made.mux(new.encode())
    copy.replace(video)


@pytest.fixture(scope="module")
def divided(
    flight: Flown, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, BatchReport, BatchReport]:
    """The root of a batch in two blocks, one of which crashed: what came of that, and of the same command again."""
    root = tmp_path_factory.mktemp("divided") / "maps"
    return root, run(flight, root, 2, Disturbed, most_tries=1), run(flight, root, 2, Here)


def test_a_block_that_ends_its_process_each_time_sets_the_flight_aside(
    divided: tuple[Path, BatchReport, BatchReport],
) -> None:
    (row,) = divided[1].rows
    assert row.state is State.SET_ASIDE
    assert "block 2 of 2: its process ended by signal 11 (SIGSEGV)" in row.words


def test_the_map_in_blocks_is_that_of_one_machine(
    divided: tuple[Path, BatchReport, BatchReport], flight: Flown
) -> None:
    root, _, again = divided
    (row,) = again.rows
    assert (row.state, row.site, row.flight) == (State.DONE, "photos", "photos")
    is_map_of_one_machine(
        root / "photos", flight.whole, "photos"
    )  # the notice of the photo that is none, too
    parts = {(each.part.kind, each.part.number) for each in Here.orders if each.part is not None}
    assert parts == {
        (PartKind.BLOCK, 1),
        (PartKind.TILES, 0),
        (PartKind.TILES, 1),
    }  # the block that was whole stayed
    assert sorted(path.name for path in root.iterdir()) == ["batch.jsonl", "batch.lock", "photos"]


def is_map_of_one_machine(site: Path, of_one: Path, name: str) -> None:
    with Archive.open(of_one, write=False) as whole, Archive.open(site, write=False) as joined:
        assert replace(joined.site(), name="whole") == whole.site()
        ours_of, theirs_of = joined.report(name), whole.report(name)
        for key in ("notices", "reading", "frames"):
            assert ours_of[key] == theirs_of[key]
        frames = {each.index: each for each in joined.keyframes()}
        assert frames.keys() == {each.index for each in whole.keyframes()} and len(frames) > 15
        for each in whole.keyframes():
            corners_px = each.camera.corners_px
            away_m = apply_homography(
                frames[each.index].site_from_image, corners_px
            ) - apply_homography(each.site_from_image, corners_px)
            assert np.linalg.norm(away_m, axis=1).max() < 0.1 * whole.site().m_per_px
        ours, theirs = joined.tiles(), whole.tiles()
        assert set(ours) == set(theirs)
        for tile in theirs:
            assert (
                np.abs(ours[tile].astype(int) - theirs[tile]).mean() < 0.1
            )  # of 255, over all pixels


def test_a_flight_in_blocks_is_known_afterwards(
    divided: tuple[Path, BatchReport, BatchReport], flight: Flown
) -> None:
    report = run(flight, divided[0], 3, Here)
    assert (report.tries, report.counts()) == (0, {"known": 1})


@pytest.mark.long
def test_a_video_in_blocks_is_the_map_of_one_machine(video: Flown, tmp_path: Path) -> None:
    root = tmp_path / "maps"
    (row,) = run(video, root, 2, Disturbed, most_tries=1).rows
    assert row.state is State.SET_ASIDE and "block 2 of 2" in row.words
    Here.orders.clear()
    (row,) = run(video, root, 2, Here).rows
    assert row.state is State.DONE
    is_map_of_one_machine(root / row.site, video.whole, "flight1")
    parts = [(each.part.kind, each.part.number) for each in Here.orders if each.part is not None]
    assert parts == [
        (PartKind.BLOCK, 1),
        (PartKind.TILES, 0),
        (PartKind.TILES, 1),
    ]  # its frames were chosen before


@pytest.mark.long
def test_a_video_that_gives_other_frames_than_were_chosen_is_refused(video: Flown) -> None:
    with opened_sources([video.source], None, video.camera) as sources:
        setup = prepare_divided(sources[0], MapSettings(model="none"))
        chosen = choose_frames(setup, MapSettings(model="none"), lambda: None).frames
        again = [
            each.posed.frame.index
            for each in frames_again(setup, chosen[3:9])
            if isinstance(each, Selected)
        ]
        assert again == [each.index for each in chosen[3:9]]
        other = replace(chosen[4], time_ns=chosen[4].time_ns + 1)
        with pytest.raises(
            InputError, match=r"flight1 does not give the same frames twice: .* without --blocks"
        ):
            list(frames_again(setup, [chosen[3], other, chosen[5]]))
        with pytest.raises(InputError, match="does not give the same frames twice"):
            list(frames_again(setup, [chosen[3], replace(chosen[4], index=10**6)]))


def test_what_cannot_be_divided_is_named(flight: Flown, tmp_path: Path) -> None:
    with pytest.raises(
        SettingsError, match="--blocks divides flights to be mapped; --mission compare"
    ):
        BatchSettings(FlightWish(Mission.COMPARE), blocks=2)
    with pytest.raises(SettingsError, match="--blocks 0: at least 1"):
        BatchSettings(blocks=0)
    settings, other = MapSettings(model="none"), tmp_path / "other"
    shutil.copytree(flight.source, other)
    first = min(other.iterdir())
    first.write_bytes(first.read_bytes() + b"another")
    with pytest.raises(
        SettingsError, match=r"the site whole shows photos already: .* leave --blocks out"
    ):
        plan_blocks(other, flight.whole, settings, flight.camera, 2, tmp_path / "blocks")
    bare = tmp_path / "bare"
    bare.mkdir()
    for number in range(2):
        cv2.imwrite(str(bare / f"{number}.jpg"), np.full((180, 320, 3), number, np.uint8))
    with pytest.raises(
        SettingsError, match="the photos of bare have no GPS, by which flights are divided"
    ):
        plan_blocks(bare, tmp_path / "site", settings, flight.camera, 2, tmp_path / "blocks")
    video = tmp_path / "flight.mp4"
    with av.open(str(video), "w") as made:
        stream = made.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 320, 180, "yuv420p"
        for value in range(4):
            picture = np.full((180, 320, 3), 50 * value, np.uint8)
            made.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        made.mux(stream.encode())
    with pytest.raises(
        SettingsError, match=r"the video flight has no GPS, by which flights are divided"
    ):
        plan_blocks(video, tmp_path / "site", settings, flight.camera, 2, tmp_path / "blocks")

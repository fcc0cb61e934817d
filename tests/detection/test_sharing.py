"""One detector for several askers: the same answers, batches where the model takes them, nobody crowded out."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from toy_models import METADATA, draw, rectangle_model, write_model

from sorvolo.detection.batching import Batcher, BatchingSettings
from sorvolo.detection.detector import Detector
from sorvolo.detection.engine import Engine, Planes, open_engine
from sorvolo.detection.session import opened_engine
from sorvolo.detection.shared_process import Models, serve
from sorvolo.detection.sharing import READY, SharedDetectorGone, shared_engine
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Numbers

# of each picture one box, whose score is how bright the picture is
_BRIGHTNESS = """
<ir_version: 8, opset_import: ["" : 17]>
brightness (uint8[N, 3, H, W] image)
  => (float[K, 4] boxes, float[K] scores, int64[K] labels, int64[K] pictures) {
  all = Constant <value_float = 255.0> ()
  zero = Constant <value_int = 0> ()
  one = Constant <value_int = 1> ()
  box = Constant <value = float[1, 4] {0, 0, 16, 16}> ()
  four = Constant <value_ints = [4]> ()
  picture = Cast <to = 1> (image)
  mean = ReduceMean <axes = [1, 2, 3], keepdims = 0> (picture)
  scores = Div (mean, all)
  shape = Shape (scores)
  count = Squeeze (shape)
  pictures = Range (zero, count, one)
  labels = Mul (pictures, zero)
  sizes = Concat <axis = 0> (shape, four)
  boxes = Expand (box, sizes)
}
"""


def planes_of(value: int, width: int = 64) -> Planes:
    return np.full((1, 3, 32, width), value, np.uint8)


@contextmanager
def sharing(folder: Path) -> Iterator[tuple[str, Models]]:
    """Models for whoever connects to a socket."""
    models = Models(opened_engine)
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(folder / "socket"))
        listening.listen()
        threading.Thread(target=serve, args=(listening, models), daemon=True).start()
        yield str(folder / "socket"), models


@pytest.fixture
def brightness(tmp_path: Path) -> Path:
    """A model that takes many pictures at once."""
    return write_model(onnx.parser.parse_model(_BRIGHTNESS), tmp_path / "many.onnx", METADATA)


class Recorded:
    """An engine that notes the shapes it was given, and waits at its first until it is let go."""

    def __init__(self, engine: Engine) -> None:
        self.shapes: list[tuple[int, ...]] = []
        self.go = threading.Event()
        self.engine = replace(engine, run=self._run)
        self._inner = engine.run

    def _run(self, planes: Planes) -> tuple[Numbers, ...]:
        self.shapes.append(planes.shape)
        self.go.wait(20)
        return self._inner(planes)


def asked(
    batcher: Batcher, pictures: list[Planes]
) -> tuple[list[threading.Thread], dict[int, Any]]:
    """An asker for each picture, one after the other, and what each is answered once its thread has ended."""
    found: dict[int, Any] = {}

    def ask(number: int, planes: Planes) -> None:
        found[number] = batcher.ask(planes)

    threads = [threading.Thread(target=ask, args=each, daemon=True) for each in enumerate(pictures)]
    for each in threads:
        each.start()
        time.sleep(0.02)
    return threads, found


def test_a_model_that_takes_many_is_given_what_waits_at_once(brightness: Path) -> None:
    recorded = Recorded(open_engine(brightness.read_bytes(), "many", "cpu", 1))
    batcher = Batcher(recorded.engine, BatchingSettings(most_pictures=3))
    values = [10, 20, 30, 40, 50, 60]
    threads, found = asked(
        batcher, [planes_of(value, 96 if value == 30 else 64) for value in values]
    )
    recorded.go.set()
    for each in threads:
        each.join(20)
    # the first alone, then at most three, those of one size together
    assert recorded.shapes == [(1, 3, 32, 64), (2, 3, 32, 64), (1, 3, 32, 96), (2, 3, 32, 64)]
    assert (batcher.pictures, batcher.batches) == (6, 4)
    for number, value in enumerate(values):
        boxes, scores, labels = found[number]
        assert boxes.tolist() == [[0, 0, 16, 16]] and labels.tolist() == [0]
        assert scores.tolist() == pytest.approx([value / 255])
    batcher.end()


def test_a_model_that_takes_one_answers_in_the_order_of_asking(tmp_path: Path) -> None:
    recorded = Recorded(opened_engine(rectangle_model(tmp_path / "toy.onnx"), threads=1))
    batcher = Batcher(recorded.engine, BatchingSettings(most_waiting=1))
    threads, found = asked(batcher, [planes_of(value) for value in (200, 210, 220)])
    assert not found and len(recorded.shapes) == 1  # one is at it, one waits, one is held back
    recorded.go.set()
    for each in threads:
        each.join(20)
    assert recorded.shapes == [(1, 3, 32, 64)] * 3
    assert [found[number][1].tolist() for number in range(3)] == [
        pytest.approx([v / 255]) for v in (200, 210, 220)
    ]
    batcher.end()


def test_an_error_of_the_model_reaches_who_asked(brightness: Path) -> None:
    engine = open_engine(brightness.read_bytes(), "many", "cpu", 1)
    batcher = Batcher(
        replace(engine, run=lambda planes: (*engine.run(planes)[:3], np.zeros(5, np.int64)))
    )
    with pytest.raises(InputError, match=r"answers with outputs of .* export it again"):
        batcher.ask(planes_of(10))
    batcher.end()


def test_a_shared_detector_finds_what_an_own_one_does(tmp_path: Path) -> None:
    path = rectangle_model(tmp_path / "toy.onnx")
    pictures = [draw((64, 96), [(10, 20, 30, 50)], scores=[score]) for score in (150, 200, 250)]
    own = Detector.load(path)
    with sharing(tmp_path) as (address, models):
        found: dict[int, Any] = {}

        def search(number: int) -> None:
            detector = Detector.load(path, shared=address)
            assert (detector.info, detector.provider) == (own.info, own.provider)
            found[number] = [detector.detect(each) for each in pictures]

        threads = [threading.Thread(target=search, args=(number,)) for number in range(3)]
        for each in threads:
            each.start()
        for each in threads:
            each.join(60)
        _, batcher = models.batcher(path)
        assert batcher.pictures == 9  # one model for all
    for number in range(3):
        for seen, wanted in zip(
            found[number], (own.detect(each) for each in pictures), strict=True
        ):
            np.testing.assert_array_equal(seen.boxes_px, wanted.boxes_px)
            np.testing.assert_array_equal(seen.scores, wanted.scores)


def test_the_packaged_model_is_shared_as_well(tmp_path: Path) -> None:
    picture = np.random.default_rng(1).integers(0, 255, (96, 128, 3), np.uint8)
    with sharing(tmp_path) as (address, _):
        shared = Detector.load("default", threads=1, shared=address).detect(
            picture, least_score=0.0
        )
    own = Detector.load("default", threads=1).detect(picture, least_score=0.0)
    assert len(own) and shared.boxes_px.tolist() == own.boxes_px.tolist()
    assert shared.scores.tolist() == own.scores.tolist()


def test_what_is_wrong_with_a_model_is_reported_as_without_sharing(tmp_path: Path) -> None:
    (tmp_path / "junk.onnx").write_bytes(b"junk")
    with sharing(tmp_path) as (address, _):
        with pytest.raises(InputError, match=r"junk\.onnx"):
            shared_engine(address, tmp_path / "junk.onnx")
        with pytest.raises(InputError, match="there is no model file"):
            shared_engine(address, tmp_path / "none.onnx")


def test_a_process_that_is_gone_is_no_fault_of_the_flight(tmp_path: Path) -> None:
    address = str(tmp_path / "socket")
    with pytest.raises(SharedDetectorGone, match="shares with others has ended"):
        shared_engine(address, tmp_path / "toy.onnx")
    process = subprocess.Popen(
        [sys.executable, "-m", "sorvolo.detection.shared_process", address],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert process.stdout is not None and process.stdout.readline() == READY
    engine = shared_engine(address, rectangle_model(tmp_path / "toy.onnx"))
    assert engine.run(planes_of(200))[1].tolist() == pytest.approx([200 / 255])
    os.kill(process.pid, signal.SIGKILL)
    with pytest.raises(SharedDetectorGone):
        engine.run(planes_of(200))
    process.communicate()

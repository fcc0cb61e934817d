"""Models of unknown origin: run beside this process, and stopped where they ask for too much."""

import io
import os
import struct
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from toy_models import draw, rectangle_model

from sorvolo.detection.confined import confined_engine, described_confined, read_message
from sorvolo.detection.engine import describe, open_engine
from sorvolo.detection.models import find_model
from sorvolo.detection.session import Session, read_info
from sorvolo.errors import InputError

BOMB = """<ir_version: 8, opset_import: ["" : 17]>
m (uint8[1, 3, H, W] image) => (float[K, 4] boxes, float[K] scores, int64[K] labels) {
  pixel = Constant <value_ints = [0, 0, 0, 0]> ()
  one = Cast <to = 7> (image)
  least = ReduceMin <keepdims = 0> (one)
  zero = Mul (least, least)
  huge = Constant <value_ints = [50000, 50000]> ()
  sides = Add (huge, zero)
  filled = ConstantOfShape <value = float[1] {1.0}> (sides)
  other = Mul (filled, filled)
  sum = ReduceSum <keepdims = 0> (other)
  boxes = Constant <value = float[1, 4] {0, 0, 1, 1}> ()
  line = Constant <value_ints = [1]> ()
  scores = Reshape (sum, line)
  labels = Constant <value_ints = [0]> ()
}"""


def _bomb(path: Path) -> Path:
    """A kilobyte that makes two pictures of 10 GB each; what it states about itself is in order."""
    model = onnx.parser.parse_model(BOMB)
    onnx.helper.set_model_props(
        model,
        {
            each.key: each.value
            for each in onnx.load_model(rectangle_model(path.with_name("good.onnx"))).metadata_props
        },
    )
    path.write_bytes(model.SerializeToString())
    assert path.stat().st_size < 2000
    return path


@pytest.mark.skipif(sys.platform != "linux", reason="memory is bounded on Linux alone")
def test_a_kilobyte_that_asks_for_gigabytes_is_stopped(tmp_path: Path) -> None:
    session = Session(_bomb(tmp_path / "bomb.onnx"), "cpu", 1)
    with pytest.raises(InputError, match=r"bomb\.onnx: .* 6 GB of memory"):
        session.see(np.zeros((32, 32, 3), np.uint8))
    with pytest.raises(InputError, match="the process that ran this model ended"):
        session.see(np.zeros((32, 32, 3), np.uint8))


def test_it_answers_as_it_would_here(tmp_path: Path) -> None:
    path = rectangle_model(tmp_path / "toy.onnx")
    here, beside = (
        opens(path.read_bytes(), "toy", "cpu", 1) for opens in (open_engine, confined_engine)
    )
    batch = np.ascontiguousarray(draw((64, 96), [(10, 20, 30, 50)]).transpose(2, 0, 1))[None]
    for own, other in zip(here.run(batch), beside.run(batch)):
        assert own.dtype == other.dtype
        np.testing.assert_array_equal(own, other)
    assert (here.provider, here.info, here.fixed_px) == (
        beside.provider,
        beside.info,
        beside.fixed_px,
    )
    assert (
        described_confined(path.read_bytes(), "toy").info == describe(path.read_bytes(), "toy").info
    )


def test_what_is_wrong_with_a_model_is_reported_as_it_would_be_here(tmp_path: Path) -> None:
    (tmp_path / "junk.onnx").write_bytes(b"junk")
    for opens in (Session, read_info):
        with pytest.raises(InputError, match=r"junk\.onnx"):
            opens(tmp_path / "junk.onnx")


def test_the_process_ends_with_its_session(tmp_path: Path) -> None:
    engine = confined_engine(rectangle_model(tmp_path / "toy.onnx").read_bytes(), "toy", "cpu", 1)
    process = engine.run.__self__
    child = process._child
    assert child.pid != os.getpid() and child.poll() is None
    del engine, process
    assert child.poll() is not None


def test_packaged_models_run_here() -> None:
    session = Session(find_model("default"), "cpu", 1)
    assert not hasattr(session._run, "__self__")


@pytest.mark.parametrize("lengths", [(2**31, 0), (0, 2**32 - 1)])
def test_a_message_that_announces_too_much_is_not_read(lengths: tuple[int, int]) -> None:
    class Pipe(io.BytesIO):
        def read(self, size: int | None = -1) -> bytes:
            assert size == 8
            return super().read(size)

    with pytest.raises(EOFError):
        read_message(Pipe(struct.pack("<II", *lengths)))

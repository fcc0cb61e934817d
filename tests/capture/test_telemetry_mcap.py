"""MCAP recordings, written by mcap's own writers: ROS 2, protobuf and JSON fixes; cut, empty, of several topics."""

import importlib
import io
import json
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from sorvolo.capture.telemetry import read_telemetry
from sorvolo.errors import InputError

BEGIN_S, COUNT = 1_780_000_000, 5
NAV_SAT_FIX = """std_msgs/Header header
sensor_msgs/NavSatStatus status
float64 latitude
float64 longitude
float64 altitude
float64[9] position_covariance
uint8 position_covariance_type
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: sensor_msgs/NavSatStatus
int8 status
uint16 service
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def fix(index: int, *, stamped: bool = True) -> dict[str, object]:
    """As sensor_msgs/NavSatFix; the first one has no fix."""
    return {
        "header": {
            "stamp": {"sec": BEGIN_S + index if stamped else index, "nanosec": 500_000_000},
            "frame_id": "gps",
        },
        "status": {"status": 0 if index else -1, "service": 1},
        "latitude": 41.89 + 1e-5 * index,
        "longitude": -12.6,
        "altitude": 130.0 + index,
        "position_covariance": [0.25, 0, 0, 0, 0.25, 0, 0, 0, 1.0],
        "position_covariance_type": 2,
    }


def ros2() -> bytes:
    writers = pytest.importorskip("mcap_ros2.writer")
    out = io.BytesIO()
    with writers.Writer(out) as writer:
        schema = writer.register_msgdef("sensor_msgs/msg/NavSatFix", NAV_SAT_FIX)
        for index in range(COUNT):
            writer.write_message("/gps/fix", schema, fix(index), (BEGIN_S + index) * 10**9)
    return out.getvalue()


def as_json(*, topics: int = 1, stamped: bool = True, finish: bool = True) -> bytes:
    writers = pytest.importorskip("mcap.writer")
    out = io.BytesIO()
    writer = writers.Writer(out, chunk_size=600)
    writer.start()
    schema = writer.register_schema("sensor_msgs/msg/NavSatFix", "jsonschema", b"{}")
    channels = [
        writer.register_channel(f"/gps{each}", "json", schema_id=schema) for each in range(topics)
    ]
    for index in range(COUNT):
        for number, channel in enumerate(channels):
            if index >= number:
                recorded_ns = (BEGIN_S + index) * 10**9 + 500_000_000
                data = json.dumps(fix(index, stamped=stamped)).encode()
                writer.add_message(channel, recorded_ns, data, recorded_ns)
    if finish:
        writer.finish()
    return out.getvalue()


def protobuf() -> bytes:
    writers = pytest.importorskip("mcap_protobuf.writer")
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

    file = descriptor_pb2.FileDescriptorProto(
        name="foxglove/LocationFix.proto",
        package="foxglove",
        syntax="proto3",
        dependency=["google/protobuf/timestamp.proto"],
    )
    fields = file.message_type.add(name="LocationFix").field
    kinds = descriptor_pb2.FieldDescriptorProto
    for number, (name, kind, label) in enumerate(
        [
            ("latitude", kinds.TYPE_DOUBLE, kinds.LABEL_OPTIONAL),
            ("longitude", kinds.TYPE_DOUBLE, kinds.LABEL_OPTIONAL),
            ("altitude", kinds.TYPE_DOUBLE, kinds.LABEL_OPTIONAL),
            ("position_covariance", kinds.TYPE_DOUBLE, kinds.LABEL_REPEATED),
            ("position_covariance_type", kinds.TYPE_INT32, kinds.LABEL_OPTIONAL),
            ("timestamp", kinds.TYPE_MESSAGE, kinds.LABEL_OPTIONAL),
        ],
        1,
    ):
        of = ".google.protobuf.Timestamp" if name == "timestamp" else None
        fields.add(name=name, number=number, type=kind, label=label, type_name=of)
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
    pool.Add(file)
    made = message_factory.GetMessageClass(pool.FindMessageTypeByName("foxglove.LocationFix"))
    out = io.BytesIO()
    with writers.Writer(out) as writer:
        for index in range(1, COUNT):
            stated = {
                key: value for key, value in fix(index).items() if key not in ("header", "status")
            }
            message = made(**stated)
            message.timestamp.seconds, message.timestamp.nanos = BEGIN_S + index, 500_000_000
            writer.write_message("/fix", message, (BEGIN_S + index) * 10**9)
    return out.getvalue()


@pytest.mark.parametrize("write", [ros2, as_json, protobuf])
def test_fixes_are_read_at_their_own_stamps(tmp_path: Path, write) -> None:
    path = tmp_path / "flight.mcap"
    path.write_bytes(write())
    found = read_telemetry(path)
    known = np.isfinite(found["latitude_deg"])
    index = np.arange(1, COUNT)
    assert found.format == "mcap" and known.sum() == COUNT - 1
    np.testing.assert_allclose(found["latitude_deg"][known], 41.89 + 1e-5 * index, atol=1e-9)
    np.testing.assert_allclose(found["ellipsoidal_height_m"][known], 130.0 + index)
    np.testing.assert_allclose(found["horizontal_sigma_m"][known], 0.5)
    np.testing.assert_allclose(found["vertical_sigma_m"][known], 1.0)
    assert (found.time_ns[known] == (BEGIN_S + index) * 10**9 + 500_000_000).all()


def test_stamps_since_boot_give_way_to_the_recorders_clock(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(as_json(stamped=False))
    assert read_telemetry(tmp_path / "a.mcap").time_ns[0] == BEGIN_S * 10**9 + 500_000_000


def test_of_several_topics_the_longest_is_used_and_the_others_named(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(as_json(topics=3))
    found = read_telemetry(tmp_path / "a.mcap")
    (words,) = [each.text for each in found.notices if each.code == "other_topics"]
    assert len(found) == COUNT and "2 (/gps1, /gps2); /gps0 is used" in words


def test_a_cut_recording_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    whole = as_json(finish=False)
    (tmp_path / "a.mcap").write_bytes(whole)
    cut = read_telemetry(tmp_path / "a.mcap")
    assert 2 <= len(cut) < COUNT and "truncated" in {each.code for each in cut.notices}
    (tmp_path / "a.mcap").write_bytes(whole[:60])
    with pytest.raises(InputError, match=r"no fix in this MCAP recording \(it is cut or damaged\)"):
        read_telemetry(tmp_path / "a.mcap")


def test_without_the_extra_the_line_to_install_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.mcap").write_bytes(as_json())
    monkeypatch.setitem(sys.modules, "mcap.reader", None)
    with pytest.raises(InputError, match=r"MCAP recording.*pip install 'sorvolo\[logs\]'"):
        read_telemetry(tmp_path / "a.mcap")


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_small_chunk_of_many_bytes_is_not_unpacked(tmp_path: Path, compression: str) -> None:
    """Nor is its stated size believed."""
    records = pytest.importorskip("mcap.records")
    packed = importlib.import_module({"zstd": "zstandard", "lz4": "lz4.frame"}[compression])
    data = packed.compress(bytes(200_000_000))
    builder = importlib.import_module("mcap.data_stream").RecordBuilder()
    records.Chunk(compression, data, 0, 0, 0, 10).write(builder)
    path = tmp_path / "bomb.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + builder.end())
    tracemalloc.start()
    with pytest.raises(InputError, match="cut or damaged"):
        read_telemetry(path)
    assert tracemalloc.get_traced_memory()[1] < 150e6
    tracemalloc.stop()

"""Autopilots' logs: written by the formats' own libraries (pyulog, pymavlink), or in the layout that these state."""

import io
import struct
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sorvolo.capture.telemetry import find_telemetry_beside, is_telemetry, read_telemetry
from sorvolo.errors import InputError

BEGIN_S = 1_780_000_000  # UTC
COUNT = 6
BOOT_S = 40.0  # since the autopilot was switched on
LATITUDE_DEG, LONGITUDE_DEG = 41.89, -12.60
TURNS_DEG = (100.0, 5.0, -3.0)  # yaw, pitch, roll


def places(index: int) -> tuple[float, float, float, float]:
    """Latitude, longitude, height above the sea and above take-off."""
    return LATITUDE_DEG + 1e-5 * index, LONGITUDE_DEG, 84.0 + index, 30.0 + index


def quaternion() -> tuple[float, float, float, float]:
    """w x y z of yaw, then pitch, then roll (Diebel, Representing Attitude, eq. 290)."""
    (cy, cp, cr), (sy, sp, sr) = (f(np.radians(TURNS_DEG) / 2) for f in (np.cos, np.sin))
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def ulog(*, dated: bool = True, old: bool = False) -> bytes:
    """By pyulog's own writer; `old`: positions in 1e-7 deg and mm, as before PX4 1.14."""
    core = pytest.importorskip("pyulog.core")
    position = (
        [("int32_t", "lat"), ("int32_t", "lon"), ("int32_t", "alt")]
        if old
        else [("double", "latitude_deg"), ("double", "longitude_deg"), ("double", "altitude_msl_m")]
    )
    scales = (1e7, 1e7, 1e3) if old else (1, 1, 1)
    forms = {
        "vehicle_gps_position": [
            ("uint64_t", "timestamp"), ("uint64_t", "time_utc_usec"), *position,
            ("float", "eph"), ("uint8_t", "fix_type"),
        ],
        "vehicle_attitude": [("uint64_t", "timestamp"), ("float[4]", "q")],
        "vehicle_local_position": [("uint64_t", "timestamp"), ("float", "z")],
    }  # fmt: skip
    boot_us = [int((BOOT_S + index) * 1e6) for index in range(COUNT)]
    rows: dict[str, list[dict[str, float]]] = {name: [] for name in forms}
    for index, time_us in enumerate(boot_us):
        utc_us = int((BEGIN_S + index) * 1e6) if dated else 0
        values = dict(zip((name for _, name in position), places(index)))
        scaled = {name: v * s for (name, v), s in zip(values.items(), scales)}
        if old:
            scaled = {name: round(value) for name, value in scaled.items()}
        rows["vehicle_gps_position"].append(
            {"timestamp": time_us, "time_utc_usec": utc_us, **scaled, "eph": 0.8,
             "fix_type": 3 if index else 1}
        )  # fmt: skip
        turned = {f"q[{each}]": value for each, value in enumerate(quaternion())}
        rows["vehicle_attitude"].append({"timestamp": time_us + 4000, **turned})
        rows["vehicle_local_position"].append({"timestamp": time_us - 4000, "z": -places(index)[3]})
    log = core.ULog(None)
    log._start_timestamp = boot_us[0]
    log._file_version = 1
    for number, (topic, fields) in enumerate(forms.items()):
        text = ";".join(f"{kind} {name}" for kind, name in fields)
        message = f"{topic}:{text};".encode()
        log._message_formats[topic] = core.ULog.MessageFormat(message, None)
        flat = [
            SimpleNamespace(type_str=kind.split("[")[0], field_name=each)
            for kind, name in fields
            for each in ([f"{name}[{k}]" for k in range(4)] if "[" in kind else [name])
        ]
        log._data_list.append(
            SimpleNamespace(
                multi_id=0,
                msg_id=number,
                name=topic,
                field_data=flat,
                data={
                    each.field_name: [row[each.field_name] for row in rows[topic]] for each in flat
                },
            )
        )
    written = io.BytesIO()
    log.write_ulog(written)
    return written.getvalue()


def dataflash() -> bytes:
    """FMT messages and their data in the layout of pymavlink's DFFormat."""
    library = pytest.importorskip("pymavlink.DFReader")
    forms = {
        "FMT": (0x80, "BBnNZ", "Type,Length,Name,Format,Columns"),
        "GPS": (1, "QBBIHBcLLefff", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ"),
        "ATT": (2, "Qfff", "TimeUS,Roll,Pitch,Yaw"),
        "POS": (3, "Qf", "TimeUS,RelHomeAlt"),
    }
    packers = {
        name: library.DFFormat(number, name.encode(), 0, form, columns).msg_struct
        for name, (number, form, columns) in forms.items()
    }

    def message(name: str, *values: object) -> bytes:
        number = forms[name][0]
        return struct.pack("<3B", 0xA3, 0x95, number) + struct.pack(packers[name], *values)

    out = b""
    for name, (number, form, columns) in forms.items():
        size = 3 + struct.calcsize(packers[name])
        out += message("FMT", number, size, name.encode(), form.encode(), columns.encode())
    gps_s = BEGIN_S + 18 - 315_964_800  # leap seconds; GPS counts from 6 January 1980
    for index in range(COUNT):
        time_us = int((BOOT_S + index) * 1e6)
        week, second = divmod(gps_s + index, 604_800)
        latitude, longitude, above_sea, above_home = places(index)
        placed = round(latitude * 1e7), round(longitude * 1e7), round(above_sea * 100)
        fix = 100, *placed, 6.0, 15.0, 0.0  # HDop 1, speed, course
        out += message("GPS", time_us, 0, 3 if index else 1, second * 1000, week, 12, *fix)
        out += message("GPS", time_us, 1, 3, second * 1000, week, 12, 100, 0, 0, 0, 0.0, 0.0, 0.0)
        yaw, pitch, roll = TURNS_DEG
        out += message("ATT", time_us + 4000, roll, pitch, yaw)
        out += message("POS", time_us + 4000, above_home)
    return out


def tlog(*, version: int = 2, dated: bool = True) -> bytes:
    """By pymavlink's own packer, received 0.3 s late by a ground station whose clock is an hour behind."""
    v2 = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega")
    link = v2.MAVLink(None, srcSystem=7, srcComponent=1)
    other = v2.MAVLink(None, srcSystem=9, srcComponent=1)
    out = b""
    for index in range(COUNT):
        boot_ms = int((BOOT_S + index) * 1000)
        latitude, longitude, above_sea, above_home = places(index)
        position = round(latitude * 1e7), round(longitude * 1e7)
        heights = round(above_sea * 1000), round(above_home * 1000)
        angles = [np.radians(TURNS_DEG[each]) for each in (2, 1, 0)]
        messages = [
            (link, v2.MAVLink_global_position_int_message(
                boot_ms, *(position if index else (0, 0)), *heights, 600, 0, 0, 0)),
            (other, v2.MAVLink_global_position_int_message(boot_ms, 0, 1, 0, 0, 0, 0, 0, 0)),
            (link, v2.MAVLink_attitude_message(boot_ms, *angles, 0, 0, 0)),
            (link, v2.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)),
        ]  # fmt: skip
        if dated:
            messages.append(
                (link, v2.MAVLink_system_time_message(int((BEGIN_S + index) * 1e6), boot_ms))
            )
            computer = v2.MAVLink(None, srcSystem=7, srcComponent=191)  # with a clock of its own
            messages += [(computer, v2.MAVLink_system_time_message(int(BEGIN_S * 1e6), 0))] * 2
        for sender, message in messages:
            stamp_us = int((BEGIN_S + index - 3600 + 0.3) * 1e6)
            packed = message.pack(sender, force_mavlink1=version == 1)
            out += struct.pack(">Q", stamp_us) + bytes(packed)
            out += b"noise" if index == 3 else b""
    return out


LOGS = {
    "flight.ulg": ulog,
    "old.ulg": lambda: ulog(old=True),
    "00000042.BIN": dataflash,
    "one.tlog": lambda: tlog(version=1),
    "two.tlog": tlog,
}


@pytest.mark.parametrize("name", LOGS)
def test_fixes_heights_and_angles_are_read_on_utc(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(LOGS[name]())
    assert is_telemetry(path)
    found = read_telemetry(path)
    first = 1  # the first sample has no fix
    known = np.isfinite(found["latitude_deg"])
    is_noted = any(each.code == "other_vehicle" for each in found.notices)
    assert is_noted == name.endswith("tlog")
    assert known.sum() == COUNT - first
    expected = np.array([places(index) for index in range(first, COUNT)])
    for column, values, within in (
        ("latitude_deg", expected[:, 0], 2e-7),
        ("longitude_deg", expected[:, 1], 2e-7),
        ("orthometric_height_m", expected[:, 2], 0.01),
    ):
        np.testing.assert_allclose(found[column][known], values, atol=within)
    # PX4's height counts from where its estimator began
    begun_m = places(0)[3] if name.endswith("ulg") else 0.0
    above_m = found["height_above_takeoff_m"][known]
    np.testing.assert_allclose(above_m, expected[:, 3] - begun_m, atol=0.01)
    np.testing.assert_allclose(
        found.time_ns[known] / 1e9 - BEGIN_S, np.arange(first, COUNT), rtol=0, atol=1e-3
    )
    for column, angle in zip(("body_yaw_deg", "body_pitch_deg", "body_roll_deg"), TURNS_DEG):
        np.testing.assert_allclose(found[column][known], angle, atol=1e-3)


@pytest.mark.parametrize("write", [lambda: ulog(dated=False), lambda: tlog(dated=False)])
def test_a_log_without_a_date_says_so(tmp_path: Path, write) -> None:
    path = tmp_path / "flight.log"
    path.write_bytes(write())
    found = read_telemetry(path)
    assert "no_date" in {each.code for each in found.notices}
    assert found.time_ns[0] < 10**12 and (np.diff(found.time_ns) == 10**9).all()


@pytest.mark.parametrize("name", LOGS)
def test_cut_and_damaged_logs_are_read_as_far_as_they_go_or_refused(
    tmp_path: Path, name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    data = LOGS[name]()
    for part in (data[: len(data) * 3 // 4], data[:40], data[:200] + b"\xff" * 300 + data[500:]):
        (tmp_path / name).write_bytes(part)
        try:
            assert len(read_telemetry(tmp_path / name)) > 0
        except InputError as error:
            assert name in str(error)
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize("name", LOGS)
def test_without_the_extra_the_line_to_install_is_named(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / name).write_bytes(LOGS[name]())
    for module in ("pyulog.core", "pymavlink.DFReader", "pymavlink.dialects.v20"):
        monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20.ardupilotmega", None)
    with pytest.raises(InputError, match=rf"{name} is an? .*pip install 'sorvolo\[logs\]'"):
        read_telemetry(tmp_path / name)
    (tmp_path / "film.mp4").touch()
    assert find_telemetry_beside(tmp_path / "film.mp4") == tmp_path / name

"""The UMCD table: its 60 columns, any order, printed units, clocks, and broken rows."""

import math
import re
from datetime import datetime, timedelta

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from real_data import real_data
from sorvolo.capture.telemetry import flight_table, read_telemetry
from sorvolo.errors import InputError

# thesis, Table 2.2, columns 1 to 60
COLUMNS = (
    "Tick#",
    "offsetTime",
    "flightTime(msec)",
    "Longitude",
    "Latitude",
    "numSats",
    "gpsAltitude(meters)",
    "baroAlt(meters)",
    "vpsHeight(M)",
    "relativeHeight",
    "accelX(M/S²)",
    "accelY(M/S²)",
    "accelZ(M/S²)",
    "gyroX(degrees/s)",
    "gyroY(degrees/s)",
    "gyroZ(degrees/s)",
    "magX",
    "magY",
    "magZ",
    "magMod",
    "velN(M/S)",
    "velE(M/S)",
    "velD(M/S)",
    "vel(M/S)",
    "quatW",
    "quatX",
    "quatY",
    "quatZ",
    "Roll",
    "Pitch",
    "Yaw",
    "errorX",
    "errorY",
    "errorZ",
    "error",
    "accel(M/S²)",
    "gyro(degrees/s)",
    "distancHP(M)",
    "distanceTravelled(M)",
    "directionOfTravel",
    "IMUTemp(C)",
    "batteryTemp(C)",
    "ratedCapacity",
    "remaingCapacity",
    "batteryCycleCount",
    "batteryLifePercentage",
    "Gimbal:roll",
    "Gimbal:pitch",
    "Gimbal:yaw",
    "Gimbal:Xroll",
    "Gimbal:Xpitch",
    "Gimbal:Yyaw",
    "MotorSpeed:RFront",
    "MotorSpeed:LFront",
    "MotorSpeed:LBack",
    "MotorSpeed:RBack",
    "MotorLoad:RFront",
    "MotorLoad:LFront",
    "MotorLoad:LBack",
    "MotorLoad:RBack",
)
SECOND_NS = 1_000_000_000


def row(index: int) -> dict[str, float]:
    reported = {
        "Tick#": 1000 + 60 * index,
        "offsetTime": 12.5 + 0.1 * index,
        "flightTime(msec)": 5000 + 100 * index,
        "Longitude": 12.4964 + 1e-6 * index,
        "Latitude": 41.9028 + 2e-6 * index,
        "gpsAltitude(meters)": 85.5,
        "baroAlt(meters)": 90.25 + index,
        "vpsHeight(M)": 9.0,
        "relativeHeight": 10.5,
        "velN(M/S)": 3.0,
        "velE(M/S)": 4.0,
        "vel(M/S)": 5.0,
        "Roll": 1.0,
        "Pitch": -2.0,
        "Yaw": 30.0,
        "quatW": 1.0,
        "quatX": 0.0,
        "quatY": 0.0,
        "quatZ": 0.0,
        "Gimbal:roll": 0.5,
        "Gimbal:pitch": -90.0,
        "Gimbal:yaw": 31.0,
        "Gimbal:Xroll": 99.0,
        "Gimbal:Yyaw": 99.0,
        "directionOfTravel": 7.0,
    }
    return {name: reported.get(name, 1.0) for name in COLUMNS}


def table(
    columns=COLUMNS, count: int = 20, delimiter: str = ",", newline: str = "\n", changes=()
) -> str:
    rows = [row(index) for index in range(count)]
    for index, name, value in changes:
        rows[index][name] = value
    lines = [delimiter.join(columns)]
    lines += [delimiter.join(f"{each[name]}" for name in columns) for each in rows]
    return newline.join(lines) + newline


def codes(telemetry) -> dict[str, int]:
    return {notice.code: notice.count for notice in telemetry.notices}


def assert_is_the_flight(telemetry, count: int = 20) -> None:
    assert len(telemetry) == count
    assert telemetry["latitude_deg"] == pytest.approx(
        [41.9028 + 2e-6 * i for i in range(count)], abs=1e-9
    )
    assert telemetry["longitude_deg"] == pytest.approx(
        [12.4964 + 1e-6 * i for i in range(count)], abs=1e-9
    )
    assert telemetry["orthometric_height_m"] == pytest.approx([85.5] * count)
    assert telemetry["height_above_takeoff_m"] == pytest.approx([10.5] * count)
    assert np.isnan(telemetry["ellipsoidal_height_m"]).all()
    assert telemetry["speed_m_s"] == pytest.approx([5.0] * count)
    assert telemetry["course_deg"] == pytest.approx([math.degrees(math.atan2(4, 3))] * count)
    assert telemetry["camera_pitch_deg"] == pytest.approx([-90.0] * count)
    assert telemetry["camera_yaw_deg"] == pytest.approx([31.0] * count)
    assert telemetry["camera_roll_deg"] == pytest.approx([0.5] * count)
    assert telemetry["body_yaw_deg"] == pytest.approx([30.0] * count)
    assert telemetry["body_pitch_deg"] == pytest.approx([-2.0] * count)
    assert telemetry["body_roll_deg"] == pytest.approx([1.0] * count)
    assert telemetry.time_ns == pytest.approx(np.arange(count) * SECOND_NS / 10, abs=1000)
    assert (telemetry.video_time_ns == telemetry.time_ns).all()


def test_the_sixty_columns_of_the_thesis():
    assert len(COLUMNS) == 60
    telemetry = flight_table.read(table().encode(), "path1.csv")
    assert_is_the_flight(telemetry)
    assert codes(telemetry) == {"no_date": 20}


@settings(max_examples=30, deadline=None)
@given(
    order=st.permutations(COLUMNS),
    delimiter=st.sampled_from(",;\t"),
    newline=st.sampled_from(["\n", "\r\n", "\r"]),
    bom=st.booleans(),
    upper=st.booleans(),
    spaced=st.booleans(),
    quoted=st.booleans(),
)
def test_neither_order_nor_dress_of_columns_matters(
    order, delimiter, newline, bom, upper, spaced, quoted
):
    text = table(tuple(order), delimiter=delimiter, newline=newline)
    header, _, rest = text.partition(newline)
    cells = header.upper().split(delimiter) if upper else header.split(delimiter)
    if spaced:
        cells = [f" {cell.replace('(', ' (').replace(':', ' : ')} " for cell in cells]
    if quoted:
        cells = [f'"{cell}"' for cell in cells]
    data = (delimiter.join(cells) + newline + rest).encode("utf-8-sig" if bom else "utf-8")
    assert flight_table.recognises(data)
    assert_is_the_flight(flight_table.read(data, "a.csv"))


@pytest.mark.parametrize("encoding", ["latin-1", "utf-16"])
def test_other_encodings(encoding):
    data = table().encode(encoding)
    assert flight_table.recognises(data)
    assert_is_the_flight(flight_table.read(data, "a.csv"))


def test_decimal_commas():
    assert_is_the_flight(
        flight_table.read(table(delimiter=";").replace(".", ",").encode(), "a.csv")
    )
    quoted = table(delimiter='","').replace("\n", '"\n"').removesuffix('"')
    assert_is_the_flight(flight_table.read(f'"{quoted}'.replace(".", ",").encode(), "a.csv"))


def test_decimal_commas_that_break_cells_apart_are_refused():
    """Read as they stand, "5,41,8923,12,6032" under time, latitude, longitude is a place 5000 km away."""
    lines = [f"{k},5,41,{8923 + k},12,{6032 + k}" for k in range(20)]
    text = "\n".join(["time,latitude,longitude", *lines]) + "\n"
    with pytest.raises(InputError, match="20 rows have more cells than the header"):
        flight_table.read(text.encode(), "a.csv")


@pytest.mark.parametrize(
    "old, new, factor, column, expected",
    [
        ("relativeHeight", "relativeHeight(feet)", 1, "height_above_takeoff_m", 10.5 * 0.3048),
        ("gpsAltitude(meters)", "gpsAltitude[ft]", 1, "orthometric_height_m", 85.5 * 0.3048),
        ("velN(M/S)", "velN(km/h)", 3.6, "speed_m_s", 5.0),
        ("Yaw", "Yaw(radians)", 1, "body_yaw_deg", 30.0),
        ("offsetTime", "offsetTime(seconds)", 1, "speed_m_s", 5.0),
    ],
)
def test_units_of_the_header_are_converted(old, new, factor, column, expected):
    rows = [row(index) for index in range(5)]
    names = [new if name == old else name for name in COLUMNS]
    if old == "Yaw":
        rows = [{**each, "Yaw": math.radians(30.0)} for each in rows]
    lines = [",".join(names)]
    lines += [
        ",".join(str(each[name] * (factor if name == old else 1)) for name in COLUMNS)
        for each in rows
    ]
    telemetry = flight_table.read("\n".join(lines).encode(), "a.csv")
    assert telemetry[column] == pytest.approx([expected] * 5)
    assert telemetry.time_ns[1] == pytest.approx(SECOND_NS / 10, abs=1000)


def test_an_unknown_unit_is_reported_and_not_guessed():
    telemetry = flight_table.read(
        table().replace("relativeHeight", "relativeHeight(furlongs)").encode(), "a.csv"
    )
    assert "unknown_unit" in codes(telemetry)
    assert "furlongs" in next(
        notice.text for notice in telemetry.notices if notice.code == "unknown_unit"
    )
    assert not (telemetry["height_above_takeoff_m"] == 10.5).any()
    with pytest.raises(InputError, match="degrees or radians"):
        flight_table.read(table().replace("Latitude", "Latitude(furlongs)").encode(), "a.csv")


@settings(max_examples=60, deadline=None)
@given(yaw=st.floats(0, 359.9), pitch=st.floats(-89, 89), roll=st.floats(-179, 179))
def test_the_quaternion_stands_in_for_missing_angles(yaw, pitch, roll):
    half = [math.radians(angle) / 2 for angle in (yaw, pitch, roll)]
    cy, sy, cp, sp, cr, sr = (
        function(angle) for angle in half for function in (math.cos, math.sin)
    )
    quaternion = {
        "quatW": cr * cp * cy + sr * sp * sy,
        "quatX": sr * cp * cy - cr * sp * sy,
        "quatY": cr * sp * cy + sr * cp * sy,
        "quatZ": cr * cp * sy - sr * sp * cy,
    }
    columns = tuple(name for name in COLUMNS if name not in ("Roll", "Pitch", "Yaw"))
    changes = [(0, name, value) for name, value in quaternion.items()]
    telemetry = flight_table.read(table(columns, 2, changes=changes).encode(), "a.csv")
    assert (telemetry["body_yaw_deg"][0] - yaw + 180) % 360 - 180 == pytest.approx(0, abs=1e-5)
    assert telemetry["body_pitch_deg"][0] == pytest.approx(pitch, abs=1e-5)
    assert telemetry["body_roll_deg"][0] == pytest.approx(roll, abs=1e-5)


@pytest.mark.parametrize(
    "missing, rate_is_reported",
    [
        ((), False),
        (("offsetTime",), False),
        (("offsetTime", "flightTime(msec)"), False),
        (("offsetTime", "flightTime(msec)", "Tick#"), True),
    ],
)
def test_each_column_of_time_stands_in_for_the_next(missing, rate_is_reported):
    telemetry = flight_table.read(
        table(tuple(name for name in COLUMNS if name not in missing)).encode(), "a.csv"
    )
    assert_is_the_flight(telemetry)
    assert ("assumed_rate" in codes(telemetry)) is rate_is_reported


@pytest.mark.parametrize("ticks_hz", [600, 4_500_000])
def test_ticks_are_the_flight_controllers_clock(ticks_hz):
    changes = [(index, "Tick#", 7000 + round(0.2 * index * ticks_hz)) for index in range(20)]
    columns = tuple(name for name in COLUMNS if name not in ("offsetTime", "flightTime(msec)"))
    telemetry = flight_table.read(table(columns, changes=changes).encode(), "a.csv")
    assert np.diff(telemetry.time_ns) == pytest.approx([0.2 * SECOND_NS] * 19, abs=1000)


def test_datcons_table_with_empty_cells_and_trailing_ones():
    header = (
        "Tick#,offsetTime,flightTime(msec),Longitude,Latitude,numSats,gpsHealth,gpsAltitude(meters),baroAlt(meters),"
        "vpsHeight(M),relativeHeight,accelX(M/S2),velN(M/S),velE(M/S),velD(M/S),velH(M/S),quatW,quatX,quatY,quatZ,Roll,"
        "Pitch,Yaw,Yaw360,distancHP(M),Gimbal:roll,Gimbal:pitch,Gimbal:yaw,Gimbal:Xroll,MotorSpeed:RFront,Attribute|Value"
    )
    lines = [header + ",V2.8.0"]
    for index in range(
        100
    ):  # 50 rows a second; the receiver finds its satellites after half a second
        place = (
            (f"{9.19 + 1e-6 * index:.7f}", f"{45.46 + 2e-6 * index:.7f}")
            if index >= 25
            else ("", "")
        )
        distance = f"{0.2 * index:.1f}" if index >= 30 else ""
        lines.append(
            ",".join(
                [
                    str(240_000 + 12 * index),
                    f"{5 + 0.02 * index:.3f}",
                    str(20 * index),
                    *place,
                    "12",
                    "4",
                    "121.5",
                    "119.9",
                    "",
                    f"{30 + 0.01 * index:.2f}",
                    "0.1",
                    "3",
                    "4",
                    "0",
                    "5",
                    "1",
                    "0",
                    "0",
                    "0",
                    "1.5",
                    "-2",
                    "-90",
                    "270",
                    distance,
                    "0.1",
                    "-90",
                    "-91",
                    "7",
                    "",
                    "ACType|P3",
                    "more",
                ]
            )
        )
    data = "\r\n".join(lines).encode()
    assert flight_table.recognises(data[:4000])
    telemetry = flight_table.read(data, "FLY123.csv")
    assert len(telemetry) == 100 and codes(telemetry)["no_fix"] == 25
    assert np.diff(telemetry.time_ns) == pytest.approx([0.02 * SECOND_NS] * 99, abs=1000)
    assert telemetry["longitude_deg"][50] == pytest.approx(9.19005) and np.isnan(
        telemetry["latitude_deg"][24]
    )
    assert (
        telemetry["orthometric_height_m"][0] == 121.5
        and telemetry["height_above_takeoff_m"][99] == 30.99
    )
    assert telemetry["camera_pitch_deg"][0] == -90 and telemetry["camera_yaw_deg"][0] == -91
    assert telemetry["body_yaw_deg"][0] == -90 and telemetry["speed_m_s"][0] == 5
    assert "unreadable_line" not in codes(telemetry)


def test_airdatas_table():
    header = (
        "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet),altitude_above_seaLevel(feet),"
        "speed(mph),distance(feet),satellites,isVideo,xSpeed(mph),ySpeed(mph),zSpeed(mph),compass_heading(degrees),"
        "pitch(degrees),roll(degrees),gimbal_heading(degrees),gimbal_pitch(degrees),gimbal_roll(degrees),message"
    )
    rows = [
        f"{100 * i},2023-05-04 10:00:{i // 10:02d},46.{500000 + i},11.2,{100 + i},{1100 + i},10,1,14,1,6,8,0,"
        f'45,2.5,-1.5,46,-89.9,0.1,"Home, sweet home"'
        for i in range(40)
    ]
    telemetry = flight_table.read("\n".join([header, *rows]).encode(), "airdata.csv")
    assert (
        len(telemetry) == 40
        and abs(int(telemetry.time_ns[0]) - 1_683_194_400 * SECOND_NS) < SECOND_NS
    )
    assert np.diff(telemetry.time_ns) == pytest.approx([SECOND_NS / 10] * 39, abs=1000)
    assert telemetry["height_above_takeoff_m"][0] == pytest.approx(30.48)
    assert telemetry["orthometric_height_m"][0] == pytest.approx(1100 * 0.3048)
    assert telemetry["speed_m_s"][0] == pytest.approx(4.4704)
    assert telemetry["course_deg"][0] == pytest.approx(53.13, abs=0.01)
    assert telemetry["camera_pitch_deg"][0] == -89.9 and telemetry["body_roll_deg"][0] == -1.5
    assert "time_zone_unknown" not in codes(telemetry)


def test_a_dji_log_with_date_and_time_of_columns_of_their_own():
    header = (
        "CUSTOM.date [UTC],CUSTOM.updateTime [UTC],OSD.flyTime [s],OSD.latitude,OSD.longitude,OSD.height [ft],"
        "OSD.altitude [ft],OSD.hSpeed [MPH],OSD.xSpeed [MPH],OSD.ySpeed [MPH],OSD.pitch,OSD.roll,OSD.yaw,GIMBAL.pitch,"
        "GIMBAL.roll,GIMBAL.yaw,HOME.latitude,HOME.longitude"
    )
    rows = [
        f"7/14/2023,{12 - (i < 10)}:{'59' if i < 10 else '00'}:{(50 + i) % 60:02d}.25 {'AM' if i < 10 else 'PM'},"
        f"{i}.1,46.{500000 + 10 * i},11.2,100,900,3,3,4,1,2,30,-90,0,31,45,10"
        for i in range(20)
    ]
    telemetry = flight_table.read("\n".join([header, *rows]).encode(), "DJIFlightRecord.csv")
    noon_ns = int(np.datetime64("2023-07-14T12:00:00", "ns").astype(np.int64))
    assert list(telemetry.time_ns[[0, 10]] - noon_ns) == [-9_750_000_000, SECOND_NS // 4]
    assert telemetry["orthometric_height_m"][0] == pytest.approx(900 * 0.3048)
    assert telemetry["latitude_deg"][0] == 46.5 and telemetry["body_yaw_deg"][0] == 30


def test_a_real_phantom_4_log():
    telemetry = read_telemetry(real_data("telemetry/phantom4_log/log.csv"))
    assert telemetry.format == "table" and len(telemetry) > 700
    found = codes(telemetry)
    assert found["time_zone_unknown"] > 700 and "unreadable_line" not in found
    assert (
        telemetry["latitude_deg"][0] == pytest.approx(55.507158)
        and telemetry["longitude_deg"][0] == 10.717078
    )
    assert np.nanmax(telemetry["height_above_takeoff_m"]) == pytest.approx(64.5, abs=0.3)
    # its column of altitudes repeats the heights; the ground lies 21 m above the sea
    assert np.isnan(telemetry["orthometric_height_m"]).all()
    assert np.nanmedian(telemetry["camera_pitch_deg"]) == pytest.approx(-90, abs=0.2)
    moving = telemetry["speed_m_s"] > 2
    # the drone flies the way that its own position moves
    east = np.gradient(telemetry["longitude_deg"]) * np.cos(np.radians(55.5))
    north = np.gradient(telemetry["latitude_deg"])
    way = np.degrees(np.arctan2(east, north))[moving]
    turn = (way - telemetry["course_deg"][moving] + 180) % 360 - 180
    assert np.median(np.abs(turn)) < 15
    steps_s = np.diff(telemetry.time_ns) / SECOND_NS
    assert np.median(steps_s) == pytest.approx(0.1, abs=0.01)


def test_a_gap_shows_in_ticks_too():
    columns = tuple(name for name in COLUMNS if name not in ("offsetTime", "flightTime(msec)"))
    lines = table(columns, 60).splitlines()
    del lines[20:50]
    telemetry = flight_table.read("\n".join(lines).encode(), "a.csv")
    assert codes(telemetry)["gap"] == 1
    assert np.diff(telemetry.time_ns).max() == pytest.approx(3.1 * SECOND_NS)


def test_a_column_of_dates_gives_utc():
    start = int(np.datetime64("2016-05-04T10:00:00", "ns").astype(np.int64))
    for name, texts in {
        "GPS:dateTimeStamp": [f"2016-05-04T10:00:{i // 10:02d}Z" for i in range(30)],
        "dateTimeUTC": [f"2016-05-04 10:00:{i // 10:02d}.{i % 10}" for i in range(30)],
        "time": [str(start / 1e9 + i / 10) for i in range(30)],
        "timestamp(ms)": [str(start / 1e6 + i * 100) for i in range(30)],
    }.items():
        lines = table(count=30).splitlines()
        text = "\n".join(
            [f"{lines[0]},{name}", *(f"{line},{each}" for line, each in zip(lines[1:], texts))]
        )
        telemetry = flight_table.read(text.encode(), "a.csv")
        assert len(telemetry) == 30, name
        assert abs(int(telemetry.time_ns[0]) - start) < SECOND_NS, name
        assert np.diff(telemetry.time_ns) == pytest.approx([SECOND_NS / 10] * 29, abs=1000), name
        assert (telemetry.video_time_ns == -1).all(), name
        assert "no_date" not in codes(telemetry) and "time_zone_unknown" not in codes(telemetry), (
            name
        )


@pytest.mark.parametrize(
    "header, text",
    [
        ("datetime", "{0:%d.%m.%Y %H:%M:%S.%f}"),
        ("datetime", "{0:%m/%d/%Y %I:%M:%S.%f %p}"),
        ("datetime", "{0:%Y-%m-%d %I:%M:%S.%f %p}"),
        ("date,time", "{0:%Y-%m-%d},{0:%H:%M:%S.%f}"),
        ("date,time", "{0:%d.%m.%Y},{0:%H:%M:%S.%f}"),
        ("time", "{0:%H:%M:%S.%f}"),
        ("gpsTime", "{0:%I:%M:%S.%f %p}"),
    ],
)
def test_dates_and_times_of_day_in_every_dress_across_midnight(header, text):
    begins = datetime(2026, 4, 2, 23, 59, 58)
    moments = [begins + timedelta(seconds=0.5 * k) for k in range(20)]
    rows = [f"{text.format(each)},41.90,{12.6 + 1e-5 * k}" for k, each in enumerate(moments)]
    telemetry = flight_table.read("\n".join([f"{header},lat,lon", *rows, ""]).encode(), "a.csv")
    day = (
        datetime(1970, 1, 1) if "date" in header else datetime(2026, 4, 2)
    )  # a clock alone counts from 1970
    first_s = (begins - day).total_seconds()
    assert telemetry.time_ns / 1e9 == pytest.approx(first_s + 0.5 * np.arange(20), abs=1e-5)
    assert (telemetry.video_time_ns == -1).all()


@pytest.mark.parametrize(
    "header, text, words",
    [
        ("timestamp", "20260402T1244{:02d}", "no time can be read in timestamp"),
        ("timestamp", "1234{:02d}00", "no time can be read in timestamp"),
        ("time_ms", "{:d}500", "name the column time(s) or time(ms)"),
        ("time", "{:d}500", "its times are more than 20 s apart"),
    ],
)
def test_times_that_nobody_understands_are_refused(header, text, words):
    """Taken as 10 rows a second, which they are not, they lay a map 13 m off without a word."""
    rows = [f"{text.format(k)},41.90,{12.6 + 1e-5 * k}" for k in range(20)]
    with pytest.raises(InputError, match=re.escape(words)):
        flight_table.read("\n".join([f"{header},lat,lon", *rows, ""]).encode(), "a.csv")


def test_a_date_without_its_zone_is_reported():
    lines = table(count=3).splitlines()
    rows = [f"{line},2016-05-04 10:00:00.{i}" for i, line in enumerate(lines[1:])]
    text = "\n".join([f"{lines[0]},dateTime", *rows])
    assert codes(flight_table.read(text.encode(), "a.csv"))["time_zone_unknown"] == 3


def test_the_barometer_stands_in_for_the_relative_height_and_reports_it():
    columns = tuple(name for name in COLUMNS if name != "relativeHeight")
    telemetry = flight_table.read(table(columns, 3).encode(), "a.csv")
    assert list(telemetry["height_above_takeoff_m"]) == [0.0, 1.0, 2.0]
    assert codes(telemetry)["height_from_barometer"] == 3


def test_sentences_in_a_61st_column_do_not_disturb():
    lines = table(count=4).splitlines()
    nmea = "$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47"
    text = "\n".join(
        [lines[0] + ",NMEA GGA/RMC Strings", *(f"{line},{nmea}" for line in lines[1:])]
    )
    assert_is_the_flight(flight_table.read(text.encode(), "a.csv"), 4)


def test_broken_rows_are_counted():
    lines = table(count=30).splitlines()
    lines[4] = lines[4].replace("41.9028", "41.x9")
    lines[7] = "1,2"
    lines[9] = '"' + lines[9]  # a stray quote
    lines[12] = ""
    telemetry = flight_table.read(("\n".join(lines) + "\n").encode(), "a.csv")
    reported = codes(telemetry)
    assert reported["unreadable_line"] == 1
    assert reported["short_row"] == 2
    assert len(telemetry) == 27


def test_a_half_written_last_row_is_counted():
    text = table(count=5)
    telemetry = flight_table.read(text[:-40].encode(), "a.csv")
    assert codes(telemetry)["truncated"] == 1
    assert_is_the_flight(telemetry, 4)
    assert "truncated" not in codes(flight_table.read(text.rstrip().encode(), "a.csv"))


def test_a_flight_starts_before_the_clock_does():
    changes = [(0, "offsetTime", -3.0), (1, "offsetTime", -2.9)]
    telemetry = flight_table.read(table(count=2, changes=changes).encode(), "a.csv")
    assert list(telemetry.video_time_ns) == [0, SECOND_NS // 10]


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_mutated_files_raise_only_input_errors(data):
    columns = COLUMNS[:12] + COLUMNS[20:31]
    valid = bytearray(table(columns, 4).encode())
    for _ in range(data.draw(st.integers(1, 8))):
        place = data.draw(st.integers(0, len(valid) - 1))
        if data.draw(st.booleans()):
            valid[place] = data.draw(
                st.one_of(st.integers(0, 255), st.sampled_from(b'"e-.,;\x00\n9'))
            )
        else:
            del valid[place : place + data.draw(st.integers(1, 20))]
        if not valid:
            return
    try:
        telemetry = flight_table.read(bytes(valid), "a.csv")
    except InputError:
        return
    assert (np.diff(telemetry.time_ns) > 0).all()
    assert all(not np.isinf(column).any() for column in telemetry.columns.values())


@settings(max_examples=100, deadline=None)
@given(
    cells=st.lists(
        st.tuples(
            *[
                st.one_of(
                    st.floats(allow_nan=True, allow_infinity=True).map(str), st.text(max_size=6)
                )
            ]
            * 4
        ),
        min_size=1,
        max_size=12,
    )
)
def test_any_cells_raise_only_input_errors(cells):
    text = "offsetTime,Latitude,Longitude,time\n" + "\n".join(",".join(each) for each in cells)
    try:
        telemetry = flight_table.read(text.encode("utf-8", "surrogatepass"), "a.csv")
    except InputError:
        return
    latitude = telemetry["latitude_deg"]
    assert (np.abs(latitude[np.isfinite(latitude)]) <= 90).all()


def litchi(*more: str) -> bytes:
    """Ten rows of a log of Litchi's, with more columns of 1.5."""
    names = "latitude,longitude,altitude(feet),ascent(feet),speed(mph),max_altitude(feet),datetime(utc),gimbalPitchRaw"
    rows = [
        f"41.8900{row},12.6,500,{100 * row},10,900,2026-04-02 12:44:{row:02d},-900"
        + ",1.5" * len(more)
        for row in range(10)
    ]
    return "\n".join([",".join([names, *more]), *rows]).encode()


def test_columns_of_height_and_gimbal_that_are_not_understood_are_named():
    telemetry = flight_table.read(litchi(), "litchi.csv")
    np.testing.assert_allclose(telemetry["height_above_takeoff_m"], 30.48 * np.arange(10))
    assert np.isnan(telemetry["orthometric_height_m"]).all()
    (found,) = [each for each in telemetry.notices if each.code == "unknown_column"]
    assert found.text.endswith("are not understood: altitude(feet), gimbalPitchRaw")
    # where what they may hold is read, others of that kind are no news
    more = litchi(
        "altitude_msl(m)", "gimbal_pitch(deg)", "height_sonar(m)", "gimbal.isPitchAtLimit"
    )
    assert "unknown_column" not in codes(flight_table.read(more, "litchi.csv"))

"""DJI subtitles: one round trip per dialect, the order of the coordinates, clocks, broken and real files."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from real_data import real_data
from sorvolo.capture.telemetry import dji_srt
from sorvolo.errors import InputError

SECOND_NS = 1_000_000_000

DIALECTS = {
    "brackets": '<font size="28">FrameCnt: {n}, DiffTime: 20ms\n2021-12-25 12:27:{s:02d}.000\n'
    "[iso: 220] [shutter: 1/8000.0] [latitude: {lat:.6f}] [longitude: {lon:.6f}] "
    "[rel_alt: {h:.3f} abs_alt: 120.5] [gb_yaw: 12.5 gb_pitch: -89.9 gb_roll: 0.1] </font>",
    "spaced": '<font size="36">SrtCnt : {n}, DiffTime : 40ms\n2021-12-25 12:27:{s:02d},000,000\n'
    "[iso : 110] [latitude : {lat:.6f}] [longtitude : {lon:.6f}] [altitude : 120.5] "
    "[drone_yaw : 12.5 drone_pitch : 3.0 drone_roll : -1.0] </font>",
    "home": "HOME({lon:.6f},{lat:.6f}) 2021.12.25 12:27:{s:02d}\n"
    "GPS({lon:.6f},{lat:.6f},17) BAROMETER:{h:.1f}\n"
    "ISO:100 Shutter:60 EV: Fnum:2.2",
    "old": "HOME({lon:.6f},{lat:.6f}) 2021.12.25 12:27:{s:02d}\n"
    "GPS({lon:.6f},{lat:.6f},17) Hb:{h:.1f} Hs:1.0\n"
    "ISO:100 TV:60 EV: 0 IR:F2.8",
    "matrice": "2021.12.25 12:27:{s:02d}\nGPS({lat:.6f},{lon:.6f},0.0M) BAROMETER:{h:.1f}M",
    "brackets in": "2021.12.25 12:27:{s:02d}\nGPS({lon:.6f},{lat:.6f},17) BAROMETER({h:.1f})",
    "line": "F/5.6, SS 400, ISO 100, EV 0, GPS ({lon:.6f}, {lat:.6f}, 15), HOME (1.5, 2.5, -57.98m), "
    "D 698.70m, H {h:.2f}m, H.S 2.88m/s, V.S 0.00m/s, "
    "F.PRY (2.7°, -7.0°, 110.1°), G.PRY (-24.4°, 0.0°, 110.4°)",
    "autel": "HOME(E: 1.5, N: 2.5) 2021.12.25 12:27:{s:02d}\n"
    "GPS({ew}: {alon:.6f}, {ns}: {alat:.6f}, 120.5) ReH:{h:.1f} \nISO:100",
    "letters": "HOME(E: 1.5, N: 2.5, 3.0m) 2021.12.25 12:27:{s:02d}\n"
    "GPS({ew}: {alon:.6f}, {ns}: {alat:.6f}, 120.5m) BAROMETER:{h:.1f}",
}


def srt(dialect: str, places, newline: str = "\n") -> str:
    cues = []
    for index, (latitude, longitude, height_m) in enumerate(places):
        body = DIALECTS[dialect].format(
            n=index + 1,
            s=index,
            lat=latitude,
            lon=longitude,
            h=height_m,
            alat=abs(latitude),
            alon=abs(longitude),
            ns="NS"[latitude < 0],
            ew="EW"[longitude < 0],
        )
        cues.append(f"{index + 1}\n00:00:{index:02d},000 --> 00:00:{index + 1:02d},000\n{body}\n\n")
    return "".join(cues).replace("\n", newline)


def ass(dialect: str, places) -> str:
    """The same cues as an Advanced SubStation Alpha file."""
    head = "[Script Info]\nScriptType: v4.00+\n\n[Events]\nFormat: Layer, Start, End, Style, Name, MarginL, Effect, Text\n"
    lines = []
    for cue in srt(dialect, places).strip().split("\n\n"):
        _, times, *body = cue.split("\n")
        start, end = (f"{int(each[:2])}{each[2:8]}.{each[9:11]}" for each in times.split(" --> "))
        lines.append(f"Dialogue: 0,{start},{end},Default,,0,0,0,," + "\\N".join(body))
    return head + "\n".join(lines) + "\n"


def codes(telemetry) -> dict[str, int]:
    return {notice.code: notice.count for notice in telemetry.notices}


@pytest.mark.parametrize("dialect", DIALECTS)
@settings(max_examples=15, deadline=None)
@given(
    latitude=st.floats(-89, 89),
    longitude=st.floats(-179.9, 179.9),
    newline=st.sampled_from(["\n", "\r\n"]),
    height_m=st.floats(-50, 500),
)
def test_every_dialect_comes_back(dialect, latitude, longitude, newline, height_m):
    if abs(latitude) < 1e-3 and abs(longitude) < 1e-3:
        return
    places = [(latitude + 1e-5 * i, longitude, height_m) for i in range(4)]
    telemetry = dji_srt.read(srt(dialect, places, newline).encode(), "a.SRT")
    assert len(telemetry) == 4
    assert telemetry["latitude_deg"] == pytest.approx([place[0] for place in places], abs=6e-7)
    assert telemetry["longitude_deg"] == pytest.approx([longitude] * 4, abs=6e-7)
    if dialect != "spaced":
        assert telemetry["height_above_takeoff_m"] == pytest.approx([height_m] * 4, abs=0.051)
    if dialect in ("brackets", "spaced", "letters", "autel"):
        assert list(telemetry["orthometric_height_m"]) == [120.5] * 4
    else:
        assert np.isnan(telemetry["orthometric_height_m"]).all()
    assert np.isnan(telemetry["ellipsoidal_height_m"]).all()
    assert list(telemetry.video_time_ns) == [index * SECOND_NS for index in range(4)]
    start = (
        0 if dialect == "line" else int(np.datetime64("2021-12-25T12:27:00", "ns").astype(np.int64))
    )
    assert list(telemetry.time_ns) == [start + index * SECOND_NS for index in range(4)]
    assert ("no_date" in codes(telemetry)) is (dialect == "line")
    assert ("time_zone_unknown" in codes(telemetry)) is (dialect != "line")
    assert ("latitude_first" in codes(telemetry)) is (dialect == "matrice")


def test_the_angles_of_each_dialect():
    places = [(48.0, 11.0, 10.0)] * 2
    brackets = dji_srt.read(srt("brackets", places).encode(), "a")
    assert [brackets[f"camera_{axis}_deg"][0] for axis in ("yaw", "pitch", "roll")] == [
        12.5,
        -89.9,
        0.1,
    ]
    spaced = dji_srt.read(srt("spaced", places).encode(), "a")
    assert [spaced[f"body_{axis}_deg"][0] for axis in ("yaw", "pitch", "roll")] == [12.5, 3.0, -1.0]
    line = dji_srt.read(srt("line", places).encode(), "a")
    assert [line[f"camera_{axis}_deg"][0] for axis in ("yaw", "pitch", "roll")] == [
        110.4,
        -24.4,
        0.0,
    ]
    assert [line[f"body_{axis}_deg"][0] for axis in ("yaw", "pitch", "roll")] == [110.1, 2.7, -7.0]
    assert line["speed_m_s"][0] == 2.88


@pytest.mark.parametrize(
    "group, latitude, longitude",
    [
        ("-58.4563,-34.7386,19", -34.7386, -58.4563),  # satellites: longitude first
        ("36.6146,-6.1120,0.0M", 36.6146, -6.1120),  # a height with its unit: latitude first
        (
            "39.9062,16.3913,69.800",
            39.9062,
            16.3913,
        ),  # so does one without: no count of satellites has decimals
        ("149.0251,-20.2532,12.0M", -20.2532, 149.0251),  # no latitude is 149
        ("-41.3899,174.0177,17", -41.3899, 174.0177),
        ("N: 40.768574, W: 109.339287, 2371.76m", 40.768574, -109.339287),
        ("W: 109.339287, N: 40.768574, 2371.76m", 40.768574, -109.339287),
        ("E: 1.25, S: 43.6, 207m", -43.6, 1.25),
        ("8.6499, 53.1665", 53.1665, 8.6499),
    ],
)
def test_the_order_of_the_coordinates(group, latitude, longitude):
    text = f"1\n00:00:00,000 --> 00:00:01,000\nGPS({group}) BAROMETER:1.0\n\n"
    telemetry = dji_srt.read(text.encode(), "a.SRT")
    assert (telemetry["latitude_deg"][0], telemetry["longitude_deg"][0]) == (latitude, longitude)


def test_coarse_positions_have_an_honest_sigma():
    text = srt("home", [(48.0, 11.0, 10.0)] * 3).replace(".000000", ".0000")
    telemetry = dji_srt.read(text.encode(), "a.SRT")
    assert telemetry["horizontal_sigma_m"] == pytest.approx([11.132 / 12**0.5] * 3, rel=1e-3)
    assert codes(telemetry)["coarse_position"] == 3
    assert codes(telemetry)["repeated_fix"] == 2
    fine = dji_srt.read(srt("home", [(48.0, 11.0, 10.0)] * 3).encode(), "a.SRT")
    assert list(fine["horizontal_sigma_m"]) == [1.5] * 3


def test_a_clock_in_whole_seconds_at_frame_rate_loses_no_sample():
    cues = [
        f"{i + 1}\n00:00:{i // 25:02d},{i % 25 * 40:03d} --> 00:00:{i // 25:02d},{i % 25 * 40 + 39:03d}\n"
        f"HOME(11.0,48.0) 2021.12.25 12:27:{(i + 7) // 25:02d}\n"
        f"GPS(11.0,{48 + i * 1e-6:.6f},17) BAROMETER:2.0\n\n"
        for i in range(100)
    ]
    telemetry = dji_srt.read("".join(cues).encode(), "a.SRT")
    assert len(telemetry) == 100
    assert (np.diff(telemetry.time_ns) == 40_000_000).all()
    assert codes(telemetry)["clock_refined"] == 100


def test_cues_without_a_date_are_placed_by_the_video():
    text = srt("home", [(48.0, 11.0, 10.0)] * 4).replace(
        "2021.12.25 12:27:02", "2021.99.99 12:27:02"
    )
    telemetry = dji_srt.read(text.encode(), "a.SRT")
    assert codes(telemetry)["no_date"] == 1
    assert (np.diff(telemetry.time_ns) == SECOND_NS).all()


def test_no_fix_is_no_place():
    text = srt("home", [(48.0, 11.0, 10.0)] * 4).replace(
        "GPS(11.000000,48.000000,17)", "GPS(N/A,N/A,4)", 1
    )
    telemetry = dji_srt.read(text.encode(), "a.SRT")
    assert np.isnan(telemetry["latitude_deg"][0])
    assert telemetry["height_above_takeoff_m"][0] == 10.0
    assert codes(telemetry)["no_fix"] == 1


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize("cut", [30, 60, 90, 120])
def test_a_cut_file_has_no_wrong_number(dialect, cut):
    places = [(48.123456, 11.654321, 123.4)] * 4
    whole = dji_srt.read(srt(dialect, places).encode(), "a")
    text = srt(dialect, places)
    telemetry = dji_srt.read(text[: len(text) - cut].encode(), "a.SRT")
    for name, values in telemetry.columns.items():
        known = values[np.isfinite(values)]
        assert np.isin(known, whole[name]).all(), name


def test_a_half_written_last_cue_is_counted():
    text = srt("home", [(48.0, 11.0, 10.0)] * 4)
    telemetry = dji_srt.read(text[: text.rindex("GPS(") + 12].encode(), "a.SRT")
    assert len(telemetry) == 3
    assert codes(telemetry)["truncated"] == 1


def test_subtitles_of_a_film_are_no_telemetry():
    film = b"1\n00:00:01,000 --> 00:00:02,000\nHello there.\n\n"
    assert not dji_srt.recognises(film)
    with pytest.raises(InputError, match="no usable dji_srt"):
        dji_srt.read(film, "film.srt")


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_mutated_files_raise_only_input_errors(data):
    dialect = data.draw(st.sampled_from(sorted(DIALECTS)))
    valid = bytearray(srt(dialect, [(48.0 + 1e-5 * i, 11.0, 10.0) for i in range(3)]).encode())
    for _ in range(data.draw(st.integers(1, 8))):
        place = data.draw(st.integers(0, len(valid) - 1))
        if data.draw(st.booleans()):
            valid[place] = data.draw(
                st.one_of(st.integers(0, 255), st.sampled_from(b"0123456789.,-:()[]"))
            )
        else:
            del valid[place : place + data.draw(st.integers(1, 30))]
        if not valid:
            return
    try:
        telemetry = dji_srt.read(bytes(valid), "a.SRT")
    except InputError:
        return
    assert (np.diff(telemetry.time_ns) > 0).all()
    assert all(not np.isinf(column).any() for column in telemetry.columns.values())


def real(name: str) -> bytes:
    return real_data(f"telemetry/dji_srt/{name}").read_bytes()


# file, cues, first and last (latitude, longitude, height above take-off), first time
REAL = [
    (
        "MAVIC3.srt",
        12318,
        (3.41531, -3.37440, -2.4),
        (3.41368, -3.37721, 3.6),
        "2021-12-25T12:27:52.373",
    ),
    (
        "mavic_2pro_new.SRT",
        8952,
        (-35.080155, -60.286702, None),
        (-35.077976, -60.314572, None),
        "2019-09-27T10:28:08.438904",
    ),
    (
        "mavic_pro.SRT",
        468,
        (-20.2533, 149.0251, 1.9),
        (-20.2532, 149.0251, 0.0),
        "2017-08-05T14:11:51",
    ),
    (
        "old_format.SRT",
        468,
        (-20.2533, 149.0251, 1.9),
        (-20.2532, 149.0251, 0.0),
        "2017-08-05T14:11:51",
    ),
    (
        "mavic_pro_buggy.SRT",
        546,
        (42.4668, -1.2218, 0.0),
        (42.4668, -1.2217, 15.8),
        "2018-08-19T08:00:36",
    ),
    (
        "mavic_mini.SRT",
        117,
        (48.0771, -121.7458, 200.7),
        (48.0775, -121.7476, 200.8),
        "1970-01-01T00:00:00",
    ),
    (
        "p4_rtk.SRT",
        55,
        (-34.237922, -58.851745, 85.8),
        (-34.232349, -58.849196, 85.8),
        "1970-01-01T00:00:00",
    ),
    (
        "matrice_300.srt",
        381,
        (36.6146, -6.1120, 0.3),
        (36.6146, -6.1120, 0.0),
        "2022-06-21T16:06:17",
    ),
    (
        "broken_incomplete.SRT",
        19,
        (-34.7383, -58.4563, 20.1),
        (-34.7383, -58.4563, 7.7),
        "2017-07-03T10:15:03",
    ),
]


@pytest.mark.parametrize("name, count, first, last, start", REAL, ids=[each[0] for each in REAL])
def test_real_files(name, count, first, last, start):
    data = real(name)
    began = time.process_time()
    telemetry = dji_srt.read(data, name)
    assert time.process_time() - began < 4.0  # about 1 s for the largest, 3.6 MB, on a quiet core
    assert len(telemetry) == count
    for place, expected in ((0, first), (-1, last)):
        assert telemetry["latitude_deg"][place] == expected[0]
        assert telemetry["longitude_deg"][place] == expected[1]
        if expected[2] is None:
            assert np.isnan(telemetry["height_above_takeoff_m"][place])
        else:
            assert telemetry["height_above_takeoff_m"][place] == expected[2]
    assert (
        abs(int(telemetry.time_ns[0]) - int(np.datetime64(start, "ns").astype(np.int64)))
        <= SECOND_NS
    )
    assert codes(telemetry).get("truncated", 0) == (name == "broken_incomplete.SRT")
    assert "jump" not in codes(telemetry)


def test_real_file_with_lost_fixes():
    telemetry = dji_srt.read(real("mavic_pro_buggy.SRT"), "mavic_pro_buggy.SRT")
    assert codes(telemetry)["no_fix"] == 16  # "GPS(N/A,N/A,...)" in the file
    assert codes(telemetry)["gap"] == 1


def test_real_file_of_several_recordings():
    telemetry = dji_srt.read(real("mavic_2pro_new.SRT"), "mavic_2pro_new.SRT")
    assert codes(telemetry)["gap"] == 11
    assert np.diff(telemetry.time_ns).max() / SECOND_NS == pytest.approx(973.416, abs=1e-3)


def test_real_empty_file():
    with pytest.raises(InputError, match="no subtitle times"):
        dji_srt.read(real("broken_empty.SRT"), "broken_empty.SRT")


@pytest.mark.parametrize("dialect", ["autel", "home", "brackets"])
def test_ass_subtitles_say_the_same_as_srt(dialect):
    places = [(41.89 + 1e-5 * row, -12.6, 49.9 + row) for row in range(8)]
    expected = dji_srt.read(srt(dialect, places).encode(), "MAX_0001.SRT")
    data = ass(dialect, places).encode()
    assert dji_srt.recognises(data)
    found = dji_srt.read(data, "MAX_0001.ass")
    assert found.time_ns.tolist() == expected.time_ns.tolist()
    assert found.video_time_ns.tolist() == expected.video_time_ns.tolist()
    for name, column in expected.columns.items():
        np.testing.assert_array_equal(found[name], column)
    np.testing.assert_allclose(found["height_above_takeoff_m"], 49.9 + np.arange(8))

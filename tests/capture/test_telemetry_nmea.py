"""NMEA: round trips through the checksum, the date, the two sentences of one moment, and broken input."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pynmeagps import GET, NMEAMessage

from sorvolo.capture.telemetry import nmea
from sorvolo.errors import InputError

SECOND_NS = 1_000_000_000
NOON_NS = int(np.datetime64("2016-05-04T12:00:00", "ns").astype(np.int64))


def sentence(body: str) -> str:
    checksum = 0
    for letter in body:
        checksum ^= ord(letter)
    return f"${body}*{checksum:02X}\r\n"


def degrees_minutes(value: float, digits: int) -> str:
    minutes = round(abs(value) * 60, 5)
    return f"{int(minutes // 60):0{digits}d}{minutes % 60:08.5f}"


def gga(
    clock: str,
    latitude: float,
    longitude: float,
    altitude: str = "545.4",
    separation: str = "46.9",
    quality: int = 1,
    hdop: str = "0.9",
    talker: str = "GP",
) -> str:
    return sentence(
        f"{talker}GGA,{clock},{degrees_minutes(latitude, 2)},{'NS'[latitude < 0]},"
        f"{degrees_minutes(longitude, 3)},{'EW'[longitude < 0]},{quality},08,"
        f"{hdop},{altitude},M,{separation},M,,"
    )


def rmc(
    clock: str,
    day: str,
    latitude: float,
    longitude: float,
    status: str = "A",
    speed: str = "10.0",
    course: str = "84.4",
    talker: str = "GP",
) -> str:
    return sentence(
        f"{talker}RMC,{clock},{status},{degrees_minutes(latitude, 2)},{'NS'[latitude < 0]},"
        f"{degrees_minutes(longitude, 3)},{'EW'[longitude < 0]},{speed},{course},{day},,"
    )


def flight(count: int = 5) -> str:
    return "".join(
        gga(f"1200{second:02d}.00", 48.1 + 1e-5 * second, 11.5)
        + rmc(f"1200{second:02d}.00", "040516", 48.1, 11.5)
        for second in range(count)
    )


def codes(telemetry) -> dict[str, int]:
    return {notice.code: notice.count for notice in telemetry.notices}


def test_gga_and_rmc_of_one_moment_are_one_sample():
    telemetry = nmea.read(flight(3).encode(), "a.log")
    assert len(telemetry) == 3
    assert telemetry.time_ns[0] == NOON_NS
    assert list(np.diff(telemetry.time_ns)) == [SECOND_NS] * 2
    assert telemetry["latitude_deg"][2] == pytest.approx(48.10002, abs=1e-7)
    assert telemetry["orthometric_height_m"][0] == 545.4
    assert telemetry["ellipsoidal_height_m"][0] == pytest.approx(592.3)
    assert telemetry["horizontal_sigma_m"][0] == pytest.approx(1.35)
    assert telemetry["speed_m_s"][0] == pytest.approx(10 * 1852 / 3600)
    assert telemetry["course_deg"][0] == 84.4
    assert (telemetry.video_time_ns == -1).all()
    assert codes(telemetry) == {}


def test_a_published_sentence_is_read():
    text = "$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n"
    telemetry = nmea.read(text.encode(), "a.log")
    assert telemetry["latitude_deg"][0] == pytest.approx(48 + 7.038 / 60, abs=1e-9)
    assert telemetry["longitude_deg"][0] == pytest.approx(11 + 31 / 60, abs=1e-9)
    assert codes(telemetry)["no_date"] == 1


def test_no_separation_means_no_ellipsoidal_height():
    telemetry = nmea.read(gga("120000", 48.1, 11.5, separation="").encode(), "a.log")
    assert np.isnan(telemetry["ellipsoidal_height_m"][0])
    assert telemetry["orthometric_height_m"][0] == 545.4


@settings(max_examples=60, deadline=None)
@given(
    latitude=st.floats(-89.9, 89.9),
    longitude=st.floats(-180, 180),
    talker=st.sampled_from(["GP", "GN", "GL", "GA", "GB", "QZ"]),
)
def test_positions_come_back_with_their_signs(latitude, longitude, talker):
    if abs(latitude) < 1e-5 and abs(longitude) < 1e-5:
        return
    for text in (
        gga("120000", latitude, longitude, talker=talker),
        rmc("120000", "040516", latitude, longitude, talker=talker),
    ):
        telemetry = nmea.read(text.encode(), "a.log")
        assert telemetry["latitude_deg"][0] == pytest.approx(latitude, abs=2e-7)
        assert telemetry["longitude_deg"][0] == pytest.approx(longitude, abs=2e-7)


@pytest.mark.parametrize(
    "latitude, longitude", [(48.1, 11.5), (-33.9, 151.2), (40.7, -74.0), (-22.9, -43.2)]
)
def test_agrees_with_sentences_of_the_library(latitude, longitude):
    message = NMEAMessage(
        "GN",
        "GGA",
        GET,
        lat=latitude,
        lon=longitude,
        quality=1,
        alt=100.0,
        HDOP=1.0,
        time="120000.00",
    )
    telemetry = nmea.read(message.serialize(), "a.log")
    assert telemetry["latitude_deg"][0] == pytest.approx(latitude, abs=1e-6)
    assert telemetry["longitude_deg"][0] == pytest.approx(longitude, abs=1e-6)


def test_across_the_antimeridian_nothing_jumps():
    track = [179.9999, 179.99995, -179.99999, -179.9999]
    text = "".join(gga(f"12000{i}", -17.0, longitude) for i, longitude in enumerate(track))
    telemetry = nmea.read(text.encode(), "a.log")
    assert telemetry["longitude_deg"] == pytest.approx(track, abs=1e-6)
    assert "jump" not in codes(telemetry)


def test_bad_and_missing_checksums_are_counted_and_dropped():
    lines = flight(4).splitlines(keepends=True)
    lines[0] = lines[0].replace("545.4", "945.4")
    lines[3] = lines[3].rpartition("*")[0] + "\r\n"
    telemetry = nmea.read("".join(lines).encode(), "a.log")
    assert codes(telemetry)["bad_checksum"] == 2
    assert len(telemetry) == 4
    assert np.isnan(telemetry["orthometric_height_m"][0])  # only RMC is left of the first moment


def test_midnight():
    text = (
        gga("235958", 48.1, 11.5)
        + rmc("235959", "311215", 48.1, 11.5)
        + gga("000000", 48.1, 11.5)
        + gga("000001", 48.1, 11.5)
        + rmc("000002", "010116", 48.1, 11.5)
    )
    telemetry = nmea.read(text.encode(), "a.log")
    first = int(np.datetime64("2015-12-31T23:59:58", "ns").astype(np.int64))
    assert list(telemetry.time_ns) == [first + second * SECOND_NS for second in range(5)]
    assert "backward_time" not in codes(telemetry)


def test_midnight_without_any_date():
    text = gga("235959", 48.1, 11.5) + gga("000000", 48.1, 11.5)
    telemetry = nmea.read(text.encode(), "a.log")
    assert list(telemetry.time_ns) == [86_399 * SECOND_NS, 86_400 * SECOND_NS]
    assert codes(telemetry)["no_date"] == 2


def test_a_void_date_does_not_move_the_flight():
    text = rmc("115959", "060180", 0.0, 0.0, status="V") + flight(2)
    telemetry = nmea.read(text.encode(), "a.log")
    assert list(telemetry.time_ns) == [NOON_NS - SECOND_NS, NOON_NS, NOON_NS + SECOND_NS]
    assert np.isnan(telemetry["latitude_deg"][0])
    assert codes(telemetry)["no_fix"] == 1


def test_no_fix_shows_nothing():
    text = flight(2) + gga("120002", 48.1, 11.5, quality=0) + gga("120003", 48.1, 11.5)
    telemetry = nmea.read(text.encode(), "a.log")
    assert np.isnan(telemetry["latitude_deg"][2])
    assert np.isnan(telemetry["orthometric_height_m"][2])
    assert codes(telemetry)["no_fix"] == 1
    with pytest.raises(InputError, match="no usable nmea"):
        nmea.read(gga("120002", 48.1, 11.5, quality=0).encode(), "a.log")


@pytest.mark.parametrize("letter", ["N", "W"])
def test_a_position_without_its_letter_is_none(letter):
    """It would be north or east without a word."""
    bodies = [gga(f"12000{k}.00", 41.9 + 1e-5 * k, -12.5) for k in range(4)]
    without = [sentence(each[1:].partition("*")[0].replace(f",{letter},", ",,")) for each in bodies]
    telemetry = nmea.read("".join(without).encode(), "a.nmea")
    assert not telemetry.has_fixes and codes(telemetry)["no_fix"] == 4


def test_null_island_is_no_place():
    telemetry = nmea.read((gga("115959", 0.0, 0.0) + flight(2)).encode(), "a.log")
    assert np.isnan(telemetry["latitude_deg"][0])
    assert codes(telemetry)["null_fix"] == 1


def test_sentences_within_another_log():
    lines = [f'17:01:02 rx> junk, "{line}" tail' for line in flight(3).splitlines()]
    noisy = "boot\n$GPGSV,3,1,11,03,03,111,00*74\n" + "\n".join(lines)
    assert nmea.recognises(noisy.encode())
    telemetry = nmea.read(noisy.encode(), "a.log")
    assert len(telemetry) == 3
    assert telemetry["latitude_deg"] == pytest.approx(
        nmea.read(flight(3).encode(), "b")["latitude_deg"]
    )


@pytest.mark.parametrize("cut", range(1, 66))
def test_a_half_written_last_sentence_is_counted(cut):
    text = flight(3) + gga("120003", 48.1, 11.5).strip()
    assert len(text) - cut > len(flight(3))
    telemetry = nmea.read(text[:-cut].encode(), "a.log")
    assert codes(telemetry) == {"truncated": 1}
    assert len(telemetry) == 3


def test_coarse_minutes_widen_the_uncertainty():
    lines = [f"GPGGA,12000{i},4806.0{i},N,01130.00,E,1,08,0.5,500.0,M,,M,," for i in range(4)]
    telemetry = nmea.read("".join(map(sentence, lines)).encode(), "a.log")
    assert "coarse_position" in codes(telemetry)
    assert telemetry["horizontal_sigma_m"][0] == pytest.approx(3.2, abs=0.1)


def test_a_moment_twice_and_a_backward_clock():
    text = (
        flight(5)
        + gga("120004", 48.1, 11.5)
        + gga("115900", 48.1, 11.5)
        + gga("120005", 48.1, 11.5)
    )
    telemetry = nmea.read(text.encode(), "a.log")
    assert len(telemetry) == 6
    assert codes(telemetry)["duplicate_time"] == 1
    assert codes(telemetry)["backward_time"] == 1


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_mutated_files_raise_only_input_errors(data):
    valid = bytearray(flight(4).encode())
    for _ in range(data.draw(st.integers(1, 6))):
        place = data.draw(st.integers(0, len(valid) - 1))
        what = data.draw(st.sampled_from(["flip", "cut", "double"]))
        if what == "flip":
            valid[place] = data.draw(st.integers(0, 255))
        elif what == "cut" and len(valid) > 10:
            del valid[place : place + data.draw(st.integers(1, 5))]
        else:
            valid[place:place] = valid[max(0, place - 20) : place]
    try:
        telemetry = nmea.read(bytes(valid), "a.log")
    except InputError:
        return
    assert (np.diff(telemetry.time_ns) > 0).all()


@settings(max_examples=150, deadline=None)
@given(
    body=st.text(st.sampled_from("0123456789.,-NSEWAVeinf "), max_size=80),
    kind=st.sampled_from(["GGA", "RMC"]),
)
def test_sentences_with_a_right_checksum_and_nonsense_fields(body, kind):
    text = sentence(f"GP{kind},{body}") + flight(2)
    telemetry = nmea.read(text.encode(), "a.log")
    assert len(telemetry) >= 2
    assert all(
        np.isfinite(column[~np.isnan(column)]).all() for column in telemetry.columns.values()
    )


@pytest.mark.parametrize("kind", ["GGA", "RMC"])
def test_a_sentence_that_was_cut_after_its_time_states_no_fix(kind):
    telemetry = nmea.read((sentence(f"GP{kind},115959.00") + flight(2)).encode(), "a.log")
    assert len(telemetry) >= 2 and np.isfinite(telemetry.columns["latitude_deg"]).sum() == 2


def test_a_receiver_that_does_not_know_the_time_yet():
    telemetry = nmea.read((sentence("GPGGA,,,,,,0,00,99.9,,,,,,") + flight(2)).encode(), "a.log")
    assert len(telemetry) == 2
    assert codes(telemetry) == {"no_time": 1}


def test_an_intact_sentence_of_nonsense_is_counted():
    nonsense = sentence("GPGGA,120000,48ÿ06.0,N,01130.0,E,1,08,0.9,5,M,,M,,").encode("latin-1")
    assert codes(nmea.read(nonsense + flight(2).encode(), "a.log")) == {"unreadable_line": 1}

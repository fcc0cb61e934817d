"""A live flight that an earlier process had read goes on: numbers, telemetry and photos that were taken."""

from pathlib import Path

import numpy as np
from PIL import Image

from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.capture.live.segments import FlightSoFar, joined_samples, segment_notices
from sorvolo.capture.live.telemetry_log import TelemetryLog
from sorvolo.capture.source import open_sources
from sorvolo.survey.flight import TELEMETRY_COLUMNS, CameraModel, Frame

_LIVE = LiveSettings(keeps_all=True, silent_s=0.1, give_up_s=0.6, first_s=10.0)
_LATITUDE = TELEMETRY_COLUMNS.index("latitude_deg")


def photos(folder: Path, names: str) -> None:
    for name in names:
        Image.effect_noise((64, 48), 60).convert("RGB").save(folder / f"{name}.jpg")


def so_far(camera: CameraModel, **others: object) -> FlightSoFar:
    values: dict = {
        "name": "flight",
        "fingerprint": "f",
        "start_ns": 5,
        "start_origin": "",
        "next_index": 2,
        "last_ns": 10**18,
        "names": frozenset({"a.jpg", "b.jpg"}),
        "times_ns": np.zeros(0, np.int64),
        "samples": np.zeros((0, len(TELEMETRY_COLUMNS))),
    }
    return FlightSoFar(camera=camera, **{**values, **others})


def test_photos_that_were_taken_are_not_taken_again(tmp_path: Path) -> None:
    photos(tmp_path, "ab")
    (first,) = open_sources([f"follow:{tmp_path}"], live=_LIVE)
    taken = [each for each in first.frames(lambda *_: True) if isinstance(each, Frame)]
    assert [each.name for each in taken] == ["a.jpg", "b.jpg"]
    photos(tmp_path, "0c")  # one sorts before those that were taken
    (again,) = open_sources([f"follow:{tmp_path}"], live=_LIVE)
    again.continue_from(so_far(first.camera))  # type: ignore[attr-defined]
    frames = [each for each in again.frames(lambda *_: True) if isinstance(each, Frame)]
    assert [(each.index, each.name) for each in frames] == [(2, "0.jpg"), (3, "c.jpg")]
    assert all(each.time_ns > 10**18 for each in frames)
    assert (again.name, again.fingerprint, again.start_ns) == ("flight", "f", 5)


def test_earlier_telemetry_precedes_what_came_since() -> None:
    log = TelemetryLog("klv", "stream")
    for second in (30, 40, 50):
        log.add(second * 10**9, {"latitude_deg": 46.0 + second, "longitude_deg": 11.0})
    earlier = np.full((2, len(TELEMETRY_COLUMNS)), np.nan)
    earlier[:, _LATITUDE] = 56.0, 66.0
    log.precede(np.array([10, 30]) * 10**9, earlier)
    times_ns, samples = log.samples(0)
    assert (times_ns / 1e9).tolist() == [10, 30, 40, 50]  # one of the same time is left out
    assert samples[:, _LATITUDE].tolist() == [56.0, 66.0, 86.0, 96.0]
    log.add(60 * 10**9, {"latitude_deg": 1.0})
    assert log.version == 5 and len(log.telemetry()) == 5
    assert log.samples(4)[0].tolist() == [60 * 10**9]


def test_what_was_noted_in_parts_is_joined() -> None:
    columns = len(TELEMETRY_COLUMNS)
    times_ns, samples = joined_samples(
        [(np.array([1, 2]), np.ones((2, columns))), (np.array([3]), np.ones(columns))]
    )
    assert times_ns.tolist() == [1, 2, 3] and samples.shape == (3, columns)
    assert joined_samples([])[1].shape == (0, columns)


def test_gaps_are_counted_and_measured() -> None:
    assert segment_notices(()) == ()
    (notice,) = segment_notices((30.0, 12.5))
    assert notice.code == "segments" and notice.count == 3
    assert "42.5 s between them are missing, the longest gap 30.0 s" in notice.text

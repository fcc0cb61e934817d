"""Watches that a station ran, made up: what they leave in their folders."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from sorvolo.station.app import Station
from sorvolo.station.runs import Run
from sorvolo.station.state import utc_now
from sorvolo.store.images import jpeg_from_image

PICTURE = jpeg_from_image(np.full((32, 32, 3), 120, np.uint8))


def watch_run(
    station: Station,
    run: str,
    site: str = "field",
    place: tuple[float, float] = (11.0, 46.0),
    day: str = "2026-05-01",
) -> Path:
    """A watch of a site that found a person, with a picture, and a car, without; the folder of its results."""
    began, ended = "2026-05-01T10:00:00Z", "2026-05-01T10:01:00Z"
    record = Run(run, "watch", site, "finished", "ada", began, ended)
    with station.state.changing() as connection:
        connection.execute(
            "INSERT INTO runs (id, made_at, site, mission, state, record) VALUES (?, ?, ?, 'watch', 'finished', ?)",
            (run, utc_now(), site, json.dumps(asdict(record))),
        )
    results = station.settings.state_folder / "runs" / run / "results"
    (results / "objects").mkdir(parents=True)
    (results / "objects" / "1.jpg").write_bytes(PICTURE)
    common = {
        "score": 0.9,
        "first_seen": f"{day}T10:00:00Z",
        "last_seen": f"{day}T10:00:09Z",
        "path": [1],
    }
    rows = [
        {"id": 1, "class": "person", "crop": "objects/1.jpg"},
        {"id": 2, "class": "car", "crop": None},
    ]
    point = {"type": "Point", "coordinates": list(place)}
    features = [
        {"type": "Feature", "properties": {**row, **common}, "geometry": point} for row in rows
    ]
    (results / "tracks.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "features": features})
    )
    return results

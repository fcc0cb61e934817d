"""What a watch keeps in memory of what it writes."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sorvolo.geometry.geodesy import Geodetic
from sorvolo.missions.watch.files import SeenFrame, WatchFiles
from sorvolo.missions.watch.settings import WatchOutputs
from sorvolo.survey.flight import Frame, Site
from sorvolo.survey.objects import Sighting, no_detections


@pytest.fixture
def files(tmp_path: Path) -> Iterator[WatchFiles]:
    with WatchFiles(
        tmp_path, WatchOutputs(), Site("field", Geodetic(0.0, 0.0), "", 1.0, is_local=True)
    ) as made:
        yield made


def sighting(index: int) -> Sighting:
    box_px = np.array([10.0, 10.0, 40.0, 50.0], np.float32)
    return Sighting(
        index, str(index), index, "car", 0.9, box_px, np.zeros(2), np.eye(2), np.array([4.0, 2.0])
    )


def track(track_id: int, best: Sighting) -> Any:
    return SimpleNamespace(id=track_id, best=best)  # all that its crop depends on


def add(files: WatchFiles, seen: Sighting) -> None:
    frame = Frame(
        seen.frame_index, seen.frame_name, seen.time_ns, np.full((60, 60, 3), 100, np.uint8)
    )
    files.add(
        SeenFrame(frame, seen.time_ns, no_detections(("car",)), [seen], [1], frozenset(), "", 0)
    )


def test_crops_of_views_that_are_no_track_s_best_are_not_kept(files: WatchFiles) -> None:
    """A car that is seen for hours takes one crop of memory, not one for each frame."""
    seen = [sighting(index) for index in range(30)]
    for each in seen:
        add(files, each)
        files.keep_crops_of([track(1, seen[min(each.frame_index, 20)]), track(2, seen[0])])
    assert len(files._crops) == 2
    assert files.crop_of(track(1, seen[20])) == files.crop_names[1]
    assert (
        files.crop_of(track(1, seen[0])) == files.crop_names[1]
    )  # another one's best becomes its own, as they join
    assert (files.folder / files.crop_names[1]).is_file() and files.crop_of(
        track(3, seen[10])
    ) is None

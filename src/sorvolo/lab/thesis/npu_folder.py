"""The NPU Drone-Map dataset's folder (the thesis's Table 4.1): high flights, and the mosaics of Bu et al. of them."""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

from sorvolo.errors import InputError
from sorvolo.lab.thesis.umcd_folder import UmcdVideo, videos_in

ENVIRONMENT = "NPU"
"""Of its videos, beside UMCD's environments."""

_MOSAIC_ENDINGS = frozenset({".tif", ".tiff"})


@dataclass(frozen=True)
class NpuSequence:
    """A sequence's video, and the published mosaic of it: a GeoTIFF, None where there is none."""

    video: UmcdVideo
    mosaic: Path | None


def read_npu_folder(place: Path) -> tuple[NpuSequence, ...]:
    """The sequences in a folder: a video each, in a folder of the sequence's name or under that name itself.

    The mosaic lies in the sequence's folder, or beside the video under its name. Raises InputError for a folder
    without videos.
    """
    if not place.is_dir():
        raise InputError(f"{place}: no such folder; give the folder of the NPU Drone-Map dataset")
    videos = videos_in(place)
    if not videos:
        raise InputError(
            f"{place}: no videos; give the folder of the NPU Drone-Map dataset, a video of each sequence"
        )
    in_folder = Counter(each.video.parent for each in videos)
    found = []
    for each in videos:
        folder = each.video.parent
        is_alone = folder != place and in_folder[folder] == 1
        name = folder.name if is_alone else each.name
        video = replace(each, environment=ENVIRONMENT, name=name, has_telemetry=bool(each.texts))
        found.append(NpuSequence(video, _mosaic(folder, "" if is_alone else each.name)))
    return tuple(found)


def _mosaic(folder: Path, start: str) -> Path | None:
    files = (
        path
        for path in sorted(folder.iterdir())
        if path.suffix.lower() in _MOSAIC_ENDINGS and path.is_file()
    )
    return next((path for path in files if path.stem.lower().startswith(start.lower())), None)

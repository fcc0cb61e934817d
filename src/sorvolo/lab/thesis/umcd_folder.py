"""The UMCD dataset's folder (the thesis's chapter 2): which videos it has, and which files belong to each."""

import re
from dataclasses import dataclass, replace
from pathlib import Path

from sorvolo.errors import InputError
from sorvolo.lab.datasets.umcd import looks_like_umcd
from sorvolo.lab.evaluation.mask_folders import has_masks

WITH, WITHOUT = "Videos With Telemetry", "Videos Without Telemetry"
MOSAICKING, CHANGES = "Mosaicking", "Change Detection"
CALIBRATION, BENCHMARK = "Camera Calibration", "Benchmark Mosaics"
"""The names of the folders, as the thesis writes them; read in any case, with any separators."""

MASKS_ENDING = "_masks"
"""Of the folder beside a video that holds its change masks, one a frame. The dataset has none: they are added."""

PICTURE_ENDINGS = frozenset({".tif", ".tiff", ".png", ".jpg", ".jpeg"})
"""Of published mosaics."""

_VIDEO_ENDINGS = frozenset({".mp4", ".mov", ".avi", ".mkv", ".m4v"})
_TEXT_ENDINGS = frozenset({".txt", ".csv", ".log", ".nmea", ".srt", ".gpx", ".tsv", ".gps", ".dat"})
_SECOND_SET = re.compile(r"(.+?)_\d+")
_REST = re.compile(r"(?:[-_. ](?!\d).*)?")  # path4_1 is another video than path4


@dataclass(frozen=True)
class UmcdVideo:
    """One video. `texts` lie beside it under its name and are no metadata; `masks` is a folder of change masks.

    `has_telemetry`: the dataset has its telemetry, so that one of the texts has to be that.
    """

    environment: str  # its folder's name, as written there
    name: str
    video: Path
    texts: tuple[Path, ...] = ()
    metadata: Path | None = None
    masks: Path | None = None
    has_telemetry: bool = True

    @property
    def key(self) -> str:
        """The environment and the name, in small letters: unique within a list of videos."""
        return f"{self.environment}/{self.name}".lower()


@dataclass(frozen=True)
class UmcdFolder:
    """A dataset's videos by the part they lie in, and its camera file."""

    place: Path
    without_telemetry: tuple[UmcdVideo, ...]
    mosaicking: tuple[UmcdVideo, ...]
    change_detection: tuple[UmcdVideo, ...]
    camera: Path | None
    benchmarks: Path | None = None

    def benchmark_of(self, video: UmcdVideo) -> Path | None:
        """The published mosaic of a mosaicking video (thesis 2.4): a picture of its name below its environment's.

        Of several, the one below a folder "...without..." is that of a video without telemetry. None where it is not
        known for sure.
        """
        below = sorted(self.benchmarks.rglob("*")) if self.benchmarks is not None else []
        found = {}
        for path in below:
            folders = _letters("/".join(path.parts[len(self.place.parts) : -1]), "/")
            if (
                path.suffix.lower() in PICTURE_ENDINGS
                and path.stem.lower() == video.name.lower()
                and _letters(video.environment) in folders.split("/")
                and "/change" not in folders
            ):
                found[path] = "without" in folders
        if len(found) > 1:
            found = {path: bare for path, bare in found.items() if bare != video.has_telemetry}
        return next(iter(found)) if len(found) == 1 else None

    def mosaic_of(self, later: UmcdVideo) -> UmcdVideo | None:
        """The mosaicking video of the path that a change detection video flew: path4 of path4_1 (thesis 2.2)."""
        by_key = {each.key: each for each in self.mosaicking}
        second = _SECOND_SET.fullmatch(later.name)
        shorter = f"{later.environment}/{second[1]}".lower() if second else ""
        return by_key.get(later.key) or by_key.get(shorter)


def read_umcd_folder(place: Path) -> UmcdFolder:
    """Find the videos of a dataset in the thesis's layout; raises InputError for a folder that has none of its parts.

    A part that is not there leaves its list empty.
    """
    if not place.is_dir():
        raise InputError(f"{place}: no such folder; give the folder of the UMCD dataset")
    parts = {name: _folder(place, name) for name in (WITHOUT, WITH, CALIBRATION, BENCHMARK)}
    mosaicking, changes = (_folder(parts[WITH], name) for name in (MOSAICKING, CHANGES))
    bare = _folder(parts[WITHOUT], MOSAICKING) or parts[WITHOUT]
    maps, later = videos_in(mosaicking), videos_in(changes)
    videos = tuple(replace(each, has_telemetry=False) for each in videos_in(bare))
    if not (videos or maps or later):
        raise InputError(
            f"{place}: not the UMCD dataset: no videos in '{WITHOUT}', nor in '{MOSAICKING}' or '{CHANGES}' of "
            f"'{WITH}' (thesis, chapter 2); give the folder that holds these"
        )
    calibration = parts[CALIBRATION]
    files = sorted(calibration.iterdir()) if calibration is not None else []
    cameras = (each for each in files if each.suffix.lower() in (".xml", ".yml", ".yaml"))
    return UmcdFolder(place, videos, maps, later, next(cameras, None), parts[BENCHMARK])


def videos_in(part: Path | None) -> tuple[UmcdVideo, ...]:
    """All videos in a folder and below it, with the files that belong to each; none of None."""
    if part is None:
        return ()
    found = sorted(
        path for path in part.rglob("*") if path.suffix.lower() in _VIDEO_ENDINGS and path.is_file()
    )
    return tuple(_video(path, part) for path in found)


def _folder(place: Path | None, name: str) -> Path | None:
    """The folder of this name, whatever its case and separators."""
    if place is None:
        return None
    folders = (each for each in sorted(place.iterdir()) if each.is_dir())
    return next((each for each in folders if _letters(each.name) == _letters(name)), None)


def _letters(name: str, kept: str = "") -> str:
    return re.sub(f"[^a-z0-9{kept}]", "", name.lower())


def _video(path: Path, part: Path) -> UmcdVideo:
    beside = [each for each in sorted(path.parent.iterdir()) if _belongs(each, path)]
    texts = [each for each in beside if each.suffix.lower() in _TEXT_ENDINGS and each.is_file()]
    metadata = next(
        (each for each in texts if each.suffix.lower() == ".txt" and looks_like_umcd(each)), None
    )
    masks = (
        each for each in beside if each.name.lower().endswith(MASKS_ENDING) and has_masks(each)
    )
    return UmcdVideo(
        path.parent.name if path.parent != part else "",
        path.stem,
        path,
        tuple(each for each in texts if each != metadata),
        metadata,
        next(masks, None),
    )


def _belongs(other: Path, video: Path) -> bool:
    """Whether a file or folder has the video's name, alone or with more behind it: path1.csv, path1_masks."""
    stem, name = video.stem.lower(), other.stem.lower() if other.is_file() else other.name.lower()
    return (
        other != video and name.startswith(stem) and _REST.fullmatch(name[len(stem) :]) is not None
    )

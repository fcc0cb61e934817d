"""Chapter 4 of the thesis from a dataset's folder to its tables, one row after another (`sorvolo reproduce`)."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal

from sorvolo.build import build
from sorvolo.errors import GeometryError, InputError, StoreError
from sorvolo.lab.thesis import comparisons, detectors, mosaics
from sorvolo.lab.thesis.npu_folder import ENVIRONMENT, read_npu_folder
from sorvolo.lab.thesis.published import VIDEOS
from sorvolo.lab.thesis.rows import Row, RowStore
from sorvolo.lab.thesis.settings import (
    BENCHMARK,
    COMPARISONS,
    MAP_METHODS,
    PUBLISHED,
    ReproductionSettings,
)
from sorvolo.lab.thesis.umcd_folder import UmcdFolder, UmcdVideo, read_umcd_folder
from sorvolo.lab.thesis.video_input import VideoInput, video_input
from sorvolo.store.site.journal import content_sha256

_Made = tuple[Mapping[str, Any], Mapping[str, bytes]]
"""A row's values, and its pictures as JPEGs by what they show."""


@dataclass(frozen=True)
class ReproductionUpdate:
    """A row that is done, was known from an earlier run, or is `missing`; `done` of `total` rows."""

    row: Row
    is_known: bool
    done: int
    total: int


@dataclass(frozen=True)
class _Task:
    """A row to be made: of which files, by what; or why it cannot be."""

    id: str
    kind: str
    files: tuple[Path, ...] = ()
    make: Callable[[], _Made] | None = None
    missing: str = ""


def reproduce(
    place: Path,
    out: Path,
    settings: ReproductionSettings,
    *,
    okutama: Path | None = None,
    npu: Path | None = None,
    is_whole: bool = True,
) -> Iterator[ReproductionUpdate]:
    """Do the experiments of chapter 4 on the dataset in `place`, yielding each row of the tables as it is there.

    `okutama` and `npu` are the folders of the other two datasets. Rows, pictures and maps are left in `out`; a row that
    an earlier run made of the same files and settings is taken from there. What cannot be used costs its rows alone,
    which come back `missing` with the reason. With `is_whole` the videos of Tables 2.1, 2.3 and 2.4 that are not there
    are such rows, too. Raises InputError for a folder that is no such dataset, StoreError on a full disk, SettingsError
    for options.
    """
    work = _Work(read_umcd_folder(place), out, settings)
    tasks = [
        *(work.absent() if is_whole else ()),
        *work.mosaic_tasks(),
        *work.npu_tasks(npu),
        *work.change_tasks(),
        *work.detector_tasks(okutama),
    ]
    for number, task in enumerate(tasks, start=1):
        row, is_known = work.done(task)
        yield ReproductionUpdate(row, is_known, number, len(tasks))


class _Work:
    """One run over a dataset: which rows it has, and how each is made."""

    def __init__(self, dataset: UmcdFolder, out: Path, settings: ReproductionSettings) -> None:
        self._dataset, self._out, self._settings = dataset, out, settings
        self._rows = RowStore(out)
        self._input = cache(self._look_into)
        self._unmapped: dict[Path, str] = {}  # sites of maps that could not be made, and why
        self._placed: dict[str, str] = {}  # by video: metadata with places of a comparison
        self._places: str | None = None  # whose places the frames have that were extracted

    def done(self, task: _Task) -> tuple[Row, bool]:
        """The task's row, and whether an earlier run made it."""
        row = Row(task.id, task.kind, missing=task.missing)
        if task.make is None:
            return row, False
        try:
            stamp = self._stamp(task)
            known = self._rows.find(task.id, stamp)
            if known is None:
                values, pictures = task.make()
                named = {
                    name: self._rows.add_picture(f"{task.id}-{name}", jpeg)
                    for name, jpeg in pictures.items()
                }
                row = self._rows.put(Row(task.id, task.kind, values, named), stamp)
        except (InputError, GeometryError, StoreError) as error:
            return Row(task.id, task.kind, missing=f"{error}"), False
        row = known or row
        if row.values.get("method") == "robust" and row.values["labels"]:
            self._placed[row.values["sequence"]] = row.values["labels"][0]
        return row, known is not None

    def absent(self) -> Iterator[_Task]:
        """The videos of the thesis's tables that the folder lacks."""
        folder = self._dataset
        lists = folder.without_telemetry, folder.mosaicking, folder.change_detection
        for (part, wanted), found in zip(VIDEOS.items(), lists):
            there = {_plain(each.key) for each in found}
            for environment, names in wanted.items():
                for name in names[: self._settings.videos]:
                    if _plain(f"{environment}/{name}") not in there:
                        where = f"{part}/{environment}/{name}.mp4"
                        reason = f"{where} is not in {folder.place}"
                        yield _Task(f"video/{where}", "video", missing=reason)

    def mosaic_tasks(self) -> Iterator[_Task]:
        """Section 4.1: Table 4.1 and its text, Figures 3.12 and 4.1 to 4.3."""
        first = None
        for each in self._chosen(self._dataset.mosaicking):
            yield from self._tasks_of_map(each)
            yield self._task(
                "correlation", each.key, (each,), partial(self._correlate, each, "thesis")
            )
            yield from self._benchmark_tasks(each)
            first = first or each
        if first is not None:
            for transform in ("similarity", "homography"):
                make = partial(self._transform, first, transform)
                yield self._task("transform", f"{first.key}/{transform}", (first,), make)
            yield self._task("example", first.key, (first,), partial(self._example, first))
        for each in self._chosen(self._dataset.without_telemetry):
            yield from self._tasks_of_map(each)
            yield from self._benchmark_tasks(each)

    def npu_tasks(self, place: Path | None) -> Iterator[_Task]:
        """Table 4.1 on its own dataset, and the correlation with the mosaics of Bu et al."""
        mosaics_of = read_npu_folder(place) if place is not None else {}
        for video in self._chosen([*mosaics_of]):
            yield from self._tasks_of_map(video)
            yield from self._published_tasks(
                PUBLISHED, video.key, video, mosaics_of[video], "mosaic of Bu et al. beside it"
            )

    def _published_tasks(
        self, kind: str, name: str, video: UmcdVideo, mosaic: Path | None, wanted: str
    ) -> Iterator[_Task]:
        """Eq. 4.1 of each method's map and a published mosaic."""
        for method in MAP_METHODS:
            row_id = f"{kind}/{name}/{method}"
            if mosaic is None:
                yield _Task(row_id, kind, missing=f"{video.video}: no {wanted}")
            else:
                make = partial(self._correlate, video, method, mosaic)
                yield _Task(row_id, kind, (*_files_of(video), mosaic), make)

    def _benchmark_tasks(self, video: UmcdVideo) -> Iterator[_Task]:
        """Section 2.4, where the dataset has the folder."""
        if self._dataset.benchmarks is not None:
            mosaic = self._dataset.benchmark_of(video)
            name = f"{'with' if video.has_telemetry else 'without'}/{video.key}"
            yield from self._published_tasks(
                BENCHMARK, name, video, mosaic, f"mosaic of it in {self._dataset.benchmarks}"
            )

    def change_tasks(self) -> Iterator[_Task]:
        """Section 4.2: Tables 4.3 to 4.5, the times, Figures 4.4 and 4.5."""
        timed: list[_Task] = []
        for later in self._chosen(self._dataset.change_detection):
            first = self._dataset.mosaic_of(later)
            for title in COMPARISONS:
                row_id = f"{later.key}/{title}"
                if first is None:
                    reason = f"{later.video}: no mosaicking video of its path, so there is no map to compare it with"
                    yield _Task(f"comparison/{row_id}", "comparison", missing=reason)
                else:
                    make = partial(self._compare, first, later, title)
                    yield self._task("comparison", row_id, (first, later), make)
            if first is not None:
                make = partial(self._time, first, later)
                timed.append(self._task("seconds", later.key, (first, later), make))
        yield from timed[:1]

    def detector_tasks(self, okutama: Path | None) -> Iterator[_Task]:
        """Section 4.3: Table 4.6 and Figure 4.6."""
        videos = self._chosen(self._dataset.change_detection)
        models = ("standard", "extended") if self._settings.training else ()
        for model in (*models, "packaged"):
            yield self._task(
                "detector", f"UMCD/{model}", videos, partial(self._detect, videos, model)
            )
        if okutama is not None:
            for model in (*models, "packaged"):
                make = partial(self._measured, detectors.okutama_labels(okutama), model)
                yield _Task(f"detector/Okutama/{model}", "detector", (okutama,), make)

    def _chosen(self, videos: Sequence[UmcdVideo]) -> list[UmcdVideo]:
        """At most this many of each environment."""
        chosen: dict[str, list[UmcdVideo]] = {}
        for each in videos:
            chosen.setdefault(each.environment.lower(), []).append(each)
        return [each for group in chosen.values() for each in group[: self._settings.videos]]

    def _tasks_of_map(self, each: UmcdVideo) -> Iterator[_Task]:
        for method in MAP_METHODS:
            row_id = f"{'with' if each.has_telemetry else 'without'}/{each.key}/{method}"
            yield self._task("mosaic", row_id, (each,), partial(self._map, each, method))

    def _task(
        self, kind: str, row_id: str, videos: Sequence[UmcdVideo], make: Callable[[], _Made]
    ) -> _Task:
        files = tuple(path for each in videos for path in _files_of(each))
        camera = (self._dataset.camera,) if self._dataset.camera else ()
        return _Task(f"{kind}/{row_id}", kind, (*files, *camera), make)

    def _stamp(self, task: _Task) -> str:
        try:
            files = [
                (path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in task.files
            ]
        except OSError as error:
            raise InputError(f"{error.filename}: cannot be read ({error.strerror})") from error
        wanted = self._settings
        of_kind = {
            "comparison": wanted.views_per_second,
            "seconds": wanted.repeats,
            "detector": (wanted.training, wanted.views_per_second, wanted.seed),
        }
        return content_sha256(build(), task.id, files, of_kind.get(task.kind))

    def _look_into(self, each: UmcdVideo) -> VideoInput:
        # another drone flew those
        camera = None if each.environment == ENVIRONMENT else self._dataset.camera
        return video_input(each, camera, self._site(each, "photos"))

    def _site(self, each: UmcdVideo, name: str) -> Path:
        return self._out / "sites" / each.key.replace("/", "-") / name

    def _map_site(self, each: UmcdVideo, method: str) -> Path:
        return self._site(each, method if each.has_telemetry else f"bare-{method}")

    def _mapped(self, each: UmcdVideo, method: str) -> Path:
        """The site of a flight's map, made where it is not there; a killed run's unfinished one is made anew."""
        site = self._map_site(each, method)
        if site in self._unmapped:
            raise InputError(f"the map of {each.key} could not be made: {self._unmapped[site]}")
        if not (site / "mosaic.tif").is_file():
            self._map(each, method)
        return site

    def _map(self, each: UmcdVideo, method: str) -> _Made:
        site = self._map_site(each, method)
        try:
            values = mosaics.map_video(self._input(each), site, method)
        except (InputError, GeometryError, StoreError) as error:
            self._unmapped[site] = f"{error}"
            raise
        return {
            "sequence": each.key,
            "environment": each.environment,
            "has_telemetry": each.has_telemetry,
            "method": method,
            **values,
        }, {"map": mosaics.map_jpeg(site)}

    def _correlate(self, each: UmcdVideo, method: str, mosaic: Path | None = None) -> _Made:
        """Eq. 4.1 of a method's map with a published mosaic, without one with the map by planar."""
        site = self._mapped(each, method)
        other = mosaic or self._mapped(each, "planar") / "mosaic.tif"
        measured = mosaics.correlation_of(site, other)
        return {"sequence": each.key, "method": method, **measured}, {}

    def _transform(self, each: UmcdVideo, transform: mosaics.Transform) -> _Made:
        if transform == "similarity":
            site = self._mapped(each, "thesis")
        else:
            site = self._site(each, "homography")
            mosaics.map_video(self._input(each), site, "thesis", transform)
        measured = {"sequence": each.key, "transform": transform, **mosaics.distortion_of(site)}
        return measured, {"map": mosaics.map_jpeg(site)}

    def _example(self, each: UmcdVideo) -> _Made:
        return {"sequence": each.key}, mosaics.example_jpegs(self._mapped(each, "thesis"))

    def _compare(self, first: UmcdVideo, later: UmcdVideo, title: str) -> _Made:
        values, pictures = comparisons.compare_video(
            self._input(later),
            self._mapped(first, "planar"),
            self._out / "sites" / "compared",
            title,
            later,
            self._settings.views_per_second,
        )
        return {"sequence": later.key, "method": title, **values}, pictures

    def _time(self, first: UmcdVideo, later: UmcdVideo) -> _Made:
        # it needs none
        before, after = (self._input(replace(each, has_telemetry=False)) for each in (first, later))
        return {
            "sequence": later.key,
            **comparisons.time_comparison(before, after, self._settings.repeats),
        }, {}

    def _detect(self, videos: Sequence[UmcdVideo], model: str) -> _Made:
        frames = self._out / "frames"
        if self._places is None:
            self._places = detectors.extract_frames(
                videos, frames, self._settings.views_per_second, self._placed
            )
        return self._measured(detectors.Labels("UMCD", frames, "umcd"), model, self._places)

    def _measured(self, labels: detectors.Labels, model: str, places: str = "") -> _Made:
        """Train the model, unless it is the packaged one, measure it on what is held out, and show it at work."""
        wanted, seed = self._settings.training, self._settings.seed
        tested = detectors.held_out(labels, seed)
        file, trained = "default", {}
        if wanted and model != "packaged":
            out = self._out / "models" / f"{labels.form}-{model}"
            stem: Literal["standard", "extended"] = (
                "extended" if model == "extended" else "standard"
            )
            file = detectors.train_network(labels, out, replace(wanted, rpn=stem, seed=seed))
            trained = {"steps": wanted.steps, "side_px": wanted.side_px}
        values = {
            "dataset": labels.name,
            "model": model,
            "split": labels.split + places,
            **trained,
            **detectors.measure_model(file, tested),
        }
        shown = (
            detectors.example_pictures(file, tested) if model == "extended" or not wanted else []
        )
        return values, {str(number): jpeg for number, jpeg in enumerate(shown, start=1)}


def _files_of(each: UmcdVideo) -> list[Path]:
    masks = sorted(each.masks.iterdir()) if each.masks is not None else []
    return [each.video, *each.texts, *([each.metadata] if each.metadata else []), *masks]


def _plain(key: str) -> str:
    """A key whose numbers have no leading zeros, in small letters: path01 is path1."""
    return re.sub(r"(?<!\d)0+(?=\d)", "", key.lower())

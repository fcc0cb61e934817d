"""Section 4.2: change detection videos against the maps of their paths, counted by frame and by pixel, and timed."""

import json
import os
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from timeit import repeat
from typing import Any

from sorvolo.capture.source import open_sources
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.lab.datasets.umcd import UmcdMetadata, read_umcd_metadata
from sorvolo.lab.evaluation.change_metrics import Counts
from sorvolo.lab.evaluation.frame_rows import map_frames
from sorvolo.lab.evaluation.map_quality import MapDeviation
from sorvolo.lab.evaluation.mask_folders import (
    ComparedMask,
    compared_masks,
    frames_against_times,
    read_mask,
)
from sorvolo.lab.thesis.changes import compare_thesis
from sorvolo.lab.thesis.published import APPEARANCES
from sorvolo.lab.thesis.settings import COMPARISONS, FIGURE_PX
from sorvolo.lab.thesis.umcd_folder import UmcdVideo
from sorvolo.lab.thesis.umcd_writing import placed_metadata
from sorvolo.lab.thesis.video_input import VideoInput
from sorvolo.missions.compare.flights import compare_flights
from sorvolo.missions.flight.settings import CompareSettings
from sorvolo.store.atomic import writing
from sorvolo.store.exports.annotated import with_outlines
from sorvolo.store.exports.change_files import BOXES_FILE
from sorvolo.store.exports.plain import rounded
from sorvolo.store.images import jpeg_from_image
from sorvolo.store.site.archive import Archive
from sorvolo.survey.flight import Frame

MASKS, TIMES, TABLE = "change masks", "times of appearance", "times of Table 2.4"
"""What a comparison is judged by: pixels and frames, or frames alone, by the metadata or by the thesis."""

_LENGTH_S = 1.5  # a video's length may differ from Table 2.4's, which has whole seconds


def compare_video(
    later: VideoInput,
    site: Path,
    scratch: Path,
    title: str,
    truth: UmcdVideo,
    views_per_second: float,
) -> tuple[dict[str, Any], dict[str, bytes]]:
    """A row of Tables 4.3 to 4.5, and pictures of Figures 4.4 and 4.5: the map beside the frame, as JPEGs.

    The map stays as it is: a copy in `scratch` is compared with. Raises InputError and StoreError as `compare_flights`,
    InputError where nothing states which frames show a change.
    """
    times = _times_of(truth, later)
    with writing(scratch):
        shutil.rmtree(scratch, ignore_errors=True)
        shutil.copytree(site, scratch)
    settings = CompareSettings(
        COMPARISONS[title],
        model="none",
        writes_masks=True,
        updates_map=False,
        views_per_second=views_per_second,
    )
    started_cpu_s = time.process_time()
    updates = list(compare_flights([later.video], scratch, settings, **later.options))
    cpu_s = time.process_time() - started_cpu_s
    (masks,) = (scratch / "flights").glob("*/masks")
    judged_by, judged = _judged(masks, truth, times, later.fps)
    boxes = json.loads((masks / BOXES_FILE).read_bytes())
    values = {
        "judged_by": judged_by,
        "views": updates[-1].views,
        "compared": updates[-1].compared,
        "cpu_seconds_per_view": cpu_s / max(1, updates[-1].views),
        "frames": asdict(sum((each.frame for each in judged), Counts())),
        "pixels": asdict(sum((each.pixels for each in judged), Counts())),
        "labels": [
            placed_metadata(each, each.fps or later.fps, boxes)
            for each in times.values()
            if each.has_times
        ][:1],
    }
    pictures = _examples(judged, later, scratch, masks.parent.name)
    with writing(scratch):
        shutil.rmtree(scratch, ignore_errors=True)
    return values, pictures


def time_comparison(first: VideoInput, later: VideoInput, repeats: int) -> dict[str, Any]:
    """Section 4.2.2: the fastest of `repeats` comparisons of two frames, s, with one thread and with one for each core.

    The frames are the middle ones of both videos, not aligned: what the time depends on is their size.
    """
    before, after = (_middle(each) for each in (first, later))
    if before.shape != after.shape:
        raise InputError(
            f"{first.video} and {later.video} differ in size; give videos of one camera"
        )
    cores = os.cpu_count() or 1

    def seconds(threads: int) -> float:
        timed = partial(compare_thesis, before, after, threads=threads)
        return min(repeat(timed, repeat=repeats, number=1))

    return {
        "single_thread_s": seconds(1),
        "multithread_s": seconds(cores),
        "threads": cores,
        "repeats": repeats,
        "width_px": before.shape[1],
        "height_px": before.shape[0],
    }


def rates(counts: Counts) -> dict[str, float | None]:
    """The rates of section 4.2.1; None where nothing was to divide by, all but the accuracy where nothing was there."""
    return {
        name: rounded(getattr(counts, name), 4)
        if counts.tp + counts.fn or name == "accuracy"
        else None
        for name in ("precision", "recall", "accuracy", "f1")
    }


def _times_of(truth: UmcdVideo, later: VideoInput) -> dict[str, UmcdMetadata]:
    """When objects are in view, by what states it, the metadata first.

    Raises InputError where there are no change masks either.
    """
    found = {} if truth.metadata is None else {TIMES: read_umcd_metadata(truth.metadata)}
    length_s, in_view_s = APPEARANCES.get(truth.key, (0, ()))
    if abs(later.length_s - length_s) <= _LENGTH_S:
        names = found[TIMES].names if found else ()
        found[TABLE] = UmcdMetadata(later.fps, in_view_s, frozenset(), names)
    if truth.masks is None and not found:
        raise InputError(
            f"{truth.video}: neither a folder of change masks ({truth.name}_masks) nor a metadata file lies beside it, "
            f"and no video of its name and length ({later.length_s:.0f} s) is in the thesis's Table 2.4, so what it "
            "shows cannot be judged"
        )
    return found


def _judged(
    masks: Path, truth: UmcdVideo, times: Mapping[str, UmcdMetadata], fps: float
) -> tuple[str, Sequence[ComparedMask]]:
    if truth.masks is not None:
        return MASKS, list(compared_masks(masks, truth.masks))
    for judged_by, stated in times.items():
        rate_hz = stated.fps or fps
        judged = list(
            frames_against_times(
                masks,
                lambda index, at=stated, hz=rate_hz: at.shows_object(index / hz),  # type: ignore[misc]
            )
        )
        if any(each.frame != Counts(unknown=1) for each in judged):
            return judged_by, judged
    raise InputError(
        f"{truth.metadata or truth.video}: states for no compared frame whether an object is in view "
        f"(Appearance: 09 to 18), and there are no change masks ({truth.name}_masks)"
    )


def _examples(
    judged: Sequence[ComparedMask], later: VideoInput, site: Path, flight: str
) -> dict[str, bytes]:
    """The best found change, and the largest false one: the map under the frame, and the frame with the outlines."""
    # the view with the most true pixels, and the one without a change that has the most false ones, if any
    found = [each for each in judged if each.frame.tp]
    false = [each for each in judged if each.frame.fp]
    wanted = {}
    if found:
        wanted["found"] = max(found, key=lambda each: (each.pixels.tp, -each.pixels.fp))
    if false:
        wanted["false"] = max(false, key=lambda each: each.pixels.fp)
    frames = _frames(later, {int(each.name) for each in wanted.values()})
    with Archive.open(site, write=False) as archive:
        rows = {row.name: row for row in map_frames(site, archive.site())[flight]}
        under = MapDeviation(archive.tiles(), archive.site_grid())
        shown = {}
        for name, each in wanted.items():
            row, image = rows.get(each.name), frames.get(int(each.name))
            if row is not None and row.has_outline and image is not None:
                changed, _ = read_mask(each.path, may_be_unknown=True)
                ground = under.under(row.outline_m, *image.shape[1::-1])
                shown[f"{name}-map"] = jpeg_from_image(ground, FIGURE_PX)
                shown[f"{name}-frame"] = jpeg_from_image(with_outlines(image, changed), FIGURE_PX)
        return shown


def _frames(flight: VideoInput, wanted: set[int]) -> dict[int, ImageRGB]:
    if not wanted:
        return {}
    (source,) = open_sources([flight.video], **flight.options)
    last, found = max(wanted), {}
    for each in source.frames(lambda index, _: index in wanted):
        if isinstance(each, Frame):
            found[each.index] = each.image
        if each.index >= last:
            break
    return found


def _middle(flight: VideoInput) -> ImageRGB:
    (source,) = open_sources([flight.video], **flight.options)
    middle = max(0, source.frame_count // 2)
    found = _frames(flight, {middle}) or _frames(flight, {0})
    if not found:
        raise InputError(f"{flight.video}: neither its middle nor its first frame can be read")
    return next(iter(found.values()))

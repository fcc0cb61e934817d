"""The thesis's chapter 4 beside ours, as one page of HTML that needs no other file, no network and no script."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from sorvolo.lab.thesis.sheets import Sheet
from sorvolo.paths import Json, JsonView
from sorvolo.store.pages.plots import Bar, bar_plot, colour_class
from sorvolo.store.pages.words import jpeg_uri, render

_SIZE_PX = 720.0, 260.0
_RATE_WORDS = {"precision": "precision", "recall": "recall", "f1": "F1"}
_GRAY_LEVELS = 256
_SHOWN = 6  # pictures of a figure

Picture = Callable[[str], bytes]
"""A row's picture by its file's name, as a JPEG."""


def reproduction_page(document: JsonView, sheets: Sequence[Sheet], picture: Picture) -> str:
    """reproduction.html of reproduction.json's content and its sheets. All text is escaped."""
    tables, rows, missing = document["tables"], document["rows"], document["missing"]
    lost = f"; {len(missing)} could not be made" if missing else ""
    pictures: dict[str, list[tuple[str, str]]] = {
        name: []
        for name in ("transforms", "example", "maps", "flat", "urban", "false", "found", "detected")
    }
    for row in rows:
        for name, words, file in _shown_of(row):
            if len(pictures[name]) < _SHOWN:
                pictures[name].append((words, jpeg_uri(picture(file))))
    page = render(
        "reproduction.html",
        package=__package__,
        title="The thesis's chapter 4",
        dataset=document["dataset"],
        size=document["size"],
        headline=f"{len(rows)} rows of the thesis's tables and figures{lost}",
        missing=[(each["id"], each["reason"]) for each in missing],
        facts_rows=[(name, str(value)) for name, value in document["made"].items()],
        sheets={each.name: each for each in sheets},
        figures=document["figures"],
        plots={
            "histogram": _histogram(rows),
            "frames": _rates("Frames", tables["tables_4_3_and_4_4"]),
            "pixels": _rates("Pixels", tables["table_4_5"]),
        },
        pictures=pictures,
    )
    return str(page)


def _rates(title: str, table: JsonView) -> Json:
    """Bars of precision, recall and F1 by method, the printed ones first."""
    published = table["published"]
    printed = published if isinstance(published, Mapping) else published[-1]
    shown = {
        "thesis, printed": printed,
        **{f"{each['method']}, here": each for each in table["ours"]},
    }
    return _bars(
        f"{title}: printed and here",
        {
            word: {name: each[rate] for name, each in shown.items()}
            for rate, word in _RATE_WORDS.items()
        },
    )


def _histogram(rows: Iterable[JsonView]) -> Json | None:
    """The mean histogram of the deviation of frames and maps, by method (section 4.1.1)."""
    found: dict[str, list[Any]] = {}
    for row in rows:
        if row["kind"] == "mosaic" and row["values"]["deviation"] is not None:
            found.setdefault(row["values"]["method"], []).append(row["values"]["histogram"])
    if not found:
        return None
    means = {
        f"{name}, here": np.mean(histograms, axis=0).reshape(8, -1).sum(axis=1)
        for name, histograms in found.items()
    }
    width = _GRAY_LEVELS // len(next(iter(means.values())))
    shares = zip(*(mean.tolist() for mean in means.values()))
    groups = {f"{k * width}": dict(zip(means, each)) for k, each in enumerate(shares)}
    return _bars("Pixels of the frames by their gray levels' difference from the map", groups)


def _bars(title: str, groups: Mapping[str, Mapping[str, float | None]]) -> Json:
    """A plot of shares by group and by name, with a key of the names."""
    names = list(next(iter(groups.values())))
    bars = [
        (
            group,
            [
                Bar(colour_class(names.index(name)), share, f"{name}: {100 * share:.1f} %")
                for name, share in shares.items()
                if share is not None
            ],
        )
        for group, shares in groups.items()
    ]
    return {
        "drawing": bar_plot(title, bars, *_SIZE_PX),
        "keys": [(colour_class(place), name) for place, name in enumerate(names)],
    }


def _shown_of(row: JsonView) -> Iterator[tuple[str, str, str]]:
    """Which figure each of a row's pictures belongs to, with its words."""
    kind, values = row["kind"], row["values"]
    for name, file in row["pictures"].items():
        if kind == "transform":
            rigid = values["transform"] == "similarity"
            yield "transforms", "rigid transform" if rigid else "homography", file
        elif kind == "example":
            yield "example", name, file
        elif kind == "detector":
            yield "detected", f"{values['dataset']}, {values['model']}", file
        elif kind == "mosaic":
            words = f"{values['sequence']}, {values['method']}"
            yield "maps", words, file
            if values["method"] == "thesis":
                yield "urban" if values["environment"].lower() == "urban" else "flat", words, file
        elif values["method"] in ("thesis", "robust"):  # the other variants are figures of nothing
            figure, _, side = name.partition("-")
            yield figure, f"{values['sequence']}, {values['method']}: {side}", file

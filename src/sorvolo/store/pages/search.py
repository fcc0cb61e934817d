"""What a search would have found, and what is under trees, as pages of HTML that need no other file, no network and no script."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sorvolo.geometry.arrays import ImageRGBA
from sorvolo.store.pages.plots import colour_class, stated_and_found
from sorvolo.store.pages.words import (
    area_words,
    at,
    jpeg_uri,
    known,
    picture_uri,
    render,
    seconds_words,
)


def search_page(report: Mapping[str, Any], pictures: Mapping[str, ImageRGBA]) -> str:
    """search.html of search.json's content; `pictures` are the maps of the classes' probabilities. Text is escaped."""
    # what is stated, and what was found
    rows = [
        (
            f"{name}, {label}",
            float(each["stated"]),
            float(each["found"]),
            float(each["found_low"]),
            float(each["found_high"]),
            int(each["count"]),
        )
        for name, label, each in _calibrated(report)
    ]
    names = list(dict.fromkeys(name for name, *_ in rows))
    page = render(
        "search.html",
        report,
        title=f"{known(report['site'])} - what the search would have found",
        notices=[*report["warnings"], *(known(at(each, "text")) for each in report["notices"])],
        maps=[(label, picture_uri(picture)) for label, picture in pictures.items()],
        holes=[
            [label, reason, area_words(area_m2), f"{area_m2 / row['area_m2']:.0%}"]
            for label, row in report["classes"].items()
            for reason, area_m2 in row["holes_m2"].items()
        ],
        segments=[
            [
                known(each["name"]),
                *(f"{each[key]:.2f}" for key in ("poa", "pod", "pos", "left")),
                area_words(each["area_m2"]),
            ]
            for each in report["segments"]
        ],
        plants=[
            [
                known(flight["name"]),
                label,
                str(row["planted"]),
                str(row["found"]),
                "{:.2f} to {:.2f}".format(*row["interval"]),
                str(flight["frames"]),
                seconds_words(flight["seconds"]),
            ]
            for flight in report["flights"]
            for label, row in flight["classes"].items()
        ],
        calibration=_calibration(report),
        calibration_plot={
            "drawing": stated_and_found(rows),
            "legend": [(colour_class(k), name) for k, name in enumerate(names)],
        },
    )
    return str(page)


def waiting_page(*, is_over: bool) -> str:
    """search.html of a flight of which nothing was measured yet: it loads itself anew, until the flight is over."""
    return str(
        render("search_waiting.html", title="What a search would have found", is_over=is_over)
    )


def under_trees_page(report: Mapping[str, Any], floor: ImageRGBA, crops: Sequence[bytes]) -> str:
    """under_trees.html of under_trees.json's content, the floor's picture and a JPEG of each find. Text is escaped."""
    page = render(
        "under_trees.html",
        report,
        title=f"{report['flight']} - under the trees",
        floor=picture_uri(floor),
        rows=[
            [
                str(number),
                f"{row['latitude_deg']:.6f}, {row['longitude_deg']:.6f}",
                f"{row['anomaly']:.0f}",
                "{:.1f} x {:.1f} m".format(*row["size_m"]),
                str(row["views"]),
                ", ".join(row["pictures"]),
            ]
            for number, row in enumerate(report["people"], start=1)
        ],
        crops=[jpeg_uri(each) for each in crops],
    )
    return str(page)


def _calibration(report: Mapping[str, Any]) -> list[list[str]]:
    return [
        [
            name,
            label,
            f"{each['stated']:.2f}",
            f"{each['found']:.2f}",
            f"{each['found_low']:.2f} to {each['found_high']:.2f}",
            str(each["count"]),
        ]
        for name, label, each in _calibrated(report)
    ]


def _calibrated(report: Mapping[str, Any]) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Each row of stated and found, with its flight's name and its class."""
    for flight in report["flights"]:
        for label, row in flight["classes"].items():
            for each in row["calibration"]:
                yield known(flight["name"]), label, each

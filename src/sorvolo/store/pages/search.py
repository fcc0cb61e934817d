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
    number_at,
    picture_uri,
    render,
    seconds_words,
    with_unit,
)


def search_page(report: Mapping[str, Any], pictures: Mapping[str, ImageRGBA]) -> str:
    """search.html of search.json's content; `pictures` are the maps of the classes' probabilities. Text is escaped."""
    first = next(iter(report["classes"]))
    headline = known(at(report, "headline", "text"))
    page = render(
        "search.html",
        title=f"{known(report['site'])} - what the search would have found",
        site=known(report["site"]),
        headline=headline[:1].upper() + headline[1:],
        model=known(report["model"]),
        notices=[*report["warnings"], *(known(at(each, "text")) for each in report["notices"])],
        maps=[(label, picture_uri(picture)) for label, picture in pictures.items()],
        figures=_figures(report["classes"][first]),
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
        refly=_refly(report.get("refly")),
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
        calibration_plot=_calibration_plot(report),
        cell=with_unit(report["cell_m"], "{:g} m"),
        so_far=report["so_far"],
    )
    return str(page)


def waiting_page(*, is_over: bool) -> str:
    """search.html of a flight of which nothing was measured yet: it loads itself anew, until the flight is over."""
    return str(
        render("search_waiting.html", title="What a search would have found", is_over=is_over)
    )


def under_trees_page(report: Mapping[str, Any], floor: ImageRGBA, crops: Sequence[bytes]) -> str:
    """under_trees.html of under_trees.json's content, the floor's picture and a JPEG of each find. Text is escaped."""
    headline = report["headline"]["text"]
    page = render(
        "under_trees.html",
        title=f"{report['flight']} - under the trees",
        flight=report["flight"],
        headline=headline[:1].upper() + headline[1:],
        warning_lines=report["warnings"],
        floor=picture_uri(floor),
        pictures=report["pictures"],
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


def _figures(row: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    interval = (
        f"90 % interval {row['pod_low']:.2f} to {row['pod_high']:.2f}; unseen ground counts as 0"
    )
    return [
        ("probability of detection (POD)", f"{row['pod']:.2f}", interval),
        ("area", area_words(row["area_m2"]), f"of it seen: {area_words(row['seen_m2'])}"),
        (
            "effective sweep width",
            with_unit(row["sweep_width_m"], "{:.1f} m") or "unknown",
            "ground times its probability, within the area or not, over the path of all flights",
        ),
        (
            "coverage",
            f"{row['coverage']:.2f}",
            f"a random search of that effort has POD {row['random_pod']:.2f}",
        ),
    ]


def _refly(refly: Mapping[str, Any] | None) -> str:
    if refly is None:
        return ""
    written = ", ".join(refly["files"])
    files = f" Files: {written}." if written else " --refly FILE.kml (or .plan, .kmz) writes it."
    return (
        f"Another flight over {refly['holes']} of the holes ({area_words(number_at(refly, 'area_m2'))}), "
        f"{refly['height_m']:.0f} m high, takes {seconds_words(number_at(refly, 'duration_s'))}.{files}"
    )


def _calibration_plot(report: Mapping[str, Any]) -> dict[str, Any]:
    """The drawing of `_calibration`, and what its colours are."""
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
    return {
        "drawing": stated_and_found(rows),
        "legend": [(colour_class(k), name) for k, name in enumerate(names)],
    }


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

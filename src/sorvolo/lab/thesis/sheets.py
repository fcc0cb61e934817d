"""The thesis's tables as sheets of words and numbers: the published figures beside ours, as CSV and as Markdown."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

_METHODS_4_1 = {
    "proposed": "thesis",
    "bu_et_al": "Bu et al.",
    "pix4d": "Pix4D",
    "photoscan": "Photoscan",
}
_COUNTS = ("tp", "fp", "fn", "tn")
_RATES = ("precision", "recall", "accuracy", "f1")
_RATE_NAMES = ("TP", "FP", "FN", "TN", "precision, %", "recall, %", "accuracy, %", "F1, %")


@dataclass(frozen=True)
class Sheet:
    """One table: the thesis's name for it, its columns, and its rows of texts and numbers; `notes` on differences."""

    name: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()

    @property
    def csv(self) -> bytes:
        """The table as CSV with its columns' names."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows(self.rows)
        return text.getvalue().encode()

    @property
    def markdown(self) -> str:
        """The table in Markdown, under its title."""
        lines = [
            f"### {self.title}",
            "",
            _markdown_row(self.columns),
            _markdown_row(["---"] * len(self.columns)),
        ]
        lines += [_markdown_row(row) for row in self.rows]
        return "\n".join([*lines, "", *(f"- {note}" for note in self.notes)]).rstrip() + "\n"


def reproduction_sheets(tables: Mapping[str, Any]) -> list[Sheet]:
    """The sheets of what `missions.reproduce.thesis_tables.tables_of` gives, in the order of the thesis's chapter."""
    return [
        _distortions(tables["figure_3_12"]),
        *_times(tables["table_4_1"]),
        _deviations(tables["section_4_1_1"]),
        _counted(tables["tables_4_3_and_4_4"], "tables_4_3_and_4_4", "Tables 4.3 and 4.4: frames"),
        _counted(tables["table_4_5"], "table_4_5", "Table 4.5: pixels"),
        _seconds(tables["section_4_2_2"]),
        _precisions(tables["table_4_6"]),
    ]


def percent(share: float | None) -> str:
    """A share in per cent with one decimal; "-" where there is none."""
    return "-" if share is None else f"{100 * share:.1f}"


def _distortions(table: Mapping[str, Any]) -> Sheet:
    rows = [
        (
            each["sequence"],
            "rigid, 4 degrees of freedom" if each["transform"] == "similarity" else "homography",
            f"{each['frames']} of {each['selected']}",
            _number(each["sides"], 3),
            _number(each["areas"], 3),
            percent(each["bend"]),
        )
        for each in table["ours"]
    ]
    columns = (
        "sequence",
        "transform",
        "frames placed",
        "opposite sides, largest ratio",
        "areas, largest ratio",
        "bend of the path, %",
    )
    notes = (
        "Ratios are of the frames' outlines on the map: 1 is an undistorted frame. The bend is the path's largest "
        "distance from the chord between its ends, over the chord; wind and drift bend it, too.",
    )
    return Sheet(
        "figure_3_12", "Figure 3.12: homography and rigid transform", columns, tuple(rows), notes
    )


def _times(table: Mapping[str, Any]) -> list[Sheet]:
    printed = [
        (
            each["sequence"],
            f"{each['frames']}",
            f"{each['keyframes']}",
            *(f"{each[key]:g}" for key in _METHODS_4_1),
            f"{60 * each['proposed'] / each['keyframes']:.2f}",
        )
        for each in table["published"]
    ]
    ours = [
        (
            _sequence(each),
            each["method"],
            f"{each['frames']}",
            f"{each['keyframes']}",
            f"{each['matched']}",
            _number(each["minutes"], 2),
            _number(each["cpu_minutes"], 2),
            _number(each["seconds_per_keyframe"], 2),
            percent(each["deviation"]),
            str(each["quality"] or "-"),
        )
        for each in table["ours"]
    ]
    return [
        Sheet(
            "table_4_1_printed",
            "Table 4.1 as printed: minutes",
            ("sequence", "frames", "KFs", *_METHODS_4_1.values(), "thesis: s a KF"),
            tuple(printed),
        ),
        Sheet(
            "table_4_1",
            "Table 4.1 here",
            (
                "sequence",
                "method",
                "frames",
                "KFs",
                "matched",
                "minutes",
                "processor minutes",
                "processor s a KF",
                "deviation, %",
                "quality",
            ),
            tuple(ours),
            tuple(table["differences"]),
        ),
    ]


def _sequence(each: Mapping[str, Any]) -> str:
    return str(each["sequence"]) + ("" if each["has_telemetry"] else " (no telemetry)")


def _deviations(table: Mapping[str, Any]) -> Sheet:
    printed = table["published"]
    rows = [
        (
            "thesis, printed",
            f"{printed['videos']}",
            f"about {percent(printed['deviation'])}",
            f"about {percent(printed['correlation'])} (4 videos)",
        )
    ]
    rows += [
        (
            f"{each['method']} here",
            f"{each['videos']}",
            percent(each["deviation"]),
            f"{percent(each['correlation'])} ({counted_videos(each['correlated'])})",
        )
        for each in table["ours"]
    ]
    rows += [
        (
            f"{each['method']} here, with {whose}",
            f"{each[count]}",
            "-",
            f"{percent(each[share])} ({counted_videos(each[count])})",
        )
        for whose, share, count in (
            ("the mosaics of [17]", "published_correlation", "published"),
            ("the dataset's mosaics (2.4)", "benchmark_correlation", "benchmarks"),
        )
        for each in table["ours"]
        if each[count]
    ]
    columns = (
        "method",
        "videos",
        "deviation from the frames, %",
        "correlation with another map (eq. 4.1), %",
    )
    title = "Section 4.1.1: how good the mosaics are"
    return Sheet("section_4_1_1", title, columns, tuple(rows), tuple(table["differences"]))


def _counted(table: Mapping[str, Any], name: str, title: str) -> Sheet:
    published = table["published"]
    printed = [
        (
            f"{each['method']}, printed",
            "13871 frames" if each["method"] == "thesis" else "-",
            "-",
            *(str(each.get(key, "-")) for key in _COUNTS),
            *(percent(each[key]) for key in _RATES),
        )
        for each in ([published] if isinstance(published, Mapping) else published)
    ]
    ours = [
        (
            f"{each['method']}, here",
            f"{each['compared']} views of {counted_videos(each['videos'])}",
            each["judged_by"],
            *(str(each[key]) for key in _COUNTS),
            *(percent(each[key]) for key in _RATES),
        )
        for each in table["ours"]
    ]
    return Sheet(
        name,
        title,
        ("method", "compared", "judged by", *_RATE_NAMES),
        (*printed, *ours),
        tuple(table["differences"]),
    )


def counted_videos(videos: int) -> str:
    """ "1 video", "3 videos"."""
    return f"{videos} video{'' if videos == 1 else 's'}"


def _seconds(table: Mapping[str, Any]) -> Sheet:
    printed = table["published"]
    rows = [
        (
            "thesis, printed",
            "not stated",
            _number(printed["single_thread_s"], 3),
            "-",
            _number(printed["multithread_s"], 3),
        )
    ]
    rows += [
        (
            f"{each['sequence']}, here",
            f"{each['width_px']} x {each['height_px']}",
            _number(each["single_thread_s"], 3),
            f"{each['threads']}",
            _number(each["multithread_s"], 3),
        )
        for each in table["ours"]
    ]
    columns = ("where", "picture, px", "one thread, s", "threads", "with them, s")
    title = "Section 4.2.2: one comparison by the thesis's method"
    return Sheet("section_4_2_2", title, columns, tuple(rows), tuple(table["differences"]))


def _precisions(table: Mapping[str, Any]) -> Sheet:
    printed = [
        (
            f"{model} Faster R-CNN, printed",
            dataset,
            "four steps, 2000 epochs",
            "-",
            percent(score),
            "-",
        )
        for model, scores in table["published"].items()
        for dataset, score in scores.items()
    ]
    ours = [
        (
            f"{each['model']}, here",
            each["dataset"],
            f"{each['schedule']}, {each['steps']} steps of preset {each['preset']} at {each['side_px']} px"
            if "steps" in each
            else "as packaged",
            f"{each['pictures']} of {counted_videos(each['videos'])}: {each['split']}",
            percent(each["thesis_map"]),
            percent(each["ap50"]),
        )
        for each in table["ours"]
    ]
    columns = ("network", "dataset", "training", "test frames", "mAP (eq. 4.4), %", "AP50, %")
    return Sheet(
        "table_4_6", "Table 4.6: detectors", columns, (*printed, *ours), tuple(table["differences"])
    )


def _number(value: float | None, decimals: int) -> str:
    return "-" if value is None else f"{value:.{decimals}f}"


def _markdown_row(cells: Iterable[str] | Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"

"""The thesis's tables as sheets of words and numbers: the published figures beside ours, as CSV and as Markdown."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sorvolo.paths import JsonView
from sorvolo.survey.wording import counted


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


def reproduction_sheets(tables: JsonView) -> list[Sheet]:
    """The sheets of what `tables_of` gives, in the order of the thesis's chapter."""
    table = tables["figure_3_12"]
    rows = [
        (
            each["sequence"],
            "rigid, 4 degrees of freedom" if each["transform"] == "similarity" else "homography",
            f"{each['frames']} of {each['selected']}",
            _number(each["sides"], 3),
            _number(each["areas"], 3),
            _percent(each["bend"]),
        )
        for each in table["ours"]
    ]
    table = tables["table_4_1"]
    printed = [
        (*each.values(), f"{60 * each['proposed'] / each['keyframes']:.2f}")
        for each in table["published"]
    ]
    ours = [
        (
            each["sequence"] + ("" if each["has_telemetry"] else " (no telemetry)"),
            *(each[name] for name in ("method", "frames", "keyframes", "matched")),
            *(
                _number(each[name], 2)
                for name in ("minutes", "cpu_minutes", "seconds_per_keyframe")
            ),
            _percent(each["deviation"]),
            each["quality"],
        )
        for each in table["ours"]
    ]
    return [
        _sheet(
            "figure_3_12",
            "Figure 3.12: homography and rigid transform",
            "sequence; transform; frames placed; opposite sides, largest ratio; areas, largest ratio; bend of the path, %",
            rows,
            (
                "Ratios are of the frames' outlines on the map: 1 is an undistorted frame. The bend is the path's largest "
                "distance from the chord between its ends, over the chord; wind and drift bend it, too.",
            ),
        ),
        *[
            _sheet(
                "table_4_1_printed",
                "Table 4.1 as printed: minutes",
                "sequence; frames; KFs; thesis; Bu et al.; Pix4D; Photoscan; thesis: s a KF",
                printed,
            ),
            _sheet(
                "table_4_1",
                "Table 4.1 here",
                "sequence; method; frames; KFs; matched; minutes; processor minutes; processor s a KF; deviation, %; quality",
                ours,
                table["differences"],
            ),
        ],
        _deviations(tables["section_4_1_1"]),
        _counted(tables["tables_4_3_and_4_4"], "tables_4_3_and_4_4", "Tables 4.3 and 4.4: frames"),
        _counted(tables["table_4_5"], "table_4_5", "Table 4.5: pixels"),
        _seconds(tables["section_4_2_2"]),
        _precisions(tables["table_4_6"]),
    ]


def _sheet(
    name: str, title: str, columns: str, rows: Iterable[Sequence[Any]], notes: Sequence[str] = ()
) -> Sheet:
    """A sheet of columns named with "; " between, and of any values: "-" for None."""
    texts = [tuple("-" if each is None else str(each) for each in row) for row in rows]
    return Sheet(name, title, tuple(columns.split("; ")), tuple(texts), tuple(notes))


def _percent(share: float | None) -> str | None:
    return None if share is None else f"{100 * share:.1f}"


def _number(value: float | None, decimals: int) -> str | None:
    return None if value is None else f"{value:.{decimals}f}"


def _deviations(table: JsonView) -> Sheet:
    printed, ours = table["published"], table["ours"]
    rows: list[Sequence[Any]] = [
        (
            "thesis, printed",
            printed["videos"],
            f"about {_percent(printed['deviation'])}",
            f"about {_percent(printed['correlation'])} (4 videos)",
        )
    ]
    for whose, share, count in (
        ("", "correlation", "correlated"),
        (", with the mosaics of [17]", "published_correlation", "published"),
        (", with the dataset's mosaics (2.4)", "benchmark_correlation", "benchmarks"),
    ):
        for each in ours:
            correlated = f"{_percent(each[share]) or '-'} ({counted(each[count], 'video')})"
            deviation = None if whose else _percent(each["deviation"])
            if each[count] or not whose:
                videos = each[count if whose else "videos"]
                rows.append((f"{each['method']} here{whose}", videos, deviation, correlated))
    return _sheet(
        "section_4_1_1",
        "Section 4.1.1: how good the mosaics are",
        "method; videos; deviation from the frames, %; correlation with another map (eq. 4.1), %",
        rows,
        table["differences"],
    )


def _counted(table: JsonView, name: str, title: str) -> Sheet:
    published = table["published"]
    printed = [published] if isinstance(published, Mapping) else published
    shown: list[tuple[str, str, JsonView]] = [
        ("printed", "13871 frames" if each["method"] == "thesis" else "-", each) for each in printed
    ] + [
        ("here", f"{each['compared']} views of {counted(each['videos'], 'video')}", each)
        for each in table["ours"]
    ]
    rows = [
        (
            f"{each['method']}, {where}",
            compared,
            each.get("judged_by"),
            *(each.get(key) for key in ("tp", "fp", "fn", "tn")),
            *(_percent(each[key]) for key in ("precision", "recall", "accuracy", "f1")),
        )
        for where, compared, each in shown
    ]
    columns = (
        "method; compared; judged by; TP; FP; FN; TN; precision, %; recall, %; accuracy, %; F1, %"
    )
    return _sheet(name, title, columns, rows, table["differences"])


def _seconds(table: JsonView) -> Sheet:
    printed = table["published"]
    rows = [
        (
            "thesis, printed",
            "not stated",
            printed["single_thread_s"],
            None,
            printed["multithread_s"],
        )
    ] + [
        (
            f"{each['sequence']}, here",
            f"{each['width_px']} x {each['height_px']}",
            _number(each["single_thread_s"], 3),
            each["threads"],
            _number(each["multithread_s"], 3),
        )
        for each in table["ours"]
    ]
    return _sheet(
        "section_4_2_2",
        "Section 4.2.2: one comparison by the thesis's method",
        "where; picture, px; one thread, s; threads; with them, s",
        rows,
        table["differences"],
    )


def _precisions(table: JsonView) -> Sheet:
    rows = [
        (
            f"{model} Faster R-CNN, printed",
            name,
            "four steps, 2000 epochs",
            None,
            _percent(score),
            None,
        )
        for model, scores in table["published"].items()
        for name, score in scores.items()
    ] + [
        (
            f"{each['model']}, here",
            each["dataset"],
            f"{each['steps']} steps at {each['side_px']} px" if "steps" in each else "as packaged",
            f"{each['pictures']} of {counted(each['videos'], 'video')}: {each['split']}",
            _percent(each["thesis_map"]),
            _percent(each["ap50"]),
        )
        for each in table["ours"]
    ]
    columns = "network; dataset; training; test frames; mAP (eq. 4.4), %; AP50, %"
    return _sheet("table_4_6", "Table 4.6: detectors", columns, rows, table["differences"])


def _markdown_row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"

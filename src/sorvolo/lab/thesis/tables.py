"""The rows put together to the thesis's tables, the published figures beside ours."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

from sorvolo.lab.evaluation.change_metrics import Counts
from sorvolo.lab.thesis.comparisons import MASKS, TABLE, TIMES, rates
from sorvolo.lab.thesis.npu_folder import ENVIRONMENT
from sorvolo.lab.thesis.published import (
    DIFFERENCES,
    FIGURES,
    SECTION_4_1_1,
    SECTION_4_2_2,
    TABLE_4_1,
    TABLE_4_3,
    TABLE_4_4,
    TABLE_4_5,
    TABLE_4_6,
)
from sorvolo.lab.thesis.rows import Row
from sorvolo.lab.thesis.settings import BENCHMARK, COMPARISONS, MAP_METHODS, PUBLISHED
from sorvolo.paths import Json, JsonView


def tables_of(rows: Sequence[Row]) -> Json:
    """Tables 4.1 and 4.3 to 4.6, sections 4.1.1 and 4.2.2 and Figure 3.12, each `published` and `ours`.

    A rate that nothing was there to divide by is None. A table whose rows are all missing has an empty `ours`.
    """
    made = [row for row in rows if not row.missing]

    def of_kind(kind: str) -> list[Json]:
        return [
            {name: value for name, value in row.values.items() if name != "histogram"}
            for row in made
            if row.kind == kind
        ]

    # by method: the mean deviation over its videos of UMCD; the correlation of the methods'
    # maps with each other, and with the published mosaics of the NPU Drone-Map dataset,
    # over those that have one
    found = []
    for method in MAP_METHODS:
        own = [row for row in made if row.values.get("method") == method]
        umcd = [row for row in own if row.values.get("environment") != ENVIRONMENT]
        result: Json = {"method": method}
        for name, count, values in (
            ("deviation", "videos", _values(umcd, "mosaic", "deviation")),
            ("correlation", "correlated", _values(made, "correlation", "correlation")),
            ("published_correlation", "published", _values(own, PUBLISHED, "correlation")),
            ("benchmark_correlation", "benchmarks", _values(own, BENCHMARK, "correlation")),
        ):
            result |= {name: _mean(values), count: len(values)}
        if result["videos"] or result["published"]:
            found.append(result)
    pairs: dict[str, tuple[Any, list[Json]]] = {
        "table_4_1": (TABLE_4_1, of_kind("mosaic")),
        "section_4_1_1": (SECTION_4_1_1, found),
        "figure_3_12": (FIGURES["3.12"], of_kind("transform")),
        "tables_4_3_and_4_4": (
            {"method": "thesis", **TABLE_4_3, **TABLE_4_4},
            _pooled(made, "frames"),
        ),
        "table_4_5": (TABLE_4_5, _pooled(made, "pixels")),
        "section_4_2_2": (SECTION_4_2_2, of_kind("seconds")),
        "table_4_6": (TABLE_4_6, of_kind("detector")),
    }
    tables: Json = {
        name: {"published": published, "ours": ours} for name, (published, ours) in pairs.items()
    }
    for name, texts in DIFFERENCES.items():
        tables[name]["differences"] = list(texts)
    return tables


def _values(rows: Iterable[Row], kind: str, name: str) -> list[float]:
    """One value of all rows of a kind that have it."""
    return [row.values[name] for row in rows if row.kind == kind and row.values[name] is not None]


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _pooled(rows: Iterable[Row], kind: str) -> list[Json]:
    """Counts of all videos together and the rates of section 4.2.1, by method and by what they were judged by."""
    groups: dict[tuple[str, str], list[JsonView]] = {
        (title, judged_by): [] for title in COMPARISONS for judged_by in (MASKS, TIMES, TABLE)
    }
    for row in rows:
        if row.kind == "comparison":
            groups[row.values["method"], row.values["judged_by"]].append(row.values)
    result = []
    for (title, judged_by), parts in groups.items():
        whole = sum((Counts(**each[kind]) for each in parts), Counts())
        if parts:
            result.append(
                {
                    "method": title,
                    "judged_by": judged_by,
                    "videos": len(parts),
                    "views": sum(each["views"] for each in parts),
                    "compared": sum(each["compared"] for each in parts),
                    **asdict(whole),
                    **rates(whole),
                    "f1_by_video": [rates(Counts(**each[kind]))["f1"] for each in parts],
                    "cpu_seconds_per_view": _mean([each["cpu_seconds_per_view"] for each in parts]),
                }
            )
    return result

"""The rows put together to the thesis's tables, the published figures beside ours."""

from collections.abc import Iterable, Mapping, Sequence
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

_COUNTS = ("tp", "fp", "fn", "tn")


def tables_of(rows: Sequence[Row]) -> dict[str, Any]:
    """Tables 4.1 and 4.3 to 4.6, sections 4.1.1 and 4.2.2 and Figure 3.12, each `published` and `ours`.

    A rate that nothing was there to divide by is None. A table whose rows are all missing has an empty `ours`.
    """
    made = [row for row in rows if not row.missing]
    frames = _pooled(made, "frames")
    tables: dict[str, Any] = {
        "table_4_1": _both(TABLE_4_1, _mosaics(made)),
        "section_4_1_1": _both(SECTION_4_1_1, _deviations(made)),
        "figure_3_12": _both(
            FIGURES["3.12"], [dict(row.values) for row in made if row.kind == "transform"]
        ),
        "tables_4_3_and_4_4": _both({"method": "thesis", **TABLE_4_3, **TABLE_4_4}, frames),
        "table_4_5": _both(TABLE_4_5, _pooled(made, "pixels")),
        "section_4_2_2": _both(
            SECTION_4_2_2, [dict(row.values) for row in made if row.kind == "seconds"]
        ),
        "table_4_6": _both(TABLE_4_6, [dict(row.values) for row in made if row.kind == "detector"]),
    }
    for name, texts in DIFFERENCES.items():
        tables[name]["differences"] = list(texts)
    return tables


def _both(published: Any, ours: Any) -> dict[str, Any]:
    return {"published": published, "ours": ours}


def _mosaics(rows: Iterable[Row]) -> list[dict[str, Any]]:
    keys = (
        "sequence",
        "has_telemetry",
        "method",
        "frames",
        "keyframes",
        "matched",
        "minutes",
        "cpu_minutes",
        "seconds_per_keyframe",
        "deviation",
        "quality",
        "camera",
    )
    return [{key: row.values[key] for key in keys} for row in rows if row.kind == "mosaic"]


def _deviations(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """By method: the mean deviation over its videos of UMCD; the correlation of the methods' maps with each other, and
    with the published mosaics of the NPU Drone-Map dataset, over those that have one."""
    alike = _values(rows, "correlation", "correlation")
    found = []
    for method in MAP_METHODS:
        own = [row for row in rows if row.values.get("method") == method]
        shares = _values(
            [row for row in own if row.values.get("environment") != ENVIRONMENT],
            "mosaic",
            "deviation",
        )
        published = _values(own, PUBLISHED, "correlation")
        benchmarks = _values(own, BENCHMARK, "correlation")
        if shares or published:
            found.append(
                {
                    "method": method,
                    "videos": len(shares),
                    "deviation": _mean(shares),
                    "correlation": _mean(alike),
                    "correlated": len(alike),
                    "published_correlation": _mean(published),
                    "published": len(published),
                    "benchmark_correlation": _mean(benchmarks),
                    "benchmarks": len(benchmarks),
                }
            )
    return found


def _values(rows: Iterable[Row], kind: str, name: str) -> list[float]:
    """One value of all rows of a kind that have it."""
    return [row.values[name] for row in rows if row.kind == kind and row.values[name] is not None]


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _pooled(rows: Iterable[Row], kind: str) -> list[dict[str, Any]]:
    """Counts of all videos together and the rates of section 4.2.1, by method and by what they were judged by."""
    compared = [
        row.values for row in rows if row.kind == "comparison" and row.values[kind] is not None
    ]
    result = []
    for title in COMPARISONS:
        for judged_by in (MASKS, TIMES, TABLE):
            parts = [
                each
                for each in compared
                if each["method"] == title and each["judged_by"] == judged_by
            ]
            if parts:
                result.append(_summed(title, judged_by, parts, kind))
    return result


def _summed(
    title: str, judged_by: str, parts: Sequence[Mapping[str, Any]], kind: str
) -> dict[str, Any]:
    whole = sum((Counts(**each[kind]) for each in parts), Counts())
    return {
        "method": title,
        "judged_by": judged_by,
        "videos": len(parts),
        "views": sum(each["views"] for each in parts),
        "compared": sum(each["compared"] for each in parts),
        **{name: getattr(whole, name) for name in _COUNTS},
        **rates(whole),
        "cpu_seconds_per_view": sum(each["cpu_seconds_per_view"] for each in parts) / len(parts),
    }

"""What the pages of HTML are made of: text, numbers in words, tables, pictures inside the page."""

import base64
import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

import cv2
import numpy as np

from sorvolo.geometry.arrays import Anything, ImageRGBA
from sorvolo.store.images import shrink

_MOST_PICTURE_BYTES = 1_450_000  # base64 makes four bytes of three: below 2 MB in the page
_BACKGROUND = 236.0  # of what was never seen, a light grey


def at(report: Mapping[str, Any], *keys: str) -> Any:
    """What lies at the path of keys; None where any part of it is missing."""
    value: Any = report
    for key in keys:
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


def number_at(report: Mapping[str, Any], *keys: str) -> float | None:
    """The finite number at the path of keys, else None."""
    return finite_or_none(at(report, *keys))


def finite_or_none(value: Any) -> float | None:
    """The value as a finite number, else None."""
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None


def escaped(value: Any) -> str:
    """The value as HTML text; None is unknown."""
    return "unknown" if value is None else escape(str(value))


def with_unit(pattern: str, value: Any) -> str | None:
    """The number in a pattern of str.format; None when it is none."""
    number = finite_or_none(value)
    return None if number is None else pattern.format(number)


def join_words(*parts: str | None) -> str:
    """What there is, with spaces between."""
    return " ".join(part for part in parts if part)


def length_words(value_m: float | None) -> str | None:
    """A length in centimetres or metres."""
    if value_m is None:
        return None
    return f"{100 * value_m:.3g} cm" if value_m < 0.995 else f"{value_m:.3g} m"


def area_words(value_m2: float | None) -> str:
    """The area of a map in square metres, hectares or square kilometres."""
    if value_m2 is None:
        return "unknown area"
    if value_m2 < 10_000:
        return f"{value_m2:,.0f} m\u00b2".replace(",", "\u202f")
    return f"{value_m2 / 1e4:.3g} ha" if value_m2 < 1e6 else f"{value_m2 / 1e6:.3g} km\u00b2"


def seconds_words(value: float | None) -> str:
    """A duration in seconds or minutes."""
    if value is None:
        return "unknown"
    return f"{value:.2g} s" if value < 10 else f"{value:.0f} s" if value < 180 else f"{value / 60:.1f} min"


def bullet_list(items: Iterable[str]) -> str:
    """A list of items that are HTML already."""
    return f"<ul>{''.join(f'<li>{each}</li>' for each in items)}</ul>"


def table_of(rows: Sequence[Sequence[str]], names: Sequence[str] = ()) -> str:
    """A table of cells that are HTML already."""
    head = f"<tr>{''.join(f'<th>{each}</th>' for each in names)}</tr>" if names else ""
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    return f'<div class="wide"><table>{head}{body}</table></div>'


def page_of(title: str, style: str, parts: Iterable[str], script: str = "") -> str:
    """A whole page of its parts, those that are not empty; all are HTML already."""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>{style}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(part for part in parts if part)
        + "\n</main>\n" + (f"<script>{script}</script>\n" if script else "") + "</body>\n</html>\n"
    )


def picture_uri(picture: ImageRGBA, most_bytes: int = _MOST_PICTURE_BYTES) -> str:
    """The picture as a JPEG on grey inside an address, below a size: that which a page can carry."""
    small = picture
    while True:
        alpha = small[..., 3:].astype(np.float32) / 255
        flat: Anything = np.round(small[..., 2::-1] * alpha + _BACKGROUND * (1 - alpha)).astype(np.uint8)
        for quality in (88, 75):
            _, data = cv2.imencode(".jpg", flat, [cv2.IMWRITE_JPEG_QUALITY, quality])
            if len(data) <= most_bytes or max(small.shape[:2]) <= 32:
                return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()
        small = shrink(small, max(1, small.shape[1] // 2), max(1, small.shape[0] // 2))

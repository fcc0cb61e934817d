"""What pages are made of: values looked up in a report, numbers in words, pictures inside the page."""

import base64
import math
from collections.abc import Mapping
from functools import cache, partial
from types import MappingProxyType
from typing import Any
from xml.etree.ElementTree import fromstring, tostring

import cv2
import numpy as np
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from sorvolo.geometry.arrays import ImageBGR, ImageRGBA
from sorvolo.store.images import shrink
from sorvolo.survey import wording

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


def known(value: Any) -> str:
    """The value as text; None is unknown."""
    return "unknown" if value is None else str(value)


def plural(count: float, name: str) -> str:
    """A number of things: "1 car", "3 buses", "4 people", "0 cars"."""
    return f"{count:.0f} {wording.plural(name, round(count))}"


def with_unit(value: Any, pattern: str) -> str | None:
    """The number in a pattern of str.format; None when it is none."""
    number = finite_or_none(value)
    return None if number is None else pattern.format(number)


def join_words(*parts: str | None) -> str:
    """What there is, with spaces between."""
    return " ".join(part for part in parts if part)


def length_words(value_m: float | None) -> str | None:
    """A length in centimetres below 10 cm, else in metres."""
    if value_m is None:
        return None
    if value_m < 0.0995:
        return f"{100 * value_m:.2g} cm"
    return f"{value_m:.2f} m" if value_m < 9.995 else f"{value_m:.3g} m"


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
    return (
        f"{value:.2g} s"
        if value < 10
        else f"{value:.0f} s"
        if value < 180
        else f"{value / 60:.1f} min"
    )


def moment_words(utc: object) -> str:
    """A time to read; what no clock dated counts from 1970 on, and is shown as the time since the start."""
    day, _, clock = str(utc or "")[:19].partition("T")
    return clock if day == "1970-01-01" else f"{day} {clock}".strip() or "unknown"


def picture_uri(picture: ImageRGBA, most_bytes: int = _MOST_PICTURE_BYTES) -> str:
    """The picture as a JPEG on grey inside an address, below a size: that which a page can carry."""
    small = picture
    while True:
        alpha = small[..., 3:].astype(np.float32) / 255
        flat: ImageBGR = np.round(small[..., 2::-1] * alpha + _BACKGROUND * (1 - alpha)).astype(
            np.uint8
        )
        for quality in (88, 75):
            _, data = cv2.imencode(".jpg", flat, [cv2.IMWRITE_JPEG_QUALITY, quality])
            if len(data) <= most_bytes or max(small.shape[:2]) <= 32:
                return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()
        small = shrink(small, max(1, small.shape[1] // 2), max(1, small.shape[0] // 2))


def jpeg_uri(jpeg: bytes) -> str:
    """A JPEG file inside an address."""
    return "data:image/jpeg;base64," + base64.b64encode(jpeg).decode()


_HOME = "sorvolo.store.pages"


def render(
    template: str,
    report: Mapping[str, Any] = MappingProxyType({}),
    *,
    package: str = _HOME,
    **values: Any,
) -> Markup:
    """The template `templates/<template>` of a package filled with these values, as text that needs no more escaping.

    Of `report` the template asks by path: `at("frames", "total")` and `number("area_m2")` as `at` and `number_at`.
    """
    looked_up = {"at": partial(at, report), "number": partial(number_at, report)}
    return Markup(_environment(package).get_template(template).render(looked_up | values))


def xml_of(template: str, *, package: str, declaration: bool = False, **values: Any) -> bytes:
    """The template `templates/<template>.xml` of a package filled with these values: XML in UTF-8, in one line."""
    root = fromstring(render(f"{template}.xml", package=package, **values))
    for element in root.iter():
        element.tail = None
        if not (element.text or "").strip():
            element.text = None
    return bytes(tostring(root, encoding="utf-8", xml_declaration=declaration))


def cell(macro: str, *values: Any) -> Markup:
    """A cell of a table, by a macro of `templates/cells.html`."""
    return Markup(getattr(_environment(_HOME).get_template("cells.html").module, macro)(*values))


@cache
def _environment(package: str) -> Environment:
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package), PackageLoader(_HOME)]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "px": "{:.1f}".format,
        "percent": lambda share: f"{100 * share if math.isfinite(share) else 0:.2f}%",
        "known": known,
        "unit": with_unit,
        "metres": length_words,
        "area": area_words,
        "duration": seconds_words,
        "moment": moment_words,
        "sentence": lambda text: text[:1].upper() + text[1:],
    }
    environment.globals |= {"plural": plural, "join_words": join_words}
    return environment

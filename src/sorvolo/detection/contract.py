"""What a model file states about itself: the metadata that `sorvolo` writes into its ONNX files, checked."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from sorvolo.errors import InputError

METADATA_KEY = "sorvolo"
"""The key among an ONNX file's `metadata_props` under which the JSON lies."""

CALIBRATED, FORMAT = 2, 3
"""The contract that brought `calibration`, and the newest, which brought `layout`; docs/model-file.md lists the fields."""

# px: what a picture's sides are multiples of, in a model whose file does not state it
_FALLBACK_STRIDE = 32
_NEEDED = ("name", "classes", "thresholds", "best_px")
_TEXTS = (
    "thermal_by",
    "preset",
    "version",
    "precision",
    "licence",
    "trained_on",
    "created",
    "layout",
)

MOST_LARGER = 3.0
"""Largest upscaling factor of a picture; beyond it only blur is added."""

MOST_CLOSER = 4.0
"""Largest upscaling factor once small objects were found: it refines their boxes."""

POSITIONS = ((0, False), (1, False), (2, True), (3, True))
"""Quarter turns counter-clockwise, and whether mirrored then, of each pass of a second look."""


@dataclass(frozen=True)
class SecondLook:
    """How reports of a class are looked at again (`second_look`).

    `looks_px`: in each look the report's longer side has so many pixels. A look that would show it more than `enlarged`
    times as large is left out, but for the smallest: blur shows nothing. Each look is taken in the first
    `positions` of POSITIONS. A report's log-odds become `shift`,
    `own` times themselves and `again` times the mean of the looks'. `least`: the score from which on a report is looked
    at. `by`: the installed model that looks, "" for the same one; another errs in other places.
    """

    looks_px: tuple[float, ...]
    own: float
    again: float
    shift: float
    least: float
    enlarged: float
    by: str = ""
    positions: int = 1

    def sides_px(self, longer_px: float) -> tuple[float, ...]:
        """The looks at a report whose longer side has so many pixels in its picture."""
        own = tuple(side_px for side_px in self.looks_px if side_px <= self.enlarged * longer_px)
        return own or (min(self.looks_px),)


@dataclass(frozen=True)
class Pyramid:
    """In which sizes a class is looked for where a picture's scale is not known (`pyramid`).

    `times`: so many times as large as it is, besides as it is. `known_px`: the side (the root of a box's area) at which
    the model knows the class best; `octaves`: the standard deviation, in powers of two, of the normal curve by which a
    look's opinion counts less where it shows an object larger or smaller. `shift`: added to the mean log-odds, so that
    thresholds hold that were chosen for one look: what looks of all sizes show is right more often. `closer`: so many
    times as large a picture is shown only where the other looks show something that is known best at that size.
    """

    times: tuple[float, ...]
    known_px: float
    octaves: float
    shift: float
    closer: tuple[float, ...] = ()


@dataclass(frozen=True)
class ScoreCalibration:
    """How a class's scores become the share of such reports that is right: their log-odds become `shift` and `slope`
    times themselves (Platt 1999)."""

    slope: float
    shift: float


@dataclass(frozen=True)
class ModelInfo:
    """One model, as its file describes it.

    `thresholds`: each class is reported from this score on. `calibration`: what becomes, in the end, of the scores of
    some classes; thresholds are of what comes out. `best_px`: from which to which longer side, in pixels, the
    model finds a class well. `stride`: the sides of its input are multiples of it. `thermal`: it was trained on
    thermal frames; `daylight`: on daylight. `thermal_by`: the installed model that looks at thermal frames
    in its place, "" for none. `precision` is float32 or int8. `on_request`: classes too unsure to be reported unless a
    person asks for them. `second_look`: classes whose reports are looked at again.
    `pyramid`: classes that are looked for in several sizes where a picture's scale is not known. `second_only`: it only
    looks again at what other models report, and whole pictures mean nothing to it. `layout`: whose convention a foreign
    network follows (`layouts`), "" for ours; `columns`: the class of each of its scores, "" for none.
    """

    name: str
    classes: tuple[str, ...]
    thresholds: Mapping[str, float]
    best_px: Mapping[str, tuple[float, float]]
    stride: int = _FALLBACK_STRIDE
    thermal: bool = False
    daylight: bool = True
    thermal_by: str = ""
    preset: str = ""
    version: str = ""
    precision: str = "float32"
    licence: str = ""
    trained_on: str = ""
    created: str = ""
    on_request: tuple[str, ...] = ()
    second_look: Mapping[str, SecondLook] = field(default_factory=dict)
    pyramid: Mapping[str, Pyramid] = field(default_factory=dict)
    calibration: Mapping[str, ScoreCalibration] = field(default_factory=dict)
    second_only: bool = False
    layout: str = ""
    columns: tuple[str, ...] = ()

    @property
    def usual_classes(self) -> tuple[str, ...]:
        """What is reported where nobody asks for certain classes."""
        return tuple(name for name in self.classes if name not in self.on_request)


def info_from_metadata(metadata: Mapping[str, str], where: str) -> ModelInfo:
    """Read the metadata of the model file `where`.

    Raises InputError where it is no model of ours, is of a newer contract, or contradicts itself.
    """
    text = metadata.get(METADATA_KEY)
    if text is None:
        raise InputError(
            f"{where} is an ONNX model of another maker: import it first (sorvolo models import {where}), and give "
            "--model the name that it has then"
        )
    try:
        fields = json.loads(text)
        if not isinstance(fields, dict):
            raise ValueError("not an object")
        if int(fields["format"]) > FORMAT:
            raise InputError(
                f"{where} follows contract {fields['format']}, this version reads up to {FORMAT}: update sorvolo"
            )
        return _info(fields)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{where}: its '{METADATA_KEY}' metadata cannot be used ({_reason(error)}); export the model again"
        ) from error


def _info(fields: Mapping[str, Any]) -> ModelInfo:
    if missing := [name for name in _NEEDED if name not in fields]:
        raise ValueError(f"it lacks {', '.join(missing)}")
    classes = tuple(str(each) for each in fields["classes"])
    if not classes or len(set(classes)) != len(classes):
        raise ValueError(f"its classes must be one or more different names, not {list(classes)}")
    thresholds, best_px = _thresholds(fields, classes), _best_px(fields, classes)
    stride = int(fields.get("stride", _FALLBACK_STRIDE))
    if not 1 <= stride <= 256:
        raise ValueError(f"its stride must lie in 1 to 256, not {stride}")
    on_request = tuple(str(each) for each in fields.get("on_request", ()))
    if not set(on_request) < set(classes):
        raise ValueError(f"its on_request must be some of its classes, not {list(on_request)}")
    columns = tuple(str(each) for each in fields.get("columns", ()))
    if bool(columns) != bool(fields.get("layout")) or set(columns) - {"", *classes}:
        raise ValueError(f"its columns must name its classes, and its layout, not {list(columns)}")
    texts = {each: _words(fields[each]) for each in _TEXTS if each in fields}
    found = {}
    for name, each in fields.get("second_look", {}).items():
        weights = [float(each[key]) for key in ("own", "again", "shift", "least", "enlarged")]
        looks_px = tuple(float(side_px) for side_px in each["looks_px"])
        if (
            name not in classes
            or not looks_px
            or not all(0 < side_px < math.inf for side_px in looks_px)
        ):
            raise ValueError(
                f"its second_look must name classes and sizes of theirs, not {name} {list(looks_px)}"
            )
        if not all(map(math.isfinite, weights)) or not 0 <= weights[3] <= 1:
            raise ValueError(
                f"its second_look must have finite weights and a least score, not {weights}"
            )
        positions = int(each.get("positions", 1))
        if not 1 <= positions <= len(POSITIONS):
            raise ValueError(
                f"its second_look must have 1 to {len(POSITIONS)} positions, not {positions}"
            )
        own, again, shift, least, enlarged = weights
        found[name] = SecondLook(
            looks_px, own, again, shift, least, enlarged, str(each.get("by", "")), positions
        )
    return ModelInfo(
        str(fields["name"]),
        classes,
        MappingProxyType(thresholds),
        MappingProxyType(best_px),
        stride,
        bool(fields.get("thermal", False)),
        bool(fields.get("daylight", True)),
        on_request=on_request,
        second_look=MappingProxyType(found),
        pyramid=MappingProxyType(_pyramid(fields, classes)),
        calibration=MappingProxyType(_calibration(fields, classes)),
        second_only=bool(fields.get("second_only", False)),
        columns=columns,
        **texts,
    )


def _thresholds(fields: Mapping[str, Any], classes: Sequence[str]) -> dict[str, float]:
    thresholds = {each: float(fields["thresholds"][each]) for each in classes}
    if not all(0 <= each <= 1 for each in thresholds.values()):
        raise ValueError(f"its thresholds must lie in 0 to 1, not {thresholds}")
    return thresholds


def _best_px(fields: Mapping[str, Any], classes: Sequence[str]) -> dict[str, tuple[float, float]]:
    best_px = {
        each: (float(fields["best_px"][each][0]), float(fields["best_px"][each][1]))
        for each in classes
    }
    if not all(0 < least < most for least, most in best_px.values()):
        raise ValueError(f"its best_px must be smallest and largest side, not {best_px}")
    return best_px


def _pyramid(fields: Mapping[str, Any], classes: Sequence[str]) -> dict[str, Pyramid]:
    found = {}
    for name, each in fields.get("pyramid", {}).items():
        times = tuple(float(one) for one in each["times"])
        known_px, octaves, shift = (float(each[key]) for key in ("known_px", "octaves", "shift"))
        if (
            name not in classes
            or not times
            or not all(0 < one <= MOST_LARGER and one != 1 for one in times)
        ):
            raise ValueError(
                f"its pyramid must name classes and times up to {MOST_LARGER}, not {name} {list(times)}"
            )
        closer = tuple(float(one) for one in each.get("closer", ()))
        if not all(1 < one <= MOST_CLOSER and one not in times for one in closer):
            raise ValueError(
                f"its pyramid must look closer at other times above 1, up to {MOST_CLOSER}, not {list(closer)}"
            )
        if not (0 < known_px < math.inf and 0 < octaves < math.inf and math.isfinite(shift)):
            raise ValueError(
                f"its pyramid must have a size and octaves above 0 and a shift, not {known_px}, {octaves} and {shift}"
            )
        found[name] = Pyramid(times, known_px, octaves, shift, closer)
    return found


def _calibration(fields: Mapping[str, Any], classes: Sequence[str]) -> dict[str, ScoreCalibration]:
    found = {}
    for name, each in fields.get("calibration", {}).items():
        slope, shift = float(each["slope"]), float(each["shift"])
        if name not in classes or not 0 < slope < math.inf or not math.isfinite(shift):
            raise ValueError(
                f"its calibration must name classes, with a slope above 0 and a shift, not {name}, {slope} and {shift}"
            )
        found[name] = ScoreCalibration(slope, shift)
    return found


def _words(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def _reason(error: Exception) -> str:
    if isinstance(error, KeyError):
        return f"it lacks {error}"
    return str(error)

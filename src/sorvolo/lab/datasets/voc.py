"""Pascal VOC: an XML file for each picture, with boxes in pixels counted from 1."""

from dataclasses import replace
from math import isfinite, nan
from pathlib import Path
from typing import Any

from defusedxml import ElementTree
from defusedxml.common import DefusedXmlException

from sorvolo.errors import InputError
from sorvolo.lab.datasets.parsed import (
    LabelFinding,
    ParsedBox,
    ParsedPicture,
    ParsedSet,
    label_files,
    paired,
    pictures_around,
    read_text,
)

FORM = "Pascal VOC"


def read_voc(place: Path) -> ParsedSet:
    """A folder with XML files (`Annotations/`, or beside the pictures), or one such file; pictures by the same stem.

    Objects marked `difficult` are regions to ignore. The devkit's boxes name their first and last pixel, counted from
    1; a set with a box that starts at 0 counts edges from 0 instead, and is read so throughout. Raises InputError when
    no XML file is of this form.
    """
    labelled, findings = _annotations(place)
    pictures = pictures_around(place, FORM)
    if not place.is_dir():
        pictures = [path for path in pictures if path.stem == place.stem]
    label_of, lonely = paired(pictures, labelled, place, FORM)
    findings += lonely
    from_zero = any(min(box.left, box.top) < 0 for each in labelled.values() for box in each.boxes)
    if from_zero:
        findings.append(LabelFinding("counted_from_zero", str(place), len(labelled)))
    result = []
    for path in pictures:
        found = labelled[label_of[path]] if path in label_of else ParsedPicture(path, ())
        # Boxes that were read as counted from 1, as they are when edges are counted from 0
        boxes = (
            tuple(box._replace(left=box.left + 1, top=box.top + 1) for box in found.boxes)
            if from_zero
            else found.boxes
        )
        result.append(replace(found, path=path, boxes=boxes))
    return ParsedSet(FORM, tuple(result), findings=tuple(findings))


def looks_like_voc(path: Path) -> bool:
    """Whether an XML file begins as an annotation."""
    return "<annotation" in read_text(path)[:2000]


def _annotations(place: Path) -> tuple[dict[Path, ParsedPicture], list[LabelFinding]]:
    """Every XML file of this form, and what of them is none. Raises InputError when there is none."""
    files = label_files(place, ending=".xml")
    labelled: dict[Path, ParsedPicture] = {}
    findings = []
    for path in files:
        picture, malformed = _parsed(path)
        if malformed:
            findings.append(LabelFinding("malformed_labels", path.name, malformed))
        if picture is not None:
            labelled[path] = picture
    if not labelled:
        raise InputError(f"{place}: none of its {len(files)} XML files is a {FORM} annotation")
    return labelled, findings


def _parsed(path: Path) -> tuple[ParsedPicture | None, int]:
    """The annotated picture, None of a file that is no annotation; and how much of the file cannot be read."""
    try:
        root = ElementTree.fromstring(path.read_bytes())
    except (ElementTree.ParseError, DefusedXmlException, OSError, ValueError, LookupError):
        return None, 1
    if root.tag != "annotation":
        return None, 1
    objects = [_box(each) for each in root.iterfind("object")]
    boxes = tuple(box for box in objects if box is not None)
    size = _number(root, "size/width"), _number(root, "size/height")
    picture = ParsedPicture(path, boxes, size if size[0] > 0 and size[1] > 0 else None)
    return picture, len(objects) - len(boxes)


def _box(element: Any) -> ParsedBox | None:
    """The box of an `object` element; None without a name or with an edge that is no number."""
    left, top, right, bottom = (
        _number(element, f"bndbox/{name}") for name in ("xmin", "ymin", "xmax", "ymax")
    )
    name = (element.findtext("name") or "").strip()
    if not name or not all(isfinite(edge) for edge in (left, top, right, bottom)):
        return None
    return ParsedBox(name, left - 1, top - 1, right, bottom, _number(element, "difficult") == 1)


def _number(element: Any, path: str) -> float:
    """The number at a path below an element; NaN where there is none."""
    try:
        value = float((element.findtext(path) or "").strip())
    except ValueError:
        return nan
    return value if isfinite(value) else nan

"""Camera files as flat nodes: XML, YAML and JSON of OpenCV, ROS and our own look alike behind this file.

A node's key is its name in lower-case letters and digits only, so that `Camera_Matrix`, `camera_matrix` and
`cameraMatrix` are one. Its value is a number, a text or a float64 array, (rows, cols) for a matrix.
"""

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias
from xml.etree.ElementTree import Element

import numpy as np
from defusedxml import ElementTree
from defusedxml.common import DefusedXmlException

from sorvolo.capture.small_files import read_small_file, text_of
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats

Node: TypeAlias = float | str | Floats

_MOST_BYTES = 4_000_000  # a camera file has kilobytes; by choice
_NUMBER = re.compile(
    r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?\.?(?:inf|nan)", re.IGNORECASE
)


def read_nodes(path: Path) -> Mapping[str, Node]:
    """The nodes of a camera file, recognised by its first character.

    Raises InputError for a file that is missing, empty, far too large, or no XML, YAML or JSON.
    """
    raw = read_small_file(path, "camera file", _MOST_BYTES)
    text = text_of(path, raw, "camera file", "XML, YAML or JSON with named values")
    if text.startswith("<"):
        nodes = _from_xml(path, text)
    elif text.startswith("{"):
        nodes = _from_json(path, text)
    else:
        nodes = _from_yaml(path, text)
    if not nodes:
        raise InputError(
            f"{path}: not a camera file: neither XML, YAML nor JSON with named values was found"
        )
    return nodes


def _from_xml(path: Path, text: str) -> dict[str, Node]:
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, DefusedXmlException, ValueError) as error:
        raise InputError(f"{path}: broken XML: {error}") from error
    nodes: dict[str, Node] = {}
    for element in _named_elements(root):
        children = {child.tag: (child.text or "") for child in element}
        if "data" in children:
            value: Node = _matrix(path, element.tag, children)
        else:
            value = _scalar_or_array(element.text or "")
        nodes.setdefault(_key(element.tag), value)
    return nodes


def _named_elements(parent: Element) -> Iterator[Element]:
    """The leaves and the matrices under `parent`, a matrix as one."""
    for child in parent:
        if len(child) == 0 or child.find("data") is not None:
            yield child
        else:
            yield from _named_elements(child)


def _from_json(path: Path, text: str) -> dict[str, Node]:
    nodes: dict[str, Node] = {}
    try:
        _flatten_json(path, json.loads(text), nodes)
    except (
        ValueError,
        RecursionError,
    ) as error:  # a whole number of thousands of digits is a plain ValueError
        raise InputError(f"{path}: broken JSON: {error}") from error
    return nodes


def _flatten_json(path: Path, tree: Mapping[str, Any], nodes: dict[str, Node]) -> None:
    for name, value in tree.items():
        if isinstance(value, dict) and "data" in value:
            children = {each: json.dumps(inner) for each, inner in value.items()}
            nodes.setdefault(_key(name), _matrix(path, name, children))
        elif isinstance(value, dict):
            _flatten_json(path, value, nodes)
        elif isinstance(value, list):
            nodes.setdefault(_key(name), _array(path, name, value))
        elif isinstance(value, str):
            nodes.setdefault(_key(name), value)
        elif isinstance(value, bool):
            nodes.setdefault(_key(name), str(value).lower())
        elif isinstance(value, int | float):
            nodes.setdefault(_key(name), _number(str(value)))


def _from_yaml(path: Path, text: str) -> dict[str, Node]:
    """OpenCV's and ROS's YAML: top-level keys, each with a scalar, a [list], or rows, cols, dt and data."""
    nodes: dict[str, Node] = {}
    blocks = re.split(r"^(?=[A-Za-z_]\w*\s*:)", text, flags=re.MULTILINE)
    for block in blocks:
        named = re.match(r"([A-Za-z_]\w*)\s*:(.*)", block, flags=re.DOTALL)
        if named is None:
            continue
        name, body = named.groups()
        fields = dict(re.findall(r"^\s+(rows|cols|dt)\s*:\s*(\S+)", body, flags=re.MULTILINE))
        data = re.search(r"\bdata\s*:\s*\[(.*?)\]", body, flags=re.DOTALL)
        if data is not None:
            nodes.setdefault(_key(name), _matrix(path, name, {**fields, "data": data.group(1)}))
        else:
            nodes.setdefault(_key(name), _scalar_or_array(body.strip().strip("[]")))
    return nodes


def _matrix(path: Path, name: str, children: Mapping[str, str]) -> Floats:
    """An OpenCV matrix as (rows, cols); raises InputError when its data do not fill it."""
    kind = children.get("dt", "d").strip().strip('"')
    if kind not in ("d", "f", "i"):
        raise InputError(
            f"{path}: {name} holds values of type {kind!r}; numbers (d, f or i) are needed"
        )
    numbers = np.array([_number(each) for each in _NUMBER.findall(children["data"])])
    rows = children.get("rows", "1").strip()
    columns = children.get("cols", str(len(numbers))).strip()
    is_shape = all(re.fullmatch(r"[0-9]{1,6}", each) for each in (rows, columns))
    if not (is_shape and int(rows) * int(columns) == len(numbers)):
        raise InputError(
            f"{path}: {name} should hold {rows[:20]} x {columns[:20]} numbers but has {len(numbers)}"
        )
    return numbers.reshape(int(rows), int(columns))


def _array(path: Path, name: str, values: list[Any]) -> Floats:
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{path}: {name} is not a list of numbers that a camera can have"
        ) from error


def _scalar_or_array(text: str) -> Node:
    plain = text.strip().strip('"')
    words = plain.replace(",", " ").split()
    if not words or not all(_NUMBER.fullmatch(word) for word in words):
        return plain
    numbers = [_number(word) for word in words]
    return numbers[0] if len(numbers) == 1 else np.array(numbers)


def _number(text: str) -> float:
    """YAML writes .nan and .inf where Python reads nan and inf."""
    return float(re.sub(r"\.(?=[a-zA-Z])", "", text))


def _key(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())

"""A TensorFlow.js graph model: its nodes and weights read, and run in plain NumPy to check what is made from it."""

import base64
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Numbers

_MOST_BYTES = 1 << 28  # of a graph's weights; the one that we read has 7.6 MB
_STORED = {"float16": "<f2", "float32": "<f4", "int32": "<i4", "bool": "?"}


@dataclass(frozen=True)
class Node:
    """One operation: its inputs are names of nodes, "name:k" the k-th output of one."""

    name: str
    op: str
    inputs: tuple[str, ...]
    attributes: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class TfjsGraph:
    """Nodes by name and the values of the constants among them; `outputs` are the names that the signature gives."""

    nodes: Mapping[str, Node]
    constants: Mapping[str, Numbers]
    outputs: tuple[str, ...]
    origin: str


def read_graph(path: Path) -> TfjsGraph:
    """The graph model described by a .json file whose weight shards lie beside it.

    Raises InputError where a file is missing, damaged, or no graph model with plain (float16 or float32) weights.
    """
    try:
        described = json.loads(path.read_text())
        nodes = {each["name"]: _node(each) for each in described["modelTopology"]["node"]}
        constants: dict[str, Numbers] = {}
        for group in described["weightsManifest"]:
            data = b"".join(_shard(path, each) for each in group["paths"])
            constants.update(_weights(group["weights"], data))
        signature = described.get("signature", {}).get("outputs", {})
        return TfjsGraph(
            nodes, constants, tuple(sorted(each.split(":")[0] for each in signature)), str(path)
        )
    except OSError as error:
        place = error.filename or path
        raise InputError(
            f"no graph model at {place}: the .json and its .bin files are needed"
        ) from error
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} is no TensorFlow.js graph model with plain weights ({type(error).__name__}: {error})"
        ) from error


def run_graph(
    graph: TfjsGraph, feed: Mapping[str, Numbers], wanted: Sequence[str]
) -> dict[str, Numbers]:
    """The values of the nodes `wanted` when the placeholders have the values of `feed`, computed in NumPy.

    Follows TensorFlow's definitions node by node; slow. Raises InputError for an operation that is not known here.
    """
    values: dict[str, list[Numbers]] = {name: [each] for name, each in feed.items()}

    def value(reference: str) -> Numbers:
        name, _, output = reference.partition(":")
        return values[name][int(output or 0)]

    for node in _in_order(graph, wanted):
        if node.name in graph.constants:
            values[node.name] = [graph.constants[node.name]]
        elif node.name not in values:
            if node.op not in _OPERATIONS:
                raise InputError(
                    f"{graph.origin}: {node.op} ({node.name}) is no operation that is known here"
                )
            out = _OPERATIONS[node.op](node, [value(each) for each in node.inputs])
            values[node.name] = out if isinstance(out, list) else [out]
    return {name: value(name) for name in wanted}


def _node(row: Mapping[str, Any]) -> Node:
    inputs = tuple(str(each) for each in row.get("input", []) if not str(each).startswith("^"))
    return Node(str(row["name"]), str(row["op"]), inputs, row.get("attr", {}))


def _shard(path: Path, name: str) -> bytes:
    if Path(name).name != name:
        raise ValueError(f"its shard {name!r} lies in another folder")
    shard = path.parent / name
    if shard.stat().st_size > _MOST_BYTES:
        raise ValueError(f"its shard {name!r} has more than {_MOST_BYTES >> 20} MB")
    return shard.read_bytes()


def _weights(entries: Sequence[Mapping[str, Any]], data: bytes) -> dict[str, Numbers]:
    """Float weights come as float32, whatever they were stored as."""
    out: dict[str, Numbers] = {}
    start = 0
    for entry in entries:
        quantised = entry.get("quantization", {})
        stored = str(quantised.get("dtype", entry["dtype"]))
        if stored not in _STORED or "scale" in quantised:
            raise ValueError(f"{entry['name']} is stored as {stored} with a scale")
        kind = np.dtype(_STORED[stored])
        count = int(np.prod(entry["shape"], dtype=np.int64))
        values = np.frombuffer(data, kind, count, start).reshape(entry["shape"])
        out[str(entry["name"])] = values.astype(np.float32) if kind.kind == "f" else values
        start += count * kind.itemsize
    if start != len(data):
        raise ValueError(f"its shards have {len(data)} bytes, its manifest describes {start}")
    return out


def _in_order(graph: TfjsGraph, wanted: Sequence[str]) -> list[Node]:
    """The nodes that `wanted` depend on, each after its inputs."""
    order: dict[str, Node] = {}
    stack = [(each.partition(":")[0], False) for each in wanted]
    while stack:
        name, is_ready = stack.pop()
        if name in order:
            continue
        if name not in graph.nodes:
            raise InputError(f"{graph.origin}: there is no node {name}")
        node = graph.nodes[name]
        if is_ready:
            order[name] = node
        else:
            stack.append((name, True))
            stack += [(each.partition(":")[0], False) for each in node.inputs]
    return list(order.values())


def _text(node: Node, key: str) -> str:
    return base64.b64decode(node.attributes[key]["s"]).decode()


def _numbers(node: Node, key: str) -> list[int]:
    return [int(each) for each in node.attributes[key]["list"]["i"]]


def _windows(x: Numbers, height: int, width: int, strides: Sequence[int]) -> Numbers:
    """(N, H', W', C, height, width) views of (N, H, W, C)."""
    views: Any = np.lib.stride_tricks.sliding_window_view(x, (height, width), (1, 2))
    return views[:, :: strides[1], :: strides[2]]


def _valid_nhwc(node: Node, strides_key: str = "strides") -> list[int]:
    dilations = _numbers(node, "dilations") if "dilations" in node.attributes else [1]
    if (
        _text(node, "padding") != "VALID"
        or _text(node, "data_format") != "NHWC"
        or max(dilations) > 1
    ):
        raise InputError(f"{node.name}: only undilated NHWC windows without padding are known here")
    return _numbers(node, strides_key)


def _convolved(node: Node, inputs: Sequence[Numbers]) -> Numbers:
    x, kernel = inputs  # kernel (height, width, in, out)
    views = _windows(x, kernel.shape[0], kernel.shape[1], _valid_nhwc(node))
    return np.tensordot(views, kernel, ((4, 5, 3), (0, 1, 2)))


def _pooled(node: Node, inputs: Sequence[Numbers]) -> Numbers:
    side = _numbers(node, "ksize")
    return _windows(inputs[0], side[1], side[2], _valid_nhwc(node)).max((-2, -1))


def _padded(_: Node, inputs: Sequence[Numbers]) -> Numbers:
    filling = float(inputs[2]) if len(inputs) > 2 else 0.0
    padded: Any = np.pad(inputs[0], inputs[1].tolist(), constant_values=filling)
    return padded


def _resized(node: Node, inputs: Sequence[Numbers]) -> Numbers:
    """Bilinear with half-pixel centres, as TensorFlow's ResizeBilinear."""
    if not node.attributes["half_pixel_centers"]["b"] or node.attributes["align_corners"]["b"]:
        raise InputError(f"{node.name}: only half-pixel centres are known here")
    out = inputs[0]
    for axis, length in zip((1, 2), inputs[1].tolist()):
        own = out.shape[axis]
        place = (np.arange(length) + 0.5) * own / length - 0.5
        low = np.floor(place)
        share = (
            (place - low)
            .reshape([-1 if each == axis else 1 for each in range(4)])
            .astype(np.float32)
        )
        first, second = (np.clip(low + step, 0, own - 1).astype(int) for step in (0, 1))
        out = out.take(first, axis) * (1 - share) + out.take(second, axis) * share
    return out


def _split(_: Node, inputs: Sequence[Numbers]) -> list[Numbers]:
    parts: list[Any] = np.split(inputs[0], np.cumsum(inputs[1])[:-1], int(inputs[2]))
    return parts


def _sparse_to_dense(_: Node, inputs: Sequence[Numbers]) -> Numbers:
    places, shape, values, filling = inputs
    out = np.full(shape, filling)
    out[tuple(np.reshape(places, (-1, len(out.shape))).T)] = values
    return out


_OPERATIONS: Mapping[str, Callable[[Node, Sequence[Numbers]], Any]] = {
    "Add": lambda _, x: x[0] + x[1],
    "AddV2": lambda _, x: x[0] + x[1],
    "ConcatV2": lambda _, x: np.concatenate(x[:-1], int(x[-1])),
    "Conv2D": _convolved,
    "Identity": lambda _, x: x[0],
    "LeakyRelu": lambda node, x: np.where(
        x[0] > 0, x[0], np.float32(node.attributes["alpha"]["f"]) * x[0]
    ),
    "MaxPool": _pooled,
    "Pad": _padded,
    "PadV2": _padded,
    "Reshape": lambda _, x: x[0].reshape(x[1].tolist()),
    "ResizeBilinear": _resized,
    "Sigmoid": lambda _, x: 1 / (1 + np.exp(-x[0])),
    "SparseToDense": _sparse_to_dense,
    "SplitV": _split,
    "Transpose": lambda _, x: x[0].transpose(x[1].tolist()),
}

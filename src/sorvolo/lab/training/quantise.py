"""A model's convolutions in whole numbers of eight bits, scaled by what real pictures make of them; needs onnx."""

import json
import logging
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sorvolo.detection.contract import METADATA_KEY
from sorvolo.detection.engine import INPUT, Planes
from sorvolo.detection.session import Session
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import ImageRGB

LEAST_PICTURES = 8
"""With fewer pictures the ranges of the numbers are a matter of chance."""

_CARRIERS = frozenset(
    {
        "Conv",
        "Relu",
        "LeakyRelu",
        "Clip",
        "Add",
        "Concat",
        "MaxPool",
        "AveragePool",
        "Resize",
        "RoiAlign",
        "ReduceMean",
    }
)
# carry features on, but one interpolates at places that eight bits cannot name, the other means away their rounding
_FLOAT = frozenset({"RoiAlign", "ReduceMean"})
_HALF = 10  # ONNX's number for float16, in which a model may store weights
_ACTIVATIONS = frozenset({"Relu", "LeakyRelu", "Clip"})
_READERS = frozenset({"Conv", "Gemm"})
_PARTS = ("backbone", "head", "neck", "proposals")  # of a network


@dataclass(frozen=True)
class Quantised:
    """A model in eight bits: the file's bytes, and how many of its convolutions are in whole numbers now."""

    model: bytes
    convolutions: int
    of: int


def quantise(
    path: Path,
    pictures: Iterable[ImageRGB],
    *,
    float_parts: Sequence[str] = (),
    weight_bits: Literal[7, 8] = 8,
) -> Quantised:
    """The model file `path` with its convolutions in int8, by the same contract (its metadata names the precision).

    `pictures` (H, W, 3) are what it will have to see: all lights and grounds, some dozens. Weights are scaled per
    channel, activations by the least and the greatest value that occurs (static quantisation, Q and DQ nodes:
    Jacob et al. 2018). CPUs without VNNI instructions add two products in 16 bits, which eight-bit weights may
    overflow without a word; those of `weight_bits` 7 never do, and round a little more. In float remain the last
    convolutions of each branch, which give scores and places, and all that handles boxes, and the network's parts
    that `float_parts` names ("neck", "proposals", or a piece of one, "backbone/_blocks.0"): what is narrow gains
    little speed and loses most. Whether it is good enough must be measured: `sorvolo evaluate detector` on both.
    Raises InputError for a file that is no model of ours or is in eight bits already and for too few pictures,
    SettingsError where the package onnx is not installed and for a part that the model does not have.
    """
    try:
        import onnx
        from onnxruntime import quantization
    except ImportError as error:
        raise SettingsError(
            "making a model of eight bits needs the package onnx: pip install 'sorvolo[training]'"
        ) from error
    session = Session(path, "cpu")
    if session.info.precision == "int8":
        raise InputError(f"{path} is in eight bits already; give the model that it was made from")
    model = onnx.load_model(path)
    # Weights stored in float16 become float32 where they stand, without a Cast: the quantiser wants them direct
    from onnx import numpy_helper

    halves = {each.name: each for each in model.graph.initializer if each.data_type == _HALF}
    for node in [
        each for each in model.graph.node if each.op_type == "Cast" and each.input[0] in halves
    ]:
        values = numpy_helper.to_array(halves[node.input[0]]).astype(np.float32)
        model.graph.initializer.remove(halves[node.input[0]])
        model.graph.initializer.append(numpy_helper.from_array(values, node.output[0]))
        model.graph.node.remove(node)
    # Weights that come through Identity nodes are read directly, and those nodes go
    weights = {each.name for each in model.graph.initializer}
    given: dict[str, str] = {}
    for node in list(model.graph.node):
        if node.op_type == "Identity" and given.get(node.input[0], node.input[0]) in weights:
            given[node.output[0]] = given.get(node.input[0], node.input[0])
            model.graph.node.remove(node)
    for node in model.graph.node:
        for place, name in enumerate(node.input):
            node.input[place] = given.get(name, name)
    # Give each node without a name one of its own: the quantiser knows nodes by name
    for index, node in enumerate(model.graph.node):
        node.name = node.name or f"{node.op_type}_{index}"
    chosen = _chosen(model.graph, path, float_parts)
    samples = _Samples(session, pictures)
    with tempfile.TemporaryDirectory() as folder, _quiet():
        out = Path(folder) / "int8.onnx"
        quantization.quantize_static(
            model,
            out,
            samples,
            quant_format=quantization.QuantFormat.QDQ,
            per_channel=True,
            activation_type=quantization.QuantType.QUInt8,
            weight_type=quantization.QuantType.QInt8,
            reduce_range=weight_bits == 7,
            nodes_to_quantize=chosen,
            op_types_to_quantize=sorted(_CARRIERS - _FLOAT),
        )
        quantised = onnx.load_model(out)
    pool_before_rounding(quantised.graph)
    if samples.count < LEAST_PICTURES:
        raise InputError(
            f"{samples.count} pictures are too few to measure how large a model's numbers become; needed are "
            f"{LEAST_PICTURES} or more, of all lights and grounds"
        )
    metadata = {each.key: each.value for each in model.metadata_props}
    metadata[METADATA_KEY] = json.dumps(json.loads(metadata[METADATA_KEY]) | {"precision": "int8"})
    onnx.helper.set_model_props(quantised, metadata)
    convolutions = {node.name for node in model.graph.node if node.op_type == "Conv"}
    return Quantised(
        quantised.SerializeToString(), len(convolutions & set(chosen)), len(convolutions)
    )


def _chosen(graph: Any, path: Path, float_parts: Sequence[str]) -> list[str]:
    """The nodes to quantise. Raises SettingsError for a part that the graph lacks, InputError where none is left."""
    names = [node.name for node in graph.node]
    if unknown := [part for part in float_parts if not _has_part(names, part)]:
        raise SettingsError(
            f"{path} has no part {', '.join(unknown)}; it has {', '.join(_parts_of(names))}"
        )
    chosen = [
        name
        for name in _quantisable(graph)
        if not any(_lies_in(name, part) for part in float_parts)
    ]
    if not chosen:
        raise InputError(
            f"{path} has no convolutions that lead to others: eight bits would gain nothing"
        )
    return chosen


def _parts_of(nodes: Sequence[str]) -> list[str]:
    """The parts of a network, or of each network in a file that holds several, such as "aerial/neck"."""
    networks = sorted({node.split("/")[1] for node in nodes if node.count("/") > 1} - set(_PARTS))
    return [
        part
        for part in (*_PARTS, *(f"{network}/{each}" for network in networks for each in _PARTS))
        if _has_part(nodes, part)
    ]


def _has_part(nodes: Sequence[str], part: str) -> bool:
    return any(_lies_in(node, part) for node in nodes)


def _lies_in(node: str, part: str) -> bool:
    """Whether a node of the graph, named by its path, belongs to a part of the network."""
    return f"{node}/".startswith(f"/{part}/")


def pool_before_rounding(graph: Any) -> None:
    """Let a pool behind a layer in float take the largest number before it is rounded: the same, and much quicker.

    ONNX Runtime has no quick pool of eight bits, and there is a quarter of the numbers left to round.
    """
    makers = {name: node for node in graph.node for name in node.output}
    readers = Counter(name for node in graph.node for name in node.input)
    for pool in [node for node in graph.node if node.op_type == "MaxPool"]:
        match _rounding_of(pool.input[0], makers):
            case back, rounding if _is_float(rounding.input[0], makers) and _are_read_once(
                readers, back, rounding
            ):
                pool.input[0] = rounding.input[0]
                graph.node.remove(back)
                graph.node.remove(rounding)


def _are_read_once(readers: Mapping[str, int], *nodes: Any) -> bool:
    return all(readers[node.output[0]] == 1 for node in nodes)


def _rounding_of(name: str, makers: Mapping[str, Any]) -> tuple[Any, Any] | None:
    """The nodes that round a tensor and make it float again, the last first; None where it is not rounded."""
    back = makers.get(name)
    if back is None or back.op_type != "DequantizeLinear":
        return None
    rounding = makers.get(back.input[0])
    return None if rounding is None or rounding.op_type != "QuantizeLinear" else (back, rounding)


def _is_float(name: str, makers: Mapping[str, Any]) -> bool:
    """Whether a tensor comes out of a layer in float."""
    while name in makers and makers[name].op_type in _ACTIVATIONS:
        name = makers[name].input[0]
    return name in makers and _rounding_of(makers[name].input[0], makers) is None


@contextmanager
def _quiet() -> Iterator[None]:
    """The quantiser advises on the terminal to do what was done already."""
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(logging.NOTSET)


class _Samples:
    """Pictures as the quantiser asks for them: one input after another, then None."""

    def __init__(self, session: Session, pictures: Iterable[ImageRGB]) -> None:
        self.count = 0
        self._inputs: Iterator[Planes] = (session.input_from(each) for each in pictures)

    def get_next(self) -> dict[str, Planes] | None:
        batch = next(self._inputs, None)
        if batch is None:
            return None
        self.count += 1
        return {INPUT: np.array(batch)}

    def set_range(self, start_index: int, end_index: int) -> None:
        """Not for inputs of different sizes; the quantiser asks only where it may go in strides."""


def _quantisable(graph: Any) -> list[str]:
    """Names of the nodes that carry features from one layer with weights to the next, convolutions included.

    The last convolution of a branch (its output reaches no such layer) is not among them, nor is what works on boxes.
    """
    nodes = list(graph.node)
    carried, leads_on = _carried(nodes), _leading_on(nodes)
    return [
        node.name
        for node in nodes
        if node.op_type in _CARRIERS - _FLOAT
        and node.output[0] in carried
        and node.output[0] in leads_on
    ]


def _carried(nodes: Sequence[Any]) -> set[str]:
    """The tensors that come from a convolution through carriers alone."""
    carried: set[str] = set()
    for node in nodes:
        if node.op_type == "Conv" or (node.op_type in _CARRIERS and _features_in(node) & carried):
            carried.update(node.output[:1])
    return carried


def _leading_on(nodes: Sequence[Any]) -> set[str]:
    """The tensors from which another layer with weights is reached through carriers alone."""
    made = {name for node in nodes for name in node.output}
    leads_on: set[str] = set()
    for node in reversed(nodes):
        if node.op_type in _READERS or (node.op_type in _CARRIERS and node.output[0] in leads_on):
            leads_on.update(name for name in _features_in(node) if name in made)
    return leads_on


def _features_in(node: Any) -> set[str]:
    """The inputs of a node that hold features: all of a sum or a row, the first of the others."""
    return set(node.input) if node.op_type in ("Add", "Concat") else set(node.input[:1])

"""An ONNX model made ready to run, here and now, by ONNX Runtime or OpenVINO; the only place that knows them."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sorvolo.detection.contract import METADATA_KEY, ModelInfo, info_from_metadata
from sorvolo.detection.layouts import (
    LAYOUTS,
    WISH_KEY,
    Port,
    picture_input,
    resolved,
    runner,
)
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import Numbers

Provider = Literal["auto", "cpu", "cuda", "openvino"]
"""Where a model runs; "auto" takes CUDA where there is one, else OpenVINO where it is installed, else the CPU."""

Planes: TypeAlias = NDArray[np.uint8]
"""(1, 3, H, W): a picture as a model takes it."""

Run = Callable[[Planes], tuple[Numbers, ...]]
"""A picture's planes to boxes, scores and labels."""

INPUT, OUTPUTS = "image", ("boxes", "scores", "labels")
CUDA = "CUDAExecutionProvider"
_OPENVINO_PRECISION = "f32"


@dataclass(frozen=True)
class Engine:
    """A model that runs: `provider` in words, its `metadata` as it stands in the file, and what that means.

    `fixed_px` is the (height, width) of its input where the model takes only one size, else None. `rest`
    gives back memory that it keeps between pictures.
    """

    run: Run
    provider: str
    metadata: str
    info: ModelInfo
    fixed_px: tuple[int, int] | None
    rest: Callable[[], None] = lambda: None


def open_engine(model: bytes, where: str, provider: Provider, threads: int) -> Engine:
    """The model `where` made ready. Raises InputError where it is damaged or none of ours, SettingsError for a
    provider that is not installed."""
    if provider in ("auto", "cuda") and (on_gpu := _cuda_engine(model, where, threads)):
        return on_gpu
    if provider == "cuda":
        raise SettingsError(
            "CUDA is not to be had here: install onnxruntime-gpu in place of onnxruntime, with a driver and CUDA of "
            "its version, or choose the provider cpu"
        )
    refused = ""
    if provider in ("auto", "openvino"):
        # before OpenVINO sees it: that crashes on some models that break the contract
        described = describe(model, where)
        try:
            run = _openvino_runner(model, threads, described, where)
        except ImportError as error:
            if provider == "openvino":
                raise SettingsError(
                    "OpenVINO is not installed: pip install 'sorvolo[openvino]', or choose the provider cpu"
                ) from error
        except RuntimeError as error:
            if provider == "openvino":
                reason = " ".join(str(error).split())[:200]
                raise InputError(
                    f"{where}: OpenVINO refuses it ({reason}); choose the provider cpu"
                ) from error
            refused = ", since OpenVINO refuses the model"
        else:
            return replace(
                described,
                run=run,
                provider=f"OpenVINO on the CPU, {_count(threads)}",
                rest=lambda: None,
            )
    session = _onnx_session(model, where, threads, ["CPUExecutionProvider"])
    return _engine(f"ONNX Runtime on the CPU, {_count(threads)}{refused}", session, where)


def describe(model: bytes, where: str) -> Engine:
    """The model opened only to be asked what it is like: quick, since nothing is optimised."""
    session = _onnx_session(model, where, 1, ["CPUExecutionProvider"], optimise=False)
    return _engine("nowhere yet", session, where)


def _cuda_engine(model: bytes, where: str, threads: int) -> Engine | None:
    """The model on the GPU; None where the runtime finds none."""
    import onnxruntime  # 30 MB of memory, for those who detect

    if CUDA not in onnxruntime.get_available_providers():
        return None
    session = _onnx_session(model, where, threads, [CUDA, "CPUExecutionProvider"])
    if session.get_providers()[0] != CUDA:
        return None
    return _engine("ONNX Runtime on the GPU (CUDA)", session, where)


def _engine(provider: str, session: Any, where: str) -> Engine:
    metadata = dict(session.get_modelmeta().custom_metadata_map)
    inputs = _ports(session.get_inputs())

    def call(feeds: Mapping[str, Any]) -> dict[str, Numbers]:
        names = [each.name for each in session.get_outputs()]
        return dict(zip(names, session.run(names, feeds)))

    if WISH_KEY in metadata:
        wish = json.loads(metadata[WISH_KEY])
        metadata[METADATA_KEY] = json.dumps(resolved(wish, metadata, inputs, call, where))
    info = info_from_metadata(metadata, where)
    if info.layout:
        fixed_px = picture_input(inputs, where)[1]
        return Engine(
            _foreign(info, inputs, call, where), provider, metadata[METADATA_KEY], info, fixed_px
        )
    fixed_px = _input_size(session, where, info.stride)

    def run(planes: Planes) -> tuple[Numbers, ...]:
        return tuple(session.run(list(OUTPUTS), {INPUT: planes}))

    side_px = fixed_px or (info.stride, info.stride)
    return Engine(
        run,
        provider,
        metadata[METADATA_KEY],
        info,
        fixed_px,
        lambda: _shrink(session, side_px),
    )


def _ports(found: Sequence[Any]) -> list[Port]:
    kinds = (each.type.removeprefix("tensor(").removesuffix(")") for each in found)
    return [Port(each.name, kind, tuple(each.shape)) for each, kind in zip(found, kinds)]


def _foreign(
    info: ModelInfo,
    inputs: Sequence[Port],
    call: Callable[[Mapping[str, Any]], Mapping[str, Numbers]],
    where: str,
) -> Run:
    if info.layout not in LAYOUTS:
        raise InputError(
            f"{where} has the layout {info.layout!r}; this version knows {', '.join(LAYOUTS)}"
        )
    return runner(info.layout, info.columns, info.classes, inputs, call, where)


def _shrink(session: Any, side_px: tuple[int, int]) -> None:
    """Have ONNX Runtime free the memory that it holds for pictures as large as those so far; 300 MB for 1080p.

    Memory is freed only after a run, so run the smallest input; it takes 0.06 s of processor time.
    """
    import onnxruntime

    options = onnxruntime.RunOptions()
    options.add_run_config_entry("memory.enable_memory_arena_shrinkage", "cpu:0")
    session.run([OUTPUTS[0]], {INPUT: np.zeros((1, 3, *side_px), np.uint8)}, options)


def _count(threads: int) -> str:
    return "1 thread" if threads == 1 else f"{threads} threads"


def _onnx_session(
    model: bytes, where: str, threads: int, providers: list[str], *, optimise: bool = True
) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    # threads that spin while they wait take the processor from who works beside: the mapping, the decoder
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.enable_mem_pattern = (
        False  # a block for all of a picture's layers: two thirds more memory, no quicker
    )
    options.log_severity_level = 4
    level = onnxruntime.GraphOptimizationLevel
    options.graph_optimization_level = level.ORT_ENABLE_ALL if optimise else level.ORT_DISABLE_ALL
    if CUDA in providers:
        onnxruntime.preload_dlls()
    try:
        return onnxruntime.InferenceSession(model, options, providers=providers)
    except Exception as error:  # the runtime's own classes share no base but this
        raise InputError(f"{where} cannot be run: {_refusal(str(error))}") from error


def _refusal(message: str) -> str:
    """Why the runtime refuses a model, and what to do."""
    import onnxruntime

    runtime = f"ONNX Runtime {onnxruntime.__version__}"
    first = " ".join(message.split())[:200]
    if "IR version" in message or "opset" in message.lower():
        return f"it is of a newer ONNX than {runtime} reads ({first}); update onnxruntime, or export with opset 17"
    if "Protobuf" in message or "protobuf" in message:
        return f"it is damaged or no ONNX file ({first}); copy or fetch it again"
    return f"{runtime} refuses it ({first}); export it again with opset 17"


def _openvino_runner(model: bytes, threads: int, described: Engine, where: str) -> Run:
    import openvino

    core = openvino.Core()
    wishes = {
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_NUM_THREADS": threads,
        "INFERENCE_PRECISION_HINT": _OPENVINO_PRECISION,
    }
    compiled = core.compile_model(core.read_model(model=model), "CPU", wishes)
    request = compiled.create_infer_request()

    def run(planes: Planes) -> tuple[Numbers, ...]:
        request.infer({INPUT: planes}, share_inputs=True)
        return tuple(request.get_tensor(name).data.copy() for name in OUTPUTS)

    def call(feeds: Mapping[str, Any]) -> dict[str, Numbers]:
        found = request.infer(dict(feeds))
        return {port.any_name: array.copy() for port, array in found.items()}

    if described.info.layout:
        ports = _ports(
            _onnx_session(model, where, 1, ["CPUExecutionProvider"], optimise=False).get_inputs()
        )
        return _foreign(described.info, ports, call, where)
    return run


def _input_size(session: Any, where: str, stride: int) -> tuple[int, int] | None:
    """The (height, width) that the model is fixed to, or None; raises InputError where it breaks the contract."""
    inputs = session.get_inputs()
    outputs = {each.name for each in session.get_outputs()}
    found = ", ".join(f"{each.name} {each.type} {each.shape}" for each in inputs)
    needed = f"one input '{INPUT}', uint8 (1, 3, H, W), and outputs {', '.join(OUTPUTS)}; export the model again"
    if len(inputs) != 1 or inputs[0].name != INPUT or inputs[0].type != "tensor(uint8)":
        raise InputError(f"{where} takes {found}; needed is {needed}")
    if missing := set(OUTPUTS) - outputs:
        lacking, given = ", ".join(sorted(missing)), ", ".join(sorted(outputs))
        raise InputError(f"{where} gives no {lacking}, but {given}; needed is {needed}")
    shape = inputs[0].shape
    if len(shape) != 4 or shape[1] != 3 or (isinstance(shape[0], int) and shape[0] != 1):
        raise InputError(f"{where} takes {found}; needed is {needed}")
    found = f"{where} takes {found}"
    fixed = [isinstance(each, int) for each in shape[2:]]
    if not any(fixed):
        return None
    if not all(fixed):
        raise InputError(
            f"{found}: height and width must be both free or both fixed; export it again"
        )
    if shape[2] % stride or shape[3] % stride:
        raise InputError(f"{found}, but its stride is {stride}; export it again")
    return int(shape[2]), int(shape[3])

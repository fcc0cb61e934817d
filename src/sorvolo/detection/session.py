"""One model file, opened where it runs fastest: a picture in, boxes out; the only place that knows ONNX Runtime."""

import math
import os
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np
import onnxruntime

from sorvolo.detection.contract import ModelInfo, info_from_metadata
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import Anything, BoxesPx, Floats, ImageRGB, TimesNs

Provider = Literal["auto", "cpu", "cuda", "openvino"]
"""Where a model runs; "auto" takes CUDA where there is one, else OpenVINO where it is installed, else the CPU."""

_INPUT, _OUTPUTS = "image", ("boxes", "scores", "labels")
_FILLING = 114
_RUN_CODE = frozenset({".pt", ".pth", ".pkl", ".pickle", ".ckpt", ".bin", ".joblib"})
_OPENVINO_PRECISION = "f32"
_CUDA = "CUDAExecutionProvider"


@dataclass(frozen=True, eq=False)
class Seen:
    """What a model tells of one picture, best first: BoxesPx (N, 4), scores (N,), labels (N,)."""

    boxes_px: BoxesPx
    scores: Floats
    labels: TimesNs


class Session:
    """A model that runs; `info` is what it says of itself, `provider` in words where it runs.

    `fixed_px` is the (height, width) of its input where the model takes only one size, else None: pictures are then
    letterboxed. Pictures given from several threads are seen one after another.
    """

    def __init__(self, path: Path, provider: Provider = "auto", threads: int | None = None) -> None:
        """Open a model file on `threads` cores, None for as many as this process may use.

        Raises InputError for a file that is missing, damaged or none of ours, SettingsError for a provider that is
        not installed.
        """
        if provider not in get_args(Provider):
            raise SettingsError(f"no provider {provider!r}; there are {', '.join(get_args(Provider))}")
        if threads is not None and threads < 1:
            raise SettingsError(f"a model needs at least one thread, not {threads}")
        model = read_model(path)
        self._threads = threads or usable_cores()
        self._run, self.provider, self.info, self.fixed_px = _opened(model, str(path), provider, self._threads)
        self._path = path
        self._buffer: Anything = np.zeros((1, 3, 0, 0), np.uint8)
        self._lock = threading.Lock()

    def see(self, picture: ImageRGB, scale: float = 1.0) -> Seen:
        """What is in one picture, (H, W, 3) RGB of any size, shown `scale` times as large; in its own pixels.

        A model of one input size sees it no larger than that. Raises InputError where the model's answer breaks the
        contract of docs/detector.md.
        """
        height, width = picture.shape[:2]
        with self._lock:
            shown = self._shown(picture, scale)
            boxes, scores, labels = self._run(self._padded(shown))
        back = np.array([width / shown.shape[1], height / shown.shape[0]] * 2, np.float32)
        return self._checked(boxes, scores, labels, back, width, height)

    def input_from(self, picture: ImageRGB) -> Anything:
        """(1, 3, H, W) what the model is given for a picture, (H, W, 3): a size of its own, padded."""
        with self._lock:
            return self._padded(self._shown(picture, 1.0)).copy()

    def _shown(self, picture: ImageRGB, scale: float) -> ImageRGB:
        most = self.fixed_px or (math.inf, math.inf)
        return _resized(picture, min(scale, most[0] / picture.shape[0], most[1] / picture.shape[1]))

    def _padded(self, picture: ImageRGB) -> Anything:
        """(1, 3, H, W) with the picture in its top-left corner, and beyond it the grey that training fills with."""
        height, width = picture.shape[:2]
        stride = self.info.stride
        inner = self.fixed_px or (-(-height // stride) * stride, -(-width // stride) * stride)
        if self._buffer.shape[2:] != inner:
            self._buffer = np.empty((1, 3, *inner), np.uint8)
        planes = self._buffer[0]
        for band in range(3):
            planes[band, :height, :width] = picture[:, :, band]
        planes[:, :height, width:] = _FILLING
        planes[:, height:] = _FILLING
        return self._buffer

    def _checked(
        self, boxes: Anything, scores: Anything, labels: Anything, back: Anything, width: int, height: int
    ) -> Seen:
        count = len(scores)
        if boxes.shape != (count, 4) or labels.shape != (count,):
            raise InputError(
                f"{self._path} answers with boxes {boxes.shape}, scores {scores.shape}, labels {labels.shape}; needed "
                "are (K, 4), (K,), (K,): export the model again"
            )
        if count and not 0 <= labels.min() <= labels.max() < len(self.info.classes):
            raise InputError(
                f"{self._path} answers with label {labels.max()}, but names {len(self.info.classes)} classes: "
                "export it again"
            )
        boxes = np.clip(boxes.astype(np.float32) * back, 0, np.array([width, height, width, height], np.float32))
        # what lies in the padding, or is not a number, is no object of the picture
        real = (boxes[:, 2] > boxes[:, 0]) & (boxes[:, 3] > boxes[:, 1]) & np.isfinite(scores)
        order = np.flatnonzero(real)
        order = order[np.argsort(-scores[order], kind="stable")]
        return Seen(boxes[order], scores[order].astype(np.float64), labels[order].astype(np.int64))


def read_info(path: Path) -> ModelInfo:
    """What a model file says of itself, without making it ready to run. Raises InputError as Session does."""
    return _contract(_described(read_model(path), str(path)), str(path))[0]


def read_model(path: Path) -> bytes:
    """The bytes of an ONNX file; only such files are ever opened, none that could run code of their own."""
    if path.suffix.lower() in _RUN_CODE:
        raise InputError(
            f"{path}: models are .onnx files; others (.pt, .pth, .pkl) can run code when opened, so they are not: "
            "export the model to ONNX"
        )
    if path.suffix.lower() != ".onnx":
        raise InputError(
            f"{path} is no model: those are .onnx files; give one, or a name that `sorvolo models list` shows"
        )
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"there is no model file {path}; `sorvolo models list` shows what is installed") from error
    except OSError as error:
        raise InputError(f"the model file {path} cannot be read ({error.strerror}); check its permissions") from error


def usable_cores() -> int:
    """How many cores this process may use: its affinity, and its container's quota where one is set."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
    except (OSError, ValueError):
        return cores
    return cores if quota == "max" else max(1, min(cores, round(int(quota) / int(period))))


def _resized(picture: ImageRGB, scale: float) -> ImageRGB:
    """The picture, (H, W, 3), at another scale: means where it shrinks, linear between pixels where it grows."""
    height, width = picture.shape[:2]
    size = max(1, round(height * scale)), max(1, round(width * scale))
    if size == (height, width):
        return picture
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(np.ascontiguousarray(picture), size[::-1], interpolation=way), np.uint8)


def _opened(
    model: bytes, where: str, provider: Provider, threads: int
) -> tuple[Any, str, ModelInfo, tuple[int, int] | None]:
    """What runs the model, where in words, what it says of itself, and its input's (height, width) if that is fixed."""
    if provider in ("auto", "cuda") and _CUDA in onnxruntime.get_available_providers():
        session = _onnx_session(model, where, threads, [_CUDA, "CPUExecutionProvider"])
        if session.get_providers()[0] == _CUDA:
            return _runner(session), "ONNX Runtime on the GPU (CUDA)", *_contract(session, where)
    if provider == "cuda":
        raise SettingsError(
            "CUDA is not to be had here: install onnxruntime-gpu in place of onnxruntime, with a driver and CUDA of "
            "its version, or choose the provider cpu"
        )
    refused = ""
    if provider in ("auto", "openvino"):
        described = _described(model, where)
        # before OpenVINO sees it: that crashes on some models that break the contract
        contract = _contract(described, where)
        try:
            run = _openvino_runner(model, threads)
        except ImportError as error:
            if provider == "openvino":
                raise SettingsError(
                    "OpenVINO is not installed: pip install 'sorvolo[openvino]', or choose the provider cpu"
                ) from error
        except RuntimeError as error:
            if provider == "openvino":
                told = " ".join(str(error).split())[:200]
                raise InputError(f"{where}: OpenVINO refuses it ({told}); choose the provider cpu") from error
            refused = ", since OpenVINO refuses the model"
        else:
            return run, f"OpenVINO on the CPU, {_count(threads)}", *contract
    session = _onnx_session(model, where, threads, ["CPUExecutionProvider"])
    return _runner(session), f"ONNX Runtime on the CPU, {_count(threads)}{refused}", *_contract(session, where)


def _contract(session: Any, where: str) -> tuple[ModelInfo, tuple[int, int] | None]:
    """What the model says of itself, and its input's (height, width) if that is fixed; InputError if it breaks it."""
    info = info_from_metadata(session.get_modelmeta().custom_metadata_map, where)
    return info, _input_size(session, where, info.stride)


def _count(threads: int) -> str:
    return "1 thread" if threads == 1 else f"{threads} threads"


def _described(model: bytes, where: str) -> Any:
    """A session that is only asked what the model is like: quick, since nothing is optimised."""
    return _onnx_session(model, where, 1, ["CPUExecutionProvider"], optimise=False)


def _onnx_session(
    model: bytes, where: str, threads: int, providers: list[str], *, optimise: bool = True
) -> Any:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 4
    level = onnxruntime.GraphOptimizationLevel
    options.graph_optimization_level = level.ORT_ENABLE_ALL if optimise else level.ORT_DISABLE_ALL
    if _CUDA in providers:
        onnxruntime.preload_dlls()
    try:
        return onnxruntime.InferenceSession(model, options, providers=providers)
    except Exception as error:  # the runtime's own classes share no base but this
        raise InputError(f"{where} cannot be run: {_refusal(str(error))}") from error


def _refusal(told: str) -> str:
    """Why the runtime refuses a model, and what to do."""
    runtime = f"ONNX Runtime {onnxruntime.__version__}"
    first = " ".join(told.split())[:200]
    if "IR version" in told or "opset" in told.lower():
        return f"it is of a newer ONNX than {runtime} reads ({first}); update onnxruntime, or export with opset 17"
    if "Protobuf" in told or "protobuf" in told:
        return f"it is damaged or no ONNX file ({first}); copy or fetch it again"
    return f"{runtime} refuses it ({first}); export it again with opset 17"


def _runner(session: Any) -> Any:
    def run(batch: Anything) -> tuple[Anything, ...]:
        return tuple(session.run(list(_OUTPUTS), {_INPUT: batch}))

    return run


def _openvino_runner(model: bytes, threads: int) -> Any:
    import openvino

    core = openvino.Core()
    wishes = {
        "PERFORMANCE_HINT": "LATENCY", "INFERENCE_NUM_THREADS": threads,
        "INFERENCE_PRECISION_HINT": _OPENVINO_PRECISION,
    }
    compiled = core.compile_model(core.read_model(model=model), "CPU", wishes)
    request = compiled.create_infer_request()

    def run(batch: Anything) -> tuple[Anything, ...]:
        request.infer({_INPUT: batch}, share_inputs=True)
        return tuple(request.get_tensor(name).data.copy() for name in _OUTPUTS)

    return run


def _input_size(session: Any, where: str, stride: int) -> tuple[int, int] | None:
    """The (height, width) that the model is fixed to, or None; raises InputError where it breaks the contract."""
    inputs = session.get_inputs()
    outputs = {each.name for each in session.get_outputs()}
    found = ", ".join(f"{each.name} {each.type} {each.shape}" for each in inputs)
    needed = f"one input '{_INPUT}', uint8 (1, 3, H, W), and outputs {', '.join(_OUTPUTS)}; export the model again"
    if len(inputs) != 1 or inputs[0].name != _INPUT or inputs[0].type != "tensor(uint8)":
        raise InputError(f"{where} takes {found}; needed is {needed}")
    if missing := set(_OUTPUTS) - outputs:
        lacking, given = ", ".join(sorted(missing)), ", ".join(sorted(outputs))
        raise InputError(f"{where} gives no {lacking}, but {given}; needed is {needed}")
    shape = inputs[0].shape
    if len(shape) != 4 or (isinstance(shape[0], int) and shape[0] != 1) or shape[1] != 3:
        raise InputError(f"{where} takes {found}; needed is {needed}")
    fixed = [isinstance(each, int) for each in shape[2:]]
    if not any(fixed):
        return None
    if not all(fixed):
        raise InputError(f"{where} takes {found}: height and width must be both free or both fixed; export it again")
    if shape[2] % stride or shape[3] % stride:
        raise InputError(f"{where} takes {found}, but its stride is {stride}; export it again")
    return int(shape[2]), int(shape[3])

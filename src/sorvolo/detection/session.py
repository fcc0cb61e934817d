"""One model file, opened where it runs fastest: a picture in, boxes out."""

import json
import math
import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import get_args

import cv2
import numpy as np

from sorvolo.detection.confined import confined_engine, described_confined
from sorvolo.detection.contract import ModelInfo
from sorvolo.detection.engine import Engine, Planes, Provider, describe, open_engine
from sorvolo.detection.layouts import AUTO, WISH_KEY, with_metadata
from sorvolo.errors import InputError, SettingsError
from sorvolo.geometry.arrays import BoxesPx, Floats, ImageRGB, Labels, Numbers

PACKAGED = Path(__file__).parent / "data"
"""The folder of the models that come with the package; all others run in a process of their own."""

_FILLING = 114  # grey level beside a picture, as YOLO's and NanoDet's trainings fill it
_RUN_CODE = frozenset({".pt", ".pth", ".pkl", ".pickle", ".ckpt", ".bin", ".joblib"})


@dataclass(frozen=True, eq=False)
class Seen:
    """What a model finds in one picture, best first: BoxesPx (N, 4), scores (N,), labels (N,)."""

    boxes_px: BoxesPx
    scores: Floats
    labels: Labels


class Session:
    """A model that runs; `info` is what its file states, `provider` in words where it runs.

    `fixed_px` is the (height, width) of its input where the model takes only one size, else None: pictures are then
    letterboxed. Pictures given from several threads are seen one after another.
    """

    def __init__(
        self,
        path: Path,
        provider: Provider = "auto",
        threads: int | None = None,
        model: bytes | None = None,
    ) -> None:
        """Open a model file on `threads` cores, None for as many as this process may use; `model` in place of its bytes.

        Raises InputError for a file that is missing, damaged or none of ours, SettingsError for a provider
        that is not installed.
        """
        if provider not in get_args(Provider):
            raise SettingsError(
                f"no provider {provider!r}; there are {', '.join(get_args(Provider))}"
            )
        if threads is not None and threads < 1:
            raise SettingsError(f"a model needs at least one thread, not {threads}")
        engine = opened_engine(path, provider, threads, model)
        self._run, self.provider, self.info, self.fixed_px = (
            engine.run,
            engine.provider,
            engine.info,
            engine.fixed_px,
        )
        self._rest, self._path = engine.rest, path
        self._buffer: Planes = np.zeros((1, 3, 0, 0), np.uint8)
        self._lock = threading.Lock()

    def see(self, picture: ImageRGB, scale: float = 1.0) -> Seen:
        """What is in one picture, (H, W, 3) RGB of any size, shown `scale` times as large; in its own pixels.

        A model of one input size sees it no larger than that. Raises InputError where the model's answer breaks the
        contract of docs/model-file.md.
        """
        height, width = picture.shape[:2]
        with self._lock:
            shown = self._shown(picture, scale)
            boxes, scores, labels = self._run(self._padded(shown))[:3]
        back = np.array([width / shown.shape[1], height / shown.shape[0]] * 2, np.float32)
        return self._checked(boxes, scores, labels, back, width, height)

    def rest(self) -> None:
        """Give back memory that is kept for the next picture: before work that needs it, and after the last picture."""
        with self._lock:
            self._rest()
            self._buffer = np.zeros((1, 3, 0, 0), np.uint8)

    def _shown(self, picture: ImageRGB, scale: float) -> ImageRGB:
        most = self.fixed_px or (math.inf, math.inf)
        return _resized(picture, min(scale, most[0] / picture.shape[0], most[1] / picture.shape[1]))

    def _padded(self, picture: ImageRGB) -> Planes:
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
        self,
        boxes: Numbers,
        scores: Numbers,
        labels: Numbers,
        back: Numbers,
        width: int,
        height: int,
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
        edges = np.array([width, height, width, height], np.float32)
        inside = np.asarray(np.clip(boxes.astype(np.float32) * back, 0, edges), np.float32)
        # what lies in the padding, or is not a number, is no object of the picture
        real = (inside[:, 2] > inside[:, 0]) & (inside[:, 3] > inside[:, 1]) & np.isfinite(scores)
        order = np.flatnonzero(real)
        order = order[np.argsort(-scores[order], kind="stable")]
        return Seen(inside[order], scores[order].astype(np.float64), labels[order].astype(np.int64))


def read_info(path: Path) -> ModelInfo:
    """What a model file states about itself, without making it ready to run. Raises InputError as Session does."""
    if _is_packaged(path):
        return _packaged_info(path)
    return described_confined(read_model(path), str(path)).info


@cache
def _packaged_info(path: Path) -> ModelInfo:
    return describe(read_model(path), str(path)).info


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
        raise InputError(
            f"there is no model file {path}; `sorvolo models list` shows what is installed"
        ) from error
    except OSError as error:
        raise InputError(
            f"the model file {path} cannot be read ({error.strerror}); check its permissions"
        ) from error


def opened_engine(
    path: Path,
    provider: Provider = "auto",
    threads: int | None = None,
    model: bytes | None = None,
) -> Engine:
    """A packaged model runs in this process, any other beside it, where it cannot take all memory.

    Raises as `Session` does.
    """
    opens = open_engine if _is_packaged(path) else confined_engine
    return opens(model or read_model(path), str(path), provider, threads or usable_cores())


def adopted(
    path: Path, layout: str = AUTO, classes: Sequence[str] | None = None, name: str = ""
) -> bytes:
    """The bytes of a foreign network with the metadata of one of ours.

    `layout` is one of `layouts.LAYOUTS`, or "auto"; `classes` names the network's classes in its order, where its file
    does not. Three pictures are shown to it first. Raises InputError for what cannot be read, recognised or run.
    """
    if isinstance(classes, str):
        classes = (classes,)
    model, where = read_model(path), str(path)
    wish = {"layout": layout, "classes": classes, "name": name or path.stem}
    engine = confined_engine(with_metadata(model, wish, WISH_KEY), where, "cpu", usable_cores())
    whole = with_metadata(model, json.loads(engine.metadata))
    session = Session(path, "cpu", model=whole)
    height, width = session.fixed_px or (480, 640)
    noise = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    ramp = np.linspace(0, 255, width).astype(np.uint8)
    for picture in (np.zeros_like(noise), noise, np.tile(ramp[:, None], (height, 1, 3))):
        session.see(picture)
    return whole


def _is_packaged(path: Path) -> bool:
    return path.resolve().parent == PACKAGED.resolve()


def usable_cores() -> int:
    """How many cores this process may use: its affinity, and its container's quota where one is set."""
    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
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
    return np.asarray(
        cv2.resize(np.ascontiguousarray(picture), size[::-1], interpolation=way), np.uint8
    )

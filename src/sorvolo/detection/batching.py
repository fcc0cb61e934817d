"""Pictures of several askers given to one model: in batches where it takes many, else one after the other."""

import queue
import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np

from sorvolo.detection.engine import Engine, Planes
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Numbers

Outputs = tuple[Numbers, ...]
"""Boxes, scores and labels of one picture."""

_Waiting = tuple[Planes, "Future[Outputs]"]


@dataclass(frozen=True)
class BatchingSettings:
    """How pictures are gathered to a batch. Chosen, not measured: no graphics card was at hand."""

    most_pictures: int = 8  # of one batch: more need memory and win little
    gather_s: float = (
        0.01  # that the first picture of a batch waits for others; only for a model that takes many
    )
    most_waiting: int = 32  # pictures; an asker beyond waits before its picture is taken


class Batcher:
    """One engine for askers in several threads. Only `ask` changes it; `end` ends its thread.

    First come, first served; an asker that waits for its answer cannot ask again, so that none crowds out the others.
    """

    def __init__(self, engine: Engine, settings: BatchingSettings = BatchingSettings()) -> None:
        self._engine, self._settings = engine, settings
        self._waiting: queue.Queue[_Waiting | None] = queue.Queue(settings.most_waiting)
        self.pictures = self.batches = 0
        self._askers = 0
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._serve, daemon=True, name="detector")
        self._thread.start()

    def ask(self, planes: Planes) -> Outputs:
        """Boxes, scores and labels of one picture, (1, 3, H, W); waits for them. Raises what the engine raises."""
        answer: Future[Outputs] = Future()
        with self._lock:
            self._askers += 1
        try:
            self._waiting.put((planes, answer))
            return answer.result()
        finally:
            with self._lock:
                self._askers -= 1

    def end(self) -> None:
        """Answer what waits, and end."""
        self._waiting.put(None)
        self._thread.join()

    def _serve(self) -> None:
        while (first := self._waiting.get()) is not None:
            batch, is_last = self._gathered(first)
            for group in _alike(batch):
                self._answer(group)
            if is_last:
                return

    def _gathered(self, first: _Waiting) -> tuple[list[_Waiting], bool]:
        """What is answered next, and whether nothing follows."""
        batch, end_s = [first], time.monotonic() + self._settings.gather_s
        while self._engine.takes_many and len(batch) < min(
            self._settings.most_pictures, self._askers
        ):
            try:
                more = self._waiting.get(timeout=max(0.0, end_s - time.monotonic()))
            except queue.Empty:
                break
            if more is None:
                return batch, True
            batch.append(more)
        return batch, False

    def _answer(self, group: Sequence[_Waiting]) -> None:
        try:
            found = self._found([planes for planes, _ in group])
        except Exception as error:  # each asker is to have it
            for _, answer in group:
                answer.set_exception(error)
            return
        for (_, answer), outputs in zip(group, found):
            answer.set_result(outputs)

    def _found(self, group: Sequence[Planes]) -> list[Outputs]:
        self.pictures += len(group)
        self.batches += 1
        outputs = self._engine.run(group[0] if len(group) == 1 else np.concatenate(group))
        if not self._engine.takes_many:
            return [outputs]
        *found, pictures = outputs
        if any(len(each) != len(pictures) for each in found):
            sizes = ", ".join(str(each.shape) for each in outputs)
            raise InputError(
                f"the model '{self._engine.info.name}' answers with outputs of {sizes}: export it again"
            )
        return [tuple(each[pictures == number] for each in found) for number in range(len(group))]


def _alike(batch: Sequence[_Waiting]) -> list[list[_Waiting]]:
    """The pictures by their size."""
    groups: dict[tuple[int, ...], list[_Waiting]] = {}
    for each in batch:
        groups.setdefault(each[0].shape, []).append(each)
    return list(groups.values())

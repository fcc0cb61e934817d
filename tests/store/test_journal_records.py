"""Records come back from a journal as they were, by their types; what was made by somebody else is refused."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sorvolo.errors import GeometryError
from sorvolo.geometry.arrays import Floats, ImageGray, Mask
from sorvolo.geometry.pose import Pose
from sorvolo.store.site.journal import Entry, RunJournal, packed, unpacked


class Colour(StrEnum):
    RED = "red"


@dataclass(frozen=True, eq=False)
class Inner:
    weights: Floats
    name: str


@dataclass(frozen=True, eq=False)
class Outer:
    colour: Colour
    is_new: bool
    score: float
    mask: Mask | None
    gray: ImageGray
    inner: Inner | None
    pairs: tuple[tuple[int, float], ...]
    many: Sequence[Inner]


def outer(mask: Mask | None = None) -> Outer:
    gray = np.arange(35, dtype=np.uint8).reshape(5, 7)
    inner = Inner(np.array([1 / 3, np.nan]), "Ötztal")
    return Outer(
        Colour.RED, True, float("inf"), mask, gray, inner, ((1, 0.5), (2, 1 / 3)), (inner, inner)
    )


def test_a_record_comes_back_bit_by_bit_through_the_file(tmp_path: Path) -> None:
    mask = np.random.default_rng(3).random((5, 7)) > 0.5
    arrays: dict[str, NDArray[Any]] = {}
    values = {"one": packed(outer(mask), arrays), "two": packed(outer(), arrays)}
    RunJournal(tmp_path / "j", "k", 0).append(Entry("x", values, arrays))
    (entry,) = RunJournal(tmp_path / "j", "k", 0).entries()
    one, two = (unpacked(Outer, entry.values[name], entry.arrays) for name in ("one", "two"))
    assert one.mask is not None and two.mask is None
    assert np.array_equal(one.mask, mask) and one.mask.dtype == bool
    assert one.colour is Colour.RED and one.is_new is True and one.score == float("inf")
    assert np.array_equal(one.gray, outer().gray) and one.pairs == outer().pairs
    assert one.inner is not None and one.inner.weights.tobytes() == outer().inner.weights.tobytes()  # type: ignore[union-attr]
    assert [each.name for each in two.many] == ["Ötztal", "Ötztal"]


@pytest.mark.parametrize(
    "value",
    [
        [1, 2],
        "text",
        None,
        ["blue", True, 1.0, None, "a0", None, [], []],
        ["red", 1, 1.0, None, "a0", None, [], []],
        ["red", True, 1.0, None, "a0", None, [[1, 0.5, 2]], []],
        ["red", True, 1.0, None, "none", None, [], []],
    ],
)
def test_what_no_packer_made_is_refused(value: object) -> None:
    with pytest.raises((KeyError, TypeError, ValueError, IndexError)):
        unpacked(Outer, value, {"a0": np.zeros(3, np.uint8)})


def test_a_record_checks_itself_when_it_comes_back() -> None:
    with pytest.raises(GeometryError):
        unpacked(Pose, ["a0", "a1"], {"a0": np.ones((3, 3)), "a1": np.zeros(3)})


def test_only_data_is_packed() -> None:
    with pytest.raises(TypeError):
        packed(open, {})

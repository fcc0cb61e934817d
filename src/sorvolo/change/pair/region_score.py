"""How sure a region that differs is a change: small decision trees trained on known answers (region_score.json)."""

import json
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from sorvolo.errors import SettingsError
from sorvolo.geometry.arrays import Floats
from sorvolo.kernels import tree_margins


@dataclass(frozen=True, eq=False)
class Trees:
    """Oblivious trees of one depth: `features` (T, D) columns, `thresholds` (T, D), `leaves` (T, 2**D) log-odds."""

    names: tuple[str, ...]
    prior: float
    features: NDArray[np.int32]
    thresholds: Floats
    leaves: Floats


def how_sure(features: Floats, names: tuple[str, ...], trees: Trees | None = None) -> Floats:
    """The chance (N,) from 0 to 1 that each row of `features` (N, F) is a change; `names` names the columns are.

    Raises SettingsError if the trees were trained on other columns.
    """
    trees = trees or trained_trees()
    if trees.names != names:
        raise SettingsError(
            "the trees of region_score.json were trained on other features; train them again"
        )
    if len(features) == 0:
        return np.zeros(0)
    margin = trees.prior + tree_margins(features, trees.features, trees.thresholds, trees.leaves)
    return np.asarray(1 / (1 + np.exp(-margin)))


@lru_cache(maxsize=1)
def trained_trees() -> Trees:
    """The trees that come with the package."""
    stored = json.loads(files("sorvolo.change.pair").joinpath("region_score.json").read_text())
    return Trees(
        tuple(stored["names"]),
        float(stored["prior"]),
        np.array(stored["features"], np.int32),
        np.array(stored["thresholds"]),
        np.array(stored["leaves"]),
    )

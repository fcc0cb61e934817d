"""Made-up changes of a made-up site."""

import numpy as np

from sorvolo.survey.findings import Change, ChangeKind, Patch

SEEN_NS = 1_700_000_000_250_000_000


def fake_change(
    number: int = 1,
    flight_id: str = "b",
    *,
    kind: ChangeKind = ChangeKind.APPEARED,
    east_m: float = 5.0,
    north_m: float = -4.0,
    size_m: float = 1.2,
    score: float = 0.8,
    velocity_m_s: tuple[float, float] = (0.0, 0.0),
) -> Change:
    """A house-shaped change with crops that show a square on one of the dates."""
    outline_m = np.array([[-1, -1], [1, -1], [1, 0.6], [0, 1], [-1, 0.6]]) * size_m / 2 + [
        east_m,
        north_m,
    ]
    side = 64
    m_per_px = 2 * size_m / side
    y, x = np.mgrid[:side, :side]
    ground = np.dstack([90 + x, 110 + y, 70 + 0 * x, np.full_like(x, 255)]).astype(np.uint8)
    ground[:3, :, 3] = 0
    inside = np.zeros((side, side), bool)
    inside[16:48, 16:48] = True
    thing = ground.copy()
    thing[inside, :3] = (200, 40 + 20 * (number % 8), 40)
    before, after = (ground, thing) if kind is not ChangeKind.DISAPPEARED else (thing, ground)
    patch = Patch(
        east_m - size_m,
        north_m + size_m,
        m_per_px,
        before,
        after,
        inside,
        np.zeros(inside.shape, np.uint8),
    )
    return Change(
        f"{flight_id}-{number}",
        kind,
        score,
        outline_m,
        SEEN_NS + number,
        SEEN_NS + 3_000_000_000,
        4,
        size_m**2 * 0.9,
        size_m,
        0.07,
        patch,
        np.array(velocity_m_s),
    )


def fake_comparison(**changed: object) -> dict[str, object]:
    """The part of report.json on a comparison."""
    return {
        "against_version": 1,
        "method": "robust",
        "views": {"compared": 180, "not-aligned": 3, "outside": 12, "all-changed": 0, "lost": 2},
        "reasons": {"too few points fit: 7 of 40": 3, "blurred": 2},
        "residual_px": {"median": 0.61, "p95": 1.4},
        "compared_area_m2": 3412.0,
        "unknown_share": 0.031,
        "suppressed": 0,
        "votes": 3,
        "voters": 5,
        "map_updated": True,
        "chosen": {"threshold": 17.3141, "parallax_px": 0.4},
        **changed,
    }

"""People drawn limb by limb: limbs look the same from all around, and people have people's sizes."""

import numpy as np
import pytest

from sorvolo.search.drawing.bodies import build_body
from sorvolo.search.drawing.objects import POSES, Light, Limb, Thing, ThingLabel, new_size
from sorvolo.search.drawing.view import DrawnPatch, opaque

_LIGHT = Light(np.array([0.5, 0.2, 0.84]) / np.linalg.norm([0.5, 0.2, 0.84]))
_ABOVE, _BESIDE = np.array([0.0, 0, 1, 0]), np.array([0.0, -1, 0, 0])
_HERE = np.zeros(3)


def _sides_m(patch: DrawnPatch) -> tuple[float, float]:
    return tuple(float(np.linalg.norm(patch.corners_m[k] - patch.corners_m[0])) for k in (1, 3))


def _person(kind: str, seed: int) -> Thing:
    size_m = new_size(ThingLabel.PERSON, kind, np.random.default_rng(seed))
    return Thing(1, ThingLabel.PERSON, kind, 0.0, 0.0, 0.0, size_m, seed)


def _limbs(thing: Thing) -> list[Limb]:
    limbs = [part for part in build_body(thing, _LIGHT, 0.01).parts if isinstance(part, Limb)]
    assert len(limbs) >= 16
    return limbs


def test_an_upright_limb_is_a_disc_from_above_and_whole_from_beside() -> None:
    limb = Limb(np.array([[0, 0, 0], [0, 0, 0.8]]), 0.2, opaque(np.zeros((4, 4, 3), np.uint8)))
    assert _sides_m(limb.facing(np.eye(3), _HERE, _ABOVE)) == pytest.approx((0.2, 0.2))
    assert _sides_m(limb.facing(np.eye(3), _HERE, _BESIDE)) == pytest.approx((0.2, 1.0))


def test_a_limb_turns_and_moves_with_its_person_and_shows_its_face() -> None:
    limb = Limb(np.array([[0, 0, 1.0], [0.6, 0, 1.0]]), 0.1, opaque(np.zeros((4, 4, 3), np.uint8)))
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    eye = np.array([3.0, 5.0, 40.0, 1.0])
    patch = limb.facing(quarter, np.array([3.0, 5.0, 0.0]), eye)
    middle = patch.corners_m.mean(axis=0)
    assert middle == pytest.approx([3.0, 5.3, 1.0])
    normal = np.cross(
        patch.corners_m[1] - patch.corners_m[0], patch.corners_m[3] - patch.corners_m[0]
    )
    sight = eye[:3] - middle
    assert abs(normal @ sight) == pytest.approx(
        np.linalg.norm(normal) * np.linalg.norm(sight), rel=1e-6
    )


@pytest.mark.parametrize("kind", list(POSES))
@pytest.mark.parametrize("seed", range(8))
def test_people_stand_on_the_ground_within_about_their_size(kind: str, seed: int) -> None:
    thing = _person(kind, seed)
    ends_m = np.concatenate([limb.ends_m for limb in _limbs(thing)])
    lowest = min(float(limb.ends_m[:, 2].min()) - limb.width_m / 2 for limb in _limbs(thing))
    assert lowest == pytest.approx(0.0, abs=0.02)  # metres; thin limbs are drawn a texel wide
    reach_m = np.linalg.norm(ends_m[:, :2], axis=1).max()
    assert reach_m < 1.3 * max(thing.size_m)
    if kind in ("standing", "walking"):
        assert ends_m[:, 2].max() == pytest.approx(thing.size_m[2], rel=0.15)
    if kind == "lying":
        assert ends_m[:, 2].max() < 0.6
        assert np.ptp(ends_m[:, 0]) > 0.75 * thing.size_m[0] / POSES["lying"][0]


def test_no_two_people_look_alike_and_a_seed_gives_one_person() -> None:
    one, again, other = (_limbs(_person("walking", seed)) for seed in (3, 3, 4))
    assert all(
        np.array_equal(a.ends_m, b.ends_m) and np.array_equal(a.texture, b.texture)
        for a, b in zip(one, again)
    )
    assert not np.allclose(one[0].ends_m, other[0].ends_m)


def test_who_is_shown_coarsely_stays_whole_and_fades_instead_of_flickering() -> None:
    fine, coarse = (
        sum(
            int(part.texture[..., 3].max())
            for part in build_body(_person("walking", 5), _LIGHT, m_per_px).parts
        )
        for m_per_px in (0.01, 0.15)
    )
    assert coarse < fine
    assert all(
        part.width_m >= 0.15 for part in build_body(_person("walking", 5), _LIGHT, 0.15).parts
    )

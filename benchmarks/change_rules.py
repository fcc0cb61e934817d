"""The rules of change detection, each with what switches it off, for change_ablation.py and pair_ablation.py."""

import importlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any
from unittest import mock

import numpy as np


@dataclass(frozen=True)
class Rule:
    """One rule and what switches it off: `place` is module:name, or module:Class.field of a settings record."""

    name: str
    stage: str
    decision: str
    switches: tuple[tuple[str, Any], ...]


@contextmanager
def switched_off(rule: Rule | None) -> Iterator[None]:
    """The rule's constants replaced meanwhile."""
    with ExitStack() as stack:
        for place, value in () if rule is None else rule.switches:
            module, _, name = place.partition(":")
            target: Any = importlib.import_module(f"sorvolo.change.{module}")
            *path, last = name.split(".")
            for each in path:
                target = getattr(target, each)
            if (
                isinstance(target, type)
                and is_dataclass(target)
                and last in {each.name for each in fields(target)}
            ):
                defaults = list(target.__init__.__defaults__ or ())
                names = [each.name for each in fields(target) if each.init]
                defaults[len(defaults) - len(names) + names.index(last)] = value
                stack.enter_context(
                    mock.patch.object(target.__init__, "__defaults__", tuple(defaults))
                )
            stack.enter_context(mock.patch.object(target, last, value))
        yield


def _nothing(*_: Any) -> None:
    return None


def _no(*_: Any) -> bool:
    return False


def _yes(*_: Any) -> bool:
    return True


def _new_at_once(
    parts: Any, row: int, thing: Any, named: Any, now_ns: int, next_id: Any
) -> dict[int, Any]:
    whole = all(each.id != thing.id for each in named.values())
    return {row: thing if whole else replace(thing, id=next_id(), announced_ns=now_ns)}


def _no_pieces(*_: Any) -> list[Any]:
    return []


def _all_parts_one(_: Any, kind: Any, changed: Any, __: Any) -> list[Any]:
    return [(changed, kind)]


def _thing_alone(thing: Any, *_: Any) -> Any:
    return thing


def _one_thing(_: Any, kind: Any, changed: Any, __: Any) -> list[Any]:
    return [(changed, kind)]


def _zero(*_: Any) -> int:
    return 0


_no_rim = property(lambda laid: np.zeros_like(laid.flagged))


def _rule(name: str, decision: str, *switches: tuple[str, Any], stage: str = "evidence") -> Rule:
    return Rule(name, stage, decision, switches)


def _decision(name: str, decision: str, *switches: tuple[str, Any]) -> Rule:
    return Rule(name, "decision", decision, switches)


_INFINITE = float("inf")
_MAP, _CANDIDATE = "evidence.evidence_map:EvidenceMap", "evidence.candidate:CandidateSettings"
_ANNOUNCING, _PARALLAX = "evidence.announcing:AnnounceSettings", "motion.parallax:ParallaxSettings"
_THINGS, _EVIDENCE = "shape.shadows:ThingSettings", "evidence.evidence_map"
_OPINIONS, _PICTURES = (
    "pair.corroboration:CorroborationSettings",
    "evidence.candidate_pictures:PictureSettings",
)
_RESTLESS = f"{_EVIDENCE}:RestlessSettings"
RULES: tuple[Rule, ...] = (
    # when a change is announced, and when it is withdrawn
    _decision("large must be sure", "0018", (f"{_ANNOUNCING}.large_score", 0.0)),
    _decision("restless ground", "before 0014", (f"{_ANNOUNCING}.restless_half", _INFINITE)),
    _decision("restless ground, only for the unsure", "0007", (f"{_ANNOUNCING}.doubt", _INFINITE)),
    _decision(
        "restless ground: not what changed itself",
        "before 0014",
        (f"{_RESTLESS}.changed_itself", 1.0),
    ),
    _decision("never seen whole", "0007", (f"{_ANNOUNCING}.cut_off", 1.0)),
    _decision("from one place", "before 0014", (f"{_ANNOUNCING}.one_place", 0.0)),
    _decision("what few views saw", "before 0014", (f"{_MAP}._grow_late", _nothing)),
    _decision("late ground joins what is beside", "before 0014", (f"{_MAP}._joins_beside", _no)),
    # what a change is made of
    _decision("a dark car stays whole", "before 0014", ("shape.shadows:_may_be_a_car", _no)),
    _decision("pieces that lie apart", "0016", ("shape.shadows:_groups", _no_pieces)),
    _decision("pieces: near ones are one", "0016", (f"{_THINGS}.gap_m", 0.0)),
    _decision("solid things", "0018", (f"{_THINGS}.solid", 0.0)),
    _decision("large things", "0018", (f"{_THINGS}.least_m2", 1e-9)),
    _decision("things: near ones are one", "before 0014", (f"{_THINGS}.apart_m", 0.0)),
    _decision(
        "things: ground or shadow between them",
        "before 0014",
        ("shape.shadows:_things_of_group", _one_thing),
    ),
    _decision("the shadow of what came", "before 0014", ("shape.shadows:_CONTRARY", {})),
    _decision(
        "parts at all", "before 0014", ("evidence.candidate_pictures:things_of", _all_parts_one)
    ),
    _decision("replaced is seldom", "before 0014", ("shape.kinds:_REPLACED_PRIOR", 1.0)),
    _decision("kinds: signs of the other date", "before 0014", ("shape.kinds:_OTHER", np.zeros(6))),
    _decision(
        "outlines by the majority of masks",
        "before 0014",
        (f"{_PICTURES}.least_majority", _INFINITE),
    ),
    _decision("outlines without shadows", "before 0014", ("shape.shadows:thing_of", _thing_alone)),
    _decision(
        "outlines without a shadow's specks", "before 0014", (f"{_THINGS}.least_piece", 1e-9)
    ),
    _decision(
        "outlines: hardly anything lit is all dark", "before 0014", (f"{_THINGS}.least_share", 0.0)
    ),
    # how views are gathered
    _rule("leaning neighbours", "0015", (f"{_EVIDENCE}:PassingSettings.share", 0.0)),
    _rule("unsteady blobs must stand", "0017", (f"{_EVIDENCE}:GatherSettings.stands_s", 0.0)),
    _rule("frames all changed", "before 0014", (f"{_EVIDENCE}:GatherSettings.all_changed", 2.0)),
    _rule(
        "only new places count", "before 0014", (f"{_EVIDENCE}:GatherSettings.moved_heights", 0.0)
    ),
    _rule("ground far away", "before 0014", ("evidence.cells:CellSettings.far_heights", _INFINITE)),
    _rule(
        "what ends at a rim waits, and counts less",
        "0007",
        ("evidence.cells:LaidView.cut_off", _no_rim),
    ),
    _rule(
        "views from before count", "before 0014", ("evidence.candidate:Candidate.recall", _nothing)
    ),
    _rule("ground that was forgotten", "before 0014", (f"{_MAP}._forgotten_at", _zero)),
    _rule("a view that flags little misses it", "before 0014", (f"{_CANDIDATE}.shows", 0.0)),
    _rule("a view that sees little is not asked", "before 0014", (f"{_CANDIDATE}.seen", 0.0)),
    _rule("gaps are closed", "before 0014", (f"{_EVIDENCE}:EvidenceSettings.join_m", 0.0)),
    _rule("no specks", "before 0014", (f"{_EVIDENCE}:EvidenceSettings.least_area_m2", 0.0)),
    _rule("pictures: better ones replace", "before 0014", (f"{_PICTURES}.better", _INFINITE)),
    _rule("parts: shown twice first", "before 0014", ("shape.things:Parts._new_at", _new_at_once)),
    # what moves
    _rule("walks against the flight, photos", "0016", ("motion.blob_tracker:floats", _no)),
    _rule("rigid blobs", "before 0016", ("motion.blob_tracker:is_rigid", _no)),
    _rule("photos: three views", "0016", (f"{_PARALLAX}.photos_apart_s", _INFINITE)),
    _rule("unlikely parallax", "before 0014", (f"{_PARALLAX}.unlikely", _INFINITE)),
    _rule("steady motion", "before 0014", ("motion.blob_tracker:_is_plausible", _yes)),
    _rule(
        "nothing goes with the camera", "before 0014", ("motion.blob_tracker:goes_with_camera", _no)
    ),
    _rule("blobs without their shadows", "before 0014", ("motion.blobs:thing_of", _thing_alone)),
    _rule(
        "blobs: no large part of the view",
        "before 0014",
        ("motion.blobs:BlobSettings.most_of_view", 1.0),
    ),
    _rule("blobs: on known ground", "before 0014", ("motion.blobs:_is_known_around", _yes)),
    _rule("feet of people", "before 0014", ("motion.blobs:_foot_m", _nothing)),
    # one pair of pictures, on flights
    _rule("one very sure opinion", "0016", (f"{_OPINIONS}.very_sure", 2.0), stage="pair"),
    _rule("opinions: what leans lies beside", "0007", (f"{_OPINIONS}.near_px", 1), stage="pair"),
    _rule("opinions: all of it seen", "0007", (f"{_OPINIONS}.seen", 0.0), stage="pair"),
    _rule(
        "growing: not what is doubted",
        "0007",
        ("pair.robust:MaskSettings.least_grown", 0.0),
        stage="pair",
    ),
    _rule("hulls", "0007", ("pair.robust:MaskSettings.convexity", 2.0), stage="pair"),
    _rule(
        "growing: limit by quiet ground",
        "0007",
        ("pair.region_extent:ExtentSettings.of_quiet", 0.0),
        stage="pair",
    ),
)
_LIGHT, _MOVED = "pair.illumination:LightSettings", "pair.moved_shadows:MovedShadowSettings"
_EXTENT, _MASKS = "pair.region_extent:ExtentSettings", "pair.robust:MaskSettings"
PAIR_RULES: tuple[Rule, ...] = tuple(
    _rule(name, decision, *switches, stage="pairs")
    for name, decision, *switches in (
        ("light: small things do not count", "0007", (f"{_LIGHT}.median_cells", 1)),
        ("light: only the same ground counts", "0007", (f"{_LIGHT}.alike", (-2.0, -1.0))),
        ("light: flat ground counts a little", "0007", (f"{_LIGHT}.flat_trust", 0.0)),
        ("light: four reaches", "0007", (f"{_LIGHT}.reaches", ((7, 1.0), (49, 1e-3)))),
        ("light: slopes drawn to one", "0007", (f"{_LIGHT}.no_slope", 0.0)),
        ("moved shadows", "0014", ("pair.illumination:_shades", _nothing)),
        ("moved shadows: three levels", "0014", (f"{_MOVED}.levels", (8,))),
        ("moved shadows: colours alike", "0014", (f"{_MOVED}.most_tint", 256)),
        ("moved shadows: no cloud", "0014", (f"{_MOVED}.largest", 1.0)),
        ("moved shadows: sharp edge", "0014", (f"{_MOVED}.sharp", 0.0)),
        ("moved shadows: same structure", "0014", (f"{_MOVED}.least_alike", -_INFINITE)),
        ("moved shadows: surer where small", "0014", (f"{_MOVED}.alike_of_few", 0.0)),
        ("moved shadows: narrow parts beside", "0014", (f"{_MOVED}.most_apart", 0)),
        ("growing", "0007", (f"{_MASKS}.least_grown", 2.0)),
        ("growing: limit by the thing's height", "0007", (f"{_EXTENT}.of_top", 0.0)),
        ("growing: limit by quiet ground", "0007", (f"{_EXTENT}.of_quiet", 0.0)),
        ("growing: not into shade", "0007", (f"{_EXTENT}.shade_of_top", 0.0)),
        ("growing: blurred rim", "0007", (f"{_EXTENT}.blurred", 0.0)),
        ("growing: nearly convex", "0007", (f"{_EXTENT}.convexity", 0.0)),
        ("growing: sharp rim", "0007", (f"{_EXTENT}.beside", _INFINITE)),
        ("regions: activity around", "0007", ("pair.regions:RegionSettings.activity_factor", 0.0)),
        ("regions: bounded activity", "0007", ("pair.regions:RegionSettings.most_clutter", 255.0)),
        ("calm pairs search less far", "0007", ("pair.robust:RobustSettings.calm_px", -1.0)),
        ("hulls", "0007", (f"{_MASKS}.convexity", 2.0)),
        ("rims drawn anew", "0007", ("pair.robust:_outlined", _thing_alone)),
        ("what left in the reference's pixels", "0007", (f"{_MASKS}.same_place_px", _INFINITE)),
        ("rim of the unknown", "0007", ("pair.robust:RobustSettings.unknown_px", 0)),
    )
)
"""For pair_ablation.py."""

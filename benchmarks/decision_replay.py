"""The evidence of a recorded flight gathered once; rules that only decide on it are then replayed in about a second.

What views show gathers without regard to what is announced: cells, candidates, pictures. `gather` takes all views in
and keeps the evidence as it is before its end, with what could have been decided on after each view. `decided` ends it
under the settings and functions of the moment: which candidates are announced, what things they hold, their kinds and
outlines.
"""

import pickle
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from sorvolo.change.announcing import Announce, Look, Tally, judge
from sorvolo.change.candidate import Candidate
from sorvolo.change.evidence import EvidenceMap, EvidenceSettings
from sorvolo.change.things import without_shadow
from sorvolo.survey.findings import Change, ComparedView


class Gatherer(EvidenceMap):
    """Evidence that announces nothing before its end. `noted` are a candidate's tallies after each view, by number."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.noted: dict[int, list[Tally]] = {}

    def _announce(self, candidate: Candidate, now_ns: int) -> list[Change]:
        if now_ns < 0:
            return super()._announce(candidate, now_ns)
        candidate.note_restlessness(self._restlessness(candidate))
        whole = self._record(candidate)
        look = None if whole is None else Look(whole.area_m2, whole.length_m)
        self.noted.setdefault(candidate.number, []).append(replace(candidate.tally, look=look))
        return []

    def under(self, settings: EvidenceSettings) -> None:
        """Decide by other settings from here on."""
        self._settings, self._rules, self._gathering = (
            settings,
            settings.announcing,
            settings.gathering,
        )
        for candidate in (*self._found.values(), *self._seeds):
            candidate.pictures._settings = settings.gathering.pictures

    def withdrawn(self) -> int:
        """After `conclude`: how many candidates were announced after some view and are not at the end."""
        early = {
            self._current(number)
            for number, tallies in self.noted.items()
            if any(
                isinstance(judge(each, self._rules, is_over=False), Announce) for each in tallies
            )
        }
        return len(early - (self._announced_ns.keys() - self._stopped.keys()))


def gather(views: Iterable[ComparedView], m_per_px: float, name: str, kept: Path) -> None:
    """Take a flight's views in, and write the evidence before its end to `kept`; one that is there stays."""
    if kept.is_file():
        return
    evidence = Gatherer(m_per_px, EvidenceSettings(), name)
    for view in views:
        evidence.add(view)
    kept.write_bytes(pickle.dumps(evidence, protocol=5))


def decided(kept: Path) -> tuple[list[Change], int]:
    """The changes that the evidence ends with, and how many more would have been announced meanwhile."""
    evidence: Gatherer = pickle.loads(kept.read_bytes())
    evidence.under(EvidenceSettings())
    settings = EvidenceSettings().things
    final = [without_shadow(each, settings) for each in evidence.conclude()]
    return final, evidence.withdrawn()

"""The things that one piece of changed ground holds, each announced under an id of its own that stays."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from sorvolo.change.shape.outlines import overlap
from sorvolo.survey.findings import Change


@dataclass(frozen=True)
class PartSettings:
    """When ground is parted anew, and what is the same thing as before."""

    more_views: float = 1.2  # so many times as many views may show another thing beside the first
    same: float = 0.4  # of the union of two outlines of one thing lies in both


class Parts:
    """Neighbours that lie so near to each other that their ground is one. `take` and `join` change it."""

    def __init__(self, settings: PartSettings = PartSettings()) -> None:
        self._settings = settings
        self.things: tuple[Change, ...] = ()
        self._announced: dict[str, Change] = {}  # by id, also those that do not show any more
        self._seen: tuple[Change, ...] = ()  # when last parted, announced or not
        self._views = 0

    def is_due(self, views: int) -> bool:
        """Whether, with this many views, it is time to look again for things to part."""
        return views >= self._settings.more_views * self._views

    def join(self, announced: Sequence[Change]) -> None:
        """Remember what was announced of a change that has become one with this: its things keep their ids."""
        self._announced |= {each.id: each for each in announced}
        self._views = 0

    def take(
        self, things: Sequence[Change], views: int, now_ns: int, next_id: Callable[[], str]
    ) -> list[Change]:
        """The things as they are seen after `views` views, the largest first; those announced for the first time, now.

        All come under the id of the whole. Each keeps the id of what was announced there; the largest of the
        others keeps that of the whole. Any more are new and get ids from `next_id`, if they were there already when
        last looked at: pictures of few views may show anything. At the end, `now_ns` = -1, all of them do.
        """
        self._views = views
        named = dict(enumerate(things[:1])) if len(things) == 1 else self._known_again(things)
        for row, thing in enumerate(things):
            if row not in named:
                named |= self._new_at(row, thing, named, now_ns, next_id)
        self._seen = tuple(things)
        self.things = tuple(named[row] for row in sorted(named))
        new = [each for each in self.things if each.id not in self._announced]
        self._announced |= {each.id: each for each in self.things}
        return new

    def _new_at(
        self,
        row: int,
        thing: Change,
        named: dict[int, Change],
        now_ns: int,
        next_id: Callable[[], str],
    ) -> dict[int, Change]:
        """A thing without a known id, by its row: under the whole's id where none of the `named` has it, else under a
        new one; nothing where it was not there when last looked at."""
        if all(each.id != thing.id for each in named.values()):
            return {row: thing}
        if now_ns < 0 or any(self._is_same(thing, each) for each in self._seen):
            return {row: replace(thing, id=next_id(), announced_ns=now_ns)}
        return {}

    def _known_again(self, things: Sequence[Change]) -> dict[int, Change]:
        """Those things, by row, that lie where something was announced already, under its id; each id once."""
        found: dict[int, Change] = {}
        free = dict(self._announced)
        for row, thing in enumerate(things):
            same = next((each for each in free.values() if self._is_same(thing, each)), None)
            if same is not None:
                found[row] = replace(thing, id=same.id, announced_ns=free.pop(same.id).announced_ns)
        return found

    def _is_same(self, a: Change, b: Change) -> bool:
        return overlap(a.outline_m, b.outline_m)[0] > self._settings.same

"""Reports tracks while a watch runs: to a TAK server, a command and a URL, each through an outbox of its own."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sorvolo.missions.flight.result_cache import ResultCache
from sorvolo.missions.watch.alerts import Outbox, Pace, alert_command, alert_url
from sorvolo.missions.watch.cot_sender import CotSender, cot_place
from sorvolo.missions.watch.settings import WatchOutputs
from sorvolo.store.exports.cursor_on_target import cot_event, cot_removal, cot_type
from sorvolo.store.exports.detection_files import track_properties
from sorvolo.survey.flight import Notice, Site
from sorvolo.survey.objects import Track

_COT, _COMMAND, _URL = RECEIVERS = ("cot", "alert_command", "alert_url")


class Notifier:
    """Sends alerts of new tracks, and keeps a TAK server's map up to date.

    `memo` has what a killed watch sent, which is not sent again, and notes what is sent.
    """

    def __init__(
        self,
        flight: str,
        fingerprint: str,
        site: Site,
        outputs: WatchOutputs,
        folder: Path,
        memo: ResultCache,
    ) -> None:
        self._memo = memo
        self._sent = [note.values for note in memo.notes if note.kind == "sent"]
        self._flight, self._uid = flight, f"sorvolo.{flight}.{fingerprint[:8]}"
        self._site, self._outputs, self._folder = site, outputs, folder
        self._pace = Pace(outputs.cot_every_s)
        self._sent_types: dict[int, str] = {}
        self._cot: Outbox[bytes] | None = None
        self._sender: CotSender | None = None
        self._broken_end: tuple[Notice, ...] = ()
        self._alerts: dict[str, Outbox[tuple[Mapping[str, Any], Mapping[str, Any]]]] = {}
        if outputs.cot and not site.is_local:
            self._sender = CotSender(cot_place(outputs.cot), outputs.cot_tls)
            self._cot = Outbox(self._sender.send, code=_COT, what=f"sending to {outputs.cot}")
        if outputs.alert_command:
            self._add_receiver(_COMMAND, alert_command(outputs.alert_command), "the alert command")
        if outputs.alert_url:
            self._add_receiver(
                _URL, alert_url(outputs.alert_url), f"the alert to {outputs.alert_url}"
            )

    def report(
        self,
        new: Sequence[Track],
        seen: Sequence[Track],
        crops: Mapping[int, str],
        segments: Mapping[int, int],
    ) -> None:
        """Send one alert for each new track, and the TAK server all tracks that are seen, each at its pace.

        `crops` are their pictures' names, `segments` their stretches of the flight (`tracking.following.Taken`), by
        track.
        """
        for track in new:
            self._alert(track, crops.get(track.id), segments.get(track.id, 0))
        for track in seen:
            if self._cot is not None and self._pace.allows(track.id):
                self._sent_types[track.id] = cot_type(track.label)
                self._cot.put(self._event(track))

    def withdraw(self, track_ids: Iterable[int]) -> None:
        """Tracks that turned out to be others leave the TAK server's map."""
        for track_id in track_ids:
            if self._cot is not None and track_id in self._sent_types:
                uid, kind = f"{self._uid}.{track_id}", self._sent_types.pop(track_id)
                self._cot.put(cot_removal(uid, type_=kind, now_ns=time.time_ns()))

    def report_final(self, tracks: Sequence[Track]) -> None:
        """Send the TAK server each track's final place."""
        if self._cot is not None:
            for track in tracks:
                self._cot.put(self._event(track))

    def close(self, alerts_s: float, events_s: float) -> None:
        """Wait until all is sent, at most so long for the alerts and for the TAK server."""
        for outbox in self._alerts.values():
            outbox.close(alerts_s)
        if self._cot is not None and self._sender is not None:
            if self._cot.close(events_s):
                try:
                    self._sender.finish()
                except OSError as error:
                    text = f"{self._outputs.cot} broke the connection at the end: {error}"
                    self._broken_end = (Notice("cot_broken_end", 1, text),)
            self._sender.close()

    def notices(self) -> tuple[Notice, ...]:
        """What could not be sent so far, and why."""
        found: list[Notice] = []
        if self._outputs.cot and self._cot is None:
            text = f"nothing was sent to {self._outputs.cot}: this flight has no place on Earth"
            found.append(Notice("cot_without_place", 1, text))
        for outbox in self._alerts.values():
            found += outbox.notices()
        return (*found, *(self._cot.notices() if self._cot is not None else ()), *self._broken_end)

    def _alert(self, track: Track, crop: str | None, segment: int) -> None:
        """Send the alert of a track to those who have not got it."""
        of_segment = {"segment": segment} if self._site.is_local else {}
        alert = {
            "flight": self._flight,
            **track_properties(track, self._site),
            **of_segment,
            "crop": None if crop is None else str((self._folder / crop).resolve()),
        }
        alert["time"] = alert["last_seen"]
        east_m, north_m = track.position_m.tolist()
        known_by = {
            "sighting": f"{alert['best_frame']} {alert['best_box_px']}",
            "stands": [segment, track.label] if not track.moving else [],
            "east_m": east_m,
            "north_m": north_m,
            "sigma_m": track.apart_sigma_m,
        }
        for receiver, outbox in self._alerts.items():
            if not self._was_sent(receiver, known_by, track.size_m[0] / 2):
                outbox.put((alert, known_by))

    def _was_sent(self, receiver: str, alert: Mapping[str, Any], within_m: float) -> bool:
        """Whether a killed watch sent an alert, each for one track: by the same sighting or, where that one had left
        frames out, of a thing of the class that stands there."""
        sent = [each for each in self._sent if each.get("receiver") == receiver]
        for each in sorted(sent, key=lambda one: one.get("sighting") != alert["sighting"]):
            apart_m = np.hypot(*(alert[k] - each.get(k, np.inf) for k in ("east_m", "north_m")))
            reach_m = 3 * np.hypot(alert["sigma_m"], each.get("sigma_m", 0)) + within_m
            is_there = alert["stands"] and alert["stands"] == each.get("stands")
            if each.get("sighting") == alert["sighting"] or (is_there and apart_m <= reach_m):
                self._sent.remove(each)
                return True
        return False

    def _add_receiver(
        self, code: str, send: Callable[[Mapping[str, Any]], None], what: str
    ) -> None:
        """A receiver of alerts; what it has got is noted at once."""

        def noted(item: tuple[Mapping[str, Any], Mapping[str, Any]]) -> None:
            alert, known_by = item
            send(alert)
            self._memo.note("sent", receiver=code, **known_by)

        self._alerts[code] = Outbox(noted, code=code, what=what)

    def _event(self, track: Track) -> bytes:
        return cot_event(
            track,
            self._site,
            uid=f"{self._uid}.{track.id}",
            now_ns=time.time_ns(),
            stale_s=self._outputs.cot_stale_s,
        )

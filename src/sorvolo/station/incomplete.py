"""What a flight from a stream lacks at its mission's end, and why, in words."""

from pathlib import Path

from sorvolo.capture.live.growing import ENDED_SUFFIX
from sorvolo.station.disk_room import shortage
from sorvolo.station.orders import Order
from sorvolo.survey.wording import counted

_FOLLOW = "follow:"


def cut_off(order: Order, *, was_stopped: bool) -> str:
    """Why the flight that a mission followed did not come to its own end; "" where it did, or a person ended it.

    A full disk is named also where a person ended it: pictures wait at the drone, or beside the mission, that the
    station could not take. Ask before the camera's reader is ended.
    """
    if not order.source.startswith(_FOLLOW):
        return ""
    path = Path(order.source.removeprefix(_FOLLOW))
    if path.with_name(path.name + ENDED_SUFFIX).exists():
        return ""
    short = shortage(path.parent, order.floor_gb)
    full = f"the station's disk is full ({short}): it took no more pictures" if short else ""
    away = (
        ""
        if was_stopped
        else f"nothing came for {order.away_s:.0f} s, and the flight's end was never stated"
    )
    return "; ".join(filter(None, (full, away)))


def unsent(pictures: int) -> str:
    """What it means that a camera's last pictures are not on the station's disk; "" where all are."""
    return (
        f"{counted(pictures, 'picture')} of the camera did not get to the station's disk"
        if pictures
        else ""
    )

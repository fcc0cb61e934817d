"""Bearer tokens: made once, kept as hashes, each with a role; guessing them is slowed down."""

import hashlib
import hmac
import secrets
import sqlite3
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import IntEnum

from sorvolo.errors import InputError, SettingsError
from sorvolo.station.state import StationState, utc_after, utc_now

_PREFIX = "sorvolo"
_NO_HASH = "0" * 64
_FREE_ATTEMPTS = 5  # wrong tokens of an address without a wait; by choice, as the next two
_LONGEST_WAIT_S = 300.0
_MOST_ADDRESSES = 10_000


class Role(IntEnum):
    """What a token allows; each role allows what those before it do."""

    VIEW = 1
    REVIEW = 2
    OPERATE = 3

    @property
    def word(self) -> str:
        """The role as it is written."""
        return self.name.lower()


@dataclass(frozen=True)
class Holder:
    """Who asks: the name of the token and its role."""

    name: str
    role: Role


@dataclass(frozen=True)
class TokenEntry:
    """A token as it is listed; times are RFC 3339 UTC, `expires_at` None for ever."""

    name: str
    role: str
    made_at: str
    expires_at: str | None


def make_token(state: StationState, name: str, role: str, days: float | None = None) -> str:
    """Make a token and return it: the only time that it is seen. Raises SettingsError, and InputError for a known name.

    The secret has 256 random bits, so that a fast hash of it cannot be turned back.
    """
    if not (name.strip() and len(name) <= 80 and name.isprintable()):
        raise SettingsError(
            f"{name!r} cannot name a token; give up to 80 letters, such as a person's name"
        )
    if role.upper() not in Role.__members__:
        raise SettingsError(f"--role {role!r}: view, review or operate was needed")
    if days is not None and not 0 < days < 36_500:
        raise SettingsError(f"--days {days}: a number above 0 was needed")
    token_id, secret = secrets.token_hex(6), secrets.token_urlsafe(32)
    try:
        with state.changing() as connection:
            connection.execute(
                "INSERT INTO tokens VALUES (?, ?, ?, ?, ?, ?)",
                (
                    token_id,
                    name,
                    role.lower(),
                    _hash(secret),
                    utc_now(),
                    None if days is None else utc_after(86_400 * days),
                ),
            )
    except sqlite3.IntegrityError as error:
        raise InputError(
            f"there is a token named {name!r} already; revoke it first, or choose another name"
        ) from error
    return f"{_PREFIX}_{token_id}_{secret}"


def revoke_token(state: StationState, name: str) -> None:
    """Make a token void. Raises InputError for a name that no token has."""
    with state.changing() as connection:
        gone = connection.execute("DELETE FROM tokens WHERE name = ?", (name,)).rowcount
    if not gone:
        raise InputError(
            f"there is no token named {name!r}; `sorvolo token ROOT` lists those there are"
        )


def list_tokens(state: StationState) -> list[TokenEntry]:
    """All tokens, oldest first, without their secrets."""
    rows = state.rows("SELECT name, role, made_at, expires_at FROM tokens ORDER BY made_at")
    return [TokenEntry(*row) for row in rows]


def has_tokens(state: StationState) -> bool:
    """Whether any token was made, expired ones included: a station with tokens never opens by their expiry."""
    return bool(state.rows("SELECT 1 FROM tokens LIMIT 1"))


def known_id_of(state: StationState, token: str) -> str:
    """The id in a token, where there is a token of that id (whatever its secret); else ""."""
    token_id = _parts(token)[1]
    return token_id if state.rows("SELECT 1 FROM tokens WHERE id = ?", (token_id,)) else ""


def holder_of(state: StationState, token: str) -> Holder | None:
    """Whose token this is; None where it is nobody's, or has expired."""
    prefix, token_id, secret = _parts(token)
    rows = state.rows("SELECT name, role, hash, expires_at FROM tokens WHERE id = ?", (token_id,))
    # compared whether the id is known or not: the time taken must not give away which ids there are
    same = hmac.compare_digest(_hash(secret), rows[0]["hash"] if rows else _NO_HASH)
    if not (rows and same and prefix == _PREFIX):
        return None
    expires = rows[0]["expires_at"]
    if expires is not None and datetime.fromisoformat(expires) <= datetime.now(UTC):
        return None
    return Holder(rows[0]["name"], Role[rows[0]["role"].upper()])


class Guesses:
    """Wrong tokens by their source, an address: after a few, each costs twice the wait of the one before."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._wrong: OrderedDict[str, tuple[int, float]] = OrderedDict()  # count, not before
        self._lock = threading.Lock()

    def wait_s(self, address: str) -> float:
        """How long this address has to wait before its next attempt is looked at, s."""
        with self._lock:
            _, not_before_s = self._wrong.get(address, (0, 0.0))
            return max(0.0, not_before_s - self._clock())

    def note(self, address: str, *, right: bool) -> None:
        """A token was looked at: right ones forgive the wrong ones before them."""
        with self._lock:
            count, _ = self._wrong.pop(address, (0, 0.0))
            if right:
                return
            wait_s = (
                0.0
                if count + 1 < _FREE_ATTEMPTS
                else min(2.0 ** (count + 1 - _FREE_ATTEMPTS), _LONGEST_WAIT_S)
            )
            self._wrong[address] = (count + 1, self._clock() + wait_s)
            while len(self._wrong) > _MOST_ADDRESSES:
                self._wrong.popitem(last=False)


def _parts(token: str) -> tuple[str, str, str]:
    """A token's prefix, id and secret; "" for what is missing."""
    prefix, _, rest = token.partition("_")
    token_id, _, secret = rest.partition("_")
    return prefix, token_id[:64], secret


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode("utf-8", "replace")).hexdigest()

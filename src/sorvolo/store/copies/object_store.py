"""An S3-compatible object store as bytes by key: requests are retried within limits, refusals are explained."""

import importlib.util
import io
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from configparser import ConfigParser
from configparser import Error as ConfigError
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeVar
from urllib.parse import urlsplit

from sorvolo.errors import SettingsError, StoreError, UnavailableError

if TYPE_CHECKING:
    from obstore.store import ObjectStore

_BUCKET = re.compile(r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]")
_PREFIX = re.compile(
    r"[A-Za-z0-9!_.*'()-]+(/[A-Za-z0-9!_.*'()-]+)*"
)  # names that no store or program writes otherwise
_CODE = re.compile(r"<Code>([A-Za-z]{1,60})</Code>")
_PATH = re.compile(r"(https?://[^/\s]*)\S*")  # which may hold any words
_STATUS = re.compile(r"status code: (\d{3})")
_CLOCK = "this machine's clock is off: set it (by NTP), then run the same command again"
_FULL = "the store is full: free some space there"
_KEYS = "the keys are not valid: check AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY (or AWS_PROFILE)"
_NO_KEYS = "no keys were found: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE"
_SLOW = "the connection is too slow or was cut; run the same command again; it continues where it stopped"
_REGION = "the bucket lies in another region: set AWS_REGION to it, and AWS_ENDPOINT_URL where it is not Amazon's"
_TOKEN = "the session has ended: get new keys (AWS_SESSION_TOKEN)"
_WORDS = {
    "NoSuchBucket": "there is no such bucket: check its name, and AWS_ENDPOINT_URL where it is not Amazon's",
    "AccessDenied": "the keys have no right to do this in the bucket: ask its owner for reading, writing and listing",
    "AllAccessDisabled": "the bucket is closed: ask its owner",
    "InvalidAccessKeyId": _KEYS,
    "SignatureDoesNotMatch": _KEYS,
    "RequestTimeTooSkewed": _CLOCK,
    "RequestExpired": _CLOCK,
    "ExpiredToken": _TOKEN,
    "InvalidToken": _TOKEN,
    "PermanentRedirect": _REGION,
    "AuthorizationHeaderMalformed": _REGION,
    "IllegalLocationConstraintException": _REGION,
    "SlowDown": "the store is busy: run the same command again later",
    "EntityTooLarge": "the store takes no file of this size",
    "QuotaExceeded": _FULL,
    "XMinioStorageFull": _FULL,
}  # S3's codes of errors

_BY_STATUS = {"403": _WORDS["AccessDenied"], "401": _KEYS, "301": _REGION}
_UNASKED = (  # by the library's message: what keeps it from asking the store at all, which no later try mends
    ("http://169.254.", _NO_KEYS),
    ("credential", _NO_KEYS),  # where only Amazon's machines give keys
    (
        "certificate",
        "the store's certificate is not trusted: set AWS_CA_BUNDLE to its authority's PEM file",
    ),
)
_WITHOUT_ANSWER = (  # likewise, the first that is in it
    ("timed out", _SLOW),
    ("timedout", _SLOW),
    (
        "",
        "no connection, or it was cut: check the network and AWS_ENDPOINT_URL, then run the same command again",
    ),
)

T = TypeVar("T")


class ConflictError(Exception):
    """The object to be replaced has changed."""


@dataclass(frozen=True)
class ObjectSettings:
    """Limits of one request, and of how often it is tried again, for links of 0.5 Mbit/s and better."""

    connect_s: float = 10.0  # for a connection; by choice
    request_s: float = 150.0  # one part with all its bytes
    retries: int = 4  # by the library, of requests that were answered by 5xx or not at all
    retry_s: float = 120.0  # after which the library tries no more
    tries: int = 2  # of ours, also for connections cut within an answer
    part_bytes: int = 8 << 20


class Objects:
    """Objects by key below one prefix of a store. Threads may share it.

    Every method raises StoreError where the store refuses or cannot be reached; no message holds a key of access.
    """

    def __init__(
        self, store: "ObjectStore", name: str, settings: ObjectSettings = ObjectSettings()
    ) -> None:
        self._store, self.name, self._settings = store, name, settings

    def read(self, key: str, most_bytes: int) -> tuple[bytes, str]:
        """An object and its ETag. Raises FileNotFoundError where there is none."""
        import obstore

        def get() -> tuple[bytes, str]:
            found = obstore.get(self._store, key)
            if found.meta["size"] > most_bytes:
                raise StoreError(
                    f"{self.name}/{key} has {found.meta['size'] / 1e6:.0f} MB: no Sorvolo wrote it"
                )
            return bytes(found.bytes()), str(found.meta["e_tag"])

        return self._tried(get, "read")

    def opened(self, key: str, size: int) -> BinaryIO:
        """An object of this size, read part by part when asked for. Reading raises FileNotFoundError for none."""
        return io.BufferedReader(_Parts(self, key, size), self._settings.part_bytes)

    def part(self, key: str, start: int, length: int) -> bytes:
        """Some bytes of an object. Raises FileNotFoundError where there is none."""
        import obstore

        return self._tried(
            lambda: bytes(obstore.get_range(self._store, key, start=start, length=length)), "read"
        )

    def write(self, key: str, stream: BinaryIO) -> None:
        """Put all of a stream, from its beginning, whole or not at all."""
        import obstore

        def put() -> None:
            stream.seek(0)
            obstore.put(
                self._store, key, stream, chunk_size=self._settings.part_bytes, max_concurrency=2
            )

        self._tried(put, "write")

    def swap(self, key: str, data: bytes, etag: str) -> None:
        """Replace an object only if it still has this ETag, or make it only if there is none (""); else ConflictError.

        Tried once: after a lost answer the caller has to look what is there.
        """
        import obstore
        from obstore.exceptions import AlreadyExistsError, PreconditionError

        with self._in_words("write"):
            try:
                mode: Any = {"e_tag": etag} if etag else "create"
                obstore.put(self._store, key, data, mode=mode, use_multipart=False)
            except (AlreadyExistsError, PreconditionError):
                raise ConflictError(key) from None

    def sizes(self, prefix: str) -> dict[str, int]:
        """The size of every object whose key begins with this folder ("" for all)."""
        return {key: size for key, (size, _) in self.listing(prefix).items()}

    def listing(self, prefix: str) -> dict[str, tuple[int, float]]:
        """The same, with how long ago each object was stored, s."""
        import obstore

        def listed() -> dict[str, tuple[int, float]]:
            found = [each for batch in obstore.list(self._store, prefix or None) for each in batch]
            newest = max((each["last_modified"] for each in found), default=None)
            now = max(newest, datetime.now(UTC)) if newest else None
            return {
                each["path"]: (
                    each["size"],
                    (now - each["last_modified"]).total_seconds() if now else 0.0,
                )
                for each in found
            }

        return self._tried(listed, "list")

    def first(self) -> list[str]:
        """A first page of keys, fewer than a thousand; none where nothing is stored."""
        import obstore

        def some() -> list[str]:
            return [each["path"] for each in next(iter(obstore.list(self._store)), [])]

        return self._tried(some, "list")

    def folders(self) -> list[str]:
        """The first parts of all keys that have several."""
        import obstore

        found = self._tried(lambda: obstore.list_with_delimiter(self._store), "list")
        return [each.strip("/").rpartition("/")[2] for each in found["common_prefixes"]]

    def has(self, key: str) -> bool:
        """Whether there is such an object."""
        import obstore

        try:
            self._tried(lambda: obstore.head(self._store, key), "read")
        except FileNotFoundError:
            return False
        return True

    def copy(self, key: str, to: str) -> None:
        """Copy an object to a second key, within the store."""
        import obstore

        self._tried(lambda: obstore.copy(self._store, key, to), "copy")

    def remove(self, keys: Sequence[str]) -> None:
        """Delete objects; those that are gone already count as deleted."""
        import obstore

        self._tried(lambda: obstore.delete(self._store, list(keys)), "delete")

    def _tried(self, work: Callable[[], T], action: str) -> T:
        """What the work returns; it is repeated where a connection breaks."""
        for count in range(1, self._settings.tries):
            try:
                with self._in_words(action):
                    return work()
            except _CutError:
                time.sleep(0.5 * 2**count)
        with self._in_words(action):
            return work()

    @contextmanager
    def _in_words(self, action: str) -> Iterator[None]:
        """Turn the store's refusals into StoreErrors. The library's own words are left out: they may hold keys."""
        from obstore.exceptions import BaseError

        try:
            yield
        except (BaseError, OSError) as error:
            text = str(error)
            if isinstance(error, FileNotFoundError) and "NoSuchBucket" not in text:
                raise FileNotFoundError(2, "no such object", self.name) from None
            raise _kind_of(text)(f"cannot {action} at {self.name}: {_words_of(text)}") from None


class _CutError(UnavailableError):
    """There was no answer, or only part of one."""


class _Parts(io.RawIOBase):
    """An object read in ranges."""

    def __init__(self, objects: Objects, key: str, size: int) -> None:
        self._objects, self._key, self._size, self._at = objects, key, size, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = offset + (0, self._at, self._size)[whence]
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: Any) -> int:
        length = min(len(buffer), self._size - self._at)
        if length <= 0:
            return 0
        data = self._objects.part(self._key, self._at, length)
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)


def open_objects(address: str, settings: ObjectSettings = ObjectSettings()) -> Objects:
    """The objects below `s3://BUCKET/PREFIX`, with keys, region and endpoint from the environment.

    AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_SESSION_TOKEN, or AWS_PROFILE in ~/.aws; AWS_REGION; AWS_ENDPOINT_URL
    for stores that are not Amazon's; AWS_CA_BUNDLE for authorities of their own. Raises SettingsError for an address
    that names none, or where the library is not installed.
    """
    bucket, prefix = _parsed(address)
    if importlib.util.find_spec("obstore") is None:
        raise SettingsError(
            "object stores need one more package; install it: pip install 'sorvolo[s3]'"
        )
    from obstore.exceptions import BaseError
    from obstore.store import S3Store

    options: Any = {
        "connect_timeout": timedelta(seconds=settings.connect_s),
        "timeout": timedelta(seconds=settings.request_s),
    }
    endpoint = _endpoint()
    if endpoint.startswith("http://"):
        options["allow_http"] = True  # it was asked for in so many letters
    if bundle := os.environ.get("AWS_CA_BUNDLE"):
        options["root_certificate"] = Path(bundle).read_bytes()
    retries: Any = {
        "max_retries": settings.retries,
        "retry_timeout": timedelta(seconds=settings.retry_s),
    }
    config: Any = (
        {"checksum_algorithm": "sha256"}
        | ({"endpoint": endpoint} if endpoint else {})
        | _profile(os.environ)
    )
    region = (
        os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION") or config.get("region")
    )
    try:
        store = S3Store(
            bucket,
            prefix=prefix or None,
            client_options=options,
            retry_config=retries,
            config=config | {"region": region or "us-east-1"},
        )
    except BaseError:
        raise SettingsError(
            "the AWS_ variables of the environment hold what no store takes; check them"
        ) from None
    return Objects(store, f"s3://{bucket}/{prefix}".rstrip("/"), settings)


def _parsed(address: str) -> tuple[str, str]:
    """Bucket and prefix of an address. Raises SettingsError, without the address where it may hold a key."""
    parts = urlsplit(address)
    if "@" in address:
        raise SettingsError(
            "an address of a store holds no keys; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
        )
    prefix = parts.path.strip("/")
    plain = not prefix or (_PREFIX.fullmatch(prefix) and not {".", ".."} & set(prefix.split("/")))
    if (
        parts.scheme != "s3"
        or parts.query
        or parts.fragment
        or not _BUCKET.fullmatch(parts.netloc)
        or not plain
    ):
        raise SettingsError(
            f"{address[:200]!r} names no place in a store; give s3://BUCKET/NAME, NAME of letters, digits, '-', '_'"
        )
    return parts.netloc, prefix


def _endpoint() -> str:
    for name in ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT"):
        if value := os.environ.get(name, ""):
            parts = urlsplit(value)
            if parts.scheme not in ("http", "https") or not parts.hostname or "@" in parts.netloc:
                raise SettingsError(
                    f"{name} holds no address; give https://HOST or https://HOST:PORT"
                )
            return value.rstrip("/")
    return ""


def _profile(environment: Mapping[str, str]) -> dict[str, str]:
    """Keys and region of a profile in the files of Amazon's own tools; none where the environment holds keys itself."""
    if environment.get("AWS_ACCESS_KEY_ID") or environment.get("AWS_SKIP_SIGNATURE"):
        return {}
    home = Path(environment.get("HOME", "~")).expanduser() / ".aws"
    profile = environment.get("AWS_PROFILE", "default")
    found = {
        **_section(
            Path(environment.get("AWS_CONFIG_FILE", home / "config")), f"profile {profile}", profile
        ),
        **_section(
            Path(environment.get("AWS_SHARED_CREDENTIALS_FILE", home / "credentials")), profile
        ),
    }
    if "AWS_PROFILE" in environment and "aws_access_key_id" not in found:
        raise SettingsError(
            f"the profile {profile!r} (AWS_PROFILE) has no keys in {home}; check its name"
        )
    names = {
        "aws_access_key_id": "access_key_id",
        "aws_secret_access_key": "secret_access_key",
        "aws_session_token": "session_token",
        "region": "region",
    }
    return {ours: found[theirs] for theirs, ours in names.items() if theirs in found}


def _section(path: Path, *names: str) -> dict[str, str]:
    parser = ConfigParser(interpolation=None)
    try:
        parser.read(path, encoding="utf-8")
    except (OSError, ConfigError, UnicodeDecodeError):
        raise SettingsError(
            f"{path} cannot be read; mend it, or set AWS_ACCESS_KEY_ID instead"
        ) from None
    return next((dict(parser[name]) for name in names if parser.has_section(name)), {})


def _kind_of(text: str) -> type[StoreError]:
    """What a library's error is: no answer, one that may be another later (5xx), or a refusal."""
    status, code = _STATUS.search(text), _CODE.search(text)
    if _unasked(text):
        return StoreError
    if status is None and code is None:
        return _CutError
    is_busy = (status is not None and status[1].startswith("5")) or (
        code is not None and code[1] == "SlowDown"
    )
    return UnavailableError if is_busy else StoreError


def _words_of(text: str) -> str:
    """Advice for a library's error. The error itself may hold keys and is not repeated."""
    code, status = _CODE.search(text), _STATUS.search(text)
    if code and code[1] in _WORDS:
        return f"{_WORDS[code[1]]} ({code[1]})"
    if unasked := _unasked(text):
        return unasked
    if "redirect" in text:
        return _REGION
    if status is None:
        return next(words for hint, words in _WITHOUT_ANSWER if hint in text.lower())
    answered = f"the store answered {status[1]}{f' {code[1]}' if code else ''}"
    known = _BY_STATUS.get(status[1], "")
    return f"{known} ({answered})" if known else f"{answered}; run the same command again later"


def _unasked(text: str) -> str:
    """Advice where no store was asked; "" where one was. A store's answer has a code, and may quote such words."""
    if _CODE.search(text):
        return ""
    own = _PATH.sub(r"\1", text.lower())
    return next((words for hint, words in _UNASKED if hint in own), "")

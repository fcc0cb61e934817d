"""MISB ST 0601: the UAS Datalink Local Set inside MPEG-TS, from bytes to numbers and back; detections in it (ST 0903)."""

import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from math import isfinite, nan
from urllib.parse import quote

from sorvolo.errors import InputError

UNIVERSAL_KEY = bytes.fromhex("060E2B34020B01010E01030101000000")
"""The 16 bytes that every UAS Datalink Local Set begins with (ST 0601, section 6.1)."""

TIME_TAG, CHECKSUM_TAG, VERSION_TAG = 2, 1, 65

_LONGEST_SET_BYTES = 65_536  # MISB ST 0601's sets have hundreds; by choice
_LONGEST_KEY_BYTES = 4  # of a BER-OID tag: 28 bits, far more than ST 0601 needs


@dataclass(frozen=True)
class Item:
    """How one tag's number is written: linearly over its range in `length` bytes (ST 0601, section 8).

    Signed ones span (-highest, highest), their lowest integer meaning "error"; `is_imapb` marks those by ST 1201.
    """

    name: str
    lowest: float
    highest: float
    length: int
    is_signed: bool = False
    is_imapb: bool = False


_STORED = tomllib.loads(
    files("sorvolo.capture.live").joinpath("klv.toml").read_text(encoding="utf-8")
)
ITEMS: Mapping[int, Item] = {int(tag): Item(*stored) for tag, stored in _STORED.items()}
"""The tags that are read, by number; those from 200 on are Sorvolo's own, in the flights that a station keeps."""

_VMTI_TAG = 74
_OFFSET = Item("offset_deg", -19.2, 19.2, 3, is_imapb=True)  # of a target's place: 85 cm a step
_ONTOLOGY = b"urn:sorvolo:class"  # no public one has "small object"


@dataclass(frozen=True)
class LocalSet:
    """One packet: its time (UTC, ns; 0 where it has none) and the numbers that it states, by `Item.name`."""

    time_ns: int
    version: int
    values: Mapping[str, float]

    def __getitem__(self, name: str) -> float:
        return self.values.get(name, nan)


def local_sets(data: bytes, counts: Counter[str]) -> Iterator[LocalSet]:
    """Every whole local set in the bytes, in order, whatever stands between them (such as AU headers of ST 1402).

    A set with a wrong or missing checksum is left out and counted as `bad_checksum`; one that is cut, or whose
    lengths do not add up, as `damaged`. A number that means "error" or lies outside its tag's range is NaN.
    """
    start = data.find(UNIVERSAL_KEY)
    while start >= 0:
        after = start + len(UNIVERSAL_KEY)
        try:
            length, body = _ber_length(data, after)
            if length > _LONGEST_SET_BYTES or body + length > len(data):
                raise InputError("a local set that is cut")
            # The set in a packet whose value begins at `body`; None where the checksum does not
            # fit.
            packet = data[start : body + length]
            time_ns, version, is_sound = 0, 0, False
            values: dict[str, float] = {}
            for tag, at, value in _items_in(packet, body - start):
                if tag == CHECKSUM_TAG:
                    is_sound = len(value) == 2 and int.from_bytes(value, "big") == checksum(
                        packet[:at]
                    )
                elif tag == VERSION_TAG:
                    version = int.from_bytes(value[:2], "big")
                elif not 0 < len(value) <= 8:
                    continue
                elif tag == TIME_TAG:
                    time_ns = int.from_bytes(value, "big") * 1000
                elif tag in ITEMS:
                    values[ITEMS[tag].name] = _number(ITEMS[tag], value)
            found = (
                LocalSet(time_ns if time_ns < 2**63 else 0, version, values) if is_sound else None
            )
        except InputError:
            counts["damaged"] += 1
        else:
            after = body + length
            if found is None:
                counts["bad_checksum"] += 1
            else:
                yield found
        start = data.find(UNIVERSAL_KEY, after)


def encode(
    time_ns: int, values: Mapping[str, float], version: int = 19, vmti: bytes = b""
) -> bytes:
    """The local set that states these numbers, by `Item.name`; the inverse of `local_sets` within half a step.

    `vmti` is what `vmti_set` made, embedded. A value that is not finite is written as "error" where its tag has a code for it, else left out. Raises InputError
    for an unknown name or a value outside its tag's range.
    """
    numbers = {item.name: tag for tag, item in ITEMS.items()}
    if unknown := sorted(set(values) - set(numbers)):
        raise InputError(f"no tag for {unknown[0]}; known are {', '.join(numbers)}")
    body = _tagged(TIME_TAG, (time_ns // 1000).to_bytes(8, "big"))
    for name, value in values.items():
        item = ITEMS[numbers[name]]
        if isfinite(value) or item.is_signed:
            body += _tagged(numbers[name], _bytes_of(item, value))
    body += _tagged(VERSION_TAG, bytes([version])) + (_tagged(_VMTI_TAG, vmti) if vmti else b"")
    length = len(body) + 4
    packet = UNIVERSAL_KEY + _written_length(length) + body + bytes([CHECKSUM_TAG, 2])
    return packet + checksum(packet).to_bytes(2, "big")


@dataclass(frozen=True)
class VmtiTarget:
    """A detection in a picture; `box_px` is left, top, right, bottom, its place NaN where it is not known."""

    number: int
    label: str
    score: float
    box_px: Sequence[float]
    latitude_deg: float
    longitude_deg: float


def vmti_set(
    targets: Sequence[VmtiTarget], size_px: tuple[int, int], centre_deg: tuple[float, float]
) -> bytes:
    """The VMTI Local Set (ST 0903.6) of one picture's detections, as ST 0601 embeds it.

    `size_px` is the picture's width and height, `centre_deg` the latitude and longitude of tags 23 and 24, from which
    places count. Classes stand in an ontology of Sorvolo's own.
    """
    labels = sorted({target.label for target in targets})
    classes = {label: number for number, label in enumerate(labels, 1)}
    packs = [
        _written_oid(target.number)
        + _pixels(target.box_px, size_px)
        + _tagged(5, bytes([round(100 * target.score)]))
        + _offset(10, target.latitude_deg - centre_deg[0])
        + _offset(11, target.longitude_deg - centre_deg[1])
        + _tagged(107, _series([_tagged(3, _unsigned(classes[target.label]))]))
        for target in targets
    ]
    ontology = [
        _tagged(1, _unsigned(number))
        + _tagged(3, _ONTOLOGY)
        + _tagged(4, _ONTOLOGY + b":" + quote(label).encode())
        + _tagged(6, label.encode())
        for label, number in classes.items()
    ]
    count = _unsigned(len(targets))
    width, height = map(_unsigned, size_px)
    items = {3: b"sorvolo", 4: b"\6", 5: count, 6: count, 8: width, 9: height}
    items |= {101: _series(packs), 103: _series(ontology)}
    return b"".join(_tagged(*item) for item in items.items())


def checksum(data: bytes) -> int:
    """The running 16-bit sum of ST 0601, section 6.3, over all bytes before the checksum's own value."""
    return (sum(data[0::2]) * 256 + sum(data[1::2])) & 0xFFFF


# ---- inside ---------------------------------------------------------------------------------------------------


def _items_in(packet: bytes, at: int) -> Iterator[tuple[int, int, bytes]]:
    """The items of a set from `at` on: tag, where the value begins, the value. Raises InputError for a damaged one."""
    while at < len(packet):
        tag, at = _ber_oid(packet, at)
        length, at = _ber_length(packet, at)
        if at + length > len(packet):
            raise InputError("an item that is longer than its set")
        yield tag, at, packet[at : at + length]
        at += length


def _number(item: Item, value: bytes) -> float:
    """The number in as many bytes as the sender chose; more bytes are the same range in finer steps."""
    bits = 8 * len(value)
    if item.is_imapb:
        forward, offset = _imapb(item, len(value))
        number = (int.from_bytes(value, "big") - offset) / forward + item.lowest
        # the upper half of the codes are special values (infinity, not a number)
        return number if item.lowest <= number <= item.highest else nan
    if item.is_signed:
        whole = int.from_bytes(value, "big", signed=True)
        return (
            nan if whole == -(1 << (bits - 1)) else item.highest * whole / ((1 << (bits - 1)) - 1)
        )
    return item.lowest + (item.highest - item.lowest) * int.from_bytes(value, "big") / (
        (1 << bits) - 1
    )


def _bytes_of(item: Item, value: float) -> bytes:
    bits = 8 * item.length
    if not isfinite(value):
        return (1 << (bits - 1)).to_bytes(item.length, "big")
    if not item.lowest <= value <= item.highest:
        raise InputError(
            f"{item.name} = {value:g} lies outside its tag's {item.lowest:g} to {item.highest:g}"
        )
    if item.is_imapb:
        forward, offset = _imapb(item, item.length)
        return int(forward * (value - item.lowest) + offset).to_bytes(item.length, "big")
    if item.is_signed:
        return round(value / item.highest * ((1 << (bits - 1)) - 1)).to_bytes(
            item.length, "big", signed=True
        )
    share = (value - item.lowest) / (item.highest - item.lowest)
    return round(share * ((1 << bits) - 1)).to_bytes(item.length, "big")


def _imapb(item: Item, length: int) -> tuple[float, float]:
    """Scale and zero offset of ST 1201, section 7.2: steps are a power of two, and zero stays exact."""
    span = item.highest - item.lowest
    whole = int(span)
    exponent = (whole - 1).bit_length() if whole == span else whole.bit_length()
    forward = 2.0 ** (8 * length - 1 - exponent)
    zero = forward * item.lowest
    return forward, zero - zero // 1 if item.lowest < 0 < item.highest else 0.0


def _pixels(box_px: Sequence[float], size_px: tuple[int, int]) -> bytes:
    """Tags 1 to 3: the numbers of a box's middle, first and last pixel, from 1 on, row by row."""
    left, top, right, bottom = box_px
    places = ((left + right) / 2, (top + bottom) / 2), (left, top), (right, bottom)
    written = b""
    for tag, place in enumerate(places, 1):
        column, row = (min(max(int(at), 0), side - 1) for at, side in zip(place, size_px))
        written += _tagged(tag, _unsigned(row * size_px[0] + column + 1))
    return written


def _offset(tag: int, degrees: float) -> bytes:
    """A place's offset from the frame's centre; nothing where it is unknown, or beyond the tag's range."""
    if not abs(degrees) < _OFFSET.highest:
        return b""
    half_step = 0.5 / _imapb(_OFFSET, _OFFSET.length)[0]  # ST 1201 cuts, to the south-west
    return _tagged(tag, _bytes_of(_OFFSET, degrees + half_step))


def _series(packs: Sequence[bytes]) -> bytes:
    return b"".join(_written_length(len(pack)) + pack for pack in packs)


def _unsigned(number: int) -> bytes:
    return number.to_bytes(max(1, -(-number.bit_length() // 8)), "big")


def _written_oid(number: int) -> bytes:
    """A number in BER-OID; the inverse of `_ber_oid`."""
    groups = [number & 0x7F]
    while number := number >> 7:
        groups.insert(0, 0x80 | number & 0x7F)
    return bytes(groups)


def _tagged(tag: int, value: bytes) -> bytes:
    return _written_oid(tag) + _written_length(len(value)) + value


def _written_length(length: int) -> bytes:
    if length < 128:
        return bytes([length])
    size = (length.bit_length() + 7) // 8
    return bytes([0x80 | size]) + length.to_bytes(size, "big")


def _ber_length(data: bytes, at: int) -> tuple[int, int]:
    """A BER length, short or long form, and where what it measures begins."""
    if at >= len(data):
        raise InputError("a length that is cut")
    first = data[at]
    if first < 128:
        return first, at + 1
    size = first & 0x7F
    if size == 0 or size > 4 or at + 1 + size > len(data):
        raise InputError("a length in no definite form")
    return int.from_bytes(data[at + 1 : at + 1 + size], "big"), at + 1 + size


def _ber_oid(data: bytes, at: int) -> tuple[int, int]:
    """A tag in BER-OID: seven bits a byte, the highest bit set where another follows."""
    tag = 0
    for place in range(at, min(at + _LONGEST_KEY_BYTES, len(data))):
        tag = tag << 7 | data[place] & 0x7F
        if data[place] < 128:
            return tag, place + 1
    raise InputError("a tag that does not end")

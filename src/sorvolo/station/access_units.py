"""Access units of H.264 and H.265 with start codes (Annex B): what is in them, read without decoding."""

from collections.abc import Iterator

_START = b"\x00\x00\x01"
_AUD = {"h264": b"\x00\x00\x00\x01\x09\xf0", "hevc": b"\x00\x00\x00\x01\x46\x01\x50"}
_SETS = {"h264": frozenset({7, 8}), "hevc": frozenset({32, 33, 34})}  # parameter sets
_SPS = {"h264": 7, "hevc": 33}
_DELIMITER = {"h264": 9, "hevc": 35}
_PICTURES = {"h264": frozenset(range(1, 6)), "hevc": frozenset(range(32))}


def nal_units(data: bytes) -> Iterator[bytes]:
    """The NAL units between the start codes, without them."""
    at = data.find(_START)
    while at >= 0:
        begin = at + 3
        at = data.find(_START, begin)
        unit = data[begin:] if at < 0 else data[begin:at]
        if unit := unit.rstrip(b"\x00"):
            yield unit


def nal_type(codec: str, unit: bytes) -> int:
    """The NAL unit's type: H.264's table 7-1, H.265's table 7-1."""
    return unit[0] & 0x1F if codec == "h264" else unit[0] >> 1 & 0x3F


def nal_types(codec: str, data: bytes) -> frozenset[int]:
    """The types of all NAL units."""
    return frozenset(nal_type(codec, unit) for unit in nal_units(data))


def is_delimiter(codec: str, unit: bytes) -> bool:
    """Whether a NAL unit only states that an access unit begins."""
    return nal_type(codec, unit) == _DELIMITER[codec]


def has_picture(codec: str, data: bytes) -> bool:
    """Whether there is any part of a picture in it: what is no video of this codec mostly has none."""
    return bool(nal_types(codec, data) & _PICTURES[codec])


def begins_decoding(codec: str, data: bytes) -> bool:
    """Whether a decoder can begin with this unit, if it is a key frame: it has all parameter sets and a picture."""
    types = nal_types(codec, data)
    return types >= _SETS[codec] and bool(types & _PICTURES[codec])


def parameter_sets(codec: str, data: bytes) -> bytes:
    """The parameter sets in it, each behind a start code; empty where there are none."""
    return b"".join(
        b"\x00\x00\x00\x01" + unit
        for unit in nal_units(data)
        if nal_type(codec, unit) in _SETS[codec]
    )


def with_parameter_sets(codec: str, data: bytes, sets: bytes) -> bytes:
    """A key frame that begins with its parameter sets: its own where it has them all, else these before it."""
    return data if not sets or nal_types(codec, data) >= _SETS[codec] else sets + data


def with_delimiter(codec: str, data: bytes) -> bytes:
    """The unit behind an access unit delimiter, as transport streams have it (ISO 13818-1, 2.14)."""
    first = next(nal_units(data[:64]), b"\x00")
    return data if is_delimiter(codec, first) else _AUD[codec] + data


def codec_string(codec: str, data: bytes) -> str | None:
    """The codec as browsers name it (RFC 6381), such as avc1.640028, from a key frame; None without parameter sets."""
    sps = next((unit for unit in nal_units(data) if nal_type(codec, unit) == _SPS[codec]), b"")
    if codec == "h264":
        return f"avc1.{sps[1:4].hex()}" if len(sps) > 3 else None
    return _hevc_string(sps.replace(b"\x00\x00\x03", b"\x00\x00"))


def _hevc_string(sps: bytes) -> str | None:
    """ISO 14496-15, E.3: profile, compatibility flags in reverse bit order, tier and level, constraint bytes."""
    if len(sps) < 15:
        return None
    profile, compatible = sps[3], int.from_bytes(sps[4:8], "big")
    reverse = int(f"{compatible:032b}"[::-1], 2)
    tier = "H" if profile & 0x20 else "L"
    constraints = sps[8:14].rstrip(b"\x00")
    space = ("", "A", "B", "C")[profile >> 6]
    known = [f"hvc1.{space}{profile & 0x1F}", f"{reverse:x}", f"{tier}{sps[14]}"]
    return ".".join([*known, *(f"{each:x}" for each in constraints)])

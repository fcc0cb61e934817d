"""A process that looks into one upload within limits of memory and time: does it match its name, is it no bomb?"""

import json
import re
import resource
import shutil
import stat
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import IO

from sorvolo.paths import Json

# a picture of 200 megapixels takes 0.6 GB decoded, copies and libraries the rest
_MEMORY_BYTES = 3 << 30
_CPU_S = 600  # of processor time; by choice
_MOST_PIXELS = 200_000_000  # of one picture: a 100-megapixel camera twice over
_MOST_FILES = 20_000  # photos of a day's flights; by choice
_MOST_RATIO = 200  # unpacked over packed: photos hardly shrink
_PHOTOS = (".jpg", ".jpeg", ".tif", ".tiff", ".dng", ".heic", ".png")
_TEXTS = (
    ".srt",
    ".ass",
    ".csv",
    ".gpx",
    ".txt",
    ".nmea",
    ".log",
    ".json",
    ".xml",
    ".mrk",
    ".obs",
    ".nav",
    ".bin",
    ".rtk",
)
_PICTURE_FORMATS = ("JPEG", "TIFF", "PNG")
_CONTAINERS = {".mp4": "mov", ".mov": "mov", ".m4v": "mov", ".mkv": "matroska", ".ts": "mpegts"}
_SIGNATURES = {".heic": ((4, b"ftyp"),), ".dng": ((0, b"II*\0"), (0, b"MM\0*"))}
_PLAIN_KINDS = (0, stat.S_IFREG, stat.S_IFDIR)  # 0: packed where files have no kinds
_SAFE = re.compile(r"[^\w.() -]", re.ASCII)


class UploadRefusal(Exception):
    """What is wrong with the upload."""


def look(part: Path, target: Path, most_bytes: int, keep_free_bytes: int = 0) -> Json:
    """What an upload holds; photos are unpacked into the folder `target`, which no dot is in. Raises UploadRefusal."""
    ending = target.suffix.lower()
    if ending in _CONTAINERS:
        return _video(part, _CONTAINERS[ending])
    with part.open("rb") as file:
        head = file.read(4096)
    if not ending:
        if head[:4] != b"PK\x03\x04":
            raise UploadRefusal("it is no zip file; pack the photos with zip")
        return _photos(part, target, most_bytes, keep_free_bytes)
    if b"\0" in head:
        raise UploadRefusal("it is no text; telemetry and camera files are")
    return {"kind": "text"}


def _video(part: Path, container: str) -> Json:
    import av

    with part.open("rb") as file:
        head = file.read(16)
    is_right = (
        head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")
        if container == "mov"
        else head[:4] == b"\x1aE\xdf\xa3"
        if container == "matroska"
        else b"G" in (head[:1], head[4:5])
    )
    if not is_right:
        raise UploadRefusal(f"its content is no {container} video, whatever its name is")
    try:
        # the demuxer is given: a playlist or a list of files in disguise would make FFmpeg open other things
        with av.open(str(part), format=container, options={"protocol_whitelist": "file"}) as video:
            if not video.streams.video:
                raise UploadRefusal("it has no pictures; was the upload cut off before it ended?")
            stream = video.streams.video[0]
            if stream.codec_context is None:  # announced by a head whose body is missing
                raise UploadRefusal("no picture in it can be decoded; was it cut off?")
            width_px, height_px = stream.codec_context.width, stream.codec_context.height
            if not 0 < width_px * height_px <= _MOST_PIXELS:
                raise UploadRefusal(
                    f"its pictures have {width_px} x {height_px} pixels, at most {_MOST_PIXELS:,} are taken"
                )
            next(video.decode(stream))
            seconds = (
                float(stream.duration * stream.time_base)
                if stream.duration and stream.time_base
                else None
            )
            whole_bytes = max((each.pos + each.size for each in stream.index_entries), default=0)
            return {
                "kind": "video",
                "width_px": width_px,
                "height_px": height_px,
                "seconds": seconds,
                "codec": stream.codec_context.name,
                "missing_bytes": max(0, whole_bytes - part.stat().st_size),
            }  # a flight that was cut is still one
    except StopIteration:
        raise UploadRefusal("no picture in it can be decoded; was it cut off?") from None
    except (av.FFmpegError, OSError) as error:
        raise UploadRefusal(
            f"it cannot be read as a video ({error.strerror}); was the file cut off?"
        ) from error


def _photos(part: Path, target: Path, most_bytes: int, keep_free_bytes: int) -> Json:
    taken: dict[str, Path] = {}
    try:
        with zipfile.ZipFile(part) as archive:
            entries = list(_entries(archive, most_bytes))
            wanted_bytes = sum(each.file_size for each in entries) + keep_free_bytes
            free_bytes = shutil.disk_usage(part.parent).free
            if wanted_bytes > free_bytes:
                raise UploadRefusal(
                    f"unpacked it needs {wanted_bytes / 1e9:.1f} GB with what stays free, {free_bytes / 1e9:.1f} GB are there; "
                    "delete uploads or flights that you no longer need, and upload it again"
                )
            target.mkdir(parents=True, exist_ok=True)
            left = most_bytes
            for entry in entries:
                path = target / _free_name(entry.filename, taken)
                with archive.open(entry) as packed:
                    left -= _unpacked(packed, path, left)
                if path.suffix.lower() in _PHOTOS:
                    _check_picture(path)
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError, ValueError) as error:
        raise UploadRefusal(f"it cannot be unpacked ({error}); was the file cut off?") from error
    except OSError as error:
        raise UploadRefusal(
            f"it cannot be unpacked here ({error.strerror}); check the station's disk"
        ) from error
    photos = sum(Path(name).suffix.lower() in _PHOTOS for name in taken)
    if not photos:
        raise UploadRefusal("there is no photo in it")
    return {"kind": "photos", "photos": photos}


def _entries(archive: zipfile.ZipFile, most_bytes: int) -> Iterator[zipfile.ZipInfo]:
    """The files in it that are wanted, others left out. Raises UploadRefusal for what was made to do harm."""
    entries = archive.infolist()
    if len(entries) > _MOST_FILES:
        raise UploadRefusal(f"{len(entries)} files are in it, at most {_MOST_FILES} are taken")
    if sum(each.file_size for each in entries) > most_bytes:
        raise UploadRefusal(
            f"unpacked it would have more than the {most_bytes / 1e9:.0f} GB that are taken"
        )
    for each in entries:
        path = PurePosixPath(each.filename.replace("\\", "/"))
        name = repr(each.filename[:80])
        if path.is_absolute() or ".." in path.parts or re.match(r"[A-Za-z]:", each.filename):
            raise UploadRefusal(
                f"the name {name} in it leads outside; pack the photos' folder itself"
            )
        if stat.S_IFMT(each.external_attr >> 16) not in _PLAIN_KINDS:
            raise UploadRefusal(f"{name} in it is a link or no plain file")
        if each.flag_bits & 1:
            raise UploadRefusal("it is encrypted; pack it without a password")
        if each.file_size > max(1_000_000, _MOST_RATIO * max(each.compress_size, 1)):
            raise UploadRefusal(
                f"{name} in it would unpack to {each.file_size / 1e6:.0f} MB: no photo does"
            )
        is_wanted = path.suffix.lower() in (*_PHOTOS, *_TEXTS) and not path.name.startswith(".")
        if is_wanted and not each.is_dir() and "__MACOSX" not in path.parts:
            yield each


def _free_name(name: str, taken: dict[str, Path]) -> str:
    """A name for a file in the one folder of photos; files of the same name in other folders get their folder's."""
    path = PurePosixPath(name.replace("\\", "/"))
    for count in range(1, len(path.parts) + 1):
        free = _SAFE.sub("_", "_".join(path.parts[-count:]))[-150:].lstrip(".- ") or "photo.jpg"
        if free.lower() not in {each.lower() for each in taken}:
            break
    taken[free] = Path(name)
    return free


def _unpacked(packed: IO[bytes], path: Path, left: int) -> int:
    """Write a file out; its bytes. What the archive announces is not trusted."""
    count = 0
    with path.open("xb") as file:
        while chunk := packed.read(1 << 20):
            count += len(chunk)
            if count > left:
                raise UploadRefusal("unpacked it has more bytes than it announces")
            file.write(chunk)
    return count


def _check_picture(path: Path) -> None:
    """Raise UploadRefusal unless the file is a picture of a size that a camera has; only its head is read."""
    from PIL import Image, UnidentifiedImageError

    with path.open("rb") as file:
        head = file.read(12)
    # their decoders are the mission's; their size is bounded there
    if path.suffix.lower() in _SIGNATURES:
        if not any(
            head[at : at + len(sign)] == sign for at, sign in _SIGNATURES[path.suffix.lower()]
        ):
            raise UploadRefusal(
                f"{path.name} is no {path.suffix[1:].upper()} picture, whatever its name is"
            )
        return
    try:
        with Image.open(path, formats=_PICTURE_FORMATS) as picture:
            width_px, height_px = picture.size
    except (
        UnidentifiedImageError,
        OSError,
        ValueError,
        SyntaxError,
        Image.DecompressionBombError,
    ) as error:
        raise UploadRefusal(
            f"{path.name} is no picture that can be read, whatever its name is"
        ) from error
    if not 0 < width_px * height_px <= _MOST_PIXELS:
        raise UploadRefusal(
            f"{path.name} has {width_px} x {height_px} pixels, at most {_MOST_PIXELS:,} are taken"
        )


def limit_process(cpu_s: int) -> None:
    """Bound this process's memory and processor time for good; it leaves no core file."""
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, _MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def main(part: str, target: str, most_bytes: str, keep_free_bytes: str) -> None:
    """Print one JSON object: what is wrong, or what the upload holds."""
    limit_process(_CPU_S)
    try:
        facts = look(Path(part), Path(target), int(most_bytes), int(keep_free_bytes))
        answer: Json = {"error": None, "facts": facts}
    except UploadRefusal as refusal:
        answer = {"error": str(refusal), "facts": None}
    except MemoryError:
        answer = {"error": "looking into it takes more memory than a flight needs", "facts": None}
    sys.stdout.write(json.dumps(answer))


if __name__ == "__main__":
    main(*sys.argv[1:5])

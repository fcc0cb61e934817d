"""What tests and benchmarks of batches share: flights that differ though their pictures do not, and sites compared."""

import json
import shutil
from pathlib import Path

_EFFORT = (  # of report.json
    "seconds",
    "cpu_s",
    "registration_cpu_s_per_keyframe",
    "peak_memory_mb",
    "latency_s",
    "frames_per_second",
)
_TIMED = {"report.html", "changes.html"}  # which show it


def another(flown: Path, folder: Path) -> Path:
    """The photos of `flown` as another flight: their first file ends in bytes that no decoder reads."""
    shutil.copytree(flown / "flight1" / "photos", folder)
    first = min(folder.iterdir())
    first.write_bytes(first.read_bytes() + folder.name.encode())
    return folder


def content(site: Path) -> dict[str, bytes]:
    """The files of a site, or of a watch, by name, less the catalogue and what states how long it took."""
    found = {}
    for path in sorted(site.rglob("*")):
        if not path.is_file() or path.name.startswith("site.") or path.name in _TIMED:
            continue
        data = path.read_bytes()
        if path.name == "report.json":
            report = json.loads(data)
            report["settings"]["memory_mb"] = None  # of the caches: a worker's share
            report.get("objects", {}).pop("seconds", None)
            data = json.dumps(
                {key: value for key, value in report.items() if key not in _EFFORT}
            ).encode()
        found[str(path.relative_to(site))] = data
    return found

"""What each mission costs for a frame of 1080p video and for a large photo: processor time, memory, bytes kept.

python benchmarks/unit_costs.py [--only NAME...] [--megapixels 12] [--seed 1] [--flights DIR] [--output FILE]

Each command of Sorvolo runs as a process of its own on a short and on a long input; the operating system accounts for
its processor time and peak memory, so that other work on the machine disturbs wall time alone, which is not given (a
loaded machine has slower caches: processor time grows by some tens of per cent). The difference of both runs over the
difference of their units is the unit cost; what remains of the short run is the start (imports, models). A unit is a
photo, and of a video a key frame (map), a view (compare) or a searched frame (watch); decoding is a row of its own and
taken off the others. Bytes and files are what the site, or the watch's folder, has more. One thread of OpenMP. Inputs
are simulated: 1080p video at 10 frames a second from 30 m, photos of `--megapixels` from 40 m with 70 % overlap; or
the photos are real ones, `--photos DIR`, of which a quarter and a half are mapped and watched, not compared; those of
another size are made as large as `--megapixels`, so that the same ground is measured in several sizes.
`--flights` keeps them. Written to results/unit_costs.json; `--only` measures those rows anew and keeps the others.
"""

import argparse
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image, ImageEnhance
from rich.console import Console
from rich.table import Table

from provenance import commit, machine
from sorvolo.lab.simulation.settings import (
    ImagingSettings,
    LaterSettings,
    OutputSettings,
    PathSettings,
    SceneSettings,
    SimulationSettings,
)
from sorvolo.lab.simulation.site import simulate_site

RESULTS = Path(__file__).parent / "results" / "unit_costs.json"
FPS, VIDEO_S, SPEED_M_S = 10.0, (2.0, 8.0), 6.0
PHOTO_STRIPS = (1, 3)
LATER_LIGHT = 1.1
LIMIT_S = 1500


@dataclass(frozen=True)
class Job:
    """A mission on one kind of input: its arguments after `sorvolo`, and the folder whose bytes are counted.

    In the texts {flight1}, {flight2} are inputs, {site} a new site, {mapped} one that holds the first flight, {out} a
    new folder.
    """

    name: str
    arguments: tuple[str, ...]
    grows: str


_DECODE = """
import sys, av
with av.open(sys.argv[1]) as video:
    video.streams.video[0].codec_context.thread_count = 1
    for frame in video.decode(video=0):
        frame.to_ndarray(format="rgb24")
"""
DECODE = Job("decode", ("-c", _DECODE, "{flight1}"), "{out}")
VIDEO_JOBS = (
    DECODE,
    Job("map", ("map", "{flight1}", "--site", "{site}", "--model", "none"), "{site}"),
    Job("map with objects", ("map", "{flight1}", "--site", "{site}"), "{site}"),
    Job("compare", ("compare", "{flight2}", "--site", "{mapped}", "--model", "none"), "{mapped}"),
    Job("watch", ("watch", "{flight2}", "--out", "{out}"), "{out}"),
)
PHOTO_JOBS = (
    *VIDEO_JOBS[1:],
    Job("heights", ("heights", "{mapped}"), "{mapped}"),
    Job("search", ("search", "{mapped}"), "{mapped}"),
)


REAL_JOBS = (
    VIDEO_JOBS[1],
    Job("watch", ("watch", "{flight1}", "--out", "{out}"), "{out}"),
    VIDEO_JOBS[3],
)


def main() -> None:
    """Simulate, run, account, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="*", help="rows such as 'video: watch'")
    parser.add_argument("--megapixels", type=float, default=12.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--photos", type=Path, help="a folder of real photos instead of simulated ones"
    )
    parser.add_argument(
        "--flights", type=Path, help="where the simulated flights are, or are to be kept"
    )
    parser.add_argument("--output", type=Path, default=RESULTS)
    parser.add_argument("--simulate", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.simulate:
        folder, kind, size = options.simulate
        simulate(Path(folder), kind, int(size), options.seed, options.megapixels)
        return
    known = (
        json.loads(options.output.read_text())
        if options.only and options.output.is_file()
        else {"rows": {}}
    )
    rows = known["rows"]
    photos = f"photo, {options.megapixels:g} MP"
    photo_jobs = PHOTO_JOBS if options.photos is None else REAL_JOBS
    with tempfile.TemporaryDirectory() as scratch:
        for kind, jobs in (("video", VIDEO_JOBS), (photos, photo_jobs)):
            wanted = [
                job for job in jobs if options.only is None or f"{kind}: {job.name}" in options.only
            ]
            if not wanted:
                continue
            flights = [
                simulated(options.flights or Path(scratch), kind, size, options) for size in (0, 1)
            ]
            for job in wanted:
                decode_s = (
                    rows.get("video: decode", {}).get("cpu_s", 0.0) if kind == "video" else 0.0
                )
                rows[f"{kind}: {job.name}"] = unit_cost(
                    job, flights, Path(scratch) / "work", decode_s
                ) | {
                    "commit": commit(),
                    "load_1_min": os.getloadavg()[0],
                }
                written(options.output, rows)
    show(rows)


def written(output: Path, rows: dict[str, Any]) -> None:
    """The rows so far, with where they are from."""
    result = {"benchmark": "unit_costs", "machine": machine(), "commit": commit(), "rows": rows}
    output.parent.mkdir(exist_ok=True)
    output.write_text(json.dumps(result, indent=1) + "\n")


def simulated(place: Path, kind: str, size: int, options: Any) -> Path:
    """The folder of two flights of a kind and size, made where it is not there.

    A process of its own makes it: the peak memory of a child counts what its parent had when it began it.
    """
    folder = place / f"{kind}{size}"
    if options.photos is not None and kind != "video":
        return copied(folder, options.photos, size, options.megapixels)
    if not folder.is_dir():
        place.mkdir(parents=True, exist_ok=True)
        subprocess.run(
            [
                sys.executable,
                __file__,
                "--seed",
                str(options.seed),
                "--megapixels",
                str(options.megapixels),
                "--simulate",
                str(folder),
                kind,
                str(size),
            ],
            check=True,
        )
    return folder


def copied(folder: Path, photos: Path, size: int, megapixels: float) -> Path:
    """Two flights of the first quarter (size 0) or half (1) of these photos, of so many megapixels; their folder.

    The second flight has the same photos in other light, encoded anew.
    """
    found = sorted(path for path in photos.iterdir() if path.suffix.lower() in (".jpg", ".jpeg"))
    for number, light in ((1, 1.0), (2, LATER_LIGHT)):
        flight = folder / f"flight{number}" / "photos"
        flight.mkdir(parents=True, exist_ok=True)
        for path in found[: max(2, len(found) // (4 if size == 0 else 2))]:
            copy_photo(path, flight / path.name, megapixels, light)
    return folder


def copy_photo(path: Path, copy: Path, megapixels: float, light: float) -> None:
    """A copy of so many megapixels, so much lighter; the file itself where it is that already."""
    with Image.open(path) as photo:
        scale = math.sqrt(megapixels * 1e6 / (photo.width * photo.height))
        if abs(scale - 1) < 0.02 and light == 1.0:
            shutil.copy(path, copy)
            return
        resized = photo.resize(
            (round(photo.width * scale), round(photo.height * scale)), Image.Resampling.BICUBIC
        )
        lit = ImageEnhance.Brightness(resized).enhance(light)
        lit.save(copy, quality=92, exif=photo.info["exif"], xmp=photo.info.get("xmp", b""))


def simulate(folder: Path, kind: str, size: int, seed: int, megapixels: float) -> None:
    """Two flights over a path of the small (0) or the large (1) size."""
    if kind == "video":
        imaging = ImagingSettings(1920, 1080, fps=FPS)
        path = PathSettings(30.0, SPEED_M_S, VIDEO_S[size] * SPEED_M_S, strips=1)
    else:
        width_px = 2 * round(math.sqrt(megapixels * 1e6 * 4 / 3) / 2)
        imaging = ImagingSettings(width_px, 2 * round(width_px * 3 / 8), fps=5.0)
        path = PathSettings(40.0, SPEED_M_S, 22.0, strips=PHOTO_STRIPS[size], strip_spacing_m=16.0)
    settings = SimulationSettings(
        seed=seed,
        scene=SceneSettings(people=4, cars=2, small_objects=3),
        path=path,
        imaging=imaging,
        later=LaterSettings(removed=1, moved=1),
        output=OutputSettings(photos=kind != "video", photo_overlap=0.7, truth_step=1_000_000),
    )
    for _ in simulate_site(folder, settings):
        pass


def unit_cost(job: Job, flights: Sequence[Path], work: Path, decode_s: float) -> dict[str, Any]:
    """The job on both sizes, and what a unit costs besides decoding its frames."""
    runs = [run(job, simulation, work) for simulation in flights]
    short, long = runs
    more = {
        name: long[name] - short[name] for name in ("units", "frames", "cpu_s", "bytes", "files")
    }
    decode_s = 0.0 if job == DECODE else decode_s
    cpu_s = (more["cpu_s"] - decode_s * more["frames"]) / more["units"]
    start_s = short["cpu_s"] - cpu_s * short["units"] - decode_s * short["frames"]
    return {
        "cpu_s": round(cpu_s, 4),
        "start_cpu_s": round(start_s, 2),
        "peak_mb": round(long["peak_mb"]),
        "bytes": round(more["bytes"] / more["units"]),
        "files": round(more["files"] / more["units"], 1),
        "runs": runs,
    }


def run(job: Job, simulation: Path, work: Path) -> dict[str, Any]:
    """One run of the job: frames that went in, units done, processor seconds, peak memory, bytes that came."""
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    places = {
        **{f"flight{number}": str(pictures(simulation, number)) for number in (1, 2)},
        "site": str(work / "site"),
        "mapped": str(work / "mapped"),
        "out": str(work / "out"),
    }
    stated = simulation / "camera.xml"
    camera = ("--camera", str(stated)) if stated.is_file() else ()
    if any("{mapped}" in each for each in job.arguments):
        kept = simulation / "mapped"
        if not kept.is_dir():
            run_python(
                [
                    "-m",
                    "sorvolo",
                    "map",
                    places["flight1"],
                    "--site",
                    str(kept),
                    "--model",
                    "none",
                    *camera,
                ]
            )
        shutil.copytree(kept, places["mapped"])
    number = 2 if any("{flight2}" in each for each in job.arguments) else 1
    grown = Path(job.grows.format(**places))
    before_bytes, before_files = below(grown)
    is_ours = job != DECODE
    takes_camera = is_ours and any("{flight" in each for each in job.arguments)
    arguments = [each if each == _DECODE else each.format(**places) for each in job.arguments]
    used = run_python(
        [*(("-m", "sorvolo") if is_ours else ()), *arguments, *(camera if takes_camera else ())]
    )
    frames = frames_of(simulation, number)
    size, files = below(grown)
    kept = {"bytes": size - before_bytes, "files": files - before_files}
    return {"frames": frames, "units": units_of(grown, number, frames), **used, **kept}


def units_of(grown: Path, number: int, frames: int) -> int:
    """Key frames or views of a site's newest flight, searched frames of a watch; else all frames."""
    report = grown / "report.json"
    if report.is_file():
        return int(json.loads(report.read_text())["frames"]["detected"])
    places = sorted((grown / "flights").glob("*/frames.*json")) if grown.is_dir() else []
    if not places or len(places) < number:
        return frames
    return len(json.loads(places[number - 1].read_text())["features"])


def pictures(simulation: Path, number: int) -> Path:
    """A flight's video, or its folder of photos."""
    folder = simulation / f"flight{number}"
    return folder / "photos" if (folder / "photos").is_dir() else folder / f"flight{number}.mp4"


def frames_of(simulation: Path, number: int) -> int:
    """How many frames or photos a flight has."""
    photos = simulation / f"flight{number}" / "photos"
    if photos.is_dir():
        return sum(path.suffix.lower() in (".jpg", ".jpeg") for path in photos.iterdir())
    features = json.loads((simulation / "truth" / "frames.geojson").read_text())["features"]
    return sum(each["properties"]["flight"] == f"flight{number}" for each in features)


def run_python(arguments: Sequence[str]) -> dict[str, float]:
    """Run a program to its end; its processor seconds and peak memory, MB. Exit codes 0 and 3 are results."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    child = subprocess.Popen(
        ["timeout", str(LIMIT_S), sys.executable, *arguments],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert child.stderr is not None
    errors = child.stderr.read()
    _, status, used = os.wait4(child.pid, 0)
    code = child.returncode = os.waitstatus_to_exitcode(status)
    if code not in (0, 3):
        raise SystemExit(
            f"{' '.join(arguments)} ended with {code}: {errors.strip().splitlines()[-1:]}"
        )
    return {"cpu_s": used.ru_utime + used.ru_stime, "peak_mb": used.ru_maxrss / 1024}


def below(folder: Path) -> tuple[int, int]:
    """The bytes and the number of all files below a folder."""
    sizes = (
        [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
        if folder.is_dir()
        else []
    )
    return sum(sizes), len(sizes)


def show(rows: dict[str, Any]) -> None:
    """The table."""
    table = Table(
        "mission", "CPU s a unit", "start, CPU s", "peak MB", "bytes a unit", "files a unit"
    )
    for name, row in rows.items():
        table.add_row(
            name, *(str(row[key]) for key in ("cpu_s", "start_cpu_s", "peak_mb", "bytes", "files"))
        )
    Console().print(table)


if __name__ == "__main__":
    main()

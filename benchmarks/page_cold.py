"""How soon the station's page can be used in a browser that never saw it, and what it loads and takes for that.

python benchmarks/page_cold.py SITE [--loads 5]

SITE is a site's folder, as `make demo` leaves one in demo-site/site. A station shows it over loopback; each load is a
Chromium of its own with an empty profile (headless, no GPU), 1280x720, that opens the site's map. Times run from the
address being opened until

- the page's frame stands: its rail of panels;
- the panel states the site's changes;
- the last tile of the mosaic that the view needs has come.

Bytes are what came over the wire until then and 3 s more. Processor time is that of all of the browser's processes, and
the station's, until the panel states the changes; the page's own tasks also of the 3 s after. The first load meets a
station that was just started. The load of the machine is written beside the figures: on a busy one run it with priority
(Linux: chrt --rr 1), or the figures are those of the other work.
"""

import argparse
import json
import os
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, sync_playwright

from provenance import commit, machine
from station import cpu_s, station

RESULTS = Path(__file__).parent / "results" / "page_cold.json"
_CHROMIUM = "/usr/bin/chromium"
_FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-sync",
    "--disable-background-networking",
    "--disable-component-update",
    "--mute-audio",
)
_MOST_MS = 60_000
_REST_S = 3.0
_WATCH = """
window.seen = {};
const look = () => {
  if (!seen.frame && document.querySelector("nav.rail")) seen.frame = performance.now();
  if (!seen.panel && document.querySelector("#panel")?.textContent.includes("Changes:")) seen.panel = performance.now();
  if (!seen.panel) requestAnimationFrame(look);
};
requestAnimationFrame(look);
"""


def main() -> None:
    """Load, note, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("site", type=Path)
    parser.add_argument("--loads", type=int, default=5)
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    before = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as scratch, sync_playwright() as playwright:
        shutil.copytree(options.site, Path(scratch) / "demo")
        with station(Path(scratch)) as (url, pid):
            loads = []
            for _ in range(options.loads):
                browser = playwright.chromium.launch(executable_path=_CHROMIUM, args=list(_FLAGS))
                loads.append(loaded(browser, url, pid))
                browser.close()
                print(json.dumps(loads[-1]), flush=True)
    result = {
        "benchmark": "page_cold",
        "machine": machine(),
        "commit": commit(),
        "load_before": round(before, 2),
        "load_after": round(os.getloadavg()[0], 2),
        "loads": loads,
    }
    options.output.write_text(json.dumps(result, indent=1) + "\n")


def loaded(browser: Browser, url: str, pid: int) -> dict[str, Any]:
    """One load in a new browser."""
    page = browser.new_context(viewport={"width": 1280, "height": 720}).new_page()
    sent = [0]
    cdp = page.context.new_cdp_session(page)
    cdp.send("Network.enable")
    cdp.send("Performance.enable")
    cdp.on(
        "Network.loadingFinished",
        lambda event: sent.__setitem__(0, sent[0] + event["encodedDataLength"]),
    )
    page.add_init_script(_WATCH)
    browser_before_s, station_before_s = tree_cpu_s(os.getpid()), cpu_s(pid)
    page.goto(f"{url}/#/site/demo/map")
    page.get_by_text("Changes:").first.wait_for(timeout=_MOST_MS)
    usable_cpu_s, station_usable_s = (
        tree_cpu_s(os.getpid()) - browser_before_s,
        cpu_s(pid) - station_before_s,
    )
    time.sleep(_REST_S)
    metrics = {
        each["name"]: each["value"] for each in cdp.send("Performance.getMetrics")["metrics"]
    }
    seen = page.evaluate("window.seen")
    tiles_ms = page.evaluate(
        "performance.getEntriesByType('resource').filter((e) => e.name.includes('/tiles/')).map((e) => e.responseEnd)"
    )
    return {
        "frame_s": round(seen["frame"] / 1000, 2),
        "panel_s": round(seen["panel"] / 1000, 2),
        "last_tile_s": round(max(tiles_ms) / 1000, 2),
        "tiles": len(tiles_ms),
        "browser_cpu_s": round(usable_cpu_s, 2),
        "station_cpu_s": round(station_usable_s, 2),
        "page_tasks_s": round(metrics["TaskDuration"], 2),
        "page_scripts_s": round(metrics["ScriptDuration"], 2),
        "mb": round(sent[0] / 1e6, 2),
        "load": round(os.getloadavg()[0], 1),
    }


def tree_cpu_s(pid: int) -> float:
    """The processor time of the Chromiums among a process's children and their children."""
    parents: dict[int, int] = {}
    names: dict[int, str] = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                head, _, rest = (folder / "stat").read_text().rpartition(")")
            except OSError:
                continue
            parents[int(folder.name)], names[int(folder.name)] = (
                int(rest.split()[1]),
                head.partition("(")[2],
            )
    total = 0.0
    for each, name in names.items():
        above = each
        while above in parents and above != pid:
            above = parents[above]
        if above == pid and "chrom" in name:
            try:
                total += cpu_s(each)
            except OSError:
                continue
    return total


if __name__ == "__main__":
    main()

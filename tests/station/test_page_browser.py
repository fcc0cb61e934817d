"""The page in a real Chromium before a real station: what a crew does with it, and what must never happen."""

import itertools
import json
import random
import re
import shutil
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from datetime import UTC, datetime, timedelta
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import unquote
from urllib.request import Request, urlopen
from xml.etree import ElementTree

import pytest

pytest.importorskip("fastapi", reason="the extra `station` is not installed")
pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

import av
import numpy as np
from browsers import WAIT_MS, Served, Watched, chromium, context_of
from fake_changes import fake_change
from fake_reports import fake_picture, fake_report
from live_sender import free_port, sending, udp_url
from PIL import Image
from playwright.sync_api import expect
from pyproj import Geod
from stream_flights import write_track, write_video
from test_changes_page import page_of
from test_stream_messages import units
from watch_runs import watch_run
from websockets.sync.client import ClientConnection, connect

import sorvolo
from faulty_link import FaultyLink
from sealing import write_again
from sorvolo.geometry.coordinates import Coordinates, place_text
from sorvolo.missions.site.review import review_changes
from sorvolo.station.events import NewEvent
from sorvolo.station.messages import Hello, Kind, Message, MessageSample
from sorvolo.station.runs import Run
from sorvolo.station.sites import site_summary
from sorvolo.station.tokens import make_token, revoke_token
from sorvolo.store.exports.change_files import crop_names
from sorvolo.store.images import jpeg_from_image, png_from_rgba
from sorvolo.store.pages.flight import report_page
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.files import HeightFile
from sorvolo.survey.findings import ChangeKind, Verdict
from waiting import wait_for

expect.set_options(timeout=WAIT_MS)
AXE = (Path(__file__).parent / "vendor" / "axe.min.js").read_text(encoding="utf-8")
BEYOND = """() => {
  const panel = document.querySelector('.panel'), edge = panel.getBoundingClientRect().right;
  return [...panel.querySelectorAll('button, select, input')].filter(each => !each.closest('.film, .timeline'))
    .filter(each => each.getBoundingClientRect().right > edge + 1).map(each => each.outerHTML.slice(0, 90));
}"""
MOST_BYTES = 800_000  # of the page, cold, as they are sent
TRANSFERRED = (
    "performance.getEntriesByType('resource').reduce((sum, each) => sum + each.transferSize, 0)"
)
KNOWN = "#sentence[data-loaded=yes]"  # all that is found is loaded
LANGUAGES = Path(sorvolo.__file__).parent / "station" / "page" / "languages"
PANELS = ("live", "findings", "compare", "layers", "measure", "place", "share")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as made:
        yield made


@pytest.fixture(scope="module")
def served(made_site: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    root = tmp_path_factory.mktemp("served")
    shutil.copytree(made_site, root / "field")
    crops = root / "field" / "flights" / "b" / "changes"
    crops.mkdir(exist_ok=True)
    for number in range(4):
        for name in crop_names(f"b-{number}"):
            picture = png_from_rgba(np.full((32, 32, 4), 90 + 20 * number, np.uint8))
            write_again(root / "field", f"flights/b/changes/{name}", picture)
    write_pod(root / "field")
    with Served(root) as station:
        yield station


def write_pod(site: Path) -> None:
    """A measured search over 0.001 degrees around the site: five sixths looked at, each better than the one before."""
    archive = Archive.open(site, write=False)
    west, south, east, north = site_summary("field", archive)["bounds_wgs84"]
    edges = np.linspace(west, east, 7)
    rows: list[dict[str, Any]] = [
        {"kind": "pod", "class": "person", "pod_from": 0.2 * k, "pod_to": 0.2 * k + 0.2}
        for k in range(5)
    ]
    rows.append({"kind": "hole", "class": "person", "reason": "not seen"})
    boxes = [
        [[low, south], [high, south], [high, north], [low, north], [low, south]]
        for low, high in itertools.pairwise(edges.tolist())
    ]
    features = [
        {
            "type": "Feature",
            "properties": row,
            "geometry": {"type": "Polygon", "coordinates": [box]},
        }
        for row, box in zip(rows, boxes, strict=True)
    ]
    (site / "search").mkdir(exist_ok=True)
    (site / "search" / "pod.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "features": features})
    )
    archive.close()


@pytest.fixture(scope="module")
def crew(browser: Any, served: Served) -> Iterator[Watched]:
    context = context_of(browser, accept_downloads=True)
    yield Watched(context, served.url)
    context.close()


@pytest.fixture
def opened(crew: Watched, served: Served) -> Iterator[Watched]:
    """The site's screen; nothing wrong may have been noted at the end."""
    crew.faults.clear()
    crew.page.goto(f"{served.url}/#/")
    crew.page.locator(".card").first.wait_for()
    crew.page.evaluate("document.getElementById('messages').replaceChildren()")
    show(crew, served)
    yield crew
    crew.page.unroute_all()
    assert crew.faults == []


@contextmanager
def greeted(served: Served, stream: str, session: str) -> Iterator[ClientConnection]:
    """A drone's connection to the station, which has answered its greeting."""
    with connect(f"{served.url.replace('http', 'ws')}/api/ingest/{stream}") as drone:
        hello = Hello(session, "h264", 160, 120, 10.0)
        drone.send(Message(Kind.HELLO, 0, 0, hello.to_json().encode()).to_bytes())
        drone.recv()
        yield drone
    # else the start page of the next test may begin to show it
    wait_for(
        lambda: stream not in [e["stream"] for e in served.ask("/api/streams") if e["is_connected"]]
    )


@contextmanager
def video_shown(
    served: Served, page: Any, folder: Path, session: str
) -> Iterator[tuple[ClientConnection, int]]:
    """A drone whose video, made in a folder, the page shows, and the time of its last picture, us."""
    messages = units(write_video(folder / "v.mp4"), "h264")
    pictures = [each for each in messages if each.kind is Kind.VIDEO]  # flown nobody knows where
    with greeted(served, "scout", session) as drone:
        for number, each in enumerate(pictures, 1):
            drone.send(replace(each, seq=number).to_bytes())
        page.locator("aside.video").wait_for()
        expect(page.locator(".delay")).to_have_text(re.compile("s delay"))
        yield drone, max(each.pts_us for each in pictures)


def show(watched: Watched, served: Served, panel: str = "live", url: str = "") -> None:
    """The site's screen with a panel; `url`: at another address than the station's own."""
    watched.page.goto(f"{url or served.url}/#/site/field/{panel}")
    watched.page.locator(KNOWN).wait_for()
    watched.page.locator(".maplibregl-canvas").first.wait_for()


def changes(served: Served) -> list[dict[str, Any]]:
    return served.ask("/api/sites/field/collections/changes/items")["features"]


def announce(served: Served, kind: str, data: dict[str, Any]) -> None:
    served.station.events.append(NewEvent(kind, data, "field", "run-1"))


def test_a_cold_page_is_small_and_lists_the_sites(browser: Any, served: Served) -> None:
    context = context_of(browser)
    watched = Watched(context, served.url)
    watched.page.goto(served.url)
    watched.page.locator(".card a").click()
    watched.page.get_by_text("4 changes").wait_for()
    assert watched.page.title() == "field – Sorvolo"
    assert 500_000 < watched.page.evaluate(TRANSFERRED) < MOST_BYTES
    assert watched.faults == []
    context.close()


def test_a_site_that_is_deleted_while_it_is_watched(
    browser: Any, made_site: Path, tmp_path: Path
) -> None:
    """The page goes back to the list, and states why."""
    shutil.copytree(made_site, tmp_path / "field")
    shutil.copytree(made_site, tmp_path / "other")
    with Served(tmp_path) as station:
        watched = Watched(context_of(browser), station.url)
        show(watched, station)
        shutil.rmtree(tmp_path / "field")
        watched.page.locator(".message.error", has_text="This site is gone").wait_for()
        expect(watched.page.locator(".card a")).to_have_count(1)
        assert "other" in watched.page.locator(".card a").get_attribute("href")
        half_deleted = "40[049]|410"  # a question that comes while the folder goes is refused
        assert [each for each in watched.faults if not re.search(half_deleted, each)] == []
        watched.page.context.close()


def test_a_site_is_deleted_once_its_name_is_typed(
    browser: Any, made_site: Path, tmp_path: Path
) -> None:
    """What would be lost is stated before; everybody who looks at it hears of it."""
    shutil.copytree(made_site, tmp_path / "field")
    shutil.copytree(made_site, tmp_path / "other")
    with Served(tmp_path) as station:
        watch_run(station.station, "fee1", "field")  # whose record goes with the site
        record = Run(
            "fee1",
            "watch",
            "field",
            "finished",
            "ada",
            "2026-05-01T10:00:00Z",
            "2026-05-01T10:01:00Z",
        )
        with station.station.state.changing() as connection:
            connection.execute("UPDATE runs SET record = ?", (json.dumps(asdict(record)),))
        looking, deleting = (Watched(context_of(browser), station.url) for _ in range(2))
        show(looking, station)
        page = deleting.page
        page.goto(station.url)
        page.get_by_label("More of field").click()
        page.get_by_role("button", name="Rename field").click()
        page.get_by_label("Name", exact=True).fill("Pré fleuri")
        page.get_by_role("dialog").get_by_role("button", name="Rename").click()
        page.get_by_role("heading", name="Pré fleuri").wait_for()
        expect(looking.page.locator("#title h1")).to_have_text("Pré fleuri")
        page.get_by_label("More of field").click()
        page.get_by_role("button", name="Delete field").click()
        box = page.get_by_role("dialog")
        expect(box).to_contain_text("2 flights, 2 versions of the map")
        expect(box).to_contain_text(re.compile(r"\d+ files, \d+(\.\d)? [kM]B"))
        name, button = (
            box.get_by_label("Type field to confirm"),
            box.get_by_role("button", name="Delete"),
        )
        name.fill("other")
        expect(button).to_be_disabled()
        box.get_by_role("button", name="Close").click()
        assert (tmp_path / "field").exists()
        page.get_by_role("button", name="Delete field").click()
        name.fill("field")
        button.click()
        expect(page.locator(".card")).to_have_count(1)
        looking.page.locator(".message.error", has_text="This site is gone").wait_for()
        expect(looking.page.locator(".card")).to_have_count(1)
        assert not (tmp_path / "field").exists() and (tmp_path / "other").exists()
        assert looking.faults == deleting.faults == []
        with Archive.open(tmp_path / "other", write=True):
            page.get_by_label("More of other").click()
            page.get_by_role("button", name="Delete other").click()
            page.locator(".message.error", has_text="another program writes the site").wait_for()
        assert page.get_by_role("dialog").count() == 0
        for each in (looking, deleting):
            each.page.context.close()


def test_an_empty_station_leads_to_a_first_flight(browser: Any, tmp_path: Path) -> None:
    with Served(tmp_path) as empty:
        watched = Watched(context_of(browser), empty.url)
        watched.page.goto(empty.url)
        wishes: list[Any] = []

        def take(route: Any) -> None:
            if route.request.method != "POST":
                return route.continue_()
            wishes.append(route.request.post_data_json)
            return route.fulfill(status=201, json={"id": "run-1"})

        watched.page.route(re.compile("/api/runs"), take)
        watched.page.get_by_role("button", name="Try the demo").click()
        watched.page.get_by_role("heading", name="Activity").wait_for()
        assert wishes == [{"mission": "demo", "site": "demo"}]
        watched.page.go_back()
        watched.page.get_by_label("Name of a new site").fill("Pré fleuri")
        watched.page.get_by_role("button", name="New site").click()
        watched.page.get_by_text("Start a mission").wait_for()
        assert unquote(watched.page.url).endswith("/site/Pré fleuri/live")
        assert watched.page.get_by_role("combobox", name="Mission").input_value() == "map"
        watched.page.context.close()


def test_changes_are_judged_with_the_keyboard_and_others_see_it(
    browser: Any, served: Served, opened: Watched
) -> None:
    other = Watched(context_of(browser), served.url)
    show(other, served, "findings")
    page = opened.page
    page.keyboard.press("2")
    first = page.locator(".strip [aria-current]").get_attribute("data-id")
    page.keyboard.press("n")
    page.keyboard.type("seen on foot")
    page.keyboard.press("Enter")
    page.locator(".gallery .remark", has_text="seen on foot").wait_for()
    page.keyboard.press("c")
    other.page.locator(f".strip button.confirmed[data-id='{first}']").wait_for()
    page.locator(f".strip [aria-current]:not([data-id='{first}'])").wait_for()  # the next one is up
    page.keyboard.press("k")
    page.keyboard.press("u")
    other.page.locator(f".strip button.open[data-id='{first}']").wait_for()
    kept = next(each["properties"] for each in changes(served) if each["id"] == first)
    assert (kept["review"], kept["note"], kept["revision"]) == ("none", "seen on foot", 3)
    assert other.faults == []
    other.page.context.close()


def test_keys_are_meant_for_what_is_shown_though_the_station_answers_late(
    browser: Any, served: Served
) -> None:
    """What is pressed and written after a verdict concerns the next change, also before the station has answered."""
    watched = Watched(context_of(browser), served.url)
    page = watched.page

    def late(route: Any) -> None:
        page.wait_for_timeout(300)
        route.continue_()

    page.route("**/reviews", late)
    show(watched, served, "findings")
    page.locator(".gallery h3").wait_for()
    first, second, third, *_ = page.locator(".strip button").evaluate_all(
        "all => all.map(each => each.dataset.id)"
    )
    before = {each["id"]: each["properties"].get("review") for each in changes(served)}
    with page.expect_response("**/reviews"):
        page.keyboard.press("c")
        assert page.locator(".strip [aria-current]").get_attribute("data-id") == second
        page.keyboard.press("n")
        page.keyboard.type(
            "rucksack", delay=40
        )  # its letters are keys that judge, withdraw, move on
    page.keyboard.press("Enter")
    page.locator(".gallery .remark", has_text="rucksack").wait_for()
    page.keyboard.press("r")
    page.keyboard.press("k")
    with (
        page.expect_response("**/reviews"),
        page.expect_response(lambda each: "none" in str(each.request.post_data)),
    ):
        page.keyboard.press("u")  # before the station has taken what it withdraws
    page.locator(f".strip button.open[data-id='{second}']").wait_for()
    kept = {each["id"]: each["properties"] for each in changes(served)}
    assert [kept[each].get("review") for each in (first, second)] == ["confirmed", "none"]
    assert kept[second]["note"] == "rucksack" and kept[third].get("review") == before[third]
    page.reload()
    page.locator(
        f".strip button.open[data-id='{second}']"
    ).wait_for()  # withdrawn: it is to be reviewed again
    assert watched.faults == []
    page.context.close()


def test_no_vote_is_lost_to_the_network_or_a_restart(browser: Any, served: Served) -> None:
    """Votes that are given while requests and answers get lost come to the station in their order."""
    page = context_of(browser).new_page()
    page.goto(served.url)
    page.locator(".card").wait_for()
    chance, faults = random.Random(7), []

    def lossy(route: Any) -> None:
        fault = chance.choice(["request", "answer", "busy", None])
        if fault == "answer":
            route.fetch()
        faults.append(fault)
        if fault in ("request", "answer"):
            route.abort()
        elif fault == "busy":
            route.fulfill(status=503, json={"title": "busy"})
        else:
            route.continue_()

    page.route("**/reviews", lossy)
    given = [str(number) for number in range(12)]
    ids = [each["id"] for each in changes(served)]
    for begun in range(0, len(given), 4):  # the page begins anew three times, others at work still
        page.evaluate(
            """async ([notes, ids, begun]) => {
          const {votes} = await import(`/page/votes.js?begun=${begun}`);
          votes.who = 'this machine';
          setInterval(() => dispatchEvent(new Event('online')), 10);
          for (const note of notes)
            votes.add({site: 'field', kind: 'change', id: ids[note % 2], verdict: ['confirmed', 'rejected'][note % 3 % 2], note});
        }""",
            [given[begun : begun + 4], ids, begun],
        )
    wait_for(lambda: page.evaluate("localStorage.getItem('sorvolo-votes')") == "[]", 120)
    notes = [each["note"] for each in served.ask("/api/sites/field/reviews?kind=change")][::-1]
    notes = [each for each in notes if each.isdigit()]
    assert [each for each, _ in itertools.groupby(notes)] == given
    assert len([each for each in faults if each]) > 15
    for each in ids[:2]:
        served.ask(
            "/api/sites/field/reviews",
            "POST",
            {"kind": "change", "id": each, "verdict": "none", "note": ""},
        )
    page.context.close()


SENTENCES = """async () => {
  const {sentence} = await import('/page/sentence.js');
  const found = new Set();
  let asked = 0;
  const person = (more) => ({properties: {class: 'person', ...more}});
  const pods = {none: [], ...Object.fromEntries(['person', 'car'].map((name) => [name, [{properties: {kind: 'pod', class: name, pod_from: 0.8, pod_to: 1},
    geometry: {type: 'Polygon', coordinates: [[[0, 0], [1e-3, 0], [1e-3, 1e-3], [0, 0]]]}}]]))};
  const peoples = {none: [], open: [person({})], rejected: [person({review: 'rejected'})], gone: [person({gone: true})],
    disputed: [person({review: 'disputed'})], confirmed: [person({review: 'confirmed'})], unsure: [person({review: 'unsure'})]};
  const runs = ['running', 'finished', 'incomplete', 'failed', 'stopped', 'lost'].flatMap((state) => ['map', 'compare', 'watch', 'search']
    .flatMap((mission) => [[{}, null], [{landed: true}, {model: 'default'}], [{}, {model: 'none'}], [{}, {model: 'boats'}], [{}, {model: 'thermal', classes: ['person']}],
      [{}, {classes: ['car']}]].map(([progress, options]) => ({state, mission, progress, options, input: {stream: 's'}, started_at: '2026-05-01T10:00:00Z'}))));
  const earlier = {state: 'finished', mission: 'watch', started_at: '2026-04-01T10:00:00Z', ended_at: '2026-04-01T10:09:00Z'};
  const histories = [[], ...runs.flatMap((each) => [[each], [each, earlier]])];
  const looks = ({options}) => !['none', 'boats'].includes(options?.model) && options?.classes?.[0] !== 'car';
  for (const link of ['live', 'late', 'waiting', 'lost']) for (const loaded of ['yes', 'no', 'failed']) for (const [pod, searched] of Object.entries(pods))
    for (const [people, objects] of Object.entries(peoples)) for (const each of histories) for (const drones of [[], ['s', 't']]) {
      const isLow = link === 'late', isFull = link === 'waiting', votes = link === 'lost' ? 2 : 0;
      const parts = sentence({link, loaded, runs: each, objects, changes: [], pod: searched, versions: [], drones, votes, isLow, isFull});
      asked += 1;
      found.add(JSON.stringify({link, loaded, pod, people, state: each[0]?.state ?? '', drones: drones.length, isMap: ['map', 'compare'].includes(each[0]?.mission), knows: Boolean(each[0] && looks(each[0])), text: parts.map(({words}) => words).join(' · '),
        looking: each.some((run) => run.state === 'running' && looks(run)),
        looked: pod === 'person' || each.some((run) => run.state === 'finished' && ['watch', 'search'].includes(run.mission) && looks(run))}));
    }
  return [asked, `[${[...found]}]`];
}"""


def test_the_sentence_is_in_no_state_a_wrong_all_clear(opened: Watched) -> None:
    """That no person was found is stated with what was looked at, never while it is not known, nor after a fault alone."""
    asked, different = opened.page.evaluate(SENTENCES)
    assert asked > 100_000
    for each in json.loads(different):
        text = each["text"]
        assert not re.search(r"all clear|nobody|no one|no people|empty|safe", text, re.IGNORECASE)
        assert ("may be old" in text) == (each["link"] != "live")
        disk = {"late": "nearly full", "waiting": "disk is full"}.get(each["link"], "")
        assert disk in text and ("disk" in text) == bool(disk)
        if each["loaded"] != "yes":
            assert "person" not in text and "looked" not in text
            continue
        assert ("1 person" in text) == (each["people"] != "none")
        assert ("rejected" in text) == (each["people"] == "rejected")
        assert ("earlier date" in text) == (each["people"] == "gone")
        if "no person found" in text:
            assert each["people"] == "none"
            assert each["looking" if "so far" in text else "looked"]
            assert "so far" in text or "in what was looked at" in text
        assert ("not measured" in text) == (each["pod"] != "person")
        isolated = each["state"] == "running" and not each["knows"]
        assert ("not searched for people" in text) == bool(each["drones"] or isolated)
        assert ("video of t" in text) == bool(
            each["drones"] and each["state"] == "running" and each["knows"]
        )
        if "before the newest flight" in text:
            assert (each["state"], each["isMap"], each["knows"]) == ("finished", True, False)
        assert bool(re.search("failed|incomplete|broke off|stopped", text)) == (
            each["state"] in ("failed", "incomplete", "lost", "stopped")
        )


def test_no_filter_version_or_role_hides_a_person_from_the_sentence(
    opened: Watched, served: Served
) -> None:
    """What a filter hides is named on the map and in Findings; ground of bad searches lowers the chance that is stated."""
    page = opened.page
    lon, lat = served.ask("/api/sites/field")["center_wgs84"]

    def with_person(route: Any) -> None:
        found = (answer := route.fetch()).json()
        own = {"class": "person", "score": 0.6, "flights": ["a", "b"], "first_seen": "2026-05-01"}
        place = {"type": "Point", "coordinates": [lon, lat]}
        person = {"type": "Feature", "id": "one", "geometry": place, "properties": own}
        route.fulfill(response=answer, json={**found, "features": [person]})

    page.route(re.compile("collections/findings"), with_person)
    away = [[lon + 1, lat], [lon + 2, lat], [lon + 2, lat + 1], [lon + 1, lat]]
    hiding = {
        "hidden": ["person"],
        "minScore": 0.9,
        "to": "2000-01-01",
        "from": "2100-01-01",
        "flight": "other",
        "verdict": "rejected",
        "area": away,
    }
    page.locator("#rooms [data-panel=findings]").click()
    keep = "each => sessionStorage.setItem('sorvolo-filters-field', each)"
    page.evaluate(keep, json.dumps(hiding))
    page.reload()
    page.locator(KNOWN).wait_for()
    assert "1 person" in page.locator("#sentence").inner_text()
    chips = page.locator(".chips button")
    expect(chips).to_have_count(len(hiding))
    for left in range(len(hiding), 0, -1):  # each by itself hides the person
        page.get_by_role("button", name=re.compile(r"Objects \(0\)")).click()
        page.get_by_text("the filter hides them all").wait_for()
        chips.first.click()
        expect(chips).to_have_count(left - 1)
    page.get_by_role("button", name="Objects (1)").wait_for()
    page.locator("#rooms [data-panel=compare]").click()
    page.locator(".timeline .mark").first.click()
    assert "1 person" in page.locator("#sentence").inner_text()

    def as_viewer(route: Any) -> None:
        answer = route.fetch()
        route.fulfill(response=answer, json={**answer.json(), "role": "view"})

    page.route(re.compile("/api/status"), as_viewer)
    page.reload()
    page.locator(KNOWN).wait_for()
    assert "1 person" in page.locator("#sentence").inner_text()
    told = page.evaluate("""async () => {
      const {lookedAt} = await import('/page/sentence.js');
      const ground = (more, west) => ({properties: {class: 'person', ...more}, geometry: {type: 'Polygon',
        coordinates: [[[west, 0], [west + 1e-3, 0], [west + 1e-3, 1e-3], [west, 1e-3], [west, 0]]]}});
      const pod = (low, west) => ground({kind: 'pod', pod_from: low, pod_to: low + 0.2}, west);
      const hole = (reason, west) => ground({kind: 'hole', reason}, west);
      return [[pod(0.8, 0)], [pod(0.8, 0), hole('not seen', 1e-3)], [pod(0.8, 0), pod(0, 1e-3), hole('too coarse', 1e-3)], [pod(0, 0), hole('under trees', 0)], [hole('not seen', 0)]]
        .map(lookedAt).map((each) => [each.share, each.from, each.to]);
    }""")
    assert np.allclose(told, [[1, 0.8, 1], [0.5, 0.4, 0.5], [1, 0.4, 0.6], [1, 0, 0.2], [0, 0, 0]])
    page.evaluate("sessionStorage.clear()")
    told = page.evaluate("""async () => {
      const {sentence} = await import('/page/sentence.js');
      const run = {state: 'running', mission: 'map', options: {model: 'none'}, input: {stream_url: 'rtsp://camera'}, started_at: '2026-05-01'};
      return sentence({link: 'live', loaded: 'yes', runs: [run], objects: [], changes: [], pod: [], versions: []}).map(({words}) => words);
    }""")
    assert "the video of rtsp://camera is not searched for people" in told


@pytest.mark.parametrize(("width", "height"), [(390, 844), (1280, 720)], ids=["phone", "laptop"])
def test_from_a_flying_drone_to_the_place_of_a_person_in_three_taps(
    browser: Any, served: Served, tmp_path: Path, width: int, height: int
) -> None:
    """The start page shows the drone; the map stays free of video and card; the place is handed on."""
    context = context_of(browser, viewport={"width": width, "height": height}, has_touch=True)
    context.grant_permissions(["clipboard-read", "clipboard-write", "geolocation"])
    watched = Watched(context, served.url)
    page = watched.page
    wishes: list[Any] = []

    def take(route: Any) -> None:
        if route.request.method != "POST":
            return route.continue_()
        wishes.append(route.request.post_data_json)
        return route.fulfill(status=201, json={"id": f"run-{len(wishes)}"})

    page.route(re.compile(r"/api/runs"), take)
    west, south, east, north = served.ask("/api/sites/field")["bounds_wgs84"]
    lon, lat = (west + east) / 2, (south + north) / 2
    messages = [
        each for each in units(write_video(tmp_path / "v.mp4"), "h264") if each.kind is Kind.VIDEO
    ]
    with greeted(served, "rescue", f"{width:016x}") as drone:
        flown = MessageSample(time.time_ns(), {"latitude_deg": lat, "longitude_deg": lon})
        drone.send(Message(Kind.TELEMETRY, 1, 0, flown.to_json().encode()).to_bytes())
        for number, each in enumerate(messages):
            drone.send(replace(each, seq=number + 2).to_bytes())
        began_s, taps = time.monotonic(), 0
        page.goto(served.url)
        drone_card = page.locator(".drone", has_text="over field")
        expect(drone_card.locator(".delay")).to_have_text(re.compile("s delay|no picture"))
        drone_card.get_by_role("button", name="Map and find people").tap()
        taps += 1
        page.locator(KNOWN).wait_for()
        assert [(each["mission"], each["site"], each["input"]) for each in wishes] == [
            ("compare", "field", {"stream": "rescue"}),
            ("watch", "field", {"stream": "rescue"}),
        ]
        place = {"type": "Point", "coordinates": [lon, lat]}
        person = {
            "type": "Feature",
            "id": 1,
            "geometry": place,
            "properties": {"id": 1, "class": "person", "score": 0.9, "sigma_m": 2.5},
        }
        for kind in ("object.found", "person.found"):
            data = {"feature": person, "is_local": False}
            served.station.events.append(NewEvent(kind, data, "field", "run-2"))
        expect(page.locator("#sentence .found")).to_contain_text("1 person")
        covers_nothing(page, ".panel")
        page.locator(".message.person").get_by_role("button", name="Show").tap()
        taps += 1
        expect(page.locator(".message")).to_have_count(0)  # what it asked for is done
        card = page.locator(".card-over")
        expect(card.locator("h3")).to_have_text("person")
        ground = page.locator(".map-canvas").bounding_box()
        assert apart(ground, page.locator("aside.video").bounding_box())
        box = card.bounding_box()
        if width == 390:  # the pin lies above, in the middle
            assert box["height"] <= 121 and box["y"] > ground["y"] + 0.6 * ground["height"]
        else:  # and here right of it
            assert box["x"] + box["width"] < ground["x"] + ground["width"] - 150
        card.get_by_role("button", name="Send place").tap()
        taps += 1
        card.get_by_text("Place copied").wait_for()
        sent = page.evaluate("navigator.clipboard.readText()")
        assert (taps, time.monotonic() - began_s < 60) == (3, True)
        for system in Coordinates:
            assert place_text(lat, lon, system) in sent
        assert (
            f"/#/site/field/place?at={lon:.7f},{lat:.7f} (on this computer alone)" in sent
            and "2.5 m (1 sigma)" in sent
        )
        announce(served, "person.found", {"feature": person, "is_local": False})
        page.locator(".message.person").wait_for()
        covers_nothing(page, ".card-over")
        drone.send(Message(Kind.END, 0, 0, b"").to_bytes())
    assert watched.faults == []
    context.close()


def covers_nothing(page: Any, below: str) -> None:
    """Messages lie over no control of the map, not over what lies below it, and not over its pin."""
    said = page.locator("#messages").bounding_box()
    for each in (".map-tools", ".maplibregl-ctrl-top-right", below, "#rooms", "#top"):
        assert apart(said, page.locator(each).bounding_box()), each
    assert said["y"] > page.locator(below).bounding_box()["y"]


def test_a_reload_in_the_field_shows_what_was_known_and_keeps_verdicts(
    browser: Any, served: Served
) -> None:
    """In Italian: the language is kept, too."""
    context = context_of(browser, keeps=True, locale="it-IT")
    with FaultyLink(served.port) as link:
        url = f"http://127.0.0.1:{link.port}"
        watched = Watched(context, url)
        page = watched.page
        show(watched, served, url=url)
        page.evaluate("navigator.serviceWorker.ready")
        page.reload(wait_until="commit")  # now by way of the worker, which keeps what comes
        page.locator(KNOWN).wait_for()
        page.wait_for_load_state("networkidle")
        page.locator("#rooms [data-panel=findings]").click()
        taken = page.locator(".strip button.open").last.get_attribute("data-id")
        page.locator(f".strip button[data-id='{taken}']").click()
        with page.expect_response(re.compile("collections/findings")):
            page.keyboard.press("c")
        page.wait_for_load_state("networkidle")
        link.cut()
        page.reload(wait_until="commit")
        page.locator(KNOWN).wait_for()
        expect(page.locator("#sentence")).to_contain_text("possono essere vecchi")
        mark = "fetch('/api/sites/field').then(each => each.headers.get('x-kept'))"
        assert page.evaluate(mark) == "1"
        page.locator("#rooms [data-panel=findings]").click()
        page.locator(f".strip button.confirmed[data-id='{taken}']").wait_for()
        chosen = page.locator(".strip [aria-current]").get_attribute("data-id")
        page.keyboard.press("c")
        expect(page.locator("#link-state")).to_contain_text("1 in attesa")
        page.reload(wait_until="commit")
        page.locator(f".strip button.confirmed[data-id='{chosen}']").wait_for()
        link.mend()
        page.evaluate("dispatchEvent(new Event('focus')), dispatchEvent(new Event('online'))")
        expect(page.locator("#link-state")).to_have_text("Connesso", timeout=60_000)
        votes = served.ask(f"/api/sites/field/reviews?kind=change&id={chosen}")
        assert votes[0]["verdict"] == "confirmed"
        context.close()


def test_what_hides_what_is_measured_and_what_is_wrong_is_said_where_it_is(
    served: Served, opened: Watched
) -> None:
    """Filters are chips, measures stay with their author, faults stand at their button, a route is one row."""
    page = opened.page
    assert "83 % of the ground looked at" in page.locator("#sentence").inner_text()
    assert "other object" not in page.locator("#sentence").inner_text()  # changes count once
    page.locator("#sentence button", has_text="83 %").click()
    expect(page.locator(".ramp li")).to_have_count(5)
    ground = page.locator(".map-canvas").bounding_box()
    page.mouse.click(ground["x"] + 0.45 * ground["width"], ground["y"] + 0.5 * ground["height"])
    seen = re.compile(r"A person here would have been seen with \d+ % to \d+ %\.")
    expect(page.locator(".chance")).to_have_text(seen)
    page.locator(".map-tools [data-panel=layers]").click()
    page.get_by_text("Filter", exact=True).click()
    page.get_by_label("Verdict").select_option("rejected")
    page.reload()
    page.locator(".chips button", has_text="Only rejected").click()
    page.get_by_text("Filter", exact=True).click()
    page.get_by_label("Verdict").select_option("confirmed")
    page.goto(f"{served.url}/#/")
    page.locator(".card a", has_text="field").first.click()
    page.locator(KNOWN).wait_for()
    expect(page.locator(".chips button")).to_have_count(0)
    page.locator("[data-panel=measure]").click()
    kept = len(served.ask("/api/sites/field/drawings")["features"])
    expect(page.locator(".drawn li")).to_have_count(kept)
    page.locator("[data-tool=distance]").click()
    box = page.locator(".map-canvas").bounding_box()
    page.mouse.click(box["x"] + 0.4 * box["width"], box["y"] + 0.5 * box["height"])
    page.wait_for_timeout(350)
    page.mouse.dblclick(box["x"] + 0.6 * box["width"], box["y"] + 0.5 * box["height"])
    expect(page.locator(".drawn li")).to_have_count(kept + 1)
    made = served.ask("/api/sites/field/drawings")["features"][-1]["properties"]
    assert (made["purpose"], made["by"]) == ("measure", "this machine")
    assert re.fullmatch(r"[\d.]+ m", made["name"])
    page.get_by_text("Re-fly gaps").click()
    page.get_by_role("button", name="Plan a route").click()
    page.locator(".route").wait_for()
    expect(page.locator(".drawn input")).to_have_count(kept + 1)  # points are no rows of their own
    page.locator("#rooms [data-panel=live]").click()
    page.get_by_text("Start a mission").click()
    page.get_by_role("button", name="Start", exact=True).click()
    expect(page.locator(".start").get_by_role("alert")).to_contain_text("Choose the files")
    page.locator(".start summary").click()
    page.get_by_label("Camera", exact=True).fill("Caméra")
    page.get_by_role("button", name="Start", exact=True).click()
    expect(page.locator(".start").get_by_role("alert")).to_contain_text("letters A to Z")
    assert not page.locator(".message.error").count()
    page.locator("#rooms [data-panel=findings]").click()
    shown = page.locator(".gallery .pictures img").first
    shown.wait_for()
    expect(shown).to_have_js_property("complete", True)
    assert shown.evaluate("each => each.clientWidth <= 4 * each.naturalWidth")


def test_a_find_is_shown_in_its_surroundings_and_in_the_video(
    served: Served, opened: Watched, tmp_path: Path
) -> None:
    """With its outline, a scale bar and north, large enough, of a change on both dates; views that look alike once."""
    page = opened.page
    change = changes(served)[0]
    frame = served.ask("/api/sites/field/collections/frames/items")["features"][1]
    after_s = int(datetime.fromisoformat(change["properties"]["first_seen"]).timestamp())
    views = [
        {
            "flight": flight,
            "time": datetime.fromtimestamp(after_s + second, UTC).isoformat(),
            "frame_id": frame["id"],
            "crop_url": change["properties"]["crops"][0],
            "video_s": 0.5,
            "video_url": "/flown.mp4",
            **{name: [] for name in ("changes", "objects", "reviews")},
        }
        for flight, second in [("a", -99), ("a", -98.8), ("a", -98.6), ("a", -90), ("b", 1)]
    ]
    page.route("**/field/place?*", lambda route: route.fulfill(json=views))
    flown = write_video(tmp_path / "flown.mp4").read_bytes()
    whole = {
        "content-range": f"bytes 0-{len(flown) - 1}/{len(flown)}",
        "content-type": "video/mp4",
    }
    page.route("**/flown.mp4", lambda route: route.fulfill(status=206, headers=whole, body=flown))
    page.locator("#rooms [data-panel=findings]").click()
    page.locator(".segments button", has_text="Changes").click()
    page.locator(f".strip [data-id='{change['id']}']").click()
    expect(page.locator(".film li")).to_have_count(3)
    page.get_by_role("button", name="10 m around").click()
    shown = page.locator(".ground")
    expect(shown).to_have_count(2)
    for figure in shown.all():
        expect(figure.locator("img")).to_have_js_property("complete", True)
        ground, outline = (figure.locator(each).bounding_box() for each in ("svg", "svg .outline"))
        side = min(ground["width"], ground["height"])
        assert side > 150
        for at, long in (("x", "width"), ("y", "height")):
            off = outline[at] + outline[long] / 2 - ground[at] - ground[long] / 2
            assert abs(off) < 0.02 * side < outline[long]
        assert figure.locator("text").all_text_contents() == ["2 m", "N"]
    page.keyboard.press("j")
    expect(shown).to_have_count(2)  # until it is pressed again
    page.locator("#rooms [data-panel=live]").click()
    lon, lat = np.mean(frame["geometry"]["coordinates"][0][:4], axis=0)
    page.goto(f"{served.url}/#/site/field/place?at={lon},{lat}")
    page.locator(".film .marked button").first.click()
    mark = page.locator(".picture .at")
    mark.wait_for()
    picture, ring = (each.bounding_box() for each in (page.locator(".picture video"), mark))
    for at, long in (("x", "width"), ("y", "height")):
        off = ring[at] + ring[long] / 2 - picture[at] - picture[long] / 2
        assert abs(off) < 0.05 * picture[long]
    page.locator(".picture video").evaluate("each => { each.currentTime = 0; }")
    expect(mark).to_be_hidden()  # the drone was elsewhere
    page.get_by_label("Close the video").click()


def test_a_searcher_s_phone_shows_where_it_is_and_no_engineering(
    browser: Any, served: Served
) -> None:
    """The place of the device in one tap, keys nowhere; a sheet that no slip folds away; memory and disk in Settings."""
    west, south, east, north = served.ask("/api/sites/field")["bounds_wgs84"]
    here = {"longitude": west + 0.3 * (east - west), "latitude": south + 0.7 * (north - south)}
    context = context_of(
        browser, viewport={"width": 390, "height": 844}, has_touch=True, geolocation=here
    )
    context.grant_permissions(["geolocation"])
    watched = Watched(context, served.url)
    page = watched.page
    show(watched, served)
    page.get_by_label("Where am I?").tap()
    dot = page.locator(".maplibregl-user-location-dot")
    dot.wait_for()
    spot = "() => { const box = document.querySelector('.maplibregl-user-location-dot').getBoundingClientRect(); return document.elementsFromPoint(box.x + box.width / 2, box.y + box.height / 2).some(each => each.closest('.map-canvas')) && box.y; }"
    wait_for(lambda: page.evaluate(spot))  # in view
    tab = page.locator("#rooms [data-panel=live]")
    tab.tap()
    tab.tap()
    page.keyboard.press("1")
    expect(page.get_by_role("heading", name="Activity")).to_be_visible()
    stops = []
    for _ in range(3):
        page.locator(".panel .handle").tap()
        stops.append(page.locator(".panel").get_attribute("data-stop"))
    assert sorted(stops) == ["full", "half", "peek"]
    page.locator("#rooms [data-panel=findings]").tap()
    page.locator(".confirm").wait_for()
    engineering = re.compile(r"memory|disk|\bMB\b|matched|by GPS|numpy|sharp")
    assert not engineering.search(page.locator("body").inner_text())
    assert not [each for each in page.locator("kbd").all() if each.is_visible()]
    page.locator("#settings-button").tap()
    expect(page.get_by_text("Keys", exact=True)).to_be_hidden()
    page.get_by_text("Diagnostics").tap()
    assert engineering.search(page.locator(".diagnostics").inner_text())
    assert watched.faults == []
    context.close()


def test_a_comparison_shows_the_same_on_both_sides_and_blinks_bare_ground(
    browser: Any, served: Served
) -> None:
    watched = Watched(context_of(browser, device_scale_factor=1), served.url)
    page = watched.page

    def left(route: Any) -> None:
        """By the search of both dates alone: no change tells it."""
        found = (answer := route.fetch()).json()
        own = {"class": "person", "gone": "b", "flights": ["a"], "untold": {"b": "disappeared"}}
        place = found["features"][0]["geometry"]
        gone = {"type": "Feature", "id": "left", "geometry": place, "properties": own}
        route.fulfill(response=answer, json={**found, "features": [*found["features"], gone]})

    page.route(re.compile("collections/findings"), left)
    show(watched, served)
    page.locator("#sentence button", has_text="5 changes").click()
    page.locator(".before-map .maplibregl-canvas").wait_for()
    expect(page.locator(".changes li")).to_have_count(5)
    alone = page.locator(".changes li", has_text="by the search, not by the pictures")
    expect(alone).to_contain_text("person disappeared")
    page.locator(".changes button").first.click()
    edge = page.get_by_label("Swipe between before and after")
    for split in ("100", "0"):  # before alone, after alone
        edge.fill(split)
        wait_for(lambda: outlined(page))
    page.keyboard.press("o")
    wait_for(lambda: not outlined(page))
    page.keyboard.press("o")
    wait_for(lambda: outlined(page))
    page.keyboard.press("b")
    wait_for(lambda: not outlined(page))
    assert watched.faults == []
    page.context.close()


def outlined(page: Any) -> bool:
    """Whether the map shows the outline of something that appeared."""
    shot = Image.open(BytesIO(page.locator(".stage").screenshot())).convert("RGB")
    away = np.abs(np.asarray(shot).astype(int) - (0x12, 0xB8, 0x86)).max(axis=2)
    return bool((away < 12).sum() > 40)


DATES = """async () => {
  const {SiteData} = await import('/page/site_data.js');
  const data = new SiteData({id: 'x', versions: [{n: 1, flight: 'a'}, {n: 2, flight: 'b'}]});
  data.all.objects = ['a', 'b'].map((flight) => ({id: flight, properties: {class: 'car', flights: [flight]}}));
  return [null, [1, 1], [1, 2]].map((versions) => {
    data.versions = versions;
    return data.shown('objects').map((each) => each.id);
  });
}"""


def test_an_earlier_version_shows_nothing_of_a_later_one(opened: Watched) -> None:
    assert opened.page.evaluate(DATES) == [["a", "b"], ["a"], ["a", "b"]]


def test_two_drones_have_a_pane_each(served: Served, opened: Watched) -> None:
    panes = opened.page.locator("aside.video header b")
    with greeted(served, "north", "1" * 16), greeted(served, "south", "2" * 16):
        expect(panes).to_have_count(2)
        assert sorted(panes.all_inner_texts()) == ["north", "south"]


def test_a_drone_that_does_not_say_where_it_is_any_more_is_not_on_the_map(
    served: Served, opened: Watched
) -> None:
    page = opened.page
    page.evaluate("""async () => {
      const {MapView} = await import('/page/map_view.js');
      const put = MapView.prototype.put;
      MapView.prototype.put = function (name, features) { window[`put_${name}`] = features.length; put.call(this, name, features); };
    }""")
    flown = MessageSample(time.time_ns(), {"latitude_deg": 46.5, "longitude_deg": 13.25})
    with greeted(served, "lost", "e" * 16) as drone:
        drone.send(Message(Kind.TELEMETRY, 1, 0, flown.to_json().encode()).to_bytes())
        wait_for(lambda: page.evaluate("window.put_drone === 1"))
        page.evaluate(
            "() => { const now = performance.now.bind(performance); performance.now = () => now() + 11000; }"
        )
        wait_for(lambda: page.evaluate("window.put_drone === 0"))
        drone.send(Message(Kind.END, 0, 0, b"").to_bytes())


def test_a_map_that_grows_out_of_view_is_followed(served: Served, opened: Watched) -> None:
    far = [13.4, 46.6, 13.401, 46.601]
    with opened.page.expect_request(re.compile("/tiles/live-fa12/")):
        announce(served, "map.tiles", {"revision": "fa12", "bounds": far})


def test_a_note_on_the_map_stays_under_the_hands(browser: Any, served: Served) -> None:
    """While it is written other people judge and missions announce things."""
    watched = Watched(context_of(browser), served.url)
    page = watched.page
    show(watched, served, "findings")
    page.locator(".gallery h3").wait_for()
    page.keyboard.press("m")
    note = page.locator(".card-over input")
    note.focus()
    page.keyboard.type("a red")
    announce(
        served,
        "object.found",
        {
            "feature": {
                "type": "Feature",
                "id": "o9",
                "properties": {"id": "o9", "class": "boat", "score": 0.9},
                "geometry": {"type": "Point", "coordinates": [0, 0]},
            }
        },
    )
    page.locator(".finds button", has_text="boat").wait_for()
    page.keyboard.type(" car")
    assert note.input_value().endswith("a red car")
    assert watched.faults == []
    page.context.close()


def test_a_change_and_an_object_are_tapped_on_the_map(browser: Any, served: Served) -> None:
    """Each at its place: the card with its facts opens, and the verdict given there is kept."""
    context = context_of(browser, viewport={"width": 1280, "height": 720})
    watched = Watched(context, served.url)
    page, card = watched.page, watched.page.locator(".card-over")
    show(watched, served, "findings")
    change = changes(served)[2]
    page.locator(f".strip button[data-id='{change['id']}']").click()
    page.keyboard.press("m")  # to its place, in the middle of what the card leaves of the map
    over, ground = card.bounding_box(), page.locator(".map-canvas").bounding_box()
    at = (over["x"] + over["width"] + ground["x"] + ground["width"]) / 2
    card.get_by_role("button", name="Close").click()
    tap_until(page, card, at)
    tapped = card.locator("dt", has_text=re.compile("^Id$")).locator("+ dd").inner_text()
    card.get_by_role("button", name="Confirm").click()
    card.locator(".verdict.confirmed").wait_for()
    # others lie there, too; it is shown at once, sent then
    wait_for(
        lambda: (
            [tapped, "confirmed"]
            in [[each["id"], each["properties"].get("review")] for each in changes(served)]
        )
    )
    card.get_by_role("button", name="Close").click()
    ring = np.array(change["geometry"]["coordinates"][0])
    announce(
        served,
        "object.found",
        {
            "feature": {
                "type": "Feature",
                "id": "o7",
                "properties": {"id": "o7", "class": "boat", "score": 0.9},
                "geometry": {
                    "type": "Point",
                    "coordinates": ((ring.min(axis=0) + ring.max(axis=0)) / 2).tolist(),
                },
            }
        },
    )
    tap_until(page, card.locator("h3", has_text=re.compile("boat", re.IGNORECASE)), at)
    assert watched.faults == []
    context.close()


def tap_until(page: Any, shown: Any, x: float) -> None:
    """Tap half-way up the map again and again, until what lies there is shown: the map has drawn it by then."""
    box = page.locator(".map-canvas").bounding_box()
    for _ in range(200):
        page.mouse.click(x, box["y"] + box["height"] / 2)
        page.wait_for_timeout(100)
        if shown.count():
            return
    raise AssertionError("nothing was shown")


def test_votes_that_differ_are_shown_as_disputed(browser: Any, served: Served) -> None:
    context = context_of(browser)
    watched = Watched(context, served.url)
    watched.page.route_web_socket(
        re.compile("/api/events"), lambda _: None
    )  # a page that hears nothing
    show(watched, served, "findings")
    watched.page.locator(".gallery h3").wait_for()
    chosen = watched.page.locator(".strip [aria-current]").get_attribute("data-id")
    review_changes(served.station.settings.root / "field", [chosen], Verdict.CONFIRMED, "my car")
    watched.page.keyboard.press("r")
    watched.page.locator(f".strip button.disputed[data-id='{chosen}']").wait_for()
    assert watched.faults == []
    context.close()


def test_before_and_after_are_swiped_and_blinked(opened: Watched) -> None:
    page = opened.page
    page.keyboard.press("3")
    page.locator(".before-map .maplibregl-canvas").wait_for()
    edge = page.get_by_label("Swipe between before and after")
    edge.fill("20")
    assert "80%" in page.locator(".before-map").evaluate("each => each.style.clipPath")
    box = page.locator(".swipe-edge").bounding_box()
    page.mouse.move(box["x"] + 17, box["y"] + 200)
    page.mouse.down()
    page.mouse.move(box["x"] + 217, box["y"] + 200)
    page.mouse.up()
    assert float(edge.input_value()) > 40
    page.get_by_role("button", name="Side by side").click()
    halves = [page.locator(each).bounding_box() for each in (".before-map", ".map-canvas")]
    assert apart(*halves) and halves[0]["width"] == pytest.approx(halves[1]["width"], abs=1)
    page.keyboard.press("b")
    for names in ("Before", "After"):
        page.locator(".swipe-names", has_text=names).wait_for()
    page.locator(".timeline .mark").first.click()
    assert page.get_by_role("combobox", name="After").input_value() == "1"
    page.get_by_text("0 changes").wait_for()
    page.keyboard.press("4")
    assert page.locator(".before-map").count() == 0
    fainter = page.get_by_label("Opacity: Map", exact=True)
    fainter.fill("0.5")
    page.reload()
    assert fainter.input_value() == "0.5"
    fainter.fill("1")
    follower = page.get_by_role("button", name="Follow the drone")
    before = follower.get_attribute("aria-pressed")
    page.locator(".map-tools").first.focus()
    page.keyboard.press("f")
    expect(follower).not_to_have_attribute("aria-pressed", str(before))
    page.keyboard.press("1")


def running(served: Served, page: Any, *runs: str) -> None:
    """The site's screen while missions run, which the station lists."""
    rows = [
        {
            "id": run,
            "mission": run.removeprefix("run-"),
            "state": "running",
            "started_at": datetime.now(UTC).isoformat(),
        }
        for run in runs
    ]
    page.route(re.compile(r"/api/runs\?"), lambda route: route.fulfill(json=rows))
    for run in runs:
        served.station.events.append(NewEvent("run.started", {"id": run}, "field", run))
    for run in runs:
        page.locator(".run.running", has_text=run.removeprefix("run-").capitalize()).wait_for()


def test_an_older_list_of_missions_that_comes_later_hides_none(
    served: Served, opened: Watched
) -> None:
    page = opened.page
    page.locator("#rooms [data-panel=live]").click()
    held: list[Any] = []
    page.route(re.compile(r"/api/runs\?"), lambda route: held.append(route))
    served.station.events.append(NewEvent("run.started", {"id": "run-x"}, "field", "run-x"))
    wait_for(lambda: page.wait_for_timeout(20) or held)
    running(served, page, "run-map")
    held[0].fulfill(json=[])
    page.wait_for_timeout(200)
    assert page.locator(".run.running").count() == 1


def test_older_drawings_that_come_later_hide_none(served: Served, opened: Watched) -> None:
    page, url, held = opened.page, "/api/sites/field/drawings", list[Any]()
    kept = served.ask(url)

    def is_listed() -> bool:
        fields = page.locator(".drawn input[aria-label=Name]")
        return "Camp 2" in fields.evaluate_all("them => them.map((each) => each.value)")

    page.locator("[data-panel=measure]").click()
    page.route(f"**{url}", lambda route: route.continue_() if held else held.append(route))
    served.station.events.append(NewEvent("drawings.changed", {}, "field", ""))
    wait_for(lambda: page.wait_for_timeout(20) or held)
    place = {"type": "Point", "coordinates": [13.2503, 46.5003]}
    camp = {"type": "Feature", "id": "camp", "geometry": place}
    camp["properties"] = {"purpose": "waypoint", "name": "Camp 2"}
    wish = {"revision": kept["revision"], "features": [*kept["features"], camp]}
    revision = served.ask(url, "PUT", wish)["revision"]
    wait_for(is_listed)
    with page.expect_event("requestfinished", lambda each: each == held[0].request):
        held[0].fulfill(json=kept)
    page.wait_for_timeout(300)
    assert is_listed()
    served.ask(url, "PUT", {"revision": revision, "features": kept["features"]})
    wait_for(lambda: not is_listed())


def test_a_flight_is_followed_live(served: Served, opened: Watched) -> None:
    page = opened.page
    lon, lat = changes(served)[0]["geometry"]["coordinates"][0][0]
    ring = [
        [lon - 1e-4, lat - 1e-4],
        [lon + 1e-4, lat - 1e-4],
        [lon + 1e-4, lat + 1e-4],
        [lon - 1e-4, lat - 1e-4],
    ]
    zone = {
        "type": "Feature",
        "id": "z",
        "geometry": {"type": "Polygon", "coordinates": [ring]},
        "properties": {"purpose": "alert", "name": "Camp"},
    }
    now = served.ask("/api/sites/field/drawings")["revision"]
    served.ask("/api/sites/field/drawings", "PUT", {"revision": now, "features": [zone]})
    page.locator("[data-panel=measure]").click()
    page.locator(".drawn input[aria-label=Name]").wait_for()
    page.locator("#rooms [data-panel=live]").click()
    running(served, page, "run-map")
    expect(page.locator("#sentence")).to_contain_text(re.compile(r"Mapping \d:\d\d"))
    figures = page.locator(".run .figures")

    def happens(kind: str, data: dict[str, Any]) -> None:
        served.station.events.append(NewEvent(kind, data, "field", "run-map"))

    def placed(time: str) -> None:
        place = {"position": [lon, lat], "height_m": 40, "heading_deg": 10, "footprint": ring}
        happens("frame.placed", {"status": "vision", "time": time, **place})

    placed("2024-05-01T10:00:00Z")
    delays = ((-86400, ""), (-3, r", 3[\d.]* s b"), (300, ""), (0.1, r", [01][\d.]* s b"))
    for seen, (seconds, words) in enumerate(
        delays, 1
    ):  # of the picture; ahead: the clocks are apart
        placed((datetime.now(UTC) + timedelta(seconds=seconds)).isoformat())
        happens("run.progress", {"frames": 9, "selected": 5 + seen, "matched": 3})
        expect(figures).to_have_text(
            re.compile(rf"^3 of {5 + seen} frames matched, {2 + seen} rejected{words}")
        )
        if not words:
            expect(figures).not_to_contain_text("behind")
    with page.expect_request(re.compile("/tiles/live-abc123/")):
        around = [lon - 1e-3, lat - 1e-3, lon + 1e-3, lat + 1e-3]
        announce(served, "map.tiles", {"revision": "abc123", "bounds": around})
    with page.expect_request(re.compile("/collections/coverage/items")):
        announce(served, "coverage.changed", {})
    hostile = "<img src=x onerror=window.pwned=1>"
    announce(
        served,
        "object.found",
        {
            "feature": {
                "type": "Feature",
                "id": "o1",
                "geometry": {"type": "Point", "coordinates": [lon + 5e-5, lat - 5e-5]},
                "properties": {"id": "o1", "class": hostile, "score": 0.9},
            }
        },
    )
    alert = page.locator(".message.alert", has_text="Camp")
    alert.wait_for()
    assert hostile in alert.inner_text()
    alert.get_by_role("button", name="Show").click()
    announce(
        served, "site.changed", {"versions": 2}
    )  # everything is loaded anew; what the watch found stays
    page.locator(".card-over h3", has_text="onerror").wait_for()
    page.wait_for_timeout(100)
    assert page.evaluate("window.pwned") is None
    happens("run.finished", {"headline": "all done"})
    done = page.locator(".message", has_text="to review").filter(has_text="all done")
    done.get_by_role("button", name="Findings").click()
    page.locator(".gallery h3").wait_for()


def test_the_api_can_be_read_as_a_page(served: Served, opened: Watched) -> None:
    page, paths = opened.page, served.ask("/openapi.json")["paths"]
    page.get_by_role("button", name="Settings").click()
    page.get_by_role("link", name="Addresses for programs").click()
    line = page.locator("summary", has_text="POST /api/runs").first
    line.click()
    page.locator("details[open] th", has_text="mission").first.wait_for()
    assert page.locator("summary").count() == sum(map(len, paths.values()))
    page.evaluate(AXE)
    assert serious(page) == []


def test_of_two_missions_at_once_the_map_s_figures_are_shown(
    served: Served, opened: Watched
) -> None:
    """A watch beside a map knows of no matched frames, and its end is not the map's."""
    page = opened.page

    def happens(run: str, kind: str, data: dict[str, Any]) -> None:
        served.station.events.append(NewEvent(kind, data, "field", run))

    running(served, page, "run-map", "run-watch")
    happens("run-map", "run.progress", {"frames": 9, "selected": 5, "matched": 3})
    happens("run-watch", "run.progress", {"frames": 8, "searched": 2, "latency_s": 1.2})
    mapping, watching = (
        page.locator(".run", has_text=name).locator(".figures") for name in ("Map", "Watch")
    )
    expect(mapping).to_have_text("3 of 5 frames matched, 2 rejected")
    expect(watching).to_have_text("")
    for number in (1, 2):
        person = {
            "type": "Feature",
            "id": number,
            "properties": {"id": number, "class": "person", "score": 0.9},
            "geometry": {"type": "Point", "coordinates": [12.5, 41.9]},
        }
        happens("run-watch", "person.found", {"feature": person, "is_local": False})
    expect(page.locator(".message.person")).to_have_count(1)
    expect(page.locator(".message.person")).to_contain_text("People seen 2 times, the last:")
    happens("run-watch", "run.finished", {"headline": "two cars found"})
    page.locator(".message", has_text="two cars found").wait_for()
    expect(mapping).to_have_text("3 of 5 frames matched, 2 rejected")


def test_a_full_browser_keeps_votes_as_long_as_the_page(opened: Watched) -> None:
    waiting = opened.page.evaluate("""async () => {
      const {votes} = await import('/page/votes.js?full');
      votes.send = () => {};
      const set = Storage.prototype.setItem;
      Storage.prototype.setItem = () => { throw new DOMException('full', 'QuotaExceededError'); };
      votes.add({site: 'field', kind: 'change', id: 'b-0', verdict: 'confirmed', note: ''});
      Storage.prototype.setItem = set;
      const closing = new Event('beforeunload', {cancelable: true});
      dispatchEvent(closing);
      return [votes.waiting.length, closing.defaultPrevented];
    }""")
    assert waiting == [1, True]


def test_what_is_drawn_without_the_station_waits_for_it(opened: Watched, served: Served) -> None:
    """A person that somebody saw is not lost: it stands on the map and in the list, also after a reload."""
    page = opened.page
    kept = served.ask("/api/sites/field/drawings")
    page.route("**/drawings", lambda route: route.abort())
    page.locator("[data-panel=measure]").click()
    page.locator("[data-tool=found]").click()
    box = page.locator(".map-canvas").bounding_box()
    page.mouse.click(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    waiting = page.locator(".drawn li", has_text="waits to be sent")
    expect(waiting).to_have_count(1)
    expect(page.locator("#link-state")).to_contain_text("1 waiting")
    page.reload()
    expect(waiting).to_have_count(1)
    drawn_s = time.time()
    page.wait_for_timeout(1500)
    page.unroute_all()
    page.reload()
    expect(page.locator("#link-state")).to_have_text("Connected")
    there = served.ask("/api/sites/field/drawings")
    (marked,) = [each for each in there["features"] if each not in kept["features"]]
    assert marked["properties"]["purpose"] == "found"
    assert datetime.fromisoformat(marked["properties"]["at"]).timestamp() < drawn_s
    expect(page.locator("#sentence")).to_contain_text("1 person")
    wish = {"revision": there["revision"], "features": kept["features"]}
    served.ask("/api/sites/field/drawings", "PUT", wish)
    opened.faults[:] = [each for each in opened.faults if "ERR_FAILED" not in each]


def test_what_waits_of_somebody_else_is_said_and_can_be_discarded(opened: Watched) -> None:
    """It is sent once that person is logged in; here nobody would know of it, for ever."""
    page = opened.page
    waiting = page.locator("#link-state")
    page.evaluate("""async () => {
      const {votes} = await import('/page/votes.js');
      const vote = {site: 'field', kind: 'change', id: 'b-1', verdict: 'confirmed', note: '', at: ''};
      votes.keep(['ada', 'bob', 'bob'].map((who, number) => ({...vote, who, number})));
    }""")
    waiting.get_by_role("button", name="3 waiting").click()
    box = page.get_by_role("dialog")
    expect(box.locator("li")).to_have_text(
        [re.compile("1 verdict.* by ada"), re.compile("2 .* by bob")]
    )
    box.get_by_role("button", name="Discard for good").last.click()
    expect(box.locator("li")).to_have_count(1)
    expect(waiting).to_contain_text("1 waiting")
    box.get_by_role("button", name="Discard for good").click()
    expect(box).to_have_count(0)
    expect(waiting).to_have_text("Connected")
    assert page.evaluate("localStorage.getItem('sorvolo-votes')") == "[]"


def test_a_vote_that_is_refused_is_said_on_every_screen(opened: Watched, served: Served) -> None:
    """Which one, and why: nothing else would tell whoever gave it while the station was away."""
    page = opened.page
    page.goto(f"{served.url}/#/")
    page.locator(".card").first.wait_for()
    page.evaluate("""async () => {
      const {votes} = await import('/page/votes.js');
      votes.add({site: 'field', kind: 'change', id: 'b-77', verdict: 'confirmed', note: ''});
    }""")
    expect(page.locator(".message.error")).to_contain_text("field, b-77: confirmed. ")
    assert page.evaluate("localStorage.getItem('sorvolo-votes')") == "[]"
    opened.faults[:] = [each for each in opened.faults if "404" not in each]


def test_what_the_browser_did_not_copy_is_not_called_copied(opened: Watched) -> None:
    """Else the place that was copied before would be sent."""
    page = opened.page
    page.evaluate("""() => {
      Object.defineProperty(navigator, 'clipboard', {value: undefined});
      document.execCommand = () => false;
    }""")
    page.locator("#rooms [data-panel=findings]").click()
    page.get_by_role("button", name="Send place").click()
    done = page.locator(".handover [role=status]")
    expect(done).to_contain_text("Not copied")
    expect(done.locator("pre")).to_contain_text("geo:46.4")
    assert "Place copied" not in page.locator("body").inner_text()


def test_times_are_the_station_s_and_days_those_that_are_shown(
    browser: Any, served: Served
) -> None:
    """The browser's clock is a day behind, and it is in New Zealand, where 20:00 UTC is the next day."""
    page = context_of(browser, timezone_id="Pacific/Auckland").new_page()
    page.add_init_script("const now = Date.now; Date.now = () => now() - 86400000;")
    page.goto(served.url)
    page.locator(".card").first.wait_for()
    now_ms, shown = page.evaluate("""async () => {
      const {now} = await import('/page/api.js');
      const {ALL, passing} = await import('/page/filters.js');
      const list = [{properties: {class: 'car', first_seen: '2026-05-01T20:00:00Z', last_seen: '2026-05-01T20:00:00Z'}}];
      const count = (more) => passing(list, {...ALL, ...more}).length;
      return [now(), [{from: '2026-05-02'}, {to: '2026-05-02'}, {from: '2026-05-03'}, {to: '2026-05-01'}].map(count)];
    }""")
    assert abs(now_ms / 1000 - time.time()) < 8
    assert shown == [1, 1, 0, 0]
    page.context.close()


@pytest.mark.parametrize("body", [None, "export const get = 1;"], ids=["missing", "older"])
def test_a_page_that_did_not_come_whole_is_loaded_again(
    browser: Any, served: Served, body: str | None
) -> None:
    """One file did not come, or is of another version than the rest: it does not stay at "Connecting" for ever."""
    page = context_of(browser).new_page()

    def spoil(route: Any) -> None:
        if body is None:
            route.abort()
        else:
            route.fulfill(content_type="text/javascript", body=body)

    page.clock.install()
    page.route("**/page/api.js", spoil)
    page.goto(served.url)
    page.get_by_text("did not come whole").wait_for()
    page.unroute_all()
    page.clock.fast_forward(6000)
    page.locator(".card").first.wait_for()
    page.context.close()


def test_what_could_not_be_loaded_or_was_kept_is_never_the_last_word(
    opened: Watched, served: Served
) -> None:
    page, sentence = opened.page, opened.page.locator("#sentence")
    findings = re.compile("collections/findings")

    def kept(route: Any) -> None:  # as the service worker marks what it kept
        answer = route.fetch()
        route.fulfill(response=answer, headers={**answer.headers, "x-kept": "1"})

    page.route(findings, kept)
    announce(served, "site.changed", {"versions": 2})
    expect(sentence).to_contain_text("answers late: this may be old")
    page.unroute_all()
    page.route(findings, lambda route: route.fulfill(status=503, json={"title": "busy"}))
    announce(served, "site.changed", {"versions": 2})
    expect(sentence).to_contain_text("could not be loaded")
    page.unroute_all()
    expect(sentence).to_contain_text("to review")  # it is tried again
    assert [each for each in opened.faults if "503" not in each] == []
    opened.faults.clear()


def test_people_found_before_there_is_a_map_are_there_after_a_reload(
    browser: Any, tmp_path: Path
) -> None:
    with Served(tmp_path) as station:
        watch_run(station.station, "run-1", "new")
        watched = Watched(context_of(browser), station.url)
        watched.page.goto(f"{station.url}/#/site/new/live")
        expect(watched.page.locator("#sentence")).to_contain_text("1 person")
        assert watched.faults == []
        watched.page.context.close()


def test_what_is_about_to_be_pressed_stays(opened: Watched, served: Served) -> None:
    """Progress comes four times a second, and other data: neither takes a button from under the finger."""
    page = opened.page
    running(served, page, "run-map")
    page.locator(".run.running").get_by_role("button", name="Stop").focus()
    for frames in (7, 8):
        announced = {"frames": frames, "selected": frames, "matched": 3}
        served.station.events.append(NewEvent("run.progress", announced, "field", "run-map"))
        expect(page.locator(".run .figures")).to_contain_text(f"3 of {frames} frames")
    assert page.evaluate("document.activeElement.innerText") == "Stop"
    page.locator("#rooms [data-panel=findings]").click()
    page.locator(".gallery .confirm").focus()
    with page.expect_response(re.compile("collections/coverage")):
        announce(served, "coverage.changed", {})
    page.wait_for_timeout(200)
    assert page.evaluate("document.activeElement.className") == "confirm"


def test_a_map_that_grows_is_not_called_missing(browser: Any, served: Served) -> None:
    page = context_of(browser).new_page()
    page.set_default_timeout(WAIT_MS)
    page.goto(f"{served.url}/#/site/fresh/live")
    page.locator("button[data-panel=layers]").click()
    page.locator(".panel", has_text="nothing mapped yet").wait_for()
    tiles = {"revision": "abc123", "bounds": [12.6, 41.89, 12.61, 41.9]}
    served.station.events.append(NewEvent("map.tiles", tiles, "fresh", "run-1"))
    page.locator(".panel", has_text="a first one is being mapped").wait_for()
    assert not page.get_by_text("This site has no map yet").count()
    page.context.close()


def test_a_link_to_a_site_shows_it_once_its_first_mission_made_it(
    browser: Any, made_site: Path, tmp_path: Path
) -> None:
    with Served(tmp_path) as station:
        page = context_of(browser).new_page()
        page.set_default_timeout(WAIT_MS)
        page.goto(f"{station.url}/#/site/field/findings")
        page.get_by_role("heading", name="There is no site field").wait_for()
        shutil.copytree(made_site, tmp_path / "field")
        page.locator(KNOWN).wait_for()
        page.context.close()


def test_tiles_of_a_site_whose_name_looks_like_a_growing_map(
    browser: Any, made_site: Path, tmp_path: Path
) -> None:
    shutil.copytree(made_site, tmp_path / "live-a1")
    with Served(tmp_path) as station:
        watched = Watched(context_of(browser), station.url)
        with watched.page.expect_response(re.compile("/api/sites/live-a1/tiles/live-")):
            watched.page.goto(f"{station.url}/#/site/live-a1/live")
        watched.page.locator(KNOWN).wait_for()
        with watched.page.expect_response(re.compile("/api/sites/live-a1/tiles/live-abc123/")):
            station.station.events.append(
                NewEvent("map.tiles", {"revision": "abc123", "bounds": None}, "live-a1", "r")
            )
        watched.page.wait_for_timeout(300)
        assert watched.faults == []
        watched.page.context.close()


def test_a_delay_does_not_depend_on_the_browser_s_clock(
    browser: Any, served: Served, tmp_path: Path
) -> None:
    """It is an hour ahead; the drone's and the station's agree."""
    watched = Watched(context_of(browser), served.url)
    watched.page.add_init_script("const now = Date.now; Date.now = () => now() + 3600000;")
    show(watched, served)
    messages = [
        each for each in units(write_video(tmp_path / "v.mp4"), "h264") if each.kind is Kind.VIDEO
    ]
    with greeted(served, "punctual", "f" * 16) as drone:
        now = MessageSample(
            time.time_ns() - 5_000_000_000, {"latitude_deg": 46.5, "longitude_deg": 13.25}
        )
        drone.send(Message(Kind.TELEMETRY, 1, 0, now.to_json().encode()).to_bytes())
        for number, each in enumerate(
            messages
        ):  # three seconds of them, taken five to two seconds ago
            drone.send(replace(each, seq=number + 2).to_bytes())
        expect(watched.page.locator("aside.video header b")).to_have_text("punctual")
        delay = watched.page.locator(".delay")
        expect(delay).to_have_text(re.compile(r"^\d+(\.\d+)? s delay"))
        watched.page.wait_for_timeout(1500)  # the station was asked for its clock
        for number, each in enumerate(messages):
            pts_us = each.pts_us + 3_000_000
            drone.send(replace(each, seq=number + 100, pts_us=pts_us, dts_us=pts_us).to_bytes())
        watched.page.wait_for_timeout(1500)
        assert 0 < float(delay.inner_text().split()[0]) < 60
        drone.send(Message(Kind.END, 0, 0, b"").to_bytes())
    assert watched.faults == []
    watched.page.context.close()


def test_a_video_whose_connection_died_in_sleep_is_asked_for_anew(
    browser: Any, served: Served, tmp_path: Path
) -> None:
    """The socket looks open, nothing comes: that is stated, and after some seconds another one is opened."""
    watched = Watched(context_of(browser), served.url)
    page = watched.page
    sockets: list[Any] = []
    died: list[bool] = []

    def passed_on(socket: Any) -> None:
        sockets.append(socket)
        server, is_first = socket.connect_to_server(), len(sockets) == 1
        server.on_message(lambda data: None if is_first and died else socket.send(data))

    page.route_web_socket(re.compile("/video"), passed_on)
    show(watched, served)
    sent = units(write_video(tmp_path / "v.mp4", seconds=4), "h264")
    messages = [each for each in sent if each.kind is Kind.VIDEO]
    with greeted(served, "asleep", "a1" * 8) as drone:
        for each in messages[:15]:
            drone.send(each.to_bytes())
        page.locator(".delay", has_text="s delay").wait_for()
        died.append(True)
        page.locator(".delay", has_text="no picture for").wait_for()
        for _ in range(300):
            if len(sockets) > 1:
                break
            page.wait_for_timeout(100)
        for each in messages[15:]:
            drone.send(each.to_bytes())
        page.locator(".delay", has_text="s delay").wait_for()
        drone.send(Message(Kind.END, 0, 0, b"").to_bytes())
        page.locator(".delay", has_text="ended").wait_for()
    assert watched.faults == []
    page.context.close()


def test_a_page_that_slept_asks_from_its_last_event_and_gets_each_once(
    browser: Any, served: Served
) -> None:
    context = context_of(browser)
    watched = Watched(context, served.url)
    sockets: list[Any] = []

    def passed_on(socket: Any) -> None:
        sockets.append(socket)
        socket.connect_to_server()

    watched.page.route_web_socket(re.compile("/api/events"), passed_on)
    show(watched, served)
    watched.page.locator("#link-state.live").wait_for()
    announce(served, "run.failed", {"error": "the lens is wet"})
    watched.page.locator(".message", has_text="the lens is wet").wait_for()
    last = served.station.events.last
    sockets[0].close()
    announce(served, "run.failed", {"error": "the battery is empty"})
    watched.page.locator(".message", has_text="the battery is empty").wait_for()
    watched.page.wait_for_timeout(300)
    assert watched.page.locator(".message", has_text="the battery is empty").count() == 1
    assert sockets[1].url.endswith(f"after={last}")
    assert watched.faults == []
    context.close()


def test_a_browser_that_slept_notices_its_dead_connection(browser: Any, served: Served) -> None:
    """A closed lid: ten minutes in which no timer runs and nothing comes, on a socket that nobody closed."""
    context = context_of(browser)
    watched = Watched(context, served.url)
    watched.page.clock.install()
    sockets: list[Any] = []
    is_dead = [False]

    def passed_on(socket: Any) -> None:
        sockets.append(socket)
        server, is_first = socket.connect_to_server(), len(sockets) == 1
        server.on_message(lambda message: None if is_first and is_dead[0] else socket.send(message))

    watched.page.route_web_socket(re.compile("/api/events"), passed_on)
    show(watched, served)
    watched.page.locator("#link-state.live").wait_for()
    announce(served, "run.failed", {"error": "the lens is wet"})
    watched.page.locator(".message", has_text="the lens is wet").wait_for()
    last = served.station.events.last
    is_dead[0] = True
    announce(served, "run.failed", {"error": "the battery is empty"})
    watched.page.wait_for_timeout(300)
    assert (
        watched.page.locator(".message", has_text="the battery is empty").count() == 0
        and len(sockets) == 1
    )
    watched.page.clock.fast_forward("10:00")
    watched.page.locator(".message", has_text="the battery is empty").wait_for()
    watched.page.locator("#link-state.live").wait_for()
    assert watched.page.locator(".message", has_text="the battery is empty").count() == 1
    assert len(sockets) == 2 and sockets[1].url.endswith(f"after={last}")
    assert watched.faults == []
    context.close()


@pytest.mark.long
def test_a_frozen_tab_catches_up_when_it_is_looked_at_again(browser: Any, served: Served) -> None:
    """As browsers freeze tabs in the background: its connection is gone; what happened meanwhile comes once each, and
    in order."""
    context = context_of(browser)
    with FaultyLink(served.port) as link:
        url = f"http://127.0.0.1:{link.port}"
        watched = Watched(context, url)
        show(watched, served, url=url)
        watched.page.locator("#link-state.live").wait_for()
        watched.page.wait_for_load_state("networkidle")
        watched.page.evaluate("""() => {
          window.heard = [];
          const note = (each) => each.addedNodes.forEach((node) => window.heard.push(node.textContent));
          new MutationObserver((all) => all.forEach(note))
            .observe(document.getElementById('messages'), { childList: true });
        }""")
        chrome = context.new_cdp_session(watched.page)
        chrome.send("Page.setWebLifecycleState", {"state": "frozen"})
        link.cut()
        for number in range(3):
            announce(served, "run.failed", {"error": f"fault {number}"})
        time.sleep(1.0)  # the length of its sleep
        link.mend()
        chrome.send("Page.setWebLifecycleState", {"state": "active"})
        watched.page.locator(".message", has_text="fault 2").wait_for()
        watched.page.locator("#link-state.live").wait_for()
        heard = [each for each in watched.page.evaluate("window.heard") if "fault" in each]
        assert [re.search(r"fault \d", each)[0] for each in heard] == [
            "fault 0",
            "fault 1",
            "fault 2",
        ]  # type: ignore[index]
        tried = "ERR_CONNECTION_REFUSED"  # by the part of the browser that does not sleep
        assert [each for each in watched.faults if tried not in each] == []
        context.close()


def test_a_page_that_lost_the_station_asks_at_once_when_it_is_looked_at(
    browser: Any, served: Served
) -> None:
    """It waits up to 15 s between two tries; nobody who comes back to it does."""
    context = context_of(browser)
    with FaultyLink(served.port) as link:
        url = f"http://127.0.0.1:{link.port}"
        watched = Watched(context, url)
        watched.page.clock.install()
        show(watched, served, url=url)
        watched.page.locator("#link-state.live").wait_for()
        watched.page.clock.pause_at(datetime.now(UTC) + timedelta(hours=1))
        link.cut()
        lost = watched.page.locator("#link-state.lost")
        for _ in range(40):
            watched.page.wait_for_timeout(
                100
            )  # of the test's own clock: for the answer to its last try
            if lost.count():
                break
            watched.page.clock.run_for(5_000)
        assert lost.count()
        announce(served, "run.failed", {"error": "out of reach"})
        link.mend()
        watched.page.wait_for_timeout(500)
        assert lost.count()  # its clock stands: it does not try by itself
        watched.page.clock.set_fixed_time(datetime.now(UTC) + timedelta(hours=3))
        watched.page.evaluate("dispatchEvent(new Event('focus'))")
        watched.page.locator("#link-state.live").wait_for()
        watched.page.locator(".message", has_text="out of reach").wait_for()
        context.close()


def test_recordings_are_listed_with_their_size_and_deleted(
    served: Served, opened: Watched, tmp_path: Path
) -> None:
    """Not without being asked again; a mission that is over, too."""
    page = opened.page
    folder = served.station.settings.root / "streams" / "old-flight"
    folder.mkdir(parents=True)
    (folder / "20260501T100000Z_aa.ts").write_bytes(bytes(2_500_000))
    watch_run(served.station, "feed", "field")
    record = Run(
        "feed", "watch", "field", "finished", "ada", "2026-05-01T10:00:00Z", "2026-05-01T10:01:00Z"
    )
    with served.station.state.changing() as connection:
        connection.execute(
            "UPDATE runs SET record = ? WHERE id = 'feed'", (json.dumps(asdict(record)),)
        )
    page.locator("#rooms [data-panel=compare]").click()
    page.locator("#rooms [data-panel=live]").click()
    page.get_by_text("Recordings and uploads of the station").click()
    row = page.locator(".files li", has_text="Stream old-flight")
    expect(row).to_contain_text("1 flight, 2.5 MB")
    row.get_by_role("button").click()
    page.get_by_role("dialog").get_by_role("button", name="Close").click()
    assert folder.exists()
    row.get_by_role("button").click()
    page.get_by_role("dialog").get_by_role("button", name="Delete").click()
    expect(row).to_have_count(0)
    assert not folder.exists()
    page.locator(".run.finished", has_text="ada").get_by_role("button", name="Delete").click()
    page.get_by_role("dialog").get_by_role("button", name="Delete").click()
    expect(page.locator(".run.finished", has_text="ada")).to_have_count(0)
    assert not (served.station.settings.state_folder / "runs" / "feed").exists()


def test_a_place_is_remembered(served: Served, opened: Watched) -> None:
    page = opened.page
    frame = served.ask("/api/sites/field/collections/frames/items")["features"][1]["geometry"][
        "coordinates"
    ][0]
    lon, lat = np.mean(frame[:4], axis=0)
    page.goto(f"{served.url}/#/site/field/place?at={lon},{lat}")  # a link that somebody sent
    page.locator(".film li").first.wait_for()
    page.get_by_text("in 2 flights").wait_for()
    box = page.locator(".map-canvas").bounding_box()
    before = page.locator(".place-name").inner_text()
    page.mouse.click(box["x"] + box["width"] / 2 + 30, box["y"] + box["height"] / 2)
    expect(page.locator(".place-name")).not_to_have_text(before)
    page.locator("#settings-button").click()
    page.get_by_label("Coordinates").select_option("mgrs")
    page.get_by_role("dialog").get_by_role("button", name="Close", exact=True).click()
    expect(page.locator(".place-name")).to_have_text(re.compile(r"^33T [A-Z]{2} \d{5} \d{5}$"))


def test_what_is_drawn_is_measured_and_shared(
    browser: Any, served: Served, opened: Watched
) -> None:
    page = opened.page
    page.locator("[data-panel=measure]").click()
    before = len(served.ask("/api/sites/field/drawings")["features"])
    expect(page.locator(".drawn li")).to_have_count(before)
    page.locator("[data-tool=interest]").click()
    box = page.locator(".map-canvas").bounding_box()
    for x, y in ((0.35, 0.35), (0.65, 0.35), (0.65, 0.65), (0.35, 0.65)):
        page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
        page.wait_for_timeout(350)  # two quick clicks would be a double click
    assert re.search(r"\d+(\.\d+)? m²", page.locator(".size").inner_text())
    page.keyboard.press("Enter")
    expect(page.locator(".drawn li")).to_have_count(before + 1)
    kept = served.ask("/api/sites/field/drawings")["features"]
    assert "interest" in {each["properties"]["purpose"] for each in kept}
    page.locator(".drawn").get_by_role("button", name="Filter").last.click()
    page.locator(".chips button", has_text="Only in the area of interest").click()
    expect(page.locator(".chips button")).to_have_count(0)
    other = Watched(context_of(browser), served.url)
    show(other, served, "measure")
    other.page.locator(".drawn li").first.wait_for()
    assert other.faults == []
    other.page.context.close()


def test_what_is_shown_can_be_taken_away(opened: Watched, served: Served, tmp_path: Path) -> None:
    page, url = opened.page, "/api/sites/field/drawings"
    kept = served.ask(url)
    mark = {"type": "Feature", "id": "seen", "properties": {"purpose": "found"}}
    mark["geometry"] = {"type": "Point", "coordinates": [13.2503, 46.5003]}
    wish = {"revision": kept["revision"], "features": [*kept["features"], mark]}
    revision = served.ask(url, "PUT", wish)["revision"]
    page.reload()
    page.locator("[data-panel=share]").click()
    page.locator(".files a[href$=gpkg]").wait_for()
    west = {"type": "Point", "coordinates": [-13.2503, 46.5003]}
    person = {"id": 1, "class": "person", "score": 0.9}
    found = {"type": "Feature", "id": 1, "properties": person, "geometry": west}
    announce(served, "object.found", {"feature": found})
    expect(page.locator("#sentence")).to_contain_text("2 people")
    taken = {}
    for name in ("GeoJSON", "CSV", "KMZ", "CalTopo", "TAK package"):
        with page.expect_download() as download:
            page.get_by_role("button", name=name).click()
        taken[name] = Path(shutil.copy(download.value.path(), tmp_path / name))
    features = json.loads(taken["GeoJSON"].read_text())["features"]
    served.ask(url, "PUT", {"revision": revision, "features": kept["features"]})
    marks = [each for each in features if each["geometry"]["coordinates"] == [13.2503, 46.5003]]
    assert [each["properties"]["class"] for each in marks] == ["person"]
    assert sum("kind" in each["properties"] for each in features) == 4
    rows = taken["CSV"].read_text().splitlines()
    assert rows[0].startswith("id,what,kind,class")
    assert sum(row.startswith("b-") for row in rows) == 4
    assert sum(",46.5003,-13.2503," in row for row in rows) == 1  # numbers, not a formula's text
    shutil.unpack_archive(taken["KMZ"], tmp_path / "kmz", "zip")
    places = check_kml(ElementTree.parse(tmp_path / "kmz" / "doc.kml").getroot())
    assert len(places) == len(features)
    marked = json.loads(taken["CalTopo"].read_text())["features"]
    assert [each["id"] for each in marked] == [each["id"] for each in features]
    assert {each["properties"]["class"] for each in marked} <= {"Marker", "Shape"}
    assert all(each["properties"]["title"] for each in marked)
    shutil.unpack_archive(taken["TAK package"], tmp_path / "tak", "zip")
    contents = ElementTree.parse(tmp_path / "tak/MANIFEST/manifest.xml").getroot().iter("Content")
    spots = [ElementTree.parse(tmp_path / "tak" / each.attrib["zipEntry"]) for each in contents]
    assert len(spots) == len(features)
    for each in spots:
        event, point = each.getroot(), each.getroot()[0]
        assert (event.get("version"), point.tag) == ("2.0", "point")
        assert datetime.fromisoformat(event.attrib["stale"]) > datetime.now(UTC)
        assert abs(float(point.attrib["lat"]) - 46.5) < 0.1 and float(point.attrib["ce"]) > 0


KML_ORDER = {  # of children, as the schema of KML 2.2 has them
    "kml": "Document",
    "Document": "name Placemark",
    "Placemark": "name description Style Point LineString Polygon MultiGeometry",
    "Style": "IconStyle LineStyle PolyStyle",
    **dict.fromkeys(("IconStyle", "LineStyle", "PolyStyle"), "color"),
    **dict.fromkeys(("Point", "LineString", "LinearRing"), "coordinates"),
    "Polygon": "outerBoundaryIs",
    "outerBoundaryIs": "LinearRing",
    "MultiGeometry": "Polygon",
}


def check_kml(root: ElementTree.Element) -> list[ElementTree.Element]:
    """The placemarks of a document whose elements are in the schema's namespace and order, with values of its types."""
    space = "{http://www.opengis.net/kml/2.2}"
    for each in root.iter():
        assert each.tag.startswith(space)
        name, text = each.tag.removeprefix(space), each.text or ""
        if name == "color":
            assert re.fullmatch("[0-9a-f]{8}", text)
        elif name == "coordinates":
            assert all(abs(float(n)) <= 180 for pair in text.split() for n in pair.split(","))
        elif name not in ("name", "description"):
            at = [KML_ORDER[name].split().index(child.tag.removeprefix(space)) for child in each]
            assert at == sorted(at) and at
        if name == "LinearRing":
            ring = (each[0].text or "").split()
            assert ring[0] == ring[-1] and len(ring) > 3
    return list(root.iter(f"{space}Placemark"))


def test_an_upload_goes_on_after_a_cut_and_starts_a_mission(
    opened: Watched, served: Served, tmp_path: Path
) -> None:
    page = opened.page
    video, track = (
        write_video(tmp_path / "f.mp4", seconds=1),
        write_track(tmp_path / "f.csv", seconds=1),
    )
    cuts = []

    def cut(route: Any) -> None:  # a piece, and the first two questions of how much came
        if route.request.method == ["PATCH", "HEAD", "HEAD", ""][len(cuts)]:
            cuts.append(route.request.url)
            route.abort()
        else:
            route.continue_()

    wishes = []

    def take(route: Any) -> None:
        if route.request.method != "POST":
            return route.continue_()
        wishes.append(route.request.post_data_json)
        return route.fulfill(status=201, content_type="application/json", body='{"id": "r"}')

    page.route(re.compile(r"/api/uploads/\w+$"), cut)
    page.route(re.compile(r"/api/runs"), take)
    page.get_by_text("Start a mission").click()
    page.get_by_label("Files of the flight").first.set_input_files([str(video), str(track)])
    page.get_by_role("button", name="Start").click()
    page.locator(".message", has_text="started").wait_for()
    (wish,) = wishes
    assert (wish["mission"], wish["site"]) == ("compare", "field")
    states = {each["id"]: (each["name"], each["state"]) for each in served.ask("/api/uploads")}
    assert states[wish["input"]["upload"]] == ("f.mp4", "ready")
    assert states[wish["options"]["telemetry"]["upload"]] == ("f.csv", "ready")
    assert len(cuts) == 3
    opened.faults[:] = [
        each for each in opened.faults if "ERR_FAILED" not in each
    ]  # the cut itself


def test_a_cut_video_is_named_as_it_goes_up(opened: Watched, tmp_path: Path) -> None:
    page, whole, head_first = (
        opened.page,
        write_video(tmp_path / "whole.mp4", seconds=1),
        {"movflags": "faststart"},
    )
    with (
        av.open(str(whole)) as read,
        av.open(str(tmp_path / "f.mp4"), "w", options=head_first) as written,
    ):
        stream = written.add_stream_from_template(read.streams.video[0])
        for packet in read.demux(video=0):
            if packet.size:
                packet.stream = stream
                written.mux(packet)
    data = (tmp_path / "f.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[:-2000])
    page.route(
        re.compile(r"/api/runs"),
        lambda route: (
            route.fulfill(status=201, content_type="application/json", body='{"id": "r"}')
            if route.request.method == "POST"
            else route.continue_()
        ),
    )
    page.get_by_text("Start a mission").click()
    page.get_by_label("Files of the flight").first.set_input_files([str(tmp_path / "cut.mp4")])
    page.get_by_role("button", name="Start").click()
    page.locator(
        ".message.warning", has_text="cut.mp4 is cut: its last 2 kB are missing"
    ).wait_for()


def test_the_drone_s_video_is_shown_with_boxes(
    served: Served, opened: Watched, tmp_path: Path
) -> None:
    page = opened.page
    with video_shown(served, page, tmp_path, "a" * 16) as (drone, last_us):
        grey = page.locator("aside.video canvas").first.evaluate(
            "each => Math.min(...each.getContext('2d').getImageData(5, 5, 1, 1).data)"
        )
        assert grey > 30  # a picture of the flight, not an empty canvas
        ingest = served.station.ingest
        ingest._loop.call_soon_threadsafe(
            ingest.hub("scout").note,
            {
                "type": "boxes",
                "pts_us": last_us,
                "frame_size_px": [160, 120],
                "boxes": [
                    {"class": "person", "score": 0.8, "xywh_px": [40, top, 20, 30]}
                    for top in (40, 0)
                ],
            },
        )
        page.locator("aside.video footer", has_text="2 detections").wait_for()
        assert columns_drawn(page)[0] == pytest.approx(39, abs=2)
        assert page.locator("aside.video canvas.boxes").evaluate(
            "each => each.getContext('2d').getImageData(43, 5, 1, 1).data[3]"
        )  # the label of a box at the upper edge is in the picture
        drone.send(Message(Kind.END, 0, 0, b"").to_bytes())
    page.locator(".delay", has_text="ended").wait_for()


def test_a_damaged_picture_does_not_end_the_video(opened: Watched) -> None:
    state = opened.page.evaluate("""async () => {
      const {FramePlayer} = await import('/page/video.js');
      const player = new FramePlayer(document.createElement('canvas'), () => {}, () => 0);
      player.begin({codec: 'avc1.42001f', width: 160, height: 120});
      const first = player.decoder;
      player.take(new Uint8Array([0, 0, 0, 1, 0x65, 1, 2, 3, 4, 5, 6, 7]), 0);
      for (let k = 0; k < 100 && first.state !== 'closed'; k++) await new Promise((done) => setTimeout(done, 50));
      await new Promise((done) => setTimeout(done, 50));
      return [first.state, player.decoder.state];
    }""")
    assert state == ["closed", "configured"]


def test_the_drone_s_video_lies_beside_the_map_and_what_is_reviewed(
    served: Served, opened: Watched, tmp_path: Path
) -> None:
    """It covers neither; on a phone it lies above the map, and gives way to the review."""
    page = opened.page
    with video_shown(served, page, tmp_path, "a1b2" * 4) as (drone, _):
        page.get_by_label("Larger or smaller").click()
        for width_px in (1280, 900, 390):
            page.set_viewport_size({"width": width_px, "height": 844})
            page.locator("#rooms [data-panel=live]").click()
            ground, pane = (
                page.locator(each).bounding_box() for each in (".map-canvas", "aside.video")
            )
            assert apart(ground, pane)
            page.locator("#rooms [data-panel=findings]").click()
            gallery, pane = (
                page.locator(each).bounding_box() for each in (".gallery", "aside.video")
            )
            assert (pane is None) == (width_px < 760)
            assert pane is None or apart(gallery, pane)
        drone.send(Message(Kind.END, 0, 0, b"").to_bytes())
    page.set_viewport_size({"width": 900, "height": 600})


def test_a_phone_s_map_is_shown_whole_behind_a_video(
    browser: Any, served: Served, tmp_path: Path
) -> None:
    """The video takes room from the map, which is fitted into what is left, until somebody moves it."""
    context = context_of(browser, viewport={"width": 390, "height": 844})
    watched = Watched(context, served.url)
    page = watched.page
    west, south, east, north = served.ask("/api/sites/field")["bounds_wgs84"]
    west, east = west + 0.45 * (east - west), east - 0.45 * (east - west)  # a tall site

    def narrow(route: Any) -> None:
        answer = route.fetch()
        wanted = {**answer.json(), "bounds_wgs84": [west, south, east, north]}
        route.fulfill(response=answer, json=wanted)

    page.route(f"{served.url}/api/sites/field", narrow)
    show(watched, served)
    page.evaluate("""async () => {
      const {VideoWall} = await import('/page/video.js');
      const fit = VideoWall.prototype.fit;
      VideoWall.prototype.fit = function () { window.view = this.screen.view; fit.call(this); };
    }""")
    whole_px = page.locator(".map-canvas").bounding_box()["height"]
    with video_shown(served, page, tmp_path, "c3d4" * 4) as (drone, _):
        seen_px = page.locator(".map-canvas").bounding_box()["height"]
        assert seen_px < whole_px - 100
        corners = page.evaluate(
            "places => places.map((each) => { const {x, y} = window.view.map.project(each); return [x, y]; })",
            [[west, north], [east, south]],
        )
        free_px = seen_px - page.evaluate("window.view.covered().low")
        (left, top), (right, bottom) = corners
        assert 0 <= left < right <= 390 and 0 <= top < bottom <= free_px
        drone.send(Message(Kind.END, 0, 0, b"").to_bytes())
    assert watched.faults == []
    context.close()


def apart(one: dict[str, float], other: dict[str, float]) -> bool:
    """Whether two boxes on the screen share nothing."""
    return any(
        one[low] + one[size] <= other[low] + 0.5 or other[low] + other[size] <= one[low] + 0.5
        for low, size in (("x", "width"), ("y", "height"))
    )


SLOW_DECODER = """window.VideoDecoder = class {  // five pictures a second, as a weak tablet has it
  constructor({output}) { this.output = output; this.waiting = []; setInterval(() => this.next(), 200); }
  get decodeQueueSize() { return this.waiting.length; }
  configure() { this.state = 'configured'; }
  decode({timestamp}) { this.waiting.push(timestamp); }
  reset() { this.waiting = []; this.state = 'unconfigured'; }
  close() { this.reset(); this.state = 'closed'; }
  next() {
    if (!this.waiting.length) return;
    window.newestShown = this.waiting.shift();
    const canvas = new OffscreenCanvas(160, 120);
    canvas.getContext('2d');
    this.output(new VideoFrame(canvas, {timestamp: window.newestShown}));
  }
};"""


@pytest.mark.long
def test_a_slow_device_stays_near_live(browser: Any, served: Served, tmp_path: Path) -> None:
    """It goes on at the next key frame; it fell further and further behind."""
    watched = Watched(context_of(browser), served.url)
    watched.page.add_init_script(SLOW_DECODER)
    messages = units(write_video(tmp_path / "v.mp4", seconds=12), "h264")
    with greeted(served, "weak", "b" * 16) as drone:
        drone.send(messages[0].to_bytes())
        show(watched, served)
        wait_for(lambda: watched.page.evaluate("window.newestShown") is not None)
        for each in messages[1:]:
            drone.send(each.to_bytes())
        last_us = max(each.pts_us for each in messages if each.kind is Kind.VIDEO)
        wait_for(
            lambda: watched.page.evaluate("window.newestShown") >= last_us, 12
        )  # all would take 24 s
        drone.send(Message(Kind.END, 0, 0, b"").to_bytes())
    assert watched.faults == []
    watched.page.context.close()


def columns_drawn(page: Any) -> tuple[int, int]:
    """The first and last column of the overlay in which something is drawn, below the boxes' labels."""
    first, last = page.locator("aside.video canvas.boxes").evaluate("""each => {
      const copy = new OffscreenCanvas(each.width, each.height).getContext('2d', {willReadFrequently: true});
      copy.drawImage(each, 0, 0);
      const {data} = copy.getImageData(0, 50, each.width, 15);
      const columns = [...Array(data.length / 4).keys()].filter(n => data[4 * n + 3] > 60).map(n => n % each.width);
      return [Math.min(...columns), Math.max(...columns)];
    }""")
    return first, last


def test_boxes_follow_the_picture_until_it_is_looked_at_again(
    served: Served, opened: Watched, tmp_path: Path
) -> None:
    page = opened.page
    with video_shown(served, page, tmp_path, "c" * 16) as (drone, last_us):
        note, loop = served.station.ingest.hub("scout").note, served.station.ingest._loop
        boxes = {
            "type": "boxes",
            "pts_us": last_us - 1_000_000,
            "frame_size_px": [160, 120],
            "boxes": [{"class": "person", "score": 0.8, "xywh_px": [40, 40, 20, 30]}],
        }
        loop.call_soon_threadsafe(note, boxes)
        page.locator("aside.video footer", has_text="1 detection, faint: seen 1 s ago").wait_for()
        assert columns_drawn(page) == pytest.approx((39, 61), abs=2)
        for number in range(9):  # 5 px a step; the last 0.1 s are not known yet
            from_us = last_us - 1_000_000 + 100_000 * number
            loop.call_soon_threadsafe(
                note,
                {
                    "type": "motion",
                    "from_us": from_us,
                    "pts_us": from_us + 100_000,
                    "to_from": [1, 0, 5, 0, 1, 0, 0, 0, 1],
                },
            )
        loop.call_soon_threadsafe(note, boxes)
        page.locator("aside.video footer", has_text="1 detection, dashed: seen 1 s ago").wait_for()
        assert columns_drawn(page) == pytest.approx((89, 111), abs=2)
        drone.send(Message(Kind.END, 0, 0, b"").to_bytes())


def test_boxes_of_cars_that_are_known_before_people_take_the_place_of_earlier_cars_alone(
    served: Served, opened: Watched, tmp_path: Path
) -> None:
    page = opened.page
    with video_shown(served, page, tmp_path, "e" * 16) as (drone, last_us):
        note, loop = served.station.ingest.hub("scout").note, served.station.ingest._loop

        def look(before_us: int, boxes: dict[str, int], **classes: list[str]) -> None:
            loop.call_soon_threadsafe(
                note,
                {
                    "type": "boxes",
                    "pts_us": last_us - before_us,
                    "frame_size_px": [160, 120],
                    **classes,
                    "boxes": [
                        {"class": name, "score": 0.8, "xywh_px": [x, 40, 10, 30]}
                        for name, x in boxes.items()
                    ],
                },
            )

        look(1_000_000, {"person": 40, "car": 140})
        page.locator("aside.video footer", has_text="2 detections, faint: seen 1 s ago").wait_for()
        assert columns_drawn(page) == pytest.approx((39, 151), abs=2)
        look(
            0, {"car": 120}, classes=["car"]
        )  # not searched for people yet: the earlier one stays, with its age
        wait_for(lambda: columns_drawn(page) == pytest.approx((39, 131), abs=2))
        expect(page.locator("aside.video footer")).to_contain_text(
            "2 detections, faint: seen 1 s ago"
        )
        look(0, {"person": 60, "car": 120})
        wait_for(lambda: columns_drawn(page) == pytest.approx((59, 131), abs=2))
        expect(page.locator("aside.video footer")).to_contain_text(re.compile("2 detections$"))
        drone.send(Message(Kind.END, 0, 0, b"").to_bytes())


def test_how_far_the_picture_moved_between_two_of_its_times(
    served: Served, opened: Watched
) -> None:
    ways = opened.page.evaluate("""async () => {
      const {PictureMotion} = await import('/page/picture_motion.js');
      const motion = new PictureMotion();
      const step = (from_us, pts_us, x, scale = 1) => motion.take({
        from_us, pts_us, to_from: [scale, 0, x, 0, scale, 0, 0, 0, 1],
      });
      const look = (pts_us, x) => ({
        pts_us, frame_size_px: [100, 100], boxes: [{class: 'car', xywh_px: [x, 40, 10, 20]}],
      });
      const carried = (...asked) => motion.carried(...asked)?.map(({xywh_px}) => xywh_px) ?? null;
      const unknown = carried(look(0, 10), 100000);
      step(100000, 200000, 10); step(200000, 300000, 20); step(500000, 600000, 0, 1.5);
      return {
        unknown,
        chain: carried(look(100000, 10), 300000), part: carried(look(150000, 10), 250000),
        back: carried(look(300000, 40), 100000),
        gap: carried(look(100000, 10), 600000), grown: carried(look(500000, 10), 600000),
        gone: carried(look(200000, 90), 300000), far: carried(look(500000, 1), 1900000),
        anew: (step(0, 100000, 7), carried(look(0, 10), 100000)), ahead: carried(look(100000, 10), 300000),
      };
    }""")
    assert {
        name: way and [[round(each, 3) for each in box] for box in way]
        for name, way in ways.items()
    } == {
        "unknown": None,
        "chain": [[40, 40, 10, 20]],
        "part": [[25, 40, 10, 20]],
        "back": [[10, 40, 10, 20]],
        "gap": None,
        "grown": [[15, 60, 15, 30]],
        "gone": [],
        "far": None,
        # the stream began anew: the old steps are gone, and its last one goes on for a while
        "anew": [[17, 40, 10, 20]],
        "ahead": [[24, 40, 10, 20]],
    }


def test_a_search_is_of_the_site_s_flights_or_of_one_that_is_given(
    served: Served, opened: Watched
) -> None:
    page = opened.page
    page.get_by_text("Start a mission").click()
    mission, origin = (
        page.get_by_role("combobox", name=name, exact=True) for name in ("Mission", "From")
    )
    mission.select_option("search")
    expect(origin).to_have_value("site")
    expect(page.get_by_label("Files of the flight")).to_have_count(0)
    origin.select_option("stream")
    expect(page.get_by_label("Camera URL")).to_be_visible()
    mission.select_option("map")
    expect(origin).to_have_value("upload")
    expect(origin.locator("option")).to_have_count(3)
    mission.select_option("search")
    expect(origin).to_have_value("stream")


def test_a_camera_s_address_shows_its_video(served: Served, opened: Watched) -> None:
    """A watch that is started on the page, on a camera that sends MPEG-TS: its pictures, and then its boxes."""
    page, port = opened.page, free_port()
    page.get_by_text("Start a mission").click()
    with sending(udp_url(port)):
        page.get_by_role("combobox", name="Mission").select_option("watch")
        page.get_by_role("combobox", name="From").select_option("stream")
        page.get_by_label("Camera URL").fill(f"udp://:{port}")
        page.get_by_role("button", name="Start").click()
        expect(page.locator("aside.video header b")).to_have_text(
            re.compile("^udp-"), timeout=60_000
        )
        expect(page.locator(".delay")).to_have_text(re.compile("s delay"))
        brightest = page.locator("aside.video canvas").first.evaluate(
            "each => Math.max(...each.getContext('2d').getImageData(0, 40, 160, 1).data.filter((_, n) => n % 4 < 3))"
        )
        assert (
            brightest > 150
        )  # the column in the middle of gray that moves: a picture, no empty canvas
        page.locator(".run.running").get_by_role("button", name="Stop").click()
        page.locator(".run.finished").wait_for(timeout=60_000)


def test_without_webcodecs_the_video_plays_as_fragments(
    browser: Any, served: Served, tmp_path: Path
) -> None:
    context = context_of(browser)
    context.add_init_script("delete window.VideoDecoder")
    watched = Watched(context, served.url)
    show(watched, served)
    messages = [
        each for each in units(write_video(tmp_path / "v.mp4"), "h264") if each.kind is Kind.VIDEO
    ]
    with greeted(served, "second", "b" * 16) as drone:
        for each in messages[:20]:
            drone.send(each.to_bytes())
        video = watched.page.locator("aside.video video")
        video.wait_for()
        expect(watched.page.locator("aside.video header b")).to_have_text("second")
        for _ in range(100):
            if video.evaluate("each => each.videoWidth === 160 && each.readyState >= 2"):
                break
            watched.page.wait_for_timeout(100)
        else:
            raise AssertionError("no picture was played")
        for each in messages[
            20:
        ]:  # after three seconds without, that is stated in place of the delay
            drone.send(each.to_bytes())
        expect(watched.page.locator(".delay")).to_have_text(re.compile("s delay"))
    assert watched.faults == []
    context.close()


def test_photos_go_up_as_one_file(opened: Watched, served: Served, tmp_path: Path) -> None:
    page = opened.page
    photos = [tmp_path / f"DJI_000{number}.jpg" for number in (2, 1, 3)]
    for each in photos:
        each.write_bytes(jpeg_from_image(np.full((48, 64, 3), 120, np.uint8)))
    page.route(
        re.compile(r"/api/runs$"),
        lambda route: route.fulfill(
            status=201, content_type="application/json", body='{"id": "r"}'
        ),
    )
    page.get_by_text("Start a mission").click()
    page.get_by_label("Files of the flight").first.set_input_files([str(each) for each in photos])
    page.get_by_role("button", name="Start").click()
    page.locator(".message", has_text="started").wait_for()
    (upload,) = [each for each in served.ask("/api/uploads") if each["kind"] == "photos"]
    assert (upload["name"], upload["state"]) == ("DJI_0001-3-photos.zip", "ready")


def test_heights_along_a_line_and_the_printed_sheet(opened: Watched, served: Served) -> None:
    page = opened.page
    heights = {
        "distance_m": [0, 10, 20, 30],
        "height_m": [101.5, None, 104, 103],
        "ground_m": [],
        "sigma_m": 0.2,
    }
    page.route(re.compile("/profile"), lambda route: route.fulfill(json=heights))
    page.locator("[data-panel=measure]").click()
    draw_profile(page)
    page.locator(".hint", has_text="no heights yet").wait_for()
    made = served.station.shelf.open("field").height_path("b", HeightFile.REPORT)
    made.parent.mkdir(exist_ok=True)
    made.write_text("{}")  # in a terminal meanwhile
    draw_profile(page)
    page.locator(
        ".profile figcaption", has_text="Difference 2.5 m, accuracy of a height 0.2 m"
    ).wait_for()
    made.unlink()
    page.evaluate("""() => {
      window.print = () => { document.body.dataset.printed = document.querySelector('.sheet').textContent; };
    }""")
    page.locator("[data-panel=share]").click()
    page.get_by_role("button", name="Print or PDF").click()
    page.locator("body[data-printed]").wait_for(state="attached")
    printed = page.locator("body").get_attribute("data-printed")
    assert "b-3" in printed
    assert re.search(
        r"the picture is [\d.]+ (m|km) wide, north up, its middle at (46|33T)", printed
    )
    assert page.locator(".sheet img").evaluate("each => each.naturalWidth / devicePixelRatio") > 500
    page.evaluate("dispatchEvent(new Event('afterprint'))")


def draw_profile(page: Any) -> None:
    page.locator("[data-tool=profile]").click()
    box = page.locator(".map-canvas").bounding_box()
    for x in (0.4, 0.6):
        page.mouse.click(box["x"] + x * box["width"], box["y"] + 0.5 * box["height"])
        page.wait_for_timeout(350)
    page.get_by_role("button", name="Done").click()


def test_a_site_that_is_not_there_yet_is_not_asked_for(browser: Any, tmp_path: Path) -> None:
    """Its first mission fails, its station is away for a while: nothing is wrong on the page but that."""
    with Served(tmp_path) as station:
        watched = Watched(context_of(browser), station.url)
        page = watched.page
        sockets: list[Any] = []

        def passed_on(socket: Any) -> None:
            sockets.append(socket)
            socket.connect_to_server()

        page.route_web_socket(re.compile("/api/events"), passed_on)
        page.goto(f"{station.url}/#/site/new/live")
        page.get_by_text("Start a mission").wait_for()
        station.station.events.append(
            NewEvent("run.failed", {"error": "no picture"}, "new", "run-1")
        )
        page.locator(".message", has_text="no picture").wait_for()
        sockets[0].close()
        for _ in range(200):  # the page's, which Playwright passes on only while it waits
            if len(sockets) == 2:
                break
            page.wait_for_timeout(100)
        station.station.events.append(
            NewEvent("run.failed", {"error": "the lens is wet"}, "new", "run-2")
        )
        page.locator(".message", has_text="the lens is wet").wait_for()
        page.wait_for_timeout(300)
        assert watched.faults == []
        page.context.close()


def test_a_base_map_comes_from_a_file(opened: Watched, tmp_path: Path) -> None:
    page = opened.page
    page.locator("[data-panel=layers]").click()
    page.get_by_text("Base map", exact=True).click()
    red = png_from_rgba(np.full((256, 256, 4), (255, 0, 0, 255), np.uint8))
    (tmp_path / "base.pmtiles").write_bytes(pmtiles_of(red))
    page.get_by_label("Base map file").set_input_files(str(tmp_path / "base.pmtiles"))
    wait_for_red(page)
    broken = {"name": "x.pmtiles", "mimeType": "", "buffer": b"no map"}
    page.get_by_label("Base map file").set_input_files(files=[broken])
    page.locator(".message.error", has_text="cannot be read").wait_for()


def test_the_height_below_crowns_is_chosen_with_a_slider(
    browser: Any, made_site: Path, tmp_path: Path
) -> None:
    """A site that nobody looked at below its crowns has no such layer."""
    shutil.copytree(made_site, tmp_path / "looked")
    looked = {"floor_m": -19.8, "levels": [-3.0, 9.0]}
    (tmp_path / "looked" / "flights" / "b" / "under_trees.json").write_text(json.dumps(looked))
    shutil.copytree(made_site, tmp_path / "field")
    with Served(tmp_path) as station:
        context = context_of(browser)
        page = context.new_page()
        page.route("**/under-trees/**", lambda route: route.fulfill(status=204))
        page.goto(f"{station.url}/#/site/field/layers")
        page.get_by_label("Track").wait_for()
        assert page.get_by_label("Under the trees").count() == 0
        page.goto(f"{station.url}/#/site/looked/layers")
        run = station.ask("/api/sites/looked")["under_trees"]["run"]
        with page.expect_request(f"**/under-trees/{run}/-20/**"):
            page.get_by_label("Under the trees", exact=True).check()
        slider = page.get_by_label("Height under the trees")
        slider.focus()
        with page.expect_request(f"**/under-trees/{run}/-19/**"):
            slider.press("ArrowRight")
        page.get_by_text("1 m above the floor").wait_for()
        context.close()


def test_the_station_s_own_base_map_is_shown_at_once(
    browser: Any, made_site: Path, tmp_path: Path
) -> None:
    shutil.copytree(made_site, tmp_path / "root" / "field")
    base = tmp_path / "base.pmtiles"
    base.write_bytes(pmtiles_of(png_from_rgba(np.full((256, 256, 4), (255, 0, 0, 255), np.uint8))))
    with Served(tmp_path / "root", base_map=base) as station:
        watched = Watched(context_of(browser), station.url)
        show(watched, station)
        wait_for_red(watched.page)
        assert watched.faults == []
        watched.page.context.close()


def wait_for_red(page: Any) -> None:
    for _ in range(100):
        page.mouse.move(5, 5)
        shot = Image.open(BytesIO(page.locator(".map-canvas").screenshot())).convert("RGB")
        if shot.getpixel((30, shot.height - 60)) == (255, 0, 0):
            return
        page.wait_for_timeout(100)
    raise AssertionError("the base map is not shown")


def pmtiles_of(tile: bytes) -> bytes:
    """A PMTiles archive (version 3) of one PNG tile, that of zoom 0: the header, the root directory, metadata, data."""
    directory = (
        bytes([1, 0, 1]) + varint(len(tile)) + bytes([1])
    )  # one entry: tile 0, run 1, its length, offset 0
    meta = b"{}"
    start = 127 + len(directory)
    sections = [127, len(directory), start, len(meta), 0, 0, start + len(meta), len(tile), 1, 1, 1]
    kinds = bytes([1, 1, 1, 2, 0, 0])  # clustered; not compressed; PNG; zooms 0 to 0
    box = struct.pack("<iiii", -1_800_000_000, -850_000_000, 1_800_000_000, 850_000_000)
    middle = bytes([0]) + struct.pack("<ii", 0, 0)
    header = b"PMTiles" + bytes([3]) + struct.pack("<11Q", *sections) + kinds + box + middle
    assert len(header) == 127
    return header + directory + meta + tile


def varint(value: int) -> bytes:
    found = bytearray()
    while value >= 128:
        found.append(value & 127 | 128)
        value >>= 7
    return bytes([*found, value])


def test_a_route_is_planned_over_ground_that_was_searched_badly_alone(opened: Watched) -> None:
    """From the search, where there is one: to all of a hole, from one point to the nearest, to no ground that was seen well."""
    route = opened.page.evaluate("""async () => {
      const {waypointsFor} = await import('/page/waypoints.js');
      const ground = (kind, west, east) => ({properties: {kind, status: kind}, geometry: {type: 'Polygon',
        coordinates: [[[west, 0], [east, 0], [east, 1e-3], [west, 1e-3], [west, 0]]]}});
      const data = {all: {pod: [ground('pod', 0, 1e-3), ground('hole', 1e-3, 2e-3)], coverage: [ground('hole', 0, 1e-3)]}};
      return waypointsFor(data).map(({geometry}) => geometry.coordinates);
    }""")
    places = np.array(route) * 1e3
    assert 12 <= len(places) <= 30
    assert places[:, 0].min() > 1 and places[:, 0].max() < 2
    assert np.ptp(places, axis=0).min() > 0.6
    assert np.hypot(*np.diff(places, axis=0).T).max() < 0.5


def test_coordinates_are_those_of_the_command_line(opened: Watched) -> None:
    places = [
        (12.6037, 41.8923),
        (5.3, 60.4),
        (16.0, 78.2),
        (-70.6, -33.4),
        (179.99, -16.5),
        (-0.001, 51.5),
        (8.5, 0.0001),
    ]
    found = opened.page.evaluate(
        """async places => {
      const {distance_m} = await import('/page/places.js');
      const {place} = await import('/page/words.js');
      const {choices} = await import('/page/choices.js');
      const written = kind => { choices.set('coordinates', kind); return places.map(each => place(each)); };
      const far = places.map(([lon, lat]) => distance_m([lon, lat], [lon + 1e-3, lat + 1e-3]));
      return {utm: written('utm'), mgrs: written('mgrs'), latlon: written('latlon'), far};
    }""",
        places,
    )
    for system in Coordinates:
        assert found[system.value] == [place_text(lat, lon, system) for lon, lat in places]
    true_m = [Geod(ellps="WGS84").inv(lon, lat, lon + 1e-3, lat + 1e-3)[2] for lon, lat in places]
    assert found["far"] == pytest.approx(true_m, rel=1e-5)


def test_a_station_with_tokens_asks_who_comes(
    browser: Any, made_site: Path, tmp_path: Path
) -> None:
    shutil.copytree(made_site, tmp_path / "field")
    with Served(tmp_path) as station:
        token = make_token(station.station.state, "Ann", "view")
        watched = Watched(context_of(browser), station.url)
        page = watched.page
        page.goto(station.url)
        page.get_by_label("Token").wait_for()
        page.keyboard.press("Escape")
        page.get_by_text("You are not logged in").wait_for()
        page.get_by_role("button", name="Log in").click()
        page.get_by_label("Token").fill("wrong")
        page.get_by_role("dialog").get_by_role("button", name="Log in").click()
        page.get_by_role("alert").get_by_text("not known here").wait_for()
        page.get_by_label("Token").fill(token)
        page.get_by_role("dialog").get_by_role("button", name="Log in").click()
        sent = {"authorization": f"Bearer {make_token(station.station.state, 'Ben', 'view')}"}
        urlopen(Request(f"{station.url}/api/status?site=field", headers=sent)).close()
        page.locator(".card a").click()
        expect(page.locator(".present")).to_have_text("also here: Ben")
        page.locator("#rooms [data-panel=live]").click()
        page.get_by_text("Ask the team lead for operator access").wait_for()
        page.locator("#rooms [data-panel=findings]").click()
        page.get_by_text("Ask the team lead for reviewer access").wait_for()
        assert not page.locator(".gallery").get_by_role("button", name="Confirm").count()
        page.keyboard.press("c")
        page.wait_for_timeout(200)
        assert not served_votes(station)
        page.clock.install()
        page.goto(station.url)
        page.locator(".card").wait_for()
        page.context.clear_cookies()
        page.clock.fast_forward(5500)
        page.get_by_label("Token").wait_for()  # the list asks every 5 s
        page.keyboard.press("Escape")
        page.clock.fast_forward(5500)
        page.wait_for_timeout(300)
        expect(page.get_by_label("Token")).to_have_count(0)
        page.get_by_role("button", name="Log in").click()
        page.get_by_label("Token").fill(token)
        page.get_by_role("dialog").get_by_role("button", name="Log in").click()
        page.locator(".card a").click()
        page.locator(KNOWN).wait_for()
        revoke_token(station.station.state, "Ann")
        page.clock.fast_forward(11_000)
        page.get_by_label("Token").wait_for()
        page.keyboard.press("Escape")  # nothing of the site stays on the screen
        page.get_by_text("You are not logged in").wait_for()
        for each in ("#sentence", "#title", "#rooms", "#messages"):
            expect(page.locator(each)).to_be_empty()
        assert [each for each in watched.faults if "401" not in each] == []
        page.context.close()


def served_votes(station: Served) -> int:
    """How many votes a station keeps."""
    return int(station.station.state.rows("SELECT count(*) AS count FROM reviews")[0]["count"])


SMALL = """() => {
  const aimedAt = (each) => each.matches('[type=checkbox]') ? each.closest('label') : each;
  return [...document.querySelectorAll('button:not(.link), select, a.button, summary, input')].map(aimedAt)
    .filter((each) => each.checkVisibility() && !each.closest('.film, .skip'))
    .filter((each) => [each.offsetWidth, each.offsetHeight].some((px) => px > 0 && px < 44))
    .map((each) => `${each.offsetWidth} x ${each.offsetHeight} ${each.outerHTML.slice(0, 80)}`);
}"""


def test_everybody_can_use_it(browser: Any, served: Served) -> None:
    """axe-core finds nothing serious on any screen, light and dark; a phone shows no part beside its edge and none too
    small for a finger."""
    context = context_of(browser, viewport={"width": 390, "height": 780})
    watched = Watched(context, served.url)
    watched.page.goto(served.url)
    watched.page.locator(".card").wait_for()
    watched.page.evaluate(AXE)
    found = {"sites": serious(watched.page) + watched.page.evaluate(SMALL)}
    show(watched, served)
    for panel in PANELS:
        watched.page.locator(f"[data-panel={panel}]").first.click()
        watched.page.wait_for_timeout(150)
        found[f"{panel}, small"] = watched.page.evaluate(SMALL)
        within = "document" if panel == PANELS[0] else ".panel"  # what is around it stays the same
        found[panel] = serious(watched.page, within)
        watched.page.emulate_media(color_scheme="dark")
        found[f"{panel}, dark"] = serious(watched.page, within, rules=["color-contrast"])
        watched.page.emulate_media(color_scheme="light")
        assert watched.page.evaluate("document.documentElement.scrollWidth") <= 390, panel
    watched.page.locator("#settings-button").click()
    found["settings"] = serious(watched.page)
    assert {name: each for name, each in found.items() if each} == {}
    context.close()


def test_a_tablet_shows_every_panel_whole(browser: Any, served: Served) -> None:
    """Upright: no button beyond its panel's edge, facts in lines and not in letters, nothing serious for axe-core."""
    context = context_of(browser, viewport={"width": 820, "height": 1180})
    watched = Watched(context, served.url)
    page = watched.page
    show(watched, served)
    page.evaluate(AXE)
    found, cut = {}, {}
    for panel in PANELS:
        if panel != "live":  # which is open
            page.locator(f"[data-panel={panel}]").first.click()
        page.locator(".panel h2").first.wait_for()
        found[panel] = serious(page, "document" if panel == PANELS[0] else ".panel")
        cut[panel] = page.evaluate(BEYOND)
        if panel == "review":
            page.locator(".gallery .facts dd").first.wait_for()
            assert (
                page.locator(".gallery .facts dd").first.evaluate("each => each.offsetWidth") > 200
            )
    assert {name: each for name, each in found.items() if each} == {}
    assert {name: each for name, each in cut.items() if each} == {}
    assert watched.faults == []
    context.close()


def test_what_a_watch_found_is_judged_with_the_keyboard(opened: Watched, served: Served) -> None:
    results, page = watch_run(served.station, "run-7"), opened.page
    try:
        announce(served, "site.changed", {"versions": 2})
        found = served.ask("/api/sites/field/collections/findings/items")["features"]
        person = found[0]["id"]
        page.locator("[data-panel=findings]").click()
        page.get_by_role("button", name="Objects (2)").click()
        page.locator(f".strip button[data-id='{person}']").click()
        page.keyboard.press("c")
        page.locator(f".strip button.confirmed[data-id='{person}']").wait_for()
        wait_for(
            lambda: served.ask("/api/sites/field/reviews?kind=object")
        )  # shown at once, sent then
        (given,) = served.ask("/api/sites/field/reviews?kind=object")
        assert (given["id"], given["verdict"]) == (person, "confirmed")
    finally:
        (results / "tracks.geojson").unlink()


def test_a_vote_on_what_a_watch_has_just_found_is_shown(opened: Watched, served: Served) -> None:
    """The page has it from an event, by the watch's own id; the station's list has it by its finding's."""
    results, page = watch_run(served.station, "run-8"), opened.page
    try:
        place = {"type": "Point", "coordinates": [11.0, 46.0]}
        person = {"id": 1, "class": "person", "score": 0.9}
        found = {"type": "Feature", "id": 1, "properties": person, "geometry": place}
        served.station.events.append(NewEvent("object.found", {"feature": found}, "field", "run-8"))
        page.locator("[data-panel=findings]").click()
        page.get_by_role("button", name="Objects (1)").click()
        page.locator(".strip button[data-id='run-8:1']").click()
        page.keyboard.press("c")
        page.locator(".strip button.confirmed").wait_for()
        expect(page.locator(".strip button[data-id='run-8:1']")).to_have_count(0)
        page.wait_for_load_state("networkidle")  # its picture is asked for, too
    finally:
        (results / "tracks.geojson").unlink()


OVER_THE_EDGE = """() => {
  const width = document.documentElement.clientWidth;
  return [...document.querySelectorAll('button, select, input, h1, h2, .field, .segments, .note, #sentence > *')].filter((each) =>
    each.checkVisibility() && !each.closest('.film, .timeline, .strip, .swipe-names, .maplibregl-map, details:not([open])'))
    .filter((each) => each.getBoundingClientRect().right > width + 1 || each.scrollWidth > each.clientWidth + 2 && each.matches('button, .segments'))
    .map((each) => each.outerHTML.slice(0, 120));
}"""
UNSAID = """() => {
  const theirs = 'code, pre, .files, .run > p, .facts dd, .card h3, #title h1, .timeline small, .drawn input, option[value=en], script, style, noscript';
  const bare = (text) => {
    let [before, rest] = ['', text];
    while (before !== rest) [before, rest] = [rest, rest.replace(/⟦[^⟦⟧]*⟧/g, ' ')];
    return rest.replace(/⟦[^⟧]*$/, '').replace(/^[^⟦]*⟧/, '').trim(); // an element may stand within a text
  };
  const texts = [];
  for (const each of document.querySelectorAll('html, body *')) {
    if (each.closest(theirs)) continue;
    for (const name of ['aria-label', 'title', 'placeholder', 'alt']) texts.push(each.getAttribute(name) ?? '');
    for (const node of each.childNodes) if (node.nodeType === 3) texts.push(node.data);
  }
  return texts.map(bare).filter((each) => /[a-z]{3,}/i.test(each));
}"""
SAME_EVERYWHERE = re.compile(  # names, formats, keys, what the station calls a flight; addresses
    r"Sorvolo|GeoJSON|CSV|KMZ|CalTopo|UTM|UTC|MGRS|OpenAPI|API|Esc|field|http.*|Español|Français|Deutsch|Italiano"
    r"|\d: .* \([ab]\)|run-\d+|[( ]*v\d\)|[\d., :]+, ada|sorvolo review"
)


@pytest.mark.parametrize("locale", ["de-DE", pytest.param("it-IT", marks=pytest.mark.long)])
def test_the_page_in_another_language_fits_a_phone_and_a_laptop(
    browser: Any, served: Served, locale: str
) -> None:
    """Nothing lies beyond an edge, nothing is serious for axe-core; a language that is chosen is kept."""
    context = context_of(browser, locale=locale)
    watched = Watched(context, served.url)
    page, beyond, found = watched.page, {}, {}
    for width, height in ((390, 844), (1280, 720)):
        page.set_viewport_size({"width": width, "height": height})
        page.goto(f"{served.url}/#/")
        page.locator(".card").first.wait_for()
        page.evaluate(AXE)

        def look(name: str, width: int = width) -> None:
            beyond[f"{name}, {width}"] = page.evaluate(OVER_THE_EDGE)
            assert page.evaluate("document.documentElement.scrollWidth") <= width, name

        look("sites")
        show(watched, served)
        for panel in PANELS:
            page.locator(f"button[data-panel={panel}]").first.click()
            page.locator(f".body.{panel}").wait_for()
            look(panel)
            if width == 390 and panel in ("live", "findings"):
                found[panel] = serious(page)
        page.locator("#settings-button").click()
        look("settings")
        page.keyboard.press("Escape")
    assert {name: each for name, each in (beyond | found).items() if each} == {}
    assert page.locator("html").get_attribute("lang") == locale[:2]
    page.locator("#settings-button").click()
    page.locator("dialog select").first.select_option("es")
    page.locator("html[lang=es]").wait_for()
    expect(page.locator("#link-state")).to_have_text("Conectado")
    page.reload()
    expect(page.locator("#link-state")).to_have_text("Conectado")
    assert watched.faults == []
    context.close()


def test_no_english_is_left_among_the_page_s_own_words(browser: Any, served: Served) -> None:
    """In a made-up language, whose texts stand in brackets; without its file the page is English."""
    there = json.loads((LANGUAGES / "de.json").read_text(encoding="utf-8"))
    context = context_of(browser, locale="de-AT")
    watched = Watched(context, served.url)
    page = watched.page
    page.route("**/page/languages/de.json", lambda route: route.fulfill(status=503))
    page.goto(f"{served.url}/#/")
    expect(page.locator("#link-state")).to_have_text("Connected")
    assert page.locator("html").get_attribute("lang") == "en"
    page.unroute_all()
    made_up = {each: "|".join(f"⟦{form}⟧" for form in each.split("|")) for each in there}
    page.route("**/page/languages/de.json", lambda route: route.fulfill(json=made_up))
    page.reload()
    expect(page.locator("#link-state")).to_have_text("⟦Connected⟧")
    left = {}

    def look(name: str) -> None:
        page.evaluate("document.querySelectorAll('details').forEach(each => { each.open = true; })")
        texts = page.evaluate(UNSAID)
        left[name] = [each for each in texts if not SAME_EVERYWHERE.fullmatch(each)]

    page.locator(".card .more summary").first.click()
    page.locator(".card .more button").first.click()
    page.locator("dialog form").wait_for()
    look("sites")
    show(watched, served)
    for panel in PANELS:
        page.locator(f"button[data-panel={panel}]").first.click()
        page.locator(f".body.{panel}").wait_for()
        page.wait_for_timeout(300)
        look(panel)
    page.locator("#settings-button").click()
    look("settings")
    assert {name: each for name, each in left.items() if each} == {}
    faults = [each for each in watched.faults if "503" not in each]
    assert faults == []
    context.close()


def serious(page: Any, within: str = "document", rules: list[str] | None = None) -> list[str]:
    """What axe-core finds on the page, or within what a selector names."""
    only = {"runOnly": {"type": "rule", "values": rules}} if rules else {}
    result = page.evaluate(
        """([within, only]) =>
          axe.run(within === 'document' ? document : within, {resultTypes: ['violations'], ...only})""",
        [within, only],
    )
    return [
        f"{each['id']}: {each['nodes'][0]['html'][:160]} {each['nodes'][0].get('failureSummary', '')[:200]}"
        for each in result["violations"]
        if each["impact"] in ("serious", "critical")
    ]


def test_a_phone_and_paper_show_many_changes_in_little_room(browser: Any) -> None:
    """A change was a page of paper and a screen of its own; colours and the whole list are printed."""
    changes = [
        fake_change(
            k + 1, kind=list(ChangeKind)[k % 5], east_m=k % 13 - 6, north_m=k % 9 - 4, size_m=0.5
        )
        for k in range(12)
    ]
    page = context_of(browser, viewport={"width": 390, "height": 844}).new_page()
    page.set_content(page_of(changes))
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    assert page.evaluate("document.documentElement.scrollHeight") < 4_400
    page.emulate_media(media="print")
    styles = "each => [getComputedStyle(each).overflow, getComputedStyle(each).printColorAdjust]"
    assert page.locator(".overview").locator("..").evaluate(styles) == ["visible", "exact"]
    last = page.locator("article").last.bounding_box()  # in a group that is folded on a screen
    assert last is not None and last["height"] > 0
    printed = page.pdf(format="A4", prefer_css_page_size=True)
    assert len(re.findall(rb"/Type\s*/Page\b", printed)) <= 5
    page.context.close()


def test_a_flight_s_report_keeps_engineering_folded_and_figures_whole(browser: Any) -> None:
    """Its time, memory, settings and libraries are a click away, at the end; no line breaks before a unit."""
    page = context_of(browser, viewport={"width": 320, "height": 844}).new_page()
    page.set_content(report_page(fake_report(), fake_picture()))
    engineering = re.compile(
        r"numpy|opencv|memory|processor time|time taken|overlap", re.IGNORECASE
    )
    assert not engineering.search(page.locator("body").inner_text())
    folded = page.locator("details", has_text="How it was computed")
    folded.locator("summary").click()
    assert engineering.search(folded.inner_text())
    assert folded.evaluate("each => !each.closest('section').nextElementSibling")
    lines = page.locator("h1").evaluate("""each => {
      const text = each.firstChild, found = [...text.data.matchAll(/[\\d.]+(?:\\s\\d+)*\\s(?:m²|ha|cm|m)(?![a-z])/g)];
      return found.map(({0: {length}, index}) => {
        const range = document.createRange();
        range.setStart(text, index);
        range.setEnd(text, index + length);
        return range.getClientRects().length;
      });
    }""")
    assert len(lines) == 2 and set(lines) == {1}
    page.context.close()

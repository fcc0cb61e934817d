"""The page's files: libraries as their makers packed them, with licences; no third party; text stays text."""

import hashlib
import json
import re
from pathlib import Path

import pytest

import sorvolo

PAGE = Path(sorvolo.__file__).parent / "station" / "page"
TESTS_OWN = Path(__file__).parent / "vendor"
MOST_BYTES = 2_500_000  # of the page, cold
LANGUAGES = sorted((PAGE / "languages").iterdir())
SAID = re.compile(r'(?<![\w.])say\(\s*("(?:[^"\\]|\\.)*")?')
COMMENT = re.compile(r"/\*\*.*?\*/|(?:^|(?<=[\s;{,]))//[^\n]*", re.DOTALL | re.MULTILINE)
READABLE = re.compile(  # a sentence, or one word that begins as a label does
    r"[A-Z][a-z]+ [a-z]|[a-z]{2,} [a-z]{2,} [a-z]|^[A-Z][a-z]{2,}$|^[A-Z][a-z]+ "
)
UNSAID = {  # read by machines, the same in all languages, or keys of a table whose values are said
    *("Arrow", "Enter", "Escape", "Backspace", "Esc", "Problem", "English", "Deutsch", "Italiano"),
    *("Feature", "Point", "Polygon", "Marker", "Shape", "Placemark", "Style", "Document"),
    *("Parameter", "Configuration", "Contents", "Content", "the PMTiles library did not load"),
    *("too few views", "rarely found anywhere"),
}
OURS = sorted(each for each in PAGE.iterdir() if each.suffix in {".js", ".css", ".html", ".svg"})


def libraries(folder: Path) -> list[dict]:
    return json.loads((folder / "manifest.json").read_text())["libraries"]


@pytest.mark.parametrize("folder", [PAGE / "vendor", TESTS_OWN], ids=["page", "tests"])
def test_every_packed_file_has_its_hash_and_its_licence(folder: Path) -> None:
    listed = {each["path"]: each for library in libraries(folder) for each in library["files"]}
    assert set(listed) == {each.name for each in folder.iterdir() if each.is_file()} - {
        "manifest.json"
    }
    for name, entry in listed.items():
        data = (folder / name).read_bytes()
        assert (len(data), hashlib.sha256(data).hexdigest()) == (entry["bytes"], entry["sha256"]), (
            name
        )
    texts = {library["licence_file"] for library in libraries(folder)}
    assert texts == {f"licences/{each.name}" for each in (folder / "licences").iterdir()}
    for each in texts:
        assert "copyright" in (folder / each).read_text(encoding="utf-8").lower()


def test_the_page_ships_no_copyleft() -> None:
    allowed = {"BSD-3-Clause", "BSD-2-Clause", "ISC", "MIT", "(MIT OR Apache-2.0)"}
    assert {library["licence"] for library in libraries(PAGE / "vendor")} <= allowed


def test_the_page_is_small_enough_to_come_over_a_field_radio() -> None:
    late = {"pmtiles.js"}  # only where somebody chooses a base map
    files = [
        each
        for each in (*OURS, *(PAGE / "vendor").glob("*.*"))
        if each.name not in late | {"manifest.json"}
    ]
    assert sum(each.stat().st_size for each in files) < MOST_BYTES


@pytest.mark.parametrize("path", OURS, ids=lambda each: each.name)
def test_no_address_of_others_and_no_markup_from_data(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    addresses = set(re.findall(r"https?://[\w.-]+", text))
    assert addresses <= {
        "http://www.w3.org",
        "http://www.opengis.net",
    }  # names of XML vocabularies, never asked for
    assert not re.search(
        r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function|srcdoc", text
    )
    if path.suffix == ".html":  # the policy forbids both
        assert not re.search(r"<style|\sstyle=|\son\w+=|<script(?![^>]*\bsrc=)", text)


def test_every_module_that_is_imported_is_there() -> None:
    for path in OURS:
        for name in re.findall(
            r"""(?:from|import)\s*\(?["']\./([\w./-]+)["']""", path.read_text(encoding="utf-8")
        ):
            assert (PAGE / name).is_file(), f"{path.name} imports {name}"


def test_every_drawing_that_is_named_is_there() -> None:
    drawn = set(re.findall(r'<symbol id="([\w-]+)"', (PAGE / "icons.svg").read_text()))
    text = "".join(each.read_text(encoding="utf-8") for each in OURS)
    ways = (r'icon: "([\w-]+)"', r'icon\("([\w-]+)"\)', r"icons\.svg#([\w-]+)")
    named = {name for each in ways for name in re.findall(each, text)}
    assert named
    assert named <= drawn


def scripts() -> dict[str, str]:
    """The page's own scripts without comments; what makes `say` is none of those that call it."""
    ours = [each for each in OURS if each.suffix == ".js"]
    return {each.name: COMMENT.sub("", each.read_text(encoding="utf-8")) for each in ours}


def said() -> set[str]:
    """What the page says, in English."""
    calls = [
        call
        for name, text in scripts().items()
        if name != "languages.js"
        for call in SAID.findall(text)
    ]
    assert "" not in calls  # a text stands where it is said, or no test could find it
    return {json.loads(each) for each in calls}


@pytest.mark.parametrize("path", LANGUAGES, ids=lambda each: each.stem)
def test_a_language_has_every_text_of_the_page_and_no_other(path: Path) -> None:
    texts = json.loads(path.read_text(encoding="utf-8"))
    assert len(texts) > 400
    assert set(texts) == said()
    for english, text in texts.items():
        values = re.findall(r"\{\w+\}", text)
        assert set(values) == set(re.findall(r"\{\w+\}", english)), english
        for form in text.split("|"):
            assert form.strip() == form != "", english
            assert set(re.findall(r"\{\w+\}", form)) == set(values), english
        assert text.count("|") == english.count("|") <= 1, english
        assert ("{n}" in english) or "|" not in english, english


def test_the_page_lists_the_languages_that_are_there() -> None:
    (listed,) = re.findall(r"LANGUAGES = \{(.*)\}", scripts()["languages.js"])
    assert sorted(re.findall(r"(\w+): ", listed)) == sorted(
        ["en", *(each.stem for each in LANGUAGES)]
    )


def test_what_is_read_on_the_page_is_said_in_the_reader_s_language() -> None:
    """Sentences and labels; a single word in small letters cannot be told from a key: the browser's test finds it."""
    read = set()
    for name, text in scripts().items():
        rest = SAID.sub("(", text)
        plain = [each[1:-1] for each in re.findall(r'"(?:[^"\\\n]|\\.)*"', rest)]
        filled = re.findall(r"`((?:[^`\\]|\\.)*)`", rest)
        parts = [part for each in filled for part in re.split(r"\$\{[^{}]*\}", each)]
        read |= {(name, each) for each in plain + parts if READABLE.search(each)}
    assert len(said()) > 400
    assert {each for each in read if each[1] not in UNSAID} == set()

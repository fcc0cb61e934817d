"""The pages keep to the program: links lead somewhere, commands and options exist; `make docs` checks the site."""

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
import typer.main

from sorvolo.cli.main import app

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
LIVING = [
    path
    for path in PAGES
    if "decisions" not in path.parts and path.name not in {"CHANGELOG.md", "STYLE.md"}
]
MOST_IMAGE_BYTES = 1_500_000
_LINK = re.compile(r"\[(?:[^\[\]]|\[[^\]]*\])*\]\(([^)\s]+)\)")
_CODE = re.compile(r"```.*?\n(.*?)```|`([^`\n]+)`|^ {4,}(\S.*)$", re.S | re.M)
_OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]*")


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page: Path) -> None:
    broken = []
    for target in _LINK.findall(
        re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)
    ):
        path, _, anchor = target.partition("#")
        if ":" in path:
            continue
        found = page if not path else Path(posixpath.normpath((page.parent / path).as_posix()))
        if not found.exists() or (
            anchor and found.suffix == ".md" and anchor not in anchors(found)
        ):
            broken.append(target)
    assert broken == []


def anchors(page: Path) -> set[str]:
    titles = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.M)
    return {
        re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", title.lower())).strip("-")
        for title in titles
    }


@pytest.mark.parametrize("page", LIVING, ids=name_of)
def test_commands_and_options_of_a_page_exist(page: Path) -> None:
    commands = options_by_command()
    known = {
        option for options in commands.values() for option in options
    } | options_of_other_programs()
    wrong = []
    for line in code_of(page):
        words = line.split()
        if words[:1] == ["sorvolo"]:
            command = next(
                (each for each in (" ".join(words[1:3]), " ".join(words[1:2])) if each in commands),
                None,
            )
            if (
                command is None
                and len(words) > 1
                and words[1].isidentifier()
                and not words[1].isupper()
            ):
                wrong.append(line)
            allowed = commands[command] if command else known
            wrong += [
                f"{line}: {each}"
                for each in _OPTION.findall(line.partition("|")[0])
                if each not in allowed
            ]
        else:
            wrong += [f"{line}: {each}" for each in _OPTION.findall(line) if each not in known]
    assert wrong == []


def code_of(page: Path) -> Iterator[str]:
    for fenced, span, indented in _CODE.findall(page.read_text(encoding="utf-8")):
        for line in (fenced or span or indented).splitlines():
            yield re.split(r"\s#\s|\s{3,}", line.strip())[0]


def options_by_command() -> dict[str, set[str]]:
    found: dict[str, set[str]] = {}

    def walk(command: typer.core.TyperCommand, name: str) -> None:
        found[name] = {
            each for one in command.params for each in (*one.opts, *one.secondary_opts)
        } | {"--help"}
        for child, below in getattr(command, "commands", {}).items():
            walk(below, f"{name} {child}".strip())

    walk(typer.main.get_command(app), "")
    return found


def options_of_other_programs() -> set[str]:
    scripts = [*(ROOT / "benchmarks").glob("*.py"), *(ROOT / "docs").rglob("*.py")]
    own = {
        each
        for path in scripts
        for each in re.findall(r'add_argument\(\s*"(--[a-z0-9-]+)"', path.read_text())
    }
    ray = {
        "--head",
        "--block",
        "--node-ip-address",
        "--ray-client-server-port",
        "--include-dashboard",
        "--address",
    }
    return own | ray | {"--no-deps", "--strict"}  # of pip and mypy


def test_pictures_are_few_and_all_used() -> None:
    used = {
        (page.parent / target).resolve()
        for page in PAGES
        for target in _LINK.findall(page.read_text(encoding="utf-8"))
    }
    pictures = [path for path in (ROOT / "docs" / "images").iterdir() if path.is_file()]
    assert [name_of(path) for path in pictures if path.resolve() not in used] == []
    assert sum(path.stat().st_size for path in pictures) < MOST_IMAGE_BYTES


def test_every_page_is_in_the_sites_navigation() -> None:
    site = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    pages = [path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")]
    assert [
        page for page in pages if not page.startswith("decisions/") and f"- {page}\n" not in site
    ] == []

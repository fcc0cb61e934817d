"""Hooks of MkDocs: the README becomes the front page, and links to files of the repository are checked.

README, ARCHITECTURE, CONTRIBUTING and CHANGELOG become pages of the site, and so do the public names of the package. Any
other link out of docs/ must name a file of the repository, else it is broken; on the site its text stays.
"""

import logging
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]
PAGES = {
    "README.md": "index.md",
    "ARCHITECTURE.md": "architecture.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")
_log = logging.getLogger("mkdocs.hooks")


def on_config(config: Any) -> Any:
    """Name every decision in the navigation, in the order of their numbers."""
    decisions = sorted(
        f"decisions/{path.name}" for path in (ROOT / "docs" / "decisions").glob("*.md")
    )
    for section in config["nav"]:
        if "Decisions" in section:
            section["Decisions"] = decisions
    return config


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are not in docs/."""
    for name, page in PAGES.items():
        text = _relinked((ROOT / name).read_text(encoding="utf-8"), "", page)
        files.append(File.generated(config, page, content=text))
    names = (ROOT / "src" / "sorvolo" / "__init__.pyi").read_text(encoding="utf-8")
    homes = re.findall(r"^from (\S+) import (\w+) as", names, re.M)
    entries = [f"::: {home}.{name}" for home, name in sorted(homes, key=lambda each: each[1])]
    text = "\n\n".join(["# All public names", *entries])
    files.append(File.generated(config, "reference.md", content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links of a page of docs/, as the site needs them."""
    if page.file.src_uri in PAGES.values():
        return markdown
    return _relinked(
        markdown, posixpath.join("docs", posixpath.dirname(page.file.src_uri)), page.file.src_uri
    )


def _relinked(markdown: str, folder: str, page: str) -> str:
    """Return the text of a page in `folder` of the repository with its links made for `page` of the site."""

    def relink(found: re.Match[str]) -> str:
        mark, text, target = found.groups()
        path, hash_mark, anchor = target.partition("#")
        if not path or ":" in path:
            return found[0]
        name = posixpath.normpath(posixpath.join(folder, path))
        inside = PAGES.get(name) or (name.removeprefix("docs/") if name.startswith("docs/") else "")
        if inside and (ROOT / name).is_file():
            return f"{mark}[{text}]({posixpath.relpath(inside, posixpath.dirname(page) or '.')}{hash_mark}{anchor})"
        if name in {"docs", "docs/decisions"}:
            return text
        if not (ROOT / name).exists():
            _log.warning("%s links to %s, which is not in the repository", page, target)
        return text

    parts = re.split(r"(```.*?```)", markdown, flags=re.S)  # every other one is code
    return "".join(
        part if number % 2 else _LINK.sub(relink, part) for number, part in enumerate(parts)
    )

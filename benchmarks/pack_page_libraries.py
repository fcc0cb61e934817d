"""The station page's libraries, taken from npm at pinned versions: files, licences, and a manifest of their hashes.

`make page-vendor` runs it and needs npm; installing and running Sorvolo does not. Nothing is built: the files are
copied as their makers packed them.
"""

import hashlib
import json
import shutil
import subprocess
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "src" / "sorvolo" / "station" / "page" / "vendor"
TESTS = ROOT / "tests" / "station" / "vendor"

# name on npm: version, the files that are taken and where they go
PAGE_LIBRARIES = {
    "maplibre-gl": (
        "6.17.0",
        {
            "dist/maplibre-gl.mjs": "maplibre-gl.mjs",
            "dist/maplibre-gl-worker.mjs": "maplibre-gl-worker.mjs",
            "dist/maplibre-gl.css": "maplibre-gl.css",
        },
    ),
    "pmtiles": ("4.5.0", {"dist/pmtiles.js": "pmtiles.js"}),
}
TEST_LIBRARIES = {"axe-core": ("4.14.1", {"axe.min.js": "axe.min.js"})}

# packages whose archives on npm hold no licence file: what their repositories state
STATED_LICENCES = {
    "pmtiles": ("Copyright 2021 Protomaps LLC", "BSD-3-Clause"),
    "murmurhash-js": ("Copyright (c) 2011 Gary Court", "MIT"),
}
# not in the packed files
BUILD_ONLY = {"@types/geojson", "minimist", "resolve-protobuf-schema", "protocol-buffers-schema"}


def main() -> None:
    """Fetch, copy, and write both manifests."""
    with tempfile.TemporaryDirectory() as folder:
        pack(PAGE_LIBRARIES, PAGE, Path(folder) / "page")
        pack(TEST_LIBRARIES, TESTS, Path(folder) / "tests")


def pack(libraries: dict[str, tuple[str, dict[str, str]]], target: Path, work: Path) -> None:
    """Install the libraries in `work`, copy what is named to `target`, with the licence of everything inside."""
    work.mkdir(parents=True)
    (work / "package.json").write_text('{"private": true}')
    wanted = [f"{name}@{version}" for name, (version, _) in libraries.items()]
    subprocess.run(
        ["npm", "install", "--ignore-scripts", "--save-exact", "--no-audit", *wanted],
        cwd=work,
        check=True,
    )
    shutil.rmtree(target, ignore_errors=True)
    (target / "licences").mkdir(parents=True)
    lock = json.loads((work / "package-lock.json").read_text())["packages"]
    entries = []
    for path, locked in sorted(lock.items()):
        name = path.removeprefix("node_modules/")
        if not path or name in BUILD_ONLY:
            continue
        _, files = libraries.get(name, ("", {}))
        for source, copied in files.items():
            shutil.copyfile(work / path / source, target / copied)
        licence = copy_licence(name, work / path, target / "licences")
        entries.append(
            {
                "name": name,
                "version": locked["version"],
                "licence": locked["license"],
                "licence_file": licence,
                "source": f"https://www.npmjs.com/package/{name}/v/{locked['version']}",
                "npm_integrity": locked["integrity"],
                "files": [described(target / copied) for copied in files.values()],
            }
        )
    manifest = {"made_by": "make page-vendor", "libraries": entries}
    (target / "manifest.json").write_text(json.dumps(manifest, indent=2) + "\n")


def copy_licence(name: str, package: Path, target: Path) -> str:
    """Copy the package's licence, or write the one that its repository states. Gives the file's place."""
    path = target / f"{name.replace('@', '').replace('/', '-')}.txt"
    found = sorted(
        each for each in package.iterdir() if each.name.lower().startswith(("license", "copying"))
    )
    if found:
        path.write_text(
            "\n".join(each.read_text(encoding="utf-8") for each in found), encoding="utf-8"
        )
    else:
        copyright_line, kind = STATED_LICENCES[name]
        path.write_text(f"{copyright_line}\n\n{LICENCE_TEXTS[kind]}", encoding="utf-8")
    return f"licences/{path.name}"


def described(path: Path) -> dict[str, object]:
    """A file's name, size and hash."""
    data = path.read_bytes()
    return {"path": path.name, "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


LICENCE_TEXTS = {
    "BSD-3-Clause": """Redistribution and use in source and binary forms, with or without modification, are permitted
provided that the following conditions are met:

1. Redistributions of source code must retain the above copyright notice, this list of conditions and the following
   disclaimer.
2. Redistributions in binary form must reproduce the above copyright notice, this list of conditions and the following
   disclaimer in the documentation and/or other materials provided with the distribution.
3. Neither the name of the copyright holder nor the names of its contributors may be used to endorse or promote
   products derived from this software without specific prior written permission.

THIS SOFTWARE IS PROVIDED BY THE COPYRIGHT HOLDERS AND CONTRIBUTORS "AS IS" AND ANY EXPRESS OR IMPLIED WARRANTIES,
INCLUDING, BUT NOT LIMITED TO, THE IMPLIED WARRANTIES OF MERCHANTABILITY AND FITNESS FOR A PARTICULAR PURPOSE ARE
DISCLAIMED. IN NO EVENT SHALL THE COPYRIGHT HOLDER OR CONTRIBUTORS BE LIABLE FOR ANY DIRECT, INDIRECT, INCIDENTAL,
SPECIAL, EXEMPLARY, OR CONSEQUENTIAL DAMAGES (INCLUDING, BUT NOT LIMITED TO, PROCUREMENT OF SUBSTITUTE GOODS OR
SERVICES; LOSS OF USE, DATA, OR PROFITS; OR BUSINESS INTERRUPTION) HOWEVER CAUSED AND ON ANY THEORY OF LIABILITY,
WHETHER IN CONTRACT, STRICT LIABILITY, OR TORT (INCLUDING NEGLIGENCE OR OTHERWISE) ARISING IN ANY WAY OUT OF THE USE OF
THIS SOFTWARE, EVEN IF ADVISED OF THE POSSIBILITY OF SUCH DAMAGE.
""",
    "MIT": """Permission is hereby granted, free of charge, to any person obtaining a copy of this software and
associated documentation files (the "Software"), to deal in the Software without restriction, including without
limitation the rights to use, copy, modify, merge, publish, distribute, sublicense, and/or sell copies of the
Software, and to permit persons to whom the Software is furnished to do so, subject to the following conditions:

The above copyright notice and this permission notice shall be included in all copies or substantial portions of the
Software.

THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR IMPLIED, INCLUDING BUT NOT LIMITED TO THE
WARRANTIES OF MERCHANTABILITY, FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL THE AUTHORS OR
COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR
OTHERWISE, ARISING FROM, OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE SOFTWARE.
""",
}


if __name__ == "__main__":
    main()

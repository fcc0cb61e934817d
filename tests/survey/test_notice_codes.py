"""The codes of notices are promised to be stable: each is reported in the documentation."""

import re
from pathlib import Path

import sorvolo
from sorvolo.lab.datasets.parsed import FINDINGS
from sorvolo.missions.watch.notifier import RECEIVERS

_DOCS = Path(__file__).resolve().parents[2] / "docs"


def _codes() -> set[str]:
    source = "\n".join(path.read_text() for path in Path(sorvolo.__file__).parent.rglob("*.py"))
    reported = set(re.findall(r'\b[Nn]otice\(\s*"(\w+)"', source)) | set(
        re.findall(r'\.notices\("(\w+)"\)', source)
    )
    return (
        reported
        | {f"{name}_{end}" for name in RECEIVERS for end in ("failed", "dropped")}
        | set(FINDINGS)
    )


def test_every_code_is_documented() -> None:
    codes = _codes()
    assert {"truncated", "ground_unknown", "telemetry_outage", "alert_url_failed"} <= codes
    docs = (_DOCS / "notices.md").read_text()
    assert not {code for code in codes if f"`{code}`" not in docs}

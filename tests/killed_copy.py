"""A folder that somebody still writes, copied as a kill at this moment would leave it."""

import shutil
from pathlib import Path

from sorvolo.store.atomic import TEMPORARY_PREFIX

JOURNAL = "run.journal"


def copy_as_killed(folder: Path, to: Path) -> Path:
    """Copy a folder that a run is writing, by threads of its own as well; the copy's path.

    The journals come first: a kill leaves files that no journal names yet, never a journal that names files which are
    not there. A temporary file that gets its name meanwhile is left out, as if it had been killed before it began.
    """
    for journal in sorted(folder.rglob(JOURNAL)):
        copied = to / journal.relative_to(folder)
        copied.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(journal, copied)

    def copy(source: str, target: str) -> str:
        try:
            return target if Path(source).name == JOURNAL else shutil.copy2(source, target)
        except FileNotFoundError:
            if not Path(source).name.startswith(TEMPORARY_PREFIX):
                raise
            return target

    return Path(shutil.copytree(folder, to, copy_function=copy, dirs_exist_ok=True))

"""How Sorvolo starts another Python process of its own."""

import sys


def python_command(module: str, *arguments: str) -> list[str]:
    """Return the command that runs a module of Sorvolo in a process of its own.

    `-P` keeps the current folder off the module search path: a `numpy.py` in a folder of flights must never run.
    """
    return [sys.executable, "-P", "-m", module, *arguments]

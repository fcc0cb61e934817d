"""`python -m sorvolo`: the same as the command `sorvolo`."""

import sys

from sorvolo.cli.main import main

if __name__ == "__main__":
    code = main()
    # A Ctrl-C that strikes inside the exec of a string (dataclasses and libraries do that) leaves CPython's mark of an
    # unhandled one behind, and `python -m` would then die of SIGINT whatever the code. The next exec takes it away.
    exec("")
    sys.exit(code)

"""`python -m sorvolo`: the same as the command `sorvolo`."""

import sys

from sorvolo.cli.main import main

if __name__ == "__main__":
    sys.exit(main())

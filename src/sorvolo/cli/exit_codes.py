"""What the exit codes of commands mean, beside 0 (success) and 2 (wrong usage); docs/commands.md lists them."""

FAILED = 1
"""An error, or a part of the work that failed."""

TO_CHECK = 3
"""Done, but the result has to be checked before use, or lacks something; the first line states what."""

STOPPED = 130
"""Stopped by Ctrl-C, as shells count it."""

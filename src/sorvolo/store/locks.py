"""Locks of the system on open files: taken at once or not at all, and let go of however the process ends."""

import fcntl


def take_lock(descriptor: int) -> bool:
    """Take the lock of an open file, which it keeps until it is closed; False where another one has it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True

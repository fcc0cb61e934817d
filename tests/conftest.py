"""What holds for all tests."""

import os
import signal

from hypothesis import settings

# a shell's background job ignores Ctrl-C, and so would the programs that tests start and stop
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# beside other workers of the suite, a second thread of the same sum only waits; read before any library starts threads
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# how long an example takes depends on what else the machine does: no test is judged by it. Continuous integration (CI
# is set) draws the same examples every time, others new ones.
settings.register_profile("anywhere", deadline=None)
settings.register_profile("every time the same", deadline=None, derandomize=True, database=None, print_blob=True)
settings.load_profile("every time the same" if "CI" in os.environ else "anywhere")

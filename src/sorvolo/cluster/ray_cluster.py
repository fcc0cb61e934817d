"""A Ray cluster reached and checked before it is used: what is not as it must be is one error within seconds."""

import os
import secrets
import socket
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import sorvolo
from sorvolo.errors import SettingsError, StoreError
from sorvolo.store.atomic import TEMPORARY_PREFIX, atomic_write_bytes

SCHEME = "ray://"
_UNREADY = "Initialization failure from server"  # Ray's words where its process for one client does not start in time


@dataclass(frozen=True)
class WaitSettings:
    """How long a cluster's answers are waited for, s. Chosen, not measured, for machines in one network."""

    reach_s: float = 8.0  # a connection to the head, which takes milliseconds
    start_s: float = 90.0  # a head that has just started: Ray gives the process that serves a client 30 s, and fails
    probe_s: float = 90.0  # the first task on every machine: Ray starts a process for it before
    again_s: float = 0.5  # between two questions which machines are there
    ending_s: float = (
        2.0  # in one wait for a try to end, between which Ctrl-C and a dead head are noticed
    )
    head_s: float = (
        10.0  # for a head that stopped answering; Ray itself would end this process after 60 s
    )
    cancel_s: float = 10.0  # tasks that are cancelled


WAITS = WaitSettings()


def unshared(host: str, root: str) -> str:
    """The words of an error about a machine that does not see the files in `root`."""
    return (
        f"the machine {host} does not see the files of this one in {root}; put ROOT on a disk that all machines have "
        "under the same path (NFS, for example)"
    )


def started_cluster() -> str:
    """HOST:PORT of the cluster that this machine is part of, as RAY_ADDRESS or `ray start` names it; "" for none."""
    named = os.environ.get("RAY_ADDRESS", "")
    noted = Path(os.environ.get("RAY_TMPDIR", "/tmp"), "ray", "ray_current_cluster")
    return named if named or not noted.is_file() else noted.read_text().strip()


def connect(name: str, workers: int | None) -> None:
    """Connect this process to the cluster of this name, or start one. Raises SettingsError: see `ray_executor`."""
    import ray

    options: dict[str, Any] = {"logging_level": "ERROR", "log_to_driver": False}
    try:
        if name.startswith(SCHEME):
            _demand_reachable(name)
            with warnings.catch_warnings(action="ignore"):  # of what the error states
                _connect_client(lambda: ray.init(address=name, **options))
        elif address := started_cluster():
            _demand_listening(name, address)
            ray.init(address=address, **options)
        else:
            ray.init(address="local", num_cpus=workers, include_dashboard=False, **options)
    except ray.exceptions.AuthenticationError as error:
        raise SettingsError(
            f"--executor {name}: the cluster needs another token; set RAY_AUTH_MODE=token and RAY_AUTH_TOKEN_PATH to "
            "the file of the token that it was started with"
        ) from error
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise SettingsError(f"--executor {name}: {why_not(name, error)}") from error


def _connect_client(connect: Callable[[], object]) -> None:
    """Connect, again and again while a head that has just started cannot serve a client yet."""
    end_s = time.monotonic() + WAITS.start_s
    while True:
        try:
            connect()
            return
        except ConnectionError as error:
            if _UNREADY not in str(error) or time.monotonic() > end_s:
                raise
            time.sleep(WAITS.again_s)


def why_not(name: str, error: Exception) -> str:
    """What Ray's error about a connection means, and what to do."""
    import ray

    words = first_line(error)
    if "ersion" in str(error):
        both = " ".join(str(error).split())[:300]
        return (
            "the cluster has another version of Ray or Python than this machine; install the same ones on all machines "
            f"(here Ray {ray.__version__}; {both})"
        )
    if "oken" in str(error) or "nauthenticated" in str(error):
        return f"the cluster needs another token: {words}; set RAY_AUTH_MODE=token and RAY_AUTH_TOKEN_PATH"
    if _UNREADY in str(error):
        return (
            f"the cluster's head answers, but started nothing to serve this batch within {WAITS.start_s:.0f} s; it is "
            "too busy, has just lost a machine, or is short of memory: look at its log (ray_client_server.err in "
            "/tmp/ray/session_latest/logs there), or try again in a minute"
        )
    if name.startswith(SCHEME):
        return (
            f"what listens there accepts no Ray client ({words}): a cluster with a token (set RAY_AUTH_MODE=token and "
            "RAY_AUTH_TOKEN_PATH), one that is too busy (try again in a minute), or no Ray"
        )
    return f"no Ray cluster answers: {words}"


def _demand_reachable(name: str) -> None:
    """Raise SettingsError within seconds where no gRPC answers at ray://HOST:PORT; Ray itself waits for minutes."""
    import grpc

    address = name.removeprefix(SCHEME)
    host, colon, port = address.rpartition(":")
    if not (host and colon and port.isdecimal()):
        raise SettingsError(
            f"--executor {name}: give ray://HOST:PORT, such as ray://192.168.1.10:10001"
        )
    _demand_listening(name, address)
    try:
        with grpc.insecure_channel(
            address
        ) as channel:  # it may be something else that listens there
            grpc.channel_ready_future(channel).result(timeout=WAITS.reach_s)
    except grpc.FutureTimeoutError:
        raise SettingsError(f"--executor {name}: {address} is not a Ray cluster") from None


def demand_head(address: str) -> None:
    """Raise ConnectionError where the head at HOST:PORT ("": not to be asked) does not listen for `head_s`.

    Ray waits for a head that died, whatever is asked of it, and ends the process after 60 s with words of its own.
    """
    if not address:
        return
    end_s = time.monotonic() + WAITS.head_s
    while True:
        try:
            _reach(address)
            return
        except OSError as error:
            if time.monotonic() > end_s:
                raise ConnectionError(
                    f"its head at {address} does not answer: {first_line(error)}"
                ) from error
            time.sleep(WAITS.again_s)


def _reach(address: str) -> None:
    """Connect to HOST:PORT and hang up. Raises OSError where nothing listens, ValueError for what is no address."""
    host, _, port = address.rpartition(":")
    socket.create_connection((host.strip("[]"), int(port)), timeout=WAITS.reach_s).close()


def _demand_listening(name: str, address: str) -> None:
    """Raise SettingsError where nothing listens at HOST:PORT."""
    try:
        _reach(address)
    except (OSError, OverflowError, ValueError) as error:
        port = address.rpartition(":")[2]
        how = (
            f"start one on that machine: ray start --head --ray-client-server-port {port}"
            if name.startswith(SCHEME)
            else "`ray start` noted it, or RAY_ADDRESS names it: `ray stop` forgets one that is gone"
        )
        raise SettingsError(
            f"--executor {name}: no Ray cluster answers at {address} ({first_line(error)}); {how} (docs/batch.md)"
        ) from None


def check_machines(root: Path) -> None:
    """Have each machine read what is written here, and answer beside it. Raises SettingsError, StoreError."""
    name, word = f"{TEMPORARY_PREFIX}{secrets.token_hex(6)}-probe", secrets.token_hex(16)
    path = root.resolve() / name
    atomic_write_bytes(path, word.encode())
    try:
        answers = _answers_of_machines(str(path), word)
        for host, version, sees in answers:
            demand_same(host, version)
            if not sees or not (root / f"{name}-{host}").is_file():
                raise StoreError(unshared(host, str(root.resolve())))
    finally:
        path.unlink(missing_ok=True)
        for left in root.glob(f"{name}-*"):
            left.unlink(missing_ok=True)
    if not answers:
        raise SettingsError("the cluster has no machine with a core")


def _answers_of_machines(path: str, word: str) -> list[tuple[str, str, bool]]:
    """What the probe finds on each machine that stays. Raises SettingsError where one runs no tasks.

    A machine that has just joined, or just died, is known to some of Ray's processes and not yet to others: a probe
    that could not be placed is placed again while the machine is there.
    """
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    probe: Any = ray.remote(probe_of(path, word))
    end_s, answers = time.monotonic() + WAITS.probe_s, []
    waiting = {each["NodeID"] for each in working_machines(ray)}
    while waiting:
        asked = {
            node: probe.options(
                num_cpus=0,
                max_retries=0,
                scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=False),
            ).remote()
            for node in waiting
        }
        for node, task in asked.items():
            try:
                answers.append(ray.get(task, timeout=max(0.0, end_s - time.monotonic())))
                waiting.remove(node)
            except _passing(ray) as error:
                if time.monotonic() > end_s:
                    raise _no_tasks(error) from error
            except ray.exceptions.RayError as error:
                raise _no_tasks(error) from error
        if waiting:
            time.sleep(WAITS.again_s)
            waiting &= {each["NodeID"] for each in working_machines(ray)}
    return answers


def _passing(ray: Any) -> tuple[type[Exception], ...]:
    """What Ray raises where a machine was not known yet, or is no longer there."""
    errors = ray.exceptions
    return (errors.TaskUnschedulableError, errors.WorkerCrashedError, errors.NodeDiedError)


def _no_tasks(error: Exception) -> SettingsError:
    return SettingsError(f"a machine of the cluster does not run tasks: {first_line(error)}")


def working_machines(ray: Any) -> list[dict[str, Any]]:
    """The machines of the cluster that are there and have a core."""
    return [each for each in ray.nodes() if each["Alive"] and each["Resources"].get("CPU", 0) > 0]


def demand_same(host: str, version: str) -> None:
    """Raise SettingsError where a machine has another Sorvolo, or none ("")."""
    if version != sorvolo.__version__:
        has = f"Sorvolo {version}" if version else "no Sorvolo"
        raise SettingsError(
            f"the machine {host} has {has}, this one {sorvolo.__version__}; install the same one on all machines"
        )


def probe_of(path: str, word: str) -> Any:
    """A function that travels whole, as a machine may not have this module: its host, its Sorvolo, whether it sees."""

    def probe() -> tuple[str, str, bool]:
        import socket

        host = socket.gethostname()
        try:
            import sorvolo

            version = sorvolo.__version__
        except ImportError:
            version = ""
        try:
            with open(path) as file:
                sees = file.read() == word
            with open(f"{path}-{host}", "w") as file:
                file.write(word)
        except OSError:
            sees = False
        return host, version, sees

    return probe


def first_line(error: Exception) -> str:
    """The first line of an error's words."""
    lines = [line.strip() for line in str(error).split("\n") if line.strip()]
    return (lines or [type(error).__name__])[0][:300]


def kill_process(ray: Any, node: str, pid: int) -> None:
    """Have a machine kill a process of Ray's there that hangs, as Ray's own wishes reach only what still listens."""
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    def kill() -> None:  # travels whole, as `probe_of`
        import os
        import signal
        from contextlib import suppress

        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)

    place = NodeAffinitySchedulingStrategy(node, soft=False)
    ray.remote(kill).options(num_cpus=0, max_retries=0, scheduling_strategy=place).remote()

"""The command as people meet it: exit codes, one line for an error, pure JSON, help with an example."""

import errno
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import sorvolo
from sorvolo.build import build
from sorvolo.cli import main as cli
from sorvolo.errors import InputError
from sorvolo.missions.map.flights import map_flights

_COMMANDS = ("inspect", "plan", "map", "simulate", "evaluate", "calibrate", "demo")


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"sorvolo {build()}\n"


def test_module_is_the_command() -> None:
    command = [sys.executable, "-m", "sorvolo", "--version"]
    run = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (run.returncode, run.stdout, run.stderr) == (0, f"sorvolo {build()}\n", "")


@pytest.mark.parametrize(("wished", "threads"), [(None, "1"), ("3", "3")])
def test_linear_algebra_has_one_thread_unless_wished_otherwise(
    wished: str | None, threads: str
) -> None:
    """SciPy is asked what it runs with, as NumPy's own library has no word for it."""
    environment = {
        name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"
    }
    asked = (
        "import ctypes, pathlib\nfrom sorvolo.cli.main import main\nmain(['--version'])\nimport scipy, scipy.linalg\n"
        "library = next((pathlib.Path(scipy.__file__).parent.parent / 'scipy.libs').glob('*openblas*'))\n"
        "print(ctypes.CDLL(str(library)).scipy_openblas_get_num_threads())"
    )
    done = subprocess.run(
        [sys.executable, "-c", asked],
        env=environment | ({"OPENBLAS_NUM_THREADS": wished} if wished else {}),
        capture_output=True,
        text=True,
        check=False,
    )
    if "StopIteration" in done.stderr or "undefined symbol" in done.stderr:
        pytest.skip("SciPy runs on another library than OpenBLAS")
    assert done.stdout.splitlines()[-1:] == [str(min(int(threads), os.cpu_count() or 1))], (
        done.stderr
    )


def test_missing_kernels_are_one_line() -> None:
    """A person reads one error with its remedy, without Python's own words."""
    program = (
        "import sys; sys.modules['sorvolo.kernels._native'] = None\n"
        "from sorvolo.cli.main import main\n"
        "sys.exit(main(['compare', 'no-such-video.mp4', '--site', 'no-such-site']))"
    )
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False
    )
    (line,) = run.stderr.splitlines()
    assert line.startswith("error: the compiled kernels are missing")
    assert "from a wheel" in line and "C++17 compiler" in line
    assert run.returncode == 1


_STRUCK = """
import sorvolo.cli.main
def main():
    try:
        exec("raise KeyboardInterrupt")
    except KeyboardInterrupt:
        return 130
sorvolo.cli.main.main = main
"""


def test_module_returns_its_code_wherever_ctrl_c_strikes(tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(_STRUCK)
    command, environment = (
        [sys.executable, "-m", "sorvolo"],
        {**os.environ, "PYTHONPATH": str(tmp_path)},
    )
    assert subprocess.run(command, env=environment, timeout=60, check=False).returncode == 130


_STRUCK_IN_A_CLEAN_UP = """
import time, typer, sorvolo.cli.main
class Struck:
    def __del__(self):
        raise KeyboardInterrupt
def work():
    Struck()
    time.sleep(30)
sorvolo.cli.main.app = typer.Typer(add_completion=False)
sorvolo.cli.main.app.command()(work)
"""


def test_ctrl_c_is_not_lost_where_python_can_raise_nothing(tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(_STRUCK_IN_A_CLEAN_UP)
    command, environment = (
        [sys.executable, "-m", "sorvolo"],
        {**os.environ, "PYTHONPATH": str(tmp_path)},
    )
    run = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert run.returncode == 130
    assert run.stderr.startswith("stopped; ") and "Exception ignored" not in run.stderr


@pytest.mark.parametrize("command", [*_COMMANDS[:4], "evaluate mosaic", *_COMMANDS[5:]])
def test_help_has_an_example(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*command.split(), "--help"]) == 0
    example = capsys.readouterr().out.split("Example", 1)[1]
    assert f"sorvolo {command}" in " ".join(example.replace("│", " ").split())


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--help"]) == 0
    words = capsys.readouterr().out.split()
    assert all(command in words for command in _COMMANDS)


@pytest.mark.parametrize(
    "arguments",
    [["nonsense"], ["map"], ["map", "x.mp4"], ["map", "x", "--site", "y", "--gsd", "z"]],
)
def test_wrong_usage_is_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and "Usage" in printed.err


@pytest.mark.parametrize(
    "arguments",
    [
        ["inspect", "{gone}"],
        ["map", "{gone}", "--site", "{made}", "--model", "none"],
        ["watch", "{gone}"],
        ["compare", "{gone}", "--site", "{made}"],
        ["simulate", "{file}"],
        ["simulate", "{file}", "--pictures", "2"],
        ["simulate", "{file}", "--pictures", "2", "--json"],
    ],
)
def test_an_error_is_one_line_on_stderr(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = {"gone": tmp_path / "gone.mp4", "made": tmp_path / "made", "file": tmp_path / "file"}
    names["file"].touch()
    assert cli.main([each.format(**names) for each in arguments]) == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("error: ") and any(
        str(path) in printed.err for path in names.values()
    )
    assert printed.err.count("\n") == 1 and "Traceback" not in printed.err


def test_nothing_is_left_of_a_map_that_could_not_begin(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["map", str(tmp_path / "gone.mp4"), "--site", str(tmp_path / "site")]) == 1
    assert "error: " in capsys.readouterr().err
    assert not (tmp_path / "site").exists()


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--gsd", "-1", "(--gsd) must lie in 1e-4 to 100 m, got -1.0"),
        ("--offset", "1e9", "(--offset) must be 20 years of seconds at most, got 1000000000.0"),
        ("--ground-elevation", "nan", "--ground-elevation must lie in -1000 to 9000 m, got nan"),
    ],
)
def test_settings_out_of_range_are_errors(
    option: str, value: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["map", str(tmp_path), "--site", str(tmp_path / "site"), option, value]) == 1
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--height", "nan", "the flight height must be positive, got nan m"),
        ("--critical-m", "nan", "the critical dimension must be positive, got nan m"),
        ("--bearing", "nan", "--bearing nan: give degrees from north"),
        ("--size", "9" * 400 + "x9", "give width x height in pixels"),
    ],
)
def test_a_plan_takes_no_number_that_is_none_as_not_given(
    option: str, value: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["plan", "--camera", "aov=70", option, value]) == 1
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    "command",
    [
        "watch x.mp4",
        "map x.mp4 --site SITE",
        "compare x.mp4 --site SITE",
        "search x.mp4 --site SITE",
        "train x --out SITE",
        "evaluate detector default x",
    ],
)
@pytest.mark.parametrize("empty", ["", " ,"])
def test_classes_that_name_none_are_an_error(
    command: str, empty: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As of a variable of a shell that is not set; nothing is searched for all classes then."""
    site = tmp_path / "site"
    words = [str(site) if word == "SITE" else word for word in command.split()]
    assert cli.main([*words, "--classes", empty]) == 1
    assert f"--classes {empty!r} names no class" in " ".join(capsys.readouterr().err.split())
    assert not site.exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--thermal", "0.3"], "give their number with --pictures"),
        (["--ground", "urbn"], "none of dirt, countryside"),
        (
            ["--pictures", "3", "--preset", "survey", "--strips", "5"],
            "leave out --preset, --strips",
        ),
        (["--pictures", "3", "--relief", "0"], "leave out --relief"),
        (["--pictures", "3", "--ground", "."], "leave out --ground ."),
    ],
)
def test_simulate_leaves_no_option_unheard(
    options: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["simulate", str(tmp_path / "made"), *options]) == 1
    assert words in capsys.readouterr().err
    assert not (tmp_path / "made").exists()


def test_a_plan_names_where_it_lies(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Longitude before latitude planned a flight in another country without a word."""
    for order, place in ((slice(None), "41.890500, 12.600500"), (slice(None, None, -1), "12.6005")):
        corners = [("41.890", "12.600"), ("41.891", "12.600"), ("41.891", "12.601")]
        corners.append(("41.890", "12.601"))
        (tmp_path / "area.txt").write_text("".join(f"{' '.join(c[order])}\n" for c in corners))
        area = str(tmp_path / "area.txt")
        assert cli.main(["plan", "--camera", "aov=62", "--area", area]) == 0
        assert place in capsys.readouterr().out


def test_json_is_pure(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["plan", "--camera", "aov=62", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["height_m"] > 0


class TestFailures:
    """A command that fails on purpose, through the one catcher."""

    @pytest.fixture(autouse=True)
    def _command(self, monkeypatch: pytest.MonkeyPatch) -> None:
        failing = cli.typer.Typer(pretty_exceptions_enable=False)
        failing.callback()(cli.options)
        failing.command("fail")(self._fail)
        failing.command("other")(self._fail)
        monkeypatch.setattr(cli, "app", failing)

    error: BaseException = RuntimeError("boom")

    @classmethod
    def _fail(cls) -> None:
        raise cls.error

    def _printed(
        self, error: BaseException, capsys: pytest.CaptureFixture[str], *options: str
    ) -> tuple[int, str]:
        type(self).error = error
        code = cli.main([*options, "fail"])
        printed = capsys.readouterr()
        assert printed.out == ""
        return code, printed.err

    def test_ours(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert self._printed(InputError("no\nsuch  thing"), capsys) == (1, "error: no such thing\n")

    def test_full_disk(self, capsys: pytest.CaptureFixture[str]) -> None:
        code, printed = self._printed(
            OSError(errno.ENOSPC, "No space left", "/full/tile.png"), capsys
        )
        assert (
            code == 1
            and "disk is full" in printed
            and "/full/tile.png" in printed
            and printed.count("\n") == 1
        )

    def test_forbidden(self, capsys: pytest.CaptureFixture[str]) -> None:
        code, printed = self._printed(
            PermissionError(errno.EACCES, "Permission denied", "/locked"), capsys
        )
        assert code == 1 and printed.startswith("error: /locked: Permission denied")

    def test_out_of_memory(self, capsys: pytest.CaptureFixture[str]) -> None:
        code, printed = self._printed(MemoryError(), capsys)
        assert code == 1 and "memory" in printed and "bug" not in printed

    def test_bug(self, capsys: pytest.CaptureFixture[str]) -> None:
        code, printed = self._printed(KeyError("oops"), capsys)
        assert code == 1 and "bug" in printed and "KeyError" in printed and "--debug" in printed
        assert printed.count("\n") == 1

    def test_debug_shows_where(self, capsys: pytest.CaptureFixture[str]) -> None:
        code, printed = self._printed(KeyError("oops"), capsys, "--debug")
        assert code == 1 and "Traceback" in printed and "_fail" in printed

    def test_stopped(self, capsys: pytest.CaptureFixture[str]) -> None:
        code, printed = self._printed(KeyboardInterrupt(), capsys)
        assert (
            code == 130
            and printed
            == "stopped; unfinished work was discarded, everything before it is unchanged\n"
        )


def test_import_is_quick_and_lazy() -> None:
    heavy = ("numpy", "cv2", "scipy", "rasterio")
    code = f"import sys, sorvolo; sys.exit(any(name in sys.modules for name in {heavy}))"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 0


@pytest.mark.parametrize("name", sorted(sorvolo.__all__))
def test_public_names_are_there(name: str) -> None:
    assert getattr(sorvolo, name) is not None


def test_public_names_are_the_missions() -> None:
    assert sorvolo.map_flights is map_flights
    assert set(sorvolo.__all__) <= set(dir(sorvolo))
    with pytest.raises(AttributeError, match="no_such"):
        _ = sorvolo.no_such


def test_a_file_gives_options_and_a_name_that_is_none_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "sorvolo.toml"
    config.write_text('[plan]\njson = true\nspeed = 4.0\n[measure.volume]\nflight = "one"\n')
    command = ["--quiet", "--config", str(config), "plan", "--camera", "Mavic 2 Pro"]
    assert cli.main(command) == 0
    assert json.loads(capsys.readouterr().out)["minimum_frame_rate_hz"] == pytest.approx(
        0.155, abs=1e-3
    )
    assert cli.main([*command, "--speed", "6"]) == 0
    assert json.loads(capsys.readouterr().out)["minimum_frame_rate_hz"] == pytest.approx(
        0.233, abs=1e-3
    )
    for text, words in (
        ("[plan]\nsped = 4\n", "[plan] there is no 'sped'; there are"),
        ("[plant]\n", "there is no 'plant'; there are archive, batch,"),
        ("plan = 4\n", "[plan] is no table of options, but 4"),
        ("[plan]\nspeed = true\n", "[plan] speed takes a value, not true"),
        ("[plan\n", "no TOML file that can be read"),
    ):
        config.write_text(text)
        assert cli.main(command) == 1
        assert words in capsys.readouterr().err


@pytest.mark.parametrize("command", [["watch"], ["map", "--site", "s"], ["search", "--site", "s"]])
def test_an_input_that_is_not_there_is_refused_before_a_model_is_loaded(
    command: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main([*command, "typo.mp4", "--model", "no-such.onnx"]) == 1
    assert "no such file or folder: typo.mp4" in capsys.readouterr().err


def test_verbose_logs_to_stderr_and_only_where_it_is_asked_for(
    capsys: pytest.CaptureFixture[str],
) -> None:
    secret = ["map", "rtsp://me:hidden@127.0.0.1:1/x", "--site", "s", "--model", "no-such.onnx"]
    assert cli.main(["--verbose", *secret]) == 1
    shown = capsys.readouterr().err
    assert re.search(r"^\d{4}-.* INFO sorvolo\.missions: map_flights begins$", shown, re.M)
    assert "hidden" not in shown
    assert cli.main(secret) == 1
    assert "INFO" not in capsys.readouterr().err

"""Progress where no terminal shows a bar, as in a log file."""

from io import StringIO

import typer
from rich.console import Console
from typer.testing import CliRunner

from sorvolo.cli.main import options
from sorvolo.cli.progress import ProgressReport, Resumed


class _Clock:
    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def test_a_log_gets_a_line_every_ten_seconds() -> None:
    out, clock = StringIO(), _Clock()
    with ProgressReport(Console(file=out, width=120), clock=clock) as progress:
        for frame in range(1, 101):
            clock.now_s += 0.25
            progress.show("mapping, frame", frame, 1500, "4.0 frames/s, 7 of 8 frames matched")
    assert out.getvalue().splitlines() == [
        "mapping, frame 40 of 1,500, 4.0 frames/s, 7 of 8 frames matched",
        "mapping, frame 80 of 1,500, 4.0 frames/s, 7 of 8 frames matched",
    ]


def test_what_is_quick_leaves_nothing_in_a_log() -> None:
    out, clock = StringIO(), _Clock()
    with ProgressReport(Console(file=out), clock=clock) as progress:
        progress.show("opening")
        clock.now_s = 9.0
        progress.show("mapping, frame", 3, 10)
    assert out.getvalue() == ""


def test_a_quiet_command_shows_none() -> None:
    out, app = StringIO(), typer.Typer()
    app.callback()(options)

    @app.command()
    def work() -> None:
        clock = _Clock()
        with ProgressReport(Console(file=out), clock=clock) as progress:
            clock.now_s = 20.0
            progress.show("mapping")

    assert CliRunner().invoke(app, ["--quiet", "work"]).exit_code == 0 and out.getvalue() == ""
    assert CliRunner().invoke(app, ["work"]).exit_code == 0 and out.getvalue() == "mapping\n"


def test_a_terminal_gets_a_bar() -> None:
    out = StringIO()
    with ProgressReport(Console(file=out, force_terminal=True, width=120), stays=True) as progress:
        progress.show("mapping, frame", 3, 10, "7 of 8 frames matched")
    assert "mapping, frame" in out.getvalue() and "7 of 8 frames matched" in out.getvalue()


def _resumed(*are_resumed: bool) -> list[str]:
    out = StringIO()
    resumed = Resumed(Console(file=out, width=120))
    for count, is_resumed in enumerate(are_resumed, start=1):
        resumed.take(count, is_resumed=is_resumed)
    resumed.end()
    return out.getvalue().splitlines()


def test_a_run_that_goes_on_is_announced_once_also_where_no_frame_was_left() -> None:
    assert _resumed(True, True, False, False) == ["continuing after 2 frames of a stopped run"]
    assert _resumed(True, True) == ["continued after all 2 frames of a stopped run"]
    assert _resumed(False, False) == []

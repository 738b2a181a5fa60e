"""What the printer shows of stages that go on side by side."""

import io
import sys
import time
from types import ModuleType

import pytest
from rich.console import Console

from roboxim_cli import progress
from roboxim_cli.printer import EventPrinter
from roboxim_cli.progress import Bars, ProgressLine
from roboxim_ros.testing import PATIENCE_S
from roboxim_runs.events import Notice, StageFinished, StageProgress, StageStarted


def test_each_line_of_a_log_names_its_stage(capsys, monkeypatch):
    monkeypatch.delenv("ROBOXIM_EVENTS", raising=False)
    monkeypatch.setattr(progress, "LINE_PERIOD_S", -1.0)
    with EventPrinter() as printer:
        for name in "ab":
            printer(StageStarted(title=f"training {name}", total=50, unit="steps", name=name))
        printer(StageProgress(done=20, total=50, note="loss 0.2", name="b"))
        printer(StageProgress(done=10, total=50, note="loss 0.1", name="a"))
        printer(StageFinished(name="b"))
        printer(Notice(text="b has ended"))
        printer(StageProgress(done=50, total=50, name="a"))
        printer(StageFinished(name="a"))
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == ["training a: 50 steps; starting", "training b: 50 steps; starting"], "said at once"
    lines = lines[2:]
    assert [line.partition(" after")[0] for line in lines] == [
        "training b: 20 of 50 steps", "training a: 10 of 50 steps", "b has ended", "training a: 50 of 50 steps",
    ]  # fmt: skip
    assert lines[0].endswith("loss 0.2")


def test_a_long_step_is_named_while_it_runs(capsys, monkeypatch):
    monkeypatch.setattr(progress, "LINE_PERIOD_S", 0.2)
    said = ""
    with ProgressLine("importing", 3, unit="meshes") as line:
        line.update(0, "duck: cutting it into convex parts")
        until = time.monotonic() + PATIENCE_S
        while "convex parts" not in said and time.monotonic() < until:
            time.sleep(0.05)
            said += capsys.readouterr().out
    assert "importing: 0 of 3 meshes after" in said
    assert "duck: cutting it into convex parts" in said


@pytest.mark.parametrize("text", ["[red] is no style here", "loss [/0.1]"])
def test_bars_of_a_terminal_stand_below_each_other(text):
    screen = io.StringIO()
    bars = Bars(Console(file=screen, force_terminal=True, width=150, legacy_windows=False))
    first, second = (bars.add(f"training {name}", 50, 0, "steps") for name in "ab")
    bars.update(first, 10, 50, text, "2/s")
    bars.say("above them")
    bars.end(first)
    start = screen.tell()
    bars.update(second, 50, 50, "", "")
    bars.end(second)
    shown, rest = screen.getvalue()[:start], screen.getvalue()[start:]
    assert text in shown
    assert "above them" in shown
    assert "training b" in rest
    assert "training a" not in rest, "its last state stays above, and is not drawn again"
    bars.end(bars.add("training c", 50, 0, "steps"))
    assert "training c" in screen.getvalue()


def test_a_notebook_draws_one_display_again(monkeypatch):
    drawn = []

    class Handle:
        def update(self, shown):
            drawn.append(shown)

    def display(shown, display_id):
        assert display_id
        drawn.append(shown)
        return Handle()

    kernel = ModuleType("IPython.display")
    kernel.HTML, kernel.display = str, display
    for name, module in (("ipykernel", ModuleType("ipykernel")), ("IPython", kernel), ("IPython.display", kernel)):
        monkeypatch.setitem(sys.modules, name, module)
    with EventPrinter() as printer:
        printer(StageStarted(title="rollouts of <b>", total=4))
        assert "0 of 4; starting" in drawn[0]
        printer(StageProgress(done=2, total=4, note="1 of 2 succeeded"))
        printer(StageFinished())
    assert '<progress value="2" max="4">' in drawn[-1]
    assert "rollouts of &lt;b&gt;; 2 of 4" in drawn[-1]

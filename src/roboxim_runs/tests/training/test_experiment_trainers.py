"""Trainers of an experiment that stand in files, and the servers of their checkpoints."""

import socket
import sys

import pytest

from roboxim_core.errors import ConfigError, RoboximError
from roboxim_eval.experiments.card_checks import check_card
from roboxim_runs.executors import InlineExecutor
from roboxim_runs.experiments.run import run_experiment
from roboxim_runs.experiments.trained.servers import Server, require_reachable

SCRIPT = """
import os, socket, sys
mode, folder, port = sys.argv[1], sys.argv[2], int(sys.argv[3])
if mode == "train":
    os.makedirs(folder, exist_ok=True)
    open(folder + "/weights", "w").write(sys.argv[4])
elif mode == "serve":
    print("loading", open(folder + "/weights").read(), flush=True)
    open(folder + "/served", "a").write("x")
    with socket.create_server(("127.0.0.1", port)) as listening:
        while True:
            listening.accept()[0].close()
"""
LEROBOT = """
dataset: {{format: lerobot, version: "2.1", columns: openpi, image_width: 64, image_height: 64, convention: ''}}
command: "{python} {script} train {{out}} 0 '{{dataset}} {{seed}}'"
policy: openpi
options: {{url: "ws://127.0.0.1:{port}", convention: "{{convention}}", version: "{{condition}}.{{replicate}}"}}
serve: "{python} {script} serve {{checkpoint}} {port}"
"""


@pytest.fixture
def lerobot_trainer(tmp_path):
    """Return the file of a trainer whose script reads LeRobot datasets, and whose checkpoints a server holds."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    file = tmp_path / "mine_too.yaml"
    file.write_text(LEROBOT.format(python=sys.executable, script=script, port=port))
    return file, port


@pytest.mark.thorough
def test_a_trainer_of_a_file_gets_its_format_and_its_policy_its_checkpoint(
    fakes, config, experiment, lerobot_trainer, tmp_path
):
    file, port = lerobot_trainer
    one = experiment.replace("count: 3", "count: 1")
    result = run_experiment(config(one, trainer=str(file)))
    form, written = fakes.exports["leave_out.0"]
    assert form == "lerobot"
    assert (written.version, written.columns, written.image_width, written.val_fraction) == ("2.1", "openpi", 64, 0.0)
    out = tmp_path / "out"
    assert (out / "train/baseline.0/weights").read_text() == f"{out}/export/baseline.0 0"
    options = fakes.policies["leave_out.0"].options
    assert options["convention"] == f"{out}/export/leave_out.0/convention.yaml", "what the policy was trained with"
    assert (options["url"], options["version"]) == (f"ws://127.0.0.1:{port}", "leave_out.0")
    assert fakes.policies["blind.0"].options["version"] == "leave_out.0", "the same checkpoint"
    assert fakes.policies["blind.0"].options["policy"] == "openpi"
    assert (out / "train/leave_out.0/served").read_text() == "xx", "for leave_out and for blind"
    assert "loading" in (out / "evaluate/leave_out.0.server.log").read_text()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port))
    assert result.card.experiment.trainer == "mine_too"
    assert result.card.experiment.config.trainers["mine_too"].steps == 7, "those of the experiment's first trainer"
    file.unlink()
    assert check_card(result.card.plain) == result.card, "the card holds the trainer"


@pytest.mark.thorough
def test_a_server_of_something_else_is_not_measured(fakes, config, lerobot_trainer, tmp_path):
    file, port = lerobot_trainer
    with socket.create_server(("127.0.0.1", port)), pytest.raises(RoboximError, match="answers at .* already"):
        run_experiment(config(trainer=str(file)))
    file.write_text(file.read_text().replace(" serve {checkpoint}", " serve {checkpoint}/no"))
    with pytest.raises(RoboximError, match=r"(?s)ended with exit code 1 at ws://.*server.log:.*FileNotFoundError"):
        run_experiment(config(trainer=str(file), out=tmp_path / "other"))


class ExecutorOfManyMachines(InlineExecutor):
    elsewhere = True


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "[::1]", "0.0.0.0", "[::ffff:127.0.0.1]"])
def test_a_server_that_other_machines_cannot_reach_is_refused_before_anything_starts(
    fakes, config, lerobot_trainer, tmp_path, host
):
    file, _ = lerobot_trainer
    file.write_text(file.read_text().replace("ws://127.0.0.1", f"ws://{host}"))
    with pytest.raises(ConfigError, match=r"options.url: .* cannot reach ws://.*; write this machine's address"):
        run_experiment(config(trainer=str(file)), executor=ExecutorOfManyMachines())
    assert not (tmp_path / "out").exists()
    require_reachable([None, Server(words=("serve",), url="ws://10.1.2.3:8000")], ExecutorOfManyMachines())
    require_reachable([Server(words=("serve",), url="ws://127.0.0.1:8000")], InlineExecutor())


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("format: lerobot", "format: lerobt", "mine_too.dataset: no format 'lerobt'.*did you mean 'lerobot'"),
        ("columns:", "colums:", "mine_too.dataset.*colums.*did you mean 'columns'"),
        ("columns: openpi", "per_cell: 3", "the experiment decides about 'per_cell'"),
        ("convention: ''", "actions: tool, convention: libero", "leave out .*actions"),
        ("command:", "comand:", "comand.*did you mean 'command'"),
        ("{checkpoint} ", "here ", "serve: needs {checkpoint}"),
        ('"{convention}"', '"{conventoin}"', "options: unknown placeholder 'conventoin'.*{convention}"),
        ("policy: openpi", "policy: opnpi", "opnpi.*did you mean 'openpi'"),
        ('version: "{condition}', 'verson: "{condition}', "'verson' is unknown.*version"),
        ("url:", "address:", "needs options.url"),
    ],
)
def test_a_wrong_trainer_is_refused_before_anything_runs(fakes, config, lerobot_trainer, old, new, said):
    file, _ = lerobot_trainer
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(ConfigError, match=f"(?s){said}"):
        run_experiment(config(trainer=str(file)))
    assert fakes.calls == []
    with pytest.raises(ConfigError, match="no trainer 'min' in the experiment or in config/trainers.*'mine'"):
        run_experiment(config(trainer="min"))

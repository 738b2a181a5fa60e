"""The commands against a small graph in this process."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys

import click
import pytest
import yaml
from click.testing import CliRunner
from control_msgs.action import GripperCommand
from rcl_interfaces.msg import IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.action import ActionServer
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from roboxim_interfaces.srv import Tick
from simulation_interfaces.msg import Result
from simulation_interfaces.srv import DeleteEntity
from std_msgs.msg import String
from std_srvs.srv import SetBool

from roboxim_bringup import doctor
from roboxim_cli.graph_names import complete
from roboxim_cli.main import group, main
from roboxim_cli.ros import topic
from roboxim_core.errors import ConfigError, RequestTimeoutError, RoboximError, SimError
from roboxim_ros import qos
from roboxim_ros.host import NodeHost
from roboxim_ros.runs import free_domain, register_run
from roboxim_ros.testing import PATIENCE_S, eventually
from roboxim_sim.rendering import RendererStatus

ISOLATED = """
import sys
from roboxim_bringup import doctor
from roboxim_cli.main import group
from roboxim_cli.graph_names import complete
from roboxim_cli.ros import topic
try:
    group.main({arguments!r}, standalone_mode=False)
finally:
    heavy = {{"rclpy", "numpy", "pybullet", "pinocchio", "jax", "yaml"}} & set(sys.modules)
    assert not heavy, heavy
"""


@pytest.mark.parametrize("end", [click.exceptions.Exit(3), SystemExit(3)])
def test_a_commands_exit_code_is_that_of_the_process(end, monkeypatch):
    """Without its standalone mode click returns an Exit's code, and the process would end with 0."""

    def ends(**_):
        raise end

    handler = signal.getsignal(signal.SIGTERM)
    for arguments in (["completion", "bash"], ["policy", "list"]):
        command = group.get_command(click.Context(group), arguments[0])
        command = command.commands[arguments[1]] if isinstance(command, click.Group) else command
        monkeypatch.setattr(command, "callback", ends)
        monkeypatch.setattr(sys, "argv", ["roboxim", *arguments])
        try:
            with pytest.raises(SystemExit) as caught:
                main()
        finally:
            signal.signal(signal.SIGTERM, handler)
        assert caught.value.code == 3, arguments


class SmallNode(Node):
    """One of everything."""

    def __init__(self, context) -> None:
        super().__init__("small", context=context)
        self.declare_parameter("count", 3, ParameterDescriptor(
            description="How many.", integer_range=[IntegerRange(from_value=1, to_value=9)]
        ))  # fmt: skip
        self.declare_parameter("name", "x", ParameterDescriptor(read_only=True))
        self.add_on_set_parameters_callback(lambda _: SetParametersResult(successful=True))
        self.create_service(SetBool, "flip", self._flip)
        self.create_service(Tick, "tick", self._tick)
        self.create_service(DeleteEntity, "delete_entity", self._delete)
        self.latched = self.create_publisher(String, "greeting", qos.LATCHED)
        self.latched.publish(String(data="hello"))
        self.steady = self.create_publisher(String, "steady", qos.EVENTS)
        self.hasty = self.create_publisher(
            String, "hasty", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        )
        self.create_timer(0.02, lambda: [one.publish(String(data="tick")) for one in (self.steady, self.hasty)])
        self.idle = self.create_publisher(String, "idle", qos.EVENTS)
        self.heard: list[str] = []
        self.create_subscription(String, "ear", lambda msg: self.heard.append(msg.data), qos.EVENTS)
        self.action = ActionServer(self, GripperCommand, "grip", self._grip, result_timeout=10)

    def _flip(self, request, response):
        response.success = not request.data
        return response

    def _tick(self, request, response):
        response.error_code, response.error_msg = 303, "wrong seq; expected 4"
        return response

    def _delete(self, request, response):
        response.result.result, response.result.error_message = Result.RESULT_NOT_FOUND, "no entity 'ghost'"
        if request.entity != "ghost":
            response.result.result = Result.RESULT_OK
        return response

    def _grip(self, goal):
        goal.publish_feedback(GripperCommand.Feedback(position=0.5))
        if goal.request.command.position < 0:
            goal.abort()
        else:
            goal.succeed()
        return GripperCommand.Result(position=goal.request.command.position)


@pytest.fixture
def small(runtime):
    with (
        free_domain() as domain,
        NodeHost(domain_id=domain) as host,
        register_run("up", domain=domain, run_id="small-run"),
    ):
        yield host.add(SmallNode)


def roboxim(*words: str) -> str:
    """Run a command in this process and return its output; its exceptions propagate."""
    result = CliRunner().invoke(group, words, standalone_mode=False, catch_exceptions=False)
    return result.stdout


def _isolated(*arguments: str) -> str:
    code = ISOLATED.format(arguments=list(arguments))
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=PATIENCE_S
    ).stdout


def test_help_lists_every_command_and_imports_nothing_heavy():
    text = _isolated("--help")
    for name in group.list_commands(None):
        assert f"  {name} " in text


@pytest.mark.parametrize("name", group.list_commands(None))
def test_every_command_has_help(name):
    command = group.get_command(None, name)
    text = roboxim(name, "--help")
    assert command.help.splitlines()[0].split(".")[0].split(",")[0] in " ".join(text.split())
    assert "\\b" not in text
    for sub_name in command.list_commands(click.Context(command)) if isinstance(command, click.Group) else ():
        sub = command.get_command(click.Context(command), sub_name)
        assert sub.help, f"{name} {sub_name} has no help"
        assert "\\b" not in sub.help
        assert not re.search("\b[^\n]", sub.help), f"{name} {sub_name}: an example stands in the line of its mark"


def test_versions():
    runner = CliRunner()
    assert runner.invoke(group, ["--version"]).output.startswith("roboxim ")
    found = json.loads(runner.invoke(group, ["--version", "--json"]).output)
    assert {"bag", "card", "bc checkpoint"} <= found["formats"].keys()
    assert "absent" not in found["packages"].values()
    wrong = runner.invoke(group, ["--json"])
    assert wrong.exit_code == 2
    assert "--version" in wrong.output


def test_completion_script_of_each_shell():
    for shell in ("bash", "zsh", "fish"):
        assert "_ROBOXIM_COMPLETE" in _isolated("completion", shell)


def test_completion_offers_commands_subcommands_and_runs(runtime):
    def complete(*words):
        environment = {
            **os.environ, "_ROBOXIM_COMPLETE": "bash_complete", "COMP_WORDS": " ".join(("roboxim", *words)),
            "COMP_CWORD": str(len(words)),
        }  # fmt: skip
        done = subprocess.run(
            [sys.executable, "-m", "roboxim_cli"], env=environment, capture_output=True, text=True, check=False
        )
        return {line.split(",")[1] for line in done.stdout.splitlines()}

    assert complete("ser") == {"service"}
    assert {"call", "list", "type"} <= complete("service", "")
    with register_run("up", domain=3, run_id="mine"):
        assert complete("env", "--run", "") == {"mine"}


def test_unknown_command_gets_a_suggestion():
    done = subprocess.run([sys.executable, "-m", "roboxim_cli", "servce"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "did you mean 'service'" in done.stderr


def test_without_a_run_the_error_says_how_to_start_one(runtime):
    with pytest.raises(ConfigError, match="roboxim up"):
        roboxim("service", "list")
    with pytest.raises(ConfigError, match="roboxim up"):
        roboxim("env")
    assert "no run" in roboxim("runs")


@pytest.mark.ros
def test_services(small):
    assert "/flip" in roboxim("service", "list").split()
    assert "/flip [std_srvs/srv/SetBool]" in roboxim("service", "list", "-t")
    assert roboxim("service", "type", "/flip").strip() == "std_srvs/srv/SetBool"
    assert roboxim("service", "find", "std_srvs/SetBool").split() == ["/flip"]
    assert yaml.safe_load(roboxim("service", "call", "/flip")) == {"success": True, "message": ""}
    assert yaml.safe_load(roboxim("service", "call", "flip", "std_srvs/srv/SetBool", "{data: true}")) == {
        "success": False,
        "message": "",
    }
    with pytest.raises(RoboximError, match="wrong seq; expected 4") as error:
        roboxim("service", "call", "/tick")
    assert error.value.code == 303


@pytest.mark.ros
def test_wrong_calls_are_explained(small):
    with pytest.raises(RoboximError, match="no service '/flop'.*did you mean '/flip'"):
        roboxim("service", "call", "/flop")
    with pytest.raises(ConfigError, match="unknown field 'date'.*data"):
        roboxim("service", "call", "/flip", "{date: true}")
    with pytest.raises(ConfigError, match="has type std_srvs/srv/SetBool, not std_srvs/srv/Empty"):
        roboxim("service", "call", "/flip", "std_srvs/srv/Empty")
    with pytest.raises(ConfigError, match="(?s)no live run 'other'.*small-run"):
        roboxim("service", "call", "/flip", "--run", "other")


@pytest.mark.ros
def test_a_refusal_of_the_simulation_interfaces_is_an_error(small):
    roboxim("service", "call", "/delete_entity", "{entity: cube}")
    with pytest.raises(SimError, match="/delete_entity: no entity 'ghost'"):
        roboxim("service", "call", "/delete_entity", "{entity: ghost}")


def test_topics_are_heard_with_the_qos_that_is_offered(small):
    for name in ("/greeting", "/steady", "/hasty"):
        assert roboxim("topic", "echo", name, "--once", "--timeout", "60").startswith("{data: ")
    words = ("topic", "pub", "-r", "100", "-t", "3", "/ear", "std_msgs/msg/String", "{data: psst}")
    assert roboxim(*words) == "published 3 on /ear\n"
    assert set(eventually(lambda: small.heard)) == {"psst"}


@pytest.mark.ros
def test_a_rate_that_no_machine_keeps_can_be_ended(small, monkeypatch):
    monkeypatch.setattr(topic, "PUBLISHING_S", 0.01)
    monkeypatch.setattr("roboxim_ros.host.wait_for_stop", lambda step, **_: step())
    words = ("topic", "pub", "-r", "1e9", "/ear", "std_msgs/msg/String", "{data: psst}")
    assert re.fullmatch(r"published [1-9]\d* on /ear\n", roboxim(*words))


@pytest.mark.thorough
def test_topics(small):
    assert {"/greeting", "/steady"} <= set(roboxim("topic", "list").split())
    assert roboxim("topic", "type", "/greeting").strip() == "std_msgs/msg/String"
    assert roboxim("topic", "echo", "/greeting", "--once") == "{data: hello}\n---\n"
    assert roboxim("topic", "echo", "/steady", "--once", "--field", "data") == "tick\n---\n"
    assert "Publisher count: 1" in roboxim("topic", "info", "/steady")
    assert "/small: reliable" in roboxim("topic", "info", "-v", "/steady")
    assert 0 < eventually(_rate_of_steady) < 100
    roboxim("topic", "pub", "--once", "/ear", "std_msgs/msg/String", "{data: psst}")
    assert eventually(lambda: small.heard) == ["psst"]
    with pytest.raises(RoboximError, match="no message"):
        roboxim("topic", "echo", "/ear", "--once", "--timeout", "2")
    with pytest.raises(ConfigError, match="no field 'date'"):
        roboxim("topic", "echo", "/steady", "--once", "--field", "date")


def _rate_of_steady() -> float | None:
    """Return the printed rate, or None when the machine was too busy for two messages within a second."""
    try:
        text = roboxim("topic", "hz", "/steady", "--duration", "1")
    except RequestTimeoutError:
        return None
    return float(text.split("average rate: ")[-1].split()[0])


def test_the_rate_of_a_topic_is_that_of_its_stamps(capsys):
    topic._print_rate([10.0, 10.02, 10.04, 10.06])
    assert "average rate: 50.00 Hz  min: 0.0200 s  max: 0.0200 s" in capsys.readouterr().out


@pytest.mark.ros
def test_a_silent_topic_is_explained(small, monkeypatch):
    monkeypatch.setattr(topic, "SILENT_S", 0.0)
    result = CliRunner().invoke(group, ["topic", "hz", "/idle", "--duration", "0.3"], standalone_mode=False)
    assert isinstance(result.exception, RequestTimeoutError)
    for text in (str(result.exception), result.stderr):
        assert "roboxim action send_goal /sim/simulate_steps" in text


@pytest.mark.ros
def test_parameters(small):
    assert "  count" in roboxim("param", "list", "/small").splitlines()
    assert roboxim("param", "get", "small", "count").strip() == "3"
    roboxim("param", "set", "/small", "count", "4")
    assert small.get_parameter("count").value == 4
    with pytest.raises(ConfigError, match="count"):
        roboxim("param", "set", "/small", "count", "10")
    with pytest.raises(ConfigError, match="read-only"):
        roboxim("param", "set", "/small", "name", "y")
    with pytest.raises(ConfigError, match="no parameter 'cont'.*did you mean 'count'"):
        roboxim("param", "get", "/small", "cont")
    described = roboxim("param", "describe", "/small", "count")
    assert "count (integer): 4" in described
    assert "from 1 to 9" in described
    assert "How many." in described
    dumped = yaml.safe_load(roboxim("param", "dump", "/small"))
    assert dumped["/small"]["ros__parameters"]["count"] == 4


@pytest.mark.ros
def test_actions(small):
    assert roboxim("action", "list", "-t").strip() == "/grip [control_msgs/action/GripperCommand]"
    assert "/small" in roboxim("action", "info", "/grip")
    assert "position: 0.03" in roboxim("action", "send_goal", "/grip", "{command: {position: 0.03}}")
    with pytest.raises(RoboximError, match="aborted"):
        roboxim("action", "send_goal", "/grip", "{command: {position: -1}}")
    with pytest.raises(ConfigError, match="unknown field 'command.pos'"):
        roboxim("action", "send_goal", "/grip", "{command: {pos: 1}}")


@pytest.mark.ros
@pytest.mark.thorough
def test_nodes(small):
    assert roboxim("node", "list").split() == ["/small"]
    text = roboxim("node", "info", "/small")
    assert "/flip: std_srvs/srv/SetBool" in text
    assert "/grip: control_msgs/action/GripperCommand" in text
    with pytest.raises(RoboximError, match="did you mean '/small'"):
        roboxim("node", "info", "/smal")


@pytest.mark.ros
def test_env_lets_another_process_attach(small):
    exports = roboxim("env")
    script = f"{exports}\nexec {sys.executable} -m roboxim_cli service call /flip"
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("ROS_", "ROBOXIM_"))}
    done = subprocess.run(
        ["sh", "-c", script], capture_output=True, text=True, check=False, env=environment, timeout=PATIENCE_S
    )
    assert done.returncode == 0, done.stderr
    assert yaml.safe_load(done.stdout)["success"] is True


@pytest.mark.ros
def test_runs_are_listed(small):
    [run] = json.loads(roboxim("runs", "--json"))
    assert (run["id"], run["pids"]) == ("small-run", [os.getpid()])
    assert "small-run" in roboxim("runs")


@pytest.mark.ros
def test_doctor_reports_every_check(runtime):
    result = CliRunner().invoke(group, ["doctor", "--json"], standalone_mode=False)
    found = {finding["name"]: finding for finding in json.loads(result.stdout)}
    assert {"Python", "renderers", "graph", "shared memory", "compiler", "cores", "disk"} <= set(found)
    assert found["graph"]["state"] == "ok"
    assert found["renderer photo"]["state"] in ("ok", "absent")
    assert "Blender" in found["renderer photo"]["purpose"]


def test_doctor_reports_an_absent_optional_part(monkeypatch):
    absent = RendererStatus(available=False, detail="Blender is not installed")
    monkeypatch.setattr("roboxim_sim.rendering.available_renderers", lambda names=None: {"photo": absent})
    monkeypatch.setattr(doctor, "CHECKS", ())
    monkeypatch.setattr(doctor, "PROBES", (doctor._photo,))
    result = CliRunner().invoke(group, ["doctor"], standalone_mode=False)
    assert "optional  renderer photo   Blender is not installed" in result.stdout
    assert "for: rendering recorded episodes again" in result.stdout
    assert "install: make photo" in result.stdout


@pytest.mark.ros
def test_completion_offers_what_the_graph_has(small):
    def offered(kind, incomplete=""):
        return complete(kind)(click.Context(click.Command("x")), None, incomplete)

    assert {"/greeting", "/steady"} <= set(offered("topics"))
    assert offered("services", "fl") == ["/flip"]
    assert offered("actions") == ["/grip"]
    assert offered("nodes", "/s") == ["/small"]


def test_conventions_are_listed_and_explained(tmp_path):
    listed = CliRunner().invoke(group, ["policy", "conventions"], standalone_mode=False, catch_exceptions=False).output
    assert "libero" in listed
    assert "15 Hz  joint_delta" in listed
    text = (
        CliRunner()
        .invoke(group, ["policy", "describe", "libero"], standalone_mode=False, catch_exceptions=False)
        .output
    )
    assert "[1, 0, 0, 0, 0, 0, 0]   moves 13.1 mm along +x (forwards)" in text
    (tmp_path / "own.yaml").write_text("rate_hz: 7\n")
    own = CliRunner().invoke(group, ["policy", "describe", str(tmp_path / "own.yaml")], standalone_mode=False)
    assert "The policy acts at 7 Hz" in own.output
    with pytest.raises(ConfigError, match="unknown convention 'libro'.*did you mean 'libero'"):
        CliRunner().invoke(group, ["policy", "describe", "libro"], standalone_mode=False, catch_exceptions=False)

"""Nodes as executables of ROS 2: arguments, and a node that a plain rclpy program finds."""

import ast
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from roboxim_bringup.graph import NODES
from roboxim_bringup.node_main import parse
from roboxim_core.errors import ConfigError
from roboxim_ros.runs import free_domain
from roboxim_ros.testing import PATIENCE_S

LAUNCH = Path(__file__).parents[1] / "launch" / "graph.launch.py"


def test_arguments_of_ros_are_parsed(tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text("/**:\n  ros__parameters: {common: 1}\nsim:\n  ros__parameters: {renderer: raster}\n")
    arguments = f"sim --ros-args -r __ns:=/a --params-file {file} -p renderer:=tiny -r __node:=sim"
    config = parse(arguments.split())
    assert config.namespace == "/a"
    assert config.nodes == ("sim",)
    assert config.parameters == {"": {"common": 1}, "sim": {"renderer": "tiny"}}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("simm", "did you mean 'sim'"),
        ("sim -r /a:=/b", "'-r /a:=/b' is not supported"),
        ("sim -r __node:=other", "the node is called 'sim'"),
        ("sim -p", "-p needs a value"),
        ("sim -p speed=1", "expected name:=value"),
    ],
)
def test_wrong_arguments_are_explained(arguments: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        parse(arguments.split())


def test_the_launch_file_starts_every_node() -> None:
    """ROS 2's `launch` has no wheel, so that the file is read, not run."""
    assigned = {
        target.id: ast.literal_eval(node.value)
        for node in ast.parse(LAUNCH.read_text()).body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    assert assigned["NODES"] == tuple(NODES)


VISITOR = """
import sys, time
from roboxim_ros.runs import activate_transport
activate_transport(open_network=True)
import rclpy
rclpy.init()
node = rclpy.create_node("visitor")
while ("tasks", "/cell") not in node.get_node_names_and_namespaces():
    time.sleep(0.1)
print("found")
"""
"""A program of its own: a process keeps the transport of its first node."""


@pytest.mark.thorough
@pytest.mark.ros
def test_a_plain_rclpy_program_finds_the_node() -> None:
    environment = {name: value for name, value in os.environ.items() if name != "ROBOXIM_TRANSPORT"}
    command = [sys.executable, "-m", "roboxim_bringup.node_main", "tasks", "--ros-args", "-r", "__ns:=/cell"]
    with free_domain() as domain:
        environment["ROS_DOMAIN_ID"] = str(domain)
        with subprocess.Popen(command, env=environment) as process:
            try:
                visitor = [sys.executable, "-c", VISITOR]
                found = subprocess.run(visitor, env=environment, capture_output=True, text=True, timeout=PATIENCE_S)
            finally:
                process.terminate()
            assert found.stdout == "found\n", found.stderr
            assert process.wait(PATIENCE_S) in (0, -signal.SIGTERM)  # the latter: it was still starting

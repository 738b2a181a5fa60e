"""Another user of the machine can neither control nor listen to a graph."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from std_msgs.msg import String
from std_srvs.srv import Trigger

from roboxim_core.errors import UnavailableError
from roboxim_ros import qos, shared_memory
from roboxim_ros.guard import GuardedNode
from roboxim_ros.host import NodeHost
from roboxim_ros.runs import free_domain, transport_environment

pytestmark = pytest.mark.ros

STRANGER = """
import os, sys, time
import rclpy, rclpy.node
from rclpy.qos import QoSProfile
from std_msgs.msg import String
from std_srvs.srv import Trigger
os.setgroups([]), os.setgid(int(sys.argv[1])), os.setuid(int(sys.argv[1]))
heard = []
try:
    rclpy.init()
    node = rclpy.node.Node("stranger", enable_rosout=False)
    node.create_subscription(String, "words", lambda m: heard.append(m.data), QoSProfile(depth=1))
    client = node.create_client(Trigger, "trigger")
    answers = []
    deadline = time.monotonic() + float(sys.argv[2])
    while time.monotonic() < deadline and not (heard and answers):
        if client.service_is_ready() and not answers:
            client.call_async(Trigger.Request()).add_done_callback(lambda f: answers.append(f.result().message))
            answers = [] if not answers else answers
        rclpy.spin_once(node, timeout_sec=0.1)
    print("answered" if answers else "unanswered", "heard" if heard else "deaf")
except Exception as error:
    print("unanswered deaf", type(error).__name__)
readable = []
for name in sys.argv[3:]:
    try:
        open("/dev/shm/" + name, "rb").close()
        readable.append(name)
    except OSError:
        pass
print("readable", readable)
"""


class Talker(GuardedNode):
    """Serves and talks."""

    def __init__(self, context):
        super().__init__("talker", context=context)
        self.calls = 0
        self.create_service(Trigger, "trigger", self._on_call)
        words = self.create_publisher(String, "words", qos.STATE)
        self.create_timer(0.1, lambda: words.publish(String(data="secret")))

    def _on_call(self, _, response):
        self.calls += 1
        response.success, response.message = True, "served"


def _look_in(domain: int, uid: int, seconds: float, *files: str) -> str:
    environment = {
        **os.environ, **transport_environment(), "ROS_DOMAIN_ID": str(domain), "HOME": "/tmp", "ROS_LOG_DIR": "/tmp/log"
    }  # fmt: skip
    command = [sys.executable, "-c", STRANGER, str(uid), str(seconds), *files]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, cwd="/")
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def _files_of_this_process() -> list[str]:
    return sorted(name for name in shared_memory._mapped() if (shared_memory.FOLDER / name).exists())


def test_files_of_participants_are_closed_to_other_users(graph_host):
    graph_host.add(Talker)
    files = _files_of_this_process()
    assert any("port" in name for name in files)
    assert any("port" not in name for name in files)
    for name in files:
        assert (shared_memory.FOLDER / name).stat().st_mode & 0o077 == 0, name


@pytest.mark.skipif(os.geteuid() != 0, reason="only the superuser can act as another user")
@pytest.mark.slow
def test_another_user_can_neither_call_nor_hear():
    with free_domain() as domain, NodeHost(domain_id=domain) as host:
        talker = host.add(Talker)
        files = _files_of_this_process()
        assert _look_in(domain, os.geteuid(), 20, *files).startswith("answered heard")  # the test can fail
        calls = talker.calls
        seen = _look_in(domain, 61234, 8, *files)
        assert seen.startswith("unanswered deaf"), seen
        assert "readable []" in seen
        assert talker.calls == calls
        assert host.alive()
        assert _look_in(domain, os.geteuid(), 20).startswith("answered heard")  # and the stranger has broken nothing


@pytest.mark.skipif(os.geteuid() != 0, reason="only the superuser can make files of another user")
def test_a_domain_whose_ports_belong_to_another_user_is_refused():
    with free_domain() as domain:
        port = Path(shared_memory.FOLDER, f"fastrtps_port{7400 + 250 * domain + 240}")
        port.touch(mode=0o666)
        try:
            os.chown(port, 61234, 61234)
            assert domain in shared_memory.busy_domains()
            with NodeHost(domain_id=domain) as host, pytest.raises(UnavailableError, match="belongs to another user"):
                host.add(Talker)
        finally:
            port.unlink()


def test_a_domain_with_a_listener_is_busy(graph_host):
    domain = graph_host.add(Talker).context.get_domain_id()
    assert domain in shared_memory.busy_domains()
    graph_host.close()
    assert domain not in shared_memory.busy_domains()

from __future__ import annotations

import subprocess
import sys
import threading

import pytest
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from roboxim_core.errors import InvalidRequestError, RequestTimeoutError, UnavailableError
from roboxim_ros.clients import Clients
from roboxim_ros.host import NodeHost
from roboxim_ros.runs import free_domain
from roboxim_ros.testing import PATIENCE_S

pytestmark = pytest.mark.ros


def _server(context) -> Node:
    node = Node("server", context=context)

    def trigger(_, response):
        response.message = "done"
        return response

    def nested(request, response):
        with Clients("inner", context=context) as inner:
            response.message = inner.call(Trigger, "other/trigger", Trigger.Request()).message
        return response

    def slow(_, response):
        node.may_answer.wait(PATIENCE_S)
        node.answers += 1
        response.message = f"answer {node.answers}"
        return response

    node.answers = 0
    node.may_answer = threading.Event()
    node.create_service(Trigger, "trigger", trigger)
    node.create_service(SetBool, "nested", nested)
    node.create_service(Trigger, "slow", slow)
    return node


def test_call_from_within_a_callback_and_from_many_threads(graph_host):
    graph_host.add(_server)
    graph_host.add(lambda context: _renamed(context))
    with Clients("clients", context=graph_host.context) as clients:
        assert clients.call(SetBool, "nested", SetBool.Request()).message == "done"
        answers = []
        threads = [
            threading.Thread(target=lambda: answers.append(clients.call(Trigger, "trigger", Trigger.Request()).message))
            for _ in range(8)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert answers == ["done"] * 8


def _renamed(context) -> Node:
    node = Node("other", context=context, namespace="other")

    def trigger(_, response):
        response.message = "done"
        return response

    node.create_service(Trigger, "trigger", trigger)
    return node


def test_absent_and_slow_services_are_distinguished(graph_host):
    server = graph_host.add(_server)
    with Clients("clients", context=graph_host.context) as clients:
        with pytest.raises(UnavailableError, match="/nowhere"):
            clients.call(Trigger, "nowhere", Trigger.Request(), wait_s=0.1)
        with pytest.raises(InvalidRequestError, match="a b"):
            clients.call(Trigger, "a b", Trigger.Request())
        with pytest.raises(RequestTimeoutError, match="/slow"):
            clients.call(Trigger, "slow", Trigger.Request(), timeout_s=0.1)
        server.may_answer.set()


HANGING = """
import sys, threading
from rclpy.node import Node
from std_srvs.srv import Trigger
from roboxim_ros.host import NodeHost
def hang(request, response):
    print("called", flush=True)
    threading.Event().wait()
def make(context):
    node = Node("hanging", context=context)
    node.create_service(Trigger, "hang", hang)
    return node
with NodeHost(domain_id=int(sys.argv[1])) as host:
    host.add(make)
    threading.Event().wait()
"""


@pytest.mark.thorough
def test_call_to_a_killed_process_ends_before_its_timeout():
    with (
        free_domain() as domain,
        subprocess.Popen([sys.executable, "-c", HANGING, str(domain)], stdout=subprocess.PIPE) as server,
        NodeHost(domain_id=domain) as host,
        Clients("clients", context=host.context) as clients,
    ):
        killer = threading.Thread(target=lambda: (server.stdout.readline(), server.kill()))
        killer.start()
        try:
            with pytest.raises(UnavailableError, match="has died"):
                clients.call(Trigger, "hang", Trigger.Request(), timeout_s=PATIENCE_S, wait_s=PATIENCE_S)
        finally:
            server.kill()
            killer.join()


def test_clients_answer_after_a_failure_of_the_middleware(graph_host):
    graph_host.add(_server)
    with Clients("clients", context=graph_host.context) as clients:
        failed = threading.Event()

        def fail():
            failed.set()
            raise RuntimeError("of the middleware")

        clients._executor.create_task(fail)
        clients.wake()
        assert failed.wait(PATIENCE_S)
        assert clients.call(Trigger, "trigger", Trigger.Request()).message == "done"


def test_a_late_answer_is_never_taken_for_the_next_one(graph_host):
    server = graph_host.add(_server)
    with Clients("clients", context=graph_host.context) as clients:
        with pytest.raises(RequestTimeoutError):
            clients.call(Trigger, "slow", Trigger.Request(), timeout_s=0.2)
        server.may_answer.set()
        assert clients.call(Trigger, "slow", Trigger.Request()).message == "answer 2"

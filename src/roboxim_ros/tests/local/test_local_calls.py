"""Calls between nodes of one process, without the middleware."""

from __future__ import annotations

import threading

import pytest
from std_srvs.srv import Empty, Trigger

from roboxim_core.errors import ErrorCode, InvalidRequestError, RequestTimeoutError, RoboximError, UnavailableError
from roboxim_ros.clients import Clients, wait_until
from roboxim_ros.direct_calls import DirectClient
from roboxim_ros.host import NodeHost
from roboxim_ros.node import RoboximNode
from roboxim_ros.runs import free_domain
from roboxim_ros.testing import PATIENCE_S

pytestmark = pytest.mark.ros


class _Server(RoboximNode):
    """Offers ``tick``, and ``slow``, which answers when it may."""

    def __init__(self, context) -> None:
        super().__init__("server", context=context)
        self.received = []
        self.threads = set()
        self.busy, self.may_answer = threading.Event(), threading.Event()
        self.offer("tick", self._tick)
        self.offer("slow", self._slow)
        self.serve(Trigger, "other", self._other)
        self.serve(Trigger, "faulty", lambda *_: 1 / 0)
        self.serve(Trigger, "here", self._other, inline=True)
        self.offer("here", self._tick, inline=True)

    def _tick(self, value) -> list:
        self.received.append(value)
        self.threads.add(threading.get_ident())
        if not value:
            raise InvalidRequestError("no data")
        return [*value, "done"]

    def _other(self, request, response) -> None:
        self.received.append(request)
        self.threads.add(threading.get_ident())
        response.message = "other"

    def _slow(self) -> None:
        self.busy.set()
        self.may_answer.wait(PATIENCE_S)


def call(clients, name, *arguments, timeout_s=PATIENCE_S):
    return clients.value_of(clients.send_local(name, *arguments), name, timeout_s)


@pytest.fixture
def server(graph_host):
    return graph_host.add(_Server)


@pytest.fixture
def clients(graph_host, server):
    with Clients("clients", context=graph_host.context) as made:
        yield made


def test_a_function_of_this_process_gets_the_callers_values(server, clients):
    values = [[number] for number in range(3)]
    assert [call(clients, "tick", value) for value in values] == [[0, "done"], [1, "done"], [2, "done"]]
    assert [id(value) for value in server.received] == [id(value) for value in values]
    assert len(server.threads) == 1
    assert threading.get_ident() not in server.threads


def test_an_error_is_raised_at_the_caller(server, clients):
    with pytest.raises(InvalidRequestError, match="no data"):
        call(clients, "tick", [])
    with pytest.raises(RoboximError, match="TypeError in tick") as raised:
        call(clients, "tick", 1)
    assert raised.value.code == ErrorCode.INTERNAL
    assert call(clients, "tick", [2]) == [2, "done"]


def test_a_service_of_this_process_gets_the_callers_request(server, clients):
    """Only callers of other processes use the middleware; errors are answers all the same."""
    request = Trigger.Request()
    assert clients.call(Trigger, "other", request, timeout_s=PATIENCE_S).message == "other"
    assert server.received[-1] is request
    assert threading.get_ident() not in server.threads
    assert "ZeroDivisionError" in clients.call(Trigger, "faulty", Trigger.Request(), timeout_s=PATIENCE_S).message
    with pytest.raises(TypeError, match="Trigger takes"):
        clients.call(Trigger, "other", Empty.Request())
    foreign = DirectClient(clients.node, Trigger, "other")
    assert wait_until(foreign.client.service_is_ready, PATIENCE_S)
    assert foreign.receive(foreign.send(request), PATIENCE_S).message == "other"
    assert server.received[-1] is not request


def test_what_is_offered_inline_runs_in_the_callers_thread(server, clients):
    assert call(clients, "here", [1]) == [1, "done"]
    assert clients.call(Trigger, "here", Trigger.Request()).message == "other"
    assert server.threads == {threading.get_ident()}
    with pytest.raises(InvalidRequestError, match="no data"):
        call(clients, "here", [])


def test_other_processes_functions_are_not_called(clients):
    assert clients.send_local("unknown") is None


def test_the_middleware_is_served_during_lockstep(server, clients):
    """A service is answered while calls of this process leave no pause."""
    ended = threading.Event()

    def lockstep():
        while not ended.is_set():
            call(clients, "tick", [1])

    threads = [threading.Thread(target=lockstep) for _ in range(3)]
    for thread in threads:
        thread.start()
    try:
        assert clients.call(Trigger, "other", Trigger.Request(), timeout_s=PATIENCE_S).message == "other"
        foreign = DirectClient(clients.node, Trigger, "other")
        number = foreign.send(Trigger.Request())
        assert foreign.receive(number, PATIENCE_S).message == "other"
    finally:
        ended.set()
        for thread in threads:
            thread.join()


def test_a_caller_learns_that_the_server_hangs_or_has_ended():
    with free_domain() as domain, NodeHost(domain_id=domain) as host:
        server = host.add(_Server)
        with Clients("clients", context=host.context) as clients:
            with pytest.raises(RequestTimeoutError, match="/slow"):
                call(clients, "slow", timeout_s=0.1)
            assert server.busy.wait(PATIENCE_S)
            errors = []

            def late():
                try:
                    call(clients, "tick", [1])
                except UnavailableError as error:
                    errors.append(str(error))

            waiting = threading.Thread(target=late)
            waiting.start()
            while not server.executor._posts:  # until the call is in the queue
                waiting.join(0.01)
            server.executor.shutdown(timeout_sec=0)
            waiting.join(PATIENCE_S)
            assert "disappeared" in errors[0]
            server.may_answer.set()

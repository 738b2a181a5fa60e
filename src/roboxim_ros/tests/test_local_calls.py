"""Calls between nodes of one process, without the middleware."""

from __future__ import annotations

import threading

import pytest
from std_srvs.srv import SetBool, Trigger

from roboxim_core.errors import InvalidRequestError, RequestTimeoutError, UnavailableError
from roboxim_ros.clients import Clients
from roboxim_ros.direct_calls import DirectClient
from roboxim_ros.host import NodeHost
from roboxim_ros.node import RoboximNode
from roboxim_ros.runs import free_domain
from roboxim_ros.testing import PATIENCE_S

pytestmark = pytest.mark.ros


class _Server(RoboximNode):
    """Serves ``tick`` in lockstep, and ``slow``, which answers when it may."""

    def __init__(self, context) -> None:
        super().__init__("server", context=context)
        self.received = []
        self.threads = set()
        self.busy, self.may_answer = threading.Event(), threading.Event()
        self.serve(SetBool, "tick", self._tick, lockstep=True)
        self.serve(Trigger, "slow", self._slow, lockstep=True)
        self.serve(Trigger, "other", lambda _, response: setattr(response, "message", "other"))

    def _tick(self, request, response) -> None:
        self.received.append(request)
        self.threads.add(threading.get_ident())
        if not request.data:
            raise InvalidRequestError("no data")
        response.message = "done"

    def _slow(self, _, response) -> None:
        self.busy.set()
        self.may_answer.wait(PATIENCE_S)


@pytest.fixture
def server(graph_host):
    return graph_host.add(_Server)


@pytest.fixture
def clients(graph_host, server):
    with Clients("clients", context=graph_host.context) as made:
        yield made


def test_a_request_of_this_process_is_not_serialised(server, clients):
    requests = [SetBool.Request(data=True) for _ in range(3)]
    assert [clients.call(SetBool, "tick", request).message for request in requests] == ["done"] * 3
    assert [id(request) for request in server.received] == [id(request) for request in requests]
    assert len(server.threads) == 1
    assert threading.get_ident() not in server.threads


def test_a_handlers_error_is_the_answer(clients):
    answer = clients.call(SetBool, "tick", SetBool.Request())
    assert not answer.success
    assert "no data" in answer.message
    with pytest.raises(TypeError, match="SetBool"):
        clients.call(SetBool, "tick", Trigger.Request())


def test_the_middleware_is_served_during_lockstep(server, clients):
    """A request of another process is answered while requests of this process leave no pause."""
    ended = threading.Event()

    def lockstep():
        while not ended.is_set():
            clients.call(SetBool, "tick", SetBool.Request(data=True))

    threads = [threading.Thread(target=lockstep) for _ in range(3)]
    for thread in threads:
        thread.start()
    try:
        assert clients.call(Trigger, "other", Trigger.Request(), timeout_s=PATIENCE_S).message == "other"
        foreign = DirectClient(clients.node, SetBool, "tick")
        number = foreign.send(SetBool.Request(data=True))
        assert foreign.receive(number, PATIENCE_S).message == "done"
    finally:
        ended.set()
        for thread in threads:
            thread.join()


def test_a_caller_learns_that_the_server_hangs_or_has_ended():
    with free_domain() as domain, NodeHost(domain_id=domain) as host:
        server = host.add(_Server)
        with Clients("clients", context=host.context) as clients:
            with pytest.raises(RequestTimeoutError, match="/slow"):
                clients.call(Trigger, "slow", Trigger.Request(), timeout_s=0.1)
            assert server.busy.wait(PATIENCE_S)
            errors = []

            def call():
                try:
                    clients.call(SetBool, "tick", SetBool.Request(data=True), timeout_s=PATIENCE_S)
                except UnavailableError as error:
                    errors.append(str(error))

            waiting = threading.Thread(target=call)
            waiting.start()
            while not server.executor._posts:  # until the call is in the queue
                waiting.join(0.01)
            server.executor.shutdown(timeout_sec=0)
            waiting.join(PATIENCE_S)
            assert "disappeared" in errors[0]
            server.may_answer.set()

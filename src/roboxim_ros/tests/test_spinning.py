"""Errors of the middleware: reported while a node lives, and none of its end."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from roboxim_ros.spinning import spin


class Failing:
    """An executor whose guard conditions are gone in the middle of waiting, as rclpy's may be at its end."""

    def __init__(self, *, shut_down: bool) -> None:
        self._is_shutdown, self.calls = shut_down, 0

    def spin(self) -> None:
        self.calls += 1
        if self.calls < 3:
            raise AttributeError("'NoneType' object has no attribute 'handle'")


@pytest.mark.parametrize(("shut_down", "reports"), [(False, 2), (True, 0)])
def test_an_error_of_the_middleware_is_reported_unless_the_executor_ends(shut_down, reports):
    lines: list[str] = []
    logger = SimpleNamespace(**dict.fromkeys(("error", "fatal", "warning"), lines.append))
    node = SimpleNamespace(get_logger=lambda: logger, get_name=lambda: "node")
    executor = Failing(shut_down=shut_down)
    spin(executor, node)
    assert len(lines) == reports
    assert executor.calls == (1 if shut_down else 3)

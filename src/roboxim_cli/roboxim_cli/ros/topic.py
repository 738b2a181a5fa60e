"""List, print, time and publish topics."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import click

from roboxim_bringup.attach import Peer, absolute, attach_options, attached, on_graph
from roboxim_cli import strict
from roboxim_cli.graph_names import add_names, complete
from roboxim_cli.options import POSITIVE


@strict.group()
def command() -> None:
    """List, print, time and publish the topics of a running graph."""


add_names(command, "topic")


@command.command("info")
@click.argument("name", shell_complete=complete("topics"))
@click.option("-v", "--verbose", is_flag=True, help="Also print nodes and QoS.")
@on_graph
def info(peer: Peer, name: str, verbose: bool) -> None:
    """Print a topic's type and its publishers and subscribers."""
    type_name = peer.type_of("topic", name)
    peer.settle()
    sides = {
        "Publisher": peer.node.get_publishers_info_by_topic(absolute(name)),
        "Subscription": peer.node.get_subscriptions_info_by_topic(absolute(name)),
    }
    click.echo(f"Type: {type_name}")
    for side, ends in sides.items():
        click.echo(f"{side} count: {len(ends)}")
        for end in ends if verbose else ():
            qos = end.qos_profile
            click.echo(
                f"  {end.node_namespace.rstrip('/')}/{end.node_name}: {qos.reliability.name.lower()}, "
                f"{qos.durability.name.lower()}, depth {qos.depth or 'unknown'}"
            )


@command.command("echo")
@click.argument("name", shell_complete=complete("topics"))
@click.argument("type_name", metavar="[TYPE]", required=False)
@click.option("--once", is_flag=True, help="End after the first message.")
@click.option("--field", help="Print this field only, e.g. robot.joint_positions.")
@click.option("--full", is_flag=True, help="Do not shorten long arrays.")
@click.option("--timeout", type=POSITIVE, help="Fail when no message arrives for this time [s].")
@on_graph
def echo(
    peer: Peer, name: str, type_name: str | None, once: bool, field: str | None, full: bool, timeout: float | None
) -> None:
    """Print the messages of a topic as YAML, separated by ---."""
    from roboxim_cli.messages import field_to_plain
    from roboxim_core.plain_data.yaml_text import dump

    def remind() -> None:
        click.echo(_silence(absolute(name)), err=True)

    def show(message: Any) -> None:
        click.echo(dump(field_to_plain(message, field or "", full=full)) + "---")

    _listen(peer, name, type_name, show, once=once, timeout_s=timeout, silent=remind)


@command.command("hz")
@click.argument("name", shell_complete=complete("topics"))
@click.option("--window", default=100, show_default=True, type=click.IntRange(2), help="Messages to average over.")
@click.option("--duration", type=POSITIVE, help="End after this time [s]; default: on Ctrl-C.")
@on_graph
def hz(peer: Peer, name: str, window: int, duration: float | None) -> None:
    """Print the rate of a topic, in wall time, once a second."""
    from collections import deque

    stamps: deque[float] = deque(maxlen=window)
    last = time.monotonic()

    def remind() -> None:
        if not stamps:
            click.echo(_silence(absolute(name)), err=True)

    def note(_: Any) -> None:
        nonlocal last
        now = time.monotonic()
        stamps.append(now)
        if now - last >= 1.0 and len(stamps) > 1:
            last = now
            _print_rate(list(stamps))

    _listen(peer, name, None, note, fresh=True, duration_s=duration, silent=remind)
    if len(stamps) > 1:
        _print_rate(list(stamps))
    elif duration is not None:
        from roboxim_core.errors import RequestTimeoutError

        raise RequestTimeoutError(
            f"{len(stamps)} messages on {absolute(name)} in {duration:g} s" + ("" if stamps else f"; {STILL}")
        )


PUBLISHING_S = 0.2
"""Longest time for which messages are published without a look at whether the command shall end [s]."""
SILENT_S = 2.0
"""Silence after which a listening command explains what is missing [s]."""
STILL = (
    "the simulation advances only on request, by a run of episodes or by hand: "
    "roboxim action send_goal /sim/simulate_steps '{steps: 1000}'"
)


def _silence(name: str) -> str:
    """Report that no message has arrived yet, and how to step the simulation."""
    return f"no message on {name} for {SILENT_S:g} s; {STILL}"


def _print_rate(stamps: list[float]) -> None:
    gaps = [later - earlier for earlier, later in zip(stamps, stamps[1:], strict=False)]
    mean = sum(gaps) / len(gaps)
    deviation = (sum((gap - mean) ** 2 for gap in gaps) / len(gaps)) ** 0.5
    click.echo(
        f"average rate: {1 / mean:.2f} Hz  min: {min(gaps):.4f} s  max: {max(gaps):.4f} s  "
        f"std dev: {deviation:.4f} s  window: {len(stamps)}"
    )


@command.command("pub")
@click.argument("name", shell_complete=complete("topics"))
@click.argument("type_name", metavar="TYPE")
@click.argument("text", metavar="[YAML]", default="")
@click.option("-1", "--once", is_flag=True, help="Publish one message once a subscriber is connected.")
@click.option("-r", "--rate", type=POSITIVE, default=1.0, show_default=True, help="Messages per second.")
@click.option(
    "-t", "--times", type=click.IntRange(0), default=0, help="End after this number of messages; 0: on Ctrl-C."
)
@attach_options
def pub(
    name: str, type_name: str, text: str, once: bool, rate: float, times: int, run_id: str | None, domain: int | None
) -> None:
    """Publish messages to a topic."""
    from roboxim_cli.messages import look_up, message_from_plain
    from roboxim_core.plain_data.yaml_text import parse
    from roboxim_ros.host import wait_for_stop
    from roboxim_ros.qos import STATE

    message = message_from_plain(look_up(type_name, "msg"), parse(text, source="message") if text else None)
    with attached(run_id, domain) as peer:
        publisher = peer.node.create_publisher(type(message), absolute(name), STATE)
        peer.look_for(
            lambda: publisher.get_subscription_count() or None, lambda: f"no node subscribes to {absolute(name)}"
        )
        sent = 0
        following = time.monotonic()

        def step() -> bool:
            nonlocal sent, following
            begun = time.monotonic()
            while following <= (now := time.monotonic()) < begun + PUBLISHING_S and not _all_sent():
                publisher.publish(message)
                sent += 1
                following = max(following + 1.0 / rate, now - PUBLISHING_S)
            return _all_sent()

        def _all_sent() -> bool:
            return sent >= (1 if once else times or float("inf"))

        wait_for_stop(step, period_s=min(PUBLISHING_S, 1.0 / rate))
        from rclpy.duration import Duration

        publisher.wait_for_all_acked(Duration(seconds=2))
        click.echo(f"published {sent} on {absolute(name)}")


def _listen(
    peer: Peer,
    name: str,
    type_name: str | None,
    take: Callable[[Any], None],
    *,
    once: bool = False,
    fresh: bool = False,
    timeout_s: float | None = None,
    duration_s: float | None = None,
    silent: Callable[[], None] | None = None,
) -> None:
    """Pass a topic's messages to ``take`` in this thread until Ctrl-C or the end of ``duration_s``.

    With ``fresh``, messages stay serialised and earlier ones are skipped; for timing. ``silent`` is called once when no
    message has arrived for `SILENT_S`.
    """
    import queue

    from roboxim_cli.messages import look_up
    from roboxim_core.errors import RequestTimeoutError
    from roboxim_ros.qos import offered

    found = type_name or peer.type_of("topic", name)
    cls = look_up(found, "msg")
    inbox: queue.Queue[Any] = queue.Queue()
    qos = offered(peer.node, absolute(name), 100, fresh=fresh)
    subscription = peer.node.create_subscription(cls, absolute(name), inbox.put, qos, raw=fresh)
    peer.wake()
    begun = received = time.monotonic()
    try:
        while duration_s is None or time.monotonic() - begun < duration_s:
            try:
                message = inbox.get(timeout=0.1)
            except queue.Empty:
                if silent is not None and time.monotonic() - received > SILENT_S:
                    silent()
                    silent = None
                if timeout_s is not None and time.monotonic() - received > timeout_s:
                    raise RequestTimeoutError(f"no message on {absolute(name)} for {timeout_s:g} s") from None
                continue
            received = time.monotonic()
            take(message)
            if once:
                return
    except KeyboardInterrupt:
        return
    finally:
        peer.node.destroy_subscription(subscription)

"""Describe, check, repair and play recorded episodes, and record a running graph."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import click

from roboxim_bringup.attach import attach_options
from roboxim_cli import strict
from roboxim_cli.graph_names import complete
from roboxim_cli.options import POSITIVE, option
from roboxim_core.plain_data.shell import shell_line

_bag = click.Path(exists=True, path_type=Path)


@strict.group()
def command() -> None:
    """Describe, check, repair and play recorded episodes, and record a running graph."""


@command.command("info")
@click.argument("path", type=_bag)
def info(path: Path) -> None:
    """Describe a bag, or a folder of bags. The exit code is 1 when a bag is damaged or holds no episode."""
    from roboxim_core.errors import ErrorCode, RecorderError
    from roboxim_recorder.summary import bag_info, dataset_summary

    if path.is_file() or any(path.glob("*.mcap")) or any(path.glob("*.db3")):
        click.echo(bag_info(path))
        return
    summary = dataset_summary(path)
    click.echo(summary.text)
    if summary.damaged:
        total = summary.episodes + len(summary.damaged)
        raise RecorderError(f"{len(summary.damaged)} of {total} bags are damaged", ErrorCode.BAG_DAMAGED)


@command.command("check", begins="checking")
@click.argument("paths", type=_bag, nargs=-1, required=True)
def check(paths: tuple[Path, ...]) -> None:
    """Check that bags are whole: every byte, tick and topic. For a run, also check that no bag is missing.

    The exit code is 1 when a bag is damaged or missing.
    """
    from roboxim_core.errors import ErrorCode, RecorderError
    from roboxim_recorder.bag import mcap_file
    from roboxim_recorder.integrity.check import check_bag
    from roboxim_recorder.run_bags import RunBags, run_bags

    broken = total = missing = 0
    for path in paths:
        found = RunBags(paths=(mcap_file(path),)) if path.is_file() else run_bags(path)
        missing += len(found.missing)
        if found.missing:
            click.echo(f"{path}: {found.missing_text}")
        if found.unexpected:
            click.echo(f"{path}: {found.unexpected_text}")
        for bag in sorted((*found.paths, *found.unexpected)):
            report = check_bag(bag)
            total += 1
            broken += not report.ok
            state = "NO EPISODE" if report.foreign else "DAMAGED"
            click.echo(f"{bag}: " + (f"whole, {report.ticks} ticks, {report.outcome}" if report.ok else state))
            for line in (*report.problems, *report.notes):
                click.echo(f"  {line}")
    if broken or missing:
        raise RecorderError(
            f"{broken} of {total} bags are damaged or hold no episode" + f", {missing} are missing" * bool(missing),
            ErrorCode.BAG_DAMAGED,
        )


@command.command("repair", begins="repairing")
@click.argument("path", type=_bag)
@option("out", help="Folder of the new bag; default: that of the bag.")
@click.option("--judge", is_flag=True, help="When the result is lost, execute the saved actions again and judge them.")
def repair(path: Path, out: Path | None, judge: bool) -> None:
    """Save the whole ticks of a damaged bag, up to the first gap, as a new bag in OUT.

    The new bag is called EPISODE.repaired. The original is only
    read. An episode whose result is lost is an error (outcome_unknown), so that no export takes it for a success.

    The exit code is 0 when nothing is lost, 1 when ticks or the result are lost, 2 when nothing can be saved.
    """
    from roboxim_recorder.integrity.repair import repair_bag

    if judge:
        from roboxim_runs.episodes.reexecution import rejudge

        report = repair_bag(path, out, rejudge=rejudge)
    else:
        report = repair_bag(path, out)
    click.echo(f"{path}: {report.text}")
    for reason in report.further:
        click.echo(f"  {reason}")
    if report.target is not None:
        click.echo(f"saved {report.target}")
    if code := {"whole": 0, "lossy": 1, "nothing": 2}[report.state]:
        sys.exit(code)


@command.command("play", begins="starting")
@click.argument("path", type=_bag)
@option(
    "-r",
    "rate",
    type=POSITIVE,
    default=1.0,
    metavar="FACTOR",
    show_default=True,
    help="Playback speed, relative to simulated time.",
)
@click.option("-t", "--topic", "topics", multiple=True, help="Play this topic; may be repeated; default: all.")
@click.option("--namespace", default="", help="Prefix of every topic, e.g. /bag.")
@click.option("--wait/--no-wait", default=False, help="Wait for a subscriber before playing.")
@attach_options
def play(
    path: Path,
    rate: float,
    topics: tuple[str, ...],
    namespace: str,
    wait: bool,
    run_id: str | None,
    domain: int | None,
) -> None:
    """Publish a bag's messages as they were recorded.

    The messages go to the only live run (or --run). Without a live run, the player starts its own.
    """
    from roboxim_bringup.attach import Peer, graph_namespace
    from roboxim_cli.ros.node import membership
    from roboxim_recorder.bag import mcap_file

    file = mcap_file(path)
    types = _types(file)
    namespace = graph_namespace(namespace)
    with membership("play", run_id, domain, open_network=False, namespace=namespace) as member:
        peer = Peer()
        try:
            publishers = _publishers(peer, types, topics, namespace)
            while wait and not any(publisher.get_subscription_count() for publisher in publishers.values()):
                time.sleep(0.05)
            click.echo(f"playing {file} into {member.where}; Ctrl-C ends it")
            sent = _play(file, publishers, rate)
            _flush(publishers)
        finally:
            peer.close()
    click.echo(f"published {sent} messages")


def _types(file: Path) -> dict[str, str]:
    """Return topic to message type of any bag, an episode's or not."""
    from mcap.reader import make_reader

    from roboxim_recorder.bag import damage, damaged

    with damage(file), file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    if summary is None:
        raise damaged(file, "it has no index")
    return {channel.topic: summary.schemas[channel.schema_id].name for channel in summary.channels.values()}


def _publishers(peer: Any, types: dict[str, str], topics: tuple[str, ...], namespace: str) -> dict[str, Any]:
    from roboxim_bringup.attach import absolute
    from roboxim_cli.messages import look_up
    from roboxim_core.errors import ConfigError, one_of
    from roboxim_ros.qos import SENSOR

    wanted = [absolute(topic) for topic in topics] or list(types)
    for topic in wanted:
        if topic not in types:
            raise ConfigError(f"the bag has no topic '{topic}'; {one_of(types, topic)}")
    return {
        topic: peer.node.create_publisher(look_up(types[topic], "msg"), f"{namespace}{topic}", SENSOR)
        for topic in wanted
    }


def _play(file: Path, publishers: dict[str, Any], rate: float) -> int:
    """Publish the serialised messages at their recorded times; return their number."""
    from mcap.reader import make_reader

    from roboxim_recorder.bag import damage

    sent = 0
    started = time.monotonic()
    first: int | None = None
    with damage(file), file.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages(topics=list(publishers)):
            first = message.log_time if first is None else first
            due = started + (message.log_time - first) / 1e9 / rate
            time.sleep(max(0.0, due - time.monotonic()))
            publishers[channel.topic].publish(message.data)
            sent += 1
    return sent


def _flush(publishers: dict[str, Any]) -> None:
    from rclpy.duration import Duration

    for publisher in publishers.values():
        publisher.wait_for_all_acked(Duration(seconds=2))


@command.command("record", begins="starting")
@click.argument("topics", nargs=-1, shell_complete=complete("topics"))
@option("out", required=True, help="Folder of the bag, which must not exist.")
@click.option("--duration", type=POSITIVE, help="End after this time [s]; else on Ctrl-C.")
@attach_options
def record(topics: tuple[str, ...], out: Path, duration: float | None, run_id: str | None, domain: int | None) -> None:
    r"""Record a running graph, whatever drives it: TOPICS, or all of them, those of your own nodes too.

    \b
    roboxim up &
    roboxim bag record --out runs/driven
    roboxim bag record /joint_states /my_node/goal --out runs/goals --duration 30

    Topics that appear later are recorded from then on. The bag is MCAP with rosbag2's profile: 'roboxim bag play' and
    Foxglove open it. It is not an episode: it has no task and no verdict, so exports refuse it; 'roboxim dataset
    convert' makes a dataset of it. Episodes are recorded by 'roboxim generate' and 'roboxim evaluate'.
    """
    from roboxim_bringup.attach import absolute, attached
    from roboxim_bringup.live_recording import LiveRecording
    from roboxim_cli.messages import look_up
    from roboxim_core.errors import ConfigError
    from roboxim_ros.host import wait_for_stop

    if out.exists():
        raise ConfigError(f"{out} exists already; choose another --out")
    wanted = [absolute(topic) for topic in topics]
    with (  # in this order: nothing is written without a run
        attached(run_id, domain) as peer,
        LiveRecording(out, lambda name: look_up(name, "msg"), wanted) as recording,
    ):
        peer.settle()
        end = time.monotonic() + (duration or float("inf"))

        def step() -> bool:
            recording.listen(peer)
            recording.write()
            return time.monotonic() >= end

        recording.listen(peer)
        wait_for_stop(step, period_s=0.2, on_waiting=lambda: click.echo(f"recording into {out}; Ctrl-C ends it"))
        recording.close(peer)
    for name, count in sorted(recording.counts.items()):
        if count:
            click.echo(f"  {name}: {count}")
    if silent := [name for name, count in sorted(recording.counts.items()) if not count]:
        click.echo(f"  no message on {', '.join(silent)}")
    for text in recording.left_out:
        click.echo(f"  left out: {text}")
    missing = [topic for topic in wanted if not recording.counts.get(topic)]
    click.echo(f"{sum(recording.counts.values())} messages in {out}")
    if not missing:
        bag, dataset = shell_line(out), shell_line(f"{out}-lerobot")
        click.echo(f'next: roboxim dataset convert lerobot {bag} --instruction "what was done" --out {dataset}')
    if missing:
        raise ConfigError(f"no message on {', '.join(missing)}")

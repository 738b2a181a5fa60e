"""Control ticks per second through the nodes, compared with robosuite 1.5's Lift on the same machine, in turns.

- RoboXim: the whole node graph at 10 Hz with two 256x256 cameras, RGB + depth + segmentation. A tick consists of
  observing, acting (a random policy), simulating, rendering, judging and recording.
- robosuite: `Lift` at 10 Hz with two 256x256 RGB cameras and a random action per step; nothing is recorded
  (``make render-peers`` installs it).

Both figures exclude resets, which have a separate column.
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from statistics import median

from benchmarks._harness import Bench
from benchmarks.peers._peer import Peer, installed
from roboxim_interfaces.msg import RunConfig as RunConfigMsg
from roboxim_interfaces.srv import RunEpisodes

from roboxim_bringup.graph import PolicyLaunch, start_graph
from roboxim_core.episode import RunConfig
from roboxim_ros.host import NodeHost
from roboxim_ros.messages.conversions import to_msg
from roboxim_ros.runs import activate_transport, free_domain

SHORT, LONG = 10, 60
"""Ticks of two episodes of one scene: the difference of their durations is the time of ticks alone."""


def main() -> None:
    """Measure and report."""
    bench = Bench("control_loop", __doc__)
    rounds = 3 if bench.quick else 10
    ticks_ms: list[float] = []
    steps_ms: list[float] = []
    resets_ms: dict[str, list[float]] = {"ours": [], "theirs": []}
    peer = Peer("robosuite", "run_robosuite.py", variables={"MUJOCO_GL": "egl"}) if installed("robosuite") else None
    activate_transport()
    with tempfile.TemporaryDirectory(prefix="roboxim-") as folder, free_domain() as domain:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        with NodeHost(domain_id=domain) as host:
            graph = start_graph(
                host,
                parameters={"sim": {"scene": ""}, "recorder": {"output_root": "/"}},
                policies=[PolicyLaunch(spec="random")],
            )
            with graph.clients() as clients:

                def episode_ms(index: int, ticks: int) -> float:
                    config = RunConfig(
                        actor="policy",
                        image_width=256,
                        image_height=256,
                        depth=True,
                        segmentation=True,
                        max_steps=ticks - 1,
                        stop_on_success=False,
                        settle_ticks=1,
                        output_dir=str(Path(folder, str(ticks))),
                    )
                    Path(config.output_dir).mkdir(exist_ok=True)
                    request = RunEpisodes.Request(config=to_msg(config, RunConfigMsg), indices=[index])
                    start = time.perf_counter()
                    answer = clients.call(RunEpisodes, "evaluator/run_episodes", request, timeout_s=120.0)
                    elapsed = 1e3 * (time.perf_counter() - start)
                    if not answer.results or answer.results[0].last_seq != ticks:
                        raise SystemExit(f"the episode did not run {ticks} ticks: {answer}")
                    return elapsed

                episode_ms(0, SHORT)
                for index in range(1, rounds + 1):
                    short, long = episode_ms(index, SHORT), episode_ms(index, LONG)
                    ticks_ms.append((long - short) / (LONG - SHORT))
                    resets_ms["ours"].append(short - SHORT * ticks_ms[-1])
                    if peer:
                        answer = peer.ask(steps=20)
                        steps_ms.extend(answer["step_ms"])
                        resets_ms["theirs"].append(answer["reset_ms"])
    ours = median(ticks_ms)
    bench.row(
        loop="RoboXim, whole graph, RGB + depth + segmentation",
        ms_per_tick=round(ours, 2),
        ticks_per_s=round(1e3 / ours, 1),
        reset_ms=round(median(resets_ms["ours"])),
    )
    if peer is None:
        print("robosuite is not measured: `make render-peers` installs it")
        bench.finish("control ticks per second through the nodes", 1e3 / ours, "Hz", at_least=30.0)
        return
    peer.close()
    theirs = median(steps_ms)
    bench.row(
        loop="robosuite Lift, RGB",
        ms_per_tick=round(theirs, 2),
        ticks_per_s=round(1e3 / theirs, 1),
        reset_ms=round(median(resets_ms["theirs"])),
    )
    bench.finish("control ticks per second through the nodes, over robosuite's Lift", theirs / ours, "", at_least=3.8)


if __name__ == "__main__":
    main()

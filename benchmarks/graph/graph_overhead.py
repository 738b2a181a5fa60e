"""Overhead of the node graph: an episode through the nodes, compared with the same episode through the cores.

Both draw, simulate, render two cameras, judge, act with the expert and write the same bag. The episodes are
interleaved in one process on one machine. The headline is the ratio of the median wall times per tick.
"""

import os
import tempfile
import time
from pathlib import Path
from statistics import median

from benchmarks._harness import Bench

from roboxim_bringup.core_graph import CoreGraph
from roboxim_bringup.graph import start_graph
from roboxim_core.episode import EpisodeResult, EpisodeRunner, RunConfig
from roboxim_ros.host import NodeHost
from roboxim_ros.messages.conversions import from_msg, to_msg
from roboxim_ros.runs import activate_transport, free_domain


def main() -> None:
    """Measure and print."""
    bench = Bench("graph_overhead", __doc__)
    episodes = 4 if bench.quick else 20
    size = 256
    activate_transport()
    with tempfile.TemporaryDirectory() as folder, free_domain() as domain:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        direct, nodes = Path(folder, "direct"), Path(folder, "nodes")
        direct.mkdir(), nodes.mkdir()
        shared = {"purpose": "demo", "keep": "successful", "image_width": size, "image_height": size}
        with CoreGraph(direct) as cores, NodeHost(domain_id=domain) as host:
            runner = EpisodeRunner(cores.ports, RunConfig(**shared, output_dir=str(direct)))
            graph = start_graph(host, parameters={"sim": {"scene": ""}, "recorder": {"output_root": "/"}})
            with graph.clients() as clients:
                times: dict[str, list[float]] = {"cores": [], "nodes": []}
                hashes: dict[str, list[str]] = {"cores": [], "nodes": []}
                for index in range(episodes + 1):
                    for side, run in (
                        ("cores", lambda i: runner.run_index(i)),
                        ("nodes", lambda i: run_through_nodes(clients, RunConfig(**shared, output_dir=str(nodes)), i)),
                    ):
                        before = time.perf_counter()
                        result = run(index)
                        seconds = time.perf_counter() - before
                        hashes[side].append(result.final_state_hash)
                        if index > 0:  # the first one warms up
                            times[side].append(seconds / (result.last_seq + 1))
        if hashes["cores"] != hashes["nodes"]:
            raise SystemExit("the nodes and the cores ran different episodes; the comparison is void")
    for side, values in times.items():
        bench.row(through=side, episodes=episodes, ms_per_tick=round(1000 * median(values), 2))
    bench.finish(
        "wall time per tick through the nodes over the cores",
        median(times["nodes"]) / median(times["cores"]), "", at_most=1.15,
    )  # fmt: skip


def run_through_nodes(clients, config: RunConfig, index: int) -> EpisodeResult:
    """Run an episode through the evaluator's service."""
    from roboxim_interfaces.msg import RunConfig as RunConfigMsg
    from roboxim_interfaces.srv import RunEpisodes

    request = RunEpisodes.Request(config=to_msg(config, RunConfigMsg), indices=[index])
    answer = clients.call(RunEpisodes, "evaluator/run_episodes", request, timeout_s=120.0)
    return from_msg(answer.results[0], EpisodeResult)


if __name__ == "__main__":
    main()

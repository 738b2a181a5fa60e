"""Response time of shell commands: ``roboxim service call`` and others, each in a separate process.

For comparison, in turns with them: a bare rclpy script that calls the same service once, as a user would write it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from statistics import median

from benchmarks._harness import Bench

from roboxim_ros.runs import find_run

ROBOXIM = (sys.executable, "-m", "roboxim_bringup")
SERVICE = "/sim/get_simulator_features"
BARE = f"""
import rclpy
from simulation_interfaces.srv import GetSimulatorFeatures as Service
rclpy.init()
node = rclpy.create_node("bare")
client = node.create_client(Service, "{SERVICE}")
assert client.wait_for_service(10.0)
answer = client.call_async(Service.Request())
rclpy.spin_until_future_complete(node, answer)
print(answer.result())
"""
COMMANDS: Mapping[str, tuple[str, ...]] = {
    "service call": (*ROBOXIM, "service", "call", SERVICE),
    "node list": (*ROBOXIM, "node", "list"),
    "topic echo --once": (*ROBOXIM, "topic", "echo", "--once", "/sim/state"),
    "tasks list": (*ROBOXIM, "tasks", "list"),
    "--help": (*ROBOXIM, "--help"),
    "bare rclpy service call": (sys.executable, "-c", BARE),
}


def main() -> None:
    """Measure and print."""
    bench = Bench("cli", __doc__)
    rounds_wanted = 2 if bench.quick else 12
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_RUNTIME_DIR"] = folder
        seconds((*ROBOXIM, "up", "--detach", "-p", "sim:renderer:=tiny"))
        try:
            find_run().join()
            rounds = [{name: seconds(command) for name, command in COMMANDS.items()} for _ in range(rounds_wanted)]
        finally:
            seconds((*ROBOXIM, "down"))
    for name in COMMANDS:
        times = [took[name] for took in rounds]
        bench.row(command=name, median_s=round(median(times), 2), worst_s=round(max(times), 2))
    bench.finish(
        "first response of `roboxim service call`", median(took["service call"] for took in rounds), "s", at_most=1.5
    )


def seconds(command: tuple[str, ...]) -> float:
    """Return the wall time of a command that must succeed [s]."""
    start = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    took = time.perf_counter() - start
    if done.returncode:
        raise SystemExit(f"`{' '.join(command[:5])}` failed: {done.stderr.strip()[-500:]}")
    return took


if __name__ == "__main__":
    main()

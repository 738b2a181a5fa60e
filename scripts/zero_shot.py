"""Runs the zero-shot experiments of the thesis (5.1) with Octo, RT-1-X and OpenVLA: `zero_shot.py --out FOLDER`.

Each policy is either a server that runs already (OCTO_URL, RT1_URL, OPENVLA_URL) or weights, for which this script
starts the server and stops it at the end:

    OCTO_CHECKPOINT     folder, or hf://rail-berkeley/octo-small-1.5
    OCTO_SOURCE         clones of octo-models/octo and kvablack/dlimp, separated by a space
    RT1_CHECKPOINT      folder of the SavedModel rt_1_x_tf_trained_for_002272480_step
    RT1_ENCODER         folder of the SavedModel of Universal Sentence Encoder Large 5
    OPENVLA_CHECKPOINT  folder, or openvla/openvla-7b
    OPENVLA_SOURCE      clone of openvla/openvla
    OPENVLA_PYTHON      Python of OpenVLA's environment (default: OPENVLA_SOURCE/.venv/bin/python)

The same command continues after Ctrl-C. Whatever is missing is named before anything starts.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shlex
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from environments import ROOT

SERVERS = ROOT / "src" / "roboxim_policies" / "servers"
EXPERIMENTS = {  # conventions: the first scene has both cameras; the second imitates that of Google's robot
    "zero_shot": {"octo": "octo_two_cameras", "rt_1_x": "rt1_widowx", "openvla": "bridge"},
    "zero_shot_reenacted": {"octo": "octo_fractal", "rt_1_x": "rt1_fractal", "openvla": "fractal"},
}
FIRST_PORT = 8101
START_S = 1800.0
"""Time in which a server must answer [s]; weights are loaded, and downloaded at the first time."""


@dataclass(frozen=True, kw_only=True)
class Server:
    """How a policy is served."""

    condition: str
    """Condition of the experiments."""
    wire: str
    """Its wire."""
    url: str
    """Address."""
    version: str
    """What the model is, for the report."""
    health: str
    """URL that answers when the server is ready; any HTTP status counts."""
    command: tuple[str, ...] = ()
    """Starts it; empty: it runs already."""
    environment: str = ""
    """Environment under .tools that the command needs."""
    folder: Path = ROOT
    """Working directory of the command."""


def planned(given: Mapping[str, str], first_port: int) -> tuple[list[Server], list[str]]:
    """Return the servers, and what is missing.

    Args:
        given: Environment variables.
        first_port: Port of the first server that is started; the next ones follow.
    """
    missing: list[str] = []

    def value(name: str, what: str) -> str:
        if not given.get(name):
            missing.append(f"{name}: {what}")
        return _absolute(given.get(name, ""))

    def address(name: str, scheme: str, place: int) -> tuple[str, bool]:
        url = given.get(f"{name}_URL", "")
        return url or f"{scheme}://127.0.0.1:{first_port + place}", bool(url)

    servers = []
    url, runs = address("OCTO", "ws", 0)
    checkpoint = given.get("OCTO_CHECKPOINT", "") if runs else value(
        "OCTO_CHECKPOINT", "folder of a checkpoint or hf://rail-berkeley/octo-small-1.5 (or OCTO_URL of a server)"
    )  # fmt: skip
    clones = "" if runs else value("OCTO_SOURCE", "clones of octo-models/octo and kvablack/dlimp")
    sources = [_absolute(one) for one in clones.split()]
    command = [str(ROOT / ".tools/policy-octo-env/bin/python"), str(SERVERS / "octo.py"), "--checkpoint", checkpoint]
    command += [part for source in sources for part in ("--source", source)]
    servers.append(_server("octo", "openpi", url, runs, checkpoint, command, environment="policy-octo"))

    url, runs = address("RT1", "ws", 1)
    checkpoint = given.get("RT1_CHECKPOINT", "") if runs else value(
        "RT1_CHECKPOINT", "folder of the SavedModel rt_1_x_tf_trained_for_002272480_step (or RT1_URL of a server)"
    )  # fmt: skip
    encoder = "" if runs else value("RT1_ENCODER", "folder of the SavedModel of Universal Sentence Encoder Large 5")
    command = [str(ROOT / ".tools/policy-rt1-env/bin/python"), str(SERVERS / "rt1.py"), "--checkpoint", checkpoint]
    command += ["--encoder", encoder]
    servers.append(_server("rt_1_x", "openpi", url, runs, checkpoint, command, environment="policy-rt1"))

    url, runs = address("OPENVLA", "http", 2)
    checkpoint = given.get("OPENVLA_CHECKPOINT", "") if runs else value(
        "OPENVLA_CHECKPOINT", "folder of a checkpoint or openvla/openvla-7b (or OPENVLA_URL of a server)"
    )  # fmt: skip
    source = "" if runs else value("OPENVLA_SOURCE", "clone of openvla/openvla, with its environment in .venv")
    python = str(Path(given.get("OPENVLA_PYTHON") or f"{source}/.venv/bin/python").absolute())
    if source and not runs and not Path(python).exists():
        missing.append(f"OPENVLA_PYTHON: {python} does not exist; name the Python of OpenVLA's environment")
    script = Path(source) / "vla-scripts" / "deploy.py"
    if source and not script.is_file():
        missing.append(f"OPENVLA_SOURCE: {script} does not exist; name a clone of openvla/openvla")
    command = [python, "vla-scripts/deploy.py", "--openvla_path", checkpoint, "--host", "127.0.0.1"]
    servers.append(_server("openvla", "openvla", url, runs, checkpoint, command, folder=Path(source or ROOT)))
    return servers, missing


def _absolute(place: str) -> str:
    """Return a path that exists as an absolute one, since servers start in other folders; anything else as it is."""
    return str(Path(place).absolute()) if place and Path(place).exists() else place


def _server(
    condition: str, wire: str, url: str, runs: bool, checkpoint: str, command: list[str], *, environment: str = "",
    folder: Path = ROOT,
) -> Server:  # fmt: skip
    health = url.replace("ws", "http", 1) + "/healthz" if url.startswith("ws") else url
    return Server(
        condition=condition, wire=wire, url=url, version=checkpoint.rstrip("/").split("/")[-1] or "unknown",
        health=health, command=() if runs else (*command, "--port", url.rsplit(":", 1)[1]), environment=environment,
        folder=folder,
    )  # fmt: skip


def options_of(servers: list[Server], conventions: Mapping[str, str], timeout_s: float) -> list[str]:
    """Return the options by which ``roboxim experiment run`` names the policies."""
    found: list[str] = []
    for server in servers:
        settings = {
            "url": server.url, "convention": conventions[server.condition], "version": server.version,
            "timeout_s": f"{timeout_s:g}",
        }  # fmt: skip
        found += ["--policy", f"{server.condition}={server.wire}"]
        for key, value in settings.items():
            found += ["--option", f"{server.condition}.{key}={value}"]
    return found


@contextlib.contextmanager
def started(server: Server, logs: Path) -> Iterator[None]:
    """Run a server, and wait until it answers.

    Raises:
        SystemExit: When it ends, or does not answer in time; with the end of its log.
    """
    if not server.command:
        yield
        return
    logs.mkdir(parents=True, exist_ok=True)
    path = logs / f"{server.condition}.log"
    with open(path, "wb") as log:
        process = subprocess.Popen(server.command, cwd=server.folder, stdout=log, stderr=subprocess.STDOUT)
        try:
            _wait(server, process, path)
            yield
        finally:
            process.terminate()
            try:
                process.wait(30)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _wait(server: Server, process: subprocess.Popen[bytes], log: Path) -> None:
    print(f"starting {server.condition}: {shlex.join(server.command)}\n  log: {log}", flush=True)
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline:
        if process.poll() is not None:
            tail = "\n".join(log.read_text(errors="replace").splitlines()[-15:])
            sys.exit(f"{tail}\nthe server of {server.condition} ended with code {process.returncode}; see {log}")
        try:
            urllib.request.urlopen(server.health, timeout=5.0).close()
            return
        except urllib.error.HTTPError:  # it answers; OpenVLA's server has no page to ask for
            return
        except OSError:
            time.sleep(1.0)
    sys.exit(f"the server of {server.condition} did not answer at {server.health} within {START_S:g} s; see {log}")


def main() -> int:
    """Check what is there, start the servers, and run the experiments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="runs/zero_shot", help="folder of the runs (default: runs/zero_shot)")
    parser.add_argument("--experiments", default=",".join(EXPERIMENTS), help="default: both")
    parser.add_argument("--scale", default="laptop", help="smoke, laptop or night (default: laptop)")
    parser.add_argument("--workers", type=int, default=1, help="processes that run episodes (default: 1)")
    parser.add_argument(
        "--timeout",
        type=float,
        default=110.0,
        help="deadline of an answer [s], below the evaluator's of 120 (default: 110)",
    )
    parser.add_argument("--first-port", type=int, default=FIRST_PORT, help=f"default: {FIRST_PORT}")
    options = parser.parse_args()
    names = options.experiments.split(",")
    for name in names:
        if name not in EXPERIMENTS:
            parser.error(f"no zero-shot experiment '{name}'; expected one of: {', '.join(EXPERIMENTS)}")
    servers, missing = planned(os.environ, options.first_port)
    if missing:
        print(
            "The zero-shot experiments need weights. Set these variables:\n  " + "\n  ".join(missing), file=sys.stderr
        )
        return 2
    for server in servers:
        if server.command and server.environment:
            made = [sys.executable, str(ROOT / "scripts" / "make_environment.py"), server.environment]
            subprocess.run(made, check=True)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the servers are stopped
    out = Path(options.out).resolve()
    roboxim = str(Path(sys.executable).parent / "roboxim")
    with contextlib.ExitStack() as stack:
        for server in servers:
            stack.enter_context(started(server, out / "servers"))
        for name in names:
            command = [
                roboxim, "experiment", "run", name, "--scale", options.scale, "--out", str(out / name),
                "--workers", str(options.workers), *options_of(servers, EXPERIMENTS[name], options.timeout),
            ]  # fmt: skip
            print(shlex.join(command), flush=True)
            code = subprocess.run(command, cwd=ROOT, check=False).returncode
            if code:
                return code
    return 0


if __name__ == "__main__":
    sys.exit(main())

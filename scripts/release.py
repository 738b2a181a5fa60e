"""Build RoboXim's distributions, install them in empty environments, and run them there: `make release`.

`dist/` receives

- `roboxim` (pure Python), `roboxim-interfaces` and `roboxim-planner-native` (manylinux, for each Python), and
  `lerobot-env-roboxim`, as wheels and source distributions;
- `constraints.txt`: the exact versions that the tests run with.

For each Python an empty environment outside of the checkout then installs the wheels, without a compiler, first
without extras and then with `learn` and `lerobot`, and runs what a user would: `roboxim doctor`, `uvx roboxim`, the
smoke demo, an example of the Python interface, and a graph with a service call. `dist/release.json` has times and
sizes.

The wheels hold no library of ROS: those of the ROS wheels are found when the wheel is used (`ros-wheels-bootstrapper`).
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from environments import (
    LOCKS,
    ROOT,
    TOOLS,
    UV,
    Environment,
    SetupError,
    clean_environment,
    index_settings,
    packages_key,
    run,
    say,
    show_progress,
    step,
)
from set_up import MEMBERS

DIST = ROOT / "dist"
PURE = (ROOT, ROOT / "plugins" / "lerobot_env_roboxim")
LIBRARIES_OF_ROS = ("libfast*", "librcpputils*", "librcutils*", "librmw*", "librosidl*", "lib*__rosidl*")
"""Libraries that the wheels of ROS hold; the interfaces' wheel must not copy them."""
BUILD = ("-m", "build", "--no-isolation", "--skip-dependency-check")
PYTHONS = ("3.11", "3.12", "3.13")
EXTRAS = ("assets", "learn", "lerobot", "pretrained", "ray", "studio", "video", "vla-eval")
"""Extras of `constraints.txt`: all but `store`, whose botocore wants another python-dateutil than matplotlib."""
EXAMPLE = """
import roboxim
evaluation = roboxim.evaluate(policies=["random"], episodes=2, size=64, workers=1, out="example")
assert 0 <= evaluation.success_rate <= 1 and evaluation.report.is_file(), evaluation
print(evaluation.success_rate, evaluation.report)
"""


def interpreter(version: str) -> str:
    """Return the path of a Python.

    Raises:
        SetupError: None is installed.
    """
    found = subprocess.run([UV, "python", "find", version], capture_output=True, text=True, check=False)
    if found.returncode == 0:
        return found.stdout.strip()
    if shutil.which("pyenv"):  # whose Pythons uv does not see unless they are chosen
        found = subprocess.run(["pyenv", "prefix", version], capture_output=True, text=True, check=False)
        if found.returncode == 0:
            return f"{found.stdout.strip()}/bin/python"
    raise SetupError(f"no Python {version} here; install one (uv python install {version}) or leave it out")


def compiled_wheels(version: str) -> list[Path]:
    """Return the wheels of the compiled distributions for a Python, built unless they are kept from before."""
    base = interpreter(version)
    environment = Environment(TOOLS / f"release-{version}-env", base)
    exact = subprocess.run([base, "-c", "import sys; print(sys.version)"], capture_output=True, text=True, check=True)
    wheels = []
    for member in MEMBERS:
        folder = TOOLS / "release" / version / member.name / member.key(exact.stdout.strip())[:16]
        wheel = member.wheel(exact.stdout.strip()) or next(folder.glob("*.whl"), None)
        if wheel is None:
            if not environment.has("packages", packages_key(LOCKS / "build.lock", base)):
                environment.make(LOCKS / "build.lock")
            shutil.rmtree(folder, ignore_errors=True)
            scratch = TOOLS / "release" / version / f"build-{member.name}"
            command = (environment.python, *BUILD, "--wheel", f"--config-setting=build-dir={scratch}")
            run(f"release-{version}-{member.name}", *command, "--outdir", folder, member.folder)
            member.keep(folder)
            wheel = next(folder.glob("*.whl"))
        wheels.append(wheel)
    return wheels


def build_compiled(version: str) -> None:
    """Build the compiled distributions for a Python, and give them the platform tag that package indexes accept."""
    for wheel in compiled_wheels(version):
        repair(wheel)


def repair(wheel: Path) -> None:
    """Check with auditwheel that a wheel runs on other Linux systems, and put it into `dist/` with its tag."""
    tools = TOOLS / "release-env" / "bin"
    excluded = [f"--exclude={pattern}" for pattern in LIBRARIES_OF_ROS]
    run(
        f"auditwheel-{wheel.name}",
        *(tools / "python", "-m", "auditwheel", "repair", "--only-plat", *excluded, "--wheel-dir", DIST, wheel),
        extra={"PATH": f"{tools}:{os.environ['PATH']}"},
    )


def build_pure() -> None:
    """Build the pure distributions, and the source distributions of all."""
    tools = Environment(TOOLS / "release-env")
    for folder in PURE:
        run(f"release-{folder.name}", tools.python, *BUILD, "--outdir", DIST, folder)
    for member in MEMBERS:
        run(f"release-{member.name}-sdist", tools.python, *BUILD, "--sdist", "--outdir", DIST, member.folder)


def write_constraints() -> None:
    """Write the exact versions of everything that `roboxim` and its extras may install, from the locks."""
    run(
        "release-constraints",
        *(UV, "pip", "compile", "--quiet", "--universal", "--python-version", PYTHONS[0], "pyproject.toml"),
        *(part for extra in EXTRAS for part in ("--extra", extra)),
        *("--constraints", LOCKS / "dev.lock", "--no-header", "--no-annotate", "--no-emit-index-url"),
        *("--no-emit-find-links", "--no-sources", "--find-links", DIST, "--output-file", DIST / "constraints.txt"),
        extra=index_settings(),
    )


def try_out(version: str) -> dict[str, Any]:
    """Install the wheels in an empty environment and run them there.

    Returns:
        Seconds of each step, and sizes [MB]: without extras, with `learn` and `lerobot`, what each extra then adds, and
        with all.
    """
    record: dict[str, Any] = {"python": version}
    with tempfile.TemporaryDirectory(prefix="roboxim-release-") as folder:
        home = Path(folder)
        venv = home / "venv"
        settings = {
            **{name: value for name, value in (clean_environment() | index_settings()).items()},
            **{"HOME": folder, "CC": "/bin/false", "CXX": "/bin/false", "UV_CACHE_DIR": str(TOOLS / "release-cache")},
            "PATH": f"{venv / 'bin'}:/usr/bin:/bin",
        }

        def do(name: str, *command: str | Path) -> None:
            begun = time.monotonic()
            done = subprocess.run(
                [str(part) for part in command], cwd=home, env=settings, text=True, check=False,
                stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            )  # fmt: skip
            if done.returncode != 0:
                shown = " ".join(str(part) for part in command)
                raise SetupError(f"{done.stdout[-3000:]}\n`{shown}` failed on Python {version}")
            record[name] = round(time.monotonic() - begun, 1)
            say(f"    {name.removesuffix('_s')}: {record[name]} s")

        def install(name: str, what: str) -> None:
            do(
                name,
                *(UV, "pip", "install", "--python", venv / "bin" / "python", "--find-links", DIST),
                *("--constraints", DIST / "constraints.txt", what),
            )

        do("environment_s", UV, "venv", "--python", interpreter(version), venv)
        install("install_s", "roboxim")
        record["base_mb"] = round(size_of(venv) / 1e6)
        do("doctor_s", "roboxim", "doctor")
        do(
            "tool_run_s",
            *(UV, "tool", "run", "--python", interpreter(version), "--find-links", DIST),
            *("--constraints", DIST / "constraints.txt", "roboxim", "--version"),
        )
        do("generate_s", "roboxim", "generate", "--episodes", "1", "--size", "64", "--out", "one")
        refused = subprocess.run(
            ["roboxim", "train", "bc", "none", "--out", "bc"], cwd=home, env=settings, capture_output=True, text=True
        )
        if "roboxim[learn]" not in refused.stderr:
            raise SetupError(f"`roboxim train bc` does not name its extra: {refused.stderr[-2000:]}")
        do("example_s", "python", "-c", EXAMPLE)
        do("graph_s", "bash", "-c", GRAPH)
        do("new_server_s", "roboxim", "policy", "new-server")
        install("install_extras_s", "roboxim[learn,lerobot]")
        record["extras_mb"] = round(size_of(venv) / 1e6)
        do("smoke_demo_s", "roboxim", "demo", "--smoke", "--out", "demo")
        for extra in EXTRAS:
            before = size_of(venv)
            install(f"install_{extra}_s", f"roboxim[{extra}]")
            record[f"{extra}_mb"] = round((size_of(venv) - before) / 1e6)
        record["all_extras_mb"] = round(size_of(venv) / 1e6)
        do("doctor_with_extras_s", "roboxim", "doctor")
    return record


GRAPH = """
set -e
roboxim up > up.log 2>&1 &
for _ in $(seq 120); do roboxim node list 2>/dev/null | grep -q sim && break; sleep 1; done
roboxim service call /sim/get_simulator_features
roboxim down
wait
"""
"""A running graph, a service call, and the graph's end."""


def size_of(folder: Path) -> int:
    """Return the bytes below a folder."""
    return sum(path.lstat().st_size for path in folder.rglob("*") if not path.is_dir())


def main() -> int:
    """Build, check and try out the distributions."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", action="append", choices=PYTHONS, help="only for this Python; may be repeated")
    parser.add_argument("--no-build", action="store_true", help="try out what dist/ holds")
    parser.add_argument("--no-try", action="store_true", help="only build")
    options = parser.parse_args()
    versions = options.python or list(PYTHONS)
    threading.Thread(target=show_progress, args=(threading.Event(),), daemon=True).start()
    try:
        if not options.no_build:
            shutil.rmtree(DIST, ignore_errors=True)
            for version in versions:
                with step(f"compiled distributions for Python {version}"):
                    build_compiled(version)
            with step("pure and source distributions"):
                build_pure()
            with step("constraints"):
                write_constraints()
        records = []
        for version in () if options.no_try else versions:
            with step(f"Python {version}: install and run"):
                records.append(try_out(version))
    except SetupError as error:
        say(f"make release: {error}")
        return 1
    sizes = {path.name: round(path.stat().st_size / 1e6, 2) for path in sorted(DIST.glob("*roboxim*"))}
    (DIST / "release.json").write_text(json.dumps({"files_mb": sizes, "environments": records}, indent=2))
    say((DIST / "release.json").read_text())
    return 0


if __name__ == "__main__":
    sys.exit(main())

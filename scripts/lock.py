"""Generate the locks in `requirements/` from the requirements in the pyproject.toml files.

A lock names every package with its version and the hashes of its files, but no index, so it installs from any index.
Locked versions do not change unless a requirement demands it or `--upgrade` is given.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import tomllib

from environments import EVERY_PYTHON, LOCKS, ROOT, UV, clean_environment, index_settings

MEMBERS = [ROOT / "src" / name / "pyproject.toml" for name in ("roboxim_interfaces", "roboxim_planner_native")]

UNUSED_BY_VERIFICATION = (
    "cmake", "cuda-", "egl-probe", "evdev", "imageio-ffmpeg", "nvidia-", "pynput", "python-xlib", "rerun-sdk",
    "tensorboard", "torchcodec", "triton", "wandb",
)  # fmt: skip
"""Prefixes of packages that lerobot or robomimic require but that reading a dataset does not import: NVIDIA's
libraries of 2.5 GB (see `scripts/torch_on_cpu.py`), input devices, viewers. torchcodec needs a system's FFmpeg."""

UNUSED_BY_RT1 = ("pygame", "tensorflow==")
"""Prefixes of packages that tf-agents and tensorflow-text require but that a policy does not import: games, and the
package tensorflow, whose place tensorflow-cpu takes."""
UNUSED_BY_ROBOTS = ("glfw", "mujoco", "pyopengl", "trossen-arm==")
"""Prefixes of packages that trossen-arm-sim requires but that reading its MJCF does not import."""
OTHER_FOR_SCALE = ("python-dateutil",)
"""Packages of which botocore (S3) needs another version than dev.lock has."""


def build_requirements() -> list[str]:
    """Return the build requirements of the compiled distributions."""
    needed = [tomllib.loads(member.read_text())["build-system"]["requires"] for member in MEMBERS]
    return sorted({requirement for requirements in needed for requirement in requirements})


def group(name: str) -> list[str]:
    """Return a dependency group of the root project."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["dependency-groups"][name]


def lock(name: str, requirements: list[str], *options: str, without: tuple[str, ...] = ()) -> None:
    """Resolve requirements into `requirements/NAME.lock`, without the packages whose names start as given."""
    command = [
        *(UV, "pip", "compile", "--quiet", "--python-version", "3.11", "--generate-hashes"),
        *(("--universal",) if name in EVERY_PYTHON else ()),
        *("--no-header", "--no-annotate", "--no-emit-index-url", "--no-emit-find-links"),
        *("--output-file", LOCKS / f"{name}.lock", *options),
        *(() if options and "pyproject.toml" in options else ("-",)),
    ]
    subprocess.run(
        [str(part) for part in command],
        cwd=ROOT,
        env=clean_environment() | index_settings(),
        input="\n".join(requirements),
        text=True,
        check=True,
    )
    packages = re.split(r"^(?=[a-z0-9])", (LOCKS / f"{name}.lock").read_text(), flags=re.MULTILINE)
    text = "".join(package for package in packages if not (without and package.startswith(without)))
    (LOCKS / f"{name}.lock").write_text(text)
    if "://" in text:
        sys.exit(f"requirements/{name}.lock names a host; a lock must install from any index")
    print(f"requirements/{name}.lock: {sum(line[:1].isalnum() for line in text.splitlines())} packages")


def lock_added(name: str, *options: str) -> None:
    """Resolve the packages that are added to the environment of dev.lock, with that one's versions."""
    pinned = re.findall(
        r"^([a-z0-9][^=]*)==(\S+)(?: \\| ; python_full_version)", (LOCKS / "dev.lock").read_text(), flags=re.MULTILINE
    )  # without those that dev.lock has for other systems only
    constraints = [f"{package}=={version}" for package, version in pinned if package not in OTHER_FOR_SCALE]
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as file:
        file.write("\n".join(constraints))
        file.flush()
        there = tuple(f"{constraint} " for constraint in constraints)
        unused = UNUSED_BY_ROBOTS if name == "robots" else ()
        lock(name, group(name), "--constraints", file.name, *options, without=(*there, *unused))


def main() -> None:
    """Make every lock."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--upgrade", action="store_true", help="use the newest versions that the requirements allow")
    upgrade = ["--upgrade"] if parser.parse_args().upgrade else []
    lock("installer", group("installer"), *upgrade)
    ours = [part for name in ("interfaces", "planner-native") for part in ("--no-emit-package", f"roboxim-{name}")]
    extras = [part for name in ("assets", "learn", "lerobot", "pretrained", "studio") for part in ("--extra", name)]
    lock("dev", [], "pyproject.toml", "--group", "dev", *extras, *ours, *upgrade)
    for name in ("scale", "robots"):
        lock_added(name, *upgrade)
    lock("build", build_requirements() + group("build"), *upgrade)
    lock("release", group("release"), *upgrade)
    lock("colcon", build_requirements() + group("colcon"), *upgrade)
    for name in (
        "verify-rlds",
        "planner-mplib",
        "planner-roboplan",
        "robosuite",
        "photo",
        "docs",
        "policy-octo",
        "verify-conventions",
    ):
        lock(name, group(name), *upgrade)
    lock("policy-rt1", group("policy-rt1"), *upgrade, without=UNUSED_BY_RT1)
    for name in ("verify-encoders", "verify-lerobot", "verify-lerobot-2"):
        lock(name, group(name), *upgrade, without=UNUSED_BY_VERIFICATION)


if __name__ == "__main__":
    main()

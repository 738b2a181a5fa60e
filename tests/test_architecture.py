"""Architecture rules: which package may import which, and that no core needs ROS."""

import ast
import subprocess
import sys
import tomllib
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

SRC = Path(__file__).resolve().parents[1] / "src"
ROOMS = ["sim", "planner", "tasks", "recorder", "eval", "policies"]
NODE_MODULES = {"node", "conversions", "ports", "ros", "tick_messages", "controllers"}
"""Modules of a room that may use rclpy or messages."""
EVERY_ROOM = {"roboxim_core", "roboxim_datasets", "roboxim_ros", "roboxim_interfaces"} | {
    f"roboxim_{room}" for room in ROOMS
}
ALLOWED = {
    "roboxim_core": {"roboxim_planner_native"},  # inverse kinematics of the delta controller
    "roboxim_datasets": {"roboxim_core"},
    "roboxim_ros": {"roboxim_core", "roboxim_interfaces"},
    **{f"roboxim_{room}": {"roboxim_core", "roboxim_ros", "roboxim_interfaces"} for room in ROOMS},
    **{
        f"roboxim_{room}": {"roboxim_core", "roboxim_ros", "roboxim_datasets", "roboxim_interfaces"}
        for room in ["recorder", "policies"]
    },
    "roboxim_planner": {"roboxim_core", "roboxim_ros", "roboxim_interfaces", "roboxim_planner_native"},
    "roboxim_bringup": EVERY_ROOM,
    "roboxim_runs": EVERY_ROOM | {"roboxim_bringup"},
    "roboxim_studio": EVERY_ROOM | {"roboxim_bringup", "roboxim_runs"},
    "roboxim_cli": EVERY_ROOM | {"roboxim_bringup", "roboxim_runs", "roboxim_studio"},
    "roboxim": {"roboxim_core", "roboxim_bringup", "roboxim_runs", "roboxim_studio", "roboxim_cli", "roboxim_policies"},
}
ROS_FREE_KIT = {
    "roboxim_ros.peer_user",
    *(f"roboxim_ros.messages.{name}" for name in ("conversions", "packing", "schemas", "serialising")),
}
"""Modules of the node kit that need no rclpy, so that a core may use them."""


def modules(package):
    root = SRC / package / package
    return sorted(path for path in root.rglob("*.py"))


@cache
def parsed(path):
    return ast.parse(path.read_text())


@cache
def nodes(path):
    return tuple(ast.walk(parsed(path)))


@cache
def imports_of(path):
    names = []
    for node in nodes(path):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.append(node.module)
    return names


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_packages_import_only_what_the_table_allows(package):
    assert modules(package), f"{package} has no modules"
    for path in modules(package):
        ours = {name.split(".")[0] for name in imports_of(path) if name.startswith("roboxim")}
        assert ours - {package} <= ALLOWED[package], (
            f"{path.relative_to(SRC)} imports {ours - {package} - ALLOWED[package]}"
        )


def module_name(path, package):
    return ".".join(path.relative_to(SRC / package).with_suffix("").parts).removesuffix(".__init__")


def imported_anywhere(path, names):
    """Yield the modules of a package that a module names anywhere: at its top, inside functions, for type checkers."""
    for node in nodes(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            for alias in node.names:
                found = f"{node.module}.{alias.name}"
                yield from {found if found in names else node.module} & names


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_no_package_has_an_import_circle(package):
    paths = {module_name(path, package): path for path in modules(package)}
    graph = {name: {*imported_anywhere(path, paths.keys())} - {name} for name, path in paths.items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"modules import each other: {' <- '.join(error.args[1])}")


def test_no_folder_is_crowded_and_no_module_repeats_its_folder():
    house = {"roboxim_bringup", "roboxim_runs", "roboxim_cli"}
    for package in ALLOWED:
        for folder in {path.parent for path in modules(package)}:
            names = {path.stem for path in folder.glob("*.py")} - {"__init__"}
            most = 14 if package in house else 20
            where = folder.relative_to(SRC)
            assert len(names) <= most, f"{where} has {len(names)} modules, at most {most}"
            if package in house:
                repeated = {name for name in names if name.removesuffix("s") == folder.name.removesuffix("s")}
                assert not repeated, f"{where}: {repeated} repeats its folder's name"


def core_modules():
    for package in ["roboxim_core", "roboxim_datasets", *(f"roboxim_{room}" for room in ROOMS)]:
        for path in modules(package):
            if path.stem not in NODE_MODULES:
                name = ".".join(path.relative_to(SRC / package).with_suffix("").parts)
                yield name.removesuffix(".__init__")


@pytest.mark.thorough
def test_cores_import_without_rclpy():
    script = f"""
import importlib, sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name == "rclpy" or name.startswith("rclpy."):
            raise ImportError("rclpy is blocked")
sys.meta_path.insert(0, Block())
failed = []
for name in {list(core_modules())!r}:
    try:
        importlib.import_module(name)
    except ImportError as error:
        failed.append(f"{{name}}: {{error}}")
sys.exit("\\n".join(failed) or 0)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr


def test_cores_name_no_ros_module():
    for package in ["roboxim_core", "roboxim_datasets", *(f"roboxim_{room}" for room in ROOMS)]:
        for path in modules(package):
            if path.stem in NODE_MODULES:
                continue
            for name in imports_of(path):
                ros = name.split(".")[0] in {"rclpy", "roboxim_interfaces"} or (
                    name.startswith("roboxim_ros") and name not in ROS_FREE_KIT
                )
                assert not ros, f"{path.relative_to(SRC)} is a core module and imports {name}"


def test_ros_calls_that_hang_are_not_used():
    banned = ["spin_until_" + "future_complete", "Events" + "Executor", "os." + "fork("]
    for package in ALLOWED:
        for path in modules(package):
            text = path.read_text()
            for word in banned:
                assert word not in text, f"{path.relative_to(SRC)} uses {word}"


def test_every_callback_of_a_node_is_guarded():
    raw = {"create_service", "create_subscription", "create_timer", "ActionServer", "Node"}
    for package in (f"roboxim_{room}" for room in ROOMS):
        for path in modules(package):
            for node in nodes(path):
                if not isinstance(node, ast.Call):
                    continue
                name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
                of_node = isinstance(node.func, ast.Attribute) and ast.unparse(node.func.value) != "self"
                assert name not in raw or (of_node and name == "create_subscription"), (
                    f"{path.relative_to(SRC)}:{node.lineno} calls {name}; use RoboximNode.serve, hear or serve_action"
                )
            for node in nodes(path):
                if isinstance(node, ast.ClassDef):
                    bases = {ast.unparse(base).rpartition(".")[2] for base in node.bases}
                    assert "Node" not in bases, f"{path.relative_to(SRC)}: {node.name} must derive from RoboximNode"


def test_error_codes_are_mirrored():
    from roboxim_interfaces.msg import ErrorCode as Message

    from roboxim_core.errors import ErrorCode

    for code in ErrorCode:
        assert getattr(Message, code.name) == code


def test_only_the_command_and_the_view_of_notebooks_import_the_studio_and_only_when_they_run():
    """Its libraries cost time to import, and no run may depend on a page."""
    importers = {
        path.relative_to(SRC): parsed(path)
        for package in ALLOWED
        if package != "roboxim_studio"
        for path in modules(package)
        if any(name.split(".")[0] in ("roboxim_studio", "viser") for name in imports_of(path))
    }
    assert {str(path) for path in importers} == {
        "roboxim/roboxim/__init__.py", "roboxim_cli/roboxim_cli/commands/studio.py",
    }  # fmt: skip
    for tree in importers.values():
        top = [ast.unparse(node) for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]  # no `if TYPE`
        assert not [line for line in top if "roboxim_studio" in line or "viser" in line]


def test_every_package_is_type_checked_and_built():
    project = tomllib.loads((SRC.parent / "pyproject.toml").read_text())
    checked = set(project["tool"]["mypy"]["packages"])
    built = {Path(path).name for path in project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]}
    python_packages = {path.parent.name for path in SRC.glob("*/setup.py")}
    assert checked == built == python_packages


def test_only_the_video_worker_imports_pyav():
    """Its wheel bundles GPL codecs, so it stays in a process of its own; see docs/how-to/data.md."""
    importers = {
        path.relative_to(SRC)
        for package in ALLOWED
        for path in modules(package)
        if any(name.split(".")[0] == "av" for name in imports_of(path))
    }
    worker = Path("roboxim_datasets/roboxim_datasets/video/worker.py")
    assert importers == {worker}
    name = "roboxim_datasets.video.worker"
    users = [path for package in ALLOWED for path in modules(package) if name in imports_of(path)]
    assert not users


def test_no_module_imports_an_optional_package_when_it_is_imported():
    for path in SRC.glob("roboxim*/roboxim*/**/*.py"):
        for node in parsed(path).body:
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not {name.partition(".")[0] for name in names} & {"ray", "fsspec", "s3fs"}, path


def test_commands_are_made_by_strict_which_refuses_options_given_twice():
    for path in modules("roboxim_cli"):
        for word in ("@click.command(", "@click.group(", "click.Group)"):
            if path.stem != "strict":
                assert word not in path.read_text(), f"{path.relative_to(SRC)}: use roboxim_cli.strict, not {word}"

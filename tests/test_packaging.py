"""Facts that several packaging files state agree."""

import re
import tomllib
from pathlib import Path
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
INTERFACES = ROOT / "src" / "roboxim_interfaces"
MANIFESTS = sorted(ROOT.glob("src/**/package.xml"))
PYTHON_PACKAGES = sorted(path.parent.name for path in ROOT.glob("src/*/setup.py"))


def depends(manifest: Path, tag: str) -> set[str]:
    """Return what a package.xml depends on by one kind of tag."""
    return {element.text for element in ElementTree.parse(manifest).getroot().iter(tag) if element.text}


def test_locks_install_from_any_index() -> None:
    locks = list((ROOT / "requirements").glob("*.lock"))
    assert locks
    for lock in locks:
        text = lock.read_text()
        assert "://" not in text, lock
        assert not re.search(r"^-", text, re.MULTILINE), lock
        for requirement in re.split(r"\n(?! )", text.strip()):
            assert re.match(r"[\w.-]+(\[[\w,-]+\])?==\S+", requirement), requirement
            assert "--hash=sha256:" in requirement, requirement


def test_every_distribution_has_its_licences() -> None:
    own = (ROOT / "LICENSE").read_text()
    for pyproject in ROOT.glob("*/*/pyproject.toml"):
        assert (pyproject.parent / "LICENSE").read_text() == own, "its build puts this file into the wheel"
    texts = {path for pattern in PROJECT["project"]["license-files"] for path in ROOT.glob(pattern)}
    assert set(ROOT.glob("config/**/LICENSE*")) < texts
    meshes = [path for suffix in ("glb", "stl") for path in ROOT.glob(f"config/*/*/**/*.{suffix}")]
    parts = {ROOT.joinpath(*path.relative_to(ROOT).parts[:3]) for path in meshes}
    assert len(parts) > 10
    assert [str(part) for part in parts if not (part / "LICENSE").is_file()] == [], "others made them"
    said = {
        "Redistribution and use": "BSD-3-Clause",
        "Apache License": "Apache-2.0",
        "MIT License": "MIT",
        "zlib": "Zlib",
    }
    found = {name for text, name in said.items() if any(text in path.read_text() for path in texts)}
    assert set(PROJECT["project"]["license"].split(" AND ")) == found == set(said.values())


def test_pixi_names_every_library() -> None:
    conda = {
        "msgpack": "msgpack-python",
        "opencv-python-headless": "opencv",
        "pin": "pinocchio",
        "ruamel-yaml": "ruamel.yaml",
    }
    pixi = tomllib.loads((ROOT / "pixi.toml").read_text())
    named = pixi["dependencies"].keys() | pixi["pypi-dependencies"].keys()
    required = {re.match(r"[\w-]+", one)[0] for one in PROJECT["project"]["dependencies"]}  # type: ignore[index]
    own = {one for one in required if one.startswith(("ros-", "roboxim-"))} | {"pybullet-arm64"}
    assert {conda.get(one, one) for one in required - own} - named == set()


def test_root_installs_every_python_package() -> None:
    built = PROJECT["tool"]["hatch"]["build"]
    assert sorted(built["dev-mode-dirs"]) == [f"src/{name}" for name in PYTHON_PACKAGES]
    assert sorted(built["targets"]["wheel"]["packages"]) == [f"src/{name}/{name}" for name in PYTHON_PACKAGES]


@pytest.mark.parametrize("name", PYTHON_PACKAGES)
def test_package_is_also_a_colcon_package(name: str) -> None:
    folder = ROOT / "src" / name
    assert (folder / "resource" / name).exists()
    assert (folder / name / "__init__.py").exists()
    assert not (folder / "pyproject.toml").exists(), "colcon would build it with that instead of setup.py"
    setup = (folder / "setup.py").read_text()
    assert f'name="{name}"' in setup
    assert f'version="{PROJECT["project"]["version"]}"' in setup


@pytest.mark.parametrize("manifest", MANIFESTS, ids=lambda path: path.parent.name)
def test_manifest_has_the_current_version(manifest: Path) -> None:
    root = ElementTree.parse(manifest).getroot()
    assert root.findtext("name") == manifest.parent.name
    assert root.findtext("version") == PROJECT["project"]["version"]


def test_interfaces_name_the_same_dependencies_everywhere() -> None:
    cmake = re.search(r"DEPENDENCIES\s+([\w\s]+)\)", (INTERFACES / "CMakeLists.txt").read_text())
    assert cmake is not None
    packages = set(cmake[1].split())
    assert depends(INTERFACES / "package.xml", "depend") == packages
    standard = {path.name for path in (INTERFACES / "standard").iterdir()}
    wheels = {f"ros-jazzy-{name.replace('_', '-')}" for name in packages - standard}
    distribution = tomllib.loads((INTERFACES / "pyproject.toml").read_text())
    required = {re.split("[~=]=", requirement)[0] for requirement in distribution["project"]["dependencies"]}
    assert required == wheels
    assert wheels <= {requirement.split("==")[0] for requirement in distribution["build-system"]["requires"]}


def test_every_distribution_has_the_current_version() -> None:
    version = PROJECT["project"]["version"]
    for pyproject in ROOT.glob("*/*/pyproject.toml"):
        assert tomllib.loads(pyproject.read_text())["project"]["version"] == version, pyproject
    own = [one for one in PROJECT["project"]["dependencies"] if one.startswith("roboxim-")]
    assert own == [f"roboxim-{name}=={version}" for name in ("interfaces", "planner-native")]
    assert f"version: {version}\n" in (ROOT / "CITATION.cff").read_text()

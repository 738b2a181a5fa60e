"""The standard types that are generated here equal those of an ordinary ROS 2 Jazzy installation.

ROS 2 peers compare type hashes (REP-2011). A hash covers names, types and order of all fields, recursively, but neither
constants nor default values. The expected hashes were taken from builds of the original packages.
"""

import importlib
import json
from pathlib import Path

import pytest

HASHES = {
    "simulation_interfaces/msg/Bounds": "e8624fe51f0f5548197542697d924c5699ac7198f1e4c68e50c3ca2af73f5b3f",
    "simulation_interfaces/msg/EntityCategory": "43bdf7933fddf75f6970f7a8fe7078524355d821d390b3954bb46ac36c03dfe1",
    "simulation_interfaces/msg/EntityFilters": "8e7b12e8ea062f14c55de4877221fe1b7cd9749665a7ad8a4ab855fc4b148303",
    "simulation_interfaces/msg/EntityInfo": "3b9a2e7fa00f9a59d325b6e47904044c421561a385682027c7fc06c359806319",
    "simulation_interfaces/msg/EntityState": "2e0464a85eb80a939025075d6c20761eca6a4cb9d6baf2c0ba373467c8b598d0",
    "simulation_interfaces/msg/NamedPose": "b32da2a039b1840f605ec025b7991a18efacac662fac272818d1ae6e2b12bc27",
    "simulation_interfaces/msg/Resource": "2bb1939cf80f8d2f284afba53cbec60b5ff33759bd39b714128ea8867a34c51a",
    "simulation_interfaces/msg/Result": "cf43a306adff3337a0a47143d8f5689933bc70a30478f13b077dc1fe3bc5ad17",
    "simulation_interfaces/msg/SimulatorFeatures": "8b101c8529bc0ea3dcf056078254768f39832b9ef0adaf93bd5cea96c0de3305",
    "simulation_interfaces/msg/Spawnable": "8675aa686f0df1ed7874a6ec210fdce1ac1c07f4e49fc26ec7fb6fe729f6772e",
    "simulation_interfaces/msg/TagsFilter": "5c3efc51e8ed04c266c09cb4691ec95b964cd410558e01d8c83646b038826b45",
    "simulation_interfaces/srv/GetEntities": "cb90004c48cd50f37732fb008e22c34c261dd680a723bf0f85d8437ea4498bf7",
    "simulation_interfaces/srv/GetEntitiesStates": "0a76170d0c1c90e1eaf805cfab78ea801d1f82df309a28c1f0fae4b570f19754",
    "simulation_interfaces/srv/GetEntityBounds": "17be8d36231178a5eed0de0344b55c19975581627a9aec30a4fee9926a35deed",
    "simulation_interfaces/srv/GetNamedPoses": "c3d12ab920115bfd4733f6d20516adc3968fb438538540997c37e200e02b04e3",
    "simulation_interfaces/srv/GetSimulationState": "3362dcebee4b1afebbf9c4beee5c79c1455385aded62092a892d61fde8644f30",
    "simulation_interfaces/srv/GetSpawnables": "3e25fd827d8bcbd9db5e36ccb190efa22d6f6313897861268ab923bf091a992a",
    "simulation_interfaces/srv/ResetSimulation": "4ce285d7ff9b8ac70dcc95161f32bf54c05a6f4b13427990e41ab40c36c39646",
    "simulation_interfaces/srv/SpawnEntity": "66860313e11009faddbfc8568e5d410d1a11607fe75eeb1308671dc0406fe3a7",
    "simulation_interfaces/srv/StepSimulation": "913fe0653690ce6bf8f09f316e6a626747012e9fca31e26719910d417aa8565c",
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "visualization_msgs/msg/Marker": "45b13ccf791f225962bf74e746f9644518855d783a6f42ba0cc14fde2b4f3ce0",
    "visualization_msgs/msg/MarkerArray": "86cb8800b6fb05b5eff1abd7a56f62a5641d3ae9a1c29e78e67e704f1d067dcf",
}

FIELDS = {
    "control_msgs/msg/GripperCommand": ["position", "max_effort"],
    "control_msgs/msg/JointTolerance": ["name", "position", "velocity", "acceleration"],
    "control_msgs/msg/JointComponentTolerance": ["joint_name", "component", "position", "velocity", "acceleration"],
}


def described(name: str) -> dict:
    """Return the generated description and hashes of an interface, as parsed JSON."""
    package, kind, type_name = name.split("/")
    module = importlib.import_module(package).__file__
    assert module is not None
    prefix = Path(module).parents[4]  # <prefix>/lib/python3.11/site-packages/<package>/__init__.py
    return json.loads((prefix / "share" / package / kind / f"{type_name}.json").read_text())


@pytest.mark.parametrize("name", HASHES)
def test_type_has_the_hash_of_the_standard(name: str) -> None:
    hashes = {entry["type_name"]: entry["hash_string"] for entry in described(name)["type_hashes"]}
    assert hashes[name] == f"RIHS01_{HASHES[name]}"


@pytest.mark.parametrize("name", FIELDS)
def test_type_has_the_fields_of_the_standard(name: str) -> None:
    fields = described(name)["type_description_msg"]["type_description"]["fields"]
    assert [field["name"] for field in fields] == FIELDS[name]

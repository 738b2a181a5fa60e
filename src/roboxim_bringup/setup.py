"""For colcon only; see the root's pyproject.toml for the installation with pip and uv."""

from setuptools import find_packages, setup

setup(
    name="roboxim_bringup",
    version="0.1.0",
    packages=find_packages(include=["roboxim_bringup", "roboxim_bringup.*"]),
    package_data={"roboxim_bringup": ["**/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/roboxim_bringup"]),
        ("share/roboxim_bringup", ["package.xml"]),
        ("share/roboxim_bringup/launch", ["launch/graph.launch.py"]),
    ],
    entry_points={
        "console_scripts": [
            f"{name} = roboxim_bringup.node_main:{name}"
            for name in ("sim", "planner", "tasks", "recorder", "evaluator")
        ]
    },
    zip_safe=False,
)

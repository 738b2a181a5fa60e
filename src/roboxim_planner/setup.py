"""For colcon only; see the root's pyproject.toml for the installation with pip and uv."""

from setuptools import find_packages, setup

setup(
    name="roboxim_planner",
    version="0.1.0",
    packages=find_packages(include=["roboxim_planner", "roboxim_planner.*"]),
    package_data={"roboxim_planner": ["**/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/roboxim_planner"]),
        ("share/roboxim_planner", ["package.xml"]),
    ],
    zip_safe=False,
)

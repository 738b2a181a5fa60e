"""For colcon only; see the root's pyproject.toml for the installation with pip and uv."""

from setuptools import find_packages, setup

setup(
    name="roboxim_recorder",
    version="0.1.0",
    packages=find_packages(include=["roboxim_recorder", "roboxim_recorder.*"]),
    package_data={"roboxim_recorder": ["**/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/roboxim_recorder"]),
        ("share/roboxim_recorder", ["package.xml"]),
    ],
    zip_safe=False,
)

"""For colcon only; see the root's pyproject.toml for the installation with pip and uv."""

from setuptools import find_packages, setup

setup(
    name="roboxim",
    version="0.1.0",
    packages=find_packages(include=["roboxim", "roboxim.*"]),
    package_data={"roboxim": ["**/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/roboxim"]),
        ("share/roboxim", ["package.xml"]),
    ],
    zip_safe=False,
)

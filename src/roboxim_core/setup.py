"""For colcon only; see the root's pyproject.toml for the installation with pip and uv."""

from setuptools import find_packages, setup

setup(
    name="roboxim_core",
    version="0.1.0",
    packages=find_packages(include=["roboxim_core", "roboxim_core.*"]),
    package_data={"roboxim_core": ["**/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/roboxim_core"]),
        ("share/roboxim_core", ["package.xml"]),
    ],
    zip_safe=False,
)

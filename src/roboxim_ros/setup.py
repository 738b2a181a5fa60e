"""For colcon only; see the root's pyproject.toml for the installation with pip and uv."""

from setuptools import find_packages, setup

setup(
    name="roboxim_ros",
    version="0.1.0",
    packages=find_packages(include=["roboxim_ros", "roboxim_ros.*"]),
    package_data={"roboxim_ros": ["**/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/roboxim_ros"]),
        ("share/roboxim_ros", ["package.xml"]),
    ],
    zip_safe=False,
)

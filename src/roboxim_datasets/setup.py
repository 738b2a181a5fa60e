"""For colcon only; see the root's pyproject.toml for the installation with pip and uv."""

from setuptools import find_packages, setup

setup(
    name="roboxim_datasets",
    version="0.1.0",
    packages=find_packages(include=["roboxim_datasets", "roboxim_datasets.*"]),
    package_data={"roboxim_datasets": ["**/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/roboxim_datasets"]),
        ("share/roboxim_datasets", ["package.xml"]),
    ],
    zip_safe=False,
)

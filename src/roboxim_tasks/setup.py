"""For colcon only; see the root's pyproject.toml for the installation with pip and uv."""

from setuptools import find_packages, setup

setup(
    name="roboxim_tasks",
    version="0.1.0",
    packages=find_packages(include=["roboxim_tasks", "roboxim_tasks.*"]),
    package_data={"roboxim_tasks": ["**/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/roboxim_tasks"]),
        ("share/roboxim_tasks", ["package.xml"]),
    ],
    zip_safe=False,
)

"""For colcon only; see the root's pyproject.toml for the installation with pip and uv."""

from setuptools import find_packages, setup

setup(
    name="roboxim_runs",
    version="0.1.0",
    packages=find_packages(include=["roboxim_runs", "roboxim_runs.*"]),
    package_data={"roboxim_runs": ["**/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/roboxim_runs"]),
        ("share/roboxim_runs", ["package.xml"]),
    ],
    zip_safe=False,
)

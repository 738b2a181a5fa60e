"""For colcon only; see the root's pyproject.toml for the installation with pip and uv."""

from setuptools import find_packages, setup

setup(
    name="roboxim_studio",
    version="0.1.0",
    packages=find_packages(include=["roboxim_studio", "roboxim_studio.*"]),
    package_data={"roboxim_studio": ["**/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/roboxim_studio"]),
        ("share/roboxim_studio", ["package.xml"]),
    ],
    zip_safe=False,
)

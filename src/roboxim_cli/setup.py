"""For colcon only; see the root's pyproject.toml for the installation with pip and uv."""

from setuptools import find_packages, setup

setup(
    name="roboxim_cli",
    version="0.1.0",
    packages=find_packages(include=["roboxim_cli", "roboxim_cli.*"]),
    package_data={"roboxim_cli": ["**/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/roboxim_cli"]),
        ("share/roboxim_cli", ["package.xml"]),
    ],
    entry_points={"console_scripts": ["roboxim = roboxim_cli.main:main"]},
    zip_safe=False,
)

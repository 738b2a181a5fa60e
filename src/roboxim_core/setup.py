"""For colcon only; see the root's pyproject.toml for the installation with pip and uv."""

import os

from setuptools import find_packages, setup


def configuration():
    """Return the YAML files of the checkout, to be installed as <prefix>/config, where roboxim_core looks."""
    root = os.path.join("..", "..")
    folders = os.walk(os.path.join(root, "config"))
    return [(os.path.relpath(path, root), [os.path.join(path, name) for name in names]) for path, _, names in folders]


setup(
    name="roboxim_core",
    version="0.1.0",
    packages=find_packages(include=["roboxim_core", "roboxim_core.*"]),
    package_data={"roboxim_core": ["**/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/roboxim_core"]),
        ("share/roboxim_core", ["package.xml"]),
        *configuration(),
    ],
    zip_safe=False,
)

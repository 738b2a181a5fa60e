"""For colcon only; see the root's pyproject.toml for the installation with pip and uv."""

import os

from setuptools import find_packages, setup


def configuration(folder, target=""):
    """Return the files of a folder of the checkout, to be installed below <prefix>/<target>."""
    root = os.path.join("..", "..")
    return [
        (os.path.join(target, os.path.relpath(path, root)), [os.path.join(path, name) for name in names])
        for path, _, names in os.walk(os.path.join(root, folder))
    ]


setup(
    name="roboxim_core",
    version="0.1.0",
    packages=find_packages(include=["roboxim_core", "roboxim_core.*"]),
    package_data={"roboxim_core": ["**/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/roboxim_core"]),
        ("share/roboxim_core", ["package.xml"]),
        *configuration("config"),  # where roboxim_core looks
        *configuration(os.path.join("config", "robots"), "share/roboxim_core"),  # package:// of /robot_description
    ],
    zip_safe=False,
)

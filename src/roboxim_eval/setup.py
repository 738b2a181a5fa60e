"""For colcon only; see the root's pyproject.toml for the installation with pip and uv."""

from setuptools import find_packages, setup

setup(
    name="roboxim_eval",
    version="0.1.0",
    packages=find_packages(include=["roboxim_eval", "roboxim_eval.*"]),
    package_data={"roboxim_eval": ["**/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/roboxim_eval"]),
        ("share/roboxim_eval", ["package.xml"]),
    ],
    zip_safe=False,
)

"""For colcon only; see the root's pyproject.toml for the installation with pip and uv."""

from setuptools import find_packages, setup

setup(
    name="roboxim_sim",
    version="0.1.0",
    packages=find_packages(include=["roboxim_sim", "roboxim_sim.*"]),
    package_data={"roboxim_sim": ["**/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/roboxim_sim"]),
        ("share/roboxim_sim", ["package.xml"]),
    ],
    zip_safe=False,
)

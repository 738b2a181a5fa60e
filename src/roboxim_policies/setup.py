"""For colcon only; see the root's pyproject.toml for the installation with pip and uv."""

from setuptools import find_packages, setup

setup(
    name="roboxim_policies",
    version="0.1.0",
    packages=find_packages(include=["roboxim_policies", "roboxim_policies.*"]),
    package_data={"roboxim_policies": ["**/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/roboxim_policies"]),
        ("share/roboxim_policies", ["package.xml"]),
    ],
    zip_safe=False,
)

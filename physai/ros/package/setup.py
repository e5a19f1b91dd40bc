"""What colcon builds: the ROS side of physai alone; its Python packages come from pip, as do these files."""

from glob import glob

from setuptools import setup  # type: ignore[import-untyped]

setup(
    name="physai",
    version="0.1.0",
    packages=[],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/physai"]),
        ("share/physai", ["package.xml"]),
        ("share/physai/launch", glob("launch/*.py")),
        ("share/physai/config", glob("config/*.yaml")),
        ("lib/physai", glob("lib/*")),
    ],
    zip_safe=False,
    license="Apache-2.0",
)

"""Installation of the ROS 2 package, as `colcon build` calls it."""

from pathlib import Path
from xml.etree import ElementTree

from setuptools import setup

MANIFEST = ElementTree.parse("package.xml").getroot()
NAME, VERSION = MANIFEST.findtext("name"), MANIFEST.findtext("version")

setup(
    name=NAME,
    version=VERSION,
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", sorted(str(path) for path in Path("launch").iterdir())),
    ],
)

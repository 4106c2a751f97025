"""Installs the package with colcon."""

from setuptools import setup

NAME = "lanestream_bridge"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/bridge.launch.py"]),
        (f"share/{NAME}/config", ["config/bridge.yaml"]),
    ],
    # lanestream itself comes from pip; see the README.
    install_requires=["setuptools"],
    zip_safe=True,
    author="The Lanestream authors",
    license="Apache-2.0",
    description="Sends a camera's images to a Lanestream service and publishes the lane boundaries in them.",
    entry_points={"console_scripts": [f"bridge = {NAME}.node:main"]},
)

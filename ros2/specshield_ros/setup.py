from setuptools import setup

NAME = "specshield_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/shield.launch.py"]),
        (f"share/{NAME}/config", ["config/shield.yaml"]),
    ],
    install_requires=["setuptools"],  # and specshield[core], by pip: it is in no ROS distribution
    zip_safe=True,
    license="Apache-2.0",
    entry_points={"console_scripts": [f"shield = {NAME}.node:main"]},
)

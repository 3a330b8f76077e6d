"""Build track_fusion: for colcon (ament_python) on a robot, and for pip in a plain venv.

What package.xml states (name, version, description, licence, maintainer) is read from there; the rest of the metadata
is here, not in pyproject.toml, because `colcon build --symlink-install` does not show that file to setuptools.
"""

from glob import glob
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

manifest = ElementTree.parse(Path(__file__).parent / "package.xml").getroot()


def stated(tag: str) -> str:
    """Return the text of one element of package.xml."""
    text = manifest.findtext(tag)
    assert text, f"package.xml has no <{tag}>"
    return text.strip()


name = stated("name")

# No wheels for other processors: there ROS comes from apt, and tools/make_venv.py leaves this extra out.
ROS_WHEELS = ["ros-jazzy-rclpy[fastrtps]", "ros-jazzy-common-interfaces"]
CLI = ["click>=8.1", "jsonschema>=4.10", "rich>=13"]
BAGS = ["rosbags>=0.10", "pyyaml>=6"]
REPORT = ["matplotlib>=3.6"]
SCENARIOS = ["pymap3d>=3"]
TEST = [
    "pytest>=7.4",
    "pytest-xdist>=3.3",
    "hypothesis>=6.90",
    "mpmath>=1.2",
    "pyriemann>=0.9,<0.12",  # 0.12 asks for NumPy 1.25 but needs 2
    "scikit-learn>=1.4",
    "stonesoup>=1.4",
    "pyyaml>=6",
    *SCENARIOS,
    "cyclonedds>=0.10.5; platform_machine == 'x86_64'",
]
DEV = [
    "ruff>=0.9",
    "mypy>=1.14",
    "scipy-stubs",
    "colcon-common-extensions",
    "colcon-ros",
    "setuptools<80",  # colcon drives setup.py directly, which later ones no longer allow
]

setup(
    name=name,
    version=stated("version"),
    description=stated("description"),
    maintainer=stated("maintainer"),
    maintainer_email=manifest.find("maintainer").get("email"),
    license=stated("license"),
    python_requires=">=3.11",
    packages=find_packages(include=["track_fusion", "track_fusion.*", "msg_adapters", "msg_adapters.*"]),
    package_data={"track_fusion": ["py.typed"], "msg_adapters": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{name}"]),
        (f"share/{name}", ["package.xml"]),
        (f"share/{name}/config", sorted(glob("config/*"))),
        (f"share/{name}/launch", sorted(glob("launch/*.launch.py"))),
    ],
    zip_safe=False,
    install_requires=["numpy>=1.26", "scipy>=1.11"],
    extras_require={
        "ros": ROS_WHEELS,
        "cli": CLI,
        "bags": BAGS,
        "report": REPORT,
        "scenarios": SCENARIOS,
        "all": CLI + BAGS + REPORT + SCENARIOS,
        "test": TEST,
        "dev": TEST + DEV,
    },
    entry_points={
        "console_scripts": [
            "sensor_tracker = track_fusion.nodes.sensor_tracker:main",
            "fusion_centre = track_fusion.nodes.fusion_centre:main",
            "replay = track_fusion.nodes.replay:main",
            "evaluator = track_fusion.nodes.evaluator:main",
            "track-fusion = track_fusion.cli:main",
        ],
    },
)

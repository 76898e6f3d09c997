"""The folders experiments/ and conf/ are installed as dolens.experiments and dolens.conf."""

from setuptools import find_namespace_packages, find_packages, setup

setup(
    packages=[
        *find_packages(include=["dolens*"]),
        *(f"dolens.{name}" for name in find_packages(include=["experiments*"])),
        "dolens.conf",
        *find_namespace_packages(include=["hydra_plugins*"]),
    ],
    package_dir={"dolens.experiments": "experiments", "dolens.conf": "conf"},
)

"""src/ links to what is importable once dolens is installed: dolens/, and in it experiments/ and
conf/ as dolens.experiments and dolens.conf.

So an editable install puts one folder on Python's path, and nothing else of the checkout is seen.
Were packages mapped to folders here, setuptools would install a finder that comes after the path,
and any folder called `dolens` beside a script, such as a clone, would hide the package.

Hydra finds launchers and sweepers in the namespace package hydra_plugins alone.
"""

from setuptools import find_namespace_packages, find_packages, setup

setup(
    packages=[
        *find_packages("src", include=["dolens*"]),
        "dolens.conf",
        *find_namespace_packages("src", include=["hydra_plugins*"], exclude=["*.__pycache__"]),
    ],
    package_dir={"": "src"},
)

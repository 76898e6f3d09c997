"""The command `dolens`: quick to answer, and of use without the packages that training needs."""

import subprocess
import sys

import pytest

from dolens import __version__
from dolens.cli.app import main

TRAINING = (
    "hydra",
    "omegaconf",
    "lightning",
    "torchvision",
    "torchmetrics",
    "tensorboard",
    "skimage",
)
# Runs the command as where these packages are not installed.
WITHOUT = """
import sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {packages}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing())
from dolens.cli.app import main
sys.argv = ["dolens", *sys.argv[1:]]
main()
"""


def run(*command):
    return subprocess.run([sys.executable, *command], capture_output=True, text=True)


def without_training(*arguments):
    return run("-c", WITHOUT.format(packages=TRAINING), *arguments)


def test_the_version_is_shown_and_the_package_runs_as_the_command():
    assert run("-m", "dolens", "--version").stdout == f"dolens {__version__}\n"
    assert run("-m", "dolens", "--help").stdout.split("dolens")[1:]


def test_help_lists_every_command_without_importing_pytorch():
    code = "import sys; sys.argv[1:] = ['--help']\nfrom dolens.cli.app import app\n"
    code += "app(standalone_mode=False)\nassert 'torch' not in sys.modules"
    done = run("-c", code)
    assert done.returncode == 0, done.stderr
    for name in (
        *(
            "show",
            "convert",
            "check",
            "export",
            "experiments",
            "train",
            "evaluate",
            "apply",
            "compare",
        ),
        "report",
    ):
        assert f"│ {name} " in done.stdout


def test_a_lens_is_shown_where_the_training_packages_are_missing(tmp_path):
    done = without_training("convert", "cooke_triplet", str(tmp_path / "triplet.zmx"))
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "triplet.zmx").read_bytes()


@pytest.mark.parametrize("command", [("train",), ("evaluate", "."), ("compare", ".")])
def test_a_command_says_which_packages_it_lacks(command):
    done = without_training(*command)
    assert done.returncode != 0
    assert "pip install 'dolens[train]'" in done.stderr
    assert "Traceback" not in done.stderr


def test_an_unknown_lens_is_one_line_with_the_nearest_name(monkeypatch, capfd):
    """Python prints a text that ends a program to stderr, and its status is 1."""
    monkeypatch.setattr(sys, "argv", ["dolens", "show", "cooke_triplett"])
    with pytest.raises(SystemExit) as ended:
        main()
    said = ended.value.code
    assert said.startswith("error: ") and "cooke_triplet" in said and "\n" not in said
    assert "".join(capfd.readouterr()) == ""

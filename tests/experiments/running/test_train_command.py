"""`dolens train` from any folder: the configuration of the wheel, and the user's own before it."""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import torch
import yaml
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from typer.testing import CliRunner

from dolens.cli.app import app
from dolens.experiments.running.catalogue import user_configuration
from dolens.experiments.running.user_configuration import completions, use_working_folder

OWN_FILES = {
    "conf/experiment/mine.yaml": """
        # @package _global_
        # A design of my own.
        defaults:
          - asphere
          - override /lens: mylens
          - _self_
        extensions: [my_surfaces]
    """,
    "conf/experiment/camera.yaml": """
        # @package _global_
        # A camera of my own.
        defaults:
          - wavefront_coding
          - override /network: mynet
          - _self_
    """,
    "conf/network/mynet.yaml": "{_target_: my_network.Scaled, gain: 0.5}",
    "my_network.py": """
        import torch

        class Scaled(torch.nn.Module):
            def __init__(self, gain):
                super().__init__()
                self.gain = torch.nn.Parameter(torch.tensor(gain))

            def forward(self, image):
                return self.gain * image
    """,
    "my_surfaces.py": """
        import pathlib, dolens, dolens.experiments

        places = [dolens.__file__, dolens.experiments.__file__]
        pathlib.Path("imported_from.txt").write_text("\\n".join(places))
    """,
}
RADIUS = 20.875
SHORT = [
    *("data.iterations=1", "trainer.max_epochs=1", "backend=reference"),
    *("callbacks.pictures=null", "+trainer.enable_progress_bar=false"),
]


def write_own(folder, root):
    """The files of a user's, in his working folder."""
    for name, text in OWN_FILES.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(line[8:] for line in text.splitlines()) or text)
        if not text.startswith("\n"):
            path.write_text(text)
    lens = yaml.safe_load((root / "conf/lens/asphere.yaml").read_text())
    (folder / "conf/lens").mkdir()
    lens["surfaces"]["1"]["radius"] = RADIUS
    (folder / "conf/lens/mylens.yaml").write_text(yaml.safe_dump(lens))


@pytest.fixture(scope="module")
def installed(root, tmp_path_factory) -> Path:
    """A folder with what the wheel holds."""
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("installed")
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(root / name, source)
    for name in ("src", "dolens", "experiments", "conf", "hydra_plugins"):
        ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
        shutil.copytree(root / name, source / name, symlinks=True, ignore=ignored)
    build = "import setuptools.build_meta as b, sys; b.build_wheel(sys.argv[1])"
    subprocess.run(
        [sys.executable, "-c", build, str(target)], cwd=source, check=True, capture_output=True
    )
    (wheel,) = target.glob("*.whl")
    zipfile.ZipFile(wheel).extractall(target)
    return target


def test_the_wheel_holds_every_file_of_the_library_the_experiments_and_the_configuration(
    installed, root
):
    tracked = subprocess.run(
        ["git", "-C", root, "ls-files", "dolens", "experiments", "conf"],
        check=True,
        capture_output=True,
        text=True,
    ).stdout.split()
    assert len(tracked) > 500
    for path in tracked:
        if (root / path).is_symlink():
            continue  # experiments/ and conf/ in it, whose files are listed too
        assert (installed / "dolens" / path.removeprefix("dolens/")).is_file(), path
    assert not (installed / "experiments").exists()
    plugins = installed / "hydra_plugins"
    assert (plugins / "dolens_optuna_sweeper/optuna_sweeper.py").is_file()
    assert not (plugins / "__init__.py").exists()  # other packages have plugins there too


def test_a_user_s_experiment_lens_and_surfaces_run_with_the_wheel(installed, root, tmp_path):
    write_own(tmp_path, root)
    done = subprocess.run(
        [sys.executable, "-m", "dolens", "train", "experiment=mine", *SHORT],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(installed), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    (run,) = (tmp_path / "outputs/mine").iterdir()
    assert yaml.safe_load((run / "lens/initial.yaml").read_text())["surfaces"]["1"]["radius"] == (
        pytest.approx(RADIUS)
    )
    assert "rms_spot_um/final" in json.loads((run / "metrics.json").read_text())
    info = json.loads((run / "run.json").read_text())
    assert info["command"][:2] == ["dolens train", "experiment=mine"]
    assert info["git"] == {"commit": None, "dirty": None}  # of dolens, which is no checkout here
    for place in (tmp_path / "imported_from.txt").read_text().splitlines():
        assert place.startswith(str(installed))


@pytest.fixture
def own(root, tmp_path, monkeypatch):
    """A working folder with a user's own files."""
    write_own(tmp_path, root)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    return tmp_path


@pytest.fixture
def composed_here(root):
    """Compose as `dolens train` does in the working folder."""

    def build(*overrides):
        use_working_folder()
        with initialize_config_dir(str(root / "conf"), version_base="1.3"):
            return compose("train", list(overrides))

    return build


def test_a_user_s_file_wins_over_the_packaged_one_of_the_same_name(own, root, composed_here):
    lens = yaml.safe_load((root / "conf/lens/asphere.yaml").read_text())
    (own / "conf/lens/asphere.yaml").write_text(yaml.safe_dump(lens | {"name": "hidden"}))
    assert composed_here("experiment=asphere", "lens.name=null").lens.name is None
    cfg = composed_here("experiment=nikon", "lens@published=asphere")
    assert cfg.published.name == "hidden"
    assert "start" in cfg  # all other files are the packaged ones


def test_a_user_s_network_is_found_in_the_working_folder(own, composed_here):
    network = instantiate(composed_here("experiment=camera").network)
    assert network(torch.ones(1)).item() == 0.5


def test_a_user_s_own_train_yaml_sets_the_defaults(own, root, composed_here):
    text = (root / "conf/train.yaml").read_text().replace("seed: 0", "seed: 7", 1)
    (own / "conf/train.yaml").write_text(text)
    assert composed_here("experiment=asphere").seed == 7


def test_in_the_checkout_the_packaged_configuration_is_not_the_user_s_own(root, tmp_path):
    assert user_configuration(root) is None
    assert user_configuration(tmp_path) is None
    (tmp_path / "conf").symlink_to(root / "conf")
    assert user_configuration(tmp_path) is None


def invoked(*arguments):
    return CliRunner().invoke(app, list(arguments), env={"COLUMNS": "100"})


def test_help_needs_no_experiment_and_names_groups_options_and_examples(own):
    done = invoked("train", "--help")
    assert done.exit_code == 0
    shown = " ".join(done.output.split())  # wherever lines are broken
    for text in (
        "dolens train experiment=NAME",
        "dolens train -m experiment=asphere",
        "mine, misalignment,",  # the user's own among the packaged ones
        "the prescription: surfaces",
        "mylens",
        "--cfg job",
        "conf/experiment/mine.yaml",
    ):
        assert text in shown, text


def test_every_group_of_the_defaults_list_says_what_it_is_for(root):
    from dolens.experiments.running.catalogue import meanings

    defaults = yaml.safe_load((root / "conf/train.yaml").read_text())["defaults"]
    assert set(meanings([root / "conf"])) == {key for d in defaults if d != "_self_" for key in d}


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ([], "no experiment is named"),
        (["experiment=asfere"], "experiment=asfere: there is no such file; did you mean 'asphere'"),
        (["experiment=mine", "lens=aspere"], "lens=aspere: there is no such file; did you mean"),
    ],
    ids=["no experiment", "misspelt experiment", "misspelt lens"],
)
def test_a_missing_or_misspelt_choice_is_one_line(own, monkeypatch, arguments, line):
    monkeypatch.setattr(sys, "argv", [])
    done = invoked("train", *arguments)
    assert done.exit_code == 1
    assert line in done.output and done.output.count("\n") == 1


def test_options_of_hydra_reach_it_untouched(own, monkeypatch, capfd):
    monkeypatch.setattr(sys, "argv", [])
    done = invoked("train", "--cfg", "job", "-p", "lens.surfaces.1.radius", "experiment=mine")
    assert done.exit_code == 0
    assert str(RADIUS) in done.output + capfd.readouterr().out


@pytest.mark.parametrize(
    ("before", "incomplete", "expected"),
    [
        ([], "experiment=mi", "experiment=mine"),  # zsh and fish
        (["experiment", "="], "mi", "mine"),  # bash, which takes = for a word
        (["experiment"], "", "mine"),  # bash, right behind the =
        (["--cfg", "job", "experiment=mine"], "lens=my", "lens=mylens"),
        (["-m", "experiment=camera"], "network.ga", "network.gain="),
    ],
)
def test_a_shell_completes_options_and_settings(own, before, incomplete, expected):
    found = completions(before, incomplete)
    assert expected in found
    assert all(text.startswith(incomplete) for text in found)


def test_a_checkout_that_is_not_installed_says_how_to_install_it(root):
    done = subprocess.run(
        [sys.executable, "-S", "train.py"], cwd=root, capture_output=True, text=True
    )
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    assert "is not installed for this Python" in done.stderr
    assert 'pip install -c constraints.txt -e ".[train]"' in done.stderr


def test_a_folder_called_dolens_beside_a_script_hides_nothing(tmp_path):
    """It has no `__init__.py`: a clone in the user's home, or results.  Nor is anything of the
    user's hidden by a folder of the checkout.
    """
    for name in ("dolens/experiments", "hydra_plugins", "experiments", "conf"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "experiments/mine.py").touch()
    (tmp_path / "script.py").write_text(
        "import dolens, dolens.conf, dolens.experiments, hydra_plugins.dolens_launchers\n"
        "import conf, experiments.mine\n"
        "dolens.load_lens('cooke_triplet')\n"
        "print(*conf.__path__, *experiments.__path__)"
    )
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.stdout.split() == [str(tmp_path / "conf"), str(tmp_path / "experiments")], done

"""A finished run's camera is tested again as it was, or with what an override changes."""

import shutil
from pathlib import Path

import pytest
import torch

from dolens.errors import InputError
from dolens.experiments.commands.evaluate import evaluate
from dolens.experiments.running.finished_run import load_run
from tests.experiments.runs import Finished
from tests.experiments.tiny_experiment import UNPICTURED


@pytest.fixture(scope="module")
def trained(tiny_run, tmp_path_factory):
    """A copy of the run, whose evaluations are written into it."""
    return Path(shutil.copytree(tiny_run, tmp_path_factory.mktemp("evaluated") / "run"))


@pytest.fixture(scope="module")
def own(trained):
    return Finished(trained).metrics


def of_test(metrics):
    return {name: value for name, value in metrics.items() if name.startswith("test/")}


def test_without_overrides_the_run_s_own_test_is_reproduced(trained, own):
    before = sorted(path for path in trained.rglob("*"))
    found = evaluate(trained, name="same")
    assert of_test(found.metrics) == of_test(own)
    assert len(of_test(own)) > 20
    folder = trained / "evaluation" / "same"
    assert found.folder == folder
    written = Finished(folder)
    assert written.metrics == found.metrics
    assert (folder / "test_photographs.csv").read_text() == (
        trained / "test_photographs.csv"
    ).read_text()
    assert (folder / "lens/final.yaml").read_text() == (trained / "lens/final.yaml").read_text()
    assert written.figures == {"images", "layout", "point_spread_functions"}
    info = written.info
    assert info["status"] == "finished" and info["evaluated"]["step"] == 2
    assert info["evaluated"]["checkpoint"] == str(trained / "checkpoints/last.ckpt")
    assert (folder / ".hydra/resolved.yaml").is_file() and (folder / "log.txt").is_file()
    # Nothing of the run itself is touched.
    after = [path for path in trained.rglob("*") if "evaluation" not in path.parts]
    assert sorted(after) == before


def test_less_light_is_noisier_and_overrides_are_recorded(trained, own):
    found = evaluate(trained, ["light=10", UNPICTURED], name="dim")
    assert found.metrics["test/raw_psnr_db"] < own["test/raw_psnr_db"] - 1.0
    assert Finished(found.folder).info["evaluated"]["overrides"] == ["light=10", UNPICTURED]


def test_at_other_depths_the_network_has_the_functions_of_its_own(trained):
    """Else a scene of one depth would tell it how far away everything is."""
    found = evaluate(trained, ["scene.depths=[5000]", UNPICTURED], name="near")
    assert {"test/psnr_db/5m"} == {n for n in found.metrics if n.startswith("test/psnr_db/5")}
    with torch.no_grad():
        camera, before = found.run.module, load_run(trained).module
        functions, own = (
            c.functions(c.variables(), taken=None, stage="test") for c in (camera, before)
        )
    assert torch.equal(functions, own) and len(own) == 3


def test_rays_and_point_spread_functions_judge_alike(trained, own):
    """Many rays a pixel make the image of the functions."""
    rays, functions = (
        evaluate(trained, [*judge, UNPICTURED], name=name).metrics["test/raw_psnr_db"]
        for name, judge in {
            "rays": ["evaluation_renderer.pupil_samples=16"],
            "psf": [
                "evaluation_renderer=psf",
                "evaluation_renderer.fields=[1,1]",
                "evaluation_renderer.pupil_samples=32",  # the run itself has set it to 2
            ],
        }.items()
    )
    assert rays == pytest.approx(functions, abs=0.1)
    assert rays > own["test/raw_psnr_db"]  # that of four rays a pixel, with their noise


def test_a_lens_that_was_made_a_little_differently_keeps_what_was_trained(trained, own):
    found = evaluate(
        trained, ["lens.surfaces.1.radius=62.9", UNPICTURED], name="made", perturb_lens=True
    )
    lens, before = found.run.lens, load_run(trained).lens
    assert float(lens.surfaces["1"].curvature) == pytest.approx(1 / 62.9, rel=1e-6)
    assert torch.equal(lens.surfaces["5"].x3, before.surfaces["5"].x3)
    assert torch.equal(lens.sensor_distance, before.sensor_distance)
    assert found.metrics["test/raw_psnr_db"] != own["test/raw_psnr_db"]
    assert "The lens is not the trained one" in (found.folder / "log.txt").read_text()


REFUSED = {
    "a wider network": ("network.width=8", "network.width: another value makes another camera"),
    "what a network follows": ("psf_size=33", "network.margin: another value"),
    "a variable": ("variables.sensor_distance.upper=99", "makes another camera"),
    "a lens": ("lens.surfaces.1.radius=60", "--perturb-lens"),
    "another experiment": ("experiment=asphere", "another experiment is another run"),
    "training": ("train=true", "an evaluation does not train"),
    "a rate": ("learning_rates.network=0.1", "of training alone"),
    "what makes training images": ("renderer.pupil_samples=9", "evaluation_renderer"),
    "a checkpoint": ("ckpt_path=a.ckpt", "--checkpoint"),
    "several values": ("light=10,20", "one value at a time"),
    "Hydra's own": ("hydra.run.dir=x", "--name"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_not_an_evaluation_is_refused(trained, case):
    override, expected = REFUSED[case]
    with pytest.raises(InputError) as caught:
        evaluate(trained, [override], name="refused")
    assert expected in str(caught.value) and "\n" not in str(caught.value)
    assert not (trained / "evaluation" / "refused").exists()


def test_a_trained_parameter_is_not_set_to_another_value(trained):
    with pytest.raises(InputError, match=r"has trained surfaces\.5\.x3;"):
        evaluate(trained, ["lens.surfaces.5.x3=1e-6"], perturb_lens=True)


def test_a_folder_that_is_there_is_not_written_over(trained):
    (trained / "evaluation" / "taken").mkdir(parents=True)
    with pytest.raises(InputError, match="is there already"):
        evaluate(trained, name="taken")
    with pytest.raises(InputError, match="without /"):
        evaluate(trained, name="../up")

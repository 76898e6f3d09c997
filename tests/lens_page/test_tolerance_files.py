"""The file of `dolens show --tolerances FILE`: of its own, or that of an experiment."""

import pytest
import torch

from dolens import InputError, load_lens
from dolens.analysis.conditions import conditions
from dolens.lens_page.offenders import offenders

OWN = """
elements:
  front: {surfaces: [1, 2]}
tolerances:
  elements.*.decenter_y: 0.02
  thicknesses.1: {half_range: 0.03}
tolerance_factor: 2
"""


@pytest.fixture(scope="module")
def triplet():
    return load_lens("cooke_triplet")


def found(lens, path):
    return offenders(lens, conditions(lens, [0.0], 587.5618), path)


def test_a_file_of_its_own_says_which_elements_move_and_how_far(triplet, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(OWN)
    offending = found(triplet, path)
    assert dict(
        zip(offending.tolerances.names, offending.tolerances.half_range.tolist(), strict=True)
    ) == {"elements.front.decenter_y": 0.04, "thicknesses.1": 0.06}
    assert offending.notes == ["Tolerances of mine.yaml."]
    assert float(offending.contributions.share.sum()) == pytest.approx(1.0, rel=1e-12)
    assert "front" not in triplet.elements


def test_an_experiment_s_file_does_too_and_says_what_is_not_read(triplet, root):
    offending = found(triplet, root / "conf/experiment/cooke_sensitivity.yaml")
    tilts = [name.endswith(("tilt_x", "tilt_y")) for name in offending.tolerances.names]
    assert sum(tilts) == 6
    assert offending.tolerances.half_range[torch.tensor(tilts)].tolist() == [0.05] * 6
    assert offending.notes[0] == (
        "Not read from cooke_sensitivity.yaml: fields, wavelengths, yield_at_um."
    )


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("elements: {}", "'tolerances' is missing"),
        ("tolerance: {thicknesses.1: 0.02}", "unknown key 'tolerance'"),
        ("[1, 2]", "expected a mapping"),
    ],
)
def test_a_file_that_says_nothing_of_tolerances_is_refused(triplet, tmp_path, text, said):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as error:
        found(triplet, path)
    assert said in str(error.value)
    assert str(path) in str(error.value)


def test_a_file_that_is_not_there_is_refused(triplet, tmp_path):
    with pytest.raises(InputError, match=r"--tolerances: .*none.yaml: cannot be read"):
        found(triplet, tmp_path / "none.yaml")

"""Lens files: they load, they come back to the last bit, and bad ones say what is wrong."""

import copy
import re
from pathlib import Path

import pytest
import torch
import yaml

from dolens import InputError, load_lens, save_lens
from dolens.prescriptions import lens_from_prescription
from tests.prescriptions.samples import SINGLET, require_refused

LENSES = sorted((Path(__file__).resolve().parents[2] / "conf" / "lens").glob("*.yaml"))


def test_there_are_lenses():
    assert {"asphere", "cooke_triplet", "wavefront_coding", "double_gauss"} <= {
        p.stem for p in LENSES
    }


@pytest.mark.parametrize("model", ["dfc", "do", "paper"])
def test_the_index_model_can_be_overridden(model, root, tmp_path):
    lens = load_lens(root / "conf" / "lens" / "cooke_triplet.yaml", index_model=model)
    save_lens(lens, tmp_path / "lens.yaml")
    assert load_lens(tmp_path / "lens.yaml").materials == lens.materials
    assert (lens.materials[0].a == 1.000293) == (model == "do")


def test_a_saved_lens_is_plain_yaml(tmp_path):
    save_lens(lens_from_prescription(SINGLET), tmp_path / "lens.yaml")
    data = yaml.safe_load((tmp_path / "lens.yaml").read_text())
    assert data["surfaces"]["1"] == {**SINGLET["surfaces"]["1"], "semi_diameter": 10.0}
    assert data["sensor"] == SINGLET["sensor"]


def test_surface_numbers_may_be_written_as_numbers():
    data = copy.deepcopy(SINGLET)
    data["surfaces"] = {int(n): row for n, row in reversed(data["surfaces"].items())}
    lens = lens_from_prescription(data)
    assert float(lens.surfaces["1"].curvature.detach()) == 0.05


def changed(*path, to=None, remove=False):
    data = copy.deepcopy(SINGLET)
    place = data
    for key in path[:-1]:
        place = place[key]
    if remove:
        del place[path[-1]]
    else:
        place[path[-1]] = to
    return data


S1 = ("surfaces", "1")
BAD = {
    "misspelt lens key": (changed("indexmodel", to="dfc"),
                          "unknown key 'indexmodel'; did you mean 'index_model'?"),
    "misspelt surface key": (changed(*S1, "thicknes", to=1),
                             "surface 1: unknown key 'thicknes'; did you mean 'thickness'?"),
    "misspelt sensor key": (changed("sensor", "distnace", to=1),
                            "sensor: unknown key 'distnace'; did you mean 'distance'?"),
    "code by name": (changed("_target_", to="os.system"), "unknown key '_target_'"),
    "code by name in a surface": (changed(*S1, "_target_", to="os.system"),
                                  "surface 1: unknown key '_target_'"),
    "unknown material": (changed(*S1, "material", to="N-BK77"),
                         "surface 1: unknown material 'N-BK77'; did you mean 'N-BK7'"),
    "glass of several makers": (changed(*S1, "material", to="SF6"),
                                "surface 1: material 'SF6' is in the catalogues of SCHOTT, HIKARI"),
    "near material": (changed("surfaces", "2", "material", to="aire"),
                      "surface 2: unknown material 'aire'; did you mean 'air'?"),
    "no material": (changed(*S1, "material", remove=True), "surface 1: 'material' is missing"),
    "no thickness": (changed(*S1, "thickness", remove=True), "surface 1: 'thickness' is missing"),
    "thickness after the last": (changed("surfaces", "2", "thickness", to=3.0),
                                 "surface 2: the last surface has no 'thickness'"),
    "thickness in words": (changed(*S1, "thickness", to="thin"),
                           "surface 1: 'thickness' must be a number, not 'thin'"),
    "infinite thickness": (changed(*S1, "thickness", to=float("inf")),
                           "surface 1: 'thickness' must be a finite number"),
    "infinite coefficient": (changed(*S1, "a4", to=float("inf")),
                             "surface 1: 'a4' must be a finite number"),
    "nan": (changed(*S1, "conic", to=float("nan")), "surface 1: 'conic' must be a finite number"),
    "truth value": (changed(*S1, "thickness", to=True), "surface 1: 'thickness' must be a number"),
    "aperture beyond the sphere": (changed("surfaces", "2", "semi_diameter", to=50.5),
                                   "surface 2: semi_diameter 50.5 mm exceeds the surface"),
    "no aperture": (changed(*S1, "semi_diameter", remove=True),
                    "surface 1: 'semi_diameter' is missing"),
    "negative aperture": (changed(*S1, "semi_diameter", to=-3),
                          "surface 1: semi_diameter must be positive"),
    "infinite aperture": (changed("surfaces", "2", "semi_diameter", to=float("inf")),
                          "surface 2: 'semi_diameter' must be a finite number"),
    "no radius": (changed(*S1, "radius", remove=True), "surface 1: 'radius' is missing"),
    "radius zero": (changed(*S1, "radius", to=0), "surface 1: 'radius' is 0"),
    "radius in words": (changed(*S1, "radius", to="big"),
                        "surface 1: 'radius' must be a number, not 'big'"),
    "radius nan": (changed(*S1, "radius", to=float("nan")), "surface 1: 'radius' must be"),
    "radius and curvature": (changed(*S1, "curvature", to=0.05),
                             "surface 1: give 'radius' or 'curvature', not both"),
    "odd coefficient": (changed(*S1, "a5", to=1.0), "surface 1: 'a5': even aspheric"),
    "unknown type": (changed(*S1, "type", to="asfere"), "surface 1: type 'asfere' is unknown"),
    "conic of a sphere": (changed("surfaces", "2", "conic", to=1.0),
                          "surface 2: unknown key 'conic'"),
    "gap in numbering": (changed("surfaces", to={"1": SINGLET["surfaces"]["1"],
                                              "3": SINGLET["surfaces"]["2"]}),
                         "surface 2 is missing"),
    "no surfaces": (changed("surfaces", to={}), "'surfaces' must map surface numbers"),
    "surfaces as a list": (changed("surfaces", to=[SINGLET["surfaces"]["1"]]),
                           "'surfaces' must map surface numbers"),
    "surface without rows": (changed(*S1, to=None), "surface 1: expected a mapping"),
    "no sensor": (changed("sensor", remove=True), "'sensor.distance' is missing"),
    "sensor without distance": (changed("sensor", to={"diameter": 3}),
                                "'sensor.distance' is missing"),
    "stop outside": (changed("stop", to=3), "stop must be a surface from 1 to 2, not 3"),
    "half a stop": (changed("stop", to=1.5), "'stop' must be a whole number"),
    "unknown index model": (changed("index_model", to="dcf"), "index_model: 'dcf' is unknown"),
    "a list": ([1, 2], "expected a mapping"),
    "nothing": (None, "expected a mapping"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_prescriptions(case, tmp_path):
    data, said = BAD[case]
    require_refused(tmp_path / "bad.yaml", yaml.safe_dump(data), said)


def test_the_good_prescription_is_good(tmp_path):
    path = tmp_path / "good.yaml"
    path.write_text(yaml.safe_dump(SINGLET))
    load_lens(path)


@pytest.mark.parametrize(
    "text",
    [
        "surfaces: {'1': {type: sphere",
        "a: b: c",
        "\tname: tab",
        "name: !!python/object/apply:os.system ['touch pwned']",
        "name: !!python/object:dolens.Lens {}",
        "- &a [*b]",
        "name: once\nname: twice",
        f"a: {'9' * 10_000}",
    ],
)
def test_files_that_are_no_plain_yaml(text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    require_refused(tmp_path / "bad.yaml", text, "is not valid YAML")
    assert not (tmp_path / "pwned").exists()


@pytest.mark.parametrize(
    ("name", "said"),
    [("none.yaml", "cannot be read (No such file"), ("lens.doc", "lens files end in .yaml")],
)
def test_files_that_are_not_there_or_of_another_kind(name, said, tmp_path):
    (tmp_path / "lens.doc").write_text("Dear reader")
    with pytest.raises(InputError, match=re.escape(f"{tmp_path / name}: ")) as error:
        load_lens(tmp_path / name)
    assert said in str(error.value) and "\n" not in str(error.value)


BEYOND_SINGLE = {
    "thickness": ("surfaces", "1", "thickness", -1e308),
    "semi-diameter": ("surfaces", "1", "semi_diameter", 1e39),
    "radius": ("surfaces", "1", "radius", 1e-21),  # its curvature's square is beyond
    "index": ("surfaces", "1", "material", "1e39"),
    "sensor": ("sensor", "distance", 1e39),
    "asphere": ("surfaces", "1", {"type": "even_asphere", "a4": 1e39}),
    "pose": ("elements", {"1": {"surfaces": [1, 2], "shift_z": 1e39}}),
    "break": ("surfaces", "1", {"type": "coordinate_break", "decenter_x": 1e39, "thickness": 0.0}),
    "spline": ("surfaces", "1", {"type": "b_spline", "coefficients": [[0.0, 1e39]]}),
    "field": ("fields", {"angles": [[0.0, 1e39]]}),
}


@pytest.mark.parametrize("case", BEYOND_SINGLE)
def test_what_single_precision_cannot_hold_is_refused_and_named(case):
    *keys, last = BEYOND_SINGLE[case]
    lens = {"surfaces": {"1": {"radius": 50.0, "semi_diameter": 5.0, "thickness": 3.0,
                               "material": "1.5"},
                         "2": {"radius": -50.0, "semi_diameter": 5.0, "material": "air"}},
            "sensor": {"distance": 40.0}}  # fmt: skip
    row = lens
    for key in keys[:-1]:
        row = row[key]
    row[keys[-1]] = last
    text = r"1e\+39|1e39|1e-21|-1e\+308"
    place = "surface 1: " if keys[0] == "surfaces" else keys[0] if keys[0] != "fields" else ""
    with pytest.raises(
        InputError, match=rf"^lens: {place}.*'\w+' is ({text})[;,] .*float32"
    ) as refused:
        lens_from_prescription(lens, torch.float32)
    assert "\n" not in str(refused.value)

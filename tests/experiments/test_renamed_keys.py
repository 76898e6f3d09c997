"""A setting that has another name now says so, and an old run's overrides are translated."""

import runpy
import subprocess
import sys

import pytest
from hydra.errors import HydraException

from dolens.errors import InputError
from dolens.experiments.running.configuration import checked
from dolens.experiments.running.renamed_keys import RENAMED, Key, Renamed
from dolens.experiments.running.renaming import explained, refuse_renamed, translated
from dolens.experiments.running.target_keys import Target, located
from tests.experiments.conftest import finished_run

CAMERA = "experiment=wavefront_coding"
# Names that never were, so that the test says what a table can say.
TABLE = Renamed(
    keys=(
        Key("sharpness.rays", "merit.quality", values={"few": "spots", "waves": "wavefront"}),
        Key("sharpness.gone", None, instead="leave it out"),
        Key("variables.*.step", "variables.*.scale"),
        Key("lens_precision", "lens_dtype"),
        Key("critics", "judges"),
    ),
    values={"merit.reference": {"middle": "centroid"}},
    options={"renderer": {"montecarlo": "rays"}},
    targets={"old.place.Adam": "torch.optim.Adam"},
)

OLD = {
    "a key": ("+lens_precision=float64", "lens_precision: .* called lens_dtype now"),
    "a key, with its values": (
        "+sharpness.rays=waves",
        "sharpness.rays: .* called merit.quality now, and 'waves' is 'wavefront'",
    ),
    "a key that is gone": (
        "+sharpness.gone=3",
        "sharpness.gone: there is no such setting any more: leave it out",
    ),
    "a key below any name": (
        "variables={surfaces.1.conic: {step: 3}}",
        r"variables.surfaces.1.conic.step: .* variables.surfaces.1.conic.scale now",
    ),
    "a value": ("merit.reference=middle", "merit.reference: 'middle' is called 'centroid' now"),
    "a class": (
        "optimizer.many._target_=old.place.Adam",
        "optimizer.many._target_: 'old.place.Adam' is called 'torch.optim.Adam' now",
    ),
}


@pytest.mark.parametrize("case", OLD)
def test_an_old_name_in_a_configuration_is_one_line_with_the_new_one(composed, case):
    override, message = OLD[case]
    with pytest.raises(InputError, match=f"^{message}") as caught:
        refuse_renamed(composed("experiment=asphere", override), TABLE)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("lens_precision=float64", "called lens_dtype now"),
        ("renderer=montecarlo", "renderer=montecarlo is called renderer=rays now"),
        ("merit.sampling_optoins.count=3", "did you mean 'sampling_options'"),
    ],
)
def test_hydra_s_refusal_of_an_old_name_is_explained(composed, override, message):
    with pytest.raises(HydraException) as caught:
        composed("experiment=asphere", override)
    assert message in explained(caught.value, ["-m", "experiment=asphere", override], TABLE)


def test_a_key_that_a_class_takes_is_no_old_name(composed):
    """A user's own optimizer may have an argument that another one has no longer."""
    table = Renamed(keys=(Key("optimizer.many.eps", "optimizer.many.epsilon"),))
    refuse_renamed(composed("experiment=asphere", "+optimizer.many.eps=1e-8"), table)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("+lens_precision=float64", ["++lens_dtype=float64"]),
        ("~lens_precision", ["~lens_dtype"]),
        ("lens_precision=float32,float64", ["lens_dtype=float32,float64"]),
        ("sharpness.rays=few", ["merit.quality=spots"]),
        ("sharpness.gone=3", []),
        ("++sharpness={gone: 3, blur: 1.5}", ["++sharpness={blur:1.5}"]),
        ("++sharpness={rays: few}", ["++sharpness={}", "++merit.quality=spots"]),
        (
            "variables={surfaces.1.conic: {step: 3, upper: null}}",
            ["variables={surfaces.1.conic:{scale:3,upper:null}}"],
        ),
        (
            "sharpness={rays: few, list: ['30', true, 'null'], 5: 1}",
            ["sharpness={list:['30',True,'null'],5:1}", "++merit.quality=spots"],
        ),
        ("critics=wave", ["judges=wave"]),
        ("critics.wave.size=33", ["judges.wave.size=33"]),
        ("++critics.wave={size: 33}", ["++judges.wave={size:33}"]),
        ("critics={wave: {size: 33}}", ["judges={wave:{size:33}}"]),
        ("~critics.wave", ["~judges.wave"]),
        ("merit.reference=middle", ["merit.reference=centroid"]),
        ("renderer=montecarlo", ["renderer=rays"]),
        (
            "optimizer={_target_: old.place.Adam, betas: [0.9, 0.99], name: 'two words'}",
            ["optimizer={_target_:torch.optim.Adam,betas:[0.9,0.99],name:'two words'}"],
        ),
    ],
)
def test_an_old_override_is_translated(old, new):
    found, notes = translated([old], TABLE)
    assert found == new
    assert len(notes) >= 1 and all("\n" not in note for note in notes)
    assert translated(found, TABLE) == (found, [])


def test_what_has_kept_its_name_is_left_as_it_was_typed():
    kept = ["experiment=asphere", "+a={b: [1, 'two words']}", "~c", "seed=0,1", "+lens@d=nikon"]
    assert translated(kept) == (kept, [])


def test_every_class_of_the_table_exists():
    for new in RENAMED.targets.values():
        located(Target("table", new, ()))


def test_the_rate_that_nothing_read_names_the_one_that_is(composed):
    with pytest.raises(InputError, match=r"optimizer.network.lr: .* learning_rates.network is"):
        checked(composed(CAMERA, "+optimizer.network.lr=0.1"))


def test_an_old_run_is_repeated_from_its_overrides_as_they_are_now(
    root, tmp_path, monkeypatch, capfd, dolens_train
):
    """The script, on a run folder whose overrides have the names of before.

    What it starts by another process runs in this one.
    """
    kept = [
        "experiment=cooke_sensitivity",
        "fields=[[0,0]]",
        "wavelengths=[587.5618]",
        "lenses=20",
        "callbacks.pictures=null",
        "+trainer.enable_progress_bar=false",
    ]
    folder = finished_run(
        root, tmp_path, *kept, "module.spots.pupil.rings=3", "module.spots.pupil.arms=6"
    )
    old = [*kept, "module.rings=3", "+module.arms=6"]
    (folder / ".hydra/overrides.yaml").write_text("\n".join(f"- '{text}'" for text in old))
    script = root / "scripts/reproduce.py"
    started = subprocess.run

    def run_here(command, **options):
        if command[:2] != [sys.executable, str(root / "train.py")]:
            return started(command, **options)
        dolens_train(options["cwd"], *command[2:])
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(subprocess, "run", run_here)
    monkeypatch.setattr(sys, "argv", [str(script), str(folder)])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(script), run_name="__main__")
    said = capfd.readouterr()
    assert ended.value.code == 0, said.err
    for name in ("rings", "arms"):
        note = f"note: module.{name}: this setting is called module.spots.pupil.{name} now"
        assert note in said.out.splitlines()
    assert said.out.splitlines()[-1] == "reproduced"

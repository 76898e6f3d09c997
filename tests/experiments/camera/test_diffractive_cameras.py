"""Cameras with a diffractive element, as their experiments begin."""

import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf

from dolens.prescriptions import lens_from_prescription


@pytest.mark.parametrize("name", ["diffractive_achromat", "diffractive_edof"])
def test_waves_make_the_functions_that_a_restorer_is_told(name, composed):
    cfg = composed(f"experiment={name}")
    lens = lens_from_prescription(OmegaConf.to_container(cfg.lens, resolve=True))
    start = {key: value["initial"] for key, value in cfg.variables.items() if "initial" in value}
    views = instantiate(cfg.views)
    with torch.no_grad():
        found = views.point_spread_functions(lens.with_values(start))
    assert found.shape[-1] == cfg.psf_size
    light = found.sum((-2, -1))
    assert float(light.min()) > 0.5 and float(light.max()) < 1.01

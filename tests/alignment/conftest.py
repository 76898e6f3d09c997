"""Lenses whose poses are fitted."""

import pytest
import torch
import yaml

from dolens.prescriptions import lens_from_prescription


@pytest.fixture(scope="module")
def triplet(root):
    prescription = yaml.safe_load((root / "conf/lens/cooke_triplet.yaml").read_text())
    spans = {"front": [1, 2], "middle": [3, 4], "rear": [5, 6]}
    prescription["elements"] = {name: {"surfaces": span} for name, span in spans.items()}
    return lens_from_prescription(prescription, torch.float64)

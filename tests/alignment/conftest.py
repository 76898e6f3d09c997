"""Lenses whose poses are fitted."""

import pytest
import yaml

from dolens.prescriptions import lens_from_prescription


@pytest.fixture
def singlet(root):
    prescription = yaml.safe_load((root / "conf/lens/la1509.yaml").read_text())
    prescription["elements"] = {"lens": {"surfaces": [1, 2]}}
    return lens_from_prescription(prescription).double().requires_grad_(False)

"""Nothing is imported before it is needed: seconds of every start, and compilers that may fail."""

import copy
import pickle
import subprocess
import sys
from pkgutil import resolve_name

import pytest

from dolens import load_lens
from dolens.optics import LENS_METHODS
from dolens.views import LensViews

# In this order: each part imports what the one before must not.
PROGRAM = """
import sys

def loaded(*names):
    return [m for m in sys.modules for name in names if m == name or m.startswith(name + ".")]

# What starts the jobs of a sweep, and its processes, wait for no PyTorch.
import dolens.experiments.sweeps.launch, dolens.experiments.sweeps.launchers
assert not loaded("torch"), "torch"

# What shows a lens is imported when it is called.
import dolens.optics.lens
above = loaded("dolens.views", "dolens.analysis", "dolens.diffraction", "dolens.plotting")
assert not above, above

# A few rays and a drawing need no compiler, and rays no SymPy, which some functions of PyTorch
# import: half a second.
import torch, dolens
lens = dolens.load_lens("conf/lens/nikon.yaml")
rays = dolens.Rays(torch.zeros(20, 3) - 1.0, torch.tensor([0.0, 0.0, 1.0]), 550.0)
lens.trace(rays).position.sum().backward()
lens.first_order(), lens.seidel(10.0)
# A lens in the terminal needs no drawing and no page, and aiming a ray no compiler of PyTorch's.
from dolens.lens_page.overview import lens_overview, prepared_lens
lens.chief_ray((0.0, 10.0))
# Nor does the power of a freeform surface, which is a derivative.
dolens.load_lens("conf/lens/freeform_corrector.yaml").first_order(meridian="y")
assert not loaded("sympy", "torch._dynamo", "matplotlib", "jinja2")
assert not loaded("dolens.prescriptions.zemax", "dolens.prescriptions.codev")
# Nor do elements of glass.
import dolens.manufacturing.glass_elements
assert not loaded("dolens.plotting", "matplotlib")
from dolens.plotting import layout_figure
layout_figure(lens)
# A draft waits for no kernels, and an MTF for no SciPy.
triplet = dolens.load_lens("cooke_triplet")
triplet.spots(draft=True), triplet.mtf(draft=True)
assert not loaded("numba", "scipy", "torch._dynamo", "sympy")

# The restorer of photographs needs no package that trains networks.
import dolens.reconstruction
lens.photograph(torch.rand(3, 20, 20), light=None)
assert not loaded("torchvision", "torchmetrics", "skimage", "lightning")

# A lens on the CPU loads no kernels for GPUs.
lens = dolens.load_lens("conf/lens/asphere.yaml", backend="cpu")
ray = torch.tensor([[0.0, 1.0, -5.0]]), torch.tensor([[0.0, 0.0, 1.0]])
lens.trace(dolens.Rays(*ray))
assert loaded("numba") and not loaded("dolens.kernels.cuda")
"""


def test_each_part_imports_no_more_than_it_needs(root):
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=root, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_a_lens_has_the_methods_that_show_it_wherever_it_comes_from():
    lens = load_lens("cooke_triplet")
    for each in (lens, copy.deepcopy(lens), pickle.loads(pickle.dumps(lens))):
        assert {"spots", "mtf", "summary", "trace", "surfaces"} <= set(dir(each))
        assert each.summary.__self__ is each and each.summary.__func__ is LensViews.summary
    methods = {name for name in dir(LensViews) if not name.startswith("_")}
    home = "dolens.views.LensViews"
    assert methods == {name for name, place in LENS_METHODS.items() if place == home}
    for name, place in LENS_METHODS.items():
        assert callable(getattr(resolve_name(place), name))
    with pytest.raises(AttributeError, match="no attribute 'spotz'"):
        lens.spotz()

"""What a layout shows is what the lens does."""

import numpy as np
import pytest

from dolens import load_lens
from dolens.plotting import layout_figure


def test_axial_rays_meet_near_the_printed_focus_of_the_triplet(root):
    figure = layout_figure(load_lens(root / "conf/lens/cooke_triplet.yaml"), rays=5)
    lines = [a for a in figure.axes[0].get_children() if a.get_gid() == "ray"]
    assert len(lines) == 5
    assert np.ptp([line.get_ydata()[-1] for line in lines]) < 0.05  # F/4.9, tens of µm
    assert lines[0].get_xdata()[-1] == pytest.approx(60.177)  # the printed sensor plane

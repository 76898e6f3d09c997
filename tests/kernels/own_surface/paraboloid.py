"""A surface of a user's own, an elliptic paraboloid, with kernels from the same three functions."""

from dolens.kernels.operations import put, zero
from dolens.optics.surfaces import Shape, Surface


def sag(p, x, y):
    cx, cy, twist = p
    sag = 0.5 * (cx * x * x + cy * y * y) + twist * x * y
    return sag, cx * x + twist * y, cy * y + twist * x, zero(x) + 1.0


def sag_hessian(p, x, y):
    cx, cy, twist = p
    return cx * x + twist * y, cy * y + twist * x, cx, twist, cy


def parameters(cotangents, p, x, y, of_sag, of_x, of_y):
    put(cotangents, 0, 0.5 * of_sag * x * x + of_x * x)
    put(cotangents, 1, 0.5 * of_sag * y * y + of_y * y)
    put(cotangents, 2, of_sag * x * y + of_x * y + of_y * x)


class Paraboloid(Surface):
    """z = (c_x·x² + c_y·y²)/2 + twist·x·y."""

    kind = "paraboloid"
    shape = Shape("paraboloid", sag, sag_hessian, parameters, layout=(None,) * 3)

    @classmethod
    def parameter_names(cls, keys):
        return ["curvature_x", "curvature_y", "twist"]

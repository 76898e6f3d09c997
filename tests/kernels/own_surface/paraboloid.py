"""A surface of a user's own, an elliptic paraboloid; its kernels are two modules beside it."""

from dolens.optics.surfaces import Surface, SurfaceKernel


class Paraboloid(Surface):
    """z = (c_x·x² + c_y·y²)/2 + twist·x·y."""

    kind = "paraboloid"
    kernel = SurfaceKernel(
        cpu="tests.kernels.own_surface.paraboloid_cpu",
        cuda="tests.kernels.own_surface.paraboloid_cuda",
    )

    @classmethod
    def parameter_names(cls, keys):
        return ["curvature_x", "curvature_y", "twist"]

    @classmethod
    def sag_and_gradient(cls, p, x, y):
        cx, cy, twist = p["curvature_x"], p["curvature_y"], p["twist"]
        sag = 0.5 * (cx * x * x + cy * y * y) + twist * x * y
        return sag, cx * x + twist * y, cy * y + twist * x, None

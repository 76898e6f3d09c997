"""The paraboloid's CPU kernels, from three functions of one point."""

from numba import njit

from dolens.kernels.cpu.explicit import OPTIONS, given_by_scalars


def paraboloid(real):
    half, one = real(0.5), real(1.0)

    @njit(**OPTIONS)
    def sag(p, x, y):
        sag = half * (p[0] * x * x + p[1] * y * y) + p[2] * x * y
        return sag, p[0] * x + p[2] * y, p[1] * y + p[2] * x, one

    @njit(**OPTIONS)
    def sag_hessian(p, x, y):
        return p[0], p[2], p[1]

    @njit(**OPTIONS)
    def parameters(p, x, y, of_sag, of_x, of_y):
        return (
            half * of_sag * x * x + of_x * x,
            half * of_sag * y * y + of_y * y,
            of_sag * x * y + of_x * y + of_y * x,
        )

    return sag, sag_hessian, parameters


KERNELS = given_by_scalars(paraboloid, numbers=3)

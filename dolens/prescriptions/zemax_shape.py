"""A shape of a Zemax `.zmx` file is an entry of a table: its TYPE, how it is read, and written."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from dolens.prescriptions.zemax.file import SurfaceBlock

Row = dict[str, Any]


class ZemaxShape(NamedTuple):
    """A `ZemaxShape` is a TYPE of surface that a prescription holds.

    Attributes:
        type: the word behind TYPE.
        kinds: the types of a prescription's rows that are written as this TYPE.
        read: a surface's block → its row's `type` and the keys of its shape (`radius`, `conic`,
            ...), in mm; medium, aperture, gap and remark are added for it.
        write: a row and its name in messages → the lines of the shape without TYPE, such as
            `CURV 0.02` and `PARM 2 1e-6`, in mm.  The writer reads all lines back and compares, so
            that what has no line is refused there.
        parameters: the numbers of PARM that it reads; any other that is not zero refuses a file.
            None: all are passed over.
        extra_data: the same for XDAT.
        phase: the `type` of the phase that a row must have to be written as this TYPE; none: it
            must have no phase.
        surface: whether light meets a surface there, which has a medium behind it and an aperture;
            a change of axes has a gap only.
    """

    type: str
    kinds: tuple[str, ...]
    read: Callable[[SurfaceBlock], Row]
    write: Callable[[Mapping[str, Any], str], list[str]]
    parameters: Sequence[int] | None = ()
    extra_data: Sequence[int] | None = ()
    surface: bool = True
    phase: str = ""

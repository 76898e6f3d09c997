"""The tools: each is a method, whose docstring and parameters a program reads.

They are short, with units, defaults and what is allowed.
"""

import base64
import json
from pathlib import Path
from typing import Annotated, Any, Literal

from mcp_types import CallToolResult, ImageContent, TextContent
from pydantic import Field

from dolens.errors import InputError, check_choice
from dolens.mcp.answer import Answer
from dolens.mcp.session import Session

MOST_LENS_BYTES, MOST_PICTURE_FILE_BYTES = 8 * 2**20, 32 * 2**20
LENS_SUFFIXES = (".yaml", ".yml", ".json", ".zmx", ".seq", ".len", ".roa", ".txt")
WRITTEN_SUFFIXES = (".yaml", ".json", ".zmx", ".seq", ".txt")
MOST_ELEMENTS = 8
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")

Lens = Annotated[str, Field(description="name of a lens of the session, as 'lens' answers it")]
Picture = Annotated[bool, Field(description="whether to answer with a picture (PNG)")]
NewName = Annotated[
    str | None, Field(description="name for the new lens; by default one is made from the old")
]
Fields = Annotated[
    list[float] | list[list[float]] | None,
    Field(
        description="degrees along y, or points [x, y]; mm on a near object; default: the lens's "
        "own",
        max_length=25,
    ),
]
Wavelengths = Annotated[
    list[float] | None, Field(description="nm; default: the lens's own", max_length=15)
]
Keep = dict[str, float | list[float | None] | dict[str, Any]]
Limits = dict[str, float | list[float | None] | None]
Seconds = Annotated[
    float,
    Field(
        description="s after which no further part of the search begins, at most 0.7 of a call's "
        "limit; it ends up to half a minute later",
        gt=0,
        le=600,
    ),
]


def result(answer: Answer) -> CallToolResult:
    """Return an answer in the protocol's form: JSON, structured and as text, and the picture."""
    values = {**answer.values}
    if answer.errors:
        values["errors"] = answer.errors
    if answer.notes:
        values["notes"] = answer.notes
    text = json.dumps(values, ensure_ascii=False, allow_nan=False)
    content: list[Any] = [TextContent(type="text", text=text)]
    if answer.picture is not None:
        data = base64.b64encode(answer.picture).decode()
        content.append(ImageContent(type="image", data=data, mime_type="image/png"))
    return CallToolResult(content=content, structured_content=values)


class Tools:
    """The tools: each is a method, whose docstring and parameters a program reads.

    Args:
        session: whose lenses they are about.
    """

    def __init__(self, session: Session) -> None:
        self.session = session

    async def _done(self, job: str, given: dict[str, Any]) -> CallToolResult:
        """Run a job with the arguments of its tool.

        Args:
            job: its name.
            given: the local variables of the tool's method.
        """
        more = {key: value for key, value in given.items() if key not in ("self", "lens", "name")}
        after = given.get("lens", "lens")
        if "lens" in given:
            more["prescription"] = self.session.prescription(after)
        return result(await self.session.run(job, given.get("name"), after, **more))

    def _within(self, seconds: float) -> float:
        """Return seconds of a search that leave time to check what it found."""
        return min(seconds, 0.7 * self.session.worker.seconds)

    async def lenses(self) -> CallToolResult:
        """List the lenses of the session, and the lens files and pictures of the folder."""
        folder = self.session.folder
        answer = await self.session.run("of_dolens")
        answer.values = {
            "session": list(self.session.lenses),
            "lens_files": folder.files(LENS_SUFFIXES),
            "pictures": folder.files(PICTURE_SUFFIXES),
            "writable_suffixes": list(WRITTEN_SUFFIXES),
            **answer.values,
        }
        return result(answer)

    async def load(
        self,
        source: Annotated[
            str | None,
            Field(
                description="a file of the folder (.yaml .json .zmx .seq .len .roa .txt), or a "
                "lens of dolens, as 'cooke_triplet' or 'published/tessar_us2838978'"
            ),
        ] = None,
        prescription: Annotated[
            str | None,
            Field(
                description="instead: a prescription as YAML text, as 'show' with text=true "
                "answers it",
                max_length=1_000_000,
            ),
        ] = None,
        name: NewName = None,
        picture: Picture = True,
    ) -> CallToolResult:
        """Load a lens from a file, by name or from text, and show it: first-order data, surfaces,
        Seidel sums (µm), RMS spots (µm)."""
        if (source is None) == (prescription is None):
            raise InputError("load: give either source or prescription")
        data = None
        if prescription is not None:
            source, data = "prescription.yaml", prescription.encode()
        elif source is not None and Path(source).suffix:
            check_choice(Path(source).suffix.lower(), LENS_SUFFIXES, f"load: {source}: suffix")
            data = self.session.folder.read(source, MOST_LENS_BYTES)
        answer = await self.session.run("load", name, source=source, data=data, picture=picture)
        return result(answer)

    async def change(
        self,
        lens: Lens,
        changes: Annotated[
            dict[str, Any],
            Field(
                description="path → value, as {'surfaces.1.radius': 21.5, 'surfaces.2.material': "
                "'SCHOTT:N-SF5', 'f_number': 4, 'fields.angles': [[0, 0], [0, 14]]}; lengths mm; "
                "a semi_diameter of 'auto' lets the light of the fields pass",
                max_length=200,
            ),
        ],
        name: NewName = None,
        picture: Picture = True,
    ) -> CallToolResult:
        """Make a new lens of an old one by changing values of its prescription, and show it."""
        return await self._done("change", locals())

    async def show(
        self,
        lens: Lens,
        text: Annotated[
            bool, Field(description="whether to add the prescription as YAML text")
        ] = False,
        picture: Picture = True,
    ) -> CallToolResult:
        """Show a lens: first-order data, surfaces, Seidel sums (µm), RMS spots (µm), section."""
        return await self._done("show", locals())

    async def trace(
        self,
        lens: Lens,
        field: Annotated[
            list[float],
            Field(description="x and y, degrees (mm on a near object)", min_length=2, max_length=2),
        ] = [0.0, 0.0],  # noqa: B006
        pupil: Annotated[
            list[list[float]],
            Field(
                description="x and y where each ray crosses the stop, over its semi-diameter "
                "(-1 to 1)",
                min_length=1,
                max_length=1000,
            ),
        ] = [[0.0, 0.0], [0.0, 1.0], [0.0, -1.0]],  # noqa: B006
        wavelength: Annotated[
            float | None, Field(description="nm; default: the reference wavelength")
        ] = None,
        path: Annotated[
            bool, Field(description="whether to tell where the first ray meets every surface")
        ] = False,
        picture: Picture = True,
    ) -> CallToolResult:
        """Trace rays of a field through points of the stop: where they land (mm), and which fail
        (VIGNETTED, TIR, MISSED)."""
        if any(len(point) != 2 for point in pupil):
            raise InputError(f"pupil: {pupil}; allowed: x and y of each ray")
        return await self._done("trace", locals())

    async def analyse(
        self,
        lens: Lens,
        what: Annotated[
            Literal[
                "spots",
                "ray_fans",
                "mtf",
                "wavefront",
                "field_curves",
                "lateral_colour",
                "encircled_energy",
                "relative_illumination",
            ],
            Field(
                description="spots (µm), ray_fans (µm), mtf (with diffraction), wavefront (waves, "
                "Zernike), field_curves (distortion %, foci mm), lateral_colour (µm), "
                "encircled_energy (µm), relative_illumination"
            ),
        ] = "spots",
        fields: Fields = None,
        wavelengths: Wavelengths = None,
        f_number: Annotated[
            float | None, Field(description="sets the stop first; default: as it is", gt=0)
        ] = None,
        frequencies: Annotated[
            list[float] | None,
            Field(description="cycles/mm, of mtf; default: to little contrast", max_length=200),
        ] = None,
        picture: Picture = True,
    ) -> CallToolResult:
        """Analyse a lens at its fields and wavelengths."""
        return await self._done("analyse", locals())

    async def optimize(
        self,
        lens: Lens,
        variables: Annotated[
            list[str] | dict[str, dict[str, Any] | None],
            Field(
                description="patterns, as ['surfaces.*.curvature', 'thicknesses.[24]', "
                "'sensor_distance']; or with bounds in mm, as {'thicknesses.*': {'lower': 1, "
                "'upper': 8}, 'sensor_distance': {'solve': 'best_focus'}}",
                max_length=100,
            ),
        ],
        for_: Annotated[
            Literal["spots", "wavefront"],
            Field(description="what becomes small: RMS spot radii, or RMS wavefront errors"),
        ] = "spots",
        keep: Annotated[
            Keep | None,
            Field(
                description="operand → target, [min, max] with null for none, or settings: efl, "
                "back_focus, f_number, total_track, distortion (%), edge_thickness, "
                "centre_thickness, air_gap, edge_air_gap, as {'efl': 50, 'back_focus': [30, null]}"
            ),
        ] = None,
        iterations: Annotated[int, Field(description="at most", ge=1, le=500)] = 50,
        fields: Fields = None,
        wavelengths: Wavelengths = None,
        name: NewName = None,
        picture: Picture = True,
    ) -> CallToolResult:
        """Make a better lens by damped least squares; apertures stay. Keep efl, or it changes."""
        return await self._done("optimize", locals())

    async def search(
        self,
        efl: Annotated[float, Field(description="focal length, mm", gt=0)],
        f_number: Annotated[float, Field(description="efl over the entrance pupil", gt=0)],
        field: Annotated[float, Field(description="degrees, axis to edge", ge=0, lt=80)],
        elements: Annotated[
            int | list[int],
            Field(
                description="how many, 8 at most; or elements of each cemented group from the "
                "front, as [1, 2, 2, 1]"
            ),
        ],
        glasses: Annotated[
            list[str],
            Field(
                description="one for all or for each, as ['SCHOTT:N-BK7']; default: chosen among "
                "SCHOTT's N-*",
                max_length=8,
            ),
        ] = [],  # noqa: B006
        wavelengths: Annotated[
            list[float],
            Field(description="nm, the middle one is the reference", min_length=1, max_length=7),
        ] = [656.2725, 587.5618, 486.1327],  # noqa: B006
        limits: Annotated[
            Limits | None,
            Field(
                description="mm: track (most), back_focus (least), glass and air ([least, most] "
                "on the axis), glass_edge, air_edge (least); distortion (a fraction, 0.02)"
            ),
        ] = None,
        seconds: Seconds = 20.0,
        starts: Annotated[int, Field(description="random starts, at most", ge=1, le=20000)] = 2000,
        forms: Annotated[int, Field(description="best forms to answer", ge=1, le=20)] = 4,
        glass_trials: Annotated[
            Literal["few", "usual"],
            Field(
                description="real glasses tried in the place of continuous ones: few take a "
                "third of the time"
            ),
        ] = "usual",
        seed: Annotated[int, Field(description="of the starts", ge=0, lt=2**31)] = 0,
        picture: Picture = True,
    ) -> CallToolResult:
        """Search for lenses of spheres from nothing but what they must do: object at infinity,
        real glasses. Answers with the best forms as lenses, their RMS spots (µm) and checks."""
        if sum(elements if isinstance(elements, list) else [elements]) > MOST_ELEMENTS:
            raise InputError(f"elements: {elements}; allowed: {MOST_ELEMENTS} at most")
        seconds = self._within(seconds)
        return await self._done("search", locals())

    async def neighbours(
        self,
        lens: Lens,
        seconds: Seconds = 20.0,
        starts: Annotated[int, Field(description="at most", ge=1, le=5000)] = 200,
        forms: Annotated[int, Field(description="best forms to answer", ge=1, le=20)] = 4,
        spread: Annotated[
            float, Field(description="how far starts lie from the lens; 1 is far", ge=0, lt=10)
        ] = 1.0,
        limits: Annotated[
            Limits | None, Field(description="as of search; default: the lens's own, with room")
        ] = None,
        seed: Annotated[int, Field(description="of the starts", ge=0, lt=2**31)] = 0,
        picture: Picture = True,
    ) -> CallToolResult:
        """Search for other forms near a lens of spheres that do the same task with its glasses."""
        seconds = self._within(seconds)
        return await self._done("neighbours", locals())

    async def check(
        self,
        lens: Lens,
        focal_length: Annotated[float | None, Field(description="mm, within 1 %", gt=0)] = None,
        f_number: Annotated[
            float | None, Field(description="of the real marginal ray, within 2 %", gt=0)
        ] = None,
        total_track: Annotated[
            float | None, Field(description="mm at most, first vertex to sensor")
        ] = None,
        back_focus: Annotated[float | None, Field(description="mm at least")] = None,
        mean_rms_spot_um: Annotated[
            float | None, Field(description="µm at most, mean over the lens's fields")
        ] = None,
        distortion: Annotated[float | None, Field(description="% at most, either way")] = None,
        glass_centre: Annotated[
            list[float | None],
            Field(
                description="mm, least and most of glass on the axis", min_length=2, max_length=2
            ),
        ] = [0.0, None],  # noqa: B006
        glass_edge: Annotated[float, Field(description="mm at least, within the beams")] = 0.0,
        air_centre: Annotated[
            list[float | None],
            Field(description="mm, least and most of air on the axis", min_length=2, max_length=2),
        ] = [0.0, None],  # noqa: B006
        air_edge: Annotated[float, Field(description="mm at least, within the beams")] = 0.0,
        vignetting: Annotated[
            float, Field(description="share of light that may be lost, 0 to 1", ge=0, le=1)
        ] = 0.0,
        picture: Picture = True,
    ) -> CallToolResult:
        """Check a lens against limits by real rays over the whole field: which hold, which not."""
        return await self._done("check", locals())

    async def tolerance(
        self,
        lens: Lens,
        rms_spot_um: Annotated[
            float | None,
            Field(description="µm: what a good lens stays within; answers the yield", gt=0),
        ] = None,
        tolerances: Annotated[
            Literal["default"] | dict[str, float | dict[str, Any]],
            Field(
                description="'default', or pattern → half-range in mm and degrees, as "
                "{'thicknesses.*': 0.02, 'elements.*.tilt_[xy]': 0.05, 'surfaces.*.curvature': "
                "{'half_range': 0.001, 'relative': true}}"
            ),
        ] = "default",
        lenses: Annotated[int, Field(description="drawn and traced", ge=10, le=2000)] = 200,
        seed: Annotated[int, Field(description="of the errors", ge=0, lt=2**31)] = 0,
        picture: Picture = True,
    ) -> CallToolResult:
        """Find what tolerances do to a lens: RMS radii (µm) that shares of refocused lenses stay
        within, the yield (%), the worst offenders."""
        return await self._done("tolerance", locals())

    async def photograph(
        self,
        lens: Lens,
        file: Annotated[
            str | None,
            Field(description="a picture of the folder (.png .jpg .tif .bmp); default: a chart"),
        ] = None,
        distance: Annotated[
            float | None, Field(description="mm; default: the lens's object distance", gt=0)
        ] = None,
        light: Annotated[
            float | None,
            Field(description="electrons of a white pixel; null: no noise", gt=0, le=1e6),
        ] = 100.0,
        picture: Picture = True,
    ) -> CallToolResult:
        """Show what a sensor behind the lens would see of a picture, 512 pixels wide at most."""
        data = None
        if file is not None:
            check_choice(Path(file).suffix.lower(), PICTURE_SUFFIXES, f"file: {file}: suffix")
            data = self.session.folder.read(file, MOST_PICTURE_FILE_BYTES)
        return await self._done("photograph", locals())

    async def export(
        self,
        lens: Lens,
        file: Annotated[
            str, Field(description="in the folder; its suffix .yaml .json .zmx .seq .txt counts")
        ],
        overwrite: Annotated[
            bool, Field(description="whether to replace a file of an earlier session or of others")
        ] = False,
        picture: Picture = True,
    ) -> CallToolResult:
        """Write a lens to a file of the folder, and say what the format could not hold."""
        check_choice(Path(file).suffix.lower(), WRITTEN_SUFFIXES, f"export: {file}: suffix")
        self.session.folder.check_writable(file, overwrite)
        old = self.session.prescription(lens)
        answer = await self.session.run("export", prescription=old, file=file, picture=picture)
        assert answer.file is not None
        self.session.folder.write(file, answer.file, overwrite)
        answer.values = {"file": file, **answer.values}
        return result(answer)


TOOLS = (
    *("lenses", "load", "change", "show", "trace", "analyse", "optimize", "search", "neighbours"),
    *("check", "tolerance", "photograph", "export"),
)

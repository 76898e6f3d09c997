"""Write docs/lenses.md and docs/lenses.png: lenses from patents and books, as a table and drawn.

    python scripts/published_lenses.py              # both
    python scripts/published_lenses.py --table      # the table alone

The table is made from the files of conf/lens/published alone;
tests/scripts/test_published_lenses.py holds it to them.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dolens.prescriptions import load_prescription, published_lens_names

DOCS = Path(__file__).resolve().parents[1] / "docs"
TABLE, PICTURE = DOCS / "lenses.md", DOCS / "lenses.png"
_HEAD = """# Published lenses

dolens comes with {count} prescriptions from patents, books, papers and catalogues. Load one by its
name, `dolens.load_lens("published/tessar_us2838978")`, and look at it with
`dolens show published/tessar_us2838978`.

The numbers of the table are those that the source prints. A blank is a number that the source does
not print, or that was not seen; `Lens.published.note` says what else a reader must know about a
prescription: a misprint, a place of the stop that is not printed, a scale. Semi-diameters that are
not printed are computed from the fields and clip nothing. The focal length that dolens computes
lies within the tolerance that stands behind the published one: half a unit of its last printed
digit, or more where the rounding of radii, gaps and indices allows more, or 1 % of a nominal one.

![Sections of the published lenses](lenses.png)

| name | kind | EFL (mm) | aperture | field | source |
| --- | --- | --- | --- | --- | --- |
"""


def document() -> str:
    """Return the text of docs/lenses.md."""
    names = published_lens_names()
    rows = [_row(name, load_prescription(name)) for name in names]
    return _HEAD.format(count=len(names)) + "\n".join((*rows, ""))


def _row(name: str, prescription: Mapping[str, Any]) -> str:
    published = prescription["published"]
    cells = (
        f"`{name.partition('/')[2]}`",
        published.get("kind", ""),
        _focal_length(published),
        _aperture(published),
        _field(published),
        prescription["source"],
    )
    return f"| {' | '.join(str(cell).replace('|', '/') for cell in cells)} |"


def _focal_length(published: Mapping[str, Any]) -> str:
    if "efl" not in published:
        return ""
    return f"{published['efl']} ± {float(published['efl_tolerance']):g}"


def _aperture(published: Mapping[str, Any]) -> str:
    if "f_number" in published:
        return f"f/{published['f_number']}"
    if "object_na" in published:
        return f"NA {published['object_na']} (object)"
    if "na" in published:
        return f"NA {published['na']}"
    if "entrance_pupil_diameter" in published:
        return f"pupil {published['entrance_pupil_diameter']} mm"
    return ""


def _field(published: Mapping[str, Any]) -> str:
    if "half_field" in published:
        return f"±{published['half_field']}°"
    for key, what in (("image_height", "image"), ("object_height", "object")):
        if key in published:
            return f"±{published[key]} mm ({what})"
    return ""


def main() -> None:
    """Write the files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--table", action="store_true", help="write the table alone")
    only_table = parser.parse_args().table
    TABLE.write_text(document(), encoding="utf-8")
    if not only_table:
        from dolens import load_lens
        from dolens.plotting import save_figure
        from dolens.plotting.small_sections import lens_sheet_figure

        lenses = {name.partition("/")[2]: load_lens(name) for name in published_lens_names()}
        save_figure(lens_sheet_figure(lenses), PICTURE)


if __name__ == "__main__":
    main()

"""The documents name what exists: modules, experiments, files; docstrings begin with a sentence."""

import ast
import importlib
import re
from decimal import Decimal
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
SUPPLEMENT = (ROOT / "docs/supplement.md").read_text(encoding="utf-8")
SOURCES = sorted(p for top in ("dolens", "experiments") for p in (ROOT / top).rglob("*.py"))
# Parts of the library, but for those whose names are also groups of the configuration.
PARTS = {p.name for p in (ROOT / "dolens").iterdir() if (p / "__init__.py").exists()}
PARTS -= {p.name for p in (ROOT / "conf").iterdir()}
NAMES = sorted(
    {
        name
        for source in (*DOCUMENTS, *SOURCES)
        for name in re.findall(
            rf"`((?:dolens|torch|{'|'.join(PARTS)})(?:\.\w+)+)`", source.read_text(encoding="utf-8")
        )
        if not name.endswith((".py", ".txt", ".html"))
    }
)
# Packages whose docstrings follow the rules of docs/glossary.md.
PROSE = ("analysis", "sensor", "plotting", "reconstruction", "prescriptions")
TITLES = re.compile(r"(Of|As|By|What|Where|Which|How|Whether)\b|\(|√|Σ")


def resolved(name):
    """The module, class, function or method of a dotted name."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError as error:
            assert ".".join(parts[:length]).startswith(error.name)
            continue
        for part in parts[length:]:
            found = getattr(found, part)
        return found
    raise AssertionError(f"no module {name}")


@pytest.mark.parametrize("name", NAMES)
def test_a_dotted_name_of_documents_and_docstrings_is_in_the_code(name):
    own = name.partition(".")[0] in PARTS
    resolved(f"dolens.{name}" if own else name)


def test_the_supplement_is_complete():
    """S1 to S21, Algorithm 1, the figures 1 to 12 and every table have a row of their own."""
    rows = [line.split("|")[1].strip() for line in SUPPLEMENT.splitlines() if line.startswith("| ")]
    for item in (
        *(f"S{number}" for number in range(1, 22)),
        "Algorithm 1",
        *(f"Figure {number}" for number in range(1, 13)),
        *("Table I (Section III A)", "Table II (Section III B)", "Table I (Section III C)"),
        *("Table II", "Table III"),
    ):
        assert rows.count(item) == 1, item


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_path_of_the_repository_exists(document):
    """`tests/…`, `conf/…` and so on; a path with a placeholder or a pattern is not looked up."""
    text = document.read_text(encoding="utf-8")
    for path in re.findall(r"`((?:dolens|experiments|tests|conf|scripts|docs)/[\w./-]+)`", text):
        assert (ROOT / path).exists(), path


def test_the_glossary_s_present_names_are_in_the_code():
    """The second column of every table: each name, and each key or value, stands somewhere."""
    files = [
        path
        for top in ("dolens", "experiments", "conf")
        for path in (ROOT / top).rglob("*")
        if path.suffix in (".py", ".yaml")
    ]
    words = {path.stem for path in files}
    for path in files:
        words.update(re.findall(r"\w+", path.read_text(encoding="utf-8")))
    for line in (ROOT / "docs/glossary.md").read_text(encoding="utf-8").splitlines():
        if line.startswith("| ") and not line.startswith("| Was"):
            for name in re.findall(r"`([^`]+)`", line.split("|")[2]):
                missing = set(re.findall(r"[A-Za-z_]\w+", name)) - words
                assert not missing, f"{line.split('|')[1].strip()}: {missing}"


def anchors(document):
    """The anchors of a document's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", document.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_link_leads_somewhere(document):
    for target in re.findall(r"\]\(([^)\s]+)\)", document.read_text(encoding="utf-8")):
        if "://" in target:
            continue
        path, _, anchor = target.partition("#")
        file = (document.parent / path).resolve() if path else document
        assert file.exists(), target
        assert not anchor or anchor in anchors(file), target


FILES = [
    *(path for package in PROSE for path in sorted((ROOT / "dolens" / package).rglob("*.py"))),
    *sorted((ROOT / "experiments/data").glob("*.py")),
]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_docstring_begins_with_a_sentence_and_not_with_a_title(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
            text = ast.get_docstring(node)
            assert text is None or not TITLES.match(text), text.splitlines()[0]


def tables(document):
    """The tables of a document: of each its rows, the header's names first."""
    text = document.read_text(encoding="utf-8")
    for block in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        rows = [[cell.strip(" *") for cell in row.split("|")[1:-1]] for row in block.splitlines()]
        yield rows[:1] + rows[2:]


def number(cell):
    """The first decimal number of a cell as it is printed; None where there is none."""
    found = re.search(r"[+−-]?\d+\.\d+", cell)
    return Decimal(found[0].replace("−", "-")) if found else None


# Names of the columns of what a column of gains is of.
VALUES = ("packages", "worst tenth", "anywhere")


def printed_gains():
    """Every gain in dB of the documents' tables: where it stands, it, and its two numbers."""
    for row in next(rows for rows in tables(ROOT / "README.md") if "system" in rows[0][0]):
        # In one cell: 26.75 dB by Adam, gain +0.37 dB; 26.86 dB by least squares, +0.48 dB.
        for value, gain in re.findall(r"(\d+\.\d+) dB[^;]*?, (?:gain )?(\+\d+\.\d+) dB", row[3]):
            yield f"README, {row[0]}", Decimal(gain), Decimal(value), number(row[1])
    for document in DOCUMENTS:
        for head, *rows in tables(document):
            for place, row in enumerate(rows):
                where = f"{document.name}, {row[0]}"
                for column, cell in enumerate(row):
                    # In one cell: 25.35: +1.38, over the first row.
                    value, colon, gain = cell.partition(": ")
                    if colon and re.fullmatch(r"\d+\.\d+", value):
                        yield where, number(gain), number(value), number(rows[0][column])
                    # In a row: over the two above.
                    if row[0] == "gain" and column and cell:
                        below, above = rows[place - 1][column], rows[place - 2][column]
                        yield where, number(cell), number(below), number(above)
                if "gain" not in head or not row[head.index("gain")]:
                    continue
                # In a column: over the row of the same conditions that has none.
                gain = head.index("gain")
                alike = [head.index(k) for k in ("seconds", "seeds", "tolerances") if k in head]
                value = next(head.index(k) for k in VALUES if k in head)
                (over,) = (r for r in rows if not r[gain] and all(r[i] == row[i] for i in alike))
                yield where, number(row[gain]), number(row[value]), number(over[value])


def test_gains_of_depth_of_field_are_over_the_plain_lens_of_their_condition():
    """Of the worst depth and of the mean, to the rounding of printed numbers."""
    text = (ROOT / "docs/results/phase_plate.md").read_text(encoding="utf-8")
    plain, checked = None, 0
    for line in re.findall(r"^\| \d+ \| (?:blind|by depth) \|.*$", text, re.M):
        light, restorer, camera, _, depths, *gains = (
            c.strip() for c in line.strip("| ").split("|")
        )
        scores = [float(value) for value in depths.split("/")]
        if camera.startswith("plain"):
            plain = (light, restorer), scores
            continue
        assert plain is not None and plain[0] == (light, restorer)
        worst, mean = (float(gain.split()[0]) for gain in gains)
        assert worst == pytest.approx(min(scores) - min(plain[1]), abs=0.011)
        assert mean == pytest.approx((sum(scores) - sum(plain[1])) / 3.0, abs=0.011)
        checked += 1
    assert checked > 20


def test_a_gain_is_the_difference_of_its_two_printed_numbers():
    gains = list(printed_gains())
    assert len(gains) > 30
    wrong = [(where, *map(str, rest)) for where, *rest in gains if rest[0] != rest[1] - rest[2]]
    assert not wrong

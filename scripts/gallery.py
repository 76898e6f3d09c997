"""The cards of the documentation: pictures of runs, and what experiments and notebooks say.

    python scripts/gallery.py outputs/nikon/<date_time> --figure layout

puts a figure of a run on its experiment's card.  MkDocs (mkdocs.yml, hooks) makes the cards where a
page has a line `<!-- cards: nikon notebooks/zoom_lens -->`: sentences, commands and costs stand in
conf/experiment and in the notebooks, and nowhere else.
"""

import argparse
import base64
import io
import json
import re
import sys
from pathlib import Path
from typing import Any

import yaml
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from dolens.experiments.running.catalogue import configuration_folders, experiments  # noqa: E402

PICTURES = ROOT / "docs/images/gallery"
SETTINGS = PICTURES / "settings.yaml"
SIZE = (600, 400)
MOST_BYTES = 40_000
CARDS = re.compile(r"^<!-- cards(?: of (?P<page>\S+))?: (?P<names>[\w /\n]+) -->$", re.MULTILINE)
# Figures of a run, the one that says most first.
FIGURES = ("images", "forms", "layout", "yield", "marks", "alignment", "spots")


def card_picture(picture: Image.Image) -> bytes:
    """Return a picture as WebP: whole on white, or the upper part of one that is tall."""
    picture = picture.convert("RGB")
    width, height = SIZE
    if picture.width < picture.height:
        picture = picture.crop((0, 0, picture.width, picture.width * height // width))
    picture.thumbnail(SIZE, Image.Resampling.LANCZOS)
    card = Image.new("RGB", SIZE, "white")
    card.paste(picture, ((width - picture.width) // 2, (height - picture.height) // 2))
    for quality in (90, 80, 70, 60, 50, 40):
        buffer = io.BytesIO()
        card.save(buffer, "WEBP", quality=quality, method=6)
        if buffer.tell() <= MOST_BYTES:
            break
    return buffer.getvalue()


def take(run: Path, figure: str | None) -> str:
    """Put a figure of a run on the card of its experiment, and return the experiment's name.

    What the run changed is written beside the pictures, and stands on the card.
    """
    given = yaml.safe_load((run / ".hydra/overrides.yaml").read_text(encoding="utf-8"))
    names = [entry.partition("=")[2] for entry in given if entry.startswith("experiment=")]
    changed = [entry for entry in given if not entry.startswith("experiment=")]
    found = [run / f"figures/{name}.png" for name in ((figure,) if figure else FIGURES)]
    taken = next((path for path in found if path.is_file()), None)
    if taken is None:
        sys.exit(f"error: {run} has none of {', '.join(str(path) for path in found)}")
    with Image.open(taken) as picture:
        PICTURES.mkdir(parents=True, exist_ok=True)
        (PICTURES / f"{names[0]}.webp").write_bytes(card_picture(picture))
    settings = yaml.safe_load(SETTINGS.read_text("utf-8")) if SETTINGS.is_file() else {}
    settings[names[0]] = " ".join(changed)
    text = yaml.safe_dump({name: settings[name] for name in sorted(settings) if settings[name]})
    SETTINGS.write_text(f"# What the runs of the pictures changed: they are shorter.\n{text}")
    return names[0]


def parents(path: Path) -> list[str]:
    """Return the experiments that an experiment's file begins with."""
    defaults = yaml.safe_load(path.read_text(encoding="utf-8")).get("defaults", [])
    return [entry for entry in defaults if isinstance(entry, str) and entry[0] not in "/_"]


def pictured(name: str) -> str | None:
    """Return the experiment whose picture an experiment's card has: its own, or a parent's."""
    if (PICTURES / f"{name}.webp").is_file():
        return name
    found = map(pictured, parents(ROOT / f"conf/experiment/{name}.yaml"))
    return next(filter(None, found), None)


def experiment_card(name: str, page: str | None) -> str:
    """Return the card of an experiment, as Markdown."""
    known = {one.name: one for one in experiments(configuration_folders(ROOT / "docs"))}
    settings = yaml.safe_load(SETTINGS.read_text(encoding="utf-8")) or {}
    shown, notes = pictured(name), [known[name].cost]
    if shown and shown != name:
        notes.append(f"picture of {shown}")
    elif name in settings:
        notes.append("picture of a shorter run")
    image = f"![](images/gallery/{shown}.webp){{ loading=lazy }}" if shown else ""
    title = f"[{name}]({page or 'gallery.md'})"
    return card(image, title, known[name].summary, f"dolens train experiment={name}", notes)


def read_notebook(name: str) -> dict[str, Any]:
    """Return a notebook by its name `notebooks/…`."""
    return json.loads((ROOT / f"docs/{name}.ipynb").read_text(encoding="utf-8"))


def notebook_card(name: str) -> str:
    """Return the card of a notebook, as Markdown."""
    notebook = read_notebook(name)
    title, text = "".join(notebook["cells"][0]["source"]).split("\n\n")[:2]
    sentence = re.split(r"(?<=[.!?])\s", text.replace("\n", " "))[0]
    image = f"![](images/{name}.webp){{ loading=lazy }}"
    title = f"[{title.removeprefix('# ')}]({name}.ipynb)"
    notes = [notebook["metadata"]["dolens"]["cost"]]
    return card(image, title, sentence, f"jupyter lab docs/{name}.ipynb", notes)


def card(image: str, title: str, sentence: str, command: str, notes: list[str]) -> str:
    """Return a card, as Markdown."""
    parts = [image, f"**{title}**", sentence, f"`{command}`", f"*{'; '.join(notes)}*"]
    return '<div class="card" markdown>\n\n' + "\n\n".join(parts) + "\n\n</div>"


def cards(found: re.Match[str]) -> str:
    """Return the cards that a line of a page asks for, as Markdown."""
    made = []
    for name in found["names"].split():
        is_notebook = name.startswith("notebooks/")
        made.append(notebook_card(name) if is_notebook else experiment_card(name, found["page"]))
    return "\n".join(['<div class="cards" markdown>\n', *made, "\n</div>"])


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace the lines that ask for cards, when MkDocs reads a page."""
    return CARDS.sub(cards, markdown)


def on_files(files: Any, config: Any) -> Any:
    """Add the last picture of each notebook to the files of the site."""
    from mkdocs.structure.files import File

    for path in sorted((ROOT / "docs/notebooks").glob("*.ipynb")):
        shown = [
            data
            for cell in read_notebook(f"notebooks/{path.stem}")["cells"]
            for output in cell.get("outputs", [])
            for kind, data in output.get("data", {}).items()
            if kind in ("image/png", "image/jpeg")
        ]
        with Image.open(io.BytesIO(base64.b64decode("".join(shown[-1])))) as picture:
            content = card_picture(picture)
        name = f"images/notebooks/{path.stem}.webp"
        files.append(File.generated(config, name, content=content))
    return files


def main() -> None:
    """Take the pictures of some runs."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument("--figure", help="its name, without .png; else the first of several")
    given = parser.parse_args()
    for run in given.runs:
        print(take(run, given.figure))


if __name__ == "__main__":
    main()

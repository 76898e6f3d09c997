"""What the documents print: blocks of code, and commands within sentences and tables."""

import re
import shlex
import textwrap
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
# A fenced block; or an indented one behind an empty line, which runs to the next line of text.
BLOCK = re.compile(
    r"^```(?P<language>\w*)(?: title=\"(?P<title>.*?)\")?\n(?P<fenced>.*?)^```$"
    r"|(?<=\n\n)(?P<indented>(?:    [^\n]*(?:\n|\Z)|\n(?=    ))+)",
    re.MULTILINE | re.DOTALL,
)
PROGRAMS = "dolens|python3?|pip|train.py|torchrun|srun|tensorboard|ray|apt|cd|ruff|mypy|coverage"
COMMAND = re.compile(rf"(?:[A-Z_]+=\S+ )*(?:{PROGRAMS}) ")


class Block(NamedTuple):
    page: str
    section: str  # the heading of second order above it
    language: str  # "sh" of indented commands, "yaml" of other indented ones
    title: str
    text: str

    @property
    def name(self):
        return f"{self.page}: {self.text.splitlines()[0].strip()}"


def blocks_of(document):
    """The blocks of a document in order; `my_folder/<path>` before one is its title."""
    found, text = [], document.read_text(encoding="utf-8")
    page = str(document.relative_to(ROOT))
    for match in BLOCK.finditer(text):
        before = text[: match.start()].rstrip().rpartition("\n")[2]
        named = re.fullmatch(r"`(my_\w+/[\w./]+)`:", before)
        title = match["title"] or (named[1] if named else "")
        content, language = match["fenced"], match["language"]
        if content is None:
            content = textwrap.dedent(match["indented"]).rstrip() + "\n"
            language = "sh" if COMMAND.match(content) and not title else "yaml"
        language = {"bash": "sh"}.get(language, language)
        section = re.findall(r"^## (.*)$", text[: match.start()], re.MULTILINE)[-1:]
        found.append(Block(page, *section or [""], language, title, content))
    return found


BLOCKS = [block for document in DOCUMENTS for block in blocks_of(document)]


def commands_of(block):
    """The commands of a block, each as its words, without comments."""
    found, pending = [], ""
    for line in block.text.replace("\\\n", " ").splitlines():
        pending = f"{pending} {line.strip()}".strip()
        try:
            words = shlex.split(pending, comments=True)
        except ValueError:  # a quotation that ends on a later line
            continue
        pending, found = "", [*found, []]
        for word in words:
            found[-1] += [word.removesuffix(";")] * (word != "&&")
            if word == "&&" or word.endswith(";"):
                found.append([])
    return [words for words in found if words]

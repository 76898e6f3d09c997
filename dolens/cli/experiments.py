"""`dolens experiments`: what experiments there are, and what one of them is made of."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

# Of a terminal that has room for what an experiment writes.
_WIDE = 130


def experiments(
    name: Annotated[
        str | None, typer.Argument(help="An experiment, to see what it is made of.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")] = False,
) -> None:
    """List the experiments, yours and the packaged ones; or show what one is made of."""
    from dolens.experiments.running.catalogue import configuration_folders
    from dolens.experiments.running.catalogue import experiments as found

    folders = configuration_folders(Path.cwd())
    if name is not None:
        _show_one(name, folders, as_json)
        return
    rows = found(folders)
    if as_json:
        typer.echo(json.dumps([_plain(row) for row in rows], indent=2))
        return
    console = Console(highlight=False)
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), row_styles=("", "on grey11"))
    table.add_column("Experiment", no_wrap=True, style="bold")
    table.add_column("What it does", ratio=3)
    table.add_column("Cost", ratio=1)
    wide = console.width >= _WIDE
    if wide:
        table.add_column("Writes", ratio=3, style="dim")
    for row in rows:
        label = f"{row.name} [green]yours[/]" if row.own else row.name
        said = [row.summary or "its file has no comment", row.cost or "not said"]
        if wide:
            said.append(row.writes or "what every run writes")
        table.add_row(label, *map(escape, said))
    console.print(table)
    console.print(
        "\nRun one: [bold]dolens train experiment=NAME[/].  "
        "Its parts and what it writes: [bold]dolens experiments NAME[/]."
    )


def _show_one(name: str, folders: list[Path], as_json: bool) -> None:
    from dolens.cli.extras import import_extra
    from dolens.experiments.running.catalogue import experiment

    found = experiment(name, folders)
    module = import_extra(
        "dolens.experiments.running.user_configuration", "train", "dolens experiments NAME"
    )
    parts = module.parts_of(name)
    command = f"dolens train experiment={name}"
    missing = "".join(f" {key}=<...>" for key in parts.missing)
    if as_json:
        plain = {**_plain(found), "command": command + missing}
        chosen = {"choices": parts.choices, "objective": parts.objective}
        typer.echo(json.dumps({**plain, **chosen, "parents": parts.parents}, indent=2))
        return
    console = Console(highlight=False)
    console.print(f"\n[bold]{name}[/]{'  [green]yours[/]' if found.own else ''}")
    if found.summary:
        console.print(escape(found.summary))
    facts = Table.grid(padding=(0, 2))
    facts.add_column(style="bold", no_wrap=True)
    facts.add_column()
    facts.add_row("Command", f"{command}{missing}")
    facts.add_row("File", str(found.path))
    if parts.parents:
        facts.add_row("Extends", ", ".join(parts.parents))
    facts.add_row("Cost", found.cost or "not said")
    facts.add_row("Returns", parts.objective)
    facts.add_row(
        "Writes", f"outputs/{name}/<date_time>/: {found.writes or 'what every run writes'}"
    )
    console.print(facts)
    console.print("\n[bold]What it chooses[/] (change one by GROUP=OPTION)")
    table = Table.grid(padding=(0, 2), pad_edge=True)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(no_wrap=True)
    table.add_column(style="dim")
    for group, option in parts.choices.items():
        table.add_row(group, option, parts.meanings.get(group, ""))
    console.print(table)
    console.print(f"\nAll settings: [bold]{command} --cfg job[/]\n")


def _plain(found: Any) -> dict[str, Any]:
    return {
        "name": found.name,
        "summary": found.summary,
        "cost": found.cost,
        "writes": found.writes,
        "own": found.own,
        "file": str(found.path),
    }

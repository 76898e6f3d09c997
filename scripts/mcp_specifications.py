"""Play specifications through `dolens mcp` as a simple policy would, without a language model.

    python scripts/mcp_specifications.py draw FOLDER        # specifications.json
    python scripts/mcp_specifications.py play FOLDER        # goes on where it was stopped
    python scripts/mcp_specifications.py report FOLDER      # the table of docs/mcp.md

Specifications come from published lenses of one to six spherical elements for an object at
infinity: each as it was published, and others drawn of them.  A drawn one has another focal length
(a factor from 0.5 to 2), is stopped down (F-number times 1 to 1.5) and has a part of the field (0.7
to 1).  So a lens of as many elements that keeps the limits exists, but where `published_breaks`
says that the published one does not.  Limits:

- EFL within 1 %, the F-number of real marginal rays within 2 %.
- Track at most 1.05 of the published lens's, back focus at least 0.95 of its, both as published
  or in best focus, whichever allows more.
- Distortion at most the published lens's and 25 % more, or 2 %.
- Mean RMS spot over the axis, 0.7 of the field and its edge at most that of the published lens at
  the same EFL, F-number and field, in its best focus, of the light that passes it; all must pass
  the new lens.
- As it is made: of 200 lenses with the usual tolerances, each refocused, 90 % have an RMS radius
  over all spots of at most what 90 % of the published lens's copies have.

The policy knows the number of elements and which are cemented, and calls tools alone: search, which
ends with real glasses; check each form; change the stop where the F-number alone is off, and
optimize where another limit is missed, and check again; tolerance of what keeps all; export.  A
second round takes up what failed, with more starts, forms and trials of glasses, and another seed.
"""

import argparse
import asyncio
import json
import os
import random
import statistics
import sys
import time
from pathlib import Path
from typing import Any

COUNT, SEED = 100, 46
# Of a search, by elements: random starts of the first and of the second round.
STARTS = {1: (20, 80), 2: (30, 100), 3: (40, 150), 4: (50, 150), 5: (50, 200), 6: (50, 400)}
LENSES, YIELD = 200, 90.0


# ---------------------------------------------------------------- specifications


def published() -> dict[str, Any]:
    """Return the published lenses that specifications are drawn from, by name."""
    from dolens import load_lens
    from dolens.errors import InputError
    from dolens.lens_search.neighbours import KnownLens
    from dolens.optics.materials import is_glass
    from dolens.prescriptions import lens_names, published_lens_names

    found = {}
    for name in [*published_lens_names(), *lens_names()]:
        lens = load_lens(name)
        try:
            known = KnownLens.of(lens, {}, 0.0)
        except InputError:
            continue
        asked = known.specification
        media = [m for m in lens.materials if not is_glass(m)]
        visible = all(400.0 <= wave <= 700.0 for wave in asked.wavelengths)
        if asked.elements > 6 or not visible or any(m.name == "mirror" for m in media):
            continue
        if lens.fields and max(asked.fields) < 45.0 and asked.limits.back_focus > 0.0:
            found[name] = lens
    return found


def specification(name: str, lens: Any, efl: float, stop_down: float, part: float) -> Any:
    """Return a specification that the published lens, scaled to a focal length, meets.

    Args:
        name: of the lens.
        lens: as published.
        efl: mm.
        stop_down: factor of its F-number.
        part: of its field.
    """
    from dolens.lens_page.overview import prepared_lens
    from dolens.lens_search.form_report import lens_sensitivity
    from dolens.lens_search.neighbours import KnownLens
    from dolens.lens_search.verification import Requirements, verify

    asked = KnownLens.of(lens, {}, 0.0).specification
    lens = scaled(lens, efl / asked.focal_length)
    asked = KnownLens.of(lens, {}, 0.0).specification
    edge = part * max(asked.fields)
    fields = [0.0, 0.7 * edge, edge] if edge else [0.0]
    as_it_is = prepared_lens(lens, [(0.0, y) for y in fields], None, stop_down * asked.f_number)
    spot, refocused = best_focus(as_it_is)
    shift = (refocused.sensor_distance - lens.sensor_distance).item()
    track = max(lens.system().vertices[-1].item(), asked.limits.track / 1.05) + max(0.0, shift)
    limits = Requirements(
        focal_length=efl,
        f_number=stop_down * asked.f_number,
        total_track=1.05 * track,
        back_focus=asked.limits.back_focus + 0.95 * min(0.0, shift),
        distortion=100.0 * max(0.02, asked.limits.distortion or 0.0) if edge else None,
    )
    breaks = [c.name for c in verify(refocused, limits).broken]
    return {
        "of": name,
        "published_breaks": breaks,
        "elements": list(asked.groups),
        "efl": efl,
        "f_number": stop_down * asked.f_number,
        "field": edge,
        "wavelengths": list(asked.wavelengths),
        "track": limits.total_track,
        "back_focus": limits.back_focus,
        "distortion": limits.distortion,
        "mean_rms_spot_um": spot,
        "as_made_um": lens_sensitivity(refocused).ninety_percent_um,
    }


def scaled(lens: Any, factor: float) -> Any:
    """Return a lens whose lengths are all multiplied by a factor."""
    from dolens.prescriptions import lens_from_prescription, prescription_of

    rows = prescription_of(lens)
    for row in (*rows["surfaces"].values(), rows["sensor"]):
        for key in ("radius", "thickness", "semi_diameter", "distance", "diameter"):
            if row.get(key) is not None:
                row[key] *= factor
    return lens_from_prescription(rows, where=lens.name)


def best_focus(lens: Any) -> tuple[float, Any]:
    """Return the least mean RMS spot over the fields by refocusing, µm, and the lens there.

    Rays are straight behind the lens: where they land is linear in the sensor's place.
    """
    import torch

    from dolens.analysis.conditions import conditions
    from dolens.analysis.spot_diagram import moments, spot_diagram

    where, step = conditions(lens), 0.01 * lens.first_order().efl.item()
    first = spot_diagram(lens, where, 1000)
    there = lens.sensor_distance.item()

    def at(distance: float) -> Any:
        with torch.no_grad():
            lens.sensor_distance.fill_(distance)
        return lens

    second = spot_diagram(at(there + step), where, 1000)
    light = (first.weight * first.valid * where.weights[:, None]).flatten(1, 2)
    slope = (second.intercepts - first.intercepts) / step

    def mean(shift: float) -> float:
        points = (first.intercepts + shift * slope).flatten(1, 2)
        return 1e3 * float(moments(points, light)[1].sqrt().mean())

    from scipy.optimize import minimize_scalar

    found = minimize_scalar(mean, bounds=(-5.0 * step, 5.0 * step), method="bounded")
    return float(found.fun), at(there + float(found.x))


def specifications() -> list[dict[str, Any]]:
    """Return the specifications, in a random order of the seed."""
    lenses, drawn = published(), random.Random(SEED)
    by_count: dict[int, list[str]] = {}
    found = []
    for name, lens in lenses.items():
        efl = lens.first_order(lens.primary_wavelength).efl.item()
        found.append(specification(name, lens, efl, 1.0, 1.0))
        by_count.setdefault(sum(found[-1]["elements"]), []).append(name)
    while len(found) < COUNT:
        name = drawn.choice(by_count[drawn.choice(sorted(by_count))])
        lens = lenses[name]
        efl = lens.first_order(lens.primary_wavelength).efl.item() * 2.0 ** drawn.uniform(-1, 1)
        found.append(specification(name, lens, efl, drawn.uniform(1, 1.5), drawn.uniform(0.7, 1.0)))
    drawn.shuffle(found)
    return [{"number": n, **each} for n, each in enumerate(found, 1)]


# ---------------------------------------------------------------- the policy


class Player:
    """Calls tools, and keeps count of calls and refusals."""

    def __init__(self, client: Any) -> None:
        self.client, self.refusals, self.calls = client, [], 0

    async def call(self, tool: str, **arguments: Any) -> dict[str, Any] | None:
        """Return what a tool answers; None where it refuses."""
        self.calls += 1
        found = await self.client.call_tool(tool, {**arguments, "picture": False})
        if found.is_error:
            self.refusals.append(found.content[0].text)
            return None
        return found.structured_content


async def play(asked: dict[str, Any], player: Player, turn: int) -> dict[str, Any]:
    """Design one lens; see the module's docstring."""
    started, done = time.perf_counter(), {}
    efl, elements = asked["efl"], asked["elements"]
    limits = {
        "track": asked["track"],
        "back_focus": asked["back_focus"],
        "distortion": asked["distortion"] and asked["distortion"] / 100.0,
        "glass": [0.01 * efl, 0.3 * efl],
        "glass_edge": 0.005 * efl,
    }
    required = {
        "focal_length": efl,
        "f_number": asked["f_number"],
        "total_track": asked["track"],
        "back_focus": asked["back_focus"],
        "distortion": asked["distortion"],
        "mean_rms_spot_um": asked["mean_rms_spot_um"],
    }
    keep = {
        "efl": efl,
        "f_number": asked["f_number"],
        "total_track": [None, asked["track"]],
        "back_focus": [asked["back_focus"], None],
        "edge_thickness": [0.005 * efl, None],
        "centre_thickness": [0.01 * efl, None],
        "air_gap": [0.002 * efl, None],
        "edge_air_gap": [0.0, None],
    }
    if asked["field"]:
        keep["distortion"] = [-asked["distortion"], asked["distortion"]]
    lenses = await player.call(
        "search",
        efl=efl,
        f_number=asked["f_number"],
        field=asked["field"],
        elements=elements,
        wavelengths=asked["wavelengths"],
        limits=limits,
        starts=STARTS[sum(elements)][turn],
        seconds=300.0,
        forms=1 + turn,
        glass_trials=("few", "usual")[turn],
        seed=turn,
    )
    tried = []

    async def checked(name: str) -> dict[str, Any] | None:
        found = await player.call("check", lens=name, **required)
        if found is not None:
            spot = next(c for c in found["checks"] if c["quantity"] == "mean RMS spot")
            number = next(c for c in found["checks"] if c["quantity"] == "F-number")
            found["f_number"] = number["value"]
            tried.append((len(found["broken"]), spot["value"], name, found))
        return found

    async def opened(name: str, wider: float = 1.0) -> None:
        """Check a lens whose stop is wider by a factor, and whose other apertures let all pass."""
        shown = await player.call("show", lens=name)
        if shown is not None:
            stop = str(shown["stop_surface"])
            changes = {f"surfaces.{n}.semi_diameter": "auto" for n in shown["surfaces"]}
            radius = wider * shown["surfaces"][stop]["semi_diameter"]
            changes[f"surfaces.{stop}.semi_diameter"] = radius
            changed = await player.call("change", lens=name, changes=changes)
            if changed is not None:
                await checked(changed["lens"])

    for form in lenses["forms"] if lenses else ():
        found = await checked(form["lens"])
        if found is not None and found["broken"] == ["F-number"]:
            # The search holds EFL over the pupil; the real ray at the sensor is asked for.
            await opened(form["lens"], found["f_number"] / asked["f_number"])
    if tried and min(tried)[0]:
        better = await player.call(
            "optimize",
            lens=min(tried)[2],
            variables={
                "surfaces.*.curvature": None,
                "thicknesses.*": {"lower": 0.0, "upper": 0.5 * efl},
                "sensor_distance": None,
            },
            keep=keep,
            iterations=30,
        )
        if better is not None:
            await opened(better["lens"])
    for broken, spot, name, found in sorted(tried)[:2]:
        if done and (broken or fulfilled(done)):
            break
        values = {c["quantity"]: c["value"] for c in found["checks"]}
        made = await player.call(
            "tolerance", lens=name, rms_spot_um=asked["as_made_um"], lenses=LENSES, seed=1
        )
        share = 0.0 if made is None else made["yield_percent"]
        if share >= done.get("yield_percent", 0.0):
            done = {
                "meets_all": not broken,
                "broken": found["broken"],
                "efl_error_percent": 100.0 * (values["focal length"] / efl - 1.0),
                "mean_rms_spot_um": spot,
                "over_limit": spot / asked["mean_rms_spot_um"],
                "yield_percent": share,
                "lens": name,
            }
    if tried:
        file = f"{asked['number']:03d}_{turn + 1}.yaml"
        wrote = await player.call("export", lens=done["lens"], file=file, overwrite=True)
        done["file"] = wrote and wrote["file"]
    else:
        done = {"meets_all": False, "broken": ["no lens"]}
    return {**done, "seconds": time.perf_counter() - started}


def fulfilled(row: dict[str, Any]) -> bool:
    """Return whether a lens meets every limit, and its yield too."""
    return bool(row["meets_all"] and row.get("yield_percent", 0.0) >= YIELD)


async def play_all(folder: Path, until: float | None) -> None:
    """Play what is left, and append each result as a line of results.jsonl."""
    from mcp import Client
    from mcp.client.stdio import StdioServerParameters

    asked = json.loads((folder / "specifications.json").read_text())
    results = folder / "results.jsonl"
    rows = (
        [json.loads(line) for line in results.read_text().splitlines()] if results.exists() else []
    )
    (folder / "lenses").mkdir(exist_ok=True)
    server = StdioServerParameters(
        command=sys.executable,
        args=["-m", "dolens", "mcp", str(folder / "lenses"), "--seconds", "1500"],
        env=dict(os.environ),
    )
    for turn in (0, 1):
        before = {row["number"]: row for row in rows if row["turn"] < turn}
        there = {row["number"] for row in rows if row["turn"] == turn}
        left = [each for each in asked if each["number"] not in there]
        if turn:
            left = [each for each in left if not fulfilled(before[each["number"]])]
        # A session holds 500 lenses at most.
        for at in range(0, len(left), 50):
            async with Client(server) as client:
                for each in left[at : at + 50]:
                    if until is not None and time.time() > until:
                        return
                    player = Player(client)
                    row = await play(each, player, turn)
                    row |= {"number": each["number"], "turn": turn, "calls": player.calls}
                    row["refusals"] = player.refusals
                    rows.append(row)
                    with results.open("a") as file:
                        file.write(json.dumps(row) + "\n")
                    print(each["number"], each["of"], json.dumps(row), flush=True)


# ---------------------------------------------------------------- the report


def report(folder: Path) -> str:
    """Return the results as a table by elements, in Markdown."""
    asked = {s["number"]: s for s in json.loads((folder / "specifications.json").read_text())}
    rows = [json.loads(line) for line in (folder / "results.jsonl").read_text().splitlines()]
    played = sorted({row["number"] for row in rows})
    best: dict[int, dict[str, Any]] = {}
    for row in rows:
        old = best.get(row["number"])
        rank = (fulfilled(row), row["meets_all"], -row.get("over_limit", 1e9))
        if old is None or rank > (fulfilled(old), old["meets_all"], -old.get("over_limit", 1e9)):
            best[row["number"]] = row
    lines = [
        "| elements | specifications | meets every limit | and yield ≥ 90 % | both in round one | "
        "published lens breaks one | EFL error, most | spot over its limit, median | "
        "minutes each, median |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    groups: dict[str, list[int]] = {}
    for number in played:
        groups.setdefault(str(sum(asked[number]["elements"])), []).append(number)
    for label, numbers in [*sorted(groups.items()), ("all", played)]:
        mine = [best[n] for n in numbers]
        first = [row for row in rows if row["number"] in numbers and row["turn"] == 0]
        minutes = [sum(r["seconds"] for r in rows if r["number"] == n) / 60.0 for n in numbers]
        over = [row["over_limit"] for row in mine if "over_limit" in row]
        errors = [abs(row["efl_error_percent"]) for row in mine if row["meets_all"]]
        lines.append(
            f"| {label} | {len(mine)} | {sum(row['meets_all'] for row in mine)} | "
            f"{sum(map(fulfilled, mine))} | {sum(map(fulfilled, first))} | "
            f"{sum(bool(asked[n]['published_breaks']) for n in numbers)} | "
            f"{max(errors, default=0.0):.2g} % | {statistics.median(over or [0.0]):.2f} | "
            f"{statistics.median(minutes):.1f} |"
        )
    lines += ["", "What failed:", ""]
    for number in played:
        row = best[number]
        if not fulfilled(row):
            spec = asked[number]
            what = ", ".join(row["broken"]) or f"yield {row.get('yield_percent', 0.0):.0f} %"
            task = f"f = {spec['efl']:.4g} mm, F/{spec['f_number']:.3g}, ±{spec['field']:.3g}°"
            over = f"spot {row.get('over_limit', 0.0):.2f} of its limit"
            lines.append(f"- {number}, of `{spec['of']}`, {task}: {what}; {over}")
    refused: dict[str, int] = {}
    for row in rows:
        for line in row["refusals"]:
            refused[line] = refused.get(line, 0) + 1
    lines += ["", f"Refusals, of {sum(row['calls'] for row in rows)} calls:", ""]
    lines += [f"- {count} × {line}" for line, count in refused.items()] or ["- none"]
    return "\n".join(lines)


def main() -> None:
    """Draw, play or report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("draw", "play", "report"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--minutes", type=float, help="begin no further one after so many")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    if given.what == "draw":
        text = json.dumps(specifications(), indent=1)
        (given.folder / "specifications.json").write_text(text)
    elif given.what == "play":
        until = None if given.minutes is None else time.time() + 60.0 * given.minutes
        asyncio.run(play_all(given.folder, until))
    else:
        print(report(given.folder))


if __name__ == "__main__":
    main()

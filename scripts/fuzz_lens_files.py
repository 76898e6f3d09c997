"""Damaged and hostile lens files are read: each is a lens or one clear line, and soon.

python scripts/fuzz_lens_files.py --files 2000 [--folder of/other/lens/files ...]
"""

import argparse
import logging
import random
import sys
import tempfile
import time
import warnings
from collections import Counter, defaultdict
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from dolens import InputError, Rays, load_lens
from dolens.optics.glass_catalog import glass_folders, user_entries
from dolens.prescriptions import lens_from_prescription, prescription_of
from dolens.prescriptions.files import (
    encode_prescription,
    find_lens,
    lens_names,
    load_prescription,
    published_lens_names,
)
from dolens.prescriptions.plain_values import plain_values, yaml_of
from scripts.guarded_cases import guarded, place_of, unclear
from tests.prescriptions import test_json_lenses, test_oslo
from tests.prescriptions.codev import samples as codev_samples
from tests.prescriptions.mutations import mutated
from tests.prescriptions.zemax import samples as zemax_samples

# How often files of each kind are drawn; the prescriptions are of dolens, the rest of others too.
SHARES = {".yaml": 6, ".json": 4, ".zmx": 5, ".seq": 3, ".len": 2, ".txt": 2, ".agf": 2}
_LARGEST = 60_000
# Glasses of a catalogue that are tried.
_GLASSES = 4
_CATALOGUE_LINES = 400
# One lens in three is written as one of these, another one in three is read again.
_WRITTEN = (".json", ".zmx", ".seq", ".txt")
_WELL = (" lens", " one line")


def main() -> int:
    """Print the table; the exit status is 1 where something else came of a file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=2000, help="how many mutated files are read")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--folder", action="append", default=[], help="of lens files to begin with")
    parser.add_argument("--kind", choices=SHARES, help="files of this kind alone")
    parser.add_argument("--seconds", type=float, default=10.0, help="of processor time for a file")
    parser.add_argument("--show", type=int, help="write the mutated file of this seed, and read it")
    options = parser.parse_args()
    seeds = _seeds(options.folder)
    print({kind: len(found) for kind, found in seeds.items()})
    shares = {k: n for k, n in SHARES.items() if k == (options.kind or k) and seeds[k]}
    with tempfile.TemporaryDirectory() as folder:

        def case(number: int) -> tuple[Path, bytes]:
            rng = random.Random(f"file {number}")
            [kind] = rng.choices(list(shares), list(shares.values()))
            # The smaller of two, as large files take their time.
            data = min(rng.choices(seeds[kind], k=2), key=len)
            if kind == ".agf":
                data = _some_glasses(data, rng)
            return Path(folder) / f"lens{kind}", mutated(data, kind, number)

        def check(number: int) -> str:
            path, data = case(number)
            path.write_bytes(data)
            said, where = outcome(path)
            return f"{path.suffix:6s} {said}\0{where}"

        if options.show is not None:
            path, data = case(options.show)
            Path(f"mutated{path.suffix}").write_bytes(data)
            print(check(options.show))
            return 0
        _warm_up()
        # What is passed over is told, and is not looked at here.
        logging.disable()
        begin, found, examples = time.monotonic(), Counter(), defaultdict(list)
        numbers = range(options.first, options.first + options.files)
        for number, answer in guarded(check, numbers, options.seconds):
            said, _, where = answer.partition("\0")
            found[said] += 1
            if said not in examples and not said.endswith(_WELL):
                print(f"{number}: {said}: {where}", flush=True)
            if len(examples[said]) < 3:
                examples[said].append(f"{number} {where}")
    print(f"{options.files} files in {time.monotonic() - begin:.0f} s")
    for said, count in sorted(found.items()):
        kept = "" if said.endswith(_WELL) else " | ".join(examples[said])
        print(f"{count:7d}  {said:70s} {kept}")
    return int(any(not said.endswith(_WELL) for said in found))


def outcome(path: Path) -> tuple[str, str]:
    """Return what came of a file, `lens` or `one line` if all is well, and a detail."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            if path.suffix == ".agf":
                return _read_catalogue(path)
            return _read_lens(path)
        except InputError as error:
            return _message(str(error), path)
        except Exception as error:
            return f"{type(error).__name__} at {place_of(error)}", repr(error)[:200]


def _message(message: str, path: Path) -> tuple[str, str]:
    """Return whether a message is one clear line that names the file."""
    message = message.replace(str(path), path.name)
    shown = ascii(message[:200])
    if said := unclear(message):
        return said, shown
    if not message.startswith(path.name):
        return "message does not begin with the file", shown
    return "one line", shown


def _read_lens(path: Path) -> tuple[str, str]:
    lens = load_lens(path)
    for name, value in lens.state_dict().items():
        if not bool(torch.isfinite(value).all()):
            return "lens with parameters that are not finite", name
    said = _used(lens)
    turn = path.stat().st_size % 12
    if said[0] != "lens" or turn > 3 + len(_WRITTEN):
        return said
    if turn < len(_WRITTEN):
        return _written(lens, path.with_suffix(_WRITTEN[turn]))
    written = yaml_of(prescription_of(lens), str(path))
    back = lens_from_prescription(plain_values(written.decode(), str(path)), where="again")
    own, again = lens.state_dict(), back.state_dict()
    if own.keys() != again.keys() or not all(torch.equal(own[k], again[k]) for k in own):
        return "lens that is another one when it is written and read", path.suffix
    return said


def _written(lens: torch.nn.Module, path: Path) -> tuple[str, str]:
    """Return what comes of writing a lens in another format."""
    try:
        encode_prescription(prescription_of(lens), path)
    except InputError as error:  # such as: the format cannot hold the lens
        said, shown = _message(str(error), path)
        if said != "one line":
            return f"written as {path.suffix}: {said}", shown
    return "lens", ""


def _used(lens: torch.nn.Module) -> tuple[str, str]:
    """Return what came of the first use of a lens."""
    try:
        return _traced(lens)
    except InputError as error:  # such as: it has no focal length, or its glass no index
        said, shown = _message(f"lens.yaml: {error}", Path("lens.yaml"))
        return ("lens", "") if said == "one line" else (said, shown)


def _traced(lens: torch.nn.Module) -> tuple[str, str]:
    lens.first_order()
    size = lens.surfaces["1"].semi_diameter if hasattr(lens.surfaces["1"], "aperture") else 1.0
    across = torch.linspace(-0.9, 0.9, 7, dtype=torch.float64) * size
    position = torch.stack((across, 0.3 * across, torch.full_like(across, -1.0)), -1)
    direction = torch.tensor([0.0, 0.01, 1.0], dtype=torch.float64)
    rays = Rays(position, (direction / direction.norm()).expand(7, 3), lens.primary_wavelength)
    hit = lens.trace(rays)
    for name in ("position", "direction", "path_length"):
        if not bool(torch.isfinite(getattr(hit, name)).all()):
            return f"trace: {name} is not finite", ""
    return "lens", ""


def _read_catalogue(path: Path) -> tuple[str, str]:
    said = "lens", ""
    for name in list(user_entries(path))[:_GLASSES]:
        prescription = {
            "surfaces": {
                "1": {
                    **{"radius": 50.0, "semi_diameter": 5.0, "thickness": 3.0},
                    "material": f"{path.stem.upper()}:{name}",
                },
                "2": {"radius": -50.0, "semi_diameter": 5.0, "material": "air"},
            },
            "sensor": {"distance": 48.0},
            "wavelengths": [587.5618],
            "temperature": 40.0,
        }
        try:
            with glass_folders(path):
                lens = lens_from_prescription(prescription, where=str(path))
                said = _used(lens)
        except InputError as error:
            said = _message(str(error), path)
        if said[0] not in ("lens", "one line"):
            return said
    return said


def _seeds(folders: list[str]) -> dict[str, list[bytes]]:
    """Return kind of file → contents to begin with: all packaged lenses as every format, others."""
    found: dict[str, list[bytes]] = {kind: [] for kind in SHARES}
    for name in (*lens_names(), *published_lens_names()):
        found[".yaml"].append(find_lens(name).read_bytes())
        # What is published of a lens, other formats cannot hold.
        plain = {k: v for k, v in load_prescription(name).items() if k != "published"}
        for kind in (".json", ".zmx", ".seq", ".txt"):
            try:
                found[kind].append(encode_prescription(plain, f"lens{kind}"))
            except InputError:  # the format cannot hold this lens
                continue
    for content in ("DEEPLENS", "OPTILAND", "RAY_OPTICS"):
        text = test_json_lenses.json.dumps(getattr(test_json_lenses, content))
        found[".json"] += [text.encode()] * 20
    found[".zmx"].append(zemax_samples.triplet().encode())
    found[".seq"].append(codev_samples.TRIPLET.encode())
    found[".len"].append(test_oslo.TRIPLET.encode())
    for folder in folders:
        for path in sorted(Path(folder).iterdir()):
            kind = path.suffix.lower()
            if kind in found and (kind == ".agf" or path.stat().st_size < _LARGEST):
                found[kind].append(path.read_bytes())
    return found


def _some_glasses(data: bytes, rng: random.Random) -> bytes:
    lines = data.splitlines(keepends=True)
    at = rng.randrange(max(1, len(lines) - _CATALOGUE_LINES))
    return b"".join(lines[at : at + _CATALOGUE_LINES])


def _warm_up() -> None:
    """Compile the kernels before a child has to."""
    for name in (*lens_names(), *published_lens_names()):
        try:
            _used(load_lens(name))
        except InputError:
            continue


if __name__ == "__main__":
    torch.set_num_threads(1)
    sys.exit(main())

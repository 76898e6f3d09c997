"""The design's map, held by reading the imports."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted(p for top in ("dolens", "experiments") for p in (ROOT / top).rglob("*.py"))
# What each part may import from dolens; siblings of one tier only in one direction, without cycles.
ALLOWED = {
    "errors": set(),
    "typed_values": {"errors"},
    "html": set(),
    "files": {"errors"},
    "tasks": {"errors"},
    "threads": set(),
    # A page of photographs knows tensors alone.
    "photograph_page": {"errors", "files", "html"},
    "cached_tensors": set(),
    "kernels": {"cached_tensors", "errors", "files", "tasks"},
    "optics": {"cached_tensors", "errors", "files", "html", "kernels"},
    "prescriptions": {"errors", "files", "optics"},
    "sensor": {"errors", "optics", "photograph_page"},
    "scene": {"errors", "optics", "sensor"},
    "analysis": {"errors", "optics", "scene", "sensor"},
    "diffraction": {"errors", "optics", "scene", "sensor", "analysis"},
    "rendering": {
        *("cached_tensors", "errors", "tasks", "optics", "kernels", "scene", "sensor"),
        *("analysis", "diffraction", "photograph_page"),
    },
    # Bounded steps of thousands of lenses are a kernel.
    "optimize": {"errors", "typed_values", "kernels", "optics", "analysis", "rendering"},
    "tolerancing": {"errors", "tasks", "optics", "analysis"},
    "alignment": {
        *("errors", "typed_values", "optics", "sensor", "rendering", "analysis", "diffraction"),
        "optimize",
    },
    "reconstruction": {"errors", "optics", "sensor", "rendering", "photograph_page"},
    "plotting": {
        *("errors", "optics", "analysis", "diffraction", "photograph_page"),
        *("sensor", "rendering"),
    },
    "views": {
        *(
            "errors",
            "optics",
            "sensor",
            "analysis",
            "diffraction",
            "rendering",
            "plotting",
            "prescriptions",
        ),
        "optimize",
    },
    # A page about a lens shows what all of these find out.
    "lens_page": {
        *("errors", "files", "html", "optics", "prescriptions", "analysis", "diffraction"),
        *("tolerancing", "plotting", "views"),
    },
    # Pages that this machine serves: a lens with sliders, and runs as they go.
    "live": {
        *("errors", "files", "html", "optics", "prescriptions", "scene", "sensor", "analysis"),
        *("diffraction", "rendering", "optimize", "plotting", "views", "lens_page"),
    },
    "manufacturing": {"errors", "files", "optics", "prescriptions", "tolerancing", "plotting"},
    # A search for lenses begins with paraxial optics, and ends with files and a page.
    "lens_search": {
        *("errors", "tasks", "html", "files", "optics", "prescriptions"),
        *("analysis", "optimize", "tolerancing", "plotting", "lens_page", "kernels"),
    },
    # Programs design lenses through all of these.
    "mcp": {
        *("errors", "files", "optics", "prescriptions", "analysis", "diffraction", "plotting"),
        *("views", "lens_page", "lens_search"),
    },
}
# The command line stands above everything, the experiments too.
ALLOWED["cli"] = {*ALLOWED, "experiments"}
ALLOWED["__main__"] = {"cli"}

# What executes what a file holds.
EXECUTING = {
    *("pickle.load", "pickle.loads", "pickle.Unpickler", "joblib.load", "shelve.open"),
    *("marshal.load", "marshal.loads", "yaml.unsafe_load", "yaml.full_load", "yaml.load_all"),
    *("torch.jit.load", "torch.hub.load", "torch.package.PackageImporter", "os.system", "os.popen"),
    *("pd.read_pickle", "importlib.machinery.SourceFileLoader"),
}


def imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module


def calls(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call):
            yield node, ast.unparse(node.func)


def name(path):
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize(
    "path", [p for p in FILES if "dolens" in p.relative_to(ROOT).parts], ids=name
)
def test_imports_of_the_library(path):
    part = path.relative_to(ROOT / "dolens").parts[0].removesuffix(".py")
    for module in imports(path):
        top, *rest = module.split(".")
        assert top not in {"hydra", "omegaconf", "lightning", "pytorch_lightning", "experiments"}
        if top == "dolens" and part != "__init__":
            assert rest, "import from the part, not from the whole"
            assert rest[0] in ALLOWED[part] | {part}, module


@pytest.mark.parametrize("path", FILES, ids=name)
def test_nothing_prints_or_runs_text(path):
    for node, called in calls(path):
        assert called not in {"print", "exec", "eval", "compile"}, node.lineno
        assert called not in EXECUTING, node.lineno
        if called in ("np.load", "numpy.load"):
            given = {k.arg: k.value for k in node.keywords}.get("allow_pickle")
            assert isinstance(given, ast.Constant) and given.value is False, node.lineno
        if called == "yaml.load":  # by a loader of plain values
            assert ast.unparse(node).endswith("Loader=_PlainLoader)"), node.lineno
        if called == "torch.load":
            safe = {k.arg: k.value for k in node.keywords}.get("weights_only")
            assert isinstance(safe, ast.Constant) and safe.value is True, node.lineno


def test_constraints_are_exact_versions():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    assert len(lines) > 10
    for line in lines:
        assert re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.!+_-]+", line), line


def test_ci_runs_the_readme_s_own_test_command():
    readme = (ROOT / "README.md").read_text()
    commands = [
        line.strip() for line in readme.splitlines() if line.startswith("    python3 -m venv")
    ]
    assert len(commands) == 2
    assert commands[1] in (ROOT / ".ci" / "run").read_text()


def test_no_file_names_a_registry_or_a_machine_s_path():
    for path in [*FILES, *ROOT.glob("conf/**/*.yaml"), *ROOT.glob("[!.]*.*"), ROOT / ".ci" / "run"]:
        if path.is_file():
            text = path.read_text()
            assert not re.search(r"pypi\.org|pythonhosted|/root/|/work/", text), path

"""A program designs through the tools: their numbers are those of the Python API, with errors and
pictures, and every refusal is one line.
"""

import base64
import inspect
import json
import re
import subprocess
import sys

import pytest
import torch
from mcp import Client

import dolens
from dolens.errors import one_line
from dolens.mcp.jobs import load
from dolens.mcp.server import LensServer
from dolens.mcp.tools import TOOLS, Tools
from tests.cli.test_app import WITHOUT
from tests.mcp.test_worker import JOBS

TRIPLET = {"lens": "cooke_triplet"}
KEPT = {"efl": 50, "back_focus": [30, None]}
SINGLET = {"efl": 50, "f_number": 6, "field": 5, "elements": 1, "glasses": ["1.5168/64.17"]}
# One of each tool, in this order: name of the call → tool, arguments.
CALLS = {
    "load": ("load", {"source": "cooke_triplet"}),
    "show": ("show", {**TRIPLET, "text": True}),
    "change": ("change", {**TRIPLET, "changes": {"surfaces.1.radius": 22.5}, "name": "bent"}),
    "trace": ("trace", {**TRIPLET, "field": [0, 14], "path": True}),
    "spots": ("analyse", {**TRIPLET, "what": "spots"}),
    "ray_fans": ("analyse", {**TRIPLET, "what": "ray_fans"}),
    "mtf": ("analyse", {**TRIPLET, "what": "mtf", "fields": [0], "wavelengths": [587.5618]}),
    "wavefront": ("analyse", {**TRIPLET, "what": "wavefront", "fields": [0, 14]}),
    "field_curves": ("analyse", {**TRIPLET, "what": "field_curves"}),
    "lateral_colour": ("analyse", {**TRIPLET, "what": "lateral_colour"}),
    "encircled_energy": ("analyse", {**TRIPLET, "what": "encircled_energy", "fields": [0]}),
    "illumination": ("analyse", {**TRIPLET, "what": "relative_illumination"}),
    "optimize": (
        "optimize",
        {**TRIPLET, "variables": ["surfaces.*.curvature"], "keep": KEPT, "iterations": 3},
    ),
    "search": ("search", {**SINGLET, "starts": 10, "forms": 1}),
    "show found": ("show", {"lens": "search_1", "picture": False}),
    "neighbours": ("neighbours", {**TRIPLET, "starts": 2, "forms": 1}),
    "check": ("check", {**TRIPLET, "focal_length": 50, "total_track": 55, "mean_rms_spot_um": 20}),
    "tolerance": ("tolerance", {**TRIPLET, "rms_spot_um": 13, "lenses": 50, "seed": 1}),
    "photograph": ("photograph", {**TRIPLET, "file": "grey.png", "distance": 2000, "light": 500}),
    "export": ("export", {**TRIPLET, "file": "triplet.zmx"}),
    "load again": ("load", {"source": "triplet.zmx", "name": "again", "picture": False}),
    "lenses": ("lenses", {}),
}
REFUSED = {
    "unknown tool": ("lod", {}, r"tool: 'lod' is unknown; did you mean 'load'\?"),
    "unknown argument": ("load", {"sorce": "x"}, r"unknown key 'sorce'; did you mean 'source'\?"),
    "no argument": ("search", {"efl": 50}, "search: f_number: Field required"),
    "out of range": ("search", {**SINGLET, "efl": -1}, "search: efl: -1; Input should be greater"),
    "too many": ("tolerance", {**TRIPLET, "lenses": 10**6}, "lenses: 1000000; .* or equal to 2000"),
    "too many elements": ("search", {**SINGLET, "elements": 9}, "elements: 9; allowed: 8 at most"),
    "of another type": ("trace", {**TRIPLET, "field": "axis"}, "trace: field: 'axis'; "),
    "no number": ("trace", {**TRIPLET, "field": [0, "nan"]}, "field"),
    "no lens": ("show", {"lens": "cook"}, "lens: 'cook' is none of the session"),
    "taken": ("load", {"source": "nikon", "name": "bent"}, "name: 'bent' is taken"),
    "out of the folder": ("load", {"source": "../x.zmx"}, "leads out of the folder"),
    "absolute": ("export", {**TRIPLET, "file": "/tmp/x.zmx"}, "leads out of the folder"),
    "no format": ("export", {**TRIPLET, "file": "x.exe"}, "'.exe' is unknown"),
    "of others": ("export", {**TRIPLET, "file": "others.yaml"}, "exists already"),
    "no name": ("load", {"source": "cooke"}, "'cooke' is no lens of dolens"),
    "no YAML": ("load", {"prescription": "a: [1"}, "is not valid YAML"),
    "code": (
        "load",
        {"prescription": "!!python/object/apply:os.system ['touch run']"},
        "prescription.yaml: ",
    ),
    "no picture": ("photograph", {**TRIPLET, "file": "others.png"}, "no picture that can be read"),
    "no parameter": ("optimize", {**TRIPLET, "variables": ["glass"]}, "has no parameter 'glass'"),
    "no path": ("change", {**TRIPLET, "changes": {"surface.1.radius": 3}}, "no 'surface' "),
    "no key": ("change", {**TRIPLET, "changes": {"surfaces.1.raduis": 3}}, "did you mean 'radius'"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    found = tmp_path_factory.mktemp("lenses")
    (found / "others.yaml").write_text("mine")
    (found / "others.png").write_text("mine")
    from PIL import Image

    Image.new("RGB", (48, 32), (90, 120, 150)).save(found / "grey.png")
    return found


@pytest.fixture(scope="module")
def played(folder, run_async):
    """All calls, and then all that are refused, in one session: name → result."""

    async def play():
        server = LensServer(folder)
        found = {}
        async with Client(server, mode="legacy") as client:
            found["tools"] = (await client.list_tools()).tools
            for name, (tool, arguments, *_) in {**CALLS, **REFUSED}.items():
                found[name] = await client.call_tool(tool, arguments)
        return found

    return run_async(play)


@pytest.fixture(scope="module")
def triplet():
    return dolens.load_lens("cooke_triplet")


def test_each_tool_says_what_it_takes_and_in_which_unit(played):
    tools = {tool.name: tool for tool in played["tools"]}
    assert tuple(tools) == TOOLS
    assert {tool for tool, _ in CALLS.values()} == set(TOOLS)
    for name, tool in tools.items():
        assert tool.description == one_line(getattr(Tools, name).__doc__)
        for parameter in tool.input_schema["properties"].values():
            assert parameter["description"]
    assert tools["search"].input_schema["required"] == ["efl", "f_number", "field", "elements"]


@pytest.mark.parametrize("name", CALLS)
def test_each_answer_has_numbers_their_errors_and_a_picture(played, name):
    answer = played[name]
    assert not answer.is_error, answer.content[0].text
    text, *pictures = answer.content
    assert json.loads(text.text) == answer.structured_content
    if name == "lenses":
        return
    for error in answer.structured_content["errors"]:
        assert error["of"] and error["how"] and error["by"] != []
    assert answer.structured_content["errors"]
    assert len(pictures) == (name not in ("load again", "show found"))
    for picture in pictures:
        data = base64.b64decode(picture.data)
        assert data.startswith(b"\x89PNG") and len(data) <= 400_000


@pytest.mark.parametrize("name", REFUSED)
def test_a_refusal_is_one_line(played, folder, name):
    answer = played[name]
    (only,) = answer.content
    assert answer.is_error and re.search(REFUSED[name][2], only.text), only.text
    assert "\n" not in only.text and "Traceback" not in only.text and len(only.text) <= 600
    assert sorted(path.name for path in folder.iterdir()) == [
        *("grey.png", "others.png", "others.yaml", "triplet.zmx")
    ]


def test_numbers_are_those_of_the_python_api(played, triplet):
    found = {name: played[name].structured_content for name in CALLS}
    efl = triplet.first_order().efl.item()
    assert found["load"]["efl_mm"] == pytest.approx(efl, rel=1e-7)
    chief = triplet.trace(triplet.chief_ray((0.0, 14.0))).position[1].item()
    assert found["trace"]["rays"][0]["sensor_mm"][1] == pytest.approx(chief, rel=1e-7)
    assert found["trace"]["path_of_first"][-1]["point"][1] == pytest.approx(chief, rel=1e-7)
    spots = [field.rms_spot_um for field in triplet.summary().fields]
    for name, rows in (("spots", found["spots"]["fields"]), ("load", found["load"]["spots"])):
        assert [row["rms_um"] for row in rows] == pytest.approx(spots, rel=1e-7), name
    better = triplet.optimize(
        ["surfaces.*.curvature"], keep={"efl": 50, "back_focus": (30, None)}, iterations=3
    )
    assert found["optimize"]["spots_after_um"] == pytest.approx(better.optimization.quality[1])
    made = triplet.tolerances("default", lenses=50, seed=1)
    assert found["tolerance"]["yield_percent"] == 100.0 * made.yield_at(13.0)
    assert found["tolerance"]["stay_within"]["90_percent_um"] == pytest.approx(made.radius_of(0.9))
    (form,) = found["search"]["forms"]
    assert form["keeps_all_limits"] and found["show found"]["efl_mm"] == pytest.approx(50.0)
    assert form["rms_spot_um"] == pytest.approx(
        [row["rms_um"] for row in found["show found"]["spots"]], rel=0.01
    )
    assert found["neighbours"]["forms"][0]["powers"] == "+ − | +"
    assert found["check"]["broken"] == ["total track", "vignetting"]


def test_a_lens_goes_through_a_file_and_through_text_unchanged(played, folder, triplet):
    text = played["show"].structured_content["prescription"]
    (folder.parent / "text.yaml").write_text(text)
    for lens in (
        dolens.load_lens(folder.parent / "text.yaml"),
        dolens.load_lens(folder / "triplet.zmx"),
    ):
        for name, value in triplet.state_dict().items():
            assert torch.equal(lens.state_dict()[name], value), name
    again, first = (played[name].structured_content for name in ("load again", "load"))
    assert again["lens"] == "again" and again["spots"] == first["spots"]


def test_lenses_of_the_session_have_names_and_the_folder_is_listed(played):
    found = played["lenses"].structured_content
    assert found["session"] == [
        *("cooke_triplet", "bent", "cooke_triplet_2", "search_1", "near_1", "again")
    ]
    assert found["lens_files"] == ["others.yaml", "triplet.zmx"]
    assert found["pictures"] == ["grey.png", "others.png"]
    assert "published/tessar_us2838978" in found["of_dolens"]
    bent = played["change"].structured_content
    assert bent["surfaces"]["1"]["radius"] == 22.5 and bent["lens"] == "bent"


def test_a_call_that_runs_out_of_time_leaves_the_server_alive(folder, run_async):
    async def play():
        server = LensServer(folder)
        server.lens_session.worker = type(server.lens_session.worker)(0.2, JOBS)
        async with Client(server, mode="legacy") as client:
            # `sleep` stands for a search that goes on and on.
            session = server.lens_session
            with pytest.raises(dolens.InputError, match=r"took more than 0\.2 s"):
                await session.run("sleep", seconds=60)
            return await client.call_tool("load", {"source": "../x.yaml"})

    assert run_async(play).is_error


def test_the_standard_output_belongs_to_the_protocol(folder):
    """The command itself, spoken to by hand: every line that it says is a message."""
    hello = {
        "protocolVersion": "2025-06-18",
        "capabilities": {},
        "clientInfo": {"name": "by hand", "version": "1"},
    }
    messages = [
        {"jsonrpc": "2.0", "id": 1, "method": "initialize", "params": hello},
        {"jsonrpc": "2.0", "method": "notifications/initialized"},
        {"jsonrpc": "2.0", "id": 2, "method": "tools/list"},
        {
            **{"jsonrpc": "2.0", "id": 3, "method": "tools/call"},
            "params": {"name": "load", "arguments": {"source": "/etc/passwd.zmx"}},
        },
    ]
    command = [sys.executable, "-m", "dolens", "mcp", str(folder)]
    with subprocess.Popen(command, stdin=-1, stdout=-1, stderr=-1, text=True) as server:
        said = {}
        for message in messages:
            server.stdin.write(json.dumps(message) + "\n")
            server.stdin.flush()
            if "id" in message:
                answer = json.loads(server.stdout.readline())
                said[answer["id"]] = answer["result"]
        rest, complaints = server.communicate()
    assert said[1]["serverInfo"]["name"] == "dolens" and "mm" in said[1]["instructions"]
    assert len(said[2]["tools"]) == len(TOOLS)
    assert said[3]["isError"] and "leads out of the folder" in said[3]["content"][0]["text"]
    assert rest == "" and complaints == "" and server.returncode == 0


def test_a_file_beside_the_server_is_not_taken_for_a_lens_of_dolens(tmp_path, monkeypatch):
    """`dolens.load_lens` would read it: its name is that of a file here."""
    (tmp_path / "cooke_triplet").write_text("mine")
    monkeypatch.chdir(tmp_path)
    assert load("cooke_triplet", None, False).values["name"] == "Cooke triplet"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["none"], "error: none: no such folder"), ([".", "--seconds", "0"], "error: --seconds: 0;")],
)
def test_a_server_that_cannot_begin_says_why_in_one_line(tmp_path, arguments, message):
    command = [sys.executable, "-m", "dolens", "mcp", *arguments]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1 and done.stderr.startswith(message)
    assert done.stderr.count("\n") == 1 and done.stdout == ""


def test_without_its_package_the_command_says_how_to_install_it(tmp_path):
    command = [sys.executable, "-c", WITHOUT.format(packages=("mcp",)), "mcp", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.stderr == (
        "error: dolens mcp: the package 'mcp' is not installed; install the packages that it needs "
        "by: pip install 'dolens[mcp]'\n"
    )


def test_the_page_lists_the_tools(root):
    page = (root / "docs" / "mcp.md").read_text()
    for name in TOOLS:
        method = getattr(Tools, name)
        words = one_line(method.__doc__)
        taken = ", ".join(f"`{p}`" for p in inspect.signature(method).parameters if p != "self")
        assert f"| `{name}` | {words} | {taken} |" in page, f"| `{name}` | {words} | {taken} |"

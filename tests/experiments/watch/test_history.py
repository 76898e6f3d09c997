"""The history of a run: bounded, whole after a kill, continued by a resume, of no influence."""

import json
import multiprocessing
import os
import shutil
import signal
import time

import numpy as np
import pytest
from PIL import Image

from dolens.errors import InputError
from dolens.experiments.watch import history as module
from dolens.experiments.watch.history import FILE, FOLDER, Frame, Recorder, read_history
from dolens.experiments.watch.run_page import RunPage
from tests.experiments.tiny_experiment import QUIET

DESIGN = [
    "experiment=nikon", QUIET, "callbacks.pictures=null", "test=false", "objective=train/merit",
    "merit.sampling_options.count=9", "data.iterations=4", "trainer.max_epochs=2",
    "trainer.log_every_n_steps=1",
]  # fmt: skip


@pytest.fixture
def at_once(monkeypatch):
    """Every frame is recorded and written, whatever it costs."""
    monkeypatch.setattr(module, "_LEAST_S", dict.fromkeys(module._LEAST_S, 0.0))
    monkeypatch.setattr(module, "_SHARE", 1e9)


def recorded(recorder, step, pictures=None):
    recorder.add(step, Frame(0, 0.0, {"sensor_distance": float(step)}), time.monotonic(), pictures)


def test_frames_and_pictures_are_few_and_spread_over_the_run(tmp_path, at_once):
    recorder = Recorder(tmp_path, most_frames=20, most_bytes=20_000)
    for step in range(100):
        recorded(recorder, step, {"a": {"sensor": bytes(1000), "restored": bytes(1000)}})
    found = read_history(tmp_path)
    steps = [frame.step for frame in found.frames]
    assert len(steps) <= 20 and steps[0] == 0 and steps[-1] == 99
    assert max(np.diff(steps)) <= 16
    assert [frame.lens["sensor_distance"] for frame in found.frames] == steps
    files = {path.name for path in (tmp_path / FOLDER).glob("*.webp")}
    assert files == {file for frame in found.frames for file in frame.files()}
    assert 8_000 < 1000 * len(files) <= 20_000


def test_many_numbers_leave_fewer_frames(tmp_path):
    recorder = Recorder(tmp_path)
    for step in range(60):
        values = {"surfaces.1.coefficients": [float(step)] * 3000}
        recorder.add(step, Frame(0, 0.0, values), time.monotonic())
    recorder.write()
    assert len(read_history(tmp_path).frames) <= 20
    assert (tmp_path / FOLDER / FILE).stat().st_size < 1_500_000


def test_what_costs_much_is_recorded_rarely(tmp_path):
    recorder = Recorder(tmp_path)
    recorder.add(0, Frame(0, 0.0), time.monotonic() - 1.0)  # a frame that took a second
    assert not recorder.due() and recorder.due("pictures")
    assert recorder._next["frame"] - time.monotonic() == pytest.approx(1.0 / module._SHARE, rel=0.1)


def _record_for_ever(folder):
    recorder = Recorder(folder)
    for step in range(10**6):
        recorded(recorder, step, {"a": {"sensor": bytes(3000)}})


def test_a_run_that_is_killed_leaves_a_whole_history(tmp_path, at_once):
    forked = multiprocessing.get_context("fork")
    last = -1
    for pause in (0.05, 0.11, 0.17):
        (tmp_path / FOLDER / FILE).unlink(missing_ok=True)
        process = forked.Process(target=_record_for_ever, args=(tmp_path,))
        process.start()
        while not (tmp_path / FOLDER / FILE).exists():
            time.sleep(0.005)
        time.sleep(pause)
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        found = read_history(tmp_path)
        assert found.frames and found.frames[-1].step > last
        for frame in found.frames:
            assert all((tmp_path / FOLDER / file).stat().st_size == 3000 for file in frame.files())


def test_the_spots_of_a_recorded_step_are_those_of_the_run_s_numbers(trained, at_once):
    run = trained(*DESIGN)
    rows = run.table("history")
    page = RunPage(run.folder)
    steps = [frame["step"] for frame in page.state()["frames"]]
    assert steps == list(range(9))  # two rounds of four
    for number, step in enumerate(steps):
        shown = page.frame(number)
        assert len(shown["section"]["glass"]) == 12 and len(shown["variables"]) == 23
        for spot in shown["spots"]["spots"] if step else ():
            label = f"spot_um/{spot['field']}/{spot['wavelength']}"
            assert spot["rms"] == pytest.approx(float(rows[step - 1][label]), rel=1e-5)
            points = np.array(spot["points"])
            assert np.hypot(*points.T).max() > spot["rms"]
    merits = page.state()["plots"][0]["series"][0]["points"]
    assert merits[-1] == [8, pytest.approx(float(rows[7]["train/merit"]), rel=1e-5)]


def test_a_resumed_run_goes_on_with_the_history_and_recording_changes_nothing(trained, at_once):
    whole = trained(*DESIGN, "callbacks.history=null", folder="whole")
    assert not (whole.folder / FOLDER).exists()
    first = trained(*DESIGN, "trainer.max_epochs=1", folder="first")
    second = trained(*DESIGN, f"ckpt_path={first.last}", folder="second")
    assert second.objective == whole.objective
    histories = [read_history(run.folder) for run in (first, second)]
    steps = [[frame.step for frame in history.frames] for history in histories]
    assert steps == [list(range(5)), list(range(9))]
    assert histories[1].frames[:4] == histories[0].frames[:4]
    assert histories[1].frames[4].lens == histories[0].frames[4].lens
    assert [entry.step for entry in histories[1].rounds] == [0, 4]
    seconds = [frame.seconds for frame in histories[1].frames]
    assert seconds == sorted(seconds)


def test_a_camera_s_history_has_photographs_as_it_went_on(two_epochs):
    frames = RunPage(two_epochs.folder).state()["frames"]
    shown = [frame for frame in frames if frame["pictures"]]
    assert [frame["step"] for frame in shown] == [2, 4]
    names = [name for name in shown[0]["pictures"] if name != "PSF"]
    assert {name.rpartition(", ")[2] for name in names} == {"8 m", "6 m", "4.5 m"}
    page = RunPage(two_epochs.folder)
    for label, file in shown[1]["pictures"][names[0]].items():
        assert label in ("truth", "sensor", "restored")
        assert (two_epochs.folder / FOLDER / file).read_bytes() == page.picture(file)
        assert Image.open(two_epochs.folder / FOLDER / file).size == (24, 24)


HOSTILE = {
    "not JSON": "{",
    "a list": "[1]",
    "deep": "[" * 100_000,
    "no frames": {"version": 1},
    "a later version": {"version": 2, "frames": [], "rounds": [], "bounds": {}},
    "no number": {"lens": {"sensor_distance": "1"}},
    "no finite number": {"lens": {"sensor_distance": float("nan")}},
    "a path": {"pictures": {"a": {"sensor": "../../../etc/passwd"}}},
    "a step of no kind": {"step": "0"},
    "a form of nothing": {"forms": [{"merit": 1.0, "spots": [], "way": "", "lens": None}]},
    "control characters": {"pictures": {"\x1b[2J": {}}},
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_a_history_from_a_stranger_is_data(kind, run_copy):
    content = HOSTILE[kind]
    if isinstance(content, dict) and "version" not in content:
        frame = {"step": 0, "seconds": 0.0, "lens": {}, "pictures": {}, "forms": [], **content}
        content = {"version": 1, "frames": [frame], "rounds": [], "bounds": {}}
    text = content if isinstance(content, str) else json.dumps(content)
    (run_copy / FOLDER).mkdir(exist_ok=True)
    (run_copy / FOLDER / FILE).write_text(text)
    with pytest.raises(InputError) as caught:
        read_history(run_copy)
    state = RunPage(run_copy).state()
    assert state["problems"] == [str(caught.value)] and "\n" not in str(caught.value)
    assert FILE in state["problems"][0] and not state["frames"]


def test_a_lens_from_a_stranger_is_a_sentence_on_the_page(run_copy):
    frame = Frame(0, 0.0, {"surfaces.99.curvature": 1.0})
    recorder = Recorder(run_copy)
    recorder.add(0, frame, time.monotonic())
    recorder.write()
    assert "surfaces.99.curvature" in RunPage(run_copy).frame(0)["section"]
    (run_copy / "lens" / "initial.yaml").write_text("surfaces: [")
    assert isinstance(RunPage(run_copy).frame(0)["section"], str)


def test_a_run_without_a_history_shows_what_it_has(run_copy):
    shutil.rmtree(run_copy / FOLDER)
    state = RunPage(run_copy).state()
    assert "no history" in state["note"] and state["status"] == "finished"
    assert "test/psnr_db" in state["metrics"]
    assert state["figures"] == sorted(path.name for path in (run_copy / "figures").iterdir())
    assert state["figures"]


def test_files_outside_of_the_history_are_not_given(run_copy):
    page = RunPage(run_copy)
    for name in ("frames.json", "../run.json", "run.json"):
        with pytest.raises(InputError, match="there is no"):
            page.picture(name)
        with pytest.raises(InputError, match="there is no"):
            page.figure(name)

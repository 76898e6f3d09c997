"""Full disks, damaged checkpoints, failing loggers: what was good stays, and one line says why."""

import csv
import errno
import logging
import threading
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.tensorboard import SummaryWriter
from typer.testing import CliRunner

from dolens.cli.app import app
from dolens.errors import InputError
from dolens.experiments.callbacks import saved_figures
from dolens.experiments.loggers import trackers as history_file
from dolens.experiments.loggers.trackers import History, TensorBoard
from dolens.experiments.running import checkpoints
from dolens.experiments.running.checkpoints import WholeCheckpoints, read_checkpoint
from dolens.experiments.running.main import machine_fault, thread_faults_in_one_line
from dolens.experiments.running.run_files import write_json
from dolens.experiments.running.run_folder import LogFile

FULL = OSError(errno.ENOSPC, "No space left on device")
CHECKPOINT = {"state_dict": {"weight": torch.arange(4096.0)}, "global_step": 7}


@pytest.fixture
def saved(tmp_path):
    WholeCheckpoints().save_checkpoint(CHECKPOINT, tmp_path / "last.ckpt")
    return tmp_path / "last.ckpt"


# -------------------------------------------------------------------------------- checkpoints


def test_a_checkpoint_that_finds_no_room_leaves_the_one_before_it(saved, monkeypatch):
    def half(content, file):
        file.write(b"half")
        raise FULL

    monkeypatch.setattr(checkpoints.torch, "save", half)
    with pytest.raises(OSError, match="No space"):
        WholeCheckpoints().save_checkpoint({"state_dict": {}}, saved)
    assert read_checkpoint(saved)["global_step"] == 7
    assert [path.name for path in saved.parent.iterdir()] == ["last.ckpt"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
def test_a_full_disk_is_named_whatever_pytorch_says_of_it():
    with pytest.raises(OSError) as caught:
        checkpoints._save(CHECKPOINT, Path("/dev/full"))
    assert machine_fault(caught.value) == "/dev/full: the disk is full"


def test_every_flipped_bit_of_a_weight_is_noticed(saved):
    content = saved.read_bytes()
    weight = content.index(np.arange(4096.0, dtype=np.float32).tobytes())
    for place in (weight, weight + 5000, weight + 4 * 4096 - 1):
        damaged = bytearray(content)
        damaged[place] ^= 1
        saved.write_bytes(damaged)
        assert torch.load(saved, weights_only=True)  # PyTorch alone takes it
        with pytest.raises(InputError, match=r"last\.ckpt is damaged: the checksum of its part"):
            read_checkpoint(saved)


@pytest.mark.parametrize("length", [0, 100, 0.5, 0.99])
def test_a_checkpoint_that_was_cut_is_refused_in_one_line(saved, length):
    content = saved.read_bytes()
    saved.write_bytes(content[: length if isinstance(length, int) else int(length * len(content))])
    with pytest.raises(InputError, match=r"^ckpt_path: .*last.ckpt is not a safe") as caught:
        read_checkpoint(saved, "ckpt_path: ")
    assert "\n" not in str(caught.value)


# -------------------------------------------------------------------------------- loggers, logs


def test_a_logger_that_fails_is_named_once_and_asked_for_nothing_more(
    tmp_path, monkeypatch, caplog
):
    def fail(*arguments, **options):
        raise FULL

    monkeypatch.setattr(SummaryWriter, "add_scalar", fail)
    board = TensorBoard(str(tmp_path))
    for step in range(3):
        board.log_metrics({"train/loss": 1.0}, step)
        board.log_picture("a", np.zeros((4, 4, 3), np.uint8), step)
    board.finalize("success")
    (said,) = caplog.messages
    assert said.startswith("The logger TensorBoard has failed in log_metrics (OSError: ")


@pytest.mark.parametrize(
    ("error", "lines"),
    [
        (OSError(errno.ENOSPC, "No space"), ["writer has ended: the disk is full"]),
        (ZeroDivisionError(), []),
    ],
)
def test_a_full_disk_that_ends_a_thread_is_one_line(error, lines, monkeypatch, caplog):
    def fail():
        raise error

    kept = []
    monkeypatch.setattr(threading, "excepthook", lambda found: kept.append(found.exc_value))
    with thread_faults_in_one_line():
        thread = threading.Thread(target=fail, name="writer")
        thread.start()
        thread.join()
    assert caplog.messages == lines
    assert kept == ([] if lines else [error])


def steps_of(path):
    with path.open(newline="") as file:
        return [row["step"] for row in csv.DictReader(file)]


def test_rows_that_find_no_room_are_written_when_there_is_some(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(history_file, "_WAIT_S", 0.0)
    history, writer = History(tmp_path / "metrics.csv"), history_file.csv.DictWriter
    real = {name: getattr(writer, name) for name in ("writerow", "writerows")}
    for step in range(9):
        if step == 3:

            def half(self, rows):
                self.writer.writerow(["3"])
                raise FULL

            for name in real:
                monkeypatch.setattr(writer, name, half)
        if step == 6:
            for name, method in real.items():
                monkeypatch.setattr(writer, name, method)
        history.log_metrics({"train/loss": 1.0}, step)
    history.finalize("success")
    assert steps_of(tmp_path / "metrics.csv") == [str(step) for step in range(9)]
    assert [m for m in caplog.messages if "its rows wait" in m] == caplog.messages[:1]


def test_half_a_row_is_no_row(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text("step,train/loss\n1,0.5\n2,0.25\n3")
    history = History(path)
    history.log_metrics({"train/loss": 0.1}, 3)
    history.save()
    assert steps_of(path) == ["1", "2", "3"]


def test_a_log_on_a_full_disk_is_one_line(tmp_path, capsys):
    log, logger = LogFile(tmp_path / "log.txt"), logging.Logger("test")
    logger.addHandler(log)
    log.stream.close()  # as good as full
    for _ in range(3):
        logger.warning("a line")
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "log.txt cannot be written" in said


def test_json_is_whole_or_as_it_was(tmp_path, monkeypatch):
    write_json(tmp_path / "run.json", {"status": "running"})
    monkeypatch.setattr(Path, "replace", lambda *_: (_ for _ in ()).throw(FULL))
    with pytest.raises(OSError):
        write_json(tmp_path / "run.json", {"status": "finished"})
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


def test_a_figure_that_fails_is_logged(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(saved_figures, "save_figures", lambda *_: (_ for _ in ()).throw(FULL))
    saved_figures._keep(
        lambda: {"layout": lambda: None}, lambda name, figure: saved_figures.save_figures(figure)
    )
    assert "No figure 'layout'" in caplog.text


# -------------------------------------------------------------------------------- the machine


class Linked(RuntimeError):
    """An error that another one led to."""


def test_a_fault_of_the_machine_is_found_behind_other_errors():
    try:
        try:
            raise PermissionError(errno.EACCES, "Permission denied", "/runs/a")
        except OSError as error:
            raise Linked("cannot configure the log") from error
    except Linked as error:
        assert machine_fault(error) == "/runs/a: permission denied"
    assert machine_fault(Linked("DataLoader worker (pid(s) 7) exited unexpectedly")).startswith(
        "data.num_workers: "
    )
    # These may be faults of the program, whose traceback somebody has to see.
    assert machine_fault(FileNotFoundError(errno.ENOENT, "none", "a.txt")) is None
    assert machine_fault(ValueError("a.txt")) is None


def test_a_run_folder_that_is_a_file_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", [])
    (tmp_path / "file").write_text("mine")
    found = CliRunner().invoke(
        app, ["train", "experiment=asphere", f"hydra.run.dir={tmp_path / 'file'}"]
    )
    assert found.exit_code == 1
    lines = [line for line in found.output.splitlines() if line.strip()]
    assert lines == [f"error: {tmp_path / 'file'}: a file is where a folder is needed"]
    assert (tmp_path / "file").read_text() == "mine"

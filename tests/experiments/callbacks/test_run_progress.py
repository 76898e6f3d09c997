"""The display of a run: what it says, and when."""

import io
import logging
import math
import time
from types import SimpleNamespace

import lightning
import pytest
import torch
from rich.console import Console

from dolens.errors import InputError
from dolens.experiments.callbacks import run_progress as callback_file
from dolens.experiments.callbacks.progress_display import (
    LogDisplay,
    MovingAverage,
    Snapshot,
    TerminalDisplay,
    clock_text,
    display_for,
    logging_above,
    plain_text,
    speed_text,
)
from dolens.experiments.callbacks.run_progress import RunProgress
from dolens.tasks import stage

SOME = Snapshot(
    "fit", 30, 120, "epoch 2 of 6", {"train/loss": 0.0123456, "val/psnr_db": 24.5}, 3.4, 65.0
)


@pytest.mark.parametrize(
    ("smoothing", "numbers", "average"),
    [
        (0.9, (), math.nan),
        (0.9, (5.0,), 5.0),
        (0.9, (5.0, 5.0, 5.0), 5.0),
        (0.5, (0.0, 0.0, 8.0), 8.0 / 1.75),  # weights 1/4, 1/2, 1
        (0.9, (1.0, math.inf), math.inf),
        (0.9, (1.0, math.inf, 1.0), 1.0),  # it recovers
    ],
)
def test_an_average_follows_numbers_as_its_weights_say_and_hides_no_nan(
    smoothing, numbers, average
):
    found = MovingAverage(smoothing)
    for number in numbers:
        found.add(number)
    assert found.value == pytest.approx(average, rel=1e-14, nan_ok=True)


def test_an_average_can_be_looked_at_while_its_first_number_is_added():
    class Watched(float):
        def __radd__(self, other):
            seen.append(average.value)
            return other + float(self)

    average, seen = MovingAverage(0.5), []
    average.add(Watched(2.0))
    assert len(seen) == 1 and math.isnan(seen[0])
    assert average.value == 2.0


def test_durations_and_speeds_are_for_people():
    assert [clock_text(s) for s in (0.4, 59.6, 3725.0)] == ["0:00", "1:00", "1:02:05"]
    assert [speed_text(s) for s in (12.34, 0.1)] == ["12.3 steps/s", "6 steps/min"]


# ---------------------------------------------------------------- displays


def test_a_log_has_a_line_every_so_often_and_names_a_stage_once(caplog, monkeypatch):
    caplog.set_level(logging.INFO, "dolens.experiments.progress")
    now, state = [100.0], [SOME]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    display = LogDisplay(lambda: state[0], every_s=30.0)
    display.open()
    for at in range(100, 191):  # a step a second
        now[0] = float(at)
        display.update()
    assert len(caplog.messages) == 4
    assert caplog.messages[0] == (
        "fit: step 30 of 120, 3.4 steps/s, 1:05 left, epoch 2 of 6; loss 0.01235, val/psnr_db 24.5"
    )
    state[0] = Snapshot("fit", stages=("planning", "compiling kernels: sphere forward"))
    for _ in range(5):
        display.update(force=True)
    assert caplog.messages[4:] == ["fit: planning › compiling kernels"]


def drawn(snapshot, width=100):
    console = Console(file=io.StringIO(), force_terminal=True, width=width, color_system=None)
    console.print(TerminalDisplay(lambda: snapshot, console).renderable())
    return [line.rstrip() for line in console.file.getvalue().splitlines()]


def test_a_terminal_has_a_bar_the_numbers_and_the_stage():
    first, second = drawn(SOME)
    assert first.startswith("fit ━━━")
    assert first.endswith("step 30 of 120, 3.4 steps/s, 1:05 left, epoch 2 of 6")
    assert second.strip() == "loss 0.01235, val/psnr_db 24.5"
    waiting = Snapshot("fit", 0, 120, stages=("looking at the lens", "rays"), stage_s=7.0)
    assert "looking at the lens › rays, 0:07" in drawn(waiting)[-1]
    # A narrow terminal cuts lines and does not wrap them.
    assert len(drawn(SOME, width=50)) == 2


def test_lines_of_the_log_go_above_the_bar():
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    console = Console(file=io.StringIO(), force_terminal=True, width=40)
    terminal = Terminal()
    handler = logging.StreamHandler(terminal)
    logging.getLogger().addHandler(handler)
    try:
        with logging_above(console):
            logging.getLogger("x").warning("%s", "[bold] is text, " + "and long " * 6)
        assert handler.stream is terminal
    finally:
        logging.getLogger().removeHandler(handler)
    assert terminal.getvalue() == ""
    assert console.file.getvalue() == "[bold] is text, " + "and long " * 6 + "\n"


def test_where_there_is_no_terminal_the_log_is_written():
    assert isinstance(display_for(lambda: SOME, 30.0), LogDisplay)


def test_a_notebook_has_the_same_as_text():
    first, second = plain_text(SOME).splitlines()
    assert first.startswith("fit ████████░░░")  # a quarter
    assert second == "loss 0.01235, val/psnr_db 24.5"


# ---------------------------------------------------------------- the callback


class Recorder:
    """A display that keeps all states."""

    def __init__(self, snapshot):
        self.snapshot, self.states, self.is_open = snapshot, [], False

    def open(self):
        self.is_open = True

    def update(self, force=False):
        assert self.is_open
        self.states.append(self.snapshot())

    def close(self):
        self.is_open = False


class Slow(lightning.LightningModule):
    """Waits before its first step, and has steps of known length."""

    def __init__(self, fails=False):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(()))
        self.fails = fails

    def on_train_epoch_start(self):
        if self.current_epoch == 0:
            with stage("looking at the lens"), stage("rays"):
                time.sleep(2.0)

    def training_step(self, batch, index):
        if self.fails and index == 1:
            raise ValueError("on purpose")
        time.sleep(0.02)
        self.log("train/loss", self.weight**2 + self.global_step % 2, prog_bar=True)
        return self.weight**2

    def validation_step(self, batch, index):
        self.log("val/psnr_db", 20.0 + self.current_epoch, prog_bar=True)

    test_step = validation_step

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.0)


class Photographs(lightning.LightningDataModule):
    def loader(self):
        return torch.utils.data.DataLoader(torch.zeros(8, 1), batch_size=2)

    train_dataloader = val_dataloader = test_dataloader = loader

    def evaluation_photographs(self, split):
        return [f"{split[:4]}{n // 2}.png" for n in range(8)]


def followed(tmp_path, module, **options):
    made = []
    callback = RunProgress(display=lambda snapshot: made.append(Recorder(snapshot)) or made[-1])
    trainer = lightning.Trainer(
        accelerator="cpu", max_epochs=3, logger=False, enable_checkpointing=False,
        enable_model_summary=False, num_sanity_val_steps=0, default_root_dir=tmp_path,
        callbacks=[callback], **options,
    )  # fmt: skip
    return trainer, made


def test_a_run_is_followed_from_its_first_second(tmp_path, caplog, monkeypatch):
    monkeypatch.setattr(callback_file, "_LOOK_S", 0.0)  # every step, however fast
    caplog.set_level(logging.INFO, "dolens.experiments.progress")
    module, data = Slow(), Photographs()
    trainer, made = followed(tmp_path, module)
    trainer.fit(module, data)
    trainer.test(module, data, verbose=False)
    fit, test = made
    assert not fit.is_open and not test.is_open
    # Before the first step the work is named.
    waiting = [s for s in fit.states if s.stages]
    assert {s.stages for s in waiting} >= {("looking at the lens", "rays")}
    assert all(s.done == 0 for s in waiting)
    # Its two seconds are none of the first step's.
    steps = [s for s in fit.states if s.part == "fit" and s.done and not s.stages]
    assert [s.done for s in steps] == list(range(1, 13)) and steps[0].total == 12
    assert steps[0].steps_per_second > 0.5
    assert steps[-1].remaining_s == pytest.approx(0.0, abs=1e-6)
    assert {s.detail for s in steps} == {f"epoch {n} of 3" for n in (1, 2, 3)}
    # Validation and test say what they look at.
    validation = [s for s in fit.states if s.part == "validate"]
    assert "photograph vali0" in {s.detail for s in validation}
    assert validation[-1].done == validation[-1].total == 4
    assert {s.part for s in test.states} == {"test"}
    assert test.states[-1].detail == "photograph test3"
    # The log keeps one line; the loss, 1 and 2 in turn, is smoothed.
    (line,) = (m for m in caplog.messages if m.startswith("fit: 12 steps"))
    assert 1.3 < float(line.partition("loss ")[2].split(",")[0]) < 1.7
    assert line.endswith("val/psnr_db 22")


def test_a_display_of_another_thread_sees_whole_numbers():
    class Interrupted(MovingAverage):
        """The training's thread reads further metrics while the display reads this one."""

        @property
        def value(self):
            callback._read_numbers()
            return super().value

    class Loss:
        """The display looks while the training's thread reads this metric."""

        def __float__(self):
            seen.append(dict(callback.snapshot().numbers))
            return 0.5

    seen = []
    callback = RunProgress()
    callback._trainer = SimpleNamespace(progress_bar_metrics={"train/loss": Loss()})
    callback._read_numbers()
    assert seen == [{}]
    callback._numbers = {"train/first": Interrupted(0.5)}
    callback._numbers["train/first"].add(3.0)
    callback._trainer.progress_bar_metrics = {"train/loss": 0.5}
    assert callback.snapshot().numbers == {"train/first": 3.0}
    assert "train/loss" in callback._numbers


def test_what_a_validation_does_within_an_epoch_is_no_time_of_a_step(tmp_path, monkeypatch):
    class Looking(Slow):
        def validation_step(self, batch, index):
            with stage("rendering"):
                time.sleep(1.0)

    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    monkeypatch.setattr(time, "sleep", lambda seconds: now.__setitem__(0, now[0] + seconds))
    trainer, made = followed(tmp_path, module := Looking(), val_check_interval=2)
    trainer.fit(module, Photographs())
    speeds = [s.steps_per_second for s in made[0].states if s.part == "fit" and s.done]
    assert speeds == pytest.approx([50.0] * len(speeds))  # steps of 0.02 s


def test_training_data_without_a_length_have_no_known_end(tmp_path):
    class Stream(torch.utils.data.IterableDataset):
        def __iter__(self):
            return iter(torch.zeros(4, 1))

    trainer, made = followed(tmp_path, module := Slow())
    trainer.fit(module, torch.utils.data.DataLoader(Stream(), batch_size=2))
    steps = [s for s in made[0].states if s.part == "fit" and s.done]
    assert steps[-1].done == 6
    assert {(s.total, s.remaining_s) for s in steps} == {(None, None)}
    assert plain_text(steps[-1]).startswith("fit step 6, ")


def test_the_display_is_closed_when_a_run_fails(tmp_path):
    module = Slow(fails=True)
    trainer, made = followed(tmp_path, module)
    with pytest.raises(ValueError, match="on purpose"):
        trainer.fit(module, Photographs())
    assert not made[0].is_open


@pytest.mark.parametrize("options", [{"smoothing": 1.0}, {"smoothing": -0.1}, {"every_s": 0.0}])
def test_a_setting_out_of_range_is_named(options):
    with pytest.raises(InputError, match=next(iter(options))):
        RunProgress(**options)

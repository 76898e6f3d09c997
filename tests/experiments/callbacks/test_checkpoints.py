"""Trainings that leave the finite numbers, and trainings that are resumed more than once."""

import lightning
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from torch.optim import lr_scheduler as schedules
from torch.utils.data import DataLoader, TensorDataset

from dolens.errors import InputError
from dolens.experiments.callbacks.checkpoints import LastCheckpoint, ResumedEpochs, ResumedSchedules
from dolens.experiments.callbacks.interruption import FiniteTraining

NAN = float("nan")


class Line(lightning.LightningModule):
    """A straight line; some steps have another loss or gradient."""

    def __init__(self, losses=None, gradients=None, weights=None):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.tensor([1.0, 2.0]))
        self.register_buffer("best", torch.tensor(float("inf")))
        self.losses, self.gradients, self.weights = losses or {}, gradients or {}, weights or {}
        self.steps, self.validated = [], []

    def training_step(self, batch, batch_idx):
        self.steps.append((self.current_epoch, batch_idx))
        step = self.global_step + 1
        if step in self.weights:
            self.weight.data[0] = self.weights[step]
        loss = (self.weight * batch[0]).square().sum() * self.losses.get(step, 1.0)
        self.log("train/loss", loss)
        return loss

    def on_after_backward(self):
        self.weight.grad[1] *= self.gradients.get(self.global_step + 1, 1.0)

    def validation_step(self, batch, batch_idx):
        self.validated.append(self.current_epoch)

    def configure_optimizers(self):
        return torch.optim.Adam(self.parameters(), lr=0.1)


def fit(module, folder, *callbacks, checkpoint=None, epochs=2):
    data = DataLoader(TensorDataset(torch.ones(3, 2)), batch_size=1)
    trainer = lightning.Trainer(
        accelerator="cpu",
        max_epochs=epochs,
        callbacks=list(callbacks),
        default_root_dir=folder,
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        log_every_n_steps=1,
    )
    trainer.fit(module, data, data, ckpt_path=checkpoint, weights_only=True)
    return module


def every_step(folder, kind=ModelCheckpoint):
    return kind(
        dirpath=folder,
        filename="{step}",
        every_n_train_steps=1,
        save_top_k=-1,
        enable_version_counter=False,
    )


def names(folder):
    return sorted(path.name for path in folder.glob("*.ckpt"))


BROKEN = {
    "loss": (Line({3: NAN}), "step 3: the loss is not finite (train/loss nan); nothing moved"),
    "gradient": (Line(None, {3: NAN}), "step 3: the gradient is not finite (of weight)"),
    "state": (Line(None, None, {3: NAN}), "the loss is not finite"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_training_ends_before_it_moves_by_what_is_no_number(tmp_path, case):
    module, said = BROKEN[case]
    with pytest.raises(InputError) as caught:
        fit(module, tmp_path, FiniteTraining(), every_step(tmp_path))
    assert said in str(caught.value) and "\n" not in str(caught.value)
    assert names(tmp_path) == ["step=1.ckpt", "step=2.ckpt"]
    if case != "state":
        assert bool(torch.isfinite(module.weight).all())


def test_a_state_that_is_no_number_is_not_kept(tmp_path):
    class Drifts(Line):
        def on_train_batch_end(self, outputs, batch, batch_idx):
            self.best.fill_(1.0 if self.global_step < 4 else NAN)

        def on_train_start(self):
            self.best.fill_(0.0)

    class Broken(LastCheckpoint):
        """Comes behind the module's own end of a batch."""

        def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
            if batch_idx:
                trainer.save_checkpoint(tmp_path / f"step={trainer.global_step}.ckpt")

    finite = FiniteTraining()
    module = Drifts()
    module.best.fill_(0.0)
    with pytest.raises(InputError, match="step 4: best is not finite any more"):
        fit(module, tmp_path, finite, Broken(tmp_path, filename="unused", save_top_k=0))
    assert names(tmp_path) == ["step=1.ckpt", "step=2.ckpt"]


def test_what_is_not_finite_to_begin_with_is_no_fault(tmp_path):
    fit(Line(), tmp_path, FiniteTraining(), every_step(tmp_path))
    assert len(names(tmp_path)) == 6


def test_steps_are_left_out_where_that_is_allowed(tmp_path, caplog):
    module = fit(Line({2: NAN}, {4: NAN, 5: NAN}), tmp_path, FiniteTraining(skipped_steps=2))
    assert [m.split(":")[0] for m in caplog.messages if "left out" in m] == [
        f"Step {n} is left out" for n in (2, 4, 5)
    ]
    assert bool(torch.isfinite(module.weight).all())
    with pytest.raises(InputError, match=r"not finite .* for 3 steps in a row"):
        fit(Line({2: NAN, 3: NAN, 4: NAN}), tmp_path, FiniteTraining(skipped_steps=2))
    with pytest.raises(InputError, match="allowed: 0 or more"):
        FiniteTraining(skipped_steps=-1)


@pytest.mark.parametrize("kind", [ModelCheckpoint, LastCheckpoint])
def test_a_run_that_is_resumed_again_and_again_makes_every_step_once(tmp_path, kind):
    """By Lightning's own checkpoints too, one of which is of an epoch's last step."""

    def callbacks(folder):
        return ResumedEpochs(), every_step(tmp_path / folder, kind)

    whole = fit(Line(), tmp_path, *callbacks("0"))
    for first in (1, 2, 3, 4):
        middle = f"{first}"
        start = tmp_path / "0" / f"step={first}.ckpt"
        fit(Line(), tmp_path, *callbacks(middle), checkpoint=start)
        for second in range(first + 1, 6):
            again = fit(
                Line(),
                tmp_path,
                *callbacks("last"),
                checkpoint=tmp_path / middle / f"step={second}.ckpt",
            )
            assert again.steps == whole.steps[second:], (first, second)
            assert torch.equal(again.weight, whole.weight)


def test_the_validation_of_an_epoch_is_not_left_out(tmp_path):
    """A run that ends within it goes on from the step before, and validates."""
    fit(Line(), tmp_path, every_step(tmp_path, LastCheckpoint), epochs=1)
    assert names(tmp_path) == ["step=1.ckpt", "step=2.ckpt", "step=3.ckpt"]

    class Ends(Line):
        def validation_step(self, batch, batch_idx):
            raise KeyboardInterrupt

    with pytest.raises((KeyboardInterrupt, SystemExit)):
        fit(Ends(), tmp_path / "a", every_step(tmp_path / "a", LastCheckpoint))
    assert names(tmp_path / "a") == ["step=1.ckpt", "step=2.ckpt"]
    again = fit(
        Line(), tmp_path / "b", ResumedEpochs(), checkpoint=tmp_path / "a" / "step=2.ckpt", epochs=1
    )
    assert again.validated == [0, 0, 0]


# Schedules by their length in steps, over nine steps where they are not cut short.
SCHEDULES = {
    "cosine": lambda o, n: schedules.CosineAnnealingLR(o, n),
    "linear": lambda o, n: schedules.LinearLR(o, 1.0, 0.1, n),
    "constant": lambda o, n: schedules.ConstantLR(o, 0.5, n - 2),
    "polynomial": lambda o, n: schedules.PolynomialLR(o, n, 2.0),
    "one cycle": lambda o, n: schedules.OneCycleLR(o, 0.2, n),
    "restarts": lambda o, n: schedules.CosineAnnealingWarmRestarts(o, n),
    "steps": lambda o, n: schedules.StepLR(o, n // 3),
    "milestones": lambda o, n: schedules.MultiStepLR(o, [n // 3, n - 2]),
    "exponential": lambda o, n: schedules.ExponentialLR(o, 0.1 ** (1 / n)),
    "cyclic": lambda o, n: schedules.CyclicLR(o, 0.01, 0.1, n // 3, cycle_momentum=False),
    "function": lambda o, n: schedules.LambdaLR(o, lambda step: 1.0 - step / n),
    "factors": lambda o, n: schedules.MultiplicativeLR(o, lambda step: 1.0 - 1.0 / n),
    "one behind the other": lambda o, n: schedules.SequentialLR(
        o,
        [schedules.LinearLR(o, 0.1, 1.0, n // 3), schedules.CosineAnnealingLR(o, n - n // 3)],
        [n // 3],
    ),
    "one times the other": lambda o, n: schedules.ChainedScheduler(
        [schedules.LinearLR(o, 1.0, 0.1, n), schedules.ExponentialLR(o, 0.9)]
    ),
}


class Scheduled(Line):
    """A line whose learning rate follows a schedule by the step; it keeps the rates."""

    def __init__(self, schedule, steps, rate=0.1):
        super().__init__()
        self.schedule, self.length, self.rate, self.rates = schedule, steps, rate, []

    def configure_optimizers(self):
        optimizer = torch.optim.Adam(self.parameters(), lr=self.rate)
        schedule = SCHEDULES[self.schedule](optimizer, self.length)
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": schedule, "interval": "step"},
        }

    def on_train_batch_start(self, batch, batch_idx):
        self.rates.append(self.optimizers().param_groups[0]["lr"])


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_a_run_resumed_with_more_epochs_follows_their_schedule(tmp_path, schedule):
    """As one that had them from the start does at the same steps."""
    kept = [every_step(tmp_path), ResumedEpochs(), ResumedSchedules()]
    whole = fit(Scheduled(schedule, 9), tmp_path / "whole", epochs=3)
    fit(Scheduled(schedule, 6), tmp_path, *kept)
    last = tmp_path / "step=6.ckpt"
    more = fit(Scheduled(schedule, 9), tmp_path / "more", *kept[1:], checkpoint=last, epochs=3)
    assert more.rates == pytest.approx(whole.rates[6:], rel=1e-12)
    (of_whole,), (of_more,) = whole.trainer.lr_scheduler_configs, more.trainer.lr_scheduler_configs
    assert of_more.scheduler.get_last_lr() == pytest.approx(of_whole.scheduler.get_last_lr())


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_a_run_resumed_with_the_same_epochs_is_the_same_to_the_bit(tmp_path, schedule):
    kept = [every_step(tmp_path), ResumedEpochs(), ResumedSchedules()]
    whole = fit(Scheduled(schedule, 6), tmp_path, *kept)
    for step in (1, 2, 4, 5):  # in the first epoch of three steps, and in the second
        folder, middle = tmp_path / str(step), tmp_path / f"step={step}.ckpt"
        again = fit(Scheduled(schedule, 6), folder, *kept[1:], checkpoint=middle)
        assert again.rates == whole.rates[step:] and torch.equal(again.weight, whole.weight)


def test_a_resumed_run_keeps_the_learning_rate_that_it_had(tmp_path):
    kept = [every_step(tmp_path), ResumedSchedules()]
    fit(Scheduled("cosine", 6), tmp_path, *kept)
    whole = fit(Scheduled("cosine", 9), tmp_path / "whole", epochs=3)
    more = Scheduled("cosine", 9, rate=0.7)
    fit(more, tmp_path / "more", kept[1], checkpoint=tmp_path / "step=6.ckpt", epochs=3)
    assert more.rates == pytest.approx(whole.rates[6:], rel=1e-12)


def test_a_schedule_that_is_over_before_the_checkpoint_is_named(tmp_path):
    fit(Scheduled("one cycle", 6), tmp_path, every_step(tmp_path))
    with pytest.raises(InputError, match="ckpt_path: scheduler: Tried to step 4 times"):
        short, last = Scheduled("one cycle", 3), tmp_path / "step=6.ckpt"
        fit(short, tmp_path / "more", ResumedSchedules(), checkpoint=last, epochs=3)


def test_a_run_that_has_nothing_left_to_train_keeps_the_checkpoint(tmp_path, caplog):
    fit(Line(), tmp_path, every_step(tmp_path))
    last = LastCheckpoint(tmp_path / "more", filename="last")
    fit(Line(), tmp_path / "more", last, checkpoint=tmp_path / "step=6.ckpt")
    assert (tmp_path / "more/last.ckpt").read_bytes() == (tmp_path / "step=6.ckpt").read_bytes()
    assert "nothing is left to train" in caplog.text

"""Trainings that leave the finite numbers, and trainings that are resumed more than once."""

import lightning
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from torch.utils.data import DataLoader, TensorDataset

from dolens.errors import InputError
from dolens.experiments.callbacks.finite_training import FiniteTraining
from dolens.experiments.callbacks.last_checkpoint import LastCheckpoint
from dolens.experiments.callbacks.resumed_epochs import ResumedEpochs

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

import logging

import lightning
import pytest
import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint

from dolens.errors import InputError
from dolens.experiments.data.camera_data import CropDataModule
from dolens.experiments.data.photographs import Photograph

STEPS = 5
pytestmark = pytest.mark.filterwarnings(
    "ignore:.*does not have many workers", "ignore:.*suggested max number of worker"
)


class _Data(CropDataModule):
    def load_split(self, split):
        generator = torch.Generator().manual_seed(len(split))
        encoded = torch.randint(0, 256, (3, 3, 16, 16), generator=generator, dtype=torch.uint8)
        return [Photograph(f"{split} {number}", one) for number, one in enumerate(encoded)]


class _Linear(lightning.LightningModule):
    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(3 * 6 * 6, 1)
        torch.nn.init.constant_(self.layer.weight, 0.01)
        torch.nn.init.zeros_(self.layer.bias)
        self.seen = []
        self.epochs = []

    def training_step(self, batch, batch_idx):
        self.seen.append(batch.clone())
        self.epochs.append((self.current_epoch, batch_idx))
        return (self.layer(batch.flatten(1)) - 1).square().mean()

    def validation_step(self, batch, batch_idx):
        self.log("val/loss", self.layer(batch.flatten(1)).mean())

    def configure_optimizers(self):
        return torch.optim.Adam(self.parameters(), lr=0.1)


class _Fail(Callback):
    """Saves in the middle of a batch, as an exception checkpoint does, and stops there."""

    def __init__(self, path, batch):
        self.path, self.batch = path, batch

    def on_train_batch_start(self, trainer, module, batch, batch_idx):
        if trainer.fit_loop.epoch_loop.batch_progress.total.ready == self.batch + 1:
            trainer.save_checkpoint(self.path)
            raise RuntimeError("power cut")


def _data(**changes):
    arguments = {
        "crop_size": (4, 4),
        "margin": 1,
        "batch_size": 2,
        "steps_per_epoch": STEPS,
        "evaluation_crops_per_photograph": 1,
        "seed": 7,
    }
    return _Data(**{**arguments, **changes})


def _fit(folder, data=None, callbacks=(), resume=None, **options):
    module = _Linear()
    if "max_steps" not in options:
        options.setdefault("max_epochs", 2)
    trainer = lightning.Trainer(
        default_root_dir=folder,
        accelerator="cpu",
        logger=False,
        callbacks=list(callbacks),
        enable_checkpointing=bool(callbacks),
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        **options,
    )
    trainer.fit(module, datamodule=data or _data(), ckpt_path=resume, weights_only=True)
    return module, trainer


def _every_step(folder):
    return ModelCheckpoint(folder, "{step}", save_top_k=-1, every_n_train_steps=1)


def _same(resumed, whole, first):
    assert resumed.epochs == whole.epochs[first:]
    assert torch.equal(torch.stack(resumed.seen), torch.stack(whole.seen[first:]))
    assert torch.equal(resumed.layer.weight, whole.layer.weight)
    assert torch.equal(resumed.layer.bias, whole.layer.bias)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    callbacks = [
        _every_step(folder),
        ModelCheckpoint(
            folder, "epoch-{step}", save_top_k=-1, every_n_epochs=1, save_on_train_epoch_end=True
        ),
    ]
    module, _ = _fit(folder, callbacks=callbacks)
    return folder, module


def test_an_uninterrupted_run_sees_the_numbered_samples(whole):
    _, module = whole
    data = _data()
    dataset = data.train_dataloader().dataset
    expected = torch.stack([dataset[index] for index in range(2 * STEPS * 2)])
    assert torch.equal(torch.cat(module.seen), expected)
    assert expected.shape[1:] == (3, 6, 6)
    assert module.epochs == [(epoch, step) for epoch in range(2) for step in range(STEPS)]


@pytest.mark.parametrize("step", [1, 3, 4, 5, 6, 7, 9])
def test_a_resumed_run_equals_an_uninterrupted_one(whole, tmp_path, step):
    folder, module = whole
    resumed, _ = _fit(tmp_path, resume=folder / f"step={step}.ckpt")
    _same(resumed, module, step)


def test_resuming_from_the_end_of_an_epoch(whole, tmp_path):
    folder, module = whole
    resumed, _ = _fit(tmp_path, resume=folder / f"epoch-step={STEPS}.ckpt")
    _same(resumed, module, STEPS)


@pytest.mark.parametrize("step", [3, 5])
def test_workers_that_read_ahead_do_not_shift_the_samples(whole, tmp_path, step):
    _, module = whole
    ahead, _ = _fit(tmp_path, _data(num_workers=2), [_every_step(tmp_path)])
    _same(ahead, module, 0)
    resumed, _ = _fit(tmp_path, _data(num_workers=2), resume=tmp_path / f"step={step}.ckpt")
    _same(resumed, module, step)


def test_an_interrupted_batch_is_seen_again(whole, tmp_path):
    _, module = whole
    path = tmp_path / "cut.ckpt"
    with pytest.raises(RuntimeError, match="power cut"):
        _fit(tmp_path, callbacks=[_Fail(path, 7)])
    resumed, _ = _fit(tmp_path, resume=path)
    _same(resumed, module, 7)


# Options of the trainer and of the data, steps to resume from, and batches of a step.
RUNS = {
    "with validation in between": ({"val_check_interval": 2}, {}, (2, 4, 5, 6), 1),
    "limited by steps": ({"max_steps": 12}, {}, (3, 5, 7), 1),
    "of fewer batches": ({"limit_train_batches": 3}, {}, (2,), 1),
    "by accumulated gradients": ({"accumulate_grad_batches": 2}, {"steps_per_epoch": 6}, (2,), 2),
}


@pytest.mark.parametrize("case", RUNS)
def test_resuming_other_runs(tmp_path, case):
    options, data, steps, batches = RUNS[case]
    module, _ = _fit(tmp_path, _data(**data), callbacks=[_every_step(tmp_path)], **options)
    dataset = _data().train_dataloader().dataset
    expected = torch.stack([dataset[index] for index in range(2 * len(module.seen))])
    assert torch.equal(torch.cat(module.seen), expected)  # no sample is wasted
    for step in steps:
        checkpoint = tmp_path / f"step={step}.ckpt"
        resumed, _ = _fit(tmp_path / "again", _data(**data), resume=checkpoint, **options)
        _same(resumed, module, batches * step)


@pytest.mark.parametrize("step", [2, 4])
def test_resuming_from_a_checkpoint_written_by_validation(tmp_path, step):
    options = {"val_check_interval": 2}
    best = ModelCheckpoint(tmp_path, "{step}", save_top_k=-1, monitor="val/loss")
    module, _ = _fit(tmp_path, callbacks=[best], **options)
    resumed, _ = _fit(tmp_path, resume=tmp_path / f"step={step}.ckpt", **options)
    _same(resumed, module, step)


def test_samples_outlive_a_slip_of_lightning_in_the_count_of_epochs(tmp_path):
    # Lightning 2.6.6 appends a batch to the closed epoch when a run limited by steps, without
    # validation, resumes from the end of an epoch.  Samples and weights must not care.
    options = {"max_steps": 12, "limit_val_batches": 0}
    ends = ModelCheckpoint(
        tmp_path, "{step}", save_top_k=-1, every_n_epochs=1, save_on_train_epoch_end=True
    )
    module, _ = _fit(tmp_path, callbacks=[ends], **options)
    resumed, _ = _fit(tmp_path, resume=tmp_path / "step=5.ckpt", **options)
    assert torch.equal(torch.stack(resumed.seen), torch.stack(module.seen[5:]))
    assert torch.equal(resumed.layer.weight, module.layer.weight)


def test_resuming_with_other_samples_is_said(whole, tmp_path, caplog):
    folder, _ = whole
    with caplog.at_level(logging.WARNING):
        _fit(tmp_path, _data(seed=8), resume=folder / "step=3.ckpt")
    assert any("resuming with seed 8, the checkpoint" in text for text in caplog.messages)


def test_what_would_replace_the_sampler_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"trainer\.overfit_batches: 1"):
        _fit(tmp_path, overfit_batches=1)

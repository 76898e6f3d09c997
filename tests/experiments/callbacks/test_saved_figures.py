"""The callback that saves and logs figures: when, under which names, and when some fail."""

import logging
from types import SimpleNamespace

import pytest
import torch
from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from dolens.errors import InputError
from dolens.experiments.callbacks.saved_figures import SaveFigures
from dolens.experiments.experiment import Experiment
from dolens.experiments.loggers.trackers import TensorBoard


class Drawn(Experiment):
    """Counts what is drawn."""

    def __init__(self, figures, training=()):
        super().__init__(torch.nn.Identity())
        self.after, self.during, self.count = tuple(figures), tuple(training), 0

    def figures(self):
        return {name: lambda name=name: self._draw(name) for name in self.after}

    def training_figures(self):
        return {name: lambda name=name: self._draw(name) for name in self.during}

    def _draw(self, name):
        self.count += 1
        if name == "refused":
            raise InputError("this lens has no such figure")
        if name == "broken":
            raise ZeroDivisionError("nothing to divide by")
        figure = Figure(figsize=(1.0, 1.0))
        figure.text(0.5, 0.5, "$\\unknown$" if name == "unprintable" else name)
        return figure


class Unlisted(Drawn):
    def figures(self):
        raise ZeroDivisionError("nothing to divide by")


@pytest.fixture
def trainer(tmp_path):
    board = TensorBoard(str(tmp_path))
    return SimpleNamespace(
        loggers=[board], current_epoch=0, max_epochs=8, global_step=0, sanity_checking=False
    )


def logged(trainer, tmp_path):
    """Step → tags of the images that TensorBoard has."""
    trainer.loggers[0].finalize("success")
    found = EventAccumulator(str(tmp_path), size_guidance={"images": 0})
    found.Reload()
    return {tag: [e.step for e in found.Images(tag)] for tag in found.Tags()["images"]}


def saved(folder):
    return {path.name for path in folder.iterdir()} if folder.exists() else set()


def test_figures_of_training_come_at_their_interval_and_after_the_last_epoch(trainer, tmp_path):
    module = Drawn(["images", "layout"], training=["images"])
    callback = SaveFigures(tmp_path / "figures", every_n_epochs=3)
    for epoch in range(trainer.max_epochs):
        trainer.current_epoch = trainer.global_step = epoch
        callback.on_validation_end(trainer, module)
    assert module.count == 4
    assert not saved(tmp_path / "figures")
    assert logged(trainer, tmp_path) == {"figures/images": [0, 3, 6, 7]}


def test_nothing_is_logged_in_a_sanity_check(trainer, tmp_path):
    module = Drawn([], training=["images"])
    trainer.sanity_checking = True
    SaveFigures(tmp_path / "figures").on_validation_end(trainer, module)
    assert module.count == 0


def test_figures_of_the_test_are_saved_and_kept_apart_from_those_of_training(trainer, tmp_path):
    module = Drawn(["images", "layout"], training=["images"])
    SaveFigures(tmp_path / "figures").on_test_end(trainer, module)
    assert saved(tmp_path / "figures") == {"images.png", "layout.png"}
    assert set(logged(trainer, tmp_path)) == {"figures/test_images", "figures/layout"}
    assert module.count == 2


def test_a_figure_that_fails_is_named_and_costs_no_other(trainer, tmp_path, caplog):
    module = Drawn(["refused", "broken", "unprintable", "layout"])
    with caplog.at_level(logging.WARNING):
        SaveFigures(tmp_path / "figures").on_test_end(trainer, module)
    assert saved(tmp_path / "figures") == {"layout.png"}
    refused, broken, unprintable = caplog.records
    assert refused.getMessage() == "No figure 'refused': this lens has no such figure"
    assert refused.levelname == "WARNING" and refused.exc_info is None
    assert "'broken'" in broken.getMessage() and broken.exc_info[0] is ZeroDivisionError
    assert "'unprintable'" in unprintable.getMessage() and unprintable.levelname == "ERROR"


def test_a_list_of_figures_that_fails_is_logged(trainer, tmp_path, caplog):
    SaveFigures(tmp_path / "figures").on_test_end(trainer, Unlisted([]))
    (record,) = caplog.records
    assert record.exc_info[0] is ZeroDivisionError
    assert not saved(tmp_path / "figures")


def test_an_experiment_without_figures_has_none(trainer, tmp_path):
    module = Experiment(torch.nn.Identity())
    callback = SaveFigures(tmp_path / "figures")
    callback.on_validation_end(trainer, module)
    callback.on_test_end(trainer, module)
    assert not saved(tmp_path / "figures")


def test_the_interval_is_at_least_one_epoch(tmp_path):
    with pytest.raises(InputError, match="every_n_epochs: 0; allowed: 1 or more"):
        SaveFigures(tmp_path, every_n_epochs=0)


def test_figures_are_saved_in_the_formats_of_the_configuration(trainer, tmp_path):
    module = Drawn(["layout"])
    SaveFigures(tmp_path / "figures", formats=["png", "pdf"]).on_test_end(trainer, module)
    assert saved(tmp_path / "figures") == {"layout.png", "layout.pdf"}
    assert set(logged(trainer, tmp_path)) == {"figures/layout"}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"formats": ["gif"]}, "formats"),
        ({"formats": []}, "allowed: a list of png, pdf, svg"),
        ({"formats": "png"}, "allowed: a list of png, pdf, svg"),
        ({"dpi": 0.0}, "dpi: 0.0; allowed: more than 0"),
    ],
)
def test_formats_and_resolutions_that_cannot_be_are_refused(tmp_path, settings, message):
    with pytest.raises(InputError, match=message):
        SaveFigures(tmp_path, **settings)

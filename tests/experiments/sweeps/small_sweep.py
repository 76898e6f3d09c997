"""Sweeps of jobs without PyTorch, for tests of what runs them."""

from pathlib import Path

from hydra import initialize_config_dir
from hydra._internal.callbacks import Callbacks
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.types import HydraContext, RunMode
from omegaconf import OmegaConf

from dolens.experiments.running.user_configuration import use_working_folder
from dolens.experiments.sweeps.launch import OwnBasicLauncher

ROOT = Path(__file__).resolve().parents[3]
SETTINGS = {"value": 0, "act": "finish", "objective": "score", "threads": None, "ckpt_path": None}


def small_task():
    """A job without PyTorch; a function within one goes to other processes by its code."""

    def task(cfg):
        import json
        import os
        import signal
        from pathlib import Path

        from hydra.core.hydra_config import HydraConfig
        from omegaconf import OmegaConf

        hydra = HydraConfig.get()
        folder = Path(hydra.runtime.output_dir)
        (folder / ".hydra").mkdir(exist_ok=True)
        OmegaConf.save(cfg, folder / ".hydra" / "resolved.yaml")
        with (folder / "begun").open("a") as file:
            file.write(f"{hydra.mode.name} {os.environ.get('OMP_NUM_THREADS')} {cfg.ckpt_path}\n")
        (folder / "run.json").write_text('{"status": "running"}')
        first = len((folder / "begun").read_text().splitlines()) == 1
        if cfg.act == "kill" or (cfg.act == "kill_once" and first):
            os.kill(os.getpid(), signal.SIGKILL)
        if cfg.act == "wait" and first:
            signal.pause()
        if cfg.act == "fail":
            raise ValueError("this job fails")
        (folder / "metrics.json").write_text(json.dumps({"score": float(cfg.value)}))
        (folder / "run.json").write_text('{"status": "finished"}')
        return float(cfg.value)

    return task


def sweep(folder: Path, launcher: str, jobs: list[str], *options: str) -> list[float]:
    """Launch jobs as a sweeper of Hydra's does, with files of conf/hydra/launcher."""
    conf = folder / "conf"
    conf.mkdir(exist_ok=True)
    OmegaConf.save(OmegaConf.create(SETTINGS), conf / "sweep.yaml")
    use_working_folder()
    overrides = [
        f"hydra/launcher={launcher}",
        f"hydra.searchpath=[file://{ROOT / 'conf'}]",
        f"hydra.sweep.dir={folder / 'jobs'}",
        "hydra.mode=MULTIRUN",
        "hydra.sweep.subdir=${hydra.job.num}",
        "hydra.job_logging.root.handlers=[file]",
        "hydra.job_logging.handlers.file.filename=${hydra.runtime.output_dir}/log.txt",
        *options,
    ]
    with initialize_config_dir(str(conf), version_base="1.3"):
        loader = GlobalHydra.instance().config_loader()
        config = loader.load_configuration("sweep", overrides, run_mode=RunMode.MULTIRUN)
        OwnBasicLauncher().on_multirun_start(config)
        found = Plugins.instance().instantiate_launcher(
            HydraContext(config_loader=loader, callbacks=Callbacks()), small_task(), config
        )
        try:
            returns = found.launch([job.split() for job in jobs], 0)
            return [one.return_value for one in returns]
        finally:
            HydraConfig.instance().cfg = None

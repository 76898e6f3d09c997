"""Workers are processes that share independent tasks: in this one, or over Ray."""

from dolens.experiments.workers.workers import Workers, workers_of

__all__ = ["Workers", "workers_of"]

"""Hydra finds its plugins in the namespace package `hydra_plugins`; this one searches by Optuna."""

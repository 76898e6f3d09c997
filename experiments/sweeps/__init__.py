"""The jobs of a sweep in processes, on machines of a cluster, and again after a kill.

`hydra_plugins.dolens_launchers` has the launchers that Hydra finds; they call these modules.
"""

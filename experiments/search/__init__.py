"""A search for the best values of a configuration: Optuna proposes, jobs of a sweep try."""

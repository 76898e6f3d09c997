"""Lightning modules, data modules and callbacks: the glue between dolens and a training run."""

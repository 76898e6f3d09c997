"""What the commands about finished runs do; `dolens.cli` has their options."""

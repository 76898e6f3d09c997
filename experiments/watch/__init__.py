"""A run is watched on a page: while it works, when it has ended, and through its history."""

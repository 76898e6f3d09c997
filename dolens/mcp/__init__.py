"""A server of the Model Context Protocol: programs design lenses with dolens over stdio.

`server` answers by the `tools` of a `session`, `folder` confines its files, and a `worker` runs
`jobs`, `design` and `analyses` in a process of its own, for a time at most.
"""

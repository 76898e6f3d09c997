"""The report: every system of the supplement run, compared with what is printed, on one page."""

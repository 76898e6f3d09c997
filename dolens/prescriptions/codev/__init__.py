"""CODE V sequence files (`.seq`) are read and written."""

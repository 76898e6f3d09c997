"""The report's page: pure functions from finished runs to HTML."""

"""`python -m dolens` is the command `dolens`."""

from dolens.cli.app import main

main()

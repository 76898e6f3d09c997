"""`python -m dolens.cli` is the command `dolens`."""

from dolens.cli.app import main

main()

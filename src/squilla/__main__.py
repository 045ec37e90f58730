"""``python -m squilla``: the command line."""

from squilla.cli import main

main()

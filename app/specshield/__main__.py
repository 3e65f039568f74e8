"""`python -m specshield` is the command `specshield`."""

from specshield.cli import main

main()

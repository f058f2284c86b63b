"""`python -m saltus` is the program `saltus`."""

from saltus.cli import main

main(prog_name="saltus")

"""`saltus convert`: every decoded item of ASTERIX recordings as a table."""

from saltus.convert.command import convert_files

__all__ = ["convert_files"]

"""Text from outside, made fit to be read: what would steer a terminal is spelt out, what is endless is cut."""

import sys

from saltus.streams import silence

__all__ = ["brief", "cut", "say", "shown"]


def shown(name: str) -> str:
    r"""Spell a name so that it is seen and nothing else happens.

    Control characters, directional marks, line ends and halves of characters (of file names that are no UTF-8) become
    their escapes, as `\x1b`; all that prints stays.
    """
    if name.isprintable():
        return name
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in name)


def cut(name: str, most: int = 80) -> str:
    """Spell a name as `shown` does, in at most so many characters."""
    text = shown(name[: most + 1])
    return text if len(text) <= most else text[: most - 3] + "..."


def brief(value: object, most: int = 80) -> str:
    """Write a value as in code, shown, and cut to `most` characters."""
    try:
        return cut(repr(value), most)
    except ValueError:  # an integer of more digits than Python writes
        return f"a {type(value).__name__} too long to be written"


def say(text: str, *, err: bool = False) -> None:
    """Print lines; everything that the program writes as plain text goes out here.

    Args:
        text: lines; what is unprintable in them is spelt out.
        err: to standard error; what nobody reads there, or cannot be written, is lost and nothing else.
    """
    import click

    lines = "\n".join(shown(line) for line in text.split("\n"))
    try:
        click.echo(lines, err=err)
    except OSError:
        if not err:
            raise
        silence(sys.stderr)

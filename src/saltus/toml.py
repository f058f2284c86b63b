"""A TOML file as tables, whatever its bytes are."""

import re
import tomllib
from pathlib import Path

from saltus.errors import ModelError

__all__ = ["LARGEST", "load_toml"]

LARGEST = 4_000_000  # bytes of a file that people wrote


def load_toml(path: Path | str) -> dict[str, object]:
    """Read a TOML file.

    Raises:
        ModelError: it is larger than `LARGEST`, no UTF-8, no TOML, nested too deep or holds a number too long; the
            message names the file and, where the parser tells it, line and column.
    """
    path = Path(path)
    with path.open("rb") as file:
        content = file.read(LARGEST + 1)
    if len(content) > LARGEST:
        raise ModelError(f"{path}: longer than {LARGEST} bytes, so no configuration and no model; is it another file?")
    try:
        return tomllib.loads(content.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise ModelError(f"{path}: no readable TOML: byte {error.start} is no UTF-8; save it as UTF-8.") from error
    except RecursionError as error:
        raise ModelError(f"{path}: no readable TOML: tables or lists are nested too deep.") from error
    except tomllib.TOMLDecodeError as error:
        raise ModelError(f"{path}: no readable TOML: {error}.") from error
    except ValueError as error:  # int() and datetime say it so
        long = re.search(rb"[0-9_]{1000,}", content)
        line = f" (line {1 + content[: long.start()].count(10)})" if long else ""
        said = f"a number has too many digits{line}" if "digits" in str(error) else str(error)
        raise ModelError(f"{path}: no readable TOML: {said}.") from error

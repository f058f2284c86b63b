"""What a user may set of the reading of recordings; every field is a key of the configuration's [reading] table."""

from dataclasses import dataclass

from saltus.errors import ModelError

__all__ = ["ReadingSettings"]


@dataclass(frozen=True, slots=True)
class ReadingSettings:
    """Bounds of reading.

    Attributes:
        memory: bytes that one file may take while it is read, the reports that it becomes among them. A file that
            would take more is refused before it is read, or, where its size tells too little, as soon as it does.
    """

    memory: float = 4e9

    def __post_init__(self) -> None:
        """Refuse settings that cannot be."""
        if not self.memory >= 1e6:
            raise ModelError(f"reading.memory is a number of bytes, 1e6 or more: {self.memory}.")

"""`saltus info`: what is in recordings."""

from saltus.info.command import show_info

__all__ = ["show_info"]

"""ASTERIX as bytes: layouts of all categories and editions, and the codec between data blocks and columns.

What items mean for tracking is not known here; that is `saltus.io`.
"""

__all__: list[str] = []

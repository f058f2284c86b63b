"""Array shapes in annotations: checked by jaxtyping in tests, shown in the documentation, and free elsewhere.

`Float[np.ndarray, "*lead n n"]` is jaxtyping's type where jaxtyping was imported before Saltus, as its pytest plugin
and docs/conf.py do. Everywhere else it is the bare `np.ndarray`: no program pays for types that nobody executes.
"""

import sys
from typing import TYPE_CHECKING

__all__ = ["Bool", "Float", "Int", "Shaped"]

if TYPE_CHECKING or "jaxtyping" in sys.modules:
    from jaxtyping import Bool, Float, Int, Shaped
else:

    class _Unchecked:
        def __getitem__(self, item: tuple[type, str]) -> type:
            """Return the array type of `Float[array, "shape"]`."""
            return item[0]

    Bool = Float = Int = Shaped = _Unchecked()

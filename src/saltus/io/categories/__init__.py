"""What becomes of each ASTERIX category: one file for each that gives reports, one line here for each."""

from saltus.io.categories.cat001 import CAT001
from saltus.io.categories.cat010 import CAT010
from saltus.io.categories.cat011 import CAT011
from saltus.io.categories.cat020 import CAT020
from saltus.io.categories.cat021 import CAT021
from saltus.io.categories.cat048 import CAT048
from saltus.io.categories.cat062 import CAT062
from saltus.io.categories.services import SERVICES

__all__ = ["CATEGORIES"]

CATEGORIES = {c.number: c for c in (CAT001, CAT010, CAT011, CAT020, CAT021, CAT048, CAT062, *SERVICES)}

"""The search for effects: candidates, what each would gain, what it takes to believe it, and what would do as well."""

from triaxcal.search.alternatives import NEAR, alternatives
from triaxcal.search.apart import telling_apart
from triaxcal.search.comparison import NO_LOWER, compared
from triaxcal.search.search import Nearest, Search
from triaxcal.search.worth import FAMILYWISE, Model, deviance

__all__ = [
    "FAMILYWISE",
    "NEAR",
    "NO_LOWER",
    "Model",
    "Nearest",
    "Search",
    "alternatives",
    "compared",
    "deviance",
    "telling_apart",
]

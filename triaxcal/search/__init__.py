"""The search for effects: candidates, what each would gain, what it takes to believe it, and what would do as well."""

from triaxcal.search.alternatives import NEAR, alternatives
from triaxcal.search.apart import telling_apart
from triaxcal.search.coincidence import FAILED, coincidence, coincidence_of_spoiled
from triaxcal.search.comparison import NO_LOWER, compared
from triaxcal.search.left_out import LeftOut
from triaxcal.search.search import Nearest, Search
from triaxcal.search.worth import FAMILYWISE, Model, deviance

__all__ = [
    "FAILED",
    "FAMILYWISE",
    "NEAR",
    "NO_LOWER",
    "LeftOut",
    "Model",
    "Nearest",
    "Search",
    "alternatives",
    "coincidence",
    "coincidence_of_spoiled",
    "compared",
    "deviance",
    "telling_apart",
]

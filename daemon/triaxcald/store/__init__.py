"""An index of the outcomes in a station's folder: `triaxcal.sqlite`, table `run`.

The outcomes are the truth. The table is made from them, and made anew where it is
missing, damaged or behind them.
"""

from triaxcald.store.index import History, Runs, Store
from triaxcald.store.rows import microseconds

__all__ = ["History", "Runs", "Store", "microseconds"]

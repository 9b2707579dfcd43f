"""An index of the outcomes in a station's folder: `triaxcal.sqlite`, table `run`.

The outcomes are the truth. The table is made from them, and made anew where it is
missing, damaged or behind them.
"""

from triaxcald.store.database import FILE_NAME, TIMES, VERSION
from triaxcald.store.index import History, Runs, Store, timed_in
from triaxcald.store.rows import BESIDE, microseconds

__all__ = ["BESIDE", "FILE_NAME", "TIMES", "VERSION", "History", "Runs", "Store", "microseconds", "timed_in"]

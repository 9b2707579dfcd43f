"""Computes a recording's result again from the recording alone, and finds where
anything in it says otherwise.

What is found are values; `triaxcald.audit.text` makes lines of them, which
nothing reads back.
"""

from triaxcald.audit.conduct import Audit, audit

__all__ = ["Audit", "audit"]

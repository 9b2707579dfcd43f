"""Computes a recording's result again from the recording alone, and finds where
anything in it says otherwise.

What is found are values; `triaxcald.audit.text` makes lines of them, which
nothing reads back.
"""

from triaxcald.audit.conduct import Audit, audit
from triaxcald.audit.many import Audited, audit_each, to_audit, worst

__all__ = ["Audit", "Audited", "audit", "audit_each", "to_audit", "worst"]

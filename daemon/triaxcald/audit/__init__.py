"""Computes a recording's result again from the recording alone, and finds where
anything in it says otherwise.

What is found are values; `triaxcald.audit.text` makes lines of them, which
nothing reads back.
"""

from triaxcald.audit.chain import ChainAudit, audit_chain, chains_in
from triaxcald.audit.conduct import Audit, audit
from triaxcald.audit.many import Audited, audit_each, to_audit, worst
from triaxcald.audit.signature import Policy

__all__ = [
    "Audit",
    "Audited",
    "ChainAudit",
    "Policy",
    "audit",
    "audit_chain",
    "audit_each",
    "chains_in",
    "to_audit",
    "worst",
]

"""Computes a recording's result again from the recording alone, and finds where
anything in it says otherwise.

What is found are values; `triaxcald.audit.text` makes lines of them, which
nothing reads back.
"""

from triaxcald.audit.chain import ChainAudit, audit_chain, chains_in
from triaxcald.audit.conduct import Audit, audit
from triaxcald.audit.signature import Policy

__all__ = ["Audit", "ChainAudit", "Policy", "audit", "audit_chain", "chains_in"]

"""What a device holds, and what shows it. Values alone: `triaxcald.text` puts
them into words."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class DeviceState(StrEnum):
    """Which calibration the device starts with, as far as anybody can vouch for
    it."""

    UNTOUCHED = "untouched"
    """No calibration register was written."""
    OLD = "old"
    """Something was written, and the old calibration is back."""
    NEW_VERIFIED = "new_verified"
    """Read back equal after a restart."""
    NEW_UNVERIFIED = "new_unverified"
    """The store was acknowledged and the registers read back equal; no restart
    has proven it."""
    MIXED = "mixed"
    """The registers are known to be neither the old ones nor the new ones."""
    UNKNOWN = "unknown"
    """The link died, or a store went unanswered, and no read decided."""


class Evidence(StrEnum):
    """What the state rests on."""

    NOTHING_WRITTEN = "nothing_written"
    NOTHING_STORED = "nothing_stored"
    """The registers in use read back equal, and no store was asked for."""
    READ_BACK = "read_back"
    """The registers read back equal, with no restart since they were written."""
    RESTART = "read_after_restart"
    POWER_CYCLE = "read_after_power_cycle"
    WRITE_COUNTER = "write_counter"
    """The store went unanswered; the device's counter of stores shows that it
    took place, or did not."""
    NO_ANSWER = "no_answer"


@dataclass
class Held:
    """What the device holds, at any moment: true also when nobody gets to
    change it any more."""

    state: DeviceState = DeviceState.UNTOUCHED
    evidence: Evidence = Evidence.NOTHING_WRITTEN

    def now(self, state: DeviceState, evidence: Evidence) -> None:
        self.state, self.evidence = state, evidence

    @property
    def settled(self) -> bool:
        """Whether nothing is left to be cleared up."""
        if self.state is DeviceState.OLD:
            return self.evidence is not Evidence.READ_BACK
        return self.state in (DeviceState.UNTOUCHED, DeviceState.NEW_VERIFIED)

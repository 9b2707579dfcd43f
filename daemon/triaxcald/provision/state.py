"""State of a device's registers, and the evidence for it. Values alone:
`triaxcald.text` puts them into words."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum


class DeviceState(StrEnum):
    """The calibration with which the device starts, as far as it is known."""

    UNTOUCHED = "untouched"
    """No calibration register was written."""
    OLD = "old"
    """Something was written, and the old calibration is back."""
    NEW_VERIFIED = "new_verified"
    """All registers read back equal after a restart that removed a probe, or
    after the supply was seen off."""
    NEW_UNVERIFIED = "new_unverified"
    """The store was acknowledged, or every write lasts, and the registers read
    back equal; no restart has proven it."""
    MIXED = "mixed"
    """The registers are known to be neither the old ones nor the new ones."""
    UNKNOWN = "unknown"
    """The link died, or a store went unanswered, and no read decided; or an
    earlier cut was not settled."""


class Observation(StrEnum):
    """An observation since the last write of the registers. Observations are
    independent: none implies another."""

    ACKNOWLEDGED = "acknowledged"
    """The device acknowledged the store."""
    COUNTER_ADVANCED = "counter_advanced"
    """The device's counter of stores advanced with the store."""
    READ_BACK = "read_back"
    """All calibration registers read back as wanted."""
    MARK_GONE = "mark_gone_after_restart"
    """A value that was in use, and stored nowhere, was gone after a restart."""
    SUPPLY_SWITCHED = "supply_switched"
    """The device went silent, as it does without supply, and answered again."""


class Evidence(StrEnum):
    """Evidence for the state of a device."""

    NOTHING_WRITTEN = "nothing_written"
    """No calibration register was written."""
    NOTHING_STORED = "nothing_stored"
    """The registers in use read back equal, and no store was asked for."""
    READ_BACK = "read_back"
    """The registers read back equal, with no restart since they were written."""
    RESTART = "read_after_restart"
    """All registers were read after a restart that removed a probe."""
    POWER_CYCLE = "read_after_power_cycle"
    """All registers were read after the supply was seen off."""
    WRITE_COUNTER = "write_counter"
    """The store went unanswered; the device's counter of stores shows that it
    took place, or did not."""
    NO_ANSWER = "no_answer"
    """No read decided."""


@dataclass
class Held:
    """State of the device at any moment, correct also if the process ends now."""

    state: DeviceState = DeviceState.UNTOUCHED
    evidence: Evidence = Evidence.NOTHING_WRITTEN
    observed: set[Observation] = field(default_factory=set)

    def now(self, state: DeviceState, evidence: Evidence) -> None:
        self.state, self.evidence = state, evidence

    def saw(self, observation: Observation) -> None:
        self.observed.add(observation)

    @property
    def observations(self) -> list[Observation]:
        """In the order of `Observation`."""
        return [o for o in Observation if o in self.observed]

    @property
    def settled(self) -> bool:
        """Whether the state is known and needs no further work."""
        if self.state is DeviceState.OLD:
            return self.evidence is not Evidence.READ_BACK
        return self.state in (DeviceState.UNTOUCHED, DeviceState.NEW_VERIFIED)

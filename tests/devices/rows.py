"""Devices that misbehave, one a row: what each holds in the end, how `provision` ends, and what it says.

docs/reference/misbehaving-devices.md shows the same table.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from tests.devices.bench import Transport
from tests.devices.habits import Habits
from tests.devices.memory import PRODUCT_CODE
from tests.devices.motion import Motion
from tests.devices.place import Trouble
from tests.devices.profiles import Timing, Wording
from tests.devices.table import OLD, Coefficients

Holds = Literal["old", "new", "neither"]
PATIENT = Timing(reply_s=5.0, silence_s=10.0, store_poll_s=10.0, reconnect_s=10.0)
"""For devices that answer: a machine that is busy otherwise makes no difference."""
QUICK = Timing(reply_s=0.3, silence_s=0.6)
"""For devices that do not answer: the wait is over soon."""
ABSURD = Coefficients((-2.4e6, -2.38e6, -2.42e6), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
NO_OUTPUT = Wording(corrected=False, readings="before")
"""Requests then come in one order, each time: the 28th to the 37th write the registers."""
BARE = Habits(store_command=False, reset_command=False, unlock=False)


@dataclass(frozen=True)
class Row:
    """``state`` and ``exit_code`` as the outcome has them, ``says`` a part of its reason or of the error line.

    ``holds`` is what the device starts with after a loss of power, by its memory cells. ``settings`` are of `Bench`.
    ``supply``: the operator switches it off and on when asked.
    """

    does: str
    holds: Holds
    state: str
    exit_code: int
    says: str
    transport: Transport = "tcp"
    arguments: tuple[str, ...] = ()
    supply: bool = False
    settings: Mapping[str, Any] = field(default_factory=dict)


def row(
    does: str, holds: Holds, state: str, exit_code: int, says: str, *arguments: str, habits: Habits | None = None,
    timing: Timing = PATIENT, transport: Transport = "tcp", supply: bool = False, **settings: Any,
) -> Row:  # fmt: skip
    settings |= {"habits": habits or Habits(), "timing": timing}
    return Row(does, holds, state, exit_code, says, transport, arguments, supply, settings)


RESTARTED = "read back after a restart"
UNPROVEN = "no restart has proven it"
ONLY_6 = "no answer to function 16; does the device support only 6? (single_write)"
OLD_BACK = "the device holds the old calibration"

# fmt: off
ROWS = (
    # Devices that do what they should, each in its own way.
    row("does everything right (Modbus TCP)", "new", "new_verified", 0, RESTARTED),
    row("does everything right (Modbus RTU)", "new", "new_verified", 0, RESTARTED, transport="rtu"),
    row("does everything right (CANopen)", "new", "new_verified", 0, RESTARTED, transport="canopen"),
    row("has no restart", "new", "new_unverified", 0, UNPROVEN, habits=Habits(reset_command=False)),
    row("has no restart; its supply is switched", "new", "new_verified", 0, "after a power cycle", "--power-cycle",
        habits=Habits(reset_command=False, restart_s=2.0), supply=True, timing=QUICK),
    row("writes straight to the EEPROM, has no restart", "new", "new_unverified", 0, UNPROVEN, habits=BARE),
    row("writes straight to the EEPROM", "new", "new_unverified", 0, UNPROVEN, habits=Habits(store_command=False)),
    row("holds the calibration already", "old", "new_verified", 0, "only scale_factor_x was written", wanted=OLD),
    row("is blank, all 0xFF", "new", "new_verified", 0, RESTARTED, habits=Habits(blank=0xFF)),
    row("is blank, all 0x00", "new", "new_verified", 0, RESTARTED, habits=Habits(blank=0x00), transport="canopen"),
    row("restarts for half a second", "new", "new_verified", 0, RESTARTED, habits=Habits(restart_s=0.5),
        transport="canopen", timing=Timing(reply_s=0.2, reconnect_s=5.0)),
    row("restarts without acknowledging", "new", "new_verified", 0, RESTARTED, habits=Habits(reset_reply=False),
        timing=QUICK),
    row("acknowledges the restart and goes on", "new", "new_unverified", 0, UNPROVEN,
        habits=Habits(reset_ignored=True)),
    row("acknowledges store and restart and does neither", "old", "new_unverified", 0, UNPROVEN,
        habits=Habits(reset_ignored=True, forget_store=True)),
    row("acknowledges store and restart and does neither (CANopen)", "old", "new_unverified", 0, UNPROVEN,
        habits=Habits(reset_ignored=True, forget_store=True), transport="canopen"),
    row("refuses the store, and acknowledges a restart that it ignores", "old", "unknown", 4, "to settle",
        habits=Habits(store_reply="refused", reset_ignored=True)),
    row("checks the checksum before it stores", "new", "new_verified", 0, RESTARTED,
        habits=Habits(checksum_checked=True)),
    # How it stores.
    row("stores slowly and answers meanwhile", "new", "new_verified", 0, RESTARTED, habits=Habits(store_seconds=0.5)),
    row("stores slowly and is busy meanwhile", "new", "new_verified", 0, RESTARTED, habits=Habits(store_seconds=0.5,
        while_storing="busy", second_store_spoils=True)),
    row("stores slowly and is busy meanwhile (CANopen)", "new", "new_verified", 0, RESTARTED,
        habits=Habits(store_seconds=0.5, while_storing="busy", second_store_spoils=True), transport="canopen"),
    row("stores slowly and is silent meanwhile", "new", "new_verified", 0, RESTARTED, habits=Habits(store_seconds=0.5,
        while_storing="silent", second_store_spoils=True), timing=QUICK),
    row("answers the store late, which the profile allows", "new", "new_verified", 0, RESTARTED,
        habits=Habits(store_seconds=1.0, store_blocks=True), timing=Timing(reply_s=0.3, store_reply_s=5.0)),
    row("stores, and never answers the store", "new", "new_verified", 0, RESTARTED,
        habits=Habits(store_reply="none, done", second_store_spoils=True), timing=QUICK),
    row("neither stores nor answers the store", "old", "old", 4, OLD_BACK, habits=Habits(store_reply="none, not done"),
        timing=QUICK),
    row("neither answers the store nor restarts", "old", "unknown", 4, "no read decides",
        habits=Habits(store_reply="none, not done", reset_command=False), timing=QUICK),
    row("counts its stores, does not answer one, has no restart", "new", "new_unverified", 0, "by its own counter",
        habits=Habits(store_reply="none, done", reset_command=False, counter=True), timing=QUICK),
    row("stores and says busy", "new", "new_verified", 0, RESTARTED, habits=Habits(store_reply="busy, done",
        second_store_spoils=True)),
    row("says busy to the store and does not store", "old", "old", 4, OLD_BACK,
        habits=Habits(store_reply="busy, not done")),
    row("refuses the store", "old", "old", 4, OLD_BACK, habits=Habits(store_reply="refused")),
    row("acknowledges the store and forgets", "old", "old", 4, "nothing was stored", habits=Habits(forget_store=True)),
    row("acknowledges the store and forgets (CANopen)", "old", "old", 4, "nothing was stored",
        habits=Habits(forget_store=True), transport="canopen"),
    row("forgets one register", "old", "old", 4, OLD_BACK, habits=Habits(forget_store=frozenset({"bias_z"}))),
    row("forgets, shows what was written, has no restart", "old", "new_unverified", 0, UNPROVEN,
        habits=Habits(forget_store=True, read_back="cached", reset_command=False)),
    row("forgets, shows what was written; its supply is switched", "old", "old", 4, "after a power cycle",
        "--power-cycle", supply=True, timing=QUICK, habits=Habits(forget_store=True, read_back="cached",
        reset_command=False, restart_s=2.0)),
    row("forgets direct writes and shows them, has no restart", "old", "new_unverified", 0, UNPROVEN,
        habits=Habits(store_command=False, reset_command=False, forget_store=True, read_back="cached")),
    # What it takes.
    row("refuses a register", "old", "old", 4, "bias_x", habits=Habits(refuses=frozenset({"bias_x"}))),
    row("refuses a register, writes straight to the EEPROM", "old", "old", 4, "bias_x",
        habits=Habits(refuses=frozenset({"bias_x"}), store_command=False, reset_command=False)),
    row("acknowledges a register and keeps the old value", "old", "old", 4, "bias_y",
        habits=Habits(stuck=frozenset({"bias_y"})), transport="rtu"),
    row("reads a register back with another bit", "old", "untouched", 3, "checksum",
        habits=Habits(flips={"misalignment_x": 3})),
    row("reads a register differently each time", "old", "untouched", 3, "misalignment_x",
        habits=Habits(alternates=frozenset({"misalignment_x"}), checksum=False)),
    row("ignores writes, as it is locked with another key", "old", "old", 4, "expected",
        habits=Habits(when_locked="ignores"), wording=Wording(key=1)),
    row("supports only function 6 to write", "old", "untouched", 4, ONLY_6, habits=Habits(lacks_function=16)),
    row("supports only function 6 to write, and leaves others unanswered", "old", "untouched", 4, ONLY_6,
        habits=Habits(lacks_function=16, when_lacking="silent"), timing=QUICK),
    # What it holds at first.
    row("holds a checksum that does not fit", "old", "untouched", 3, "checksum",
        habits=Habits(stored_checksum_wrong=True)),
    row("holds a checksum that does not fit; it is forced", "new", "new_verified", 0, RESTARTED,
        "--force", "repaired board", habits=Habits(stored_checksum_wrong=True)),
    row("has the other word order than its profile says", "old", "untouched", 3, "word order",
        wording=Wording(word_order="little", product_code=(PRODUCT_CODE << 16 | PRODUCT_CODE >> 16) & 0xFFFFFFFF,
        serial=False), serial=None),
    row("holds absurd values", "old", "untouched", 3, "scale_factor_x", before=ABSURD, wording=Wording(limits=False)),
    row("corrects with values that are not in its registers", "old", "untouched", 3, "corrected output",
        motion=Motion(follows_registers=False)),
    row("has another product code", "old", "untouched", 4, "product_code", wording=Wording(product_code=1)),
    row("is another unit than the station expects", "old", "untouched", 4, "serial", serial="9999"),
    row("restarts with the values of the factory", "neither", "mixed", 4, "neither the old calibration nor the new",
        habits=Habits(resets_to="factory")),
    # The line to it.
    row("loses 3 % of the replies", "new", "new_verified", 0, RESTARTED, timing=QUICK, trouble=Trouble(lose_reply=0.03,
        seed=3), wording=NO_OUTPUT),
    row("loses 3 % of the replies (RTU)", "new", "new_verified", 0, RESTARTED, timing=QUICK, transport="rtu",
        trouble=Trouble(lose_reply=0.03, seed=4), wording=NO_OUTPUT),
    row("loses 3 % of the replies (CANopen)", "new", "new_verified", 0, RESTARTED, timing=QUICK, transport="canopen",
        trouble=Trouble(lose_reply=0.03, seed=5), wording=NO_OUTPUT),
    row("does not hear 3 % of the requests", "new", "new_verified", 0, RESTARTED, timing=QUICK,
        trouble=Trouble(lose_request=0.03, seed=6), wording=NO_OUTPUT),
    row("answers each request twice (RTU)", "new", "new_verified", 0, RESTARTED, transport="rtu",
        trouble=Trouble(duplicate=0.05, seed=7), wording=NO_OUTPUT),
    row("damages some replies (RTU)", "new", "new_verified", 0, RESTARTED, transport="rtu", timing=QUICK,
        trouble=Trouble(garble=0.05, garbage=("truncated",), seed=8), wording=NO_OUTPUT),
    row("resets the connection now and then", "new", "new_verified", 0, RESTARTED, trouble=Trouble(drop=0.03, seed=9),
        wording=NO_OUTPUT),
    row("is busy for every fifth request", "new", "new_verified", 0, RESTARTED, trouble=Trouble(busy=0.2, seed=14),
        wording=NO_OUTPUT),
    row("is busy for the first two seconds", "new", "new_verified", 0, RESTARTED, trouble=Trouble(busy_for_s=2.0)),
    row("is busy for the first two seconds (CANopen)", "new", "new_verified", 0, RESTARTED, transport="canopen",
        trouble=Trouble(busy_for_s=2.0)),
    row("is not reached by its gateway now and then", "new", "new_verified", 0, RESTARTED, wording=NO_OUTPUT,
        trouble=Trouble(busy=0.1, busy_code=0x0B, seed=15)),
    row("stores, and its gateway says that it did not answer", "new", "new_verified", 0, RESTARTED, timing=QUICK,
        habits=Habits(store_reply="none, done", second_store_spoils=True), trouble=Trouble(gateway=0x0B)),
    row("restarts, and its gateway says that it did not answer", "new", "new_verified", 0, RESTARTED, timing=QUICK,
        habits=Habits(reset_reply=False), trouble=Trouble(gateway=0x0B)),
    row("is never reached by its gateway", "old", "untouched", 4,
        "no contact: exception 0x0A (gateway path unavailable)",
        trouble=Trouble(busy=1.0, busy_code=0x0A)),
    row("is always busy", "old", "untouched", 4, "busy", trouble=Trouble(busy=1.0)),
    row("never answers", "old", "untouched", 4, "no", trouble=Trouble(dead_after=0), timing=QUICK),
    row("falls silent for good while it is written", "old", "unknown", 4, "--resume", timing=QUICK,
        trouble=Trouble(dead_after=32), wording=NO_OUTPUT),
    row("falls silent for a second while it is written", "old", "old", 4, "old calibration", timing=QUICK,
        trouble=Trouble(dead_after=32, dead_for_s=1.5), wording=NO_OUTPUT),
    row("loses its power for a moment while it is written", "old", "old", 4, "old calibration",
        trouble=Trouble(brown_out=frozenset({32})), wording=NO_OUTPUT),
    # The supply.
    row("loses its supply in the store, and gets it back", "old", "old", 4, "old calibration", timing=QUICK,
        habits=Habits(cut_at_byte=17, power_back_s=0.5)),
    row("loses its supply in the store for good", "neither", "unknown", 4, "--resume", timing=QUICK,
        habits=Habits(cut_at_byte=17)),
    row("loses its supply in a direct write for good", "neither", "unknown", 4, "--resume", timing=QUICK,
        habits=Habits(cut_at_byte=17, store_command=False)),
)
# fmt: on

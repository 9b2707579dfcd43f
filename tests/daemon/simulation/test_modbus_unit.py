"""The simulated unit on Modbus: bytes on the wire written by hand, then the driver against it."""

import asyncio
import os
import struct
from contextlib import AsyncExitStack, aclosing, asynccontextmanager
from pathlib import Path

import numpy as np
import pytest

from triaxcal_drivers.catalogue import BUILT_IN, parse_bundle
from triaxcal_drivers.errors import BusError, DeviceAbsent, DeviceSilent, RegisterRefused
from triaxcal_drivers.interface import SampleBlock
from triaxcal_drivers.modbus.driver import ModbusDriver
from triaxcal_drivers.modbus.protocol import READ_INPUT, SerialLine, TcpAddress
from triaxcal_drivers.profile import Bundle
from triaxcal_drivers.registers import crc
from triaxcald.simulation.modbus_unit import (
    FIFO_RECORDS,
    GONE_S,
    HOLDING,
    WINDOW_WORDS,
    ModbusMap,
    ModbusUnit,
    pty_pair,
)
from triaxcald.simulation.time_base import RealTimeBase, SteppedTimeBase
from triaxcald.simulation.unit import CALIBRATION, COVERED, TABLE, Faults, ReferenceUnit

TEXT = (BUILT_IN / "triax-ref-modbus.toml").read_text("utf-8")
LOOPBACK = TcpAddress("127.0.0.1", 0)
PATIENCE_S, SILENCE_S = 180.0, 0.05
UNLOCK = "0009 0000 0009 01 10 0010 0001 02 5A17"
UNLOCKED = "0009 0000 0006 01 10 0010 0001"


class Ramp:
    """x rises by 1 mV a sample at 100 Hz, y is 0.5 V, z is −2.4 V; 25 °C."""

    def sample(self, unit_time_s):
        still = np.ones_like(unit_time_s)
        return np.stack([unit_time_s / 10, 0.5 * still, -2.4 * still], axis=1), 25.0 * still

    def restarted(self, unit_time_s):
        pass


@pytest.fixture
def time_base() -> SteppedTimeBase:
    return SteppedTimeBase()


@pytest.fixture
def unit() -> ReferenceUnit:
    return ReferenceUnit(Ramp(), serial_number=0x00BC614E)


def bundle(*, hasty: bool = False) -> Bundle:
    """The built-in profile; ``hasty`` for tests that sit out a silence."""
    rate = "rate_hz = 100.0"
    assert rate in TEXT
    limits = "reply_timeout_s = 0.1\nsilence_timeout_s = 0.2" if hasty else "reply_timeout_s = 5.0"
    return parse_bundle(TEXT.replace(rate, f"{rate}\n{limits}").encode(), {}, where="test")


@asynccontextmanager
async def socket_to(served: ModbusUnit):
    """A function that sends a frame in hex and gives the frame that comes back, in hex, or nothing."""
    reader, writer = await asyncio.open_connection(served.bus.host, served.bus.port)

    async def ask(frame: str, *, within_s: float = PATIENCE_S) -> str:
        writer.write(bytes.fromhex(frame))
        try:
            async with asyncio.timeout(within_s):
                header = await reader.readexactly(6)
                return (header + await reader.readexactly(int.from_bytes(header[4:], "big"))).hex()
        except TimeoutError:
            return ""

    yield ask
    writer.close()
    await writer.wait_closed()


def plain(frame: str) -> str:
    return bytes.fromhex(frame).hex()


@pytest.mark.parametrize(
    ("request_", "reply"),
    [
        # identity: vendor "TRIA", product, firmware, serial number
        ("0001 0000 0006 01 03 0000 0002", "0001 0000 0007 01 03 04 5452 4941"),
        ("0001 0000 0006 01 03 0002 0006", "0001 0000 000F 01 03 0C 0000 7A01 0001 0000 00BC 614E"),
        ("0001 0000 0006 01 03 0008 0003", "0001 0000 0009 01 03 06 0000 0000 0000"),
        # scale factor −2.4 V/g is C019999A; reference temperature 25 °C is 41C80000
        ("0001 0000 0006 01 03 0100 0002", "0001 0000 0007 01 03 04 C019 999A"),
        ("0001 0000 0006 01 03 0124 0004", "0001 0000 000B 01 03 08 41C8 0000 0000 0000"),
        ("0001 0000 0006 01 03 0200 0002", "0001 0000 0007 01 03 04 C019 999A"),
        # unknown address, a gap inside a block, an address past the map, a write-only register
        ("0001 0000 0006 01 03 0050 0001", "0001 0000 0003 01 83 02"),
        ("0001 0000 0006 01 03 000A 0003", "0001 0000 0003 01 83 02"),
        ("0001 0000 0006 01 03 FFFF 0002", "0001 0000 0003 01 83 02"),
        ("0001 0000 0006 01 03 0010 0001", "0001 0000 0003 01 83 02"),
        ("0001 0000 0006 01 04 0001 0001", "0001 0000 0003 01 84 02"),
        ("0001 0000 0006 01 04 0000 007C", "0001 0000 0003 01 84 02"),
        # counts that the protocol forbids, a function that the unit lacks, a request cut short
        ("0001 0000 0006 01 03 0000 0000", "0001 0000 0003 01 83 03"),
        ("0001 0000 0006 01 03 0000 007E", "0001 0000 0003 01 83 03"),
        ("0001 0000 0006 01 01 0000 0001", "0001 0000 0003 01 81 01"),
        ("0001 0000 0003 01 03 00", "0001 0000 0003 01 83 03"),
        ("0001 0000 0008 01 10 0010 0001 02 5A", "0001 0000 0003 01 90 03"),
        ("0001 0000 0009 01 10 0010 0001 04 5A17", "0001 0000 0003 01 90 03"),
        # locked, read-only, wrong key, partial float, function 6 on half a float
        ("0001 0000 000B 01 10 0100 0002 04 3F80 0000", "0001 0000 0003 01 90 04"),
        ("0001 0000 000B 01 10 0006 0002 04 0000 0001", "0001 0000 0003 01 90 02"),
        ("0001 0000 0009 01 10 0010 0001 02 1234", "0001 0000 0003 01 90 03"),
        ("0001 0000 0006 01 06 0010 1234", "0001 0000 0003 01 86 03"),
        ("0001 0000 0006 01 06 0100 3F80", "0001 0000 0003 01 86 03"),
        # unlock by function 6 and by 16
        ("0001 0000 0006 01 06 0010 5A17", "0001 0000 0006 01 06 0010 5A17"),
        ("0001 0000 0009 01 10 0010 0001 02 5A17", "0001 0000 0006 01 10 0010 0001"),
    ],
)
async def test_requests_over_tcp_are_answered_byte_for_byte(unit, time_base, request_, reply):
    async with ModbusUnit(unit, time_base) as served, socket_to(served) as ask:
        assert await ask(request_) == plain(reply)


@pytest.mark.parametrize("frame", ["0001 0000 0006 02 03 0000 0002", "0001 0001 0006 01 03 0000 0002"])
async def test_another_units_or_protocols_frame_is_passed_over(unit, time_base, frame):
    async with ModbusUnit(unit, time_base) as served, socket_to(served) as ask:
        assert await ask(frame, within_s=SILENCE_S) == ""
        assert await ask("0002 0000 0006 01 03 0008 0001") == plain("0002 0000 0005 01 03 02 0000")


async def test_a_calibration_register_is_written_when_unlocked(unit, time_base):
    async with ModbusUnit(unit, time_base) as served, socket_to(served) as ask:
        assert await ask(UNLOCK) == plain(UNLOCKED)
        # bias_x to 0.25 g; then bias_y and bias_z in one block
        assert await ask("0002 0000 000B 01 10 010C 0002 04 3E80 0000") == plain("0002 0000 0006 01 10 010C 0002")
        assert await ask("0003 0000 000F 01 10 010E 0004 08 3F00 0000 BE80 0000") == plain(
            "0003 0000 0006 01 10 010E 0004"
        )
        assert await ask("0004 0000 0006 01 03 010C 0006") == plain(
            "0004 0000 000F 01 03 0C 3E80 0000 3F00 0000 BE80 0000"
        )
        # the stored copy is as it was, and the status says so: unlocked, RAM differs from stored
        assert await ask("0005 0000 0006 01 03 020C 0002") == plain("0005 0000 0007 01 03 04 0000 0000")
        assert await ask("0006 0000 0006 01 03 0008 0001") == plain("0006 0000 0005 01 03 02 0009")


async def test_a_block_that_cuts_a_float_is_refused_whole(unit, time_base):
    async with ModbusUnit(unit, time_base) as served, socket_to(served) as ask:
        await ask(UNLOCK)
        # three words from bias_x: bias_x and half of bias_y
        cut = await ask("0002 0000 000D 01 10 010C 0003 06 3E80 0000 3F00")
        assert cut == plain("0002 0000 0003 01 90 03")
        # one word from the middle of bias_x
        middle = await ask("0003 0000 0009 01 10 010D 0001 02 0001")
        assert middle == plain("0003 0000 0003 01 90 03")
        # a value that is no number
        nan = await ask("0004 0000 000B 01 10 010C 0002 04 7FC0 0000")
        assert nan == plain("0004 0000 0003 01 90 03")
        assert await ask("0005 0000 0006 01 03 010C 0002") == plain("0005 0000 0007 01 03 04 0000 0000")


async def test_the_fifo_window_pops_what_it_returns(unit, time_base):
    """Samples every 10 ms from 0: at 0.02 s there are three. 0.5 V are 419430 counts, −2.4 V −2013266."""
    async with ModbusUnit(unit, time_base) as served, socket_to(served) as ask:
        await time_base.advance(0.02)
        assert await ask("0001 0000 0006 01 04 0000 0003") == plain("0001 0000 0009 01 04 06 0000 0003 0000")
        # two records: 23 words; one is left
        first = "0000 0000 0000 0000 0000 0006 6666 FFE1 47AE 09C4"
        second = "0001 0000 2710 0000 0347 0006 6666 FFE1 47AE 09C4"
        assert await ask("0002 0000 0006 01 04 0000 0017") == plain(
            "0002 0000 0031 01 04 2E 0002 0001 0000" + first + second
        )
        third = "0002 0000 4E20 0000 068E 0006 6666 FFE1 47AE 09C4"
        assert await ask("0003 0000 0006 01 04 0000 007B") == plain(
            "0003 0000 00F9 01 04 F6 0001 0000 0000" + third + "0000" * 110
        )
        # the corrected window still holds its own three: 0.5 V are −0.208333 g, z 1 g less one count
        corrected = await ask("0004 0000 0006 01 04 0400 000D")
        assert corrected == plain(
            "0004 0000 001D 01 04 1A 0001 0002 0000 0000 0000 0000 0000 0000 FFFC D233 000F 4240 09C4"
        )


async def test_a_write_acts_on_the_samples_after_it_alone(unit, time_base):
    async with ModbusUnit(unit, time_base) as served, socket_to(served) as ask:
        await ask(UNLOCK)
        await time_base.advance(0.005)
        await ask("0002 0000 000B 01 10 0110 0002 04 3E80 0000")  # bias_z to 0.25 g
        await time_base.advance(0.01)
        reply = bytes.fromhex(await ask("0003 0000 0006 01 04 0400 0017"))[9:]
    before, after = reply[6:26], reply[26:46]
    assert (before[14:18], after[14:18]) == (bytes.fromhex("000F4240"), bytes.fromhex("000B71B0"))  # 1 g, 0.75 g


async def test_a_unit_that_nobody_reads_does_its_work_as_it_goes(time_base):
    runs = []

    class Counted(Ramp):
        def sample(self, unit_time_s):
            runs.append(len(unit_time_s))
            return super().sample(unit_time_s)

    async with ModbusUnit(ReferenceUnit(Counted(), serial_number=1), time_base):
        await time_base.advance(60.0)
    assert sum(runs) >= 5900
    assert max(runs) <= 101


async def test_samples_that_nobody_fetches_are_counted_as_lost(unit, time_base):
    async with ModbusUnit(unit, time_base) as served, socket_to(served) as ask:
        await time_base.advance(41.0)  # 4101 samples, of which the FIFO holds 4096
        reply = bytes.fromhex(await ask("0001 0000 0006 01 04 0000 000D"))[9:]
        assert struct.unpack(">HHHH", reply[:8]) == (1, FIFO_RECORDS - 1, 5, 5)


class ToldBehind(SteppedTimeBase):
    """Keeps what says whether the reader is behind."""

    def wait_for_reader(self, behind):
        self.behind = behind


async def test_a_reader_is_behind_once_it_has_begun_and_leaves_much_in_a_fifo(unit):
    time_base = ToldBehind()
    windows = ModbusMap(unit, time_base)

    def fetch(address):
        return windows.read(READ_INPUT, address, WINDOW_WORDS)

    await time_base.advance(2.0)
    windows.fill()
    assert not time_base.behind(), "nobody reads it, which holds up nobody"
    fetch(0x0000)
    assert time_base.behind()
    while int.from_bytes(fetch(0x0000)[2:4], "big"):
        pass
    assert not time_base.behind(), "the corrected ones are not wanted"
    fetch(0x0400)
    assert time_base.behind()


async def test_a_reader_that_has_gone_holds_up_nobody_after_a_while(unit):
    time_base = ToldBehind()
    windows = ModbusMap(unit, time_base)
    await time_base.advance(2.0)
    windows.read(READ_INPUT, 0x0000, WINDOW_WORDS)
    for seconds, is_behind in ((GONE_S - 1.0, True), (2.0, False)):
        await time_base.advance(seconds)
        windows.fill()
        assert time_base.behind() is is_behind
    windows.read(READ_INPUT, 0x0000, WINDOW_WORDS)
    assert time_base.behind(), "it is back"


async def test_without_supply_it_keeps_silent_and_its_fifos_are_empty_afterwards(unit, time_base):
    async with ModbusUnit(unit, time_base) as served, socket_to(served) as ask:
        await time_base.advance(1.0)
        unit.switch_off(1.0)
        assert await ask("0001 0000 0006 01 03 0008 0001", within_s=SILENCE_S) == ""
        await time_base.advance(10.0)
        unit.switch_on(11.0)
        await time_base.advance(0.125)
        window = bytes.fromhex(await ask("0002 0000 0006 01 04 0000 000D"))[9:]
        assert struct.unpack(">HHHHI", window[:12]) == (1, 2, 0, 0, 0)


async def test_a_unit_that_restarts_is_silent_and_comes_back_empty_and_locked(unit, time_base):
    async with ModbusUnit(unit, time_base) as served, socket_to(served) as ask:
        await time_base.advance(1.0)
        await ask(UNLOCK)
        await ask("0002 0000 000B 01 10 010C 0002 04 3E80 0000")
        assert await ask("0003 0000 0009 01 10 0013 0001 02 B007") == plain("0003 0000 0006 01 10 0013 0001")
        assert await ask("0004 0000 0006 01 03 0008 0001", within_s=SILENCE_S) == ""
        await time_base.advance(0.125)
        assert await ask("0005 0000 0006 01 03 0008 0001") == plain("0005 0000 0005 01 03 02 0000")
        assert await ask("0006 0000 0006 01 03 010C 0002") == plain("0006 0000 0007 01 03 04 0000 0000")
        window = bytes.fromhex(await ask("0007 0000 0006 01 04 0000 000D"))[9:]
        # three samples since the start at 1.1 s, the first with counter and time stamp 0
        assert struct.unpack(">HHHHI", window[:12]) == (1, 2, 0, 0, 0)


async def test_two_frames_in_one_segment_are_both_answered(unit, time_base):
    async with ModbusUnit(unit, time_base) as served, socket_to(served) as ask:
        first = await ask("0001 0000 0006 01 03 0008 0001 0002 0000 0006 01 03 0002 0002")
        assert first == plain("0001 0000 0005 01 03 02 0000")
        assert await ask("") == plain("0002 0000 0007 01 03 04 0000 7A01")


@asynccontextmanager
async def raw_port(path: str):
    """A function that writes a frame in hex to a serial port and gives what comes back, in hex."""
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY)
    reader = asyncio.StreamReader()
    transport, _ = await asyncio.get_running_loop().connect_read_pipe(
        lambda: asyncio.StreamReaderProtocol(reader), os.fdopen(fd, "rb", 0)
    )

    async def ask(frame: str, length: int, *, within_s: float = PATIENCE_S) -> str:
        os.write(fd, bytes.fromhex(frame))
        try:
            async with asyncio.timeout(within_s):
                return (await reader.readexactly(length)).hex()
        except TimeoutError:
            return ""

    yield ask
    transport.close()


async def test_requests_on_a_serial_line_are_answered_byte_for_byte(unit, time_base):
    """Unit 0x11 and CRCs as in the protocol's worked examples, where the request is one of them."""
    async with (
        pty_pair() as (near, far),
        raw_port(far) as ask,
        ModbusUnit(unit, time_base, SerialLine(near, parity="N"), unit_id=0x11),
    ):
        # the worked example: three registers at 0x6B, which this unit does not have
        assert await ask("11 03 00 6B 00 03 76 87", 5) == plain("11 83 02 C1 34")
        assert await ask("11 03 00 00 00 02 C6 9B", 9) == plain("11 03 04 54 52 49 41 AD B3")
        assert await ask("11 06 00 10 5A 17 F0 31", 8) == plain("11 06 00 10 5A 17 F0 31")
        assert await ask("11 03 00 00 00 02 C6 9C", 9, within_s=SILENCE_S) == ""  # a wrong CRC
        assert await ask("12 03 00 00 00 02 C6 A8", 9, within_s=SILENCE_S) == ""  # another unit
        assert await ask("11 03 00 00 00 02 C6 9B", 9) == plain("11 03 04 54 52 49 41 AD B3")


def test_the_profile_knows_the_units_registers_by_address_type_and_access():
    registers = bundle().profile.registers
    assert {r.address: name for name, r in registers.items()} == HOLDING
    assert {n: (r.type, r.access) for n, r in registers.items()} == {n: (e.type, e.access) for n, e in TABLE.items()}
    assert bundle().profile.crc.over == COVERED


@asynccontextmanager
async def driven(unit, time_base, *, where=LOOPBACK, hasty=False):
    """The unit served, and the driver's device opened on it."""
    profile = bundle(hasty=hasty)
    async with AsyncExitStack() as stack:
        served = await stack.enter_async_context(ModbusUnit(unit, time_base, where))
        device = ModbusDriver().device(profile, served.bus)
        await device.open()
        stack.push_async_callback(device.close)
        yield device, profile


async def gathered(
    device, profile, samples: int, streams=("readings",), *, time_base=None, seconds=0.0
) -> dict[str, list[SampleBlock]]:
    """Blocks of the streams until each has so many samples; ``time_base`` goes on by ``seconds`` once they are open."""
    decoders = {name: ModbusDriver().decoder(profile, name) for name in streams}
    blocks: dict[str, list[SampleBlock]] = {name: [] for name in streams}
    async with aclosing(device.stream(streams)) as batches:
        if time_base is not None:
            assert len(decoders[streams[0]].feed(await anext(batches))) == 0
            await time_base.advance(seconds)
        async for batch in batches:
            for name in streams:
                blocks[name].append(decoders[name].feed(batch))
            if all(sum(map(len, b)) >= samples for b in blocks.values()):
                break
    return blocks


@pytest.mark.parametrize("where", ["tcp", "serial"])
async def test_the_driver_gets_every_sample_of_both_streams(unit, time_base, where, tmp_path: Path):
    place = TcpAddress("127.0.0.1", 0) if where == "tcp" else SerialLine(f"pty:{tmp_path}/line", 115_200, "N")
    async with driven(unit, time_base, where=place) as (device, profile):
        streams = ("readings", "corrected")
        blocks = await gathered(device, profile, 500, streams, time_base=time_base, seconds=5.0)
    for name, scale in (("readings", 1.0), ("corrected", 1 / -2.4)):
        readings = np.concatenate([b.readings for b in blocks[name]])
        counter = np.concatenate([b.counter for b in blocks[name]])
        assert counter.tolist() == list(range(1, 501))
        np.testing.assert_allclose(readings[:, 0], np.arange(1, 501) * 1e-3 * scale, atol=2e-6)
        np.testing.assert_allclose(readings[:, 2], -2.4 * scale, atol=2e-6)
        time_ns = np.concatenate([b.time_ns for b in blocks[name]])
        assert (np.diff(time_ns) == 10_000_000).all()
        assert sum(b.missing + b.duplicates + b.errors for b in blocks[name]) == 0


async def test_a_backlog_is_fetched_without_waiting_for_the_next_poll(unit, time_base):
    text = TEXT.replace("poll_period_s = 0.05", "poll_period_s = 60.0")
    profile = parse_bundle(text.encode(), {}, where="test")
    async with ModbusUnit(unit, time_base) as served, asyncio.timeout(PATIENCE_S):
        device = ModbusDriver().device(profile, served.bus)
        await device.open()
        decode, blocks = ModbusDriver().decoder(profile, "readings"), []
        async with aclosing(device.stream(["corrected", "readings"])) as batches:
            await anext(batches)  # of the corrected ones; the readings are polled for the first time after it
            await time_base.advance(20.0)
            while sum(map(len, blocks)) < 2000:
                blocks.append(decode.feed(await anext(batches)))
        await device.close()
    assert sum(map(len, blocks)) == 2000
    assert len(blocks) > 1


async def test_what_a_deep_fifo_holds_from_before_is_discarded(unit, time_base):
    async with driven(unit, time_base) as (device, profile):
        await time_base.advance(50.0)  # 5001 samples, of which the FIFO keeps 4096
        blocks = (await gathered(device, profile, 100, time_base=time_base, seconds=1.0))["readings"]
        assert device.discarded == FIFO_RECORDS
    assert np.concatenate([b.counter for b in blocks]).tolist() == list(range(5001, 5101))
    assert sum(b.missing + b.duplicates + b.errors for b in blocks) == 0


async def test_a_second_stream_has_nothing_from_before_it_either(unit, time_base):
    async with driven(unit, time_base) as (device, profile):
        await gathered(device, profile, 100, time_base=time_base, seconds=1.0)
        await time_base.advance(5.0)
        again = await gathered(device, profile, 100, time_base=time_base, seconds=1.0)
    assert np.concatenate([b.counter for b in again["readings"]]).tolist() == list(range(601, 701))


async def test_an_accelerated_unit_loses_nothing_while_registers_are_read(unit):
    """Two thousand samples a second of unit time are asked of the loop; what came is whole."""
    async with driven(unit, RealTimeBase(speed=20)) as (device, profile):

        async def look() -> int:
            times = 0
            while True:
                assert await device.read("serial_number") == bytes.fromhex("00BC614E")
                times += 1
                if gathering.done():
                    return times

        gathering = asyncio.create_task(gathered(device, profile, 1000))
        assert await look() > 10
        blocks = (await gathering)["readings"]
    assert sum(b.missing + b.duplicates + b.errors for b in blocks) == 0
    assert (np.diff(np.concatenate([b.counter for b in blocks])) == 1).all()


async def test_a_calibration_is_written_stored_and_survives_a_restart(unit, time_base):
    async with driven(unit, time_base, hasty=True) as (device, _):
        await device.write("unlock_key", b"\x5a\x17")
        await device.write("bias_x", struct.pack(">f", 0.125))
        body = b"".join([await device.read(name) for name in COVERED])
        with pytest.raises(RegisterRefused) as refused:  # the CRC is not yet right
            await device.write("store", bytes.fromhex("65766173"))
        assert (refused.value.register, refused.value.code) == ("store", 3)
        await device.write("calibration_crc", crc("crc-16/modbus", body).to_bytes(2, "big"))
        await device.write("store", bytes.fromhex("65766173"))
        await time_base.advance(0.06)
        assert await device.read("write_counter") == b"\0\0\0\x01"
        await device.write("reset", b"\xb0\x07")
        with pytest.raises(DeviceSilent):
            await device.read("status")
        await time_base.advance(0.2)
        assert await device.read("bias_x") == struct.pack(">f", 0.125)
        with pytest.raises(RegisterRefused) as refused:
            await device.write("bias_x", bytes(4))
        assert refused.value.code == 4


async def test_every_calibration_register_is_read_like_its_stored_copy(unit, time_base):
    async with driven(unit, time_base) as (device, _):
        for name in CALIBRATION:
            assert await device.read(name) == await device.read("stored_" + name)


async def test_a_restart_while_streaming_is_one_jump_in_time(unit, time_base):
    async with driven(unit, time_base, hasty=True) as (device, profile):
        decode = ModbusDriver().decoder(profile, "readings")
        async with aclosing(device.stream(["readings"])) as batches:
            await anext(batches)
            await time_base.advance(5.0)
            before = [decode.feed(await anext(batches)) for _ in range(2)]
            unit.power_cycle(time_base.now_s())
            silent = decode.feed(await anext(batches))
            await time_base.advance(1.0)
            after = decode.feed(await anext(batches))
    assert silent.errors == 1
    assert sum(map(len, before)) == 500
    assert len(after) == 91
    assert after.missing == 0
    assert after.time_ns[0] > before[-2].time_ns[-1]
    assert after.counter[0] == 501


async def test_a_unit_that_dies_while_streaming_is_silent(time_base):
    unit = ReferenceUnit(Ramp(), serial_number=1, faults=Faults(die_at_s=1.0))
    async with driven(unit, time_base, hasty=True) as (device, profile):
        blocks = await gathered(device, profile, 90, time_base=time_base, seconds=0.9)
        assert sum(map(len, blocks["readings"])) == 90
        await time_base.advance(0.2)
        with pytest.raises(DeviceSilent, match=r"stream readings has been silent .* no reply"):
            await gathered(device, profile, 1)
        await device.close()
        with pytest.raises(DeviceAbsent, match=r"nothing answers at 127.0.0.1:.* unit 1"):
            await device.open()


async def test_a_unit_that_dies_on_a_write_does_not_reply_to_it(time_base):
    unit = ReferenceUnit(Ramp(), serial_number=1, faults=Faults(die_on_write="bias_y"))
    async with driven(unit, time_base, hasty=True) as (device, _):
        await device.write("unlock_key", b"\x5a\x17")
        with pytest.raises(DeviceSilent):
            await device.write("bias_y", bytes(4))


async def test_an_address_that_is_taken_cannot_be_served(unit, time_base):
    async with ModbusUnit(unit, time_base) as served:
        taken = TcpAddress("127.0.0.1", served.bus.port)
        with pytest.raises(BusError, match=f"cannot listen on 127.0.0.1:{served.bus.port}: "):
            async with ModbusUnit(unit, time_base, taken):
                pass


async def test_a_pseudo_terminal_is_linked_while_the_unit_is_served(unit, time_base, tmp_path: Path):
    link = tmp_path / "line"
    link.symlink_to("/dev/nothing")  # left behind by a process that was killed
    async with ModbusUnit(unit, time_base, SerialLine(f"pty:{link}")) as served:
        assert served.bus.serial_port == str(link)
        async with raw_port(str(link)) as ask:
            assert await ask("01 03 00 08 00 01 05 C8", 7) == plain("01 03 02 00 00 B8 44")
    assert not link.is_symlink()


async def test_a_file_in_the_links_place_is_left_alone(unit, time_base, tmp_path: Path):
    link = tmp_path / "line"
    link.write_text("precious")
    with pytest.raises(BusError, match="line: File exists"):
        async with ModbusUnit(unit, time_base, SerialLine(f"pty:{link}")):
            pass
    assert link.read_text() == "precious"

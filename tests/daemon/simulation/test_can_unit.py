"""The simulated unit on CAN: its frames as literal bytes, and the driver against it from end to end."""

import asyncio
import contextlib
import socket
import subprocess
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import can
import numpy as np
import pytest

from triaxcal_drivers.can.device import CanDevice
from triaxcal_drivers.can.driver import CanDriver
from triaxcal_drivers.can.model import CanBus
from triaxcal_drivers.catalogue import load_bundle, parse_bundle
from triaxcal_drivers.errors import BusError, DeviceAbsent, DeviceSilent, RegisterRefused
from triaxcal_drivers.interface import RawBatch
from triaxcal_drivers.profile import Bundle
from triaxcal_drivers.registers import crc
from triaxcald.simulation.can_unit import CanUnit, tpdos
from triaxcald.simulation.time_base import RealTimeBase, SteppedTimeBase
from triaxcald.simulation.unit import (
    COVERED,
    INVALID_CORRECTED,
    TABLE,
    ConstantPhysics,
    Faults,
    ReferenceUnit,
    SampleRun,
)

SERIAL = 0x4D


@pytest.fixture
def settings(request: pytest.FixtureRequest) -> CanBus:
    return CanBus(interface="virtual", channel=request.node.name, node_id=5)


@pytest.fixture
def clock() -> SteppedTimeBase:
    return SteppedTimeBase()


@pytest.fixture
def unit() -> ReferenceUnit:
    """-2.4 V in z, 25 °C; at rest with z up, after the factory calibration."""
    return ReferenceUnit(ConstantPhysics(), serial_number=SERIAL)


class Master:
    """The other end of a stepped unit's bus. Frames are compared as text: identifier and bytes."""

    def __init__(self, channel: str, clock: SteppedTimeBase) -> None:
        self.bus = can.Bus(channel, "virtual", ignore_config=True)
        self.clock = clock

    def received(self) -> list[str]:
        frames = []
        while message := self.bus.recv(0):
            frames.append(f"{message.arbitration_id:03x}: {bytes(message.data).hex(' ')}")
        return frames

    def send(self, identifier: int, data: str) -> None:
        message = can.Message(arbitration_id=identifier, data=bytes.fromhex(data), is_extended_id=False)
        self.bus.send(message)

    async def ask(self, request: str) -> str:
        """The answer to an SDO request; other frames are passed over."""
        self.send(0x605, request)
        while message := await asyncio.to_thread(self.bus.recv, 2.0):
            if message.arbitration_id == 0x585:
                return bytes(message.data).hex(" ")
        raise AssertionError(f"no answer to {request}")

    async def command(self, code: int, node: int = 5) -> None:
        """An NMT command, and a request behind it, whose answer shows that the command was taken."""
        self.send(0x000, f"{code:02x} {node:02x}")
        await self.ask("40 18 10 01 00 00 00 00")


@pytest.fixture
async def master(settings: CanBus, clock: SteppedTimeBase, unit: ReferenceUnit) -> AsyncIterator[Master]:
    made = Master(str(settings.channel), clock)
    async with CanUnit(unit, clock, settings):
        await clock.advance(0)
        yield made
    made.bus.shutdown()


async def test_the_unit_boots_into_pre_operational_and_beats_once_a_second(
    master: Master, clock: SteppedTimeBase
) -> None:
    assert master.received() == ["705: 00"]
    await clock.advance(0.995)
    assert master.received() == []
    await clock.advance(2.01)
    assert master.received() == ["705: 7f"] * 3


async def test_without_supply_nothing_is_sent_and_the_unit_boots_when_it_comes(
    master: Master, clock: SteppedTimeBase, unit: ReferenceUnit
) -> None:
    await master.command(0x01)
    await clock.advance(0.5)
    unit.switch_off(0.5)
    master.received()
    await clock.advance(10.0)
    master.send(0x605, "40 18 10 01 00 00 00 00")
    await clock.advance(10.0)
    assert master.received() == []
    unit.switch_on(20.5)
    await clock.advance(1.5)
    assert master.received() == ["705: 00", "705: 7f"]


async def test_four_tpdos_a_sample_once_it_is_operational(master: Master, clock: SteppedTimeBase) -> None:
    await clock.advance(0.995)  # samples 0 to 99 are taken before the start
    await master.command(0x01)
    master.received()
    await clock.advance(0.01)
    # -2.4 V is -2013266 counts = 0xE147AE; 25 °C is 2500 = 0x09C4; counter 100; 1 g is 0x0F4240
    assert master.received() == [
        "705: 05",
        "185: 00 00 00 00 00 00 64 00",
        "285: ae 47 e1 c4 09 64 00 00",
        "385: 00 00 00 00 00 00 64 00",
        "485: 40 42 0f c4 09 64 00 00",
    ]


async def test_nmt_stop_ends_the_stream_and_pre_operational_answers_again(
    master: Master, clock: SteppedTimeBase
) -> None:
    await master.command(0x01)
    master.send(0x000, "02 05")
    master.send(0x605, "40 18 10 01 00 00 00 00")
    master.send(0x000, "80 00")  # to all nodes
    assert await master.ask("40 18 10 04 00 00 00 00") == "43 18 10 04 4d 00 00 00"
    master.received()
    await clock.advance(0.5)
    assert master.received() == []


async def test_a_command_for_another_node_is_not_obeyed(master: Master, clock: SteppedTimeBase) -> None:
    await master.command(0x01, node=6)
    master.received()
    await clock.advance(0.5)
    assert master.received() == []


async def test_a_reset_node_command_restarts_the_unit(
    master: Master, clock: SteppedTimeBase, unit: ReferenceUnit
) -> None:
    assert await master.ask("2b 10 20 00 17 5a 00 00") == "60 10 20 00 00 00 00 00"
    assert await master.ask("40 00 20 00 00 00 00 00") == "4b 00 20 00 01 00 00 00"  # unlocked
    await master.command(0x82)
    assert await master.ask("40 00 20 00 00 00 00 00") == "4b 00 20 00 01 00 00 00"  # communication alone
    master.send(0x000, "81 05")
    master.send(0x605, "40 00 20 00 00 00 00 00")  # is not answered: the unit restarts
    async with asyncio.timeout(5):
        while unit.started_s == 0:
            await asyncio.sleep(0)
    await clock.advance(0.09)
    assert master.received() == []
    await clock.advance(0.02)
    assert master.received() == ["705: 00"]
    assert await master.ask("40 00 20 00 00 00 00 00") == "4b 00 20 00 00 00 00 00"  # locked again


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("40 18 10 01 00 00 00 00", "43 18 10 01 41 49 52 54"),  # vendor_id
        ("40 01 20 00 00 00 00 00", "43 01 20 00 00 00 00 00"),  # write_counter
        ("40 00 21 03 00 00 00 00", "43 00 21 03 9a 99 19 c0"),  # scale_factor_z, -2.4
        ("40 06 22 00 00 00 00 00", "43 06 22 00 00 00 c8 41"),  # stored_reference_temperature, 25.0
        ("40 17 10 00 00 00 00 00", "4b 17 10 00 e8 03 00 00"),  # heartbeat time, 1000 ms, from the EDS
        ("40 00 18 01 00 00 00 00", "43 00 18 01 85 01 00 40"),  # COB-ID of TPDO1, with the node
        ("40 00 1a 01 00 00 00 00", "43 00 1a 01 18 01 00 23"),  # what TPDO1 maps first
        ("40 00 23 03 00 00 00 00", "47 00 23 03 ae 47 e1 00"),  # the latest reading in z
        ("40 00 23 05 00 00 00 00", "4b 00 23 05 c4 09 00 00"),  # its temperature
        ("40 01 23 03 00 00 00 00", "47 01 23 03 40 42 0f 00"),  # the same, corrected
        ("40 10 20 00 00 00 00 00", "80 10 20 00 01 00 01 06"),  # unlock_key is write-only
        ("40 99 29 00 00 00 00 00", "80 99 29 00 00 00 02 06"),  # no such object
        ("40 00 21 09 00 00 00 00", "80 00 21 09 11 00 09 06"),  # no such sub-index
        ("23 02 22 01 00 00 00 00", "80 02 22 01 02 00 01 06"),  # the stored copy is read-only
        ("23 02 21 01 00 00 80 3e", "80 02 21 01 22 00 00 08"),  # locked
        ("2b 10 20 00 18 5a 00 00", "80 10 20 00 30 00 09 06"),  # wrong key
        ("2f 10 20 00 17 00 00 00", "80 10 20 00 10 00 07 06"),  # one byte where two are due
        ("ff 10 20 00 00 00 00 00", "80 10 20 00 01 00 04 05"),  # no such SDO command
        ("21 02 21 01 04 00 00 00", "80 02 21 01 01 00 04 05"),  # segmented transfers are not served
        ("60 00 00 00 00 00 00 00", "80 00 00 00 01 00 04 05"),
        ("a0 00 20 00 00 00 00 00", "80 00 20 00 01 00 04 05"),  # nor block transfers
        ("22 10 20 00 17 5a 00 00", "80 10 20 00 10 00 07 06"),  # size not said: four bytes
    ],
)
async def test_sdo_requests_are_answered_to_the_byte(master: Master, request_: str, answer: str) -> None:
    assert await master.ask(request_) == answer


async def test_an_unlocked_unit_takes_finite_values_only_and_sends_the_new_correction(
    master: Master, clock: SteppedTimeBase
) -> None:
    assert await master.ask("2b 10 20 00 17 5a 00 00") == "60 10 20 00 00 00 00 00"
    assert await master.ask("23 02 21 03 00 00 c0 7f") == "80 02 21 03 30 00 09 06"  # not a number
    assert await master.ask("23 02 21 03 00 00 00 3e") == "60 02 21 03 00 00 00 00"  # bias_z 0.125 g
    assert await master.ask("40 02 21 03 00 00 00 00") == "43 02 21 03 00 00 00 3e"
    assert await master.ask("23 10 10 01 73 61 76 65") == "80 10 10 01 30 00 09 06"  # CRC does not match
    await clock.advance(0.02)
    assert await master.ask("40 01 23 03 00 00 00 00") == "47 01 23 03 f8 59 0d 00"  # 875 000 µg


def test_the_corrected_output_saturates_and_the_invalid_one_is_the_most_negative_number() -> None:
    corrected = np.array([[INVALID_CORRECTED, 9_000_000, -9_000_000]], dtype=np.int32)
    zero = np.zeros(1, dtype=np.int16)
    run = SampleRun(
        zero.astype(np.uint16), zero.astype(float), np.array([[-1, 2**23 - 1, -(2**23)]], dtype=np.int32),
        zero - 1, corrected, np.array([0x0102], dtype=np.uint16),
    )  # fmt: skip
    assert [frames[0].hex(" ") for frames in tpdos(run)] == [
        "ff ff ff ff ff 7f 00 00",
        "00 00 80 ff ff 00 00 02",
        "00 00 80 ff ff 7f 00 00",
        "01 00 80 ff ff 00 00 02",
    ]


@pytest.fixture
def bundle() -> Bundle:
    return load_bundle(Path("triax-ref-can"))


@contextlib.asynccontextmanager
async def connected(bundle: Bundle, settings: CanBus) -> AsyncIterator[CanDevice]:
    device = CanDriver().device(bundle, settings)
    await device.open()
    try:
        yield device
    finally:
        await device.close()


async def frames_of(device: CanDevice, count: int) -> list[RawBatch]:
    batches: list[RawBatch] = []
    async with contextlib.aclosing(device.stream(["readings", "corrected"])) as stream:
        async for batch in stream:
            batches.append(batch)
            if sum(map(len, batches)) >= count:
                break
    return batches


@pytest.mark.slow
async def test_the_driver_reads_a_fast_unit_without_a_loss(
    bundle: Bundle, settings: CanBus, unit: ReferenceUnit
) -> None:
    """20 times as fast: 8000 frames a second, for three seconds of the unit's time."""
    async with CanUnit(unit, RealTimeBase(speed=20), settings), connected(bundle, settings) as device:
        batches = await frames_of(device, 1200)
    driver = CanDriver()
    for stream, expected in (("readings", [0, 0, -2.4]), ("corrected", [0, 0, 1.0])):
        decoder = driver.decoder(bundle, stream)
        blocks = [decoder.feed(batch) for batch in batches]
        readings = np.concatenate([b.readings for b in blocks])
        assert len(readings) >= 298
        assert sum(b.missing + b.duplicates + b.incomplete + b.errors for b in blocks) == 0
        np.testing.assert_allclose(readings, np.tile(expected, (len(readings), 1)), atol=1e-6)
        time_ns = np.concatenate([b.time_ns for b in blocks])
        assert (np.diff(time_ns) == 10_000_000).all()
        assert np.concatenate([b.channels["temp_c"] for b in blocks]).tolist() == [25.0] * len(readings)
    assert device.dropped == 0


@pytest.mark.slow
async def test_a_calibration_written_stored_and_restarted_is_there(
    bundle: Bundle, settings: CanBus, unit: ReferenceUnit
) -> None:
    profile = bundle.profile
    assert profile.crc is not None
    async with CanUnit(unit, RealTimeBase(speed=20), settings), connected(bundle, settings) as device:
        assert profile.decode("serial_number", await device.read("serial_number")) == SERIAL
        with pytest.raises(RegisterRefused) as refused:
            await device.write("bias_x", profile.encode("bias_x", 0.25))
        assert (refused.value.register, refused.value.code) == ("bias_x", 0x08000022)

        await device.write("unlock_key", profile.encode("unlock_key", 0x5A17))
        await device.write("bias_x", profile.encode("bias_x", 0.25))
        body = b"".join([(await device.read(n))[::-1] for n in profile.crc.over])  # big-endian
        assert len(body) == sum(TABLE[n].size for n in COVERED)
        await device.write("calibration_crc", profile.encode("calibration_crc", crc("crc-16/modbus", body)))
        await device.write("store", profile.encode("store", 0x65766173))
        async with asyncio.timeout(5):
            while int.from_bytes(await device.read("status"), "little") & 16:  # storing
                pass
        await device.write("reset", profile.encode("reset", 0xB007))
        await device.open()
        assert profile.decode("write_counter", await device.read("write_counter")) == 1
        assert profile.decode("bias_x", await device.read("bias_x")) == 0.25
        assert profile.decode("status", await device.read("status")) == 0
        batches = await frames_of(device, 40)
    decoder = CanDriver().decoder(bundle, "corrected")
    corrected = np.concatenate([decoder.feed(batch).readings for batch in batches])
    np.testing.assert_allclose(corrected, np.tile([-0.25, 0, 1.0], (len(corrected), 1)), atol=1e-6)


async def test_a_unit_that_dies_falls_silent(bundle: Bundle, settings: CanBus) -> None:
    dying = ReferenceUnit(ConstantPhysics(), serial_number=1, faults=Faults(die_on_write="unlock_key"))
    quick = bundle.text.replace(b"_timeout_s = 2.0", b"_timeout_s = 0.2").replace(
        b"reply_timeout_s = 1.0", b"reply_timeout_s = 0.2"
    )
    impatient = parse_bundle(quick, bundle.files, where="test")
    async with CanUnit(dying, RealTimeBase(), settings), connected(impatient, settings) as device:
        with pytest.raises(DeviceSilent):
            await device.write("unlock_key", bytes.fromhex("175a"))
        with pytest.raises(DeviceSilent):
            await anext(device.stream(["readings"]))
        with pytest.raises(DeviceAbsent):
            await device.open()


async def test_a_unit_on_a_bus_that_cannot_be_opened_says_so(unit: ReferenceUnit) -> None:
    nowhere = CanBus(interface="socketcan", channel="no-such-can0", node_id=5)
    with pytest.raises(BusError, match="cannot open socketcan no-such-can0"):
        async with CanUnit(unit, RealTimeBase(), nowhere):
            pass


SERVE = """
import asyncio, sys
from triaxcal_drivers.can.model import CanBus
from triaxcald.simulation.can_unit import CanUnit
from triaxcald.simulation.unit import ConstantPhysics
from triaxcald.simulation.time_base import RealTimeBase
from triaxcald.simulation.unit import ReferenceUnit

async def serve():
    bus = CanBus(interface="udp_multicast", channel=sys.argv[1], node_id=9, options={"port": int(sys.argv[2])})
    async with CanUnit(ReferenceUnit(ConstantPhysics(), serial_number=77), RealTimeBase(), bus):
        print("ready", flush=True)
        await asyncio.to_thread(sys.stdin.read)

asyncio.run(serve())
"""
GROUP = "239.74.163.2"


@pytest.fixture
def multicast_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        port: int = free.getsockname()[1]
    try:
        with (
            can.Bus(GROUP, "udp_multicast", port=port, ignore_config=True) as a,
            can.Bus(GROUP, "udp_multicast", port=port, ignore_config=True) as b,
        ):
            a.send(can.Message(arbitration_id=1))
            heard = b.recv(1.0)
    except (can.CanError, OSError) as e:
        pytest.skip(f"multicast is not to be had here: {e}")
    if heard is None:
        pytest.skip("multicast is not to be had here: a frame sent was not received")
    return port


@pytest.mark.slow
async def test_a_unit_in_another_process_is_reached_over_udp_multicast(bundle: Bundle, multicast_port: int) -> None:
    settings = CanBus(interface="udp_multicast", channel=GROUP, node_id=9, options={"port": multicast_port})
    served = subprocess.Popen(
        [sys.executable, "-c", SERVE, GROUP, str(multicast_port)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    try:
        assert served.stdout is not None
        assert await asyncio.to_thread(served.stdout.readline) == b"ready\n"
        async with connected(bundle, settings) as device:
            assert await device.read("serial_number") == bytes([77, 0, 0, 0])
            batches = await frames_of(device, 80)
    finally:
        served.communicate(timeout=180)
    decoder = CanDriver().decoder(bundle, "readings")
    readings = np.concatenate([decoder.feed(batch).readings for batch in batches])
    assert len(readings) >= 15
    np.testing.assert_allclose(readings, np.tile([0, 0, -2.4], (len(readings), 1)), atol=1e-6)

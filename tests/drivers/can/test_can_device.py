"""The driver's half of the conversation, by the bytes of CiA 301, with the device played by the test."""

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from typing import Any

import can
import pytest

from triaxcal_drivers.can.device import CanDevice
from triaxcal_drivers.can.driver import CanDriver
from triaxcal_drivers.can.model import CanBus
from triaxcal_drivers.catalogue import parse_bundle
from triaxcal_drivers.errors import BusError, DeviceAbsent, DeviceSilent, ProfileError, RegisterRefused
from triaxcal_drivers.interface import RawBatch, RawFlag
from triaxcal_drivers.profile import Bundle

START = (0x000, "01 05")
VENDOR = (0x605, "40 18 10 01 00 00 00 00"), (0x585, "43 18 10 01 41 49 52 54")
PRODUCT = (0x605, "40 18 10 02 00 00 00 00"), (0x585, "43 18 10 02 01 7a 00 00")
SERIAL = (0x605, "40 18 10 04 00 00 00 00"), (0x585, "43 18 10 04 4d 00 00 00")
Frame = tuple[int, str]
Exchange = tuple[Frame, Frame | None]
OPENING: list[Exchange] = [(START, None), VENDOR, PRODUCT, SERIAL, (START, None)]


class Peer:
    """The other end of the bus: expects frames and answers them."""

    def __init__(self, channel: str) -> None:
        self.bus = can.Bus(channel, "virtual", ignore_config=True)

    def send(self, identifier: int, data: str, **more: Any) -> None:
        self.bus.send(can.Message(arbitration_id=identifier, data=bytes.fromhex(data), is_extended_id=False, **more))

    async def converse(self, script: Sequence[Exchange]) -> None:
        for (identifier, request), answer in script:
            message = await asyncio.to_thread(self.bus.recv, 2.0)
            assert message is not None, f"expected {identifier:#x}: {request}"
            assert (message.arbitration_id, bytes(message.data).hex(" ")) == (identifier, request)
            if answer:
                self.send(*answer)


@pytest.fixture
def settings(request: pytest.FixtureRequest) -> CanBus:
    return CanBus(interface="virtual", channel=request.node.name, node_id=5)


@pytest.fixture
async def peer(settings: CanBus) -> AsyncIterator[Peer]:
    made = Peer(str(settings.channel))
    yield made
    made.bus.shutdown()


@pytest.fixture
async def closed(edited: Callable[..., Bundle], settings: CanBus) -> AsyncIterator[CanDevice]:
    bundle = edited(
        ("silence_timeout_s = 2.0", "silence_timeout_s = 0.2"),
        ("reply_timeout_s = 1.0", "reply_timeout_s = 0.2"),
    )
    made = CanDriver().device(bundle, settings)
    yield made
    await made.close()


@pytest.fixture
async def device(closed: CanDevice, peer: Peer) -> CanDevice:
    await asyncio.gather(closed.open(), peer.converse(OPENING))
    return closed


async def test_opening_starts_the_node_and_reads_who_it_is(closed: CanDevice, peer: Peer) -> None:
    await asyncio.gather(closed.open(), peer.converse(OPENING))


async def test_where_nothing_answers_the_device_is_absent(closed: CanDevice, peer: Peer) -> None:
    with pytest.raises(DeviceAbsent, match=r"^nothing answers at node 5 on virtual test_where_nothing"):
        await closed.open()


async def test_a_node_without_the_identity_object_is_not_the_device(closed: CanDevice, peer: Peer) -> None:
    refused = VENDOR[0], (0x585, "80 18 10 01 00 00 02 06")
    with pytest.raises(DeviceAbsent, match=r"is not a TRIAX-REF: .*0x06020000 Object does not exist$"):
        await asyncio.gather(closed.open(), peer.converse([(START, None), refused]))


NOT_YET = VENDOR[0], (0x585, "80 18 10 01 22 00 00 08")


async def test_a_node_that_does_not_say_yet_what_it_is_is_asked_again(closed: CanDevice, peer: Peer) -> None:
    await asyncio.gather(closed.open(), peer.converse([OPENING[0], NOT_YET, NOT_YET, *OPENING[1:]]))


async def test_a_node_that_never_says_what_it_is_is_not_called_another(
    closed: CanDevice, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("triaxcal_drivers.can.device.BUSY_S", 0.0)
    with pytest.raises(DeviceAbsent, match=r"^node 5 on .* does not say for 0 s what it is: .*0x08000022"):
        await asyncio.gather(closed.open(), peer.converse([OPENING[0], NOT_YET]))


@pytest.mark.parametrize(
    ("register", "request_", "answer", "raw"),
    [
        ("scale_factor_x", "40 00 21 01", "43 00 21 01 9a 99 19 c0", "9a9919c0"),
        ("status", "40 00 20 00", "4b 00 20 00 05 00 00 00", "0500"),
    ],
)
async def test_a_register_is_read_by_an_expedited_upload(
    device: CanDevice, peer: Peer, register: str, request_: str, answer: str, raw: str
) -> None:
    script = [((0x605, request_ + " 00 00 00 00"), (0x585, answer))]
    got, _ = await asyncio.gather(device.read(register), peer.converse(script))
    assert got.hex() == raw


@pytest.mark.parametrize(
    ("register", "raw", "request_", "answer"),
    [
        ("bias_x", "0000803e", "23 02 21 01 00 00 80 3e", "60 02 21 01 00 00 00 00"),
        ("unlock_key", "175a", "2b 10 20 00 17 5a 00 00", "60 10 20 00 00 00 00 00"),
    ],
)
async def test_a_register_is_written_by_an_expedited_download(
    device: CanDevice, peer: Peer, register: str, raw: str, request_: str, answer: str
) -> None:
    script = [((0x605, request_), (0x585, answer))]
    await asyncio.gather(device.write(register, bytes.fromhex(raw)), peer.converse(script))


async def test_a_refused_write_carries_the_devices_code(device: CanDevice, peer: Peer) -> None:
    script = [((0x605, "23 02 21 01 00 00 80 3e"), (0x585, "80 02 21 01 22 00 00 08"))]
    with pytest.raises(RegisterRefused) as caught:
        await asyncio.gather(device.write("bias_x", bytes.fromhex("0000803e")), peer.converse(script))
    assert (caught.value.register, caught.value.code) == ("bias_x", 0x08000022)
    assert str(caught.value).startswith("register bias_x (0x2102:01) of node 5 on virtual ")


async def test_a_request_without_an_answer_says_that_the_device_is_silent(device: CanDevice, peer: Peer) -> None:
    timed_out: Exchange = ((0x605, "80 00 00 00 00 00 04 05"), None)
    script = [((0x605, "40 00 20 00 00 00 00 00"), None), timed_out]
    outcomes = await asyncio.gather(device.read("status"), peer.converse(script), return_exceptions=True)
    assert isinstance(outcomes[0], DeviceSilent)
    assert "no valid answer within 0.2 s" in str(outcomes[0])
    assert outcomes[1] is None


async def test_an_answer_cut_short_is_no_answer(device: CanDevice, peer: Peer) -> None:
    script = [((0x605, "40 00 20 00 00 00 00 00"), (0x585, "4b 00"))]
    with pytest.raises(DeviceSilent):
        await asyncio.gather(device.read("status"), peer.converse(script))


@pytest.mark.parametrize(
    "foreign",
    [
        "43 00 21 02 aa aa aa aa",  # a late answer: of another register
        "60 00 21 01 00 00 00 00",  # to a write
        "80 00 21 02 00 00 02 06",  # a refusal of another register
    ],
)
async def test_an_answer_to_another_request_is_no_answer(device: CanDevice, peer: Peer, foreign: str) -> None:
    asked = (0x605, "40 00 21 01 00 00 00 00")

    async def answer() -> None:
        await peer.converse([(asked, (0x585, foreign))])
        peer.send(0x585, "43 00 21 01 9a 99 19 c0")

    got, _ = await asyncio.gather(device.read("scale_factor_x"), answer())
    assert got.hex() == "9a9919c0"


async def test_two_transfers_at_once_go_one_after_the_other(device: CanDevice, peer: Peer) -> None:
    script = [((0x605, f"40 02 21 {n:02x} 00 00 00 00"), (0x585, f"43 02 21 {n:02x} 0{n} 00 00 00")) for n in (1, 2)]
    x, y, _ = await asyncio.gather(device.read("bias_x"), device.read("bias_y"), peer.converse(script))
    assert (x, y) == (b"\1\0\0\0", b"\2\0\0\0")


async def first_batch(device: CanDevice, names: Sequence[str], send: Callable[[], None]) -> RawBatch:
    stream = device.stream(names)
    coming = asyncio.ensure_future(anext(stream))
    await asyncio.sleep(0)  # lets the stream begin
    send()
    return await coming


async def test_frames_of_the_named_streams_are_passed_raw(device: CanDevice, peer: Peer) -> None:
    def send() -> None:
        peer.send(0x185, "01 02 03 04 05 06 07 08")
        peer.send(0x385, "09")
        peer.send(0x705, "05")
        peer.send(0x285, "0a 0b")
        peer.send(0x186, "0c")

    batch = await first_batch(device, ["readings"], send)
    assert batch.source.tolist() == [0x185, 0x285]
    assert batch.payload.hex() == "01020304050607080a0b"
    assert batch.flags.tolist() == [0, 0]


async def test_error_frames_are_flagged(device: CanDevice, peer: Peer) -> None:
    def send() -> None:
        peer.send(0x004, "00 00 00 00 00 00 00 00", is_error_frame=True)

    batch = await first_batch(device, ["readings"], send)
    assert batch.flags.tolist() == [RawFlag.ERROR]


async def test_registers_answer_while_the_stream_runs(device: CanDevice, peer: Peer) -> None:
    stream = device.stream(["readings", "corrected"])
    coming = asyncio.ensure_future(anext(stream))
    script = [((0x605, "40 00 20 00 00 00 00 00"), (0x585, "4b 00 20 00 05 00 00 00"))]
    raw, _ = await asyncio.gather(device.read("status"), peer.converse(script))
    peer.send(0x485, "01")
    assert raw == b"\5\0"
    assert (await coming).source.tolist() == [0x485]


async def test_a_stream_that_stops_raises_device_silent(device: CanDevice, peer: Peer) -> None:
    stream = device.stream(["readings"])
    coming = asyncio.ensure_future(anext(stream))
    await asyncio.sleep(0)
    peer.send(0x185, "01")
    await coming
    with pytest.raises(DeviceSilent, match=r"node 5 on virtual .* has sent nothing of readings for 0.2 s"):
        await anext(stream)


async def test_error_frames_alone_do_not_break_the_silence(device: CanDevice, peer: Peer) -> None:
    stream, seen = device.stream(["readings"]), 0

    async def keep_failing() -> None:
        nonlocal seen
        while True:
            coming = asyncio.ensure_future(anext(stream))
            await asyncio.sleep(0)
            peer.send(0x004, "00", is_error_frame=True)
            assert (await coming).flags.tolist() == [RawFlag.ERROR]
            seen += 1

    with pytest.raises(DeviceSilent):
        await keep_failing()
    assert seen > 0


async def test_a_stream_that_the_profile_lacks_is_refused(device: CanDevice) -> None:
    with pytest.raises(ProfileError, match="no stream 'reading'; did you mean 'readings'"):
        await anext(device.stream(["reading"]))


async def test_a_device_that_only_streams_is_sent_nothing(
    edited: Callable[..., Bundle], settings: CanBus, peer: Peer
) -> None:
    bundle = edited()
    text = bundle.text.decode()
    lonely = text[: text.index("[registers]")]
    lonely = "\n".join(li for li in lonely.splitlines() if not li.startswith(("serial_register", "expect")))
    device = CanDriver().device(parse_bundle(lonely.encode(), bundle.files, where="unit.toml"), settings)
    await device.open()
    try:
        batch = await first_batch(device, ["readings"], lambda: peer.send(0x185, "01"))
    finally:
        await device.close()
    assert len(batch) == 1
    assert peer.bus.recv(0) is None


async def test_a_closed_device_says_so(closed: CanDevice) -> None:
    with pytest.raises(BusError, match="is not open"):
        await closed.read("status")


@pytest.mark.parametrize(
    ("interface", "channel"),
    [("no-such-interface", "a"), ("socketcan", "no-such-can0"), ("udp_multicast", "10.0.0.1")],
)
async def test_a_bus_that_cannot_be_opened_is_a_bus_error(bundle: Bundle, interface: str, channel: str) -> None:
    device = CanDriver().device(bundle, CanBus(interface=interface, channel=channel, node_id=5))
    with pytest.raises(BusError, match=rf"^cannot open {interface} {channel}: ") as caught:
        await device.open()
    assert "\n" not in str(caught.value)

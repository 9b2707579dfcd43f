"""The driver against bytes written by hand from the Modbus Application Protocol and its RTU and MBAP framings.

The RTU frames for unit 0x11 are the worked examples that circulate with the protocol (function 3 at 0x6B,
function 4 at 8, functions 6 and 16 at 1).
"""

import asyncio
import os
from contextlib import aclosing, suppress

import numpy as np
import pytest

from triaxcal_drivers.errors import (
    BusError,
    DeviceAbsent,
    DeviceBusy,
    DeviceSilent,
    ProfileError,
    RegisterRefused,
    RegisterValueError,
)
from triaxcal_drivers.interface import RawBatch, RawFlag
from triaxcal_drivers.modbus import line
from triaxcal_drivers.modbus.device import ModbusDevice
from triaxcal_drivers.modbus.model import ModbusBus

# The probe at opening: reads input register 8, which holds 10.
PROBE = ("0001 0000 0006 11 04 0008 0001", "0001 0000 0005 11 04 02 000A")
RTU_PROBE = ("11 04 00 08 00 01 B2 98", "11 04 02 00 0A F8 F4")


async def opened(bundle, heard) -> ModbusDevice:
    bus = (
        ModbusBus(serial_port=heard.path, parity="N", unit_id=17)
        if hasattr(heard, "path")
        else ModbusBus(host="127.0.0.1", port=heard.port, unit_id=17)
    )
    device = ModbusDevice(bundle.profile, bus, now_ns=lambda: 1_000)
    await device.open()
    return device


async def first_batches(device, stream, number):
    batches = []
    async with aclosing(device.stream([stream])) as records:
        async for batch in records:
            batches.append(batch)
            if len(batches) == number:
                break
    return batches


async def collect(device, streams, batches):
    async for batch in device.stream([streams] if isinstance(streams, str) else streams):
        batches.append(batch)


async def test_registers_are_read_and_written_over_tcp(bundle, tcp_device):
    exchanges = [
        PROBE,
        ("0002 0000 0006 11 03 0001 0002", "0002 0000 0007 11 03 04 000A 0102"),
        ("0003 0000 000B 11 10 0001 0002 04 000A 0102", "0003 0000 0006 11 10 0001 0002"),
        ("0004 0000 0009 11 10 0001 0001 02 0003", "0004 0000 0006 11 10 0001 0001"),
    ]
    async with tcp_device(*exchanges) as heard:
        device = await opened(bundle(), heard)
        assert await device.read("pair") == bytes.fromhex("000A 0102")
        await device.write("pair", bytes.fromhex("000A 0102"))
        await device.write("setting", b"\x00\x03")
        await device.close()
    assert len(heard) == 4


async def test_registers_are_read_and_written_over_a_serial_line(bundle, serial_device):
    exchanges = [
        RTU_PROBE,
        ("11 10 00 01 00 02 04 00 0A 01 02 C6 F0", "11 10 00 01 00 02 12 98"),
        ("11 06 00 01 00 03 9A 9B", "11 06 00 01 00 03 9A 9B"),
    ]
    async with serial_device(*exchanges) as heard:
        device = await opened(bundle(('name = "by-hand"', 'name = "by-hand"\nsingle_write = true')), heard)
        await device.write("pair", bytes.fromhex("000A 0102"))
        await device.write("setting", b"\x00\x03")
        await device.close()
    assert len(heard) == 3


SINGLE = ('name = "by-hand"', 'name = "by-hand"\nsingle_write = true')
ONLY_6 = "no answer to function 16; does the device support only 6? (single_write)"
ONLY_16 = "no answer to function 6; does the device support only 16? (single_write = false)"


@pytest.mark.parametrize(
    ("replaced", "register", "request_pdu", "exception", "words"),
    [
        ([], "setting", "10 0001 0001 02 0003", "90 01", ONLY_6),
        ([], "pair", "10 0001 0002 04 000A 0102", "90 01", ONLY_6),
        ([], "setting", "10 0001 0001 02 0003", None, ONLY_6),
        ([SINGLE], "setting", "06 0001 0003", "86 01", ONLY_16),
        ([SINGLE], "setting", "06 0001 0003", None, ONLY_16),
        ([SINGLE], "pair", "10 0001 0002 04 000A 0102", "90 01", "alone writes the 2 words of a uint32"),
        ([], "setting", "10 0001 0001 02 0003", "90 02", None),  # it has the function
        ([SINGLE], "setting", "06 0001 0003", "86 04", None),
    ],
)
async def test_a_function_that_the_unit_lacks_is_named_with_the_key(
    bundle, tcp_device, replaced, register, request_pdu, exception, words
):
    def framed(pdu, transaction=2):
        data = bytes.fromhex(f"11 {pdu}")
        return (bytes([0, transaction, 0, 0, 0, len(data)]) + data).hex()

    async with tcp_device(PROBE, (framed(request_pdu), framed(exception) if exception else None)) as heard:
        device = await opened(bundle(*replaced, hasty=True), heard)
        raw = {"setting": b"\x00\x03", "pair": bytes.fromhex("000A 0102")}[register]
        with pytest.raises(RegisterRefused if exception else DeviceSilent) as caught:
            await device.write(register, raw)
        await device.close()
    assert f"register {register} (0x0001) cannot be written" in str(caught.value)
    assert words in str(caught.value) if words else "single_write" not in str(caught.value)
    assert len(heard) == 2


async def test_silence_after_a_write_that_was_answered_says_nothing_of_functions(bundle, tcp_device):
    write = "0000 0009 11 10 0001 0001 02 0003"
    exchanges = [PROBE, (f"0002 {write}", "0002 0000 0006 11 10 0001 0001"), (f"0003 {write}", None)]
    async with tcp_device(*exchanges) as heard:
        device = await opened(bundle(hasty=True), heard)
        await device.write("setting", b"\x00\x03")
        with pytest.raises(DeviceSilent, match=r"no reply in 0\.2 s$"):
            await device.write("setting", b"\x00\x03")
        await device.close()


async def test_a_stream_is_polled_over_a_serial_line(bundle, serial_device):
    exchanges = [RTU_PROBE, ("11 03 00 6B 00 03 76 87", "11 03 06 AE 41 56 52 43 40 49 AD")]
    async with serial_device(*exchanges) as heard:
        device = await opened(bundle(), heard)
        (batch,) = await first_batches(device, "readings", 1)
        await device.close()
    assert batch.payload == bytes.fromhex("AE41 5652 4340")
    assert batch.source.tolist() == [0x0003_006B]
    assert batch.time_ns.tolist() == [1_000]
    assert not batch.flags.any()


async def test_registers_go_most_significant_first_whatever_order_the_device_keeps(bundle, tcp_device):
    exchanges = [
        PROBE,
        ("0002 0000 0006 11 03 0001 0002", "0002 0000 0007 11 03 04 0102 000A"),
        ("0003 0000 000B 11 10 0001 0002 04 0102 000A", "0003 0000 0006 11 10 0001 0002"),
    ]
    async with tcp_device(*exchanges) as heard:
        device = await opened(bundle(), heard)
        assert await device.read("twisted") == bytes.fromhex("000A 0102")
        await device.write("twisted", bytes.fromhex("000A 0102"))
        await device.close()
    assert len(heard) == 3


async def test_bytes_in_a_word_are_swapped_where_the_profile_says_so(bundle, tcp_device):
    exchanges = [PROBE, ("0002 0000 0006 11 03 0001 0002", "0002 0000 0007 11 03 04 0A00 0201")]
    async with tcp_device(*exchanges) as heard:
        device = await opened(bundle(('name = "by-hand"', 'name = "by-hand"\nbyte_order = "little"')), heard)
        assert await device.read("pair") == bytes.fromhex("000A 0102")
        await device.close()


@pytest.mark.parametrize("byte_order", ["big", "little"])
@pytest.mark.parametrize("word_order", ["big", "little"])
async def test_text_keeps_its_registers_in_order_whatever_the_order_of_words(
    bundle, tcp_device, byte_order, word_order
):
    wire = {"big": "5754 3535 3132 3334 3500", "little": "5457 3535 3231 3433 0035"}[byte_order]
    exchanges = [PROBE, ("0002 0000 0006 11 03 007F 0005", f"0002 0000 000D 11 03 0A {wire}")]
    text = f'sn = {{ address = 0x7F, type = "ascii", length = 9, byte_order = "{byte_order}", access = "ro" }}\n'
    made = bundle(
        ('name = "by-hand"', f'name = "by-hand"\nword_order = "{word_order}"'),
        ("[registers]\n", "[registers]\n" + text),
    )
    async with tcp_device(*exchanges) as heard:
        device = await opened(made, heard)
        raw = await device.read("sn")
        await device.close()
    assert raw == b"WT5512345"
    assert made.profile.text("sn", raw) == "WT5512345"


async def test_a_refused_register_names_itself_and_the_code(bundle, tcp_device):
    exchanges = [
        PROBE,
        ("0002 0000 0006 11 03 0001 0002", "0002 0000 0003 11 83 02"),
        ("0003 0000 0009 11 10 0001 0001 02 0003", "0003 0000 0003 11 90 04"),
    ]
    async with tcp_device(*exchanges) as heard:
        device = await opened(bundle(), heard)
        with pytest.raises(RegisterRefused) as refused:
            await device.read("pair")
        assert (refused.value.register, refused.value.code) == ("pair", 2)
        assert "register pair (0x0001) cannot be read: exception 0x02 (illegal data address)" in str(refused.value)
        with pytest.raises(RegisterRefused) as refused:
            await device.write("setting", b"\x00\x03")
        assert (refused.value.register, refused.value.code) == ("setting", 4)
        await device.close()


async def test_a_gateway_that_has_not_reached_the_device_is_no_refusal(bundle, tcp_device):
    exchanges = [
        PROBE,
        ("0002 0000 0006 11 03 0001 0002", "0002 0000 0003 11 83 0B"),
        ("0003 0000 0009 11 10 0001 0001 02 0003", "0003 0000 0003 11 90 0A"),
    ]
    async with tcp_device(*exchanges) as heard:
        device = await opened(bundle(), heard)
        said = r"register pair \(0x0001\) cannot be read: no contact: exception 0x0B \(gateway target device failed to"
        with pytest.raises(DeviceSilent, match=said):
            await device.read("pair")
        said = r"register setting \(0x0001\) cannot be written: no contact: exception 0x0A \(gateway path unavailable"
        with pytest.raises(DeviceSilent, match=said):
            await device.write("setting", b"\x00\x03")
        await device.close()


async def test_a_gateways_code_is_the_devices_own_where_the_profile_says_so(bundle, tcp_device):
    busy = ('name = "by-hand"', 'name = "by-hand"\nbusy_codes = [11]')
    exchanges = [
        (PROBE[0], "0001 0000 0003 11 84 0B"),
        ("0002 0000 0006 11 03 0001 0002", "0002 0000 0003 11 83 0B"),
    ]
    async with tcp_device(*exchanges) as heard:
        device = await opened(bundle(busy), heard)
        with pytest.raises(DeviceBusy, match=r"cannot be read: exception 0x0B"):
            await device.read("pair")
        await device.close()


async def test_a_register_of_the_wrong_length_is_not_sent(bundle, tcp_device):
    async with tcp_device(PROBE) as heard:
        device = await opened(bundle(), heard)
        with pytest.raises(RegisterValueError, match=r"register pair: 2 bytes, expected 4 \(uint32\)"):
            await device.write("pair", b"\0\0")
        with pytest.raises(RegisterValueError, match="an input register cannot be written"):
            await device.write("level", b"\0\0")
        with pytest.raises(ProfileError, match="no register named 'pear'"):
            await device.read("pear")
        await device.close()
    assert len(heard) == 1


async def test_a_late_reply_is_not_taken_for_the_next_one(bundle, tcp_device):
    exchanges = [
        PROBE,
        ("0002 0000 0006 11 03 0001 0001", None),
        ("0003 0000 0006 11 03 0001 0001", "0002 0000 0005 11 03 02 AAAA 0003 0000 0005 11 03 02 BBBB"),
    ]
    async with tcp_device(*exchanges) as heard:
        device = await opened(bundle(hasty=True), heard)
        with pytest.raises(DeviceSilent, match=r"unit 17: no reply in 0\.2 s"):
            await device.read("setting")
        assert await device.read("setting") == b"\xbb\xbb"
        await device.close()


async def test_a_reply_of_another_unit_is_no_answer(bundle, tcp_device):
    other_then_own = "0002 0000 0005 12 03 02 AAAA 0002 0000 0005 11 03 02 BBBB"
    async with tcp_device(PROBE, ("0002 0000 0006 11 03 0001 0001", other_then_own)) as heard:
        device = await opened(bundle(), heard)
        assert await device.read("setting") == b"\xbb\xbb"
        await device.close()


async def test_a_frame_with_a_wrong_crc_is_no_answer(bundle, serial_device):
    async with serial_device(RTU_PROBE, ("11 03 00 01 00 01 D7 5A", "11 03 02 00 0A F9 81")) as heard:
        device = await opened(bundle(hasty=True), heard)
        with pytest.raises(DeviceSilent):
            await device.read("setting")
        await device.close()
    assert len(heard) == 2


async def test_a_late_reply_on_a_serial_line_is_waited_out(bundle):
    """RTU frames have no transaction number: the reply to the first request must not answer the second."""
    master, slave = os.openpty()
    loop = asyncio.get_running_loop()
    replies = ["11 04 02 00 0A F8 F4", None, "11 03 02 00 0B 38 40"]

    def answer() -> None:
        os.read(master, 64)
        if (reply := replies.pop(0)) is not None:
            os.write(master, bytes.fromhex(reply))

    loop.add_reader(master, answer)
    line = ModbusBus(serial_port=os.ttyname(slave), parity="N", unit_id=17)
    device = ModbusDevice(bundle(hasty=True).profile, line)
    await device.open()
    with pytest.raises(DeviceSilent):
        await device.read("setting")
    os.write(master, bytes.fromhex("11 03 02 00 0A F9 80"))  # the reply to the first, too late
    assert await device.read("setting") == b"\x00\x0b"
    await device.close()
    loop.remove_reader(master)
    os.close(master)
    os.close(slave)


async def test_a_late_reply_on_a_serial_line_does_not_show_that_the_device_is_back(bundle, monkeypatch):
    master, slave = os.openpty()
    loop = asyncio.get_running_loop()
    replies = ["11 04 02 00 0A F8 F4", None, None, None]

    def answer() -> None:
        os.read(master, 64)
        if (reply := replies.pop(0)) is not None:
            os.write(master, bytes.fromhex(reply))

    loop.add_reader(master, answer)
    device = ModbusDevice(bundle(hasty=True).profile, ModbusBus(serial_port=os.ttyname(slave), parity="N", unit_id=17))
    await device.open()
    with pytest.raises(DeviceSilent):
        await device.read("setting")
    open_serial = line._open_serial

    async def open_and_hear_the_late_reply(*where):
        link = await open_serial(*where)
        os.write(master, bytes.fromhex("11 03 02 00 0A F9 80"))
        return link

    monkeypatch.setattr(line, "_open_serial", open_and_hear_the_late_reply)
    with pytest.raises(DeviceAbsent):
        await device.open()
    loop.remove_reader(master)
    os.close(master)
    os.close(slave)


async def test_failed_requests_are_records_with_flags(bundle, tcp_device):
    ask = "0000 0006 11 03 006B 0003"
    exchanges = [
        PROBE,
        (f"0002 {ask}", "0002 0000 0003 11 83 06"),  # an exception
        (f"0003 {ask}", "0003 0000 0007 11 03 04 0001 0002"),  # two words in place of three
        (f"0004 {ask}", None),  # nothing
        (f"0005 {ask}", "0005 0000 0009 11 04 06 0001 0002 0003"),  # another function
        (f"0006 {ask}", "0006 0000 0007 11 03 06 0001 0002"),  # fewer words than it says
        (f"0007 {ask}", "0007 0000 0003 11 83 0B"),  # a gateway that has not reached it
        (f"0008 {ask}", "0008 0000 0009 11 03 06 0001 0002 0003"),
    ]
    async with tcp_device(*exchanges) as heard:
        device = await opened(bundle(hasty=True), heard)
        batches = await first_batches(device, "readings", 7)
        await device.close()
    assert [int(b.flags[0]) for b in batches] == [
        RawFlag.ERROR,
        RawFlag.INVALID,
        RawFlag.ERROR,
        RawFlag.INVALID,
        RawFlag.INVALID,
        RawFlag.ERROR,
        0,
    ]
    assert [b.payload.hex() for b in batches] == [
        "06",
        "030400010002",
        "",
        "0406000100020003",
        "030600010002",
        "0b",
        "000100020003",
    ]
    assert {int(b.source[0]) for b in batches} == {0x0003_006B}


ASK_FIFO = "0000 0006 11 04 0020 000A"


def window(transaction: str, count: str, remaining: str, *counters: str) -> tuple[str, str]:
    """A read of the FIFO's window and its reply, with records 1, 2, 3 and their counter."""
    records = "".join(f"0001 0002 0003 {c}" for c in counters) + "0000" * 4 * (2 - len(counters))
    return f"{transaction} {ASK_FIFO}", f"{transaction} 0000 0017 11 04 14 {count} {remaining} {records}"


async def test_a_fifo_is_read_again_at_once_while_records_remain(bundle, tcp_device):
    exchanges = [
        PROBE,
        window("0002", "0000", "0000"),
        window("0003", "0002", "0002", "0000", "0001"),
        window("0004", "0002", "0000", "0002", "0003"),
    ]
    async with tcp_device(*exchanges) as heard:
        device = await opened(bundle(("poll_period_s = 0.001", "poll_period_s = 60.0")), heard)
        (batch,) = await first_batches(device, "queue", 1)
        await device.close()
    assert len(heard) == 4
    np.testing.assert_array_equal(batch.length, [20, 20])


async def test_what_the_fifo_holds_when_a_stream_is_opened_is_discarded_by_its_count(bundle, tcp_device):
    """Five records at the first reply; new ones keep coming, so that it is never empty."""
    exchanges = [
        PROBE,
        window("0002", "0002", "0003", "0001", "0002"),
        window("0003", "0002", "0002", "0003", "0004"),
        window("0004", "0002", "0003", "0005", "0006"),
        window("0005", "0002", "0000", "0007", "0008"),
    ]
    async with tcp_device(*exchanges) as heard:
        device = await opened(bundle(), heard)
        (batch,) = await first_batches(device, "queue", 1)
        assert device.discarded == 6
        await device.close()
    assert batch.payload.hex().endswith("00010002000300070001000200030008")
    assert len(batch) == 1


async def test_a_fifo_that_does_not_say_what_remains_is_emptied_first(bundle, tcp_device):
    exchanges = [
        PROBE,
        window("0002", "0002", "FFFF", "0001", "0002"),
        window("0003", "0002", "FFFF", "0003", "0004"),
        window("0004", "0001", "FFFF", "0005"),
        window("0005", "0001", "FFFF", "0006"),
    ]
    async with tcp_device(*exchanges) as heard:
        device = await opened(bundle((", remaining = 1", "")), heard)
        (batch,) = await first_batches(device, "queue", 1)
        assert device.discarded == 5
        await device.close()
    assert batch.payload.hex().endswith("0001000200030006" + "0000" * 4)


async def test_a_fifo_that_fills_as_fast_as_it_is_read_is_not_discarded_for_ever(bundle, tcp_device, monkeypatch):
    monkeypatch.setattr("triaxcal_drivers.modbus.device._DISCARD_S", 0.05)
    full = [window(f"{i:04X}", "0002", "FFFF", "0001", "0002") for i in range(2, 2000)]
    async with tcp_device(PROBE, *full) as heard:
        device = await opened(bundle((", remaining = 1", "")), heard)
        (batch,) = await first_batches(device, "queue", 1)
        assert device.discarded + 2 * len(batch) == 2 * (len(heard) - 1)
        await device.close()


async def test_a_request_that_fails_while_discarding_is_tried_again(bundle, tcp_device):
    exchanges = [
        PROBE,
        (f"0002 {ASK_FIFO}", "0002 0000 0003 11 84 06"),  # an exception: busy
        window("0003", "0009", "FFFF", "0001", "0002"),  # more than a window holds
        window("0004", "0002", "0002", "0001", "0002"),
        (f"0005 {ASK_FIFO}", "0005 0000 0003 11 84 06"),
        window("0006", "0002", "0000", "0003", "0004"),
        window("0007", "0001", "0000", "0005"),
    ]
    async with tcp_device(*exchanges) as heard:
        device = await opened(bundle(), heard)
        (batch,) = await first_batches(device, "queue", 1)
        assert device.discarded == 4
        await device.close()
    assert batch.payload.hex().endswith("0001000200030005" + "0000" * 4)


@pytest.mark.parametrize(
    ("reply", "words"),
    [
        ("0003 11 84 04", r"exception 0x04"),
        ("0017 11 04 14 0000 0005" + "0000" * 8, "its FIFO stays empty"),  # though it says that records remain
    ],
)
async def test_a_device_that_gives_nothing_to_discard_is_silent(bundle, tcp_device, reply, words):
    never = [(f"{i:04X} {ASK_FIFO}", f"{i:04X} 0000 {reply}") for i in range(2, 2000)]
    async with tcp_device(PROBE, *never) as heard:
        device = await opened(bundle(hasty=True), heard)
        with pytest.raises(DeviceSilent, match=rf"stream queue has been silent .*{words}"):
            await first_batches(device, "queue", 1)
        await device.close()


@pytest.mark.parametrize(("code", "why"), [("04", "exception 0x04"), ("0B", "no contact: exception 0x0B")])
async def test_a_stream_that_fails_for_long_is_silent_and_says_why(bundle, tcp_device, code, why):
    refusals = [(f"{i:04X} 0000 0006 11 03 006B 0003", f"{i:04X} 0000 0003 11 83 {code}") for i in range(2, 2000)]
    async with tcp_device(PROBE, *refusals) as heard:
        device = await opened(bundle(hasty=True), heard)
        batches = []
        with pytest.raises(DeviceSilent, match=rf"stream readings has been silent .* s: {why}") as silent:
            await collect(device, "readings", batches)
        assert silent.value.stream is None, "there is no other that goes on"
        assert sum(map(len, batches)) == len(heard) - 1
        await device.close()


async def test_a_stream_that_is_refused_beside_another_is_told_by_name(bundle):
    """Function 3 is answered by exception 2, function 4 by 10 to the probe and by one record of the FIFO."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                request = await reader.readexactly(12)
                record = "04 14 0001 0000" + "0001" * 8
                reply = {b"\x03\x00": "83 02", b"\x04\x00": record}[request[7:9]]
                reply = "04 02 000A" if request[7:] == bytes.fromhex("04 0008 0001") else reply
                pdu = bytes.fromhex(reply)
                writer.write(request[:4] + (1 + len(pdu)).to_bytes(2, "big") + request[6:7] + pdu)
        writer.close()

    async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
        bus = ModbusBus(host="127.0.0.1", port=server.sockets[0].getsockname()[1], unit_id=17)
        device = ModbusDevice(bundle(hasty=True).profile, bus)
        await device.open()
        with pytest.raises(DeviceSilent, match=r"stream readings .*exception 0x02") as silent:
            await collect(device, ["readings", "queue"], [])
        assert silent.value.stream == "readings"
        assert silent.value.source == 3 << 16 | 0x6B
        await device.close()


async def test_a_fifo_that_stays_empty_is_silent(bundle, tcp_device):
    empty = [
        (f"{i:04X} 0000 0006 11 04 0020 000A", f"{i:04X} 0000 0017 11 04 14" + "0000" * 10) for i in range(2, 2000)
    ]
    async with tcp_device(PROBE, *empty) as heard:
        device = await opened(bundle(hasty=True), heard)
        batches: list[RawBatch] = []
        with pytest.raises(DeviceSilent, match="its FIFO stays empty"):
            await collect(device, "queue", batches)
        assert sum(map(len, batches)) == 0, "a unit that answers, and brings nothing, is not back"
        await device.close()


async def test_a_refused_connection_says_where(bundle, tcp_device):
    async with tcp_device() as heard:
        port = heard.port
    device = ModbusDevice(bundle().profile, ModbusBus(host="127.0.0.1", port=port))
    with pytest.raises(BusError, match=f"^cannot connect to 127.0.0.1:{port}: Connection refused$"):
        await device.open()


async def test_a_missing_serial_port_says_which(bundle):
    device = ModbusDevice(bundle().profile, ModbusBus(serial_port="/dev/ttyNONE"))
    with pytest.raises(BusError, match=r"^cannot open /dev/ttyNONE: No such file or directory$"):
        await device.open()


async def test_a_device_that_never_answers_is_absent(bundle, tcp_device):
    async with tcp_device((PROBE[0], None), ("0002" + PROBE[0][4:], None)) as heard:
        with pytest.raises(DeviceAbsent, match=r"^nothing answers at .* unit 17: no reply in 0\.2 s$"):
            await opened(bundle(hasty=True), heard)
    assert len(heard) == 2


@pytest.mark.parametrize(
    ("reply", "words"),
    [
        ("{n} 0000 0005 FF 04 02 000A", "a reply came as unit 255"),
        ("0000 0000 0005 11 04 02 000A", "a reply came as transaction 0, expected 2"),
        ("{n} 0000 0005 11 04 02", "9 bytes came, and no whole reply"),
        ("0000 0001 0000 05", "7 bytes came, and no whole reply"),  # of another protocol
    ],
)
async def test_what_came_in_place_of_a_reply_is_said(bundle, tcp_device, reply, words):
    exchanges = [(n + PROBE[0][4:], reply.format(n=n)) for n in ("0001", "0002")]
    async with tcp_device(*exchanges) as heard:
        with pytest.raises(DeviceAbsent, match=rf"^127\.0\.0\.1:\d+ unit 17: no reply in 0\.2 s; {words}$"):
            await opened(bundle(hasty=True), heard)
    assert len(heard) == 2


async def test_an_adapter_that_echoes_is_called_one(bundle, serial_device):
    echo = RTU_PROBE[0], RTU_PROBE[0] + RTU_PROBE[1]
    async with serial_device(echo, echo) as heard:
        with pytest.raises(DeviceAbsent, match=r"unit 17: no reply in 0\.2 s; what is sent comes back: the adapter"):
            await opened(bundle(hasty=True), heard)


async def test_a_stream_says_what_comes_in_place_of_its_replies(bundle, tcp_device):
    asked = [(f"{i:04X} 0000 0006 11 03 006B 0003", f"{i:04X} 0000 0003 12 83 04") for i in range(2, 2000)]
    async with tcp_device(PROBE, *asked) as heard:
        device = await opened(bundle(hasty=True), heard)
        with pytest.raises(DeviceSilent, match=r"silent for .* s: no reply in 0\.2 s; a reply came as unit 18$"):
            await collect(device, "readings", [])
        await device.close()


async def test_a_device_that_its_gateway_does_not_reach_is_absent(bundle, tcp_device):
    again = "0002" + PROBE[0][4:]
    async with tcp_device((PROBE[0], "0001 0000 0003 11 84 0B"), (again, "0002 0000 0003 11 84 0B")) as heard:
        with pytest.raises(DeviceAbsent, match=r"^nothing answers at .* unit 17: no contact: exception 0x0B \(gateway"):
            await opened(bundle(), heard)
    assert len(heard) == 2
    async with tcp_device((PROBE[0], "0001 0000 0003 11 84 0A"), (again, "0002" + PROBE[1][4:])) as heard:
        device = await opened(bundle(), heard)
        await device.close()


async def test_an_exception_shows_that_the_device_is_there(bundle, tcp_device):
    async with tcp_device((PROBE[0], "0001 0000 0003 11 84 02")) as heard:
        device = await opened(bundle(), heard)
        await device.close()


async def test_a_connection_that_breaks_is_a_fault_of_the_bus(bundle):
    async def hang_up(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readexactly(12)
        writer.write(bytes.fromhex(PROBE[1]))
        await reader.readexactly(12)
        writer.close()

    async with await asyncio.start_server(hang_up, "127.0.0.1", 0) as server:
        port = server.sockets[0].getsockname()[1]
        device = ModbusDevice(bundle().profile, ModbusBus(host="127.0.0.1", port=port, unit_id=17))
        await device.open()
        with pytest.raises(BusError, match="the connection was lost"):
            await device.read("setting")
        with pytest.raises(BusError, match="the connection is closed"):
            await device.read("setting")
        await device.close()
        with pytest.raises(BusError, match="the device is not open"):
            await device.read("setting")

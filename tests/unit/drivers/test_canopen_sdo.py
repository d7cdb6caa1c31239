"""The SDO client against a real server object, with late, foreign and missing answers."""

import asyncio

import pytest

from docking.errors import BadReply, DeviceRefused, DeviceSilent
from docking.ports import CanFrame
from drivers.canopen.sdo import SdoClient
from drivers.maps.objects import ObjectEntry, load_object_map
from sim.canopen.dictionary import Dictionary
from sim.canopen.sdo_server import SdoServer
from sim.canopen.settings import DriveSettings
from sim.virtual_time import run_virtual

MAP = load_object_map("cia402")


class Wire:
    """Client and server of node 5 joined without delay; `twist` may change an answer (None = lost)."""

    def __init__(self) -> None:
        self.server = SdoServer(Dictionary(5, DriveSettings(), lambda i, s: None, lambda i, s, v: None, lambda: False))
        self.client = SdoClient("A.Y", 5, self.send, MAP.abort_text, 0.5)
        self.sent: list[CanFrame] = []
        self.twist = lambda answer: answer

    def send(self, frames: list[CanFrame]) -> None:
        self.sent += frames
        for cob, data in frames:
            assert cob == 0x605
            answer = self.server.answer(data)
            answer = None if answer is None else self.twist(answer)
            if answer is not None:
                self.client.on_reply(answer)


def test_expedited_read_and_write() -> None:
    async def main() -> None:
        wire = Wire()
        assert await wire.client.read(MAP.objects["serial"]) == 402_005
        await wire.client.write(MAP.objects["soft_limit_min"], -4_500_000)
        assert await wire.client.read(MAP.objects["soft_limit_min"]) == -4_500_000
        assert wire.client.stray == 0

    run_virtual(main)


def test_segmented_read() -> None:
    async def main() -> None:
        wire = Wire()
        assert await wire.client.read_bytes(MAP.objects["device_name"]) == b"Simulated positioner drive"
        assert len(wire.sent) == 1 + 4

    run_virtual(main)


def test_a_text_that_the_device_does_not_have_is_empty() -> None:
    async def main() -> None:
        wire = Wire()
        assert await wire.client.read_text(MAP.objects["device_name"]) == "Simulated positioner drive"
        assert await wire.client.read_text(ObjectEntry("nothing", 0x5555, 0, "text")) == ""

    run_virtual(main)


def test_segmented_write_is_refused_with_words() -> None:
    async def main() -> None:
        wire = Wire()
        with pytest.raises(DeviceRefused) as caught:
            await wire.client.write_bytes(MAP.objects["device_name"], b"another name")
        assert caught.value.where == "A.Y"
        assert caught.value.value == "06010002h"
        assert "read-only" in caught.value.cause
        assert "1008h:00" in caught.value.cause

    run_virtual(main)


def test_abort_texts() -> None:
    async def main() -> None:
        wire = Wire()
        for entry, value in (
            (ObjectEntry("nothing", 0x5555, 0, "u8"), "06020000h"),
            (ObjectEntry("nothing", 0x1018, 9, "u8"), "06090011h"),
        ):
            with pytest.raises(DeviceRefused) as caught:
                await wire.client.read(entry)
            assert caught.value.value == value

    run_virtual(main)


def test_silence_is_named_after_the_deadline() -> None:
    async def main() -> float:
        import asyncio

        wire = Wire()
        wire.twist = lambda answer: None
        with pytest.raises(DeviceSilent) as caught:
            await wire.client.read(MAP.objects["vendor"])
        assert caught.value.where == "A.Y"
        assert "1018h:01" in caught.value.cause
        assert wire.sent[-1][1] == bytes.fromhex("8018100100000405"), "the server is told to give up"
        return asyncio.get_running_loop().time()

    assert run_virtual(main) == pytest.approx(0.5)


def test_answer_to_another_question_is_not_taken() -> None:
    async def main() -> None:
        wire = Wire()
        wire.twist = lambda answer: answer[:1] + b"\x17\x10\x00" + answer[4:]
        with pytest.raises(DeviceSilent):
            await wire.client.read(MAP.objects["vendor"])
        assert wire.client.stray == 1

    run_virtual(main)


def test_two_answers_are_counted() -> None:
    async def main() -> None:
        wire = Wire()

        def twice(answer: bytes) -> bytes:
            wire.client.on_reply(answer)
            return answer

        wire.twist = twice
        await wire.client.read(MAP.objects["vendor"])
        assert wire.client.stray == 1

    run_virtual(main)


def test_wrong_length_and_toggle() -> None:
    async def main() -> None:
        wire = Wire()
        wire.twist = lambda answer: bytes((0x4F,)) + answer[1:]
        with pytest.raises(BadReply):
            await wire.client.read(MAP.objects["vendor"])
        wire = Wire()
        wire.twist = lambda answer: bytes((answer[0] | 0x10,)) + answer[1:] if answer[0] < 0x20 else answer
        with pytest.raises(BadReply, match="toggle"):
            await wire.client.read_bytes(MAP.objects["device_name"])

    run_virtual(main)


def test_a_text_of_another_length_than_announced_or_without_an_end_is_not_taken() -> None:
    async def main() -> None:
        wire = Wire()
        wire.twist = lambda answer: answer[:4] + b"\x05\0\0\0" if answer[0] == 0x41 else answer
        with pytest.raises(BadReply, match="5 bytes announced"):
            await wire.client.read_bytes(MAP.objects["device_name"])
        wire = Wire()
        toggle = 0

        def endless(answer: bytes) -> bytes:
            nonlocal toggle
            if answer[0] == 0x41:
                return answer
            toggle ^= 0x10
            return bytes((toggle ^ 0x10,)) + b"endless"

        wire.twist = endless
        with pytest.raises(BadReply, match="does not end"):
            await wire.client.read_bytes(MAP.objects["device_name"])
        assert len(wire.sent) < 600

    run_virtual(main)


@pytest.mark.parametrize("turns", [0, 1, 3], ids=["in the same turn", "one turn later", "three turns later"])
def test_the_answer_to_a_request_that_was_given_up_is_no_second_device(turns: int) -> None:
    async def main() -> None:
        wire = Wire()
        wire.twist = lambda answer: None
        task = asyncio.ensure_future(wire.client.read(MAP.objects["serial"]))
        await asyncio.sleep(0.001)
        task.cancel()
        for _ in range(turns):
            await asyncio.sleep(0)
        answer = wire.server.answer(wire.sent[-1][1])
        assert answer is not None
        wire.client.on_reply(answer)
        await asyncio.gather(task, return_exceptions=True)
        wire.twist = lambda answer: answer
        assert await wire.client.read(MAP.objects["serial"]) == 402_005
        assert wire.client.stray == 0
        wire.client.on_reply(answer)
        assert wire.client.stray == 1

    run_virtual(main)

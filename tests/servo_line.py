"""Virtual servos on a wire without a wire, in time that the test moves by hand."""

from __future__ import annotations

from graderd.drivers.dynamixel.codec import (
    Instruction,
    Packet,
    StreamDecoder,
    encode,
)
from graderd.simulator.servo import VirtualServo
from graderd.simulator.servo.line import answers


class Line:
    """Servos on a wire without a wire."""

    def __init__(self, *servos: VirtualServo) -> None:
        self.servos = servos
        self.now_s = 0.0
        self.run(0.0)

    def run(self, seconds: float, fed: bool = False) -> None:
        end_s = self.now_s + seconds
        while self.now_s < end_s - 1e-9:
            self.now_s = min(end_s, self.now_s + 0.01)
            for servo in self.servos:
                if fed:
                    servo.note_traffic(self.now_s)
                servo.advance(self.now_s)
        for servo in self.servos:
            servo.advance(self.now_s)

    def ask(self, servo_id: int, instruction: int, params: bytes = b"") -> list[Packet]:
        (request,) = StreamDecoder().feed(encode(servo_id, instruction, params))
        decoder = StreamDecoder()
        return [p for _, raw in answers(self.servos, request, self.now_s) for p in decoder.feed(raw)]

    def write(self, name: str, value: int, servo_id: int = 1, instruction: int = Instruction.WRITE) -> int | None:
        register = self.servos[0].table[name]
        replies = self.ask(servo_id, instruction, register.address.to_bytes(2, "little") + register.encode(value))
        return replies[0].error if replies else None

    def read(self, name: str, servo_id: int = 1) -> int:
        register = self.servos[0].table[name]
        params = register.address.to_bytes(2, "little") + register.size.to_bytes(2, "little")
        (reply,) = self.ask(servo_id, Instruction.READ, params)
        assert reply.error == 0
        return register.decode(reply.data)


def moving(line: Line, velocity: int = 500, goal: int = 250_000) -> None:
    for name, value in (("profile_acceleration", 600), ("profile_velocity", velocity), ("torque_enable", 1)):
        assert line.write(name, value) == 0
    assert line.write("goal_position", goal) == 0

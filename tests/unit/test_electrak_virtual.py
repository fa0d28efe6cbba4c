"""The virtual actuator behaves as the manual and a capture of a real unit say."""

from __future__ import annotations

import pytest

from graderd.drivers.electrak.codec import Control, ElectrakCodec, Feedback
from graderd.drivers.j1939.ids import Frame, Pgn, make_id, pgn_of, source_of
from graderd.drivers.j1939.name import Name
from graderd.simulator.actuators import VirtualElectrak

CODEC = ElectrakCodec("electrak_hd")


class Bench:
    """One actuator and a controller that sends the same control message every 100 ms."""

    def __init__(self, unit: VirtualElectrak) -> None:
        self.unit = unit
        self.now_s = 0.0
        self.control: Control | None = None
        self.source = 0
        self.sent: list[tuple[float, Frame]] = []
        self._due_s = 0.0
        unit.advance(0.0)

    def run(self, seconds: float) -> Bench:
        end_s = self.now_s + seconds
        while self.now_s < end_s - 1e-9:
            if self.control is not None and self.now_s >= self._due_s - 1e-9:
                self._due_s = self.now_s + 0.1
                self.send(
                    Frame(
                        make_id(6, Pgn.PROPRIETARY_A, self.source, self.unit.address),
                        CODEC.encode_control(self.control),
                    )
                )
            self.now_s += 0.005
            self.sent += [(self.now_s, frame) for frame in self.unit.advance(self.now_s)]
        return self

    def send(self, frame: Frame) -> None:
        self.unit.on_frame(frame, self.now_s)

    def go(self, target_mm: float, *, limit_a: float = 18.0, speed: float = 50.0, enable: bool = True) -> Bench:
        self.control = Control(target_mm, limit_a, speed, motion_enable=enable)
        return self

    def feedback(self) -> list[tuple[float, Feedback]]:
        return [(t, CODEC.decode_feedback(f.data)) for t, f in self.sent if pgn_of(f.can_id) == Pgn.PROPRIETARY_A2]

    def last(self) -> Feedback:
        return self.feedback()[-1][1]


def awake(position_mm: float = 140.0, **changes: object) -> Bench:
    bench = Bench(VirtualElectrak(position_mm=position_mm, seed=3, **changes))  # type: ignore[arg-type]
    bench.go(position_mm, enable=False).run(1.0)
    return bench


def test_it_wakes_up_as_the_captured_unit_did() -> None:
    bench = Bench(VirtualElectrak(position_mm=141.4, seed=1))
    bench.run(0.5)
    assert bench.sent == [], "a sleeping unit sends nothing"
    start_s = bench.now_s
    bench.go(160.0).run(1.0)
    claim_s, claim = bench.sent[0]
    assert claim == Frame(0x18EEFF13, bytes.fromhex("0100604400FF0080"))
    assert claim_s - start_s <= 0.165
    first_s, first = bench.feedback()[0]
    assert first_s - start_s <= 0.295
    assert first.position_mm == pytest.approx(141.4, abs=0.11)
    moving_s = next(t for t, f in bench.feedback() if f.moving)
    assert moving_s - start_s <= 0.75


def test_it_sleeps_after_five_seconds_without_a_control_message_and_only_then() -> None:
    bench = awake()
    bench.control = None
    awake_after = {seconds: bench.run(seconds).unit.awake for seconds in (4.5, 0.7)}
    assert awake_after == {4.5: True, 0.7: False}
    heard_n = len(bench.sent)
    bench.run(2.0)
    assert len(bench.sent) == heard_n


def test_feedback_comes_every_105_ms_with_the_factory_bits_one_by_default() -> None:
    bench = awake().run(10.0)
    times = [t for t, _ in bench.feedback()]
    assert (times[-1] - times[0]) / (len(times) - 1) == pytest.approx(0.105, abs=0.002)
    assert bench.sent[-1][1].can_id == 0x19EFFF13
    assert bench.sent[-1][1].data[4:] == bytes.fromhex("C0FFFFFF")
    bench.unit.behaviour.factory_ones = False
    bench.run(0.3)
    assert bench.sent[-1][1].data[4:] == bytes(4)


def test_soft_start_speed_taper_and_dead_zone_follow_the_capture() -> None:
    bench = awake(100.0).go(180.0).run(6.0)
    moving = [f for _, f in bench.feedback() if f.moving]
    assert moving[0].duty_percent < 50, "the motor starts softly"
    full = [f for f in moving if f.duty_percent == 50 and 110 < f.position_mm < 170]
    speed = (full[-1].position_mm - full[0].position_mm) / (0.105 * (len(full) - 1))
    assert speed == pytest.approx(33.2, abs=1.0)
    assert all(f.duty_percent <= 35 for f in moving if f.position_mm > 174.5)
    assert 0.7 <= 180.0 - bench.unit.position_mm <= 1.5


def test_a_small_error_does_not_start_the_motor() -> None:
    bench = awake(100.0).go(101.5).run(2.0)
    assert bench.unit.position_mm == 100.0
    bench.go(102.5).run(2.0)
    assert bench.unit.position_mm > 101.0


def test_a_move_goes_on_when_control_messages_stop_or_ends_where_so_set() -> None:
    bench = awake(50.0).go(250.0).run(1.5)
    bench.control = None
    bench.run(4.9)
    assert bench.unit.position_mm > 195.0
    bench = awake(20.0)
    bench.unit.behaviour.acm_loss = "stop"
    bench.unit.behaviour.speed_factor = 0.3
    bench.go(290.0).run(1.5)
    bench.control = None
    bench.run(20.0)
    assert bench.unit.position_mm < 100.0


def test_overload_stops_latches_and_is_reset_by_motion_disabled() -> None:
    bench = awake(100.0)
    bench.unit.load_n = 1500.0  # 16 A
    bench.go(200.0, limit_a=10.0).run(1.5)
    assert "overload" in bench.last().flags
    stood_mm = bench.unit.position_mm
    assert stood_mm < 115.0
    bench.run(1.0)
    assert bench.unit.position_mm == stood_mm
    bench.go(200.0, enable=False).run(0.3)
    assert not bench.unit.overloaded
    bench.go(200.0, limit_a=18.0).run(4.0)
    assert bench.unit.position_mm > 195.0


def test_inrush_does_not_trip_the_limit() -> None:
    bench = awake(100.0).go(150.0, limit_a=4.0).run(3.0)
    assert bench.unit.position_mm > 148.0


def test_load_slows_it_and_takes_current() -> None:
    speeds, currents = [], []
    for load_n in (0.0, 1700.0):
        bench = awake(50.0)
        bench.unit.load_n = load_n
        bench.go(280.0, speed=100.0, limit_a=25.0).run(2.0)
        speeds.append(bench.unit.velocity_mm_per_s)
        currents.append(bench.last().current_a)
    assert speeds == [pytest.approx(71 * 0.97, abs=0.5), pytest.approx(58 * 0.97, abs=0.5)]
    assert currents == [pytest.approx(3.0), pytest.approx(18.0)]
    assert "saturation" in bench.last().flags


def test_below_20_percent_duty_the_motor_does_not_run() -> None:
    bench = awake(100.0).go(200.0, speed=15.0).run(2.0)
    assert bench.unit.position_mm == 100.0


@pytest.mark.parametrize("refuses", [False, True])
def test_a_bad_control_message_sets_the_parameter_flag(refuses: bool) -> None:
    bench = awake(100.0)
    bench.unit.behaviour.parameter_refuses_motion = refuses
    bench.go(200.0).run(0.8)
    bench.go(305.0).run(0.3)
    assert "parameter" in bench.last().flags
    bench.run(4.0)
    if refuses:
        assert bench.unit.position_mm < 160.0
    else:
        assert bench.unit.position_mm == pytest.approx(198.9, abs=0.5), "the last good target stays"


@pytest.mark.parametrize(
    ("trait", "value", "flag"),
    [("supply_v", 8.0, "voltage_low"), ("supply_v", 17.0, "voltage_high"), ("temperature_c", 90.0, "temperature_high")],
)
def test_out_of_range_supply_or_temperature_finishes_a_move_and_refuses_the_next(
    trait: str, value: float, flag: str
) -> None:
    bench = awake(100.0).go(150.0).run(0.8)
    setattr(bench.unit, trait, value)
    bench.run(3.0)
    assert bench.unit.position_mm == pytest.approx(148.9, abs=0.5)
    assert flag in bench.last().flags
    bench.go(200.0).run(2.0)
    assert bench.unit.position_mm < 151.0


def test_manual_override_moves_it_against_every_message_and_feedback_goes_on() -> None:
    bench = awake(100.0)
    bench.unit.manual_override = "extend"
    bench.run(1.0)
    assert bench.unit.position_mm > 130.0
    assert bench.last().duty_percent == 100
    bench.unit.manual_override = None
    bench.run(0.5)
    assert bench.unit.velocity_mm_per_s == 0


def test_a_controller_with_the_actuators_own_address_gives_a_false_overload() -> None:
    bench = awake()
    bench.source = 19
    bench.go(200.0).run(0.5)
    assert "overload" in bench.last().flags


def test_fatal_needs_a_power_cycle() -> None:
    bench = awake(100.0)
    bench.unit.fatal = True
    bench.go(200.0).run(1.0)
    assert bench.unit.position_mm == 100.0
    assert "fatal" in bench.last().flags
    bench.unit.cut_power()
    bench.run(0.5)
    bench.unit.restore_power()
    bench.go(100.0, enable=False).run(1.0)
    bench.go(200.0).run(4.0)
    assert bench.unit.position_mm > 198.0


def test_against_a_lower_name_it_moves_to_the_next_address_of_its_block() -> None:
    bench = awake()
    bench.send(Frame(make_id(6, Pgn.ADDRESS_CLAIMED, 19), (1).to_bytes(8, "little")))
    bench.run(0.1)
    assert bench.unit.address == 20
    higher = Name(arbitrary_address_capable=1, industry_group=3).to_bytes()
    bench.send(Frame(make_id(6, Pgn.ADDRESS_CLAIMED, 20), higher))
    bench.sent.clear()
    bench.run(0.1)
    assert source_of(bench.sent[0][1].can_id) == 20, "it defends its address"


def test_two_units_have_equal_names_unless_told_otherwise_and_a_commanded_address_moves_both() -> None:
    left, right = Bench(VirtualElectrak(address=19)), Bench(VirtualElectrak(address=20))
    assert left.unit.name == right.unit.name
    assert VirtualElectrak(identity=2).name != left.unit.name
    data = left.unit.name.to_bytes() + bytes((25,))
    for bench in (left, right):
        bench.go(100.0, enable=False).run(1.0)
        bench.send(Frame(make_id(6, Pgn.TP_CONNECTION, 0), bytes((32, 9, 0, 2, 255, 0xD8, 0xFE, 0))))
        bench.send(Frame(make_id(7, Pgn.TP_DATA, 0), b"\x01" + data[:7]))
        bench.send(Frame(make_id(7, Pgn.TP_DATA, 0), b"\x02" + data[7:] + b"\xff" * 5))
        assert bench.unit.address == 25


def test_a_request_for_its_claim_is_answered_unless_told_otherwise() -> None:
    bench = awake()
    bench.sent.clear()
    ask = Frame(make_id(6, Pgn.REQUEST, 0xFE), bytes.fromhex("00EE00"))
    bench.send(ask)
    bench.unit.behaviour.answers_requests = False
    bench.send(ask)
    bench.run(0.05)
    assert sum(pgn_of(f.can_id) == Pgn.ADDRESS_CLAIMED for _, f in bench.sent) == 1


def test_the_same_seed_gives_the_same_bytes() -> None:
    runs = []
    for _ in range(2):
        bench = Bench(VirtualElectrak(position_mm=50.0, seed=7))
        bench.go(200.0).run(5.0)
        runs.append(bench.sent)
    assert runs[0] == runs[1]

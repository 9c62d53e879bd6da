"""The gate: the plant lives the prescribed delays, whatever else is on the wires."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autopilot.link.clock import Clock
from autopilot.link.wire import (
    AUTOPILOT,
    PLANT,
    AoaSsa,
    Attitude,
    HilActuatorControls,
    Message,
    NamedValueInt,
    ServoOutputRaw,
    Timesync,
    Wire,
    plant_heartbeat,
)
from gains.table import InputError
from gains.witnessfile import Witness
from sitl.flight import fly_virtual
from sitl.link.gate import MAX_HISTORY, Gate, Miss, check_flyable
from sitl.link.spec import parse_spec
from sitl.scenario import Scenario, load_scenario
from tests.helpers import HEARTBEAT, HIRM, MS, TS, S, broken

T0 = 137 * S
HIRM_WITNESS = load_scenario("witness")


def witness(*delays: int, transitions: str = "any", d_max: int | None = None) -> Witness:
    return Witness("", "", 0.025, 1, d_max or max(delays), transitions, 1.0, delays)


# -------------------------------------------------------------------------------------- a whole flight


def fifo(wanted: list[int]) -> tuple[int, ...]:
    """Return the delays, each cut to one more than the last, from the end of the period to its start too."""
    delays = list(wanted)
    for k in range(1, 2 * len(delays)):
        i = k % len(delays)
        delays[i] = min(delays[i], delays[i - 1] + 1)
    assert all(d <= last + 1 for last, d in pairwise((delays[-1], *delays)))
    return tuple(delays)


def flown(scenario: Scenario) -> list[dict]:
    """Return the truth of each sample of a flight in virtual time."""
    truth: list[dict] = []
    fly_virtual(scenario, lambda record, _ns: truth.append(record.body) if record.topic == "plant/truth" else None)
    return truth


def flight(delays: tuple[int, ...], transitions: str, latch: str, **changes: object) -> Scenario:
    sequence = witness(*delays, transitions=transitions)
    changed = {"witness": sequence, "latch": latch, "duration_s": 2.0, "x0": np.array([0.0, 0.0, 1e-4])}
    return replace(HIRM_WITNESS, **(changed | changes))


def lived_as_prescribed(truth: list[dict], delays: tuple[int, ...]) -> bool:
    """Whether each sample held the command of sample k - d(k mod L), or where there is none what it held before."""
    j = None
    for k, body in enumerate(truth):
        assert body["k"] == k
        wanted = k - delays[k % len(delays)]
        j = wanted if wanted >= 0 else j
        if body["j"] != j:
            return False
    return True


def recursion(delays: tuple[int, ...], x0: np.ndarray, samples: int) -> np.ndarray:
    """Return x(k+1) = A x(k) + B K1 x(k - d(k)), the input neutral before the first command; shape (samples, 3)."""
    A, B, K1 = HIRM.model.A, HIRM.model.B, HIRM.K1
    x, u = [x0], np.zeros(1)
    for k in range(samples - 1):
        j = k - delays[k % len(delays)]
        u = K1 @ x[j] if j >= 0 else u
        x.append(A @ x[k] + B @ u)
    return np.array(x)


sequences = st.lists(st.integers(1, 6), min_size=1, max_size=30)


def check_flight(scenario: Scenario, delays: tuple[int, ...]) -> None:
    truth = flown(scenario)
    assert len(truth) == scenario.samples
    assert lived_as_prescribed(truth, delays)
    x = recursion(delays, scenario.x0, len(truth))
    largest = np.maximum.accumulate(np.abs(x).max(axis=1))[:, None]
    assert np.abs((np.array([body["x"] for body in truth]) - x) / largest).max() < 2e-6


@settings(deadline=None, max_examples=40)
@given(wanted=sequences)
def test_a_plant_that_latches_the_newest_lives_any_fifo_sequence(wanted: list[int]) -> None:
    delays = fifo(wanted)
    check_flight(flight(delays, "fifo", "newest"), delays)


@settings(deadline=None, max_examples=40)
@given(wanted=sequences)
def test_a_plant_that_latches_the_last_lives_any_sequence(wanted: list[int]) -> None:
    check_flight(flight(tuple(wanted), "any", "last"), tuple(wanted))


@pytest.mark.parametrize("up", ["delay=4ms,jitter=uniform:5ms", "order=keep,rate=400kbps"])
def test_a_link_that_takes_less_than_a_sample_changes_nothing(up: str) -> None:
    delays = (1, 2, 3, 1, 1, 6, 2)
    slow = flight(delays, "any", "last", up=parse_spec(up), down=parse_spec("delay=4ms,jitter=uniform:5ms,dup=0.3"))
    assert lived_as_prescribed(flown(slow), delays)


def test_where_the_link_takes_longer_the_plant_lives_a_longer_delay() -> None:
    truth = flown(flight((1,), "fifo", "newest", down=parse_spec("delay=30ms")))
    assert {body["d"] for body in truth[10:]} != {1}


@pytest.mark.parametrize("name", ["witness", "witness-pendulum"])
@pytest.mark.parametrize("actuator", ["pwm", "float"])
@pytest.mark.parametrize("wraps_at_s", [4294.967296, 4294967.296], ids=["u32 us", "u32 ms"])
def test_a_wrap_of_the_plants_stamps_changes_nothing(name: str, actuator: str, wraps_at_s: float) -> None:
    scenario = load_scenario(name)
    clocks = {**scenario.clocks, "plant": Clock(round((wraps_at_s - 2.0) * 1e9), 40_000)}
    truth = flown(replace(scenario, clocks=clocks, actuator=actuator, duration_s=5.0))
    assert truth[0]["t_ns"] < wraps_at_s * 1e9 < truth[-1]["t_ns"]
    assert lived_as_prescribed(truth, scenario.witness.delays)


# ------------------------------------------------------------------------------------- the gate by hand


@dataclass
class Bench:
    """A gate between a plant and an autopilot that do as they are told; parcels are what a test calls them."""

    gate: Gate[str]
    plant: Wire = field(default_factory=lambda: Wire(PLANT, AUTOPILOT))
    autopilot: Wire = field(default_factory=lambda: Wire(AUTOPILOT, PLANT))
    t0_ns: int = T0
    out: list[str] = field(default_factory=list)
    dropped: list[str] = field(default_factory=list)

    def sense(self, datagram: bytes) -> None:
        self.take(self.gate.sense(datagram))

    def say(self, message: Message) -> None:
        self.sense(self.plant.encode(message))

    def sample(self, k: int, *, number: bool = False) -> None:
        """Let sample k pass, and its number first."""
        ms = (self.t0_ns + k * TS) // MS
        if number:
            self.say(NamedValueInt(ms % 2**32, "SAMPLE_K", k))
        self.say(Attitude(ms % 2**32, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))

    def command(self, j: int, parcel: str | None = None) -> None:
        """Let the command of sample j arrive."""
        stamp_us = (self.t0_ns + j * TS) // 1000
        step = self.gate.command(self.autopilot.encode(HilActuatorControls(stamp_us, 0.1)), parcel or f"c{j}")
        assert step is not None
        self.take(step)

    def take(self, step) -> None:
        self.out += [parcel for parcel, _ in step.released]
        self.dropped += step.dropped


def bench(*delays: int, transitions: str = "any", d_max: int | None = None) -> Bench:
    made = Bench(Gate(witness(*delays, transitions=transitions, d_max=d_max)))
    made.sample(0, number=True)
    return made


def test_the_answer_to_the_passing_sample_goes_through_on_arrival() -> None:
    b = bench(1)
    assert b.out == []
    b.command(0)
    assert b.out == ["c0"]
    b.sample(1)
    assert b.out == ["c0"]
    b.command(1)
    assert b.out == ["c0", "c1"]
    assert not b.gate.misses


def test_a_command_waits_for_the_sample_before_the_one_that_shall_hold_it() -> None:
    b = bench(3)
    for k in range(5):
        b.command(k)
        b.sample(k + 1)
    assert b.out == ["c0", "c1", "c2", "c3"]  # sample 6 holds c3, that is d = 3


def test_a_command_the_plant_holds_already_does_not_go_through_again() -> None:
    b = bench(1, 1, 2, 3, transitions="fifo")
    b.command(0)
    for k in (1, 2, 3):
        b.sample(k)
        b.command(k)
    assert b.out == ["c0", "c3"]
    assert b.gate.held == 2


def test_an_older_command_goes_through_again_where_the_sequence_jumps_up() -> None:
    b = bench(2, 1, 1, 3)
    b.command(0)
    b.sample(1)
    b.command(1)
    assert b.out == ["c0", "c1"]
    b.sample(2)
    assert b.out == ["c0", "c1", "c0"]  # sample 3 holds the command of sample 0


def test_what_comes_after_its_sample_is_counted_and_not_sent_late() -> None:
    b = bench(1, 1, 1, d_max=2)
    b.sample(1)
    b.command(0)
    assert b.out == []
    assert b.gate.misses == {Miss.ABSENT: 1}
    b.sample(2)
    b.sample(3)
    b.command(0, "too late")
    assert b.gate.misses == {Miss.ABSENT: 3, Miss.OLD: 1}
    assert b.dropped == ["c0", "too late"]


def test_the_newest_of_two_commands_of_one_sample_waits() -> None:
    b = bench(2)
    b.command(0, "first")
    b.command(0, "second")
    assert b.dropped == ["first"]
    b.sample(1)
    assert b.out == ["second"]
    b.command(0, "third")
    assert b.out == ["second", "third"]  # a repeat of what the plant holds
    assert b.gate.misses == {Miss.REPLACED: 1}


@pytest.mark.parametrize("j", [1, 2, -1, 1000, -1000, 10**12])
def test_a_command_of_no_sample_that_has_passed_is_swallowed(j: int) -> None:
    b = bench(1)
    stamp_us = (T0 + j * TS) // 1000 % 2**64
    step = b.gate.command(b.autopilot.encode(HilActuatorControls(stamp_us, 0.1)), "c")
    assert step == ((), ("c",))
    assert b.gate.misses == {Miss.UNKNOWN: 1}


def test_before_the_plant_has_numbered_a_sample_no_command_goes_through() -> None:
    b = Bench(Gate(witness(1)))
    b.command(0)
    b.sample(0)
    b.command(0)
    assert b.dropped == ["c0", "c0"]
    b.sample(1, number=True)
    b.command(1)
    assert b.out == ["c1"]


def test_a_datagram_with_commands_of_several_samples_is_swallowed() -> None:
    b = bench(1)
    frames = [b.autopilot.encode(ServoOutputRaw((T0 + j * TS) // 1000, 1500)) for j in (0, -3)]
    assert b.gate.command(b"".join(frames), "c") == ((), ("c",))
    assert b.gate.command(frames[0] * 2, "same") == ((("same", 0),), ())


@pytest.mark.parametrize("message", [Timesync(0, 5), Timesync(5, 6), HEARTBEAT])
def test_everything_but_commands_is_none_of_its_business(message: Message) -> None:
    b = bench(1)
    assert b.gate.command(b.autopilot.encode(message), "x") is None


def test_messages_of_others_and_second_copies_let_nothing_through() -> None:
    b = bench(3)
    b.command(0)
    b.sample(0)
    b.sample(0, number=True)
    for message in (plant_heartbeat(), AoaSsa((T0 + 2 * TS) // 1000, 0.0, 0.0), NamedValueInt(T0 // MS, "DELAY_K", 2)):
        b.say(message)
    stranger = Wire((1, 99), AUTOPILOT)
    b.sense(stranger.encode(Attitude((T0 + 2 * TS) // MS, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)))
    assert b.out == []
    b.sample(2)
    assert b.out == ["c0"]


@pytest.mark.parametrize("offset_ns", [0, 3 * S, -3 * S, -136 * S])
def test_after_a_restart_of_the_plant_it_starts_anew(offset_ns: int) -> None:
    b = bench(2)
    for k in range(50):
        b.command(k)
        b.sample(k + 1)
    b.command(50)
    b.t0_ns += offset_ns
    b.out.clear()
    b.sample(0, number=True)
    assert b.dropped == ["c50"]
    b.command(0, "new")
    b.sample(1)
    assert b.out == ["new"]


def test_a_number_that_does_not_fit_starts_anew_and_the_next_one_mends_it() -> None:
    b = bench(2)
    b.command(0)
    b.say(NamedValueInt(T0 // MS, "SAMPLE_K", 2**31 - 1))
    assert b.dropped == ["c0"]
    b.sample(1, number=True)
    b.command(1)
    b.sample(2)
    assert b.out == ["c1"]


@settings(deadline=None)
@given(
    delays=st.lists(st.integers(1, 6), min_size=1, max_size=8),
    events=st.lists(st.tuples(st.booleans(), st.integers(0, 12)), max_size=60),
)
def test_the_history_is_bounded_and_each_parcel_has_one_end(delays: list[int], events: list[tuple[bool, int]]) -> None:
    b, k, handed = bench(*delays), 0, []
    for passes, number in events:
        if passes:
            k += 1 + number // 6
            b.sample(k)
        else:
            handed.append(f"p{len(handed)}")
            b.command(k - number, handed[-1])
        assert b.gate.held <= max(delays) <= MAX_HISTORY
        assert len(b.dropped) == len(set(b.dropped))
        assert not set(b.dropped) & set(b.out)
        assert len(set(b.dropped) | set(b.out)) + b.gate.held == len(handed)


def test_hostile_datagrams_change_nothing() -> None:
    rng = np.random.default_rng(5)
    b = bench(3)
    plant, autopilot = Wire(PLANT, AUTOPILOT), Wire(AUTOPILOT, PLANT)
    frames = [
        plant.encode(Attitude(T0 // MS, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)),
        plant.encode(NamedValueInt(T0 // MS, "SAMPLE_K", 9)),
        autopilot.encode(ServoOutputRaw(10**6, 1900)),
        autopilot.encode(HilActuatorControls(10**6, 1.0)),
    ]
    for k in range(100):
        for _ in range(40):
            datagram = broken(frames[rng.integers(4)], rng)
            assert b.gate.sense(datagram) == ((), ())
            assert b.gate.command(datagram, "hostile") is None
        b.command(k)
        b.sample(k + 1)
    assert b.out == [f"c{j}" for j in range(99)]
    assert not b.gate.misses


@settings(deadline=None)
@given(
    values=st.lists(
        st.tuples(st.integers(0, 3), st.integers(0, 2**64 - 1), st.integers(-(2**31), 2**31 - 1)), max_size=40
    )
)
def test_after_messages_with_any_numbers_two_samples_with_theirs_mend_it(values: list[tuple[int, int, int]]) -> None:
    b = bench(1, 5, 2)
    for kind, stamp, number in values:
        match kind:
            case 0:
                b.say(Attitude(stamp % 2**32, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
            case 1:
                b.say(NamedValueInt(stamp % 2**32, "SAMPLE_K", number))
            case 2:
                b.gate.command(b.autopilot.encode(ServoOutputRaw(stamp % 2**32, 1500)), "p")
            case _:
                b.gate.command(b.autopilot.encode(HilActuatorControls(stamp, 0.0)), "p")
    b.sample(7, number=True)
    b.sample(8, number=True)
    b.out.clear()
    b.command(8)
    b.sample(9)
    assert b.out == ["c8"]


# ---------------------------------------------------------------------------------- what cannot be flown


def test_a_witness_that_cannot_be_flown_is_refused() -> None:
    good = witness(1, 2, 3)
    for wrong, latch, complaint in (
        (replace(good, d_min=0), None, "w.csv: d_min: expected at least 1"),
        (replace(good, d_max=MAX_HISTORY + 1), None, f"w.csv: d_max: expected at most {MAX_HISTORY}"),
        (good, "newest", "w.csv: transitions: expected fifo"),
        (replace(good, Ts=0.03), "last", "w.csv: Ts_s: expected 0.025 as that of hirm, found 0.03"),
    ):
        with pytest.raises(InputError, match=complaint):
            check_flyable(wrong, "w.csv", latch, HIRM.model)
    check_flyable(good, "w.csv", "last", HIRM.model)
    check_flyable(replace(good, transitions="fifo"), "w.csv", "newest", HIRM.model)

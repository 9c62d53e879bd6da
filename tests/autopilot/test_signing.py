"""Signatures against pymavlink's own, both ways; replay windows against a reference model; restarts of every kind."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from autopilot.link.messages import Timesync
from autopilot.link.signing import (
    DEPTH,
    LAST_TIMESTAMP,
    MAX_DEPTH,
    MAX_STREAMS,
    NEW_STREAM_SPAN,
    RESERVE,
    Signing,
    Timestamps,
    Verdict,
    timestamp_of,
)
from autopilot.link.wire import Wire

quick = settings(deadline=None)
KEY = bytes(range(32))
OTHER_KEY = bytes(range(1, 33))
NOW = 37_500_000_000_000  # in 2026
SECOND = 100_000
NS_PER_UNIT = 10_000
PLANT = (1, 25)
LINK = 7


def native(timestamp: int, *, link: int = LINK, key: bytes = KEY, source: tuple[int, int] = PLANT) -> dialect.MAVLink:
    """Return pymavlink's own end of a signed link."""
    end = dialect.MAVLink(None, srcSystem=source[0], srcComponent=source[1])
    end.signing.secret_key = key
    end.signing.link_id = link
    end.signing.timestamp = timestamp
    end.signing.sign_outgoing = True
    return end


def frame(timestamp: int, value: int = 1, **how) -> bytes:
    """Return a TIMESYNC frame that pymavlink signed."""
    return dialect.MAVLink_timesync_message(value, 2).pack(native(timestamp, **how))


def unsigned_body(value: int = 1, source: tuple[int, int] = PLANT) -> bytes:
    """Return a frame up to its checksum whose header says that it is signed."""
    return frame(0, value, source=source)[:-13]


def timestamp_in(signed: bytes) -> int:
    return int.from_bytes(signed[-12:-6], "little")


def receiver(**how) -> Signing:
    return Signing(KEY, 0, NOW, **how)


# -- the signature


@quick
@given(
    st.binary(min_size=32, max_size=32), st.integers(0, 255), st.integers(0, LAST_TIMESTAMP), st.binary(max_size=200)
)
def test_a_signed_frame_equals_pymavlinks_byte_for_byte(key, link, timestamp, text):
    end = native(timestamp, link=link, key=key)
    theirs = dialect.MAVLink_data96_message(1, len(text) % 97, text[:96].ljust(96, b"\0")).pack(end)
    ours = Signing(key, link, timestamp, Timestamps(next=timestamp)).sign(theirs[:-13])
    assert ours == theirs


def test_pymavlink_accepts_what_is_signed_here_and_refuses_it_under_another_key():
    ours = Signing(KEY, LINK, NOW)
    frames = [ours.sign(unsigned_body(value)) for value in range(1, 200)]
    parser = native(NOW)
    messages = parser.parse_buffer(bytearray(b"".join(frames)))
    assert [message.tc1 for message in messages] == list(range(1, 200))
    assert parser.signing.goodsig_count == 199
    stranger = native(NOW, key=OTHER_KEY)
    with pytest.raises(dialect.MAVError, match="signature"):
        stranger.decode(bytearray(frames[0]))


def test_what_pymavlink_signs_is_accepted_once_and_under_the_same_key_only():
    end, ours, stranger = native(NOW), receiver(), Signing(OTHER_KEY, 0, NOW)
    frames = [dialect.MAVLink_timesync_message(value, 2).pack(end) for value in range(1, 200)]
    assert {stranger.check(f) for f in frames} == {Verdict.BAD_SIGNATURE}
    assert {ours.check(f) for f in frames} == {Verdict.ACCEPTED}
    assert none_accepted(ours, frames)
    assert ours.counts[Verdict.ACCEPTED] == 199


def none_accepted(end: Signing, frames: list[bytes]) -> bool:
    return all(end.check(f) is not Verdict.ACCEPTED for f in frames)


def test_a_frame_with_any_one_bit_flipped_is_refused_and_changes_nothing():
    ours, good = receiver(), frame(NOW)
    before = (ours.exact(), ours.timestamp)
    for position in range(8 * len(good)):
        bits = bytearray(good)
        bits[position // 8] ^= 1 << position % 8
        assert ours.check(bytes(bits)) is not Verdict.ACCEPTED, position
    assert (ours.exact(), ours.timestamp) == before
    assert ours.check(good) is Verdict.ACCEPTED


def test_a_frame_that_is_too_short_or_too_long_by_any_number_of_bytes_is_refused():
    ours, good = receiver(), frame(NOW)
    assert none_accepted(ours, [good[:length] for length in range(len(good))])
    assert none_accepted(ours, [good + bytes(more) for more in range(1, 300)])
    assert ours.exact() == receiver().exact()
    assert ours.check(good) is Verdict.ACCEPTED


def test_a_forged_frame_of_the_far_future_locks_nobody_out():
    ours = receiver()
    forged = [frame(NOW + years * 365 * 86_400 * SECOND, key=OTHER_KEY) for years in range(1, 70)]
    assert ours.check(frame(NOW)) is Verdict.ACCEPTED
    before = (ours.exact(), ours.ahead(), ours.timestamp)
    assert {ours.check(f) for f in forged} == {Verdict.BAD_SIGNATURE}
    assert (ours.exact(), ours.ahead(), ours.timestamp) == before
    assert ours.check(frame(NOW + 1)) is Verdict.ACCEPTED


@pytest.mark.parametrize("accepting", [False, True])
def test_frames_without_a_signature_pass_only_where_that_was_asked_for(accepting):
    ours = receiver(accept_unsigned=accepting)
    plain = dialect.MAVLink(None, *PLANT)
    expected = Verdict.ACCEPTED if accepting else Verdict.UNSIGNED
    assert ours.check(dialect.MAVLink_timesync_message(1, 2).pack(plain)) is expected
    assert ours.check(dialect.MAVLink_timesync_message(1, 2).pack(plain, force_mavlink1=True)) is expected
    assert ours.check(frame(NOW, key=OTHER_KEY)) is Verdict.BAD_SIGNATURE
    assert ours.check(frame(NOW)) is Verdict.ACCEPTED
    assert ours.check(frame(NOW)) is Verdict.REPLAYED


@pytest.mark.parametrize(
    "noise", [b"", b"\xfd", b"\xfd\x00", b"\xfd\x00\x01", b"\xfe\x00", b"\x00" * 40, b"\xff" * 280]
)
def test_what_is_no_frame_is_malformed_even_where_unsigned_frames_pass(noise):
    assert receiver(accept_unsigned=True).check(noise) is Verdict.MALFORMED


def test_a_frame_of_another_link_with_the_same_key_is_refused_where_the_peers_link_is_known():
    ours = receiver(peer_link=LINK)
    assert ours.check(frame(NOW, link=LINK + 1)) is Verdict.WRONG_LINK
    assert ours.exact() == receiver().exact()
    assert ours.check(frame(NOW, link=LINK)) is Verdict.ACCEPTED


# -- our own timestamps


@quick
@given(st.lists(st.integers(-3, 5) | st.integers(0, 10**10), max_size=50))
def test_timestamps_rise_strictly_and_follow_the_clock_when_it_is_ahead(steps_ns):
    ours, now_ns, signed = Signing(KEY, 0, NOW), 0, []
    for step_ns in steps_ns:
        now_ns += step_ns
        ours.tick(now_ns)
        signed.append(timestamp_in(ours.sign(unsigned_body())))
        assert signed[-1] >= NOW + now_ns // NS_PER_UNIT
        assert signed[-1] <= NOW + max(now_ns, 0) // NS_PER_UNIT + 10**6 + len(signed)
    assert all(b > a for a, b in pairwise(signed))


def test_without_sending_faster_than_the_clock_the_timestamp_is_the_clock():
    ours = Signing(KEY, 0, NOW)
    for tick in range(1, 100):
        ours.tick(tick * 25_000_000)
        assert timestamp_in(ours.sign(unsigned_body())) == NOW + tick * 2_500


def test_a_time_that_goes_back_is_not_followed():
    ours = Signing(KEY, 0, NOW)
    ours.tick(10**9)
    ours.tick(0)
    assert ours.timestamp == NOW + SECOND


@pytest.mark.parametrize("lead", [-30 * SECOND, -1, 0, 1, 3600 * SECOND])
def test_the_timestamp_follows_an_authentic_peer_that_is_ahead_as_pymavlinks_does(lead):
    ours, theirs = receiver(), native(NOW, link=0)
    heard = frame(NOW + lead)
    assert ours.check(heard) is Verdict.ACCEPTED
    theirs.decode(bytearray(heard))
    expected = dialect.MAVLink_timesync_message(1, 2).pack(theirs)
    assert timestamp_in(ours.sign(unsigned_body())) == timestamp_in(expected)


def test_a_clock_that_does_not_know_the_date_counts_from_zero_until_a_peer_tells():
    ours = Signing(KEY, 0, timestamp_of(0))
    assert [timestamp_in(ours.sign(unsigned_body())) for _ in range(3)] == [0, 1, 2]
    assert ours.check(frame(NOW)) is Verdict.ACCEPTED
    assert timestamp_in(ours.sign(unsigned_body())) == NOW


def test_a_timestamp_that_leaves_ours_no_room_is_refused_even_with_the_key():
    ours = receiver()
    assert ours.check(frame(LAST_TIMESTAMP)) is Verdict.TOO_NEW
    assert ours.check(frame(NOW)) is Verdict.ACCEPTED
    assert ours.timestamp == NOW


@pytest.mark.parametrize(
    ("unix_s", "timestamp"), [(1_420_070_400, 0), (1_420_070_401, 100_000), (0, -142_007_040_000_000)]
)
def test_timestamps_count_units_of_ten_microseconds_since_2015(unix_s, timestamp):
    assert timestamp_of(unix_s * 10**9) == timestamp
    assert timestamp_of(unix_s * 10**9 + 9_999) == timestamp


# -- the replay window


def reference(accepted: set[int], depth: int, floor: int, timestamp: int) -> bool:
    """Say whether a window that remembers everything would accept: the rule, word by word."""
    newest = sorted(accepted)[-depth:]
    return timestamp not in newest and timestamp > (newest[0] if len(newest) == depth else floor)


@quick
@given(st.integers(1, 6), st.integers(-5, 20), st.lists(st.integers(0, 30), max_size=60))
@example(3, -5, [5, 4, 6, 7, 4, 5, 8, 6])
def test_the_window_agrees_with_a_model_that_remembers_everything(depth, floor, offsets):
    ours = receiver(depth=depth, timestamps=Timestamps(floors={(*PLANT, LINK): NOW + floor}))
    accepted: set[int] = set()
    for offset in offsets:
        timestamp = NOW + offset
        expected = reference(accepted, depth, NOW + floor, timestamp)
        known = timestamp in sorted(accepted)[-depth:]
        verdict = ours.check(frame(timestamp))
        assert verdict is (Verdict.ACCEPTED if expected else Verdict.REPLAYED if known else Verdict.TOO_OLD)
        if expected:
            assert timestamp not in accepted
            accepted.add(timestamp)


@pytest.mark.parametrize("depth", [1, 2, 64])
def test_a_frame_is_accepted_when_depth_less_one_newer_ones_overtook_it_and_not_one_more(depth):
    for newer in range(depth + 3):
        ours = receiver(depth=depth)
        assert {ours.check(frame(NOW + i)) for i in range(depth)} == {Verdict.ACCEPTED}
        late = frame(NOW + 1_000)
        assert {Verdict.ACCEPTED} >= {ours.check(frame(NOW + 2_000 + i)) for i in range(newer)}
        first, again = ours.check(late), ours.check(late)
        if newer < depth:
            assert (first, again) == (Verdict.ACCEPTED, Verdict.REPLAYED)
        else:
            assert (first, again) == (Verdict.TOO_OLD, Verdict.TOO_OLD)


def test_streams_have_windows_of_their_own():
    ours = receiver()
    ends = [
        {"source": (system, component), "link": link} for system in (1, 2) for component in (1, 25) for link in (0, 1)
    ]
    frames = [frame(NOW, **end) for end in ends]
    assert [ours.check(f) for f in frames] == [Verdict.ACCEPTED] * len(ends)
    assert [ours.check(f) for f in frames] == [Verdict.REPLAYED] * len(ends)


@pytest.mark.parametrize("behind", [0, NEW_STREAM_SPAN - 1, NEW_STREAM_SPAN, NEW_STREAM_SPAN + 1, 10 * NEW_STREAM_SPAN])
def test_a_new_stream_may_be_one_minute_behind_as_pymavlink_has_it(behind):
    parser, taken = native(NOW, link=0), True
    try:
        parser.decode(bytearray(frame(NOW - behind)))
    except dialect.MAVError:
        taken = False
    assert receiver().check(frame(NOW - behind)) is (Verdict.ACCEPTED if taken else Verdict.TOO_OLD)
    assert taken == (behind <= NEW_STREAM_SPAN)


def test_a_stream_with_a_stored_floor_continues_however_far_its_clock_is_behind():
    floor = NOW - 3600 * SECOND
    ours = receiver(timestamps=Timestamps(floors={(*PLANT, LINK): floor}))
    assert ours.check(frame(floor)) is Verdict.TOO_OLD
    assert ours.check(frame(floor + 1)) is Verdict.ACCEPTED


def test_a_stream_that_is_not_listed_has_the_floor_of_the_unseen():
    ours = receiver(timestamps=Timestamps(unseen=NOW + 5))
    assert ours.check(frame(NOW + 5)) is Verdict.TOO_OLD
    assert ours.check(frame(NOW + 6)) is Verdict.ACCEPTED


# -- ten thousand attacks


def test_of_ten_thousand_forged_replayed_cut_and_shifted_frames_none_is_accepted_and_the_stream_goes_on():
    rng = np.random.default_rng(2015)
    ours = Signing(KEY, 0, NOW)
    sender = Signing(KEY, LINK, NOW)
    body, seen, taken = unsigned_body(), [], 0
    for round_ in range(1_000):
        for end in (ours, sender):
            end.tick(round_ * 25_000_000)
        signed = [sender.sign(body) for _ in range(3)]
        # The attacker sees each frame before it arrives, and acts before and after.
        attacks = [_attack(rng, signed, seen) for _ in range(10)]
        assert none_accepted(ours, attacks[:5])
        for index in rng.permutation(3):
            assert ours.check(signed[index]) is Verdict.ACCEPTED
            taken += 1
        assert none_accepted(ours, attacks[5:])
        seen.extend(signed)
    assert taken == 3_000
    assert ours.counts.total() - taken == 10_000
    assert set(ours.counts) >= {Verdict.BAD_SIGNATURE, Verdict.REPLAYED, Verdict.TOO_OLD, Verdict.MALFORMED}
    assert len(ours.exact().floors) == 1


def _attack(rng: np.random.Generator, signed: list[bytes], seen: list[bytes]) -> bytes:
    """Return one frame of somebody who sees everything and has no key."""
    victim = bytearray(signed[rng.integers(len(signed))])
    match rng.integers(6):
        case 0 if seen:  # replayed, recent or old
            return (
                seen[-1 - int(rng.integers(min(len(seen), 100)))]
                if rng.random() < 0.5
                else seen[rng.integers(len(seen))]
            )
        case 1:  # cut, or with something behind
            return bytes(victim[: rng.integers(len(victim))]) if rng.random() < 0.5 else bytes(victim) + rng.bytes(1)
        case 2:  # shifted in time, forth or back
            shifted = timestamp_in(bytes(victim)) + int(rng.integers(1, 10**12)) * int(rng.choice([-1, 1]))
            victim[-12:-6] = shifted.to_bytes(6, "little")
            return bytes(victim)
        case 3:  # another command under the signature
            victim[10] ^= int(rng.integers(1, 256))
            return bytes(victim)
        case 4:  # the signature stripped
            victim[2] = 0
            return bytes(victim[:-13])
    return frame(timestamp_in(bytes(victim)) + int(rng.integers(0, 10**9)), key=OTHER_KEY)


def test_frames_shuffled_within_the_depth_are_all_accepted_once():
    rng = np.random.default_rng(7)
    ours, sender, body = receiver(), Signing(KEY, LINK, NOW), unsigned_body()
    frames = [sender.sign(body) for _ in range(DEPTH * 30)]
    for start in range(0, len(frames), DEPTH):
        block = [frames[start + i] for i in rng.permutation(DEPTH)]
        assert {ours.check(f) for f in block} == {Verdict.ACCEPTED}
        assert none_accepted(ours, block)


# -- bounds


def test_streams_beyond_the_maximum_are_refused_and_counted_and_the_known_ones_go_on():
    ours = receiver()
    for system in range(MAX_STREAMS):
        assert ours.check(frame(NOW, source=(system, 1))) is Verdict.ACCEPTED
    for system in range(MAX_STREAMS, MAX_STREAMS + 40):
        assert ours.check(frame(NOW, source=(system, 1))) is Verdict.TOO_MANY_STREAMS
    assert ours.counts[Verdict.TOO_MANY_STREAMS] == 40
    assert len(ours.exact().floors) == MAX_STREAMS
    for system in range(MAX_STREAMS):
        assert ours.check(frame(NOW + 1, source=(system, 1))) is Verdict.ACCEPTED


def test_a_stream_older_than_a_minute_makes_room_and_is_never_replayed_even_when_our_clock_is_set_back():
    ours = receiver()
    old = [frame(NOW + system, source=(system, 1)) for system in range(MAX_STREAMS)]
    assert {ours.check(f) for f in old} == {Verdict.ACCEPTED}
    ours.tick((NEW_STREAM_SPAN + 2) * NS_PER_UNIT)
    late = NOW + NEW_STREAM_SPAN
    assert ours.check(frame(late, source=(100, 1))) is Verdict.ACCEPTED
    assert ours.check(frame(late, source=(101, 1))) is Verdict.ACCEPTED
    assert ours.check(frame(late, source=(102, 1))) is Verdict.TOO_MANY_STREAMS
    assert ours.forgotten == 2
    assert ours.exact().unseen == ours.ahead().unseen == NOW + 1
    assert none_accepted(ours, old)
    for left in (ours.exact(), ours.ahead()):
        assert none_accepted(Signing(KEY, 0, NOW - 3600 * SECOND, left), old)


def test_a_stream_remembers_no_more_than_its_depth():
    ours = receiver(depth=5)
    assert {ours.check(frame(NOW + i)) for i in range(100)} == {Verdict.ACCEPTED}
    (stream,) = ours._streams.values()
    assert stream.times == [NOW + i for i in range(95, 100)]


@pytest.mark.parametrize(
    "wrong",
    [
        {"key": bytes(31)},
        {"link_id": 256},
        {"link_id": -1},
        {"depth": 0},
        {"depth": MAX_DEPTH + 1},
        {"timestamps": Timestamps(floors={(i, 1, 0): 0 for i in range(MAX_STREAMS + 1)})},
    ],
)
def test_parameters_outside_their_range_are_refused(wrong):
    with pytest.raises(ValueError, match=r"expected|range"):
        Signing(**{"key": KEY, "link_id": 0, "start": NOW, **wrong})


# -- restarts


def store(end: Signing) -> Timestamps:
    """Store ahead, as a running program does."""
    kept = end.ahead()
    end.stored(kept)
    return kept


def test_after_a_clean_stop_what_is_new_is_accepted_and_what_was_accepted_is_not():
    first = receiver()
    frames = [frame(NOW + i * SECOND) for i in range(10)]
    assert {first.check(f) for f in frames} == {Verdict.ACCEPTED}
    sent = timestamp_in(first.sign(unsigned_body()))
    for start in (NOW, NOW - 86_400 * SECOND, NOW + 86_400 * SECOND):
        second = Signing(KEY, 0, start, first.exact())
        assert none_accepted(second, frames)
        assert second.check(frame(NOW + 9 * SECOND + 1)) is Verdict.ACCEPTED
        assert timestamp_in(second.sign(unsigned_body())) > sent


@pytest.mark.parametrize("crash_ms", [1, 200, 999, 1_000, 2_500, 9_990])
@pytest.mark.parametrize("pause_ms", [0, 300, 5_000])
def test_after_a_crash_no_frame_is_accepted_again_and_new_ones_wait_for_the_reserve_at_most(crash_ms, pause_ms):
    lead = -20 * SECOND  # the peer's clock is behind ours

    def peers(at_ms: int) -> bytes:
        return frame(NOW + lead + at_ms * 100)

    first, taken, own = receiver(), [], []
    for at_ms in range(0, crash_ms, 10):
        first.tick(at_ms * 1_000_000)
        own.append(timestamp_in(first.sign(unsigned_body())))
        if first.check(peers(at_ms)) is Verdict.ACCEPTED:
            taken.append(peers(at_ms))
        if at_ms % 1_000 == 0:
            left = store(first)
    assert len(taken) == len(range(0, crash_ms, 10))
    restart_ms = crash_ms + pause_ms
    second = Signing(KEY, 0, NOW + restart_ms * 100, left)
    second.stored(second.ahead())
    assert none_accepted(second, taken)
    assert timestamp_in(second.sign(unsigned_body())) > max(own)
    accepted_ms = []
    for at_ms in range(restart_ms, restart_ms + 3_000, 10):
        second.tick((at_ms - restart_ms) * 1_000_000)
        if second.check(peers(at_ms)) is Verdict.ACCEPTED:
            accepted_ms.append(at_ms)
        if second.wants_store or (at_ms - restart_ms) % 1_000 == 0:
            store(second)
    assert accepted_ms[0] <= max(restart_ms + 10, crash_ms + RESERVE // 100 + 20)
    assert accepted_ms == list(range(accepted_ms[0], restart_ms + 3_000, 10))


hour = st.integers(-3600 * SECOND, 3600 * SECOND)
events = st.one_of(
    st.tuples(st.just("tick"), st.integers(0, 5_000)),
    st.tuples(st.just("frame"), st.integers(0, 2), st.integers(-40, 3 * SECOND) | hour),
    st.tuples(st.just("send"), st.integers(1, 3)),
    st.tuples(st.sampled_from(["store", "stop"])),
    st.tuples(st.just("crash"), hour),
)


class Life:
    """A link through any number of runs; what is stored is written before a run, and whenever the history says so."""

    def __init__(self) -> None:
        self.accepted: dict[tuple[int, int], bytes] = {}
        self.sent: set[int] = set()
        self.left = Timestamps()
        self.overdrawn = 0
        self._begin(NOW)

    def _begin(self, clock: int) -> None:
        self.begun, self.now_ms = max(clock, 0), 0
        self.end = Signing(KEY, 0, self.begun, self.left, depth=3)
        self.store()
        assert none_accepted(self.end, list(self.accepted.values()))

    def tick(self, step_ms: int) -> None:
        self.now_ms += step_ms
        self.end.tick(self.now_ms * 1_000_000)

    def frame(self, system: int, offset: int) -> None:
        timestamp = max(self.begun + self.now_ms * 100 + offset, 0)
        signed = frame(timestamp, source=(system, 1))
        if self.end.check(signed) is Verdict.ACCEPTED:
            assert (system, timestamp) not in self.accepted
            self.accepted[system, timestamp] = signed

    def send(self, count: int) -> None:
        for _ in range(count):
            timestamp = timestamp_in(self.end.sign(unsigned_body()))
            assert timestamp not in self.sent
            self.sent.add(timestamp)
        self.overdrawn += self.end.overdrawn

    def store(self) -> None:
        self.left = store(self.end)

    def stop(self) -> None:
        self.left = self.end.exact()
        self.crash(0)

    def crash(self, set_by: int) -> None:
        """Start anew from what is stored, with the clock set forth or back."""
        self._begin(self.begun + self.now_ms * 100 + set_by)


@settings(deadline=None, max_examples=150)
@given(st.lists(events, max_size=60))
@example([("frame", 0, 0), ("store",), ("frame", 0, 0), ("crash", 0), ("frame", 0, 0)])
@example([("send", 3), ("tick", 5_000), ("send", 3), ("crash", -3600 * SECOND), ("send", 3)])
def test_whatever_happens_no_frame_is_accepted_twice_and_no_timestamp_sent_twice(history):
    life = Life()
    for event, *values in history:
        getattr(life, event)(*values)
    assert life.overdrawn == 0


def test_a_frame_that_no_stored_floor_covers_waits_for_the_next_write():
    ours = receiver()
    store(ours)
    assert ours.check(frame(NOW)) is Verdict.UNRESERVED
    assert ours.wants_store
    store(ours)
    assert not ours.wants_store
    assert ours.check(frame(NOW + RESERVE)) is Verdict.ACCEPTED
    assert ours.check(frame(NOW + RESERVE + 1)) is Verdict.UNRESERVED
    store(ours)
    assert ours.check(frame(NOW + RESERVE + 2)) is Verdict.ACCEPTED
    assert ours.counts[Verdict.UNRESERVED] == 2


def test_a_stream_that_what_was_stored_does_not_list_goes_on_waiting():
    ours = receiver()
    kept = store(ours)
    assert ours.check(frame(NOW)) is Verdict.UNRESERVED
    ours.stored(kept)
    assert ours.check(frame(NOW)) is Verdict.UNRESERVED


def test_a_stream_that_was_silent_for_an_hour_resumes_without_waiting():
    ours = receiver()
    assert ours.check(frame(NOW)) is Verdict.ACCEPTED
    for second in range(3_600):
        ours.tick(second * 10**9)
        store(ours)
    assert ours.check(frame(NOW + 3_600 * SECOND)) is Verdict.ACCEPTED


def test_sending_counts_on_from_the_last_timestamp_while_the_clock_is_beyond_the_reserve():
    ours = Signing(KEY, 0, NOW)
    store(ours)
    first = timestamp_in(ours.sign(unsigned_body()))
    ours.tick(60 * 10**9)
    assert timestamp_in(ours.sign(unsigned_body())) == first + 1
    assert (ours.held_back, ours.overdrawn, ours.wants_store) == (1, 0, True)
    store(ours)
    assert timestamp_in(ours.sign(unsigned_body())) == NOW + 60 * SECOND
    assert ours.held_back == 1


def test_what_is_sent_after_the_exact_values_were_stored_is_counted():
    ours = receiver()
    assert ours.check(frame(NOW)) is Verdict.ACCEPTED
    ours.sign(unsigned_body())
    ours.stored(ours.exact())
    ours.sign(unsigned_body())
    assert ours.overdrawn == 1
    assert ours.check(frame(NOW + 1)) is Verdict.UNRESERVED


def test_frames_pass_while_nothing_can_be_stored():
    ours = receiver()
    store(ours)
    ours.stored(None)
    assert ours.check(frame(NOW + 3600 * SECOND)) is Verdict.ACCEPTED
    ours.tick(7200 * 10**9)
    assert timestamp_in(ours.sign(unsigned_body())) == NOW + 7200 * SECOND
    assert (ours.held_back, ours.overdrawn) == (0, 0)


def test_a_frame_that_was_kept_back_for_more_than_a_minute_is_refused_although_no_newer_one_came():
    end = receiver()
    end.tick(0)
    assert end.check(frame(NOW)) is Verdict.ACCEPTED
    kept_back, in_time = frame(NOW + 1), frame(NOW + 5)
    end.tick(59 * 10**9)
    assert end.check(in_time) is Verdict.ACCEPTED
    end.tick(7200 * 10**9)
    assert end.check(kept_back) is Verdict.TOO_OLD
    assert end.check(frame(NOW + 6)) is Verdict.TOO_OLD
    assert end.check(frame(NOW + 7200 * SECOND)) is Verdict.ACCEPTED


@pytest.mark.parametrize("accepting", [False, True])
def test_a_listener_asks_of_an_unsigned_frame_only_whether_such_are_heard(accepting, monkeypatch):
    end = receiver(accept_unsigned=accepting)
    monkeypatch.setattr("autopilot.link.signing.deepcopy", lambda _: pytest.fail("copied for a stranger"))
    assert end.would_accept(Wire(PLANT, None).encode(Timesync(1, 2))) is accepting
    assert not end.would_accept(frame(NOW, key=bytes(32)))

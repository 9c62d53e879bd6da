"""Key files that are refused without a word of their content; timestamps that outlive every end of a program."""

from __future__ import annotations

import hashlib
import os
import tomllib
from pathlib import Path
from time import time  # noqa: TID251  the wall clock is what is tested

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from autopilot.link import keyfile
from autopilot.link.keyfile import (
    MAX_ENTRIES,
    MAX_KEY_FILE_BYTES,
    TimestampStore,
    read_key,
    timestamps_path,
    wall_clock_start,
)
from autopilot.link.signing import MAX_STREAMS, RESERVE, Signing, Timestamps, Verdict
from gains import atomic
from gains.table import InputError

KEY = bytes(range(32))
OTHER_KEY = bytes(range(1, 33))
SECRET = "correct horse battery staple"
NOW = 37_500_000_000_000
MS, S = 1_000_000, 1_000_000_000
needs_modes = pytest.mark.skipif(os.name != "posix", reason="owner and mode say nothing there")


@pytest.fixture
def key_path(tmp_path: Path) -> Path:
    return written(tmp_path / "secret.key", KEY.hex())


def written(path: Path, content: str | bytes, mode: int = 0o600) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    path.chmod(mode)
    return path


def frame(timestamp: int, *, key: bytes = KEY, link: int = 0) -> bytes:
    end = dialect.MAVLink(None, srcSystem=1, srcComponent=25)
    end.signing.secret_key, end.signing.sign_outgoing = key, True
    end.signing.timestamp, end.signing.link_id = timestamp, link
    return dialect.MAVLink_timesync_message(1, 2).pack(end)


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_key(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: expected ")
    assert "found" in message
    assert "\n" not in message
    assert caught.value.__cause__ is None
    assert caught.value.__context__ is None or caught.value.__suppress_context__
    return message


# -- the key


@pytest.mark.parametrize("ending", ["", "\n", "\r\n"])
@pytest.mark.parametrize("text", [KEY.hex(), KEY.hex().upper()])
def test_64_hexadecimal_digits_are_the_key_itself(tmp_path, text, ending):
    assert read_key(written(tmp_path / "key", text + ending)) == KEY


def test_a_passphrase_is_hashed_as_published_for_sha_256(tmp_path):
    published = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # FIPS 180, of "abc"
    assert read_key(written(tmp_path / "key", "abc\n")).hex() == published


@pytest.mark.parametrize("text", [SECRET, "pässwört ✈", KEY.hex()[:-1], KEY.hex() + "0", "g" + KEY.hex()[1:]])
def test_any_other_line_is_a_passphrase_and_its_utf_8_is_hashed(tmp_path, text):
    assert read_key(written(tmp_path / "key", text + "\n")) == hashlib.sha256(text.encode("utf-8")).digest()


def test_a_frame_that_a_ground_station_signs_with_the_passphrase_is_accepted(tmp_path):
    key = read_key(written(tmp_path / "key", SECRET + "\n"))
    theirs = hashlib.new("sha256", SECRET.encode("ascii")).digest()
    assert Signing(key, 0, NOW).check(frame(NOW, key=theirs)) is Verdict.ACCEPTED


def test_a_byte_order_mark_is_no_part_of_a_passphrase(tmp_path):
    assert read_key(written(tmp_path / "key", "\ufeffabc\r\n")) == hashlib.sha256(b"abc").digest()


@pytest.mark.parametrize(
    ("content", "found"),
    [
        ("", "an empty file"),
        ("\n", "an empty file"),
        (f"{SECRET}\n{SECRET}\n", "several lines"),
        (f"{SECRET}\n\n", "several lines"),
        (f"{SECRET}\rmore", "several lines"),
        (f"{KEY.hex()} \n", "blanks at an end of the line"),
        (f" {SECRET}\n", "blanks at an end of the line"),
        ("   \n", "blanks at an end of the line"),
        (f"{SECRET}\0", "control characters"),
        (SECRET.encode() + b"\xff\xfe", "byte 28, which is no UTF-8"),
        (SECRET * (MAX_KEY_FILE_BYTES // len(SECRET) + 1), "more"),
    ],
)
def test_what_is_not_one_line_of_text_is_refused_without_showing_it(tmp_path, content, found):
    message = refusal(written(tmp_path / "key", content))
    assert message.endswith(f"found {found}")
    assert not any(word in message for word in SECRET.split())
    assert KEY.hex() not in message


def test_a_missing_key_file_and_a_name_that_is_none_are_refused(tmp_path):
    assert refusal(tmp_path / "nothing").endswith("found nothing of that name")
    with pytest.raises(InputError, match="expected a file name"):
        read_key(tmp_path / "no\0name")


@needs_modes
def test_what_is_no_regular_file_is_refused_without_waiting_for_it(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path(os.devnull)):
        assert refusal(path).endswith("no regular file")
    assert refusal(tmp_path).endswith("Is a directory")


@needs_modes
@pytest.mark.parametrize("mode", [0o400, 0o600])
def test_a_file_for_its_owner_only_is_read(tmp_path, mode):
    assert read_key(written(tmp_path / "key", KEY.hex(), mode)) == KEY


@needs_modes
@pytest.mark.parametrize("mode", [0o640, 0o620, 0o610, 0o604, 0o602, 0o601, 0o644, 0o666, 0o700, 0o777])
def test_any_other_mode_is_refused(tmp_path, mode):
    message = refusal(written(tmp_path / "key", SECRET, mode))
    assert message.endswith(f"found mode {mode:04o}")


@needs_modes
def test_a_link_is_judged_by_the_file_it_leads_to(tmp_path):
    (tmp_path / "good").symlink_to(written(tmp_path / "private", KEY.hex()))
    (tmp_path / "bad").symlink_to(written(tmp_path / "public", KEY.hex(), 0o644))
    assert read_key(tmp_path / "good") == KEY
    refusal(tmp_path / "bad")


@needs_modes
def test_a_file_of_somebody_else_is_refused(key_path, monkeypatch):
    owner = os.stat(key_path).st_uid
    monkeypatch.setattr(keyfile.os, "geteuid", lambda: owner + 1)
    assert refusal(key_path).endswith(f"found one of user {owner}")


# -- the clock


def test_the_start_is_what_the_wall_clock_showed_when_the_own_clock_was_zero():
    before = time()
    start = wall_clock_start(1_042 * S)
    after = time()
    assert (before - 1_420_070_400 - 1_042) * 100_000 - 2 <= start <= (after - 1_420_070_400 - 1_042) * 100_000 + 2


def test_a_date_that_no_timestamp_can_say_is_refused(monkeypatch):
    monkeypatch.setattr(keyfile, "time_ns", lambda: 4_300_000_000 * S)
    with pytest.raises(InputError, match="before 2104"):
        wall_clock_start(0)


# -- timestamps


def run(key_path: Path, *, port: str = "plant", program: str = "autopilot", key: bytes = KEY, start: int = NOW):
    """Begin one run of a program with one port."""
    store = TimestampStore(key_path, program, key)
    signing = Signing(key, 0, start, store.load(port))
    store.attach(port, signing)
    return store, signing


def heard(store: TimestampStore, signing: Signing, now_ns: int, start: int = NOW) -> bytes:
    """Let the peer be heard, so that a frame of its clock is accepted and returned."""
    for _ in range(2):
        accepted = frame(start + now_ns // 10_000)
        if signing.check(accepted) is Verdict.ACCEPTED:
            return accepted
        store.pass_(now_ns)
    raise AssertionError("the frame was refused")


def sent(signing: Signing) -> int:
    return int.from_bytes(signing.sign(frame(0)[:-13])[-12:-6], "little")


def test_a_clean_stop_leaves_the_exact_values(key_path):
    store, signing = run(key_path)
    accepted = heard(store, signing, 0)
    last = sent(signing)
    store.close()
    _, again = run(key_path, start=NOW - 10**9)
    assert again.check(accepted) is Verdict.TOO_OLD
    assert sent(again) == last + 1


def test_a_crash_leaves_values_ahead_of_all_that_was_used(key_path):
    store, signing = run(key_path)
    accepted, last = heard(store, signing, 0), 0
    for now_ms in range(0, 3_500, 25):
        signing.tick(now_ms * MS)
        accepted = heard(store, signing, now_ms * MS + 10_000)
        last = sent(signing)
        store.pass_(now_ms * MS)
    kept = TimestampStore(key_path, "autopilot", KEY).load("plant")
    assert last < kept.next <= last + RESERVE
    used = int.from_bytes(accepted[-12:-6], "little")
    assert used <= kept.floors[1, 25, 0] <= used + RESERVE
    _, again = run(key_path, start=NOW - 3_600 * 100_000)
    assert again.check(accepted) is Verdict.TOO_OLD
    assert sent(again) > last


def test_before_the_first_frame_the_reserve_is_on_the_disk(key_path):
    assert TimestampStore(key_path, "autopilot", KEY).load("plant") == Timestamps()
    store, signing = run(key_path)
    assert store.writes == 1
    assert sent(signing) < TimestampStore(key_path, "autopilot", KEY).load("plant").next


def test_the_file_is_written_once_a_second_and_sooner_only_for_a_link_that_waits(key_path):
    store, signing = run(key_path)
    store.pass_(0)
    written_at = []
    for now_ms in range(0, 3_001, 10):
        signing.tick(now_ms * MS)
        before = store.writes
        if now_ms == 1_050:
            assert signing.check(frame(NOW)) is Verdict.UNRESERVED
        store.pass_(now_ms * MS)
        if store.writes > before:
            written_at.append(now_ms)
    assert written_at == [1_000, 1_100, 2_100]


def test_nothing_is_written_while_nothing_changes(key_path):
    store, signing = run(key_path)
    signing.tick(0)
    for second in range(10):
        store.pass_(second * S)
    assert store.writes == 1


def test_programs_and_ports_and_keys_have_timestamps_of_their_own(key_path):
    store, signing = run(key_path)
    accepted = heard(store, signing, 0)
    store.close()
    for other in ({"program": "plant"}, {"port": "gcs0"}):
        fresh = Signing(
            KEY,
            0,
            NOW,
            TimestampStore(key_path, other.get("program", "autopilot"), KEY).load(other.get("port", "plant")),
        )
        assert fresh.check(accepted) is Verdict.ACCEPTED
    other_store, _ = run(key_path, key=OTHER_KEY)
    assert other_store.load("plant").floors == {}
    other_store.close()
    _, back = run(key_path)
    assert back.check(accepted) is Verdict.TOO_OLD


def test_two_ports_share_one_file_and_neither_loses_what_the_other_wrote(key_path):
    store = TimestampStore(key_path, "autopilot", KEY)
    ends = {port: Signing(KEY, link, NOW, store.load(port)) for link, port in enumerate(("plant", "gcs0"))}
    for port, end in ends.items():
        store.attach(port, end)
    accepted = [heard(store, end, number * S) for number, end in enumerate(ends.values())]
    store.close()
    again = TimestampStore(key_path, "autopilot", KEY)
    for port, taken in zip(ends, accepted, strict=True):
        assert Signing(KEY, 0, NOW, again.load(port)).check(taken) is Verdict.TOO_OLD


def test_the_file_is_private_and_says_nothing_of_the_key(key_path):
    store, signing = run(key_path)
    heard(store, signing, 0)
    store.close()
    content = store.path.read_bytes()
    assert store.path == timestamps_path(key_path, "autopilot") == key_path.parent / "secret.key.autopilot.timestamps"
    if os.name == "posix":
        assert store.path.stat().st_mode & 0o777 == 0o600
    assert KEY.hex().encode() not in content
    assert hashlib.sha256(KEY).hexdigest()[:16].encode() not in content
    (entry,) = tomllib.loads(content.decode())["port"]
    assert entry["stream"] == [{"system": 1, "component": 25, "link": 0, "floor": NOW}]
    assert sorted(key_path.parent.iterdir()) == sorted([key_path, store.path])


def test_an_end_while_the_file_is_replaced_leaves_the_former_one(key_path, monkeypatch):
    store, signing = run(key_path)
    before = store.path.read_bytes()

    def ended(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(atomic.os, "replace", ended)
    signing.tick(5 * S)
    with pytest.raises(KeyboardInterrupt):
        store.pass_(5 * S)
    assert store.path.read_bytes() == before
    assert sorted(key_path.parent.iterdir()) == sorted([key_path, store.path])


def test_a_disk_that_fails_in_flight_is_counted_and_stops_no_frame(key_path, monkeypatch):
    store, signing = run(key_path)
    heard(store, signing, 0)
    with monkeypatch.context() as patch:
        patch.setattr(atomic.os, "replace", _no_space)
        signing.tick(100 * S)
        store.pass_(100 * S)
        assert (store.failures, store.failure) == (1, "No space left on device")
        assert signing.check(frame(NOW + 100 * 100_000)) is Verdict.ACCEPTED
        signing.tick(200 * S)
        assert signing.check(frame(NOW + 200 * 100_000)) is Verdict.ACCEPTED
        assert sent(signing) >= NOW + 200 * 100_000
    store.pass_(200 * S)
    assert (store.failures, store.failure) == (1, "")
    assert TimestampStore(key_path, "autopilot", KEY).load("plant") == signing.ahead()
    assert signing.check(frame(NOW + 900 * 100_000)) is Verdict.UNRESERVED


def _no_space(*_):
    raise OSError(28, os.strerror(28))


def test_a_folder_that_cannot_be_written_is_refused_before_the_first_frame(key_path, monkeypatch):
    monkeypatch.setattr(atomic.os, "replace", _no_space)
    with pytest.raises(
        InputError, match=r"autopilot\.timestamps: expected a file that can be written, found: No space"
    ):
        run(key_path)


def test_closing_twice_or_without_a_link_writes_nothing_more(key_path):
    store, signing = run(key_path)
    store.close()
    writes = store.writes
    signing.tick(10 * S)
    store.close()
    store.pass_(10 * S)
    assert store.writes == writes
    idle = TimestampStore(key_path, "plant", KEY)
    idle.pass_(0)
    idle.close()
    assert not idle.path.exists()


ENTRY = '[[port]]\nname = "plant"\nkey = "k"\nnext = 1\nunseen = -1\n'
STREAM = "[[port.stream]]\nsystem = 1\ncomponent = 1\nlink = 0\nfloor = 5\n"


def many(text: str, count: int, field: str) -> str:
    return "".join(
        text.replace(field, f"{field[:-1]}{i}{field[-1]}" if field[-1] == '"' else f"{field[:-1]}{i}")
        for i in range(count)
    )


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"\xff\xfe", "expected UTF-8"),
        ("not toml", "expected TOML"),
        ("port = 3", "port: expected an array of tables"),
        ("ports = []", "expected one of port, found an unknown key"),
        (ENTRY.replace("next = 1", "next = 1.5"), r"port\[0\].next: expected an integer"),
        (ENTRY.replace("next = 1", f"next = {1 << 48}"), r"port\[0\].next: expected an integer"),
        (ENTRY.replace("unseen = -1\n", ""), r"port\[0\].unseen: expected an integer"),
        (ENTRY + ENTRY, "expected one entry per port and key, found plant twice"),
        (ENTRY + STREAM + STREAM, "expected every stream once, found 1, 1, 0 twice"),
        (ENTRY + STREAM.replace("system = 1", "system = 256"), "system: expected an integer"),
        (ENTRY + STREAM.replace("floor = 5", 'floor = "5"'), "floor: expected an integer"),
        (ENTRY + many(STREAM, MAX_STREAMS + 1, "link = 0"), f"at most {MAX_STREAMS} streams"),
        (many(ENTRY, MAX_ENTRIES + 1, 'name = "plant"'), f"at most {MAX_ENTRIES} entries"),
        ("#" * ((1 << 20) + 1), "found more"),
    ],
)
def test_a_malformed_file_is_refused_by_name(key_path, content, complaint):
    path = written(timestamps_path(key_path, "autopilot"), content)
    with pytest.raises(InputError, match=complaint) as caught:
        TimestampStore(key_path, "autopilot", KEY)
    assert str(caught.value).startswith(f"{path}: ")


@needs_modes
def test_a_timestamps_file_that_others_can_change_is_refused(key_path):
    written(timestamps_path(key_path, "autopilot"), ENTRY, 0o622)
    with pytest.raises(InputError, match="found mode 0622"):
        TimestampStore(key_path, "autopilot", KEY)


def test_an_entry_beyond_the_maximum_is_refused_and_a_known_one_is_not(key_path):
    written(timestamps_path(key_path, "autopilot"), many(ENTRY, MAX_ENTRIES, 'name = "plant"'))
    store = TimestampStore(key_path, "autopilot", KEY)
    with pytest.raises(InputError, match=f"at most {MAX_ENTRIES} entries, found no room for port plant"):
        store.attach("plant", Signing(KEY, 0, NOW))


def test_what_is_written_is_read_back_as_it_was(key_path):
    kept = Timestamps(NOW, 17, {(system, 190, link): NOW + link for system in (1, 255) for link in range(8)})
    store = TimestampStore(key_path, "autopilot", KEY)
    store.attach("gcs0", Signing(KEY, 0, NOW, kept))
    store.close()
    assert TimestampStore(key_path, "autopilot", KEY).load("gcs0") == kept
